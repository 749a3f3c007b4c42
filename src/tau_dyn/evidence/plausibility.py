"""Conditions for a confirmed cause: plausible amplitudes, settings inside the range of the search, and no companion.

A fit finds the best amplitude of any law; these rules check whether a machine can have it. They are applied after the search: a
law that fails them was in the model during the search for others, and remains in the result as `suspected`, with the reason.

No law is exact on a machine. The remainder of a large force is a small force on the same joint, which the law of another cause,
its companion, may absorb. Two laws of one joint's speed absorb each other's remainder best: if one law alone fits a curve
within the usual inexactness of textbook friction, the curve is no evidence for a second law. Reference: Armstrong-Helouvry,
Dupont & Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect, JointScales, Motion, Scene, format_quantity
from tau_dyn.estimate import Estimate, solve_scaled
from tau_dyn.evidence.channel import Channel, ColumnCache
from tau_dyn.evidence.measurements import TRAIN, VALIDATION
from tau_dyn.evidence.result import Unexplained
from tau_dyn.evidence.stepwise_selection import SelectedCause
from tau_dyn.parameters import Parameter, Parameters


class Implausible(str):
    """Reason why a fitted cause is implausible: its amplitude, a setting, or a difference between joints."""


INCONSISTENT_LEVEL = 1e-3
"""Significance level of a difference between joints; standard errors of amplitudes may be some tens of per cent too small."""
MAX_EXCESS_STDERR = 2.0
"""Standard errors by which a value may be outside its plausible range and still count as within it."""


def measure_scales(
    parameters: Parameters, scene: Scene, force: np.ndarray, inertia: np.ndarray
) -> dict[str, dict[str, float]]:
    """Return the references of which plausible amplitudes are shares.

    Args:
        parameters: Parameters of a fitted model, including its friction.
        scene: The joints and their speeds.
        force: Largest measured force (na,) [N or N m].
        inertia: Largest inertia (na,) [kg or kg m^2].
    """
    friction = measure_friction(parameters, scene)
    return {
        joint: {"force": float(force[k]), "inertia": float(inertia[k])} | friction[joint]
        for k, joint in enumerate(scene.joints)
    }


def measure_friction(parameters: Parameters, scene: Scene) -> dict[str, dict[str, float]]:
    """Return the friction of each joint of a fitted model [N or N m, and per speed]; empty if it has no friction."""
    found: dict[str, dict[str, float]] = {}
    for k, joint in enumerate(scene.joints):
        own: dict[str, float] = {}
        for key in ("coulomb", "viscous"):
            names = [n for n in (f"{joint}.{key}", f"{joint}.{key}_pos", f"{joint}.{key}_neg") if n in parameters]
            if names:
                own[key] = float(np.mean([abs(parameters[n].value) for n in names]))
        if {"coulomb", "viscous"} <= own.keys() and scene.fast[k] > 0:
            fast = float(scene.fast[k])
            own["drag"] = (own["coulomb"] + own["viscous"] * fast) / fast**2
        found[joint] = own
    return found


def widen_scales(first: JointScales, *others: JointScales) -> JointScales:
    """Return the larger of each scale: next to a friction cause, the baseline's friction in the fit may be small."""
    return {
        joint: {key: max([x, *(s[joint][key] for s in others if key in s.get(joint, {}))]) for key, x in own.items()}
        for joint, own in first.items()
    }


def find_implausible(effects: Sequence[Effect], values: Parameters, scales: JointScales) -> str:
    """Return the amplitude outside its plausible range, as a phrase; empty if all lie within."""
    return next((text for effect in effects if (text := effect.find_implausible(values, scales))), "")


def find_out_of_range(parameters: Sequence[Parameter]) -> str:
    """Return the parameter beyond its bounds by more than its uncertainty, as a phrase; empty if all lie within."""
    for p in parameters:
        spare = MAX_EXCESS_STDERR * (p.stderr or 0.0)
        if not p.lower - spare <= p.value <= p.upper + spare:
            low, high = (format_quantity(x, p.unit) if np.isfinite(x) else "" for x in (p.lower, p.upper))
            span = f"{low} to {high}" if low and high else f"at least {low}" if low else f"at most {high}"
            return f"{p.name} = {format_quantity(p.value, p.unit)} is outside of its plausible range ({span})"
    return ""


