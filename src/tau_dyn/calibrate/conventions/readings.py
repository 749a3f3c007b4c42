"""Readings of a pose file: changes without parameters of the joints' and the poses' conventions.

A change acts on measured poses and names its cause; a reading is a tuple of changes, applied in order. Joints: sign, quarter
turns of the zero, exchanged columns, degrees or millimetres. Poses: exchanged or reversed axes, unit, order of the quaternion,
inverse orientations or poses, the kind of three angles, and rows shifted between joints and poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.measured import POSITION, PoseSet
from tau_dyn.exceptions import InputError

_MAX_ROW_SHIFT = 2
"""Largest shift of rows between joints and poses: a header or a first pose counted in one table only gives one, rarely two."""
_MAX_JOINTS_FOR_ALL_SIGNS = 7
"""Joints up to which every combination of signs is a reading of its own: 127 of an arm with seven joints."""
_POSITION_UNITS = {"mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
"""Units other than m in which devices write positions."""


@dataclass(frozen=True, eq=False)
class PoseReading:
    """One change of how a file is read.

    Attributes:
        cause: Name in results.
        joints: Joints that it changes.
        words: Clause that describes the file.
        apply: Function that returns the poses in the intended convention.
        unit: Metres of the unit of the file's positions.
        acts_on: Part that it changes: `joints`, `positions`, `orientations`, or `poses` (positions by orientations).
    """

    cause: str
    joints: tuple[str, ...]
    words: str
    apply: Callable[[PoseSet], PoseSet]
    unit: float = 1.0
    acts_on: Literal["joints", "positions", "orientations", "poses"] = "positions"

    @property
    def is_format(self) -> bool:
        """Whether it is the meaning of the orientation's numbers, which every other change of poses needs."""
        return self.acts_on == "orientations" and self.cause != "inverse_poses"

    @property
    def place(self) -> tuple[str, tuple[str, ...]]:
        """The cause and its joints; a reading has at most one change for each."""
        return self.cause, self.joints


Reading = tuple[PoseReading, ...]


def apply_reading(reading: Reading, poses: PoseSet) -> PoseSet:
    """Return the poses after the changes of a reading."""
    for change in reading:
        poses = change.apply(poses)
    return poses


def apply_reading_alike(reading: Reading, poses: PoseSet) -> PoseSet:
    """Return held-out poses with those changes of a reading that apply to them.

    Raises:
        InputError: The poses lack orientations by which the reading changes positions.
    """
    for change in reading:
        if not poses.measures_poses and change.acts_on != "joints":
            continue
        if poses.rotation is None and change.acts_on == "poses":
            raise InputError(
                "mismatch",
                f"{poses.source} has no orientations, and its positions cannot be read as those of the training poses: "
                f"{change.words}; measure both in the same way",
            )
        if poses.rotation is not None or change.acts_on != "orientations":
            poses = change.apply(poses)
    return poses


def list_readings(poses: PoseSet, joints: Sequence[str], units: Sequence[str], *, turns: bool) -> list[Reading]:
    """Return the readings of one cause each, and inverse poses in each format of orientations.

    The product of an inverse and a roll of a quaternion's four numbers is a turn of both frames (both have determinant -1 in
    four dimensions), so that orientations do not show either of the two changes alone.

    Args:
        poses: Measured poses.
        joints: Actuated joints.
        units: Units of their positions, `rad` or `m` each.
        turns: Whether the robot's tool can turn, so that measured orientations count.
    """
    oriented = turns and poses.rotation is not None
    single = [
        *_list_joint_changes(joints, units),
        *_list_axis_changes(oriented),
        *_list_unit_changes(),
        *_list_shifts(poses),
    ]
    turned = _list_orientation_changes(poses) if oriented else []
    single += turned
    inverse = [change for change in turned if change.acts_on == "poses"]
    pairs = [(change, other) for change in turned if change.is_format for other in inverse]
    signs = [_reverse(joints, k) for k in range(len(joints))]
    sizes = range(2, len(joints) + 1) if len(joints) <= _MAX_JOINTS_FOR_ALL_SIGNS else ()
    return [
        *((change,) for change in [*signs, *single]),
        *pairs,
        *(some for n in sizes for some in combinations(signs, n)),
    ]


def _reverse(joints: Sequence[str], k: int) -> PoseReading:
    sign = np.where(np.arange(len(joints)) == k, -1.0, 1.0)
    words = f"the sign of {joints[k]} is reversed: it counts the other way than the robot file"
    return PoseReading("joint_sign", (joints[k],), words, _scale_joints(sign), acts_on="joints")


