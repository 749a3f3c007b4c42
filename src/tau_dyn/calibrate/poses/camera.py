"""One camera and a flat pattern, one of them on the tool: visibility and accuracy; cameras and trackers read from YAML.

A pinhole, z forward, x to the right of the picture, y down: `u = f_x x / z + c_x`, `v = f_y y / z + c_y`. All corners of the
pattern must be in the picture, the pattern must face the camera and be neither too near nor too far (thesis 5.6). With corner
noise `s` the pattern's pose has the covariance `s^2 (H'H)^-1`, `H` the corners' derivative by the pose: depth is measured far
worse than the lateral position. A pattern seen squarely hardly shows its tilt, and a tilt that is free biases its depth. So on a
plate that keeps its orientation (`steady`) all pictures share one: the pattern is located in each, the mean orientation is
kept, and each position is estimated again with it. A lens' distortion is taken as corrected.

Files have lengths in m, angles in degrees, places in the robot's base frame; orientations only with `orientation_noise`:

    camera: {position: [5.5, -0.6, 0.8], look_at: [1.7, -0.6, 0.7], image: [1280, 960], focal: 1400, noise: 0.2}
    pattern: {columns: 8, rows: 6, square: 0.04, position: [0, 0, 0], normal: [1, 0, 0], up: [0, 0, 1]}
    limits: {distance: [0.5, 6], incidence: 60, margin: 5}
    choose: {position: [[3, 7], [-2, 1], [0.2, 2]]}

`choose` names the values that are optimised: a place within ranges of x, y and z, and the direction; or `choose: direction`
alone. With `mount: tool` the camera is on the tool, its place in the tool frame, and the pattern is stationary in the base frame.

    tracker: {position: [5, -0.6, 1], noise: 10e-6, noise_per_metre: 5e-6}
    reflector: {position: [0, 0, 0], normal: [1, 0, 0], orientation_noise: 50e-6}
    limits: {distance: [0.5, 30], incidence: 30, elevation: [-45, 45]}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames, Frame, compute_mean_rotation
from tau_dyn.calibrate.measured.kinds import invert_poses
from tau_dyn.calibrate.poses.devices import StandingDevice, Tracker, transform_to_base
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml
from tau_dyn.mechanism import Poses

_STEPS = 8  # iterations of the pose of a view
_AT_REST = 1e-10  # largest part of a step at which the iteration ends


@dataclass(frozen=True)
class CameraPattern:
    """A chessboard: a grid of corners in its frame's plane, z towards the viewer.

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
class Camera(StandingDevice):
    """A stationary camera and a pattern on the tool.

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
        margin: Least distance of corners from the picture's edge [px].
        steady: Whether the pattern keeps its orientation, so that positions alone are measured.
        name: Name in messages.
        up: Direction that points upwards in the picture (3,), in the robot's base frame.
        places: Lowest and highest x, y, z of its place (3, 2) [m] if place and direction are to be chosen, None if the
            camera's place is given; with equal ones only the direction is chosen.
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
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    places: np.ndarray | None = None

    @property
    def turned(self) -> bool:
        """A pattern has an orientation, unless all pictures share one."""
        return not self.steady

    def _rules(self, at: Poses) -> Sequence[tuple[str, np.ndarray]]:
        points = _points(at, self.pattern.outline)
        away = np.linalg.norm(at.position, axis=1)
        pixels = self.project(points)
        edge = np.array([self.margin, self.margin]), np.array(self.image) - 1 - self.margin
        outside = ((pixels < edge[0]) | (pixels > edge[1])).any(axis=(1, 2))
        cosine = -np.einsum("ni,ni->n", at.rotation[:, :, 2], at.position) / np.maximum(away, 1e-9)
        return (
            ("behind the camera", (points[..., 2] <= 1e-6).any(axis=1)),
            (f"nearer than {self.distance[0]:g} m", away < self.distance[0]),
            (f"farther than {self.distance[1]:g} m", away > self.distance[1]),
            ("pattern seen from behind", cosine <= 0),
            (f"pattern seen at more than {np.rad2deg(self.incidence):.0f} degrees", cosine < np.cos(self.incidence)),
            ("pattern not wholly in the picture", outside),
        )

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the pattern's middle and its four corners (N, 5, 3) [m] in the robot's base frame."""
        return _points(transform_to_base(self.frames, tool), np.vstack([np.zeros((1, 3)), self.pattern.outline]))

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance of the pattern's measured pose (N, 6, 6), or of the position of a steady one (N, 3, 3)."""
        slope = self.compute_slope(self.see(tool))
        slope = slope[:, :, :3] if self.steady else slope
        return self.pixel_noise**2 * np.linalg.inv(np.swapaxes(slope, 1, 2) @ slope)

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return the pattern's pose as located in noisy pictures."""
        at = self.see(tool)
        pixels = self.project(self.place_corners(at))
        pixels = pixels + self.pixel_noise * rng.standard_normal(pixels.shape)
        found = self.locate(pixels, at)
        if not self.steady:
            return found
        turn = np.broadcast_to(compute_mean_rotation(found.rotation), found.rotation.shape)
        return self.locate(pixels, Poses(found.position, turn), turns=False)

    def place_corners(self, at: Poses) -> np.ndarray:
        """Return the corners (N, K, 3) [m] of patterns at poses (N), in the same frame."""
        return _points(at, self.pattern.corners)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixels (N, K, 2) of points (N, K, 3) [m] in the camera's frame."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return points[..., :2] / points[..., 2:] * np.array(self.focal) + np.array(self.centre)

    def locate(self, pixels: np.ndarray, start: Poses, *, turns: bool = True) -> Poses:
        """Return the pattern's poses in the camera's frame from corners (N, K, 2) [px] by Gauss-Newton.

        A pattern seen squarely from afar has a second, mirrored pose that fits almost as well; `start` decides.
        Without `turns` the orientation stays.

        Raises:
            InputError: The corners do not determine the pose.
        """
        position, rotation = start.position.copy(), start.rotation.copy()
        for _ in range(_STEPS):
            here = Poses(position, rotation)
            gap = (pixels - self.project(self.place_corners(here))).reshape(len(pixels), -1, 1)
            slope = self.compute_slope(here)[:, :, : 6 if turns else 3]
            turned = np.swapaxes(slope, 1, 2)
            try:
                step = np.linalg.solve(turned @ slope, turned @ gap)[:, :, 0]
            except np.linalg.LinAlgError:
                raise InputError(
                    "unsupported",
                    "the corners in the pictures do not determine the pattern's pose; check size, focal length and distance",
                ) from None
            position = position + step[:, :3]
            if turns:
                rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            if np.abs(step).max(initial=0.0) < _AT_REST:
                break
        return Poses(position, rotation)

    def compute_slope(self, at: Poses) -> np.ndarray:
        """Return the corners' derivative by the pattern's twist (N, 2 K, 6)."""
        points = self.place_corners(at)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        by_point = np.zeros((*points.shape[:2], 2, 3))
        by_point[..., 0, 0], by_point[..., 0, 2] = self.focal[0] / z, -self.focal[0] * x / z**2
        by_point[..., 1, 1], by_point[..., 1, 2] = self.focal[1] / z, -self.focal[1] * y / z**2
        arms = points - at.position[:, None]
        by_turn = np.cross(arms[:, :, None], by_point)  # u . (w x arm) = w . (arm x u)
        return np.concatenate([by_point, by_turn], axis=3).reshape(len(points), -1, 6)


