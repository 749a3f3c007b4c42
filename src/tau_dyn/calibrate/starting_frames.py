"""Frames from which a fit starts: those that the nominal robot's poses give in closed form.

Positions and orientations: Umeyama 1991; orientations of several campaigns: Shah 2013. Distances from a point, and a ball: the
differences of `|p + t|^2 = (d + c)^2` are linear in `t` and `c` (trilateration), and a few Gauss-Newton steps follow. A hole is
at the tool's mean position, a plane is the best one through the tool's positions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from tau_dyn.calibrate.frames import (
    IDENTITY,
    DeviceFrames,
    Frame,
    align,
    compute_mean_rotation,
    is_flat,
    split_setup,
)
from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.measured import ENCODERS, KINDS, PoseSet
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses

_ALTERNATIONS = 20
"""Number of alternating fits of the device's frame and of the targets' places; each halves the remaining change or more."""
_MAX_EVALUATIONS = 60
"""Evaluations for each unknown of a descent to a start; a smooth one takes about ten."""
_MAX_TARGET_M = 0.1
"""Distance of a target from the tool frame [m] that counts as much as one residual of a start: it determines directions that
the poses hardly determine, on a plate that hardly turns."""
_MIRROR_GAIN = 5.0
"""Factor by which a mirrored device frame must fit better before the device is reported as left-handed."""


def estimate_initial_frames(poses: PoseSet, nominal: Predicted, *, tool: bool = True) -> DeviceFrames:
    """Return the device's frame in which the nominal robot's tool is nearest to the measured poses.

    Args:
        poses: Measured poses.
        nominal: Tool poses of the nominal robot (N).
        tool: Whether the target may be anywhere on a tool that turns.

    Raises:
        InputError: The nominal robot reaches too few of the poses, or a mirrored frame fits far better.
    """
    poses, ok = poses.as_poses(), nominal.ok
    if ok.sum() < 3:
        k = int(np.argmin(ok))
        raise InputError(
            "wrong_unit",
            f"{poses.source}: the nominal robot reaches {int(ok.sum())} of {poses.n} poses "
            f"({poses.names[k]}: {nominal.reason[k]}); "
            "are the joints' columns in the right order and in m or rad?",
        )
    if poses.measures_poses and len(poses.devices) == 1:
        return _align_poses(poses, nominal)
    number = split_setup(poses.setup)[0]
    found = [_place_device(poses, nominal, ok & (number == k), kind) for k, kind in enumerate(poses.frame_kinds)]
    targets = [one.tool for one in found if len(one.tool) == len(poses.targets)]
    places = targets[0] if targets else (IDENTITY,) * len(poses.targets)
    lengths = tuple(one.lengths[0] if one.lengths else 0.0 for one in found)
    frames = DeviceFrames(tuple(one.device[0] for one in found), places, poses.frame_kinds, lengths)
    if poses.measures_poses:
        return frames
    some, base = poses.take(ok), nominal.poses.take(ok)
    starts = [frames, _place_points(some, base, frames)] if tool else [frames]
    settled = [_settle(some, base, start, tool=tool) for start in starts]
    return min(settled, key=lambda one: one[1])[0]


def place_alone(
    poses: PoseSet, known: Predicted, targets: tuple[Frame, ...], noise: float | None = None
) -> DeviceFrames:
    """Return the place of the one device of poses (N) at which its measurements best match known tool poses (N) and targets.

    Args:
        poses: Measurements of the device.
        known: Tool poses in the robot's base frame.
        targets: Placements of the targets on the tool.
        noise: Standard error of a measurement [m], beyond which a residual counts linearly; by default all residuals are squared.
    """
    position = known.poses.position + np.einsum(
        "nij,nj->ni", known.poses.rotation, DeviceFrames(tool=targets).of_each(poses.setup)[3]
    )
    at = known._replace(poses=Poses(position, known.poses.rotation))
    found = _place_device(poses, at, known.ok, poses.kinds[0])
    frames = DeviceFrames(found.device, targets, poses.kinds, found.lengths or (0.0,))
    return _settle(poses, known.poses, frames, tool=False, noise=noise)[0]


def _place_points(poses: PoseSet, base: Poses, frames: DeviceFrames) -> DeviceFrames:
    """Return frames with every hole and ball as a point that the target touches: `p + R p_T + t = 0` is linear."""
    number, target = split_setup(poses.setup)
    point = np.array([kind in ("hole", "sphere") for kind in poses.kinds])[poses.device]
    if not point.any():
        return frames
    rows = np.zeros((int(point.sum()), 3, len(frames.device) + len(frames.tool), 3))
    index, n = np.arange(len(rows)), len(frames.device)
    rows[index, :, number[point]] = np.eye(3)
    rows[index, :, n + target[point]] = base.rotation[point]
    x = np.linalg.lstsq(rows.reshape(3 * len(rows), -1), -base.position[point].ravel(), rcond=1e-9)[0].reshape(-1, 3)
    device = list(frames.device)
    for k in np.unique(number[point]):
        device[k] = Frame(np.eye(3), x[k])
    lengths = [0.0 if kind == "sphere" else size for kind, size in zip(frames.kinds, frames.lengths, strict=True)]
    tool = tuple(f._replace(translation=x[n + k]) for k, f in enumerate(frames.tool))
    return DeviceFrames(tuple(device), tool, frames.kinds, tuple(lengths))


def _settle(
    poses: PoseSet, base: Poses, frames: DeviceFrames, *, tool: bool, noise: float | None = None
) -> tuple[DeviceFrames, float]:
    """Return the frames after a descent at known tool poses, and the residual sum of squares [m^2].

    With a noise, residuals far beyond it count linearly (pseudo-Huber loss).
    """
    shown = [6 * k + axis for k, kind in enumerate(frames.kinds) for axis in KINDS[kind].axes]
    n, places = len(shown), [6 * k + axis for k in range(len(frames.tool) if tool else 0) for axis in range(3)]

    def move(x: np.ndarray) -> DeviceFrames:
        device, target = np.zeros(6 * len(frames.device)), np.zeros(6 * len(frames.tool))
        device[shown], target[places] = x[:n], x[n : n + len(places)]
        return frames.moved(device, target, x[n + len(places) :])

    def left(x: np.ndarray) -> np.ndarray:
        moved = move(x)
        seen = moved.measured(base, poses.setup)
        return poses.compute_position_residuals(seen, moved.lengths_of(poses.setup)).ravel()

    start = np.zeros(n + len(places) + len(frames.with_length))
    if not len(start) or poses.n * 3 < len(start):
        return frames, float(np.sum(left(start) ** 2))
    slope = float(np.sqrt(np.mean(left(start) ** 2))) / _MAX_TARGET_M

    def left_near(x: np.ndarray) -> np.ndarray:
        return np.concatenate([left(x), slope * x[n : n + len(places)]])

    end = least_squares(
        left_near,
        start,
        method="lm" if noise is None else "trf",
        loss="linear" if noise is None else "soft_l1",
        f_scale=1.0 if noise is None else noise,
        x_scale=1.0,
        max_nfev=_MAX_EVALUATIONS * len(start),
    )
    return move(end.x), float(2 * end.cost)


def _place_device(poses: PoseSet, nominal: Predicted, own: np.ndarray, kind: str) -> DeviceFrames:
    """Return the frame of one device or fixture by its own poses (N,); with targets if it measures poses."""
    known = nominal.poses.position[own]
    if len(known) < 3:
        return DeviceFrames((IDENTITY,), ())
    if kind in ENCODERS:
        zero = float(np.median(poses.position[own, 0] - known[:, 0])) / float(poses.length_factors[own][0])
        return DeviceFrames((IDENTITY,), (), (kind,), (zero,))
    if kind == "hole":
        return DeviceFrames((Frame(np.eye(3), -known.mean(axis=0)),), ())
    if kind == "plane":
        turn = np.linalg.svd(known - known.mean(axis=0))[2]
        turn = turn * np.sign(np.linalg.det(turn))
        return DeviceFrames((Frame(turn, -turn @ known.mean(axis=0) * np.array([0.0, 0.0, 1.0])),), ())
    if kind != "pose":
        place, length = _trilaterate(known, poses.position[own, 0], KINDS[kind].sign)
        return DeviceFrames((Frame(np.eye(3), place),), (), (kind,), (length,))
    some = replace(poses.take(own), devices=("1",), kinds=("pose",), device=np.zeros(int(own.sum()), int))
    return _align_poses(some, Predicted(nominal.poses.take(own), nominal.ok[own], nominal.reason[own]))


def _trilaterate(known: np.ndarray, distance: np.ndarray, sign: float) -> tuple[np.ndarray, float]:
    """Return the shift (3,) [m] of positions (n, 3) and the length [m] with `|p + t| = d + sign length`, the best of some starts.

    The linear equations are solved with and without the length. Positions in a plane leave two mirrored points.
    """
    square, ones = np.sum(known**2, axis=1), np.ones(len(known))
    middle, normal = known.mean(axis=0), np.linalg.svd(known - known.mean(axis=0))[2][2]
    starts = []
    for columns in ((2 * known, ones), (2 * known, -2 * sign * distance, ones)):
        x = np.linalg.lstsq(np.column_stack(columns), distance**2 - square, rcond=1e-9)[0]
        length = float(x[3]) if len(columns) > 2 else 0.0
        away = float(np.sqrt(np.mean((distance + sign * length) ** 2)))
        for side in (-1.0, 1.0):
            across = -middle + side * away * normal  # a point off the plane of the positions
            starts += [
                (*x[:3], length),
                (*(x[:3] - 2 * normal * (normal @ (x[:3] + middle))), length),
                (*across, length),
            ]

    def left(x: np.ndarray) -> np.ndarray:
        return distance + sign * x[3] - np.linalg.norm(known + x[:3], axis=1)

    found = [least_squares(left, start, method="lm") for start in starts if np.all(np.isfinite(start))]
    best = min(found, key=lambda one: one.cost).x
    return best[:3], float(best[3])


def _align_poses(poses: PoseSet, nominal: Predicted) -> DeviceFrames:
    """Return the frames of one device that measures poses or positions."""
    ok = nominal.ok
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
"""Weight of the common orientation in a campaign's own, relative to its poses: it fixes the free angle of poses in a line."""