def _scale_joints(factor: np.ndarray) -> Callable[[PoseSet], PoseSet]:
    return lambda poses: replace(
        poses,
        q=poses.q * factor,
        approach=poses.approach * np.sign(factor),
        speed=poses.speed * factor,
        acceleration=poses.acceleration * factor,
        jerk=poses.jerk * factor,
    )


def _list_joint_changes(joints: Sequence[str], units: Sequence[str]) -> list[PoseReading]:
    changes: list[PoseReading] = []
    turning, numbers = np.array([unit == "rad" for unit in units]), np.arange(len(joints))
    for k in np.flatnonzero(turning).tolist():
        for turn in (90, -90, 180):
            words = f"the zero of {joints[k]} is {turn:d} degrees away from the robot file's"
            zero = _shift_joint(numbers == k, np.deg2rad(turn))
            changes.append(PoseReading("joint_zero", (joints[k],), words, zero, acts_on="joints"))
    for a, b in combinations(range(len(joints)), 2):
        order = np.where(numbers == a, b, np.where(numbers == b, a, numbers))
        words = f"the columns of {joints[a]} and {joints[b]} are exchanged"
        pair = (joints[a], joints[b])
        changes.append(PoseReading("columns_exchanged", pair, words, _order_joints(order), acts_on="joints"))
    for own, unit, factor in ((turning, "degrees", np.pi / 180), (~turning, "millimetres", 1e-3)):
        for some in _unit_groups(np.flatnonzero(own).tolist()):
            who = "joint positions" if len(some) == own.sum() else f"positions of {joints[some[0]]}"
            scale = np.where(np.isin(numbers, some), factor, 1.0)
            where: tuple[str, ...] = () if len(some) == own.sum() else (joints[some[0]],)
            words = f"{who} are in {unit}"
            changes.append(PoseReading("joint_unit", where, words, _scale_joints(scale), acts_on="joints"))
    return changes


def _unit_groups(index: list[int]) -> list[list[int]]:
    """Return all joints of a kind as one group, then each joint alone."""
    return [index, *([one] for one in index if len(index) > 1)] if index else []


def _shift_joint(own: np.ndarray, turn: float) -> Callable[[PoseSet], PoseSet]:
    return lambda poses: replace(poses, q=poses.q - turn * own)


def _order_joints(order: np.ndarray) -> Callable[[PoseSet], PoseSet]:
    return lambda poses: replace(
        poses,
        q=poses.q[:, order],
        approach=poses.approach[:, order],
        speed=poses.speed[:, order],
        acceleration=poses.acceleration[:, order],
        jerk=poses.jerk[:, order],
    )


def _list_axis_changes(oriented: bool) -> list[PoseReading]:
    """Return exchanges and reversals of x, y and z; without orientations all odd ones are one mirrored device."""
    if not oriented:
        words = "x_tool and y_tool are exchanged, or one axis is reversed: positions alone show a mirrored frame, not which axes"
        return [PoseReading("columns_exchanged", (), words, _turn_positions(np.eye(3)[[1, 0, 2]]))]
    changes = []
    for order in permutations(range(3)):
        if order != (0, 1, 2):
            names = ", ".join(POSITION[k] for k in order)
            words = f"the position columns are exchanged: x, y, z are in {names}"
            changes.append(PoseReading("columns_exchanged", (), words, _turn_positions(np.eye(3)[list(order)])))
    for signs in product((1.0, -1.0), repeat=3):
        turned = [name for name, sign in zip(POSITION, signs, strict=True) if sign < 0]
        if 0 < len(turned) < 3:
            words = f"the sign of {' and '.join(turned)} is the opposite of the orientation's axes"
            changes.append(PoseReading("axis_sign", (), words, _turn_positions(np.diag(signs))))
    return changes


def _turn_positions(matrix: np.ndarray) -> Callable[[PoseSet], PoseSet]:
    def apply(poses: PoseSet) -> PoseSet:
        stated = None if poses.position_stderr is None else poses.position_stderr @ np.abs(matrix).T
        return replace(poses, position=poses.position @ matrix.T, position_stderr=stated)

    return apply


def _list_unit_changes() -> list[PoseReading]:
    def scale(factor: float) -> Callable[[PoseSet], PoseSet]:
        def apply(poses: PoseSet) -> PoseSet:
            stated = None if poses.position_stderr is None else factor * poses.position_stderr
            return replace(poses, position=factor * poses.position, position_stderr=stated)

        return apply

    return [
        PoseReading("position_unit", (), f"the positions are in {u}", scale(f), f) for u, f in _POSITION_UNITS.items()
    ]