def find_inconsistent(effects: Sequence[Effect], values: Parameters, step_s: float) -> str:
    """Return that a time common to all joints differs between joints, as a phrase; empty if it does not.

    Channels that one controller reads in sequence are spread within one sample, so times that differ by less count as equal.

    Args:
        effects: The cause's effects on its joints.
        values: Fitted values with their standard errors.
        step_s: Time between samples of the log [s].
    """
    if not effects[0].shared_by_joints or len(effects) < 2:
        return ""
    own = [values[name] for effect in effects for name in effect.parameters.names]
    own = [p for p in own if p.stderr]
    uniform = step_s / np.sqrt(12)
    weight = np.array([1 / (float(p.stderr or 1.0) ** 2 + uniform**2) for p in own])
    x = np.array([p.value for p in own])
    mean = float(x @ weight / weight.sum()) if len(own) else 0.0
    scatter = float(np.sum(weight * (x - mean) ** 2))
    if len(own) < 2 or stats.chi2.sf(scatter, len(own) - 1) > INCONSISTENT_LEVEL:
        return ""
    listed = ", ".join(f"{p.name.rpartition('.')[0]} {format_quantity(p.value, p.unit)}" for p in own)
    return f"one recording has one {effects[0].name.replace('_', ' ')}, and here it differs between joints ({listed})"


def is_distinct_from_zero(effects: Sequence[Effect], estimate: Estimate, min_z: float) -> bool:
    """Return whether the amplitudes together are distinct from zero: a Wald test at the level of `min_z` standard errors.

    Correlated amplitudes may each be poorly determined and yet not both be zero. The less significant result of the two
    covariances of an estimate is used. Amplitudes without a standard error, as at a bound, are left out.
    """
    base, parameters = estimate.base, estimate.parameters
    own = {name for effect in effects for name in effect.parameters.names}
    known = {p.name for p in parameters if p.stderr is not None and 0 < p.stderr < np.inf}
    rows = [k for k, c in enumerate(base.kept) if base.alone[c] and base.names[c] in own & known]
    if not rows:
        return False
    x = np.array([parameters[base.names[c]].value for c in base.kept[rows]])
    found = np.inf
    for covariance in (estimate.cov, estimate.scatter):
        C = covariance[np.ix_(rows, rows)]
        size = np.sqrt(np.diag(C))
        found = min(
            found, float(x / size @ np.linalg.pinv(C / np.outer(size, size), 1e-6, hermitian=True) @ (x / size))
        )
    return bool(found > stats.chi2.isf(2 * stats.norm.sf(min_z), len(rows)))


MIN_FORCE_SHARE = 1e-5
"""Share of a joint's force below the accuracy of measurements: filter residues of exact data are not a cause."""
MAX_LAW_ERROR = 0.05
"""Share of a force by which its law may be inexact: textbook laws of friction fit measured curves to five to ten per cent."""
_SPEEDS = 40
"""Speeds at which two laws are compared, evenly spaced by ratio."""
_SETTING_FACTORS = tuple(np.geomspace(0.25, 4.0, 9))
"""Factors by which a law's settings are varied, as they adjust if another law is left out."""
_MAX_ROWS = 8000
"""Samples from which a force's size is computed: many times the number of parameters."""
_SMALL = "it is {:.1f} % of the force of {} there, whose law is not known as exactly as that"
_ONE_CURVE = "{} alone meets the joint's friction to {:.1f} %, and no law of friction is known more exactly than that"


def measure_net_forces(library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters) -> np.ndarray:
    """Return the rms force (causes, m) of each cause, net of the part that the baseline absorbs."""
    channel = library.channel
    sizes = np.zeros((len(kept), len(channel.outputs)))
    usable = sum(int(mask.sum()) for mask in channel.masks(TRAIN, VALIDATION))
    every = 1 + usable // (_MAX_ROWS * len(channel.outputs))  # decimated evenly
    for k in range(len(channel.outputs)):
        base = channel.gather(channel.free_columns, k, TRAIN, VALIDATION)[::every]
        for n, one in enumerate(kept):
            force = np.zeros(1)
            for effect in one.candidate.effects:
                columns = channel.gather(library.columns(effect), k, TRAIN, VALIDATION)[::every]
                force = force + columns @ values.select(effect.parameters.names).values
            if force.any():
                left = force - base @ solve_scaled(base, force, 1e-7)
                sizes[n, k] = float(np.sqrt(np.mean(left**2)))
    return sizes


def find_companion(library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters) -> tuple[int, str] | None:
    """Return the index of a cause that is no larger, on each of its joints, than the inexactness of another law, and the reason.

    Args:
        library: The exact columns of effects.
        kept: The accepted causes.
        values: The fitted amplitudes of all of them.
    """
    if len(kept) < 2:
        return None
    sizes = measure_net_forces(library, kept, values)
    largest, which = sizes.max(axis=0), sizes.argmax(axis=0)
    for n in range(len(kept)):
        joints = np.flatnonzero(sizes[n] > 0)
        share = sizes[n, joints] / largest[joints]
        if len(joints) and share.max() < MAX_LAW_ERROR:
            return n, _SMALL.format(100 * share.max(), kept[which[joints[np.argmax(share)]]].candidate.cause)
    return _find_second_speed_law(kept, values, library.channel.scene)


