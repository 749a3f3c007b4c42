"""Errors between measured and predicted poses, and the measurement noise, known independently of the fit.

The measurement noise is as stated, by columns of the file, from repeated poses, or from the distances between several targets on
the tool, which no pose changes. The residuals of a fit do not measure it: a
model that lacks an effect has larger residuals, and would be judged by its own error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from tau_dyn.calibrate.frames import compute_rotation_between
from tau_dyn.calibrate.measured.pose_set import PoseSet
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses
from tau_dyn.results import Brief


class ErrorSize(NamedTuple):
    """Mean, root mean square and largest of the errors' norms [m or rad]."""

    mean: float
    rms: float
    max: float


@dataclass(frozen=True, eq=False)
class PoseErrors(Brief):
    """Measured minus predicted poses.

    Attributes:
        position: (N, 3) [m] in the device's axes, nan where the model reaches no pose.
        rotation: Rotation vectors (N, 3) [rad] in the device's axes, None if no orientation was measured.
        relative: Stated standard errors of the measurements over their median (N, 6), None if not stated.
        configuration: Which poses have the same joint positions (N,), None if all differ; poses with the same joint positions are
            not independent.
        oriented: Whether the model predicts orientation, so that it counts in comparisons.
        numbers: Independent numbers of each position (N,); three unless given.
        of_tool: Which rows are errors of the tool (N,), all unless given; the others are arcs of passive joints, which count in
            sizes only if there are no errors of the tool.
    """

    position: np.ndarray
    rotation: np.ndarray | None
    relative: np.ndarray | None = None
    configuration: np.ndarray | None = None
    oriented: bool = True
    numbers: np.ndarray | None = None
    of_tool: np.ndarray | None = None

    @property
    def counted(self) -> np.ndarray:
        """Rows that count in sizes (N,)."""
        every = np.ones(len(self.position), bool)
        return every if self.of_tool is None or not self.of_tool.any() else self.of_tool

    @property
    def distance(self) -> np.ndarray:
        """Absolute positioning error (N,) [m], thesis (5.5)."""
        return np.linalg.norm(self.position, axis=1)

    @property
    def angle(self) -> np.ndarray | None:
        """Angle of the orientation error (N,) [rad]."""
        return None if self.rotation is None else np.linalg.norm(self.rotation, axis=1)

    @property
    def position_size(self) -> ErrorSize:
        """Mean, rms and largest positioning error [m]."""
        return _size(self.distance[self.counted])

    @property
    def orientation_size(self) -> ErrorSize | None:
        """Mean, rms and largest orientation error [rad]."""
        angle = self.angle
        return None if angle is None else _size(angle)

    def to_dict(self) -> dict[str, object]:
        """Return the contract's `{position, orientation}`; orientation is None if it was not measured."""
        return {"position": self.position_size, "orientation": self.orientation_size}

    def noise(self) -> tuple[float, float]:
        """Return the rms of a coordinate [m] and of an angle [rad] (1 if there is no error), at the median stated error."""
        position, angle = (self._weighted(k) for k in (0, 1))
        known = np.isfinite(position).all(axis=1)
        numbers = 3 * known.sum() if self.numbers is None else self.numbers[known].sum()
        place = float(np.sqrt(np.sum(position[known] ** 2) / max(numbers, 1)))
        return place or 1.0, float(np.sqrt(np.nanmean(angle**2))) or 1.0

    def score(self, noise: tuple[float, float]) -> np.ndarray:
        """Return squared errors of each configuration in units of the noise [m, rad]; unpredicted ones as the worst."""
        place, turn = (np.sum((self._weighted(k) / noise[k]) ** 2, axis=1) for k in (0, 1))
        squares = _with_worst(place + np.nan_to_num(turn))  # encoders have no orientation
        return squares if self.configuration is None else np.bincount(self.configuration, squares)

    def squared_distance(self) -> np.ndarray:
        """Return squared position errors (N,) [m^2]; a pose without prediction counts as the worst."""
        return _with_worst(np.sum(self.position**2, axis=1))

    def _weighted(self, block: int) -> np.ndarray:
        errors = (self.position, self.rotation if self.oriented else None)[block]
        if errors is None:
            return np.zeros_like(self.position)
        return errors if self.relative is None else errors / self.relative[:, 3 * block : 3 * block + 3]


def compute_pose_errors(
    poses: PoseSet, seen: Poses, target: np.ndarray | None, *, own: bool, lengths: np.ndarray
) -> PoseErrors:
    """Return measured minus predicted poses; a distance or a touch has an error along its measured direction only.

    Args:
        poses: Measured poses.
        seen: Predicted poses of the target in the device's frame.
        target: Orientation of the target on a plate that keeps its own (3, 3).
        own: Whether the prediction has an orientation of its own.
        lengths: Offset or radius of each measurement (N,) [m].
    """
    rotation = None
    if poses.rotation is not None and (own or target is not None):
        predicted = poses.expect(seen).rotation if target is None else seen.rotation @ target
        rotation = np.full_like(poses.position, np.nan)
        ok = np.isfinite(predicted).all(axis=(1, 2))
        rotation[ok] = compute_rotation_between(poses.rotation[ok], predicted[ok])
        rotation[poses.of_encoders] = np.nan
    position = poses.compute_position_residuals(seen, lengths)
    relative, of_tool = poses.relative_errors(6), ~poses.of_encoders
    return PoseErrors(position, rotation, relative, poses.configuration, own, poses.numbers, of_tool)