@dataclass(frozen=True, eq=False)
class ToolCamera(Camera):
    """A camera on the tool and a stationary pattern.

    Attributes:
        pose: The pattern in the robot's base frame.
        on_tool: The camera in the tool frame.
    """

    @property
    def kind(self) -> str:
        """Kind of measurement: the pose of the stationary pattern in the camera's frame."""
        return "hand_eye"

    @property
    def frames(self) -> DeviceFrames:
        """The base in the pattern's frame, the camera on the tool."""
        return replace(super().frames, kinds=(self.kind,), lengths=(0.0,))

    def find_places(self, tool: Poses) -> np.ndarray:
        """Return where the camera is (N, 3) [m]."""
        return transform_to_base(self.frames, tool).position

    def see(self, tool: Poses) -> Poses:
        """Return the pattern in the camera's frame."""
        return invert_poses(super().see(tool))

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the pattern's middle and its four corners (N, 5, 3) [m], which are stationary."""
        corners = np.vstack([np.zeros((1, 3)), self.pattern.outline]) @ self.pose.rotation.T + self.pose.translation
        return np.repeat(corners[None], len(tool.position), axis=0)


def build_camera_frame(place: np.ndarray, look_at: np.ndarray, up: np.ndarray) -> Frame:
    """Return the frame of a camera at a place that looks at a point, `up` upwards in the picture.

    Raises:
        InputError: The camera looks along `up`, or at its own place.
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
    """Return a target's frame: z along `normal`, `up` against its y (so that it is upright in a picture).

    Raises:
        InputError: `normal` has no length or is parallel to `up`.
    """
    frame = build_camera_frame(place, place - normal, up)
    return Frame(frame.rotation @ np.diag([1.0, -1.0, -1.0]), place)


def _points(at: Poses, local: np.ndarray) -> np.ndarray:
    return at.position[:, None] + np.einsum("nij,kj->nki", at.rotation, local)


UP = (0.0, 0.0, 1.0)


def read_camera(path: str | Path) -> Camera:
    """Read a camera and its pattern: a `ToolCamera` if the camera is on the tool.

    Raises:
        InputError: Something is missing or no number; the message names the place.
    """
    root = FilePart(read_yaml(path), str(path), {"camera", "pattern", "limits", "choose"})
    camera = root.part("camera", {"mount", "position", "look_at", "up", "image", "focal", "centre", "noise"})
    mount = camera.content.get("mount", "base")
    if mount not in ("base", "tool"):
        camera.fault(f"mount must be base or tool, not {mount}")
    if mount == "tool" and "choose" in root.content:
        root.fault("`choose` places a fixed camera; leave it out for a camera on the tool")
    pattern = root.part("pattern", {"columns", "rows", "square", "border", "position", "normal", "up"})
    limits = root.part("limits", {"distance", "incidence", "margin"}, needed=False)
    image = camera.numbers("image", 2, low=1)
    focal = camera.numbers("focal", 2, low=1e-6, alone=True)
    centre = camera.numbers("centre", 2, default=tuple((image - 1) / 2))
    pose = camera.framed(build_camera_frame, "look_at")
    target = pattern.framed(build_target_frame, "normal")
    up = camera.numbers("up", 3, default=UP)
    make, at_base, on_tool = (ToolCamera, target, pose) if mount == "tool" else (Camera, pose, target)
    return make(
        pose=at_base,
        on_tool=on_tool,
        pattern=CameraPattern(
            int(pattern.whole("columns", 8)),
            int(pattern.whole("rows", 6)),
            pattern.number("square", 0.04, low=1e-6),
            pattern.number("border", 0.0, low=0.0),
        ),
        focal=(float(focal[0]), float(focal[1])),
        image=(int(image[0]), int(image[1])),
        centre=(float(centre[0]), float(centre[1])),
        pixel_noise=camera.number("noise", 0.2, low=1e-9),
        distance=limits.pair("distance", (0.3, 10.0)),
        incidence=np.deg2rad(limits.number("incidence", 60.0, low=1e-3, high=90.0)),
        margin=limits.number("margin", 5.0, low=0.0),
        up=(float(up[0]), float(up[1]), float(up[2])),
        places=_read_places(root, pose.translation),
    )


def _read_places(root: FilePart, place: np.ndarray) -> np.ndarray | None:
    """Return the permitted range of the camera's place (3, 2) [m], None if neither place nor direction is to be chosen."""
    if "choose" not in root.content:
        return None
    if root.content["choose"] == "direction":
        return np.column_stack([place, place])
    if not isinstance(root.content["choose"], Mapping):
        root.fault(
            "choose must be `direction`, or hold the ranges of x, y and z in which the camera may be, such as "
            f"{{position: [[3, 7], [-2, 1], [0.2, 2]]}}, not {root.content['choose']}"
        )
    ranges = root.part("choose", {"position"})
    return np.array(ranges.ranges("position", 3))


