"""Parallelism of guideways, and constancy of the plate's orientation (thesis 4.2).

Lines must be measured in one frame. With unit directions d_i, the small angle's vector is `d_i x d_j`; its component along the
lines is no angle, so two numbers are tested (chi-squared).

If all actuators move together along the guideways, the rods do not turn. So the effect of wrong rod lengths or joint
positions on the orientation is constant along the guideways, but differs between places across them. Carts that turn have the
opposite effect (Figure 4.7). The rotation vector against the mean orientation is split by least squares into a part for each
place across (`q` minus its mean), a part for each layer along (the measured position along the direction in which poses of
one place follow the mean of `q`), and a residual. Each part is tested with the other one in the model (two-way analysis of
variance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assumptions.guideway import SIGNIFICANCE_LEVEL, Guideway
from tau_dyn.mechanism import Poses


@dataclass(frozen=True)
class Parallelism:
    """Comparison of two guideways.

    Attributes:
        joints: Their actuated joints.
        angle: Angle between them [rad].
        stderr: Standard error of the angle [rad].
        p_value: p-value of the hypothesis that they are parallel.
        apart: Distance that the angle causes over the longer of the two travels [m].
    """

    joints: tuple[str, str]
    angle: float
    stderr: float
    p_value: float
    apart: float

    @property
    def sure(self) -> bool:
        """Whether the angle is significant."""
        return self.p_value < SIGNIFICANCE_LEVEL

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        size = f"{1e3 * self.angle:.3f} +- {1e3 * self.stderr:.3f} mrad"
        if not self.sure:
            return f"{self.joints[0]} and {self.joints[1]} are parallel as far as these points show ({size})."
        return f"{self.joints[0]} and {self.joints[1]} are not parallel: {size}, {1e6 * self.apart:.0f} um over the travel."

    def to_dict(self) -> dict[str, Any]:
        """Return its content in a result file."""
        return asdict(self) | {"sentence": self.sentence}


def check_parallelism(lines: Sequence[Guideway]) -> list[Parallelism]:
    """Return the comparison of each pair of guideways, all measured in one frame."""
    return [_pair(one, other) for one, other in combinations(lines, 2)]


def _pair(one: Guideway, other: Guideway) -> Parallelism:
    d, g = one.direction, other.direction
    g = g if d @ g > 0 else -g
    angle = np.cross(d, g)
    plane = np.linalg.svd((d + g)[None])[2][1:]
    cross = [_cross(line, plane) for line in (one, other)]
    covariance, two = cross[0] + cross[1], plane @ angle
    size = float(np.linalg.norm(two))
    unit = two / size if size > 0 else np.array([1.0, 0.0])
    statistic = float(two @ np.linalg.pinv(covariance) @ two)
    travel = max(float(np.ptp(line.q)) for line in (one, other))
    p = float(stats.chi2.sf(statistic, 2)) if np.any(covariance) else float(size == 0)
    return Parallelism((one.joint, other.joint), size, float(np.sqrt(unit @ covariance @ unit)), p, size * travel)


def _cross(line: Guideway, plane: np.ndarray) -> np.ndarray:
    """Return the covariance (2, 2) [rad^2] of a direction's turn within the plane's two axes."""
    d = line.direction
    turned = np.cross(d, np.eye(3)).T / np.linalg.norm(line.slope)  # column k: d x (unit change of slope k)
    return plane @ turned @ line.covariance @ turned.T @ plane.T


MIN_ORIENTATION_POSES = 6  # poses; three angles have a mean and a scatter each
POLE_DISTANCE_RAD = np.radians(2.0)
"""Distance of the second Euler angle from 0 or 180 degrees within which the first and third are not separately determined."""


class Part(NamedTuple):
    """One cause's part: rms size [rad], share of the variance, p-value of the hypothesis that it is zero."""

    rms: float
    share: float
    p_value: float