def _find_second_speed_law(kept: Sequence[SelectedCause], values: Parameters, scene: Scene) -> tuple[int, str] | None:
    """Return a law of speed whose joints' friction another law alone fits, and the reason, or None."""
    laws = [n for n, one in enumerate(kept) if all(effect.speed_law for effect in one.candidate.effects)]
    reasons: dict[int, list[str]] = {n: [] for n in laws}
    for joint in scene.joints:
        here = {n: [e for e in kept[n].candidate.effects if joint in e.joints] for n in laws}
        here = {n: effects for n, effects in here.items() if effects}
        if len(here) < 2:
            continue
        errors = {
            n: measure_law_error(effects, sum(here.values(), []), values, scene, joint) for n, effects in here.items()
        }
        alone = [n for n in here if errors[n] < MAX_LAW_ERROR] or list(here)
        best = max(alone, key=lambda n: kept[n].candidate.statistic)
        why = _ONE_CURVE.format(kept[best].candidate.cause, 100 * errors[best])
        for n in here:
            reasons[n].append(why if n != best and errors[best] < MAX_LAW_ERROR else "")
    return next(((n, said[0]) for n, said in reasons.items() if said and all(said)), None)


def measure_law_error(
    law: Sequence[Effect], every: Sequence[Effect], values: Parameters, scene: Scene, joint: str
) -> float:
    """Return the largest relative error of one law of speed for a joint's friction by several laws.

    Coulomb and viscous friction and the adjustable settings of the law are fitted again, to relative errors.

    Args:
        law: Effects of the law.
        every: Effects of all the laws.
        values: The fitted amplitudes, and the joint's Coulomb and viscous friction if the model has them.
        scene: The range of the motion; the speeds are between its slowest and its fast ones.
        joint: The joint.
    """
    k = scene.index(joint)
    speed = np.geomspace(scene.slow[k], scene.fast[k], _SPEEDS)
    plain = np.column_stack([np.ones_like(speed), speed])
    own = measure_friction(values, scene).get(joint, {})
    alone = [_restrict(effect, joint) for effect in every]
    extra = sum(_compute_curve(e, speed) @ values.select(e.parameters.names).values for e in alone)
    total = plain @ [own.get("coulomb", 0.0), own.get("viscous", 0.0)] + extra
    weight = 1 / np.maximum(np.abs(total), np.abs(total).max() * 1e-3)
    errors = []
    for steps in product(*(_SETTING_FACTORS for effect in law for _ in effect.refined)):
        factors = iter(steps)
        moved = [e.with_settings(**{key: e.settings[key] * next(factors) for key in e.refined}) for e in law]
        columns = (
            np.column_stack([plain, *(_compute_curve(_restrict(effect, joint), speed) for effect in moved)])
            * weight[:, None]
        )
        left = total * weight - columns @ solve_scaled(columns, total * weight, 1e-7)
        errors.append(float(np.abs(left).max()))
    return min(errors)


def _restrict(effect: Effect, joint: str) -> Effect:
    """Return an effect on one of its joints alone."""
    return type(effect)((joint,), (effect.units[joint],), label=effect.label, **effect.settings)


def _compute_curve(effect: Effect, speed: np.ndarray) -> np.ndarray:
    """Return a single joint's effect per unit amplitude at speeds (N,), as (N, p)."""
    still = np.zeros((len(speed), 1))
    return effect.columns(Motion.of(effect.joints, still, speed[:, None], still))[:, 0]


def compute_least_forces(channel: Channel) -> np.ndarray:
    """Return the rms (m,) below which a force at an output is not distinct from filter residues of the measured force."""
    return np.asarray(MIN_FORCE_SHARE * np.sqrt(np.mean(np.concatenate([run.y for run in channel.runs]) ** 2, axis=0)))


def demote_small(
    items: Sequence[Unexplained], outputs: Sequence[str], rms: np.ndarray, least: np.ndarray
) -> tuple[Unexplained, ...]:
    """Return the structures; those below the inexactness of confirmed laws and measured forces are suspected.

    Args:
        items: Structures.
        outputs: Names of the outputs (m,).
        rms: Residual's rms (m,), all causes in the model.
        least: Rms force that a structure needs at each output (m,).
    """
    known = {output: least[k] / rms[k] if rms[k] else np.inf for k, output in enumerate(outputs)}
    return tuple(
        replace(u, status="suspected") if np.sqrt(u.share_of_residual_variance) < known[u.joint] else u for u in items
    )
