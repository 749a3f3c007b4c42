"""A joint whose encoder counts another joint's motion too: a search over all pairs, before any dimension is fitted.

On arms whose elbow is driven from the base the encoder measures against the ground, `x_3 = q_3 +- q_2`. A robot file that does
not say so misses its poses by a large part of its reach, and no fit of dimensions finds the way there. Each pair is tried, with
either sign and the file's dimensions; the device's frame and the targets' places are fitted in closed form.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.families import Family
from tau_dyn.calibrate.models import Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.start import align_with_targets

_MIN_RELATIVE_MISFIT = 0.01
"""What the robot file misses, over how far the poses spread, from which a coupling is looked for."""
_MAX_ERROR_LEFT = 0.3
"""Rms error with the best coupling, over that without and over the next best, below which it stands out."""


class UnitCoupling(NamedTuple):
    """A coupling that stands out.

    Attributes:
        name: As in a model's name, such as `j3=-j2`.
        error: Rms error of the positions with it [m].
        without: Rms error without any [m].
        next_best: Rms error with the next best one [m].
    """

    name: str
    error: float
    without: float
    next_best: float


def find_unit_coupling(family: Family, poses: PoseSet) -> UnitCoupling | None:
    """Return the coupling of all of one joint's motion to another joint that the poses ask for, None where none stands out."""
    without = _measure_misfit(family, poses, Spec("frames"))
    wide = float(np.sqrt(np.mean(np.sum((poses.position - poses.position.mean(axis=0)) ** 2, axis=1))))
    if not without > _MIN_RELATIVE_MISFIT * wide:
        return None
    names = [pair.replace("/", sign) for pair in family.can_have("coupling") for sign in ("=", "=-")]
    errors = np.array([_measure_misfit(family, poses, Spec("frames", {"coupling": (name,)})) for name in names])
    if len(errors) < 2:
        return None
    first, second = np.argsort(errors)[:2]
    if errors[first] < _MAX_ERROR_LEFT * min(without, errors[second]):
        return UnitCoupling(names[first], float(errors[first]), without, float(errors[second]))
    return None


def _measure_misfit(family: Family, poses: PoseSet, spec: Spec) -> float:
    """Return the rms error of the positions [m], inf where fewer than half of the poses are reached."""
    geometry = family.build(spec)
    found = geometry.forward(geometry.parameters.values, poses.q)
    if 2 * found.ok.sum() < poses.n:
        return float("inf")
    seen, nominal = poses.take(found.ok), found.poses.take(found.ok)
    frame, place = align_with_targets(seen, nominal)
    known = nominal.position + np.einsum("nij,nj->ni", nominal.rotation, place[seen.target])
    left = seen.position - frame.translation - known @ frame.rotation.T
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
