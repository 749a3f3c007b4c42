r"""The tool of a moving robot, tracked by a camera: poses of `see --times`, on the controller's clock and in the robot's base.

The camera measures the target at `t_k` in its own frame, `s_k`. Kinematics give the tool at the same moments, `x_k`, `R_k`, from
the logged drives. The camera's place (R, p) and the target's place o on a tool that turns are those with the least

    sum_k |R s_k + p - x_k - R_k o|^2

The rest is the deflection at the images, errors of the kinematics included; its constant and rigid part is absorbed by the
camera's place. A cubic spline takes it to the controller's samples, so faster changes than half of the image rate are not seen.
The variance of an error is the larger of that of the corners, and that with which the spline through the other images predicts
each one: for white noise the latter is 1.94 times that of an image. References: Arun, Huang, Blostein 1987 (R, p); thesis 5.5,
6.3 (tracking by a camera).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from tau_dyn.control.observers.observation import ToolObservation
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.mechanism import Poses
from tau_dyn.message_codes import CodedWarning

_MIN_IMAGES = 12  # fewer leave no degrees of freedom next to the camera's place
_MAX_TURN_STDERR = 0.02  # rad, of the camera's direction: one axis' deflection then appears in another by 2 %
_MAX_GAP = 2.5  # median steps between images that a spline bridges
_NOISE_OF_NEIGHBOURS = 1.94  # variance of an image less the cubic through its neighbours, for white noise of variance 1
_UNDERSAMPLED = 3.0  # times the noise: the images then miss a part of the motion
_MIN_TURN = 1e-6  # rad, of a tool that turns at all


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """Target positions in a camera's frame.

    Attributes:
        t: Times (n,) [s], increasing, by the clock of the log of the drives.
        position: Positions (n, 3) [m].
        stderr: Standard errors (n, 3) [m].
        source: File.
    """

    t: np.ndarray
    position: np.ndarray
    stderr: np.ndarray
    source: str

    @classmethod
    def of(cls, t: np.ndarray, position: np.ndarray, stderr: np.ndarray, source: str) -> CameraTrack:
        """Return the track of rows in any order; rows without a number are left out."""
        keep = np.isfinite(np.column_stack([t, position, stderr])).all(axis=1)
        order = np.argsort(t[keep], kind="stable")
        t, position, stderr = (x[keep][order] for x in (t, position, stderr))
        if len(t) and np.any(np.diff(t) <= 0):
            raise InputError("time_stamps", f"{source}: two images have the same time")
        return cls(t, position, stderr, source)


def observe_by_camera(axes: Sequence[str], t: np.ndarray, tool: Poses, track: CameraTrack) -> ToolObservation:
    """Return the tool's positions at a log's samples from a camera's track.

    Args:
        axes: Names of the tool's directions along x, y, z, as many as wanted (m of them).
        t: Times of the log (N,) [s], by the clock of the track.
        tool: Poses of the tool computed from the drives (N).
        track: The camera's track.

    Raises:
        CannotAnswer: Too few images, images that do not cover the motion, or a motion that does not show the camera's direction.
    """
    inside = (track.t >= t[0]) & (track.t <= t[-1])
    n = int(inside.sum())
    if n < _MIN_IMAGES:
        raise CannotAnswer(
            "too_little_data",
            f"{track.source}: {n} images within the log; tracking takes {_MIN_IMAGES}",
            "a camera that takes images during the whole motion",
        )
    moments, seen = track.t[inside], track.position[inside]
    _require_covered(moments, t, tool.position, track.source)
    base = CubicSpline(t, tool.position, axis=0)(moments)
    turned = Slerp(t, Rotation.from_matrix(tool.rotation))(moments).as_matrix()
    turn, rest = _register(seen, base, turned, track)
    noise = np.sqrt(np.mean((track.stderr[inside] ** 2) @ (turn**2).T, axis=0))
    others = np.sqrt(np.mean(_predict_from_neighbours(moments, rest) ** 2, axis=0) / _NOISE_OF_NEIGHBOURS)
    stderr = np.maximum(noise, others)
    at = np.clip(t, moments[0], moments[-1])
    m = len(axes)
    position = tool.position[:, :m] + CubicSpline(moments, rest, axis=0)(at)[:, :m]
    notes = tuple(
        CodedWarning(
            "track_undersampled",
            f"{axis}: images differ from their neighbours by {1e6 * o:.3g} um, their corners explain {1e6 * s:.3g} um; the "
            "deflection changes faster than images are taken, or the corners are worse than stated",
        )
        for axis, o, s in zip(axes, others, noise, strict=False)
        if o > _UNDERSAMPLED * s
    )
    how = f"camera, {n} images"
    return ToolObservation(tuple(axes), t - t[0], tool.position[:, :m], position, stderr[:m], how, None, notes)


def _require_covered(moments: np.ndarray, t: np.ndarray, position: np.ndarray, source: str) -> None:
    """Refuse images with a gap while the tool moves.

    Raises:
        CannotAnswer: There is one.
    """
    step = float(np.median(np.diff(moments)))
    ends = np.concatenate([[t[0]], moments, [t[-1]]])
    for a, b in zip(ends, ends[1:], strict=False):
        during = (t >= a) & (t <= b)
        if b - a > _MAX_GAP * step and np.ptp(position[during], axis=0).max(initial=0.0) > 1e-4:
            raise CannotAnswer(
                "too_little_data",
                f"{source}: there is no image from {a:.4g} s to {b:.4g} s, while the tool moves",
                "images of the whole motion, at an even rate",
            )


def _register(
    seen: np.ndarray, base: np.ndarray, rotation: np.ndarray, track: CameraTrack
) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's rotation (3, 3) to the base, and what its place leaves (n, 3) [m].

    Raises:
        CannotAnswer: The motion does not show the camera's direction.
    """
    middle = seen - seen.mean(axis=0)
    spread = np.linalg.svd(middle, compute_uv=False)[1]
    unsure = float(np.sqrt(np.mean(track.stderr**2))) / max(spread, 1e-300)
    if unsure > _MAX_TURN_STDERR:
        raise CannotAnswer(
            "poor_excitation",
            f"{track.source}: the motion is too straight or too small to show the camera's direction, known to {unsure:.2g} rad",
            "a motion in two directions in front of the same camera",
        )
    turn = Rotation.align_vectors(base - base.mean(axis=0), middle)[0]
    start = np.concatenate([turn.as_rotvec(), base.mean(axis=0) - turn.apply(seen.mean(axis=0))])
    turns = float(Rotation.from_matrix(rotation[0].T @ rotation).magnitude().max()) > _MIN_TURN
    start = np.concatenate([start, np.zeros(3 if turns else 0)])

    def left(x: np.ndarray) -> np.ndarray:
        place = Rotation.from_rotvec(x[:3]).apply(seen) + x[3:6]
        return (place - base - (rotation @ x[6:] if turns else 0.0)).ravel()

    found = least_squares(left, start, x_scale="jac").x
    return Rotation.from_rotvec(found[:3]).as_matrix(), left(found).reshape(-1, 3)


def _predict_from_neighbours(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return values (n, 3) less the cubic through two neighbours on each side (n - 4, 3)."""
    out = np.empty((len(t) - 4, x.shape[1]))
    for k in range(2, len(t) - 2):
        near = [k - 2, k - 1, k + 1, k + 2]
        weights = [
            np.prod([(t[k] - t[j]) / (t[i] - t[j]) for j in near if j != i]) for i in near
        ]  # Lagrange's polynomials
        out[k - 2] = x[k] - np.array(weights) @ x[near]
    return out
