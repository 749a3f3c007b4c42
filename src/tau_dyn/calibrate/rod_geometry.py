"""A parallel robot of points and distances as a `Geometry`: `|A_k(q) - B_k(X)| = L_k` (thesis (4.14)), laws on top.

Gaps and their derivatives are those of `mechanism`, at other dimensions and with displaced ends A. Parameters are those of the
mechanism, except that a turning joint has, instead of an axis of free length, the orientation of its frame:
`<joint>.turn_x/y/z`, a rotation vector after the nominal orientation, in the frame's own axes. So a joint's axis and its zero are
both free, its gear ratio is not, and no quaternion must be kept at norm 1 (thesis 5.4 left its four numbers free). Every law adds
its own. The tool's frame on the plate is part of the target's (`tool.x` ..), since plate points are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.geometry import Closure, Geometry, Predicted
from tau_dyn.calibrate.laws import CartComplianceLaw, Displaced, Law, displace
from tau_dyn.calibrate.robot_file import format_corrected_rods
from tau_dyn.mechanism import (
    AXES,
    ChainJoint,
    Legs,
    Poses,
    RodDimensions,
    Rods,
    compute_joint_frames,
    compute_points,
    forward_kinematics,
    list_path,
    set_dimensions,
)
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

TURN = "turn"
_STEPS = 12  # Newton steps to a pose
_AT_REST = 1e-9  # [m or rad]: after a step this small the next one, a quadratic one, would be rounding
_CLOSED = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class _DisplacedLegs(Legs):
    """Legs at given samples alone, whose ends A are where laws put them (N, n, 3) [m]."""

    points: np.ndarray | None = None

    def base_points(self, q: np.ndarray) -> np.ndarray:
        """Return the displaced ends."""
        assert self.points is not None
        return self.points


class _PlacedRods(NamedTuple):
    legs: Legs
    moved: Displaced
    theta: np.ndarray

    @property
    def q(self) -> np.ndarray:
        """Where the joints really are (N, na)."""
        return self.moved.real


@dataclass(frozen=True, eq=False)
class RodGeometry(Geometry):
    """A parallel robot with free dimensions.

    Attributes:
        rods: The nominal robot.
        laws: Laws of drives and guideways.
    """

    rods: Rods
    laws: tuple[Law, ...] = ()

    @property
    def robot(self) -> Robot:
        """The robot file."""
        return self.rods.robot

    @property
    def orients(self) -> bool:
        """Whether the plate turns."""
        return not self.rods.translates

    @property
    def parameters(self) -> Parameters:
        """Dimensions, then the laws'."""
        return self._parameters

    @property
    def priority(self) -> np.ndarray:
        """Lengths and laws first, then points of plate and base, joints; the first guideway last: it fixes the base frame."""
        return self._priority

    @cached_property
    def _parameters(self) -> Parameters:
        turning = {f"{j.name}.axis_{a}" for j in self._turning.values() for a in AXES}
        rows = [
            replace(p, name=p.name.replace(".axis_", f".{TURN}_"), value=0.0, unit="rad") if p.name in turning else p
            for p in self.rods.geometry
        ]
        return Parameters([*rows, *(p for law in self.laws for p in law.parameters)])

    @cached_property
    def _priority(self) -> np.ndarray:
        joints = self.rods.numbers.joints
        first = "arm1" if self.rods.numbers.arms else joints[0].name if joints else ""
        return np.array([_rank(name, first) for name in self.parameters.names], int)

    @property
    def _turning(self) -> dict[int, ChainJoint]:
        """Turning joints by their places in the chains; those of arms have no dimensions of their own."""
        return {} if self.rods.numbers.arms else {k: j for k, j in enumerate(self.rods.numbers.joints) if not j.slides}

    def under(self, loads: np.ndarray) -> Geometry:
        """Return the geometry under loads at the tool (N, 7), which deflect its carts."""
        laws = tuple(replace(law, at_tool=loads) if isinstance(law, CartComplianceLaw) else law for law in self.laws)
        return replace(self, laws=laws) if loads.any() and self.laws else self

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses: Newton from `start`, or from where the nominal robot is."""
        at = self._at(theta, q)
        start = forward_kinematics(self.rods, q).poses if start is None else start
        plate, ok = self._newton(at, self.rods.plate_poses(start))
        tool = self.rods.tool_poses(plate)
        position = np.where(ok[:, None], tool.position, np.nan)
        rotation = np.where(ok[:, None, None], tool.rotation, np.nan)
        return Predicted(Poses(position, rotation), ok, np.where(ok, "", "out of reach"))

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        at, plate = self._at(theta, q), self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_parameter(at, plate))

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na)."""
        at, plate = self._at(theta, q), self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_joint(at, plate))

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> Closure:
        """Return the gaps `|A - B| - L` (N, n) [m]."""
        at, plate = self._at(theta, q), self.rods.plate_poses(poses)
        by_pose, arm = at.legs.gap_by_pose(at.q, plate), plate.rotation @ self.rods.tool.translation
        by_pose[:, :, 3:] += np.cross(by_pose[:, :, :3], arm[:, None])
        gap = at.legs.gap(at.q, plate)
        return Closure(gap, self._by_parameter(at, plate), by_pose, self._by_joint(at, plate))

    def numbers(self, theta: np.ndarray) -> RodDimensions:
        """Return the robot's dimensions at these parameters, without the laws."""
        values = dict(zip(self.rods.geometry.names, np.asarray(theta, float).tolist(), strict=False))
        turns = {}
        for k, joint in self._turning.items():
            names = [f"{joint.name}.axis_{a}" for a in AXES]
            turns[k] = np.array([values[name] for name in names])
            values |= dict(zip(names, joint.direction.tolist(), strict=True))
        found = set_dimensions(self.rods.numbers, values)
        joints = [_turn(j, turns[k]) if k in turns else j for k, j in enumerate(found.joints)]
        return replace(found, joints=tuple(joints))

    @property
    def beyond_file(self) -> str:  # type: ignore[override]
        """Laws of drives and guideways."""
        return Geometry.beyond_file if self.laws else ""

    def format_urdf(self, theta: np.ndarray) -> str:
        """Return the robot file with these dimensions."""
        return format_corrected_rods(self.rods, self.numbers(theta))

    @property
    def description(self) -> dict[str, Any] | None:
        """Its kind; None with laws of drives or guideways."""
        return None if self.laws else {"kind": "rods"}

    def list_turned_joints(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Return the turning joints with their frames' orientations (3, 3)."""
        return [(j.name, j.rotation) for j in self.numbers(theta).joints if not j.slides]

    def rods_at(self, theta: np.ndarray) -> Rods:
        """Return the robot with these dimensions, without the laws."""
        numbers = self.numbers(theta)
        return replace(self.rods, numbers=numbers, lengths=numbers.lengths, on_plate=numbers.on_plate)

    def _at(self, theta: np.ndarray, q: np.ndarray) -> _PlacedRods:
        """Return the legs at some positions, with all laws evaluated once."""
        theta, numbers = np.asarray(theta, float), self.numbers(theta)
        ends = np.cumsum([len(self.rods.geometry), *(len(law.parameters) for law in self.laws)])
        moved = displace(self.laws, np.split(theta, ends)[1:-1], np.asarray(q, float), self.rods.n)
        points = compute_points(numbers.joints, numbers.carried, np.ascontiguousarray(moved.real.T))
        own = {f.name: getattr(self.rods, f.name) for f in fields(Legs)}
        own |= {"numbers": numbers, "lengths": numbers.lengths, "on_plate": numbers.on_plate}
        return _PlacedRods(_DisplacedLegs(**own, points=points.transpose(2, 0, 1) + moved.ends), moved, theta)

    def _newton(self, at: _PlacedRods, plate: Poses) -> tuple[Poses, np.ndarray]:
        """Return plate poses that close the rods, and where they do (N,)."""
        position, rotation = plate.position.copy(), plate.rotation.copy()
        lost = ~(np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2)))
        position[lost], rotation[lost] = self.rods.home.position[0], self.rods.home.rotation[0]
        size = float(np.mean(self.rods.lengths))
        for _ in range(_STEPS):
            here = Poses(position, rotation)
            step = -self._solve(at.legs.gap_by_pose(at.q, here), at.legs.gap(at.q, here)[:, :, None])[:, :, 0]
            step = np.where(np.isfinite(step), step, 0.0)
            long = np.linalg.norm(step[:, :3], axis=1) / (0.3 * size)
            step /= np.maximum(1.0, long)[:, None]
            position = position + step[:, :3]
            if not self.rods.translates:
                rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            if np.abs(step).max(initial=0.0) < _AT_REST:
                break
        here = Poses(position, rotation)
        return here, np.abs(at.legs.gap(at.q, here)).max(axis=1, initial=0.0) < _CLOSED

    def _solve(self, by_pose: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return plate twists (N, 6, k) for rows (N, n, k)."""
        rows = 3 if self.rods.translates else 6
        j = by_pose[:, :, :rows]
        if j.shape[1] != rows:  # more rods than freedoms: the best in the least-squares sense
            turned = np.swapaxes(j, 1, 2)
            j, right = turned @ j, turned @ right
        try:
            found = np.linalg.solve(j, right)
        except np.linalg.LinAlgError:  # one pose is singular; the others still have their answer
            found = np.linalg.pinv(j) @ right
        out = np.zeros((len(by_pose), 6, right.shape[2]))
        out[:, :rows] = found
        return out

    def _tool_twist(self, at: _PlacedRods, plate: Poses, columns: np.ndarray) -> np.ndarray:
        twist = -self._solve(at.legs.gap_by_pose(at.q, plate), columns)
        arm = plate.rotation @ self.rods.tool.translation
        if arm.any():
            twist[:, :3] += np.cross(twist[:, 3:], arm[:, :, None], axis=1)
        return twist

    def _by_parameter(self, at: _PlacedRods, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by dimensions, turns and laws (N, n, p)."""
        unit = at.legs.rod_directions(at.q, plate)
        out = np.zeros((*unit.shape[:2], len(self.parameters)))
        k = len(self.rods.geometry)
        out[:, :, :k] = at.legs.gap_by_geometry(at.q, plate)
        self._write_turns(out, at, unit)
        by_q = at.legs.gap_by_q(at.q, plate) if self.laws else out
        for law, columns in at.moved.columns:
            part = slice(k, k + columns.shape[2])
            if law.rods:
                out[:, law.rods, part] = np.einsum("nki,nip->nkp", unit[:, law.rods], columns)
            else:
                out[:, :, part] = by_q[:, :, [law.actuator]] * columns
            k = part.stop
        return out

    def _write_turns(self, out: np.ndarray, at: _PlacedRods, unit: np.ndarray) -> None:
        r"""Write, rod by rod on each turning joint, the gap's derivative by its `turn` in the place of its axis.

        The frame is `S = R_parent R_0 Exp(t)`; a change of `t` turns all behind it by `S J_r(t) dt` about the joint's origin,
        with the right Jacobian `J_r` of the rotation group (Chirikjian 2012).
        """
        if not self._turning:
            return
        numbers = at.legs.numbers
        q = np.ascontiguousarray(at.q.T)
        frames = compute_joint_frames(numbers.joints, q)
        places = compute_points(numbers.joints, numbers.carried, q)
        for place, joint in self._turning.items():
            parent = frames[joint.parent].rotation if joint.parent >= 0 else np.eye(3)[:, :, None]
            frame = np.einsum("ijn,jk->ikn", parent, numbers.joints[place].rotation)
            first = self.parameters.names.index(f"{joint.name}.{TURN}_x")
            back = np.asarray(pin.Jexp3(at.theta[first : first + 3]))
            for k, carrier in enumerate(numbers.carried.carrier):
                if place in list_path(numbers.joints, carrier):
                    arm = places[k] - frames[place].origin
                    moment = np.cross(arm.T, unit[:, k])  # u . (w x arm) = w . (arm x u)
                    own = np.einsum("ijn,ni->nj", np.broadcast_to(frame, (3, 3, len(moment))), moment)
                    out[:, k, first : first + 3] = own @ back

    def _by_joint(self, at: _PlacedRods, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the encoders' positions (N, n, na)."""
        out = at.legs.gap_by_q(at.q, plate) @ at.moved.by_encoder
        if at.moved.ends_by_encoder.any():
            out += np.einsum("nki,nkia->nka", at.legs.rod_directions(at.q, plate), at.moved.ends_by_encoder)
        return out


def _turn(joint: ChainJoint, turn: np.ndarray) -> ChainJoint:
    """Return a turning joint with its frame turned after the nominal orientation, its axis with it."""
    own = joint.rotation.T @ joint.direction  # the axis in the joint's own frame
    rotation = joint.rotation @ Rotation.from_rotvec(turn).as_matrix()
    return joint._replace(direction=rotation @ own, rotation=rotation)


def _rank(name: str, first: str) -> int:
    owner, _, what = name.rpartition(".")
    stem = what.rpartition("_")[0] or what
    if stem in ("length", "drift", "guideway", "drive") or stem.startswith(("bend", "error")):
        return 0
    order: Sequence[str] = ("plate", "base", "direction", "turn", "origin")
    level = 1 + order.index(stem) if stem in order else 1
    return level + (10 if owner == first else 0)