def format_camera_file(path: str | Path, position: np.ndarray, look_at: np.ndarray | None) -> str:
    """Return a camera's file with another place and direction, and without the key `choose`.

    Args:
        path: File with all other values.
        position: The camera's place (3,) [m].
        look_at: Point (3,) [m] at which it looks; None if place and direction stay.
    """
    content: Any = {key: value for key, value in read_yaml(path).items() if key != "choose"}
    if look_at is not None:
        content["camera"] = {**content["camera"], "position": position.tolist(), "look_at": look_at.tolist()}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)


def read_tracker(path: str | Path) -> Tracker:
    """Read a laser tracker and its reflector.

    Raises:
        InputError: Something is missing or no number; the message names the place.
    """
    root = FilePart(read_yaml(path), str(path), {"tracker", "reflector", "limits"})
    tracker = root.part("tracker", {"position", "noise", "noise_per_metre"})
    reflector = root.part("reflector", {"position", "normal", "up", "orientation_noise"})
    limits = root.part("limits", {"distance", "incidence", "elevation"}, needed=False)
    low, high = limits.pair("elevation", (-45.0, 45.0))
    turn = reflector.number("orientation_noise", 0.0, low=0.0)
    return Tracker(
        pose=Frame(np.eye(3), tracker.numbers("position", 3)),
        on_tool=reflector.framed(build_target_frame, "normal"),
        along=tracker.number("noise", 10e-6, low=1e-12),
        across=tracker.number("noise_per_metre", 5e-6, low=1e-12),
        turn=turn if turn > 0 else None,
        distance=limits.pair("distance", (0.5, 30.0)),
        incidence=np.deg2rad(limits.number("incidence", 30.0, low=1e-3, high=90.0)),
        elevation=(float(np.deg2rad(low)), float(np.deg2rad(high))),
    )


