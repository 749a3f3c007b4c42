"""Where the measuring device stands and where its target sits on the tool: what turns a robot's tool pose into a measurement.

    R_m = R_D R R_T,    p_m = p_D + R_D (p + R p_T),

with `(R_D, p_D)` the robot's base in the device's frame (X_DB) and `(R_T, p_T)` the target in the tool frame (thesis (5.3)).
Rotations change on their manifold: `R_D <- Exp(d) R_D`, `R_T <- R_T Exp(d)`. Campaigns may each have frames of their own. A fit
starts from frames that the nominal robot's poses give in closed form (Umeyama 1991).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses
from tau_dyn.parameters import Parameter

AXES = ("x", "y", "z", "rx", "ry", "rz")


class Frame(NamedTuple):
    """A placement: rotation (3, 3) and translation (3,) [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    @property
    def inverse(self) -> Frame:
        """The placement the other way round."""
        return Frame(self.rotation.T, -self.rotation.T @ self.translation)


IDENTITY = Frame(np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class DeviceFrames:
    """Device and target: one of each, a device for every campaign, a target for every campaign or for every target.

    Methods take which of them each pose has: `setup` (N, 2), or (N,) where both are numbered alike.

    Attributes:
        device: The robot's base frame in the device's.
        tool: The target in the tool frame.
    """

    device: tuple[Frame, ...] = (IDENTITY,)
    tool: tuple[Frame, ...] = (IDENTITY,)

    def measured(self, base: Poses, setup: np.ndarray) -> Poses:
        """Return what the device sees (N) of tool poses in the robot's base frame."""
        rd, td, rt, tt = self.of_each(setup)
        position = base.position + np.einsum("nij,nj->ni", base.rotation, tt)
        return Poses(td + np.einsum("nij,nj->ni", rd, position), rd @ base.rotation @ rt)

    def in_base(self, measured: Poses, setup: np.ndarray) -> Poses:
        """Return tool poses in the robot's base frame (N) from what the device saw; needs orientation."""
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
        """Return twists of the tool in the base's axes (N, 6, p) from twists of the target in the device's: `carried` undone."""
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
        return _spread(one, first, len(self.device)), _spread(two, second, len(self.tool))

    def moved(self, device: np.ndarray, tool: np.ndarray) -> DeviceFrames:
        """Return the frames after steps (6 nd,) and (6 nt,): translations, then rotation vectors."""
        d = tuple(
            Frame(_exp(step[3:]) @ f.rotation, f.translation + step[:3])
            for f, step in zip(self.device, device.reshape(-1, 6), strict=True)
        )
        t = tuple(
            Frame(f.rotation @ _exp(step[3:]), f.translation + step[:3])
            for f, step in zip(self.tool, tool.reshape(-1, 6), strict=True)
        )
        return DeviceFrames(d, t)

    def apart(self, devices: int, tools: int) -> DeviceFrames:
        """Return as many frames; where there was one, it stands for all."""
        device = self.device if len(self.device) == devices else self.device[:1] * devices
        return replace(self, device=device, tool=self.tool if len(self.tool) == tools else self.tool[:1] * tools)

    def parameters(self) -> list[Parameter]:
        """Return `device.x` .. `device.rz`, `tool.x` .. at their values; rotations as rotation vectors."""
        rows = []
        for owner, frames in (("device", self.device), ("tool", self.tool)):
            for k, frame in enumerate(frames):
                label = owner if k == 0 else f"{owner}_{k + 1}"
                vector = Rotation.from_matrix(frame.rotation).as_rotvec()
                values = [*frame.translation, *vector]
                units = ["m"] * 3 + ["rad"] * 3
                rows += [Parameter(f"{label}.{a}", float(v), u) for a, v, u in zip(AXES, values, units, strict=True)]
        return rows

    def of_each(self, setup: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return rotation (N, 3, 3) and translation (N, 3) of each pose's device, then of its target."""

        def pick(frames: tuple[Frame, ...], index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            index = np.minimum(index, len(frames) - 1)
            return np.array([f.rotation for f in frames])[index], np.array([f.translation for f in frames])[index]

        device, tool = split_setup(setup)
        return *pick(self.device, device), *pick(self.tool, tool)


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
"""Thickness of a cloud of positions, relative to its extent, below which it is a plane."""

_ALTERNATIONS = 20
"""Fits of the device's frame and of the targets' places in turn; what is left to go shrinks by half or more each."""
_MIRROR_GAIN = 5.0
"""By how much better a mirrored device frame must fit before it is called wrong-handed."""


def estimate_initial_frames(poses: PoseSet, nominal: Predicted) -> DeviceFrames:
    """Return the device's frame in which the nominal robot's tool comes nearest to the measured poses.

    Raises:
        InputError: The nominal robot reaches too few of the poses, or a mirrored frame fits far better.
    """
    ok = nominal.ok
    if ok.sum() < 3:
        k = int(np.argmin(ok))
        raise InputError(
            "wrong_unit",
            f"{poses.source}: the nominal robot reaches {int(ok.sum())} of {poses.n} poses "
            f"({poses.names[k]}: {nominal.reason[k]}); "
            "are the joints' columns in the right order and in m or rad?",
        )
    seen, known = poses.position[ok], nominal.poses.position[ok]
    flat = is_flat(known)
    if poses.rotation is not None and flat:
        return _from_orientation(poses, nominal)
    device = (
        align_with_targets(poses.take(ok), nominal.poses.take(ok))[0] if len(poses.targets) > 1 else align(seen, known)
    )
    if not flat:
        _check_hand(poses.source, seen, known, device)
    if poses.rotation is None:
        return DeviceFrames((device,), (IDENTITY,) * len(poses.targets))
    back = np.swapaxes(device.rotation @ nominal.poses.rotation[ok], 1, 2) @ poses.rotation[ok]
    return DeviceFrames(
        (device,), tuple(Frame(_mean_of(back[poses.target[ok] == k]), np.zeros(3)) for k in _each(poses))
    )


_NEAREST = 1e-3
"""Weight of the common orientation in a campaign's own, relative to its poses: it decides what poses in a line leave open."""


def estimate_campaign_frames(
    poses: PoseSet, base: Poses, ok: np.ndarray, frames: DeviceFrames, *, turned: bool, tool: bool
) -> DeviceFrames:
    """Return frames with the device of each campaign at its own poses, where they fit better so than the given ones.

    Orientations give the rotations by themselves, so that a campaign that turns one joint is placed by the target of the others.

    Args:
        poses: Measured poses (N), several campaigns.
        base: Tool poses (N) in the robot's base frame.
        ok: Whether they are known (N,).
        frames: A device for every campaign, and targets.
        turned: Whether measured orientations count.
        tool: Whether the targets are unknown.
    """
    some, known = poses.take(ok), base.take(ok)
    found = _turn_frames(some, known, frames, tool=tool) if turned else frames
    for _ in range(1 if turned else _ALTERNATIONS):
        found = _shift_frames(some, known, found, tool=tool)
        if not turned:
            found = _align_devices(some, known, found)

    def miss(one: DeviceFrames) -> float:
        return float(np.sum((some.position - one.measured(known, some.setup).position) ** 2))

    return found if miss(found) < miss(frames) else frames


def _turn_frames(poses: PoseSet, base: Poses, frames: DeviceFrames, *, tool: bool) -> DeviceFrames:
    """Return frames with the rotations that measured orientations `R_m = R_D R R_T` ask for: the better of two starts.

    One start keeps the given targets. The other solves `R_D' R_m = R R_T` as linear equations of all entries (Shah 2013).
    """
    assert poses.rotation is not None
    starts = [frames, _solve_rotations(poses, base, frames)] if tool else [frames]
    found = [_alternate_rotations(poses, base, start, tool=tool) for start in starts]

    def miss(one: DeviceFrames) -> float:
        return float(np.sum((poses.rotation - one.measured(base, poses.setup).rotation) ** 2))

    return min(found, key=miss)


def _solve_rotations(poses: PoseSet, base: Poses, frames: DeviceFrames) -> DeviceFrames:
    """Return frames with the rotations of the smallest singular vector of the linear equations, each nearest to its block."""
    assert poses.rotation is not None
    n_device, n_frames = len(frames.device), len(frames.device) + len(frames.tool)
    rows = np.zeros((poses.n, 9, n_frames, 9))
    device, tool = (
        np.minimum(x, n - 1) for x, n in zip(split_setup(poses.setup), (n_device, len(frames.tool)), strict=True)
    )
    number, eye = np.arange(poses.n), np.eye(3)
    # row-major entries: (X R)_ij = sum_k X_ik R_kj and (R Y)_ij = sum_k R_ik Y_kj
    rows[number, :, device] = np.einsum("ia,nbj->nijab", eye, poses.rotation).reshape(-1, 9, 9)
    rows[number, :, n_device + tool] = -np.einsum("nia,jb->nijab", base.rotation, eye).reshape(-1, 9, 9)
    flat = rows.reshape(-1, 9 * n_frames)
    blocks = np.linalg.eigh(flat.T @ flat)[1][:, 0].reshape(n_frames, 3, 3)
    turns = [compute_mean_rotation(x[None] * np.sign(np.linalg.det(blocks[0]))) for x in blocks]
    return DeviceFrames(
        tuple(f._replace(rotation=x.T) for f, x in zip(frames.device, turns[:n_device], strict=True)),
        tuple(f._replace(rotation=x) for f, x in zip(frames.tool, turns[n_device:], strict=True)),
    )


def _alternate_rotations(poses: PoseSet, base: Poses, frames: DeviceFrames, *, tool: bool) -> DeviceFrames:
    """Return frames with rotations of devices and targets fitted in turn."""
    assert poses.rotation is not None
    for _ in range(_ALTERNATIONS):
        rd, _, rt, _ = frames.of_each(poses.setup)
        rd = poses.rotation @ np.swapaxes(base.rotation @ rt, 1, 2)
        frames = replace(frames, device=_average(rd, split_setup(poses.setup)[0], frames.device))
        if tool:
            rd = frames.of_each(poses.setup)[0]
            rt = np.swapaxes(rd @ base.rotation, 1, 2) @ poses.rotation
            frames = replace(frames, tool=_average(rt, split_setup(poses.setup)[1], frames.tool))
    return frames


def _average(rotations: np.ndarray, number: np.ndarray, frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Return frames with the mean of their own rotations (N, 3, 3); those without any stay."""
    number = np.minimum(number, len(frames) - 1)
    return tuple(
        f._replace(rotation=compute_mean_rotation(rotations[number == k])) if np.any(number == k) else f
        for k, f in enumerate(frames)
    )


def _shift_frames(poses: PoseSet, base: Poses, frames: DeviceFrames, *, tool: bool) -> DeviceFrames:
    """Return frames with the translations of least squares, the shortest where the poses leave them open."""
    rd, _, _, tt = frames.of_each(poses.setup)
    n_device, n_tool = len(frames.device), len(frames.tool)
    device, target = split_setup(poses.setup)
    columns = np.zeros((poses.n, 3, n_device + n_tool, 3))
    columns[np.arange(poses.n), :, np.minimum(device, n_device - 1)] = np.eye(3)
    left = poses.position - np.einsum("nij,nj->ni", rd, base.position)
    if tool:
        columns[np.arange(poses.n), :, n_device + np.minimum(target, n_tool - 1)] = rd @ base.rotation
    else:
        left = left - np.einsum("nij,nj->ni", rd @ base.rotation, tt)
    places = np.linalg.lstsq(columns.reshape(3 * poses.n, -1), left.ravel(), rcond=1e-9)[0].reshape(-1, 3)
    found = tuple(f._replace(translation=x) for f, x in zip((*frames.device, *frames.tool), places, strict=True))
    return DeviceFrames(found[:n_device], found[n_device:] if tool else frames.tool)


def _align_devices(poses: PoseSet, base: Poses, frames: DeviceFrames) -> DeviceFrames:
    """Return frames with each device aligned with its own positions, those with fewer than three left."""
    seen, device = frames.measured(base, poses.setup), list(frames.device)
    for k, old in enumerate(device):
        own = poses.campaign == k
        if own.sum() >= 3:
            known = (seen.position[own] - old.translation) @ old.rotation
            device[k] = _align_near(poses.position[own], known, old.rotation)
    return replace(frames, device=tuple(device))


def _align_near(seen: np.ndarray, known: np.ndarray, rotation: np.ndarray) -> Frame:
    """Return the frame that best takes `known` points (N, 3) to `seen` ones, near a rotation where they leave it open."""
    a, b = seen.mean(axis=0), known.mean(axis=0)
    u, s, vt = np.linalg.svd((seen - a).T @ (known - b))
    u, _, vt = np.linalg.svd((u * s) @ vt + _NEAREST * s[0] * rotation)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Frame(turn, a - turn @ b)


def _each(poses: PoseSet) -> range:
    """Return the targets' numbers."""
    return range(len(poses.targets))


def _mean_of(rotations: np.ndarray) -> np.ndarray:
    """Return the mean rotation (3, 3), none where there are no rotations."""
    return compute_mean_rotation(rotations) if len(rotations) else np.eye(3)


def align_with_targets(poses: PoseSet, nominal: Poses) -> tuple[Frame, np.ndarray]:
    """Return the device's frame and the targets' places on the tool (targets, 3) [m], fitted in turn."""
    place = np.zeros((len(poses.targets), 3))
    turned = nominal.rotation
    frame = align(poses.position, nominal.position)
    for _ in range(_ALTERNATIONS):
        for k in _each(poses):
            own = poses.target == k
            if own.any():
                left = poses.position[own] - frame.translation - nominal.position[own] @ frame.rotation.T
                rows = (frame.rotation @ turned[own]).reshape(-1, 3)
                place[k] = np.linalg.lstsq(rows, left.ravel(), rcond=None)[0]
        frame = align(poses.position, nominal.position + np.einsum("nij,nj->ni", turned, place[poses.target]))
    return frame, place


def _from_orientation(poses: PoseSet, nominal: Predicted) -> DeviceFrames:
    """Return frames from orientations where positions lie in a plane: the target taken as turned like the tool."""
    assert poses.rotation is not None
    ok = nominal.ok
    rotation = compute_mean_rotation(poses.rotation[ok] @ np.swapaxes(nominal.poses.rotation[ok], 1, 2))
    shift = poses.position[ok].mean(axis=0) - rotation @ nominal.poses.position[ok].mean(axis=0)
    return DeviceFrames((Frame(rotation, shift),), (IDENTITY,))


def _check_hand(source: str, seen: np.ndarray, known: np.ndarray, device: Frame) -> None:
    def left(frame: Frame) -> float:
        return float(np.sqrt(np.mean(np.sum((seen - frame.translation - known @ frame.rotation.T) ** 2, axis=1))))

    proper, mirrored = left(device), left(align(seen, known, mirrored=True))
    if proper > _MIRROR_GAIN * mirrored:
        raise InputError(
            "invalid_value",
            f"{source}: the measuring device's frame is left-handed: with one axis turned round the nominal robot is off by "
            f"{1e3 * mirrored:.3g} mm instead of {1e3 * proper:.3g} mm; change the sign of one of x_tool, y_tool, z_tool",
        )


def is_flat(points: np.ndarray) -> bool:
    """Tell whether points (N, 3) lie in a plane."""
    s = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(len(s) < 3 or s[2] < _FLAT * s[0])