@dataclass(frozen=True, eq=False)
class Orientation:
    """Measured orientation over many poses.

    Attributes:
        turn: Rotation vector from the mean orientation, in the measuring frame (N, 3) [rad].
        euler: ZYZ Euler angles, continuous over the poses (N, 3) [rad].
        place: Number of each pose's place across the guideways (N,).
        layer: Number of each pose's place along them (N,).
        across: Part that changes from place to place: rods and their joints; None if no place was visited twice.
        along: Part that changes along the guideways: carts that turn; None if no place was visited twice.
        rest: rms of the residual of both parts [rad].
        why_not: Reason why there is no split, '' if there is one.
    """

    turn: np.ndarray
    euler: np.ndarray
    place: np.ndarray
    layer: np.ndarray
    across: Part | None
    along: Part | None
    rest: float
    why_not: str

    @property
    def sizes(self) -> np.ndarray:
        """Angle from the mean orientation (N,) [rad]."""
        return np.linalg.norm(self.turn, axis=1)

    @property
    def near_pole(self) -> bool:
        """Whether the first and third Euler angle are poorly determined."""
        return bool(np.min(np.abs(np.sin(self.euler[:, 1]))) < np.sin(POLE_DISTANCE_RAD))

    @property
    def sentence(self) -> str:
        """The verdict in a sentence."""
        start = f"The plate turns by up to {np.degrees(self.sizes.max()):.3f} deg from its mean orientation"
        if self.across is None or self.along is None:
            return f"{start}; {self.why_not}."
        causes = [(self.across, "the rods and their joints: it changes from place to place across the guideways"),
                  (self.along, "carts that turn: it changes along the guideways")]  # fmt: skip
        seen = sorted([c for c in causes if c[0].p_value < SIGNIFICANCE_LEVEL], key=lambda c: -c[0].share)
        if not seen:
            return f"{start}; neither places across nor along the guideways explain it beyond chance."
        return (
            f"{start}; "
            + " and ".join(f"{100 * part.share:.0f} % of it comes from {what}" for part, what in seen)
            + "."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return its content in a result file."""
        euler = np.degrees(self.euler)
        return {
            "n_poses": len(self.turn), "sentence": self.sentence,
            "turn": {"max": float(self.sizes.max()), "rms": float(np.sqrt(np.mean(self.sizes**2)))},
            "euler_zyz_range_deg": dict(zip(("alpha", "beta", "gamma"), np.ptp(euler, axis=0), strict=True)),
            "euler_near_pole": self.near_pole,
            "across": self.across, "along": self.along, "rest_rms": self.rest,
        }  # fmt: skip


def check_orientation(q: np.ndarray, poses: Poses, *, tolerance: float = 2e-3) -> Orientation:
    """Compare measured orientations.

    Args:
        q: Positions of the actuators that run parallel to each other (N, na) [m].
        poses: Measured poses (N), positions included, in any fixed frame.
        tolerance: Actuated positions closer than this [m] are one place.

    Raises:
        InputError: Shapes, numbers, or too few poses.
    """
    q = np.asarray(q, float)
    if q.ndim != 2 or len(q) != len(poses.rotation) or len(q) < MIN_ORIENTATION_POSES:
        raise InputError(
            "too_little_data",
            f"orientation needs at least {MIN_ORIENTATION_POSES} poses with as many actuated positions, not {q.shape[0]}",
        )
    if not (np.isfinite(q).all() and np.isfinite(poses.rotation).all()):
        raise InputError("bad_sample", "every measured pose needs finite numbers")
    measured = Rotation.from_matrix(poses.rotation)
    mean = measured.mean()
    turn = (measured * mean.inv()).as_rotvec()
    place = _clusters(q - q.mean(axis=1, keepdims=True), tolerance)
    layer = _clusters(_along(q.mean(axis=1), poses.position, place), tolerance)
    euler = np.unwrap(_zyz(measured), axis=0)
    return Orientation(turn, euler, place, layer, *_split(turn, place, layer))


def _zyz(measured: Rotation) -> np.ndarray:
    R = measured.as_matrix()
    beta = np.arctan2(np.hypot(R[:, 0, 2], R[:, 1, 2]), R[:, 2, 2])
    alpha = np.arctan2(R[:, 1, 2], R[:, 0, 2])
    return np.column_stack([alpha, beta, np.arctan2(R[:, 2, 1], -R[:, 2, 0])])


def _along(travel: np.ndarray, position: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return positions along the guideways (N, 1) [m]; the direction is how poses of one place follow their travel (N,)."""
    count = np.bincount(place)
    x = travel - np.bincount(place, travel)[place] / count[place]
    if not np.ptp(x) > 0:
        return np.zeros((len(x), 1))
    direction = x @ position
    size = np.linalg.norm(direction)
    return position @ (direction / size)[:, None] if size > 0 else np.zeros((len(x), 1))


def _clusters(x: np.ndarray, tolerance: float) -> np.ndarray:
    return fcluster(linkage(x, "complete"), tolerance, "distance") - 1


def _split(turn: np.ndarray, place: np.ndarray, layer: np.ndarray) -> tuple[Part | None, Part | None, float, str]:
    n, places, layers = len(turn), place.max() + 1, layer.max() + 1
    rest_rms = float(np.sqrt(np.mean(np.sum(turn**2, axis=1))))
    if places == 1 or layers == 1:
        return (
            None,
            None,
            rest_rms,
            "all poses are at one place " + ("across" if places == 1 else "along") + " the guideways",
        )
    by_place, by_layer, one = _dummies(place), _dummies(layer), np.ones((n, 1))
    both = np.hstack([one, by_place, by_layer])
    free = n - np.linalg.matrix_rank(both)
    if free < 3:
        return None, None, rest_rms, "too few places were visited twice to separate rods from carts"
    effect = np.linalg.lstsq(both, turn, rcond=None)[0]
    rest = turn - both @ effect
    total = float(np.sum((turn - turn.mean(axis=0)) ** 2))
    parts = []
    for columns, others, at in ((by_place, by_layer, slice(1, places)), (by_layer, by_place, slice(places, None))):
        part = columns @ effect[at]
        part = part - part.mean(axis=0)
        reduced = np.hstack([one, others])
        more = np.linalg.matrix_rank(both) - np.linalg.matrix_rank(reduced)
        parts.append(_tested(turn, reduced, rest, free, more, part, total))
    return parts[0], parts[1], float(np.sqrt(np.sum(rest**2) / free)), ""


def _dummies(index: np.ndarray) -> np.ndarray:
    """Return a column for each number but the first (N, k - 1)."""
    return (index[:, None] == np.arange(1, index.max() + 1)).astype(float)


def _tested(
    turn: np.ndarray, reduced: np.ndarray, rest: np.ndarray, free: int, more: int, part: np.ndarray, total: float
) -> Part:
    without = turn - reduced @ np.linalg.lstsq(reduced, turn, rcond=None)[0]
    gained, left = np.sum(without**2, axis=0) - np.sum(rest**2, axis=0), np.sum(rest**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        F = np.where(left > 0, gained / more / (left / free), np.where(gained > 0, np.inf, 0.0))
    p = min(1.0, 3 * float(stats.f.sf(F, more, free).min()))  # three components tried
    size = float(np.sum(part**2))
    return Part(float(np.sqrt(size / len(turn))), size / total if total > 0 else 0.0, p)
