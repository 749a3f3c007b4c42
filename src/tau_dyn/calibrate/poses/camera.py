r"""One fixed camera and a flat pattern on the tool: what it sees, how well it measures, what it would measure.

A pinhole, z forward, x to the right of the picture, y down: `u = f_x x / z + c_x`, `v = f_y y / z + c_y`. All corners
of the pattern must lie in the picture, the pattern must face the camera and be neither too near nor too far (thesis
5.6). The pattern's pose follows from its corners by least squares, so with corner noise `s` its covariance is `s^2
(H'H)^-1`, `H` the corners' derivative by the pose: depth is measured far worse than what lies across. A pattern seen
squarely hardly shows its tilt, and a tilt that is free makes its depth not only uncertain but biased (to second order
in the noise). So on a plate that keeps its orientation (`steady`) all pictures share one: the pattern is located in
each, the mean orientation is kept, and each position is found anew with it. A lens' distortion is taken as corrected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames, Frame, compute_mean_rotation
from tau_dyn.calibrate.poses.devices import SEEN, transform_to_base, transform_to_device
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses

_STEPS = 8  # iterations of the pose of a view
_AT_REST = 1e-10  # largest part of a step at which the iteration ends


@dataclass(frozen=True)
class CameraPattern:
    """A chessboard: a grid of corners in its frame's plane, z towards who looks at it.

    Attributes:
        columns: Corners along x.
        rows: Corners along y.
        square: Distance of neighbours [m].
        border: Width that must be visible around the outermost corners [m].
    """

    columns: int = 8
    rows: int = 6
    square: float = 0.04
    border: float = 0.0

    @property
    def corners(self) -> np.ndarray:
        """Corners (K, 3) [m], centred."""
        return self._grid(self.columns, self.rows, 0.0)

    @property
    def outline(self) -> np.ndarray:
        """Its four corners with the border (4, 3) [m]."""
        return self._grid(2, 2, self.border)

    def _grid(self, columns: int, rows: int, border: float) -> np.ndarray:
        half = 0.5 * self.square * np.array([self.columns - 1, self.rows - 1]) + border
        x, y = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera that stands still and a pattern on the tool.

    Attributes:
        pose: The camera in the robot's base frame.
        on_tool: The pattern in the tool frame.
        pattern: The pattern.
        focal: Focal lengths (2,) [px].
        image: Width and height (2,) [px].
        centre: Principal point (2,) [px].
        pixel_noise: Standard deviation of a corner's coordinates [px].
        distance: Nearest and farthest distance of the pattern [m].
        incidence: Largest angle between the pattern's normal and the line to the camera [rad].
        margin: What corners keep from the picture's edge [px].
        steady: Whether the pattern keeps its orientation, so that positions alone are measured.
        name: For messages.
    """

    pose: Frame
    on_tool: Frame
    pattern: CameraPattern
    focal: tuple[float, float]
    image: tuple[int, int]
    centre: tuple[float, float]
    pixel_noise: float = 0.2
    distance: tuple[float, float] = (0.3, 10.0)
    incidence: float = float(np.deg2rad(60.0))
    margin: float = 5.0
    steady: bool = False
    name: str = "camera"

    @property
    def frames(self) -> DeviceFrames:
        """The base in the camera's frame, the pattern on the tool."""
        return DeviceFrames((self.pose.inverse,), (self.on_tool,))

    @property
    def turned(self) -> bool:
        """A pattern has an orientation, unless all pictures share one."""
        return not self.steady

    @property
    def place(self) -> np.ndarray:
        """Where it looks from (3,) [m]."""
        return self.pose.translation

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return why it does not see the whole pattern (N,), '' where it does."""
        at = transform_to_device(self.frames, tool)
        out = np.full(len(at.position), SEEN, dtype=object)
        points = _points(at, self.pattern.outline)
        away = np.linalg.norm(at.position, axis=1)
        pixels = self.project(points)
        edge = np.array([self.margin, self.margin]), np.array(self.image) - 1 - self.margin
        outside = ((pixels < edge[0]) | (pixels > edge[1])).any(axis=(1, 2))
        cosine = -np.einsum("ni,ni->n", at.rotation[:, :, 2], at.position) / np.maximum(away, 1e-9)
        rules = (
            ("behind the camera", (points[..., 2] <= 1e-6).any(axis=1)),
            (f"nearer than {self.distance[0]:g} m", away < self.distance[0]),
            (f"farther than {self.distance[1]:g} m", away > self.distance[1]),
            ("pattern seen from behind", cosine <= 0),
            (f"pattern seen at more than {np.rad2deg(self.incidence):.0f} degrees", cosine < np.cos(self.incidence)),
            ("pattern not wholly in the picture", outside),
        )
        for words, wrong in rules:
            out[wrong & (out == SEEN)] = words
        return out

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the pattern's middle and its four corners (N, 5, 3) [m] in the robot's base frame."""
        return _points(transform_to_base(self.frames, tool), np.vstack([np.zeros((1, 3)), self.pattern.outline]))

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance of the pattern's measured pose (N, 6, 6), of a steady one's position (N, 3, 3)."""
        slope = self._slope(transform_to_device(self.frames, tool))
        slope = slope[:, :, :3] if self.steady else slope
        return self.pixel_noise**2 * np.linalg.inv(np.swapaxes(slope, 1, 2) @ slope)

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return the pattern's pose as located in noisy pictures."""
        at = transform_to_device(self.frames, tool)
        pixels = self.project(_points(at, self.pattern.corners))
        pixels = pixels + self.pixel_noise * rng.standard_normal(pixels.shape)
        found = self.locate(pixels, at)
        if not self.steady:
            return found
        turn = np.broadcast_to(compute_mean_rotation(found.rotation), found.rotation.shape)
        return self.locate(pixels, Poses(found.position, turn), turns=False)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (N, K, 2) of points (N, K, 3) [m] in the camera's frame."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return points[..., :2] / points[..., 2:] * np.array(self.focal) + np.array(self.centre)

    def locate(self, pixels: np.ndarray, start: Poses, *, turns: bool = True) -> Poses:
        """Return the pattern's poses in the camera's frame from corners (N, K, 2) [px] by Gauss-Newton.

        A pattern seen squarely from afar has a second, mirrored pose that fits almost as well; `start` decides.
        Without `turns` the orientation stays.

        Raises:
            InputError: The corners do not tell the pose.
        """
        position, rotation = start.position.copy(), start.rotation.copy()
        for _ in range(_STEPS):
            here = Poses(position, rotation)
            gap = (pixels - self.project(_points(here, self.pattern.corners))).reshape(len(pixels), -1, 1)
            slope = self._slope(here)[:, :, : 6 if turns else 3]
            turned = np.swapaxes(slope, 1, 2)
            try:
                step = np.linalg.solve(turned @ slope, turned @ gap)[:, :, 0]
            except np.linalg.LinAlgError:
                raise InputError(
                    "unsupported",
                    "the pattern's corners in the pictures do not tell its pose; check its size, the focal length, the distance",
                ) from None
            position = position + step[:, :3]
            if turns:
                rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            if np.abs(step).max(initial=0.0) < _AT_REST:
                break
        return Poses(position, rotation)

    def _slope(self, at: Poses) -> np.ndarray:
        """Return the corners' derivative by the pattern's twist (N, 2 K, 6)."""
        points = _points(at, self.pattern.corners)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        by_point = np.zeros((*points.shape[:2], 2, 3))
        by_point[..., 0, 0], by_point[..., 0, 2] = self.focal[0] / z, -self.focal[0] * x / z**2
        by_point[..., 1, 1], by_point[..., 1, 2] = self.focal[1] / z, -self.focal[1] * y / z**2
        arms = points - at.position[:, None]
        by_turn = np.cross(arms[:, :, None], by_point)  # u . (w x arm) = w . (arm x u)
        return np.concatenate([by_point, by_turn], axis=3).reshape(len(points), -1, 6)