def _with_worst(squares: np.ndarray) -> np.ndarray:
    worst = np.nanmax(squares) if np.isfinite(squares).any() else 1.0
    return np.where(np.isfinite(squares), squares, worst)


def _size(x: np.ndarray) -> ErrorSize:
    x = x[np.isfinite(x)]
    if not len(x):
        return ErrorSize(float("nan"), float("nan"), float("nan"))
    return ErrorSize(float(x.mean()), float(np.sqrt(np.mean(x**2))), float(x.max()))


_MIN_REPEATS = 5  # measurements beyond the first at the same joints; the standard deviation is then known to a third

NoiseSource = Literal["stated", "columns", "repeats", "targets", "unknown"]


@dataclass(frozen=True)
class MeasurementNoise:
    """Standard errors of a measured coordinate.

    Attributes:
        source: Where they are from; `unknown` if no source is available.
        position: Standard error of a coordinate [m], None if unknown.
        orientation: Standard error about an axis [rad], None if unknown.
    """

    source: NoiseSource
    position: float | None = None
    orientation: float | None = None


def estimate_measurement_noise(poses: PoseSet, accuracy: tuple[float, ...] = ()) -> MeasurementNoise:
    """Return the standard errors of measured poses.

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
    repeated = _from_repeats(poses)
    return _from_targets(poses) if repeated.source == "unknown" else repeated


def _from_repeats(poses: PoseSet) -> MeasurementNoise:
    """Return the pooled standard deviation of poses measured several times with the same joints and loads, in one campaign.

    Touches repeat without scatter, whatever their noise. Encoders count only if no pose of the tool was measured.
    """
    poses = poses.take(~poses.touches & ~(poses.of_encoders & (not poses.of_encoders.all())))
    rows = np.column_stack([poses.configuration, poses.setup, poses.loads])
    _, group = np.unique(rows, axis=0, return_inverse=True)
    group = group.ravel()
    more = poses.n - len(np.unique(group))
    if more < _MIN_REPEATS:
        return MeasurementNoise("unknown")
    size = np.bincount(group)
    mean = np.stack([np.bincount(group, x) / size for x in poses.position.T], axis=1)
    numbers = poses.numbers.mean() * more
    position = float(np.sqrt(np.sum((poses.position - mean[group]) ** 2) / numbers))
    if poses.rotation is None:
        return MeasurementNoise("repeats", position)
    first = np.full(len(size), -1)
    first[group[::-1]] = np.arange(poses.n)[::-1]
    turn = compute_rotation_between(poses.rotation, poses.rotation[first[group]])
    middle = np.stack([np.bincount(group, x) / size for x in turn.T], axis=1)
    return MeasurementNoise("repeats", position, float(np.sqrt(np.sum((turn - middle[group]) ** 2) / (3 * more))))


_GROSS = 5.0
"""Robust standard deviations beyond which a distance between two targets is a mistake, not noise."""


def _from_targets(poses: PoseSet) -> MeasurementNoise:
    """Return the noise by distances between targets at the same joints, which scatter by twice the variance of a coordinate.

    The tool is rigid: whatever the robot does, two targets on it keep their distance. Only targets of one campaign, measured in
    three coordinates by one device, count.
    """
    alone = len(poses.devices) == 1 and not poses.touches.any() and not poses.of_encoders.any()
    if not alone or not np.all(poses.numbers == 3) or len(poses.targets) < 2:
        return MeasurementNoise("unknown")
    at = {
        (k, c, t): i for i, (k, c, t) in enumerate(zip(poses.configuration, poses.campaign, poses.target, strict=True))
    }
    sides: dict[tuple[int, int, int], list[float]] = {}
    for (k, campaign, target), i in at.items():
        for other in range(target + 1, len(poses.targets)):
            if (j := at.get((k, campaign, other))) is not None:
                distance = float(np.linalg.norm(poses.position[i] - poses.position[j]))
                sides.setdefault((campaign, target, other), []).append(distance)
    square, left = 0.0, 0
    for lengths in sides.values():
        off = np.abs(np.array(lengths) - np.median(lengths))
        kept = np.array(lengths)[off <= _GROSS * 1.4826 * np.median(off)]
        if len(kept) > 1:
            square, left = square + float(np.sum((kept - kept.mean()) ** 2)), left + len(kept) - 1
    if left < _MIN_REPEATS:
        return MeasurementNoise("unknown")
    return MeasurementNoise("targets", float(np.sqrt(square / (2 * left))))


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))
