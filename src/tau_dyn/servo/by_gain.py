"""Logs at several servo gains: estimates of the drive from the logs of each gain alone, and the missing effect if they disagree.

The torque of a drive at full supply does not depend on the gain of the loop around it. If fits at each gain alone estimate
significantly different torques, the law is incomplete, however well each fit follows its own logs. Then the entries that a law
may lack are tested on all logs together, and the entry that explains most is named.

Start values of searches in the loop: first values of causes, springs at resonances in octave steps, the best at each joint.

Sums of squares of springs, plays and dead bands have several minima, so these searches start at several values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.message_codes import CodedWarning
from tau_dyn.servo.data import BASELINE, LoopData, fit_precisely, keep_kinds
from tau_dyn.servo.fit import LoopFit, LoopProblem, fit_loop
from tau_dyn.servo.unknowns import LoopUnknowns, build_unknowns, compute_stiffness

if TYPE_CHECKING:
    from tau_dyn.servo.data import LoopData

MISSING = {"drive_exponent": "a drive law that bends", "supply_sag": "a supply that sags", "dead_band": "a dead band",
           "carried_friction": "a friction that grows with the load"}  # fmt: skip
"""Entries that a law may lack, tested if fits disagree."""
DISAGREES = 3.3
"""Difference of two fits over its standard error from which they disagree: one pair in a thousand by chance."""
MIN_DIFFERENCE = 0.1  # relative; smaller differences change no simulation
MIN_FALL = 0.08
"""Relative decrease of the residual's rms from which an entry is named as missing."""
_ITERATIONS = 10  # from a solution of all logs


def compare_gains(
    data: LoopData, x: np.ndarray, progress: Callable[[str], None]
) -> tuple[tuple[dict[str, Any], ...], list[str]]:
    """Return the estimates from the logs of each gain alone, row by row, and the warnings about them."""
    gains = [tuple(r.entries["position_gain"]) for r in data.records]
    u = extend_unknowns(data.unknowns, x, ("force_per_unit",), data)
    rows, fits = [], []
    for gain in sorted(set(gains)):
        progress(f"logs at gain {gain[0]:.3g} alone")
        chosen = [k for k, g in enumerate(gains) if g == gain]
        fit = fit_loop(_build_problem(data, u, chosen), max_iterations=_ITERATIONS)
        torque, sigma = read_kind(u, fit, "force_per_unit")
        fits.append((torque, sigma))
        joints = data.law.joints
        rows.append({
            "position_gain": dict(zip(joints, gain, strict=True)),
            "logs": [data.records[k].name for k in chosen],
            "force_per_unit": dict(zip(joints, map(float, torque), strict=True)),
            "force_per_unit_stderr": dict(zip(joints, map(float, sigma), strict=True)),
            "rms": dict(zip(joints, map(float, fit.sigma), strict=True)),
        })  # fmt: skip
    odd, pairs = _count_disagreements(fits)
    if not odd:
        return tuple(rows), []
    values = ", ".join(f"{f[0][0]:.3g} ± {f[1][0]:.2g}" for f in fits)
    said = (
        f"the fits at each gain alone disagree in {odd} of {pairs} pairs about the torque for the whole supply "
        f"({values} N m at rising gain), so the servo's law is incomplete"
    )
    return tuple(rows), [CodedWarning("law_incomplete", said + _name_missing(data, x, progress))]


