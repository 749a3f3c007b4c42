"""Deviation of a camera from its planned place, from one picture of the pattern with the robot at a known pose.

The pattern's pose `X_CP` in the camera follows from its corners, its pose `X_BP` in the robot's base from the joints, so the
camera is at `X_BC = X_BP X_CP^-1`. With the corners' covariance of position `d` and turn `w` of the pattern, both in the
camera's axes, the camera's own errors are `w x p - d` and `-w`. A plate that faces the camera squarely has a second, mirrored
tilt of almost the same picture (Schweighofer & Pinz 2006); of two that the corners do not separate, the one nearer to the
wanted place is taken, with a warning.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import Frame
from tau_dyn.calibrate.poses.camera import Camera
from tau_dyn.calibrate.poses.devices import transform_to_base, transform_to_device
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses
from tau_dyn.vision import Cameras, Pattern, measure_poses_from_images

_TO_PRINT = np.diag([1.0, -1.0, -1.0])
"""From the printed pattern's frame (y down, z into the plate) to the target's (y up, z out of it); it is its own inverse."""
_MIN_TILT_STDERR = 5.0  # standard errors between two tilts that corners separate
_MIN_CHI2_DIFFERENCE = 25.0  # of two tilts, in corner variances, as `vision` takes it
_MAX_NOISE_RATIO = 5.0
"""Ratio to the camera's corner noise above which its focal length, its lens or the pattern's size is in doubt."""
_SHIFTS = (("right", "left"), ("down", "up"), ("forwards", "backwards"))
_TURNS = (("up", "down"), ("right", "left"), ("clockwise", "anticlockwise"))
"""Words for positive and negative numbers."""
_ROOM = 0.15  # of the picture's width and height between pattern and border, where a pose leaves so much
_UPSIDE_DOWN = float(np.deg2rad(90.0))  # turn about the line of sight beyond which the picture is upside down


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Motion that brings a camera to its planned place.

    Attributes:
        camera: Its actual place, in the robot's base frame.
        target: The pattern as found, in the camera's frame.
        shift: To the right, down and forwards, in the axes of the camera at its actual place (3,) [m].
        turn: Rotation vector about these axes (3,) [rad]: up, to the right, clockwise.
        stderr: Standard errors of both (6,), from the corners alone.
        rms: Root mean square residual of the corners [px].
        warnings: Sentences.
    """

    camera: Frame
    target: Poses
    shift: np.ndarray
    turn: np.ndarray
    stderr: np.ndarray
    rms: float
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the correction for a JSON result."""
        return {
            "shift": {"axes": ["right", "down", "forwards"], "value": self.shift, "stderr": self.stderr[:3], "unit": "m"},
            "turn": {
                "axes": ["up", "right", "clockwise"], "value": self.turn, "stderr": self.stderr[3:], "unit": "rad",
            },
            "position": self.camera.translation,
            "direction": self.camera.rotation[:, 2],
            "rms_px": self.rms,
        }  # fmt: skip

    def describe(self) -> list[str]:
        """Return instructions, a sentence each for place and direction."""
        shifts = _list_moves(1e3 * self.shift, 1e3 * self.stderr[:3], _SHIFTS, 1, "mm")
        turns = _list_moves(np.rad2deg(self.turn), np.rad2deg(self.stderr[3:]), _TURNS, 2, "deg")
        return [
            f"move the camera {shifts}, in its own axes",
            f"then turn it {turns}",
            "± standard error from the picture; errors of the robot file come on top",
        ]


def _list_moves(
    values: np.ndarray, errors: np.ndarray, words: tuple[tuple[str, str], ...], digits: int, unit: str
) -> str:
    return ", ".join(
        f"{abs(x):.{digits}f} ± {s:.{digits}f} {unit} {names[int(x < 0)]}"
        for x, s, names in zip(values, errors, words, strict=True)
    )


def compute_camera_covariance(camera: Camera, tool: Poses) -> np.ndarray:
    """Return the covariance (N, 6, 6) of a camera's place [m] and turn [rad], in its axes, found from one picture each."""
    at = transform_to_device(camera.frames, tool)
    slope = camera.compute_slope(at)
    of_target = camera.pixel_noise**2 * np.linalg.inv(np.swapaxes(slope, 1, 2) @ slope)
    return np.array([_carry_to_camera(c, p) for c, p in zip(of_target, at.position, strict=True)])


