"""May a cause be confirmed? Its amplitudes are plausible, its settings inside what was searched, and it is no companion.

A fit finds the best amplitude of any law; these rules ask whether a machine can have it. They are applied after the search: a
law that fails them has been accounted for while others were looked for, and stays in the answer as `suspected` with the reason.

No law is exact on a machine. What a law leaves of a large force is a small force on the same joint, which another cause's law may
take up: its companion. Two laws of one joint's speed take up each other's remainder best: there a curve that one law alone meets
to within what measured friction follows textbook laws is no evidence for a second law. Reference: Armstrong-Helouvry, Dupont &
Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy import stats

from tau_dyn.diagnose.channel import TRAIN, VALIDATION, Channel, measure_friction
from tau_dyn.diagnose.null_model import ColumnCache
from tau_dyn.diagnose.result import Unexplained
from tau_dyn.diagnose.stepwise_selection import SelectedCause
from tau_dyn.effects import Effect, JointScales, Motion, Scene, format_quantity, spell_unit
from tau_dyn.estimate import Estimate, solve_scaled
from tau_dyn.parameters import Parameters

INCONSISTENT_LEVEL = 1e-3
"""Significance level of a difference between joints; standard errors of amplitudes may be some tens of per cent too small."""
EDGE_TOLERANCE = 1e-3
"""Relative distance from the end of a grid within which a setting counts as at the edge."""


def find_edge(effects: Sequence[Effect], scene: Scene) -> str:
    """Return which setting lies at an open end of its grid, as a phrase; empty where none does."""
    for effect in effects:
        free = {*effect.refined, *effect.open_ends}
        fixed = {key: value for key, value in effect.settings.items() if key not in free}
        grid = [s for s in type(effect).grid(scene, effect.joints) if all(s.get(k, x) == x for k, x in fixed.items())]
        for key, end in effect.open_ends.items():
            values = sorted({setting[key] for setting in grid if key in setting})
            if len(values) < 2 or key not in effect.settings:
                continue
            x, unit = (
                effect.settings[key],
                spell_unit(effect.setting_units.get(key, "1"), effect.units[effect.joints[0]]),
            )
            low, high = values[0] * (1 + EDGE_TOLERANCE), values[-1] * (1 - EDGE_TOLERANCE)
            if (end != "high" and x <= low) or (end != "low" and x >= high):
                return f"{key} = {format_quantity(x, unit)} is at the edge of what was searched"
    return ""


def find_implausible(effects: Sequence[Effect], values: Parameters, scales: JointScales) -> str:
    """Return which amplitude lies outside its plausible range, as a phrase; empty where all lie within."""
    return next((text for effect in effects if (text := effect.find_implausible(values, scales))), "")


def find_inconsistent(effects: Sequence[Effect], values: Parameters, step_s: float) -> str:
    """Return that a time which all joints share differs from joint to joint, as a phrase; empty where it does not.

    Channels that one controller reads in turn stand anywhere within one sample, so times that differ by less are one.

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

    Amplitudes that move against each other may each be known badly and yet not both be zero. Of the two covariances of an
    estimate the one that finds less counts. Amplitudes without a standard error, as at a bound, are left out.
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


MAX_LAW_ERROR = 0.05
"""Share of a force by which its law may be inexact: textbook laws of friction meet measured curves to five to ten per cent."""
_SPEEDS = 40
"""Speeds at which two laws are compared, evenly spaced by ratio."""
_SETTING_FACTORS = tuple(np.geomspace(0.25, 4.0, 9))
"""Factors by which a law's settings are tried, as they adjust where another law is left out."""
_MAX_ROWS = 8000
"""Samples from which a force's size is taken: many times the number of parameters."""
_SMALL = "it is {:.1f} % of the force of {} there, whose law is not known as exactly as that"
_ONE_CURVE = "{} alone meets the joint's friction to {:.1f} %, and no law of friction is known more exactly than that"


def measure_net_forces(library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters) -> np.ndarray:
    """Return the rms force (causes, m) of each cause, net of what the baseline absorbs of it."""
    channel = library.channel
    sizes = np.zeros((len(kept), len(channel.outputs)))
    for k in range(len(channel.outputs)):
        base = _take_rows(channel, channel.free_columns, k)
        for n, one in enumerate(kept):
            force = _compute_force(library, one.candidate.effects, values, k)
            if force.any():
                sizes[n, k] = _measure_rms(_remove(base, force))
    return sizes