def _count_disagreements(fits: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[int, int]:
    odd = pairs = 0
    for (a, sa), (b, sb) in combinations(fits, 2):
        for j in range(len(a)):
            pairs += 1
            apart = abs(a[j] - b[j])
            odd += apart > DISAGREES * np.hypot(sa[j], sb[j]) and apart > MIN_DIFFERENCE * min(a[j], b[j])
    return odd, pairs


def _name_missing(data: LoopData, x: np.ndarray, progress: Callable[[str], None]) -> str:
    """Return the entry that explains most of the residual of all logs, as the end of a sentence."""
    everything = range(len(data.records))
    plain = extend_unknowns(data.unknowns, x, ("force_per_unit",), data)
    before = fit_loop(_build_problem(data, plain, everything), max_iterations=_ITERATIONS).sigma
    found = []
    for kind, words in MISSING.items():
        if kind in data.unknowns.kinds:
            continue
        progress(f"trying {words}")
        u = extend_unknowns(data.unknowns, x, ("force_per_unit", kind), data)
        fit = fit_loop(_build_problem(data, u, everything), max_iterations=_ITERATIONS)
        fall = float(1 - np.exp(np.mean(np.log(fit.sigma / before))))
        value = read_kind(u, fit, kind)[0]
        found.append((fall, f"{words} ({kind} {value[0]:.2g}) takes {100 * fall:.0f} % off the residual", kind))
    best = max(found, default=(0.0, "", ""))
    if best[0] < MIN_FALL:
        return f"; neither {' nor '.join(MISSING.values())} explains it; log the servo's output and supply voltage"
    return f"; the largest missing part is {best[1]}; write '{best[2]}: {{estimate: START}}' into the controller file"


def extend_unknowns(u: LoopUnknowns, x: np.ndarray, kinds: Sequence[str], data: LoopData) -> LoopUnknowns:
    """Return the unknowns at a solution, with further kinds free at all joints."""
    values = u.with_values(x)
    more = [kind for kind in kinds if kind not in u.kinds]
    wider = build_unknowns(data.law, u.space, values, [*u.kinds, *more])
    n = len(u.kinds)
    free, lower, upper, prior = (np.array(a) for a in (wider.free, wider.lower, wider.upper, wider.prior))
    free[:n], lower[:n], upper[:n], prior[:n] = u.free, u.lower, u.upper, u.prior
    return replace(wider, free=free, lower=lower, upper=upper, prior=prior)


def read_kind(u: LoopUnknowns, fit: LoopFit, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (na,) of a kind, and their standard errors, which are zero where it is fixed."""
    where = np.full(u.free.shape, -1)
    where[u.free] = np.arange(int(u.free.sum()))
    at, sigma = where[u.kinds.index(kind)], np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return u.with_values(fit.x)[kind], np.where(at >= 0, sigma[at], 0.0)


def _build_problem(data: LoopData, u: LoopUnknowns, chosen: Sequence[int]) -> LoopProblem:
    return data.pick(chosen).build_problem(u)


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
"""First changes of entries from their null values."""
_PROFILES = (20.0, 10.0)  # rad/s^2; half and a quarter of the highest that Feetech's servos can be set to
_FIRST_STICTION = 3e-3  # as a share of the loop's stiffness
_PLAYS = (0.005, 0.03)  # rad; of gears, and of worn hobby servos
DELAYS = (0.002, 0.008)  # s; a step of a servo's bus, and several
_DEAD_BANDS = (0.006, 0.03)  # rad
RESONANCES_HZ = (2.0, 4.0, 8.0, 16.0, 32.0)
"""Start resonances of springs, with the link on its spring and the motor fixed, up to the log's Nyquist frequency."""
_DAMPING_RATIO = 0.05  # of a spring's start; of gears with elastic parts, 0.02 to 0.1
_FEW = 0.1  # share of a rigid joint's viscous friction, and of the link's inertia as the drive's, with which springs also start;
# of the Coulomb friction, with which dead bands do


def list_starts(data: LoopData, u: LoopUnknowns, fit: LoopFit, cause: str) -> list[dict[str, np.ndarray]]:
    """Return the values, by entry (na,), that a search for a cause begins with."""
    entry, values, na = LOOP_CAUSES[cause].entries[0], u.with_values(fit.x), len(data.law.joints)
    if cause == SPRING:
        theta = np.append(1.0, fit.x[u.n - data.space.n_unknowns :])
        inertia = np.mean([(w.inertia @ theta).mean(axis=0) for w in data.loads], axis=0)
        inertia = np.maximum(inertia, 1e-3 * np.maximum(values["armature"], 1e-6))
        highest = 0.5 / max(r.interval for r in data.records)
        turns = [2 * np.pi * f for f in RESONANCES_HZ if f < highest]
        springs = [
            {"joint_compliance": 1 / (inertia * w**2), "joint_damping": 2 * _DAMPING_RATIO * inertia * w} for w in turns
        ]
        # the friction and drive inertia with which a rigid joint imitates a spring would mislead the spring's search
        heavy = {key: np.array(values[key]) for key in ("viscous", "armature")}
        light = {"viscous": _FEW * values["viscous"], "armature": np.maximum(values["armature"], _FEW * inertia)}
        return [spring | rest for rest in (heavy, light) for spring in springs]
    if cause == "backlash":
        return [{entry: np.full(na, width)} for width in _PLAYS]
    if cause == "dead_band":  # Coulomb friction has grown by the torque that the dead band takes away
        stiffness, friction = compute_stiffness(values), values["coulomb"]
        rest = [np.maximum(friction - width * stiffness, _FEW * friction) for width in _DEAD_BANDS]
        return [{entry: np.full(na, width), "coulomb": f} for width, f in zip(_DEAD_BANDS, rest, strict=True)]
    if cause == "goal_profile":
        known, passes = data.law.values[entry], data.law.values["steps_pass"]
        limits = _PROFILES[:1] if np.all(np.isfinite(known)) else _PROFILES
        firsts = [np.where(np.isfinite(known), known, limit) for limit in limits]
        forms = [passes] if np.any(passes) or np.any(np.isfinite(known)) else [np.ones(na), np.zeros(na)]
        return [{entry: first, "steps_pass": np.array(form)} for first in firsts for form in forms]
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
    """Return the unknowns at a solution with causes free at their joints, away from their null, where friction has a slope."""
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
    """Return the unknowns with causes free at joints, at the starts of least residual after a few steps at each joint."""
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
    """Return the data with unknowns at start values near a spring if the law has one; otherwise unchanged."""
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
    values["command_delay"] = np.array(data.law.values["command_delay"])  # the rigid screen's delay imitates the spring
    for kind in ("load_friction", "stiction"):
        values[kind] = np.where(data.law.values[kind] > 0, values[kind], _FEW * values[kind])
    return replace(data, unknowns=replace(data.unknowns, values=values))
