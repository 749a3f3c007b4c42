"""Where searches in the loop begin: first values of causes, springs at resonances an octave apart, the best at each joint.

Sums of squares of springs, plays and dead bands have several minima, so these begin at several places.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.servo.by_gain import extend_unknowns
from tau_dyn.servo.data import BASELINE, LoopData, fit_precisely, keep_kinds
from tau_dyn.servo.fit import LoopFit, fit_loop
from tau_dyn.servo.unknowns import LoopUnknowns, compute_stiffness

SPRING = "joint_compliance"
TRY_ITERATIONS = 6  # from a solution of all but the new numbers
_FIRST = {
    "command_delay": 0.01,
    "torque_delay": 0.005,
    "load_friction": 0.15,
    "carried_friction": 0.15,
    "supply_sag": 0.15,
    "drive_exponent": -0.1,
}
"""First changes of entries off their null."""
_PROFILE = 20.0  # rad/s^2; half of the highest that Feetech's servos can be set to
_FIRST_STICTION = 3e-3  # as a share of the loop's stiffness
_PLAYS = (0.005, 0.03)  # rad; of gears, and of worn hobby servos
DELAYS = (0.002, 0.008)  # s; a step of a servo's bus, and several
_DEAD_BANDS = (0.006, 0.03)  # rad; Coulomb friction stands for a small part of a large one
RESONANCES_HZ = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Resonances of the link on its spring, the motor held, at which springs start, up to the log's Nyquist frequency."""
_DAMPING_RATIO = 0.05  # of a spring's start; of gears with elastic parts, 0.02 to 0.1
_FEW = 0.1  # share of a rigid joint's viscous friction, and of the link's inertia as the drive's, with which springs start too


def list_starts(data: LoopData, u: LoopUnknowns, fit: LoopFit, cause: str) -> list[dict[str, np.ndarray]]:
    """Return the values, by entry (na,), that a search for a cause begins with."""
    entry, values, na = LOOP_CAUSES[cause].entries[0], u.with_values(fit.x), len(data.law.joints)
    if cause == SPRING:
        theta = np.append(1.0, fit.x[u.n - data.space.n_unknowns :])
        inertia = np.mean([(w.inertia @ theta).mean(axis=0) for w in data.loads], axis=0)
        inertia = np.maximum(inertia, 1e-3 * np.maximum(values["armature"], 1e-6))
        highest = 0.5 / max(r.dt for r in data.records)
        turns = [2 * np.pi * f for f in RESONANCES_HZ if f < highest]
        springs = [
            {"joint_compliance": 1 / (inertia * w**2), "joint_damping": 2 * _DAMPING_RATIO * inertia * w} for w in turns
        ]
        # what a rigid joint puts into friction and drive inertia to stand for a spring would lead its search astray
        heavy = {key: np.array(values[key]) for key in ("viscous", "armature")}
        light = {"viscous": _FEW * values["viscous"], "armature": np.maximum(values["armature"], _FEW * inertia)}
        return [spring | rest for rest in (heavy, light) for spring in springs]
    if cause in ("backlash", "dead_band"):
        return [{entry: np.full(na, width)} for width in (_PLAYS if cause == "backlash" else _DEAD_BANDS)]
    if cause == "goal_profile":
        known, passes = data.law.values[entry], data.law.values["steps_pass"]
        first = np.where(np.isfinite(known), known, _PROFILE)
        forms = [passes] if np.any(passes) or np.any(np.isfinite(known)) else [np.ones(na), np.zeros(na)]
        return [{entry: first, "steps_pass": np.array(form)} for form in forms]
    if cause == "stiction":
        return [{entry: values[entry] + _FIRST_STICTION * compute_stiffness(values)}]
    return [{entry: np.array(data.law.values[entry]) + _FIRST.get(entry, 0.0)}]


def free_causes(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    chosen: Sequence[tuple[str, int]],
    starts: Mapping[str, Mapping[str, np.ndarray]],
) -> LoopUnknowns:
    """Return the unknowns at a solution with causes free at their joints, off their null, where friction has a slope."""
    entries = list(dict.fromkeys(entry for cause, _ in chosen for entry in LOOP_CAUSES[cause].entries))
    wide = extend_unknowns(u, fit.x, entries, data)
    free, n = np.array(wide.free), len(u.kinds)
    free[n:] = False
    values = {key: np.array(value) for key, value in wide.values.items()}
    for cause, j in chosen:
        for entry in LOOP_CAUSES[cause].entries:
            free[wide.kinds.index(entry), j] = True
        for entry, start in starts[cause].items():
            values[entry][j] = start[j]
    free[:n] |= u.free
    return replace(wide, free=free, values=values)


def start_best(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    starts: Mapping[str, Sequence[Mapping[str, np.ndarray]]],
    joints: Sequence[int],
) -> LoopUnknowns:
    """Return the unknowns with causes free at joints, at the starts from which a few steps leave least at each joint."""
    places = [(cause, j) for cause in starts for j in joints]
    tried = [dict(zip(starts, one, strict=True)) for one in product(*starts.values())]
    kept = data.build_problem(u).keep_inertial(fit.x)
    problems = [data.build_problem(free_causes(data, u, fit, places, start)) for start in tried]
    sigmas = [fit_loop(one.with_inertial(kept), max_iterations=TRY_ITERATIONS).sigma for one in problems]
    best = [tried[k] for k in np.argmin(sigmas, axis=0)]
    chosen = {
        cause: {entry: np.array([best[j][cause][entry][j] for j in range(len(best))]) for entry in rows[0]}
        for cause, rows in starts.items()
    }
    return free_causes(data, u, fit, places, chosen)


def start_springs(data: LoopData, progress: Callable[[str], None]) -> LoopData:
    """Return the data with unknowns at start values near a spring, where the law asks for one; else as they are."""
    if SPRING not in data.law.estimated:
        return data
    progress("springs from several starts")
    joints = range(len(data.law.joints))
    zero = np.zeros(len(joints))
    stiff = replace(data, law=data.law.with_values(joint_compliance=zero, joint_damping=zero))
    u = keep_kinds(stiff, BASELINE)
    u = replace(u, values={**u.values, SPRING: zero, "joint_damping": zero})
    base = fit_precisely(stiff.build_problem(u), progress)
    starts = list_starts(stiff, u, base, SPRING)
    if np.all(data.law.values[SPRING] > 0):
        starts.append(starts[0] | {key: np.array(data.law.values[key]) for key in (SPRING, "joint_damping")})
    wide = start_best(stiff, u, base, {SPRING: starts}, joints)
    found = wide.with_values(fit_precisely(stiff.build_problem(wide), progress).x)
    values = {key: np.array(x) for key, x in data.unknowns.values.items()}
    values |= {key: found[key] for key in (*BASELINE, SPRING, "joint_damping") if key in values}
    values["command_delay"] = np.array(data.law.values["command_delay"])  # the rigid screen's stands for the spring
    for kind in ("load_friction", "stiction"):
        values[kind] = np.where(data.law.values[kind] > 0, values[kind], _FEW * values[kind])
    return replace(data, unknowns=replace(data.unknowns, values=values))