def _carry_to_camera(covariance: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the covariance (6, 6) of the camera from that of the pattern at a position (3,) [m] in it."""
    x, y, z = position
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    carry = np.block([[-np.eye(3), -cross], [np.zeros((3, 3)), -np.eye(3)]])
    return carry @ covariance @ carry.T


def choose_picture_pose(camera: Camera, tool: Poses) -> int:
    """Return the tool pose (of N) at which one picture determines the camera's place best.

    The pattern must be well inside the picture, so that a camera that is not yet at its place sees it as well.
    """
    spread = np.trace(compute_camera_covariance(camera, tool)[:, :3, :3], axis1=1, axis2=2)
    size, at = np.array(camera.image), transform_to_device(camera.frames, tool)
    pixels = camera.project(camera.place_corners(at))
    room = np.minimum(pixels, size - 1 - pixels).min(axis=1) / size
    inside = room.min(axis=1)
    return int(np.argmin(np.where(inside >= min(_ROOM, inside.max()), spread, np.inf)))


def find_camera_correction(camera: Camera, tool: Poses, taken: str | Path) -> CameraCorrection:
    """Return the motion that brings a camera to its planned place, from a picture that it took.

    Args:
        camera: The camera at its planned place; its lens is taken as corrected.
        tool: The tool's pose (1) in the robot's base frame when the picture was taken.
        taken: The picture.

    Raises:
        InputError: No picture, another size, no pattern in it, or a pattern that looks the same upside down.
    """
    pattern = Pattern(camera.pattern.columns, camera.pattern.rows, camera.pattern.square)
    numbers = np.array([[*camera.focal, *camera.centre, 0.0, 0.0, 0.0, 0.0, 0.0]])
    size, exact = np.array([camera.image]), np.zeros((len(numbers[0]),) * 2)
    known = Cameras(numbers, np.eye(3)[None], np.zeros((1, 3)), size, "none", exact)
    found = measure_poses_from_images([str(taken)], pattern, cameras=known)
    seen, said = Poses(found.position, found.rotation @ _TO_PRINT), []
    noise = max(float(found.rms[0]) / np.sqrt(2), 1e-3)
    wanted = transform_to_device(camera.frames, tool)
    stderr = float(np.sqrt(np.trace(found.covariance[0][3:, 3:])))
    seen, unsure = _choose_tilt(camera, seen, wanted, noise, stderr)
    if unsure:
        said.append(
            "the plate faces the camera so squarely that its tilt has two answers; the one nearer to the wanted place is taken: "
            "take another picture at a pose where the plate is seen at 20 degrees or more"
        )
    if noise > _MAX_NOISE_RATIO * camera.pixel_noise:
        said.append(
            f"the corners are {noise:.2f} px from those of the camera file, whose noise is {camera.pixel_noise:g} px; check "
            "focal length and pattern, and take the lens' distortion out of the picture"
        )
    base = transform_to_base(camera.frames, tool)
    rotation = base.rotation[0] @ seen.rotation[0].T
    stands = Frame(rotation, base.position[0] - rotation @ seen.position[0])
    shift = rotation.T @ (camera.pose.translation - stands.translation)
    turn = Rotation.from_matrix(rotation.T @ camera.pose.rotation).as_rotvec()
    if abs(turn[2]) > _UPSIDE_DOWN:
        said.append("the picture is upside down against the camera file; check `up` of camera and pattern")
    covariance = _carry_to_camera(found.covariance[0], seen.position[0])
    return CameraCorrection(stands, seen, shift, turn, np.sqrt(np.diag(covariance)), float(found.rms[0]), tuple(said))


def _choose_tilt(camera: Camera, seen: Poses, wanted: Poses, noise: float, stderr: float) -> tuple[Poses, bool]:
    """Return the pattern as found or with its other tilt, and whether the corners leave both open.

    The corners leave both open if the other tilt fits as well, or if the tilts differ by less than five standard errors [rad].
    """
    sight = seen.position[0] / np.linalg.norm(seen.position[0])
    half_turn = Rotation.from_rotvec(np.pi * sight).as_matrix()
    normal = seen.rotation[0][:, 2]
    turned = Rotation.align_vectors((half_turn @ normal)[None], normal[None])[0]
    swing, near = turned.as_matrix(), bool(turned.magnitude() < _MIN_TILT_STDERR * stderr)
    pixels = camera.project(camera.place_corners(seen))
    try:
        other = camera.locate(pixels, Poses(seen.position, (swing @ seen.rotation[0])[None]))
    except InputError:
        return seen, near
    gap = camera.project(camera.place_corners(other)) - pixels
    apart = Rotation.from_matrix(seen.rotation[0].T @ other.rotation[0]).magnitude()
    if not np.isfinite(gap).all() or np.sum(gap**2) > _MIN_CHI2_DIFFERENCE * noise**2 or apart < np.deg2rad(1.0):
        return seen, near
    away = [Rotation.from_matrix(p.rotation[0].T @ wanted.rotation[0]).magnitude() for p in (seen, other)]
    return (seen if away[0] <= away[1] else other), True
