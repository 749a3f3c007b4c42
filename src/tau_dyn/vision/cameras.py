"""Cameras of one scene: pinhole and lens of each (Brown 1966), poses and covariance; stored as YAML.

    x = X / Z,  y = Y / Z,  r^2 = x^2 + y^2,  g = 1 + k1 r^2 + k2 r^4 + k3 r^6
    x' = x g + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y g + p1 (r^2 + 2 y^2) + 2 p2 x y
    u = fx x' + cx,   v = fy y' + cy

The centre of the first pixel is (0, 0); z points out of the camera, y down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml, write_whole

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Names of a camera's nine intrinsics; the first four in pixels."""

LENSES = {"none": 4, "radial": 6, "brown": 8, "brown3": 9}
"""Lens models, and the number of intrinsics that are free in each."""


def project(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return pixels (..., 2) of points (..., 3) in the camera's frame [m]; `intrinsics` (..., 9) broadcast."""
    k = np.moveaxis(np.asarray(intrinsics, float), -1, 0)
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    xd, yd = apply_distortion(x, y, k)
    return np.stack([k[0] * xd + k[2], k[1] * yd + k[3]], axis=-1)


def apply_distortion(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distorted positions of ideal image points; `k` holds the nine intrinsics on its first axis."""
    r2 = x * x + y * y
    g = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    return x * g + 2 * k[6] * x * y + k[7] * (r2 + 2 * x * x), y * g + k[6] * (r2 + 2 * y * y) + 2 * k[7] * x * y


def compute_rays(pixels: np.ndarray, intrinsics: np.ndarray, iterations: int = 15) -> np.ndarray:
    """Return the ideal image points `x y` (..., 2) of pixels (..., 2), by fixed-point iteration; nan if it diverges."""
    k = np.asarray(intrinsics, float)
    target = (pixels - k[2:4]) / k[0:2]
    at = target.copy()
    with np.errstate(all="ignore"):
        for _ in range(iterations):
            at = at + target - np.stack(apply_distortion(at[..., 0], at[..., 1], k), axis=-1)
        off = np.abs(target - np.stack(apply_distortion(at[..., 0], at[..., 1], k), axis=-1)).max(axis=-1)
    return np.where((off < 1e-6)[..., None], at, np.nan)


def project_with_jacobians(points: np.ndarray, intrinsics: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (..., 2), their derivatives by the point (..., 2, 3) and by the nine intrinsics (..., 2, 9)."""
    k = np.moveaxis(np.asarray(intrinsics, float), -1, 0)
    x, y, z = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2], points[..., 2]
    xd, yd = apply_distortion(x, y, k)
    by_image = _by_image(x, y, k)
    by_point = np.empty((*points.shape[:-1], 2, 3))
    by_point[..., :, :2] = by_image / z[..., None, None]
    by_point[..., :, 2] = -(by_image @ np.stack([x, y], axis=-1)[..., None])[..., 0] / z[..., None]
    pixels = np.stack([k[0] * xd + k[2], k[1] * yd + k[3]], axis=-1)
    return pixels, by_point, _by_intrinsics(x, y, xd, yd, k)


def _by_image(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> np.ndarray:
    r2 = x * x + y * y
    g = 1 + r2 * (k[4] + r2 * (k[5] + r2 * k[8]))
    slope = 2 * (k[4] + r2 * (2 * k[5] + 3 * k[8] * r2))  # dg/dx = slope x
    cross = slope * x * y + 2 * k[6] * x + 2 * k[7] * y
    out = np.empty((*x.shape, 2, 2))
    out[..., 0, 0] = k[0] * (g + slope * x * x + 2 * k[6] * y + 6 * k[7] * x)
    out[..., 0, 1] = k[0] * cross
    out[..., 1, 0] = k[1] * cross
    out[..., 1, 1] = k[1] * (g + slope * y * y + 6 * k[6] * y + 2 * k[7] * x)
    return out


def _by_intrinsics(x: np.ndarray, y: np.ndarray, xd: np.ndarray, yd: np.ndarray, k: np.ndarray) -> np.ndarray:
    r2 = x * x + y * y
    out = np.zeros((*x.shape, 2, 9))
    out[..., 0, 0], out[..., 1, 1] = xd, yd
    out[..., 0, 2] = out[..., 1, 3] = 1.0
    for column, power in ((4, r2), (5, r2**2), (8, r2**3)):
        out[..., 0, column], out[..., 1, column] = k[0] * x * power, k[1] * y * power
    out[..., 0, 6], out[..., 1, 6] = k[0] * 2 * x * y, k[1] * (r2 + 2 * y * y)
    out[..., 0, 7], out[..., 1, 7] = k[0] * (r2 + 2 * x * x), k[1] * 2 * x * y
    return out


PLACE = ("rx", "ry", "rz", "x", "y", "z")
"""Names of a camera's six pose parameters: a small rotation about the first camera's axes [rad], then a translation [m]."""


@dataclass(frozen=True, eq=False)
class Cameras:
    """One or more cameras; a point `X` in the first camera's frame is `rotation[c] X + position[c]` in camera c's.

    Attributes:
        intrinsics: Intrinsics (c, 9), in the order of `INTRINSICS`.
        rotation: Rotations (c, 3, 3); the first is the identity.
        position: Positions (c, 3) [m]; the first is zero.
        size: Width and height of each camera's images (c, 2) [px].
        lens: Lens model, a name in `LENSES`.
        covariance: Covariance of `names` (p, p); zero for parameters that were taken as known.
        noise: Standard deviation of a corner in each camera's images (c,) [px]; nan if unknown.
    """

    intrinsics: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    size: np.ndarray
    lens: str = "brown"
    covariance: np.ndarray | None = None
    noise: np.ndarray | None = None

    @property
    def n(self) -> int:
        """Number of cameras."""
        return len(self.intrinsics)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters (p,): nine per camera, then six pose parameters for each except the first."""
        inner = [f"camera{c + 1}.{name}" for c in range(self.n) for name in INTRINSICS]
        return tuple(inner + [f"camera{c + 1}.{name}" for c in range(1, self.n) for name in PLACE])

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors of `names` (p,); nan if they are unknown."""
        return (
            np.full(len(self.names), np.nan) if self.covariance is None else np.sqrt(np.diag(self.covariance).clip(0))
        )

    def free(self) -> np.ndarray:
        """Return the mask of `names` that are free in the lens model (p,)."""
        inner = np.tile(np.arange(9) < LENSES[self.lens], self.n)
        return np.concatenate([inner, np.ones(6 * (self.n - 1), bool)])

    def moved(self, step: np.ndarray) -> Cameras:
        """Return the cameras after a step (p,) in `names`; rotations are updated on their manifold."""
        inner, place = step[: 9 * self.n].reshape(-1, 9), step[9 * self.n :].reshape(-1, 6)
        rotation, position = self.rotation.copy(), self.position.copy()
        if self.n > 1:
            rotation[1:] = Rotation.from_rotvec(place[:, :3]).as_matrix() @ rotation[1:]
            position[1:] = position[1:] + place[:, 3:]
        return replace(self, intrinsics=self.intrinsics + inner, rotation=rotation, position=position)

    def minus(self, other: Cameras) -> np.ndarray:
        """Return the step (p,) from other cameras to these."""
        turned = (
            Rotation.from_matrix(self.rotation[1:] @ np.swapaxes(other.rotation[1:], 1, 2)).as_rotvec()
            if self.n > 1
            else np.zeros((0, 3))
        )
        place = np.hstack([turned, self.position[1:] - other.position[1:]])
        return np.concatenate([(self.intrinsics - other.intrinsics).ravel(), place.ravel()])

    def to_dict(self) -> dict[str, Any]:
        """Return values and standard errors, camera by camera."""
        stderr = dict(zip(self.names, self.stderr, strict=True))
        out = []
        for c in range(self.n):
            row: dict = {
                name: {"value": float(v), "stderr": float(stderr[f"camera{c + 1}.{name}"])}
                for name, v in zip(INTRINSICS, self.intrinsics[c], strict=True)
            }
            row["size"] = [int(s) for s in self.size[c]]
            row["noise_px"] = None if self.noise is None else float(self.noise[c])
            if c:
                row["rotation"] = Rotation.from_matrix(self.rotation[c]).as_quat(canonical=True).tolist()
                row["position"] = self.position[c].tolist()
            out.append(row)
        return {"lens": self.lens, "cameras": out}


def check_lens(lens: str) -> None:
    """Reject a lens model that does not exist."""
    if not isinstance(lens, str) or lens not in LENSES:
        raise UnknownName("lens model", str(lens), LENSES)


def write_cameras(path: str | Path, cameras: Cameras) -> None:
    """Write cameras as YAML, atomically."""
    write_whole(path, format_cameras_text(cameras))


def format_cameras_text(cameras: Cameras) -> str:
    """Return cameras as YAML text."""
    rows = []
    for c in range(cameras.n):
        row = {"size": [int(s) for s in cameras.size[c]]}
        row |= {name: float(v) for name, v in zip(INTRINSICS, cameras.intrinsics[c], strict=True)}
        if c:
            row["quaternion"] = Rotation.from_matrix(cameras.rotation[c]).as_quat(canonical=True).tolist()
            row["position"] = cameras.position[c].tolist()
        rows.append(row)
    held: dict = {"format": "tau_dyn cameras 1", "lens": cameras.lens, "cameras": rows}
    if cameras.covariance is not None:
        held["covariance"] = cameras.covariance.tolist()
    return yaml.safe_dump(held, sort_keys=False, width=1000)


def read_cameras(path: str | Path) -> Cameras:
    """Read cameras from YAML as written by `write_cameras`; without covariance they are taken as exact.

    Raises:
        InputError: Keys are missing, or values do not describe a camera.
    """
    held = read_yaml(path)
    try:
        rows = held.get("cameras") if isinstance(held, dict) else None
        if not rows or not isinstance(rows, list):
            raise ValueError("no list of cameras in it")
        inner = np.array(
            [
                [_number(row.get(name, 0.0) if name in INTRINSICS[4:] else row[name]) for name in INTRINSICS]
                for row in rows
            ]
        )
        size = np.array([[int(s) for s in row["size"]] for row in rows]).reshape(len(rows), 2)
        turned = np.array([[0.0, 0.0, 0.0, 1.0], *([_number(v) for v in row["quaternion"]] for row in rows[1:])])
        position = np.array([[0.0, 0.0, 0.0], *([_number(v) for v in row["position"]] for row in rows[1:])])
        lens = held.get("lens", "brown3")
        cameras = Cameras(inner, Rotation.from_quat(turned).as_matrix(), position, size, lens)
        covariance = (
            np.array([[_number(v) for v in row] for row in held["covariance"]])
            if "covariance" in held
            else np.zeros((len(cameras.names),) * 2)
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as fault:
        raise InputError(
            "file_format",
            f"{path}: not a cameras file ({' '.join(str(fault).split())}); it needs `cameras`, each with size, fx, fy, "
            "cx, cy and, after the first, quaternion and position",
        ) from fault
    check_lens(lens)
    if not np.all(inner[:, :2] > 0) or np.any(size < 1):
        raise InputError("file_format", f"{path}: focal lengths and image sizes must be positive")
    if covariance.shape != (len(cameras.names),) * 2 or np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[
        0
    ] < -1e-9 * np.trace(covariance).clip(1e-300):
        raise InputError(
            "wrong_shape",
            f"{path}: the covariance must be a positive matrix of {len(cameras.names)} by {len(cameras.names)} numbers",
        )
    return replace(cameras, covariance=covariance)


def _number(value: object) -> float:
    number = float(value)  # type: ignore[arg-type]
    if not np.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number