def build_camera_frame(place: np.ndarray, look_at: np.ndarray, up: np.ndarray) -> Frame:
    """Return the frame of a camera at a place that looks at a point, `up` upwards in the picture.

    Raises:
        InputError: It looks along `up`, or at itself.
    """
    z = look_at - place
    x = np.cross(z, up)
    if np.linalg.norm(z) < 1e-9 or np.linalg.norm(x) < 1e-9 * np.linalg.norm(z) * max(np.linalg.norm(up), 1e-9):
        raise InputError(
            "invalid_value",
            "the camera's direction is not given: look_at must differ from position, and up from the line between them",
        )
    z, x = z / np.linalg.norm(z), x / np.linalg.norm(x)
    return Frame(np.stack([x, np.cross(z, x), z], axis=1), place)


def build_target_frame(place: np.ndarray, normal: np.ndarray, up: np.ndarray) -> Frame:
    """Return a target's frame: z along `normal`, `up` against its y (so that it stands upright in a picture).

    Raises:
        InputError: `normal` has no length or lies along `up`.
    """
    frame = build_camera_frame(place, place - normal, up)
    return Frame(frame.rotation @ np.diag([1.0, -1.0, -1.0]), place)


def _points(at: Poses, local: np.ndarray) -> np.ndarray:
    return at.position[:, None] + np.einsum("nij,kj->nki", at.rotation, local)
