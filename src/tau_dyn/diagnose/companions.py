"""Which causes may only be the inexactness of another cause's law.

No law is exact on a machine. What a law leaves of a large force is a small force on the same joint, which another cause's law may
take up. Two laws of one joint's speed take up each other's remainder best: there a curve that one law alone meets to within what
measured friction follows textbook laws is no evidence for a second law.

Reference: Armstrong-Helouvry, Dupont & Canudas de Wit 1994.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from tau_dyn.diagnose.candidate_scan import ColumnCache
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.data_split import TRAIN, VALIDATION
from tau_dyn.diagnose.result import Unexplained
from tau_dyn.diagnose.scenes import measure_friction
from tau_dyn.diagnose.stepwise_selection import SelectedCause
from tau_dyn.effects import Effect, Motion, Scene
from tau_dyn.estimate import solve_scaled
from tau_dyn.parameters import Parameters

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


def measure_net_forces(
    channel: Channel, library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters
) -> np.ndarray:
    """Return the rms force (causes, m) of each cause, net of what the baseline absorbs of it."""
    sizes = np.zeros((len(kept), len(channel.outputs)))
    for k in range(len(channel.outputs)):
        base = _take_rows(channel, channel.free_columns, k)
        for n, one in enumerate(kept):
            force = _compute_force(channel, library, one.candidate.effects, values, k)
            if force.any():
                sizes[n, k] = _measure_rms(_remove(base, force))
    return sizes


def find_companion(
    channel: Channel, library: ColumnCache, kept: Sequence[SelectedCause], values: Parameters
) -> tuple[int, str] | None:
    """Return the place of a cause that is no larger, on each of its joints, than another cause's law is inexact, and why.

    Args:
        channel: The channel.
        library: The exact columns of effects.
        kept: The causes that stand.
        values: The fitted amplitudes of all of them.
    """
    if len(kept) < 2:
        return None
    sizes = measure_net_forces(channel, library, kept, values)
    largest, which = sizes.max(axis=0), sizes.argmax(axis=0)
    for n in range(len(kept)):
        joints = np.flatnonzero(sizes[n] > 0)
        share = sizes[n, joints] / largest[joints]
        if len(joints) and share.max() < MAX_LAW_ERROR:
            return n, _SMALL.format(100 * share.max(), kept[which[joints[np.argmax(share)]]].candidate.cause)
    return _find_second_speed_law(kept, values, channel.scene)


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


def _compute_force(
    channel: Channel, library: ColumnCache, effects: Sequence[Effect], values: Parameters, output: int
) -> np.ndarray:
    """Return the force of effects on an output (N,)."""
    force = np.zeros(1)
    for effect in effects:
        theta = np.array([values[name].value for name in effect.parameters.names])
        force = force + _take_rows(channel, library.columns(effect), output) @ theta
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