def _list_shifts(poses: PoseSet) -> list[PoseReading]:
    def shift(rows: int) -> Callable[[PoseSet], PoseSet]:
        def apply(poses: PoseSet) -> PoseSet:
            index = np.arange(max(0, -rows), min(poses.n, poses.n - rows))
            of_joints = poses.take(index + rows)
            return replace(poses.take(index), q=of_joints.q, approach=of_joints.approach, speed=of_joints.speed)

        return apply

    changes = []
    for rows in (*range(1, _MAX_ROW_SHIFT + 1), *range(-_MAX_ROW_SHIFT, 0)):
        count = f"{abs(rows)} row{'s' if abs(rows) > 1 else ''}"
        words = f"the joints' rows are {count} {'later' if rows > 0 else 'earlier'} than the poses they belong to (row shift)"
        changes.append(PoseReading("row_shift", (), words, shift(rows)))
    recorded = bool(poses.acceleration.any())  # rows of a recording are shifted by a time
    return [] if recorded else [change for change in changes if poses.n > 4 * _MAX_ROW_SHIFT]


def _list_orientation_changes(poses: PoseSet) -> list[PoseReading]:
    """Return other meanings of the orientation's columns."""
    changes = [
        PoseReading(
            "quaternion_order",
            (),
            "the quaternion's order is w x y z instead of x y z w",
            _roll_quaternion,
            acts_on="orientations",
        ),
        PoseReading(
            "inverse_poses",
            (),
            "the poses are inverse: the device in the target's frame, or base and tool exchanged",
            _invert,
            acts_on="poses",
        ),
        PoseReading(
            "inverse_poses",
            ("orientation",),
            "the orientations alone are inverse (conjugate quaternions)",
            _transpose,
            acts_on="orientations",
        ),
    ]
    if poses.angles is not None:
        changes += [_read_angles(kind, unit) for unit in ("rad", "deg") for kind in ANGLE_KINDS]
    return [change if change.joints != ("orientation",) else replace(change, joints=()) for change in changes]


def _roll_quaternion(poses: PoseSet) -> PoseSet:
    assert poses.rotation is not None
    if poses.angles is not None:  # held-out poses in another format
        return poses
    return replace(
        poses,
        rotation=Rotation.from_quat(np.roll(Rotation.from_matrix(poses.rotation).as_quat(), -1, axis=1)).as_matrix(),
    )


def _transpose(poses: PoseSet) -> PoseSet:
    assert poses.rotation is not None
    return replace(poses, rotation=np.swapaxes(poses.rotation, 1, 2))


def _invert(poses: PoseSet) -> PoseSet:
    back = _transpose(poses)
    assert back.rotation is not None
    return replace(back, position=-np.einsum("nij,nj->ni", back.rotation, poses.position))


ANGLE_KINDS = {
    "a rotation vector": "",
    "angles about fixed x, y, z (roll, pitch, yaw)": "xyz",
    "angles about moving x, y, z": "XYZ",
    "angles about fixed x, z, y": "xzy",
    "angles about fixed y, x, z": "yxz",
    "angles about fixed y, z, x": "yzx",
    "angles about fixed z, x, y": "zxy",
    "angles about moving z, y, z": "ZYZ",
    "angles about moving z, x, z": "ZXZ",
}
"""Kinds of three angles, with SciPy's sequence; angles named after axes cover all twelve orders by these."""


def _read_angles(kind: str, unit: str) -> PoseReading:
    def apply(poses: PoseSet) -> PoseSet:
        if poses.angles is None:  # held-out poses in another format
            return poses
        return replace(poses, rotation=turn_by_angles(poses.angles, ANGLE_KINDS[kind], degrees=unit == "deg"))

    words = f"the three columns of the orientation are {kind} in {unit}"
    return PoseReading("", (), words, apply, acts_on="orientations")


def turn_by_angles(angles: np.ndarray, sequence: str, *, degrees: bool) -> np.ndarray:
    """Return rotation matrices (N, 3, 3) of rotation vectors, or of angles (N, 3) about x, y and z in a sequence of axes."""
    if degrees:
        angles = np.deg2rad(angles)
    if not sequence:
        return Rotation.from_rotvec(angles).as_matrix()
    own = sorted(sequence.lower()) == ["x", "y", "z"]
    order = ["xyz".index(axis) for axis in sequence.lower()] if own else [0, 1, 2]
    return Rotation.from_euler(sequence, angles[:, order]).as_matrix()