def find_companion(library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters) -> tuple[int, str] | None:
    """Return the place of a cause that is no larger, on each of its joints, than another cause's law is inexact, and why.

    Args:
        library: The exact columns of effects.
        kept: The causes that stand.
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
    """Return a law of speed whose joints' friction another one meets alone, and why; None where there is none."""
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
        best = min(errors, key=lambda n: errors[n])
        why = _ONE_CURVE.format(kept[best].candidate.cause, 100 * errors[best])
        for n in here:
            reasons[n].append(why if n != best and errors[best] < MAX_LAW_ERROR else "")
    return next(((n, said[0]) for n, said in reasons.items() if said and all(said)), None)


def measure_law_error(
    law: Sequence[Effect], every: Sequence[Effect], values: Parameters, scene: Scene, joint: str
) -> float:
    """Return by how much one law of speed misses a joint's friction by several, at worst, as a share of the friction there.

    Coulomb and viscous friction and the settings that the law adjusts are fitted anew, to relative errors.

    Args:
        law: Effects of the law.
        every: Effects of all the laws.
        values: The fitted amplitudes, and the joint's Coulomb and viscous friction where the model has them.
        scene: What the motion offers; the speeds are between its slowest and its fast ones.
        joint: The joint.
    """
    k = scene.index(joint)
    speed = np.geomspace(scene.slow[k], scene.fast[k], _SPEEDS)
    plain = np.column_stack([np.ones_like(speed), speed])
    own = measure_friction(values, scene).get(joint, {})
    extra = sum(_compute_curve(effect, speed, joint) @ _get_amplitudes(effect, values, joint) for effect in every)
    total = plain @ [own.get("coulomb", 0.0), own.get("viscous", 0.0)] + extra
    weight = 1 / np.maximum(np.abs(total), np.abs(total).max() * 1e-3)
    errors = []
    for steps in product(*(_SETTING_FACTORS for effect in law for _ in effect.refined)):
        factors = iter(steps)
        moved = [e.with_settings(**{key: e.settings[key] * next(factors) for key in e.refined}) for e in law]
        columns = (
            np.column_stack([plain, *(_compute_curve(effect, speed, joint) for effect in moved)]) * weight[:, None]
        )
        left = total * weight - columns @ solve_scaled(columns, total * weight, 1e-7)
        errors.append(float(np.abs(left).max()))
    return min(errors)


def _compute_curve(effect: Effect, speed: np.ndarray, joint: str) -> np.ndarray:
    """Return an effect's force on a joint per unit amplitude at speeds (N,), as (N, p)."""
    one = type(effect)((joint,), (effect.units[joint],), label=effect.label, **effect.settings)
    still = np.zeros((len(speed), 1))
    return one.columns(Motion.of((joint,), still, speed[:, None], still))[:, 0]


def _get_amplitudes(effect: Effect, values: Parameters, joint: str) -> np.ndarray:
    """Return an effect's fitted amplitudes on a joint (p,)."""
    one = type(effect)((joint,), (effect.units[joint],), label=effect.label, **effect.settings)
    return np.array([values[name].value for name in one.parameters.names])


def _compute_force(library: ColumnCache, effects: Sequence[Effect], values: Parameters, output: int) -> np.ndarray:
    """Return the force of effects on an output (N,)."""
    force = np.zeros(1)
    for effect in effects:
        theta = np.array([values[name].value for name in effect.parameters.names])
        force = force + _take_rows(library.channel, library.columns(effect), output) @ theta
    return force


def _take_rows(channel: Channel, columns: Sequence[np.ndarray], output: int) -> np.ndarray:
    """Return an output's columns (N, p) on the data that causes are found and confirmed on, thinned evenly."""
    masks = channel.masks(TRAIN, VALIDATION)
    every = 1 + sum(int(mask.sum()) for mask in masks) // (_MAX_ROWS * len(channel.outputs))
    rows = [c[m[:, output], output] for c, m in zip(columns, masks, strict=True)]
    return np.concatenate(rows)[::every]


def _remove(columns: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return what columns do not reproduce of a force (N,)."""
    return force - columns @ solve_scaled(columns, force, 1e-7)


def _measure_rms(force: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(force**2)))


def demote_companions(
    items: Sequence[Unexplained], outputs: Sequence[str], rms: np.ndarray, largest: np.ndarray
) -> tuple[Unexplained, ...]:
    """Return the structures, those as suspected that are no larger than the law of a confirmed cause is inexact.

    Args:
        items: Structures.
        outputs: Names of the outputs (m,).
        rms: Residual's rms (m,), all causes in the model.
        largest: Rms force of the largest confirmed cause at each output (m,), net of the baseline.
    """
    found = []
    for item in items:
        k = list(outputs).index(item.joint)
        size = np.sqrt(item.share_of_residual_variance) * rms[k]
        is_companion = size < MAX_LAW_ERROR * largest[k]
        found.append(replace(item, status="suspected") if is_companion else item)
    return tuple(found)
