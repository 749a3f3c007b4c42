"""Where a fit starts: the device's frame from the nominal robot, and what is wrong with poses before anything is fitted."""

from __future__ import annotations

import numpy as np

from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames, Frame, align, compute_mean_rotation
from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.mechanism import Poses

_FLAT = 1e-3
"""Thickness of a cloud of positions, relative to its extent, below which it is a plane."""

_MAX_DUPLICATE_DISTANCE = 1e-9  # [m] or [rad]: positions of joints that are one pose
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


def check_spread(poses: PoseSet, workspace: Predicted) -> None:
    """Refuse poses in one plane where the robot can leave it.

    Args:
        poses: Measured poses.
        workspace: Nominal poses all over the joints' ranges.

    Raises:
        CannotAnswer: They lie in a plane.
    """
    if not is_flat(poses.position) or is_flat(workspace.poses.position[workspace.ok]):
        return
    raise CannotAnswer(
        "poor_excitation",
        f"{poses.source}: all {poses.n} poses lie in one plane, so that nothing is known of the robot across it",
        "measure poses all over the workspace, some at least a tenth of its size off that plane",
    )


def drop_duplicate_poses(poses: PoseSet) -> tuple[PoseSet, tuple[str, ...]]:
    """Return the poses without those that repeat another's joints and measurement, and a warning that names them.

    The same joints measured again with other noise are a repeated measurement and stay.
    """
    rotation = np.zeros((poses.n, 9)) if poses.rotation is None else poses.rotation.reshape(-1, 9)
    rows = np.round(np.column_stack([poses.q, poses.position, rotation, poses.setup]) / _MAX_DUPLICATE_DISTANCE)
    _, first = np.unique(rows, axis=0, return_index=True)
    if len(first) == poses.n:
        return poses, ()
    left = np.setdiff1d(np.arange(poses.n), first)
    named = ", ".join(poses.names[k] for k in left[:5]) + (f" and {len(left) - 5} more" if len(left) > 5 else "")
    how = "pose repeats" if len(left) == 1 else "poses repeat"
    return poses.take(np.sort(first)), (
        f"{poses.source}: {len(left)} {how} another one exactly and count once ({named})",
    )


def count_required_poses(rank: int, per_pose: int) -> int:
    """Return the fewest poses that leave at least one pose's numbers over for judging the noise."""
    return -(-rank // per_pose) + 1