class FilePart:
    """A mapping of a YAML file; every fault names it.

    Args:
        content: Content of the file there.
        where: Start of the messages.
        known: Permitted keys.
    """

    def __init__(self, content: Any, where: str, known: set[str]) -> None:
        """Refuse content that is no mapping, or has other keys."""
        self.where = where
        if not isinstance(content, Mapping):
            self.fault(f"needs {', '.join(sorted(known))}")
        unknown = [k for k in content if k not in known]
        if unknown:
            self.fault(f"'{unknown[0]}' is not known here; there are {', '.join(sorted(known))}")
        self.content = content

    def fault(self, text: str) -> NoReturn:
        """Raise with the place of the fault."""
        raise InputError("file_format", f"{self.where}: {text}")

    def part(self, key: str, known: set[str], *, needed: bool = True) -> FilePart:
        """Return a mapping in this one, an empty one if it is missing and not needed."""
        if needed and key not in self.content:
            self.fault(f"'{key}' is missing")
        return FilePart(self.content.get(key, {}), f"{self.where}: {key}", known)

    def numbers(
        self, key: str, n: int, *, default: tuple[float, ...] | None = None, low: float = -np.inf, alone: bool = False
    ) -> np.ndarray:
        """Return `n` finite numbers; with `alone`, a single number counts for all."""
        value: Any = self.content.get(key, None if default is None else list(default))
        if value is None:
            self.fault(f"'{key}' is missing")
        value = [value] * n if alone and _is_number(value) else value
        if not isinstance(value, list) or len(value) != n or not all(_is_number(v) and float(v) >= low for v in value):
            least = f" from {low:g} up" if np.isfinite(low) else ""
            self.fault(f"{key} must hold {n} finite numbers{least}, not {value}")
        return np.array([float(v) for v in value])

    def number(self, key: str, default: float, *, low: float = -np.inf, high: float = 1e9) -> float:
        """Return a number within limits."""
        value: Any = self.content.get(key, default)
        if not _is_number(value) or not low <= float(value) <= high:
            self.fault(f"{key} must be a number from {low:g} to {high:g}, not {value}")
        return float(value)

    def whole(self, key: str, default: int) -> int:
        """Return a number of corners."""
        value = self.number(key, default, low=2, high=1000)
        if value != int(value):
            self.fault(f"{key} must be a whole number of corners, not {value:g}")
        return int(value)

    def pair(self, key: str, default: tuple[float, float]) -> tuple[float, float]:
        """Return a lower and an upper limit."""
        low, high = self.numbers(key, 2, default=default)
        if not low < high:
            self.fault(f"{key} is inverted: {low:g} is not below {high:g}")
        return float(low), float(high)

    def ranges(self, key: str, n: int) -> list[tuple[float, float]]:
        """Return `n` pairs of a lower and an upper limit, which may be equal."""
        value: Any = self.content.get(key)
        if not isinstance(value, list) or len(value) != n:
            self.fault(f"{key} must hold {n} ranges, each a lower and an upper limit, not {value}")
        pairs = [FilePart({key: pair}, self.where, {key}).numbers(key, 2) for pair in value]
        for low, high in pairs:
            if low > high:
                self.fault(f"{key} has an empty range: {low:g} is above {high:g}")
        return [(float(low), float(high)) for low, high in pairs]

    def framed(self, make: Any, towards: str) -> Frame:
        """Return the frame that a function makes of a position, a direction and `up`."""
        place = self.numbers("position", 3)
        try:
            return make(place, self.numbers(towards, 3), self.numbers("up", 3, default=UP))
        except InputError as fault:
            if str(fault).startswith(self.where):
                raise
            self.fault(
                f"{towards} gives no direction: it must differ from position (or zero) and must not lie along up"
            )


def _is_number(value: Any) -> bool:
    if isinstance(value, str):  # YAML reads 10e-6 as text
        try:
            value = float(value)
        except ValueError:
            return False
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(abs(value) < 1e9)