def estimate_campaign_frames(
    poses: PoseSet, base: Poses, ok: np.ndarray, frames: DeviceFrames, *, turned: bool, tool: bool
) -> DeviceFrames:
    """Return frames with the device of each campaign fitted to its own poses, if they fit better than the given ones.

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
    """Return frames with rotations fitted to measured orientations `R_m = R_D R R_T`: the better of two starts.

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
    """Return frames with the translations of least squares, the shortest if the poses do not determine them."""
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
        own = split_setup(poses.setup)[0] == k
        if own.sum() >= 3:
            known = (seen.position[own] - old.translation) @ old.rotation
            device[k] = _align_near(poses.position[own], known, old.rotation)
    return replace(frames, device=tuple(device))


def _align_near(seen: np.ndarray, known: np.ndarray, rotation: np.ndarray) -> Frame:
    """Return the frame that best takes `known` points (N, 3) to `seen` ones, near a rotation if they do not determine it."""
    a, b = seen.mean(axis=0), known.mean(axis=0)
    u, s, vt = np.linalg.svd((seen - a).T @ (known - b))
    u, _, vt = np.linalg.svd((u * s) @ vt + _NEAREST * s[0] * rotation)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Frame(turn, a - turn @ b)


def _each(poses: PoseSet) -> range:
    """Return the targets' numbers."""
    return range(len(poses.targets))


def _mean_of(rotations: np.ndarray) -> np.ndarray:
    """Return the mean rotation (3, 3), the identity if there are no rotations."""
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
    """Return frames from orientations where positions lie in a plane: the target is assumed to have the tool's orientation."""
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
