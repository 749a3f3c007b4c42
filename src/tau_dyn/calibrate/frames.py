"""Frames of the measuring device and of its target on the tool, which convert a robot's tool pose into a measurement.

    R_m = R_D R R_T,    p_m = p_D + R_D (p + R p_T),

with `(R_D, p_D)` the robot's base in the device's frame (X_DB) and `(R_T, p_T)` the target in the tool frame (thesis (5.3)).
Rotations change on their manifold: `R_D <- Exp(d) R_D`, `R_T <- R_T Exp(d)`. Each campaign may have its own frames.
A distance-measuring device, or a fixture that the target touches, has such a frame too; the part of it that the measurements do
not determine is fixed. An encoder of a passive joint has no frames: both are the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.measured import ENCODERS, KINDS, PoseSet, find_directions
from tau_dyn.mechanism import Poses
from tau_dyn.parameters import Parameter

AXES = ("x", "y", "z", "rx", "ry", "rz")


class Frame(NamedTuple):
    """A placement: rotation (3, 3) and translation (3,) [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    @property
    def inverse(self) -> Frame:
        """The inverse placement."""
        return Frame(self.rotation.T, -self.rotation.T @ self.translation)


IDENTITY = Frame(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class DeviceFrames:
    """Device and target: one of each, a device for every campaign, a target for every campaign or for every target.

    Methods take the device and the target of each pose: `setup` (N, 2), or (N,) if both have the same number.

    Attributes:
        device: The robot's base frame in the device's frame.
        tool: The target in the tool frame.
        kinds: Kind of measurement of each device, a name of `KINDS`; by default all poses.
        lengths: Offset of distances or radius of a ball of each device [m], zero of an encoder [rad or m]; zeros by default.
    """

    device: tuple[Frame, ...] = (IDENTITY,)
    tool: tuple[Frame, ...] = (IDENTITY,)
    kinds: tuple[str, ...] = ()
    lengths: tuple[float, ...] = ()

    def measured(self, base: Poses, setup: np.ndarray) -> Poses:
        """Return the measured target poses (N) from tool poses in the robot's base frame."""
        rd, td, rt, tt = self.of_each(setup)
        position = base.position + np.einsum("nij,nj->ni", base.rotation, tt)
        return Poses(td + np.einsum("nij,nj->ni", rd, position), rd @ base.rotation @ rt)

    def in_base(self, measured: Poses, setup: np.ndarray) -> Poses:
        """Return tool poses in the robot's base frame (N) from measured target poses; needs orientation."""
        rd, td, rt, tt = self.of_each(setup)
        back = np.swapaxes(rd, 1, 2)
        rotation = back @ measured.rotation @ np.swapaxes(rt, 1, 2)
        position = np.einsum("nij,nj->ni", back, measured.position - td)
        return Poses(position - np.einsum("nij,nj->ni", rotation, tt), rotation)

    def carried(self, base: Poses, twist: np.ndarray, setup: np.ndarray) -> np.ndarray:
        """Return twists of the target in the device's axes (N, 6, p) from twists of the tool (N, 6, p) in the base's."""
        rd, _, _, tt = self.of_each(setup)
        arm = np.einsum("nij,nj->ni", base.rotation, tt)
        linear, angular = twist[:, :3], twist[:, 3:]
        if np.any(tt):
            linear = linear + np.cross(angular, arm[:, :, None], axis=1)
        return np.concatenate([rd @ linear, rd @ angular], axis=1)

    def brought(self, base: Poses, twist: np.ndarray, setup: np.ndarray) -> np.ndarray:
        """Return twists of the tool in the base's axes (N, 6, p) from those of the target in the device's; undoes `carried`."""
        rd, _, _, tt = self.of_each(setup)
        back = np.swapaxes(rd, 1, 2)
        arm = np.einsum("nij,nj->ni", base.rotation, tt)
        linear, angular = back @ twist[:, :3], back @ twist[:, 3:]
        return np.concatenate([linear - np.cross(angular, arm[:, :, None], axis=1), angular], axis=1)

    def columns(self, base: Poses, measured: Poses, setup: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the target's twist (N, 6, 6 nd) per device parameter and (N, 6, 6 nt) per tool parameter."""
        n = len(setup)
        rd, td, _, _ = self.of_each(setup)
        one = np.zeros((n, 6, 6))
        one[:, :3, :3] = one[:, 3:, 3:] = np.eye(3)
        one[:, :3, 3:] = -_skew(measured.position - td)
        two = np.zeros((n, 6, 6))
        two[:, :3, :3] = rd @ base.rotation
        two[:, 3:, 3:] = measured.rotation
        first, second = split_setup(setup)
        two[self._of_encoders(first)] = 0.0
        return _spread(one, first, len(self.device)), _spread(two, second, len(self.tool))

    @property
    def with_length(self) -> tuple[int, ...]:
        """Which devices have an offset or a radius."""
        return tuple(k for k, kind in enumerate(self.kinds) if KINDS[kind].length)

    def lengths_of(self, setup: np.ndarray) -> np.ndarray:
        """Return the offset or the radius of each pose's device (N,) [m], or an encoder's zero [rad or m]."""
        if not self.lengths:
            return np.zeros(len(setup))
        return np.array(self.lengths)[np.minimum(split_setup(setup)[0], len(self.lengths) - 1)]

    def length_columns(self, poses: PoseSet, seen: np.ndarray) -> np.ndarray:
        """Return minus the residuals' derivative (N, 6, k) by each offset, radius or zero, at predicted positions (N, 3) [m]."""
        out = np.zeros((poses.n, 6, len(self.with_length)))
        if out.size:
            u, number = find_directions(poses.kinds, poses.device, seen), split_setup(poses.setup)[0]
            for column, k in enumerate(self.with_length):
                out[number == k, :3, column] = -KINDS[self.kinds[k]].sign * u[number == k]
            out *= poses.length_factors[:, None, None]
        return out

    def moved(self, device: np.ndarray, tool: np.ndarray, lengths: np.ndarray | None = None) -> DeviceFrames:
        """Return the frames after steps (6 nd,) and (6 nt,), translations, then rotation vectors; and of lengths (k,)."""
        d = tuple(
            Frame(_exp(step[3:]) @ f.rotation, f.translation + step[:3])
            for f, step in zip(self.device, device.reshape(-1, 6), strict=True)
        )
        t = tuple(
            Frame(f.rotation @ _exp(step[3:]), f.translation + step[:3])
            for f, step in zip(self.tool, tool.reshape(-1, 6), strict=True)
        )
        new = list(self.lengths)
        for k, change in zip(self.with_length, () if lengths is None else lengths, strict=lengths is not None):
            new[k] += float(change)
        return DeviceFrames(d, t, self.kinds, tuple(new))

    def apart(self, devices: int, tools: int) -> DeviceFrames:
        """Return frames for so many devices and targets; a single frame is repeated for all."""
        out = self if len(self.tool) == tools else replace(self, tool=self.tool[:1] * tools)
        if len(self.device) == devices:
            return out
        kinds, lengths = self.kinds[:1] * devices, self.lengths[:1] * devices
        return replace(out, device=self.device[:1] * devices, kinds=kinds, lengths=lengths)

    def first(self, n: int) -> DeviceFrames:
        """Return the frames of the first `n` devices."""
        return replace(self, device=self.device[:n], kinds=self.kinds[:n], lengths=self.lengths[:n])

    def parameters(self) -> list[Parameter]:
        """Return `device.x` .. `device.rz`, `tool.x` .., then lengths, at their values; rotations as rotation vectors."""
        rows = []
        for owner, frames in (("device", self.device), ("tool", self.tool)):
            for k, frame in enumerate(frames):
                label = owner if k == 0 else f"{owner}_{k + 1}"
                vector = Rotation.from_matrix(frame.rotation).as_rotvec()
                values = [*frame.translation, *vector]
                units = ["m"] * 3 + ["rad"] * 3
                rows += [Parameter(f"{label}.{a}", float(v), u) for a, v, u in zip(AXES, values, units, strict=True)]
        for k in self.with_length:
            label = "device" if k == 0 else f"device_{k + 1}"
            kind = KINDS[self.kinds[k]]
            rows.append(Parameter(f"{label}.{kind.length}", self.lengths[k], kind.unit))
        return rows

    def of_each(self, setup: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation (N, 3, 3) and translation (N, 3) of each pose's device, then of its target."""

        def pick(frames: tuple[Frame, ...], index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            index = np.minimum(index, len(frames) - 1)
            return np.array([f.rotation for f in frames])[index], np.array([f.translation for f in frames])[index]

        device, tool = split_setup(setup)
        rotation, translation = pick(self.tool, tool)
        encoders = self._of_encoders(device)
        rotation[encoders], translation[encoders] = np.eye(3), 0.0
        return *pick(self.device, device), rotation, translation

    def _of_encoders(self, device: np.ndarray) -> np.ndarray:
        """Return which poses (N,) an encoder measured, by their devices' numbers."""
        if not set(self.kinds) & set(ENCODERS):
            return np.zeros(len(device), bool)
        return np.array([kind in ENCODERS for kind in self.kinds])[np.minimum(device, len(self.kinds) - 1)]


def split_setup(setup: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the device's and the target's numbers (N,) of a set-up (N, 2) or (N,)."""
    return (setup[:, 0], setup[:, 1]) if setup.ndim == 2 else (setup, setup)


def align(seen: np.ndarray, known: np.ndarray, *, mirrored: bool = False) -> Frame:
    """Return the frame that best takes `known` points (N, 3) to `seen` ones (Umeyama 1991); `mirrored` asks for a reflection."""
    a, b = seen.mean(axis=0), known.mean(axis=0)
    u, _, vt = np.linalg.svd((seen - a).T @ (known - b))
    sign = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrored else 1.0)
    rotation = u @ np.diag([1.0, 1.0, sign]) @ vt
    return Frame(rotation, a - rotation @ b)


def compute_mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to many (N, 3, 3)."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def compute_rotation_between(to: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return rotation vectors (N, 3) [rad] in world axes that turn `start` into `to`, both (N, 3, 3)."""
    return Rotation.from_matrix(to @ np.swapaxes(start, 1, 2)).as_rotvec()


def _exp(vector: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vector).as_matrix()


def _skew(x: np.ndarray) -> np.ndarray:
    out = np.zeros((len(x), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -x[:, 2], x[:, 1], -x[:, 0]
    return out - np.swapaxes(out, 1, 2)


def _spread(columns: np.ndarray, campaign: np.ndarray, many: int) -> np.ndarray:
    if many == 1:
        return columns
    out = np.zeros((len(campaign), 6, 6 * many))
    for k in range(many):
        out[campaign == k, :, 6 * k : 6 * k + 6] = columns[campaign == k]
    return out


_FLAT = 1e-3
"""Thickness of a cloud of positions, relative to its extent, below which it counts as a plane."""


def is_flat(points: np.ndarray) -> bool:
    """Return whether points (N, 3) lie in a plane."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(s) < 3 or s[2] < _FLAT * s[0])
