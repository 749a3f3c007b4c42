"""A camera or a laser tracker read from YAML; lengths in m, angles in degrees, places in the robot's base frame.

A camera and its pattern (in the tool frame), and a tracker with its reflector (orientations only with `orientation_noise`):

camera: {position: [5.5, -0.6, 0.8], look_at: [1.7, -0.6, 0.7], image: [1280, 960], focal: 1400, noise: 0.2}
pattern: {columns: 8, rows: 6, square: 0.04, position: [0, 0, 0], normal: [1, 0, 0], up: [0, 0, 1]}
limits: {distance: [0.5, 6], incidence: 60, margin: 5}

tracker: {position: [5, -0.6, 1], noise: 10e-6, noise_per_metre: 5e-6}
reflector: {position: [0, 0, 0], normal: [1, 0, 0], orientation_noise: 50e-6}
limits: {distance: [0.5, 30], incidence: 30, elevation: [-45, 45]}
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from tau_dyn.calibrate.frames import Frame
from tau_dyn.calibrate.poses.camera import Camera, CameraPattern, build_camera_frame, build_target_frame
from tau_dyn.calibrate.poses.tracker import Tracker
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml

_UP = (0.0, 0.0, 1.0)


def read_camera(path: str | Path) -> Camera:
    """Read a camera and its pattern.

    Raises:
        InputError: Something is missing or no number; the message names the place.
    """
    root = _Part(read_yaml(path), str(path), {"camera", "pattern", "limits"})
    camera = root.part("camera", {"position", "look_at", "up", "image", "focal", "centre", "noise"})
    pattern = root.part("pattern", {"columns", "rows", "square", "border", "position", "normal", "up"})
    limits = root.part("limits", {"distance", "incidence", "margin"}, needed=False)
    image = camera.numbers("image", 2, low=1)
    focal = camera.numbers("focal", 2, low=1e-6, alone=True)
    centre = camera.numbers("centre", 2, default=tuple((image - 1) / 2))
    return Camera(
        pose=camera.framed(build_camera_frame, "look_at"),
        on_tool=pattern.framed(build_target_frame, "normal"),
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
    )


def read_tracker(path: str | Path) -> Tracker:
    """Read a laser tracker and its reflector.

    Raises:
        InputError: Something is missing or no number; the message names the place.
    """
    root = _Part(read_yaml(path), str(path), {"tracker", "reflector", "limits"})
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


class _Part:
    """A mapping of the file; every fault names it."""

    def __init__(self, content: Any, where: str, known: set[str]) -> None:
        self.where = where
        if not isinstance(content, Mapping):
            self.fault(f"needs {', '.join(sorted(known))}")
        unknown = [k for k in content if k not in known]
        if unknown:
            self.fault(f"'{unknown[0]}' is not known here; there are {', '.join(sorted(known))}")
        self.content = content

    def fault(self, text: str) -> NoReturn:
        raise InputError("file_format", f"{self.where}: {text}")

    def part(self, key: str, known: set[str], *, needed: bool = True) -> _Part:
        if needed and key not in self.content:
            self.fault(f"'{key}' is missing")
        return _Part(self.content.get(key, {}), f"{self.where}: {key}", known)

    def numbers(
        self, key: str, n: int, *, default: tuple[float, ...] | None = None, low: float = -np.inf, alone: bool = False
    ) -> np.ndarray:
        value: Any = self.content.get(key, None if default is None else list(default))
        if value is None:
            self.fault(f"'{key}' is missing")
        value = [value] * n if alone and _is_number(value) else value
        if not isinstance(value, list) or len(value) != n or not all(_is_number(v) and float(v) >= low for v in value):
            least = f" from {low:g} up" if np.isfinite(low) else ""
            self.fault(f"{key} must hold {n} finite numbers{least}, not {value}")
        return np.array([float(v) for v in value])

    def number(self, key: str, default: float, *, low: float = -np.inf, high: float = 1e9) -> float:
        value: Any = self.content.get(key, default)
        if not _is_number(value) or not low <= float(value) <= high:
            self.fault(f"{key} must be a number from {low:g} to {high:g}, not {value}")
        return float(value)

    def whole(self, key: str, default: int) -> int:
        value = self.number(key, default, low=2, high=1000)
        if value != int(value):
            self.fault(f"{key} must be a whole number of corners, not {value:g}")
        return int(value)

    def pair(self, key: str, default: tuple[float, float]) -> tuple[float, float]:
        low, high = self.numbers(key, 2, default=default)
        if not low < high:
            self.fault(f"{key} is inverted: {low:g} is not below {high:g}")
        return float(low), float(high)

    def framed(self, make: Any, towards: str) -> Frame:
        place = self.numbers("position", 3)
        try:
            return make(place, self.numbers(towards, 3), self.numbers("up", 3, default=_UP))
        except InputError as fault:
            if str(fault).startswith(self.where):
                raise
            self.fault(
                f"{towards} gives no direction: it must differ from position (or zero) and must not lie along up"
            )


def _is_number(value: Any) -> bool:
    if isinstance(value, str):  # YAML takes 10e-6 for text
        try:
            value = float(value)
        except ValueError:
            return False
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(abs(value) < 1e9)
