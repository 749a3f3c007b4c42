"""How exact the measured poses are, known from outside the fit: as stated, by columns of the file, or from repeated poses.

What a fit leaves is no measure of it: a model that lacks an effect leaves more, and would be judged by its own error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tau_dyn.calibrate.frames import compute_rotation_between
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.exceptions import InputError

_MIN_REPEATS = 5  # measurements beyond the first of their joints; the standard deviation is then known to a third

NoiseSource = Literal["stated", "columns", "repeats", "unknown"]


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard errors of a measured coordinate.

    Attributes:
        source: Where they are from; `unknown` where nothing tells.
        position: Of a coordinate [m], None where unknown.
        orientation: About an axis [rad], None where unknown.
    """

    source: NoiseSource
    position: float | None = None
    orientation: float | None = None

    def to_dict(self) -> dict[str, object]:
        """Return it as results spell it."""
        return {"source": self.source, "position": self.position, "orientation": self.orientation}


def estimate_measurement_noise(poses: PoseSet, accuracy: tuple[float, ...] = ()) -> MeasurementNoise:
    """Return how exact poses are.

    Args:
        poses: Measured poses.
        accuracy: Stated standard errors of a coordinate [m] and perhaps of an orientation about an axis [rad].

    Raises:
        InputError: A stated standard error is not above zero, or there are more than two.
    """
    if accuracy:
        if len(accuracy) > 2 or not all(0 < x < np.inf for x in accuracy):
            text = "the accuracy is a standard error of positions [m] and perhaps one of orientations [rad], above zero"
            raise InputError("invalid_value", f"{text}, not {accuracy}")
        return MeasurementNoise("stated", *accuracy)
    if poses.position_stderr is not None:
        turn = None if poses.rotation_stderr is None else _rms(poses.rotation_stderr)
        return MeasurementNoise("columns", _rms(poses.position_stderr), turn)
    return _from_repeats(poses)


def _from_repeats(poses: PoseSet) -> MeasurementNoise:
    """Return the pooled standard deviation of poses measured several times with the same joints, in one campaign."""
    rows = np.column_stack([poses.configuration, poses.setup])
    _, group = np.unique(rows, axis=0, return_inverse=True)
    group = group.ravel()
    more = poses.n - len(np.unique(group))
    if more < _MIN_REPEATS:
        return MeasurementNoise("unknown")
    size = np.bincount(group)
    mean = np.stack([np.bincount(group, x) / size for x in poses.position.T], axis=1)
    position = float(np.sqrt(np.sum((poses.position - mean[group]) ** 2) / (3 * more)))
    if poses.rotation is None:
        return MeasurementNoise("repeats", position)
    first = np.full(len(size), -1)
    first[group[::-1]] = np.arange(poses.n)[::-1]
    turn = compute_rotation_between(poses.rotation, poses.rotation[first[group]])
    middle = np.stack([np.bincount(group, x) / size for x in turn.T], axis=1)
    return MeasurementNoise("repeats", position, float(np.sqrt(np.sum((turn - middle[group]) ** 2) / (3 * more))))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))
