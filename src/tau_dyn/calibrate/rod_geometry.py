"""A parallel robot of points and distances as a `Geometry`: `|A_k(q) - B_k(X)| = L_k` (thesis (4.14)), laws on top.

Parameters are those of the mechanism, except that a turning joint has, instead of an axis of free length, the orientation of its
frame: `<joint>.turn_x/y/z`, a rotation vector after the nominal orientation, in the frame's own axes. So a joint's axis and its
zero are both free, its gear is not, and no quaternion has to be kept at norm 1 (thesis 5.4 left its four numbers free). Every law
adds its own. The tool's frame on the plate is part of the target's (`tool.x` ..), since plate points are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.geometry import Closure, GeometryDefaults, Predicted
from tau_dyn.calibrate.joint_laws import GuideLaw, JointLaw, move_joints
from tau_dyn.calibrate.robot_file import format_corrected_rods
from tau_dyn.mechanism import (
    AXES,
    Carried,
    ChainJoint,
    Poses,
    RodDimensions,
    Rods,
    compute_gap_columns,
    compute_joint_frames,
    compute_leg_lengths,
    compute_leg_rates,
    compute_points,
    compute_velocities,
    forward_kinematics,
    list_path,
    multiply_by_constant,
    skew,
)
from tau_dyn.parameters import Parameter, Parameters

TURN = "turn"


@dataclass(frozen=True, eq=False)
class TurnedNumbers(RodDimensions):
    """Dimensions that remember the rotation vectors of turning joints."""

    turns: dict[str, np.ndarray] | None = None

    def turn(self, joint: str) -> np.ndarray:
        """Return a turning joint's rotation vector (3,) [rad]."""
        return (self.turns or {}).get(joint, np.zeros(3))


def compute_dimensions_at(nominal: RodDimensions, values: dict[str, float]) -> RodDimensions:
    """Return a robot's dimensions at parameter values, those of `kinematics.geometry` with `turn` in place of an axis."""

    def vector(owner: str, what: str) -> np.ndarray:
        return np.array([values[f"{owner}.{what}_{a}"] for a in AXES])

    joints, turns = list(nominal.joints), {}
    if nominal.arms:
        for arm, carrier in zip(nominal.arms, nominal.carried.carrier, strict=True):
            joints[carrier] = joints[carrier]._replace(origin=vector(arm, "origin"), direction=vector(arm, "direction"))
        lengths = np.array([values[f"{arm}.length"] for arm in nominal.arms])
        return replace(nominal, joints=tuple(joints), lengths=lengths)
    for k, joint in enumerate(joints):
        if joint.slides:
            joints[k] = joint._replace(origin=vector(joint.name, "origin"), direction=vector(joint.name, "direction"))
            continue
        turn = turns[joint.name] = vector(joint.name, TURN)
        own = joint.rotation.T @ joint.direction  # the axis in the joint's own frame
        rotation = joint.rotation @ Rotation.from_rotvec(turn).as_matrix()
        joints[k] = joint._replace(origin=vector(joint.name, "origin"), direction=rotation @ own, rotation=rotation)
    return TurnedNumbers(
        **{
            **{f: getattr(nominal, f) for f in RodDimensions.__dataclass_fields__},
            "joints": tuple(joints),
            "carried": Carried(nominal.carried.carrier, np.array([vector(n, "base") for n in nominal.names])),
            "lengths": np.array([values[f"{n}.length"] for n in nominal.names]),
            "on_plate": np.array([vector(n, "plate") for n in nominal.names]),
        },
        turns=turns,
    )


def right_jacobian(t: np.ndarray) -> np.ndarray:
    """Return `J_r(t)` (3, 3): `Exp(t + dt) = Exp(t) Exp(J_r dt)` (Chirikjian 2012)."""
    angle = float(np.linalg.norm(t))
    k = skew(t)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * k + k @ k / 6
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)


class PlacedRods:
    """Points A of a geometry at some positions, everything evaluated once; arrays of chains have samples last."""

    def __init__(
        self,
        numbers: RodDimensions,
        drives: Sequence[JointLaw],
        guides: Sequence[GuideLaw],
        laws: Sequence[np.ndarray],
        q: np.ndarray,
    ) -> None:
        """Place the points at positions `q` (N, na); `laws` holds each law's values, drives first."""
        self.numbers, self.q = numbers, q
        self.moved = move_joints(drives, laws[: len(drives)], q)
        self.guide_shifts = [law.displace(v, q) for law, v in zip(guides, laws[len(drives) :], strict=True)]
        self.moving = np.ascontiguousarray(self.moved.real.T)
        self.frames = compute_joint_frames(self.numbers.joints, self.moving)
        self.places = compute_points(self.numbers.joints, self.numbers.carried, self.moving)
        self.points = self.places.transpose(2, 0, 1) + sum(s.shift for s in self.guide_shifts)
        self.lengths = np.broadcast_to(compute_leg_lengths(self.numbers, self.moving).T, self.points.shape[:2])

    def _between(self, plate: Poses) -> tuple[np.ndarray, np.ndarray]:
        arms = self.numbers.on_plate @ np.swapaxes(plate.rotation, 1, 2)
        return self.points - plate.position[:, None] - arms, arms

    def gap(self, plate: Poses) -> np.ndarray:
        """Return `|A - B| - L` (N, n)."""
        return np.linalg.norm(self._between(plate)[0], axis=2) - self.lengths

    def directions(self, plate: Poses) -> np.ndarray:
        """Return unit vectors from B to A (N, n, 3)."""
        between, _ = self._between(plate)
        return between / np.linalg.norm(between, axis=2, keepdims=True)

    def by_pose(self, plate: Poses) -> np.ndarray:
        """Return the gaps' derivative by the plate's twist (N, n, 6)."""
        between, arms = self._between(plate)
        unit = between / np.linalg.norm(between, axis=2, keepdims=True)
        return -np.concatenate([unit, np.cross(arms, unit)], axis=2)

    def columns(self, unit: np.ndarray, plate: Poses) -> dict[tuple[int, str], np.ndarray]:
        """Return the gaps' derivatives by the dimensions."""
        rotation = np.moveaxis(np.asarray(plate.rotation), 0, 2)
        return compute_gap_columns(
            self.numbers, self.frames, self.moving, self.places, unit.transpose(1, 2, 0), rotation
        )

    def turning(self) -> list[tuple[ChainJoint, int]]:
        """Return the turning joints and their places in the chain list."""
        return [(j, k) for k, j in enumerate(self.numbers.joints) if not j.slides]

    def by_turn(self, joint: ChainJoint, place: int, unit: np.ndarray) -> list[tuple[int, np.ndarray]]:
        r"""Return, rod by rod on this joint, the gap's derivative (N, 3) by its `turn`.

        The frame is `S = R_parent R_0 Exp(t)`; a change of `t` turns all behind it by `S J_r(t) dt` about the joint's
        origin.
        """
        parent = self.frames[joint.parent].rotation if joint.parent >= 0 else np.eye(3)[:, :, None]
        frame = (
            multiply_by_constant(parent, joint.rotation)
            if parent.shape[2] > 1
            else (parent[:, :, 0] @ joint.rotation)[:, :, None]
        )
        origin = self.frames[place].origin
        turn = self.numbers.turn(joint.name) if isinstance(self.numbers, TurnedNumbers) else np.zeros(3)
        found = []
        for k, carrier in enumerate(self.numbers.carried.carrier):
            if place in list_path(self.numbers.joints, carrier):
                arm = self.places[k] - origin
                moment = np.cross(arm.T, unit[:, k])  # u . (w x arm) = w . (arm x u)
                own = np.einsum("ijn,ni->nj", np.broadcast_to(frame, (3, 3, len(moment))), moment)
                found.append((k, own @ right_jacobian(turn)))
        return found

    def by_effective_joint(self, unit: np.ndarray) -> np.ndarray:
        """Return the gaps' derivative by positions after the drives (N, n, na)."""
        out = np.zeros((*unit.shape[:2], self.q.shape[1]))
        for (k, a), column in compute_velocities(
            self.numbers.joints, self.numbers.carried, self.frames, self.places
        ).items():
            out[:, k, a] = np.einsum("ni,in->n", unit[:, k], np.broadcast_to(column, (3, len(unit))))
        rates = np.broadcast_to(compute_leg_rates(self.numbers, self.moving), (unit.shape[1], len(unit)))
        for k in np.flatnonzero(self.numbers.slides >= 0):
            out[:, k, self.numbers.slides[k]] -= rates[k]
        return out


_STEPS = 12  # Newton steps to a pose
_AT_REST = 1e-9  # [m or rad]: after a step this small the next one, a quadratic one, would be rounding
_CLOSED = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class RodGeometry(GeometryDefaults):
    """A parallel robot with free dimensions.

    Attributes:
        rods: The nominal robot.
        drives: Errors of actuated positions.
        guides: Displacements of rod ends.
    """

    rods: Rods
    drives: tuple[JointLaw, ...] = ()
    guides: tuple[GuideLaw, ...] = ()

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints."""
        return self.rods.robot.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`."""
        return self.rods.robot.position_units

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
        turning = {j.name for j in self.rods.numbers.joints if not j.slides}
        rows: list[Parameter] = []
        for p in self.rods.geometry:
            owner, _, what = p.name.rpartition(".")
            if owner in turning and what.startswith("axis_"):
                rows.append(Parameter(f"{owner}.{TURN}_{what[-1]}", 0.0, "rad"))
            else:
                rows.append(p)
        for law in (*self.drives, *self.guides):
            rows += list(law.parameters)
        return Parameters(rows)

    @cached_property
    def _priority(self) -> np.ndarray:
        joints = self.rods.numbers.joints
        first = "arm1" if self.rods.numbers.arms else joints[0].name if joints else ""
        return np.array([_priority(name, first) for name in self.parameters.names], int)

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses: Newton from `start`, or from where the nominal robot is."""
        at = self._at(theta, q)
        if start is None:
            found = forward_kinematics(self.rods, q)
            start = Poses(found.poses.position, found.poses.rotation)
        plate, ok = self._newton(at, self.rods.plate_poses(start))
        tool = self.rods.tool_poses(plate)
        position = np.where(ok[:, None], tool.position, np.nan)
        rotation = np.where(ok[:, None, None], tool.rotation, np.nan)
        return Predicted(Poses(position, rotation), ok, np.where(ok, "", "out of reach"))

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        at = self._at(theta, q)
        plate = self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_parameter(at, plate))

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na)."""
        at = self._at(theta, q)
        plate = self.rods.plate_poses(poses)
        return self._tool_twist(at, plate, self._by_joint(at, plate))

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> Closure:
        """Return the gaps `|A - B| - L` (N, n) [m]."""
        at, plate = self._at(theta, q), self.rods.plate_poses(poses)
        by_pose, arm = at.by_pose(plate), plate.rotation @ self.rods.tool.translation
        by_pose[:, :, 3:] += np.cross(by_pose[:, :, :3], arm[:, None])
        return Closure(at.gap(plate), self._by_parameter(at, plate), by_pose, self._by_joint(at, plate))

    def numbers(self, theta: np.ndarray) -> RodDimensions:
        """Return the robot's dimensions at these parameters, without the laws."""
        values = dict(zip(self.parameters.names, np.asarray(theta, float).tolist(), strict=True))
        return compute_dimensions_at(self.rods.numbers, values)

    @property
    def beyond_file(self) -> str:  # type: ignore[override]
        """Laws of drives and guideways."""
        return GeometryDefaults.beyond_file if self.drives or self.guides else ""

    def format_urdf(self, theta: np.ndarray) -> str:
        """Return the robot file with these dimensions."""
        return format_corrected_rods(self.rods, self.numbers(theta))

    @property
    def description(self) -> dict[str, Any] | None:
        """Its kind; None with laws of drives or guideways."""
        return None if self.drives or self.guides else {"kind": "rods"}

    def list_turned_joints(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Return the turning joints with their frames' orientations (3, 3)."""
        return [(j.name, j.rotation) for j in self.numbers(theta).joints if not j.slides]

    def rods_at(self, theta: np.ndarray) -> Rods:
        """Return the robot with these dimensions, without the laws."""
        numbers = self.numbers(theta)
        return replace(self.rods, numbers=numbers, lengths=numbers.lengths, on_plate=numbers.on_plate)

    def _at(self, theta: np.ndarray, q: np.ndarray) -> PlacedRods:
        theta = np.asarray(theta, float)
        ends = np.cumsum([len(self.rods.geometry), *(len(law.parameters) for law in (*self.drives, *self.guides))])
        return PlacedRods(
            self.numbers(theta), self.drives, self.guides, np.split(theta, ends)[1:-1], np.asarray(q, float)
        )

    def _newton(self, at: PlacedRods, plate: Poses) -> tuple[Poses, np.ndarray]:
        """Return plate poses that close the rods, and where they do (N,)."""
        position, rotation = plate.position.copy(), plate.rotation.copy()
        lost = ~(np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2)))
        position[lost], rotation[lost] = self.rods.home.position[0], self.rods.home.rotation[0]
        size = float(np.mean(self.rods.lengths))
        for _ in range(_STEPS):
            here = Poses(position, rotation)
            step = -self._solve(at.by_pose(here), at.gap(here)[:, :, None])[:, :, 0]
            step = np.where(np.isfinite(step), step, 0.0)
            long = np.linalg.norm(step[:, :3], axis=1) / (0.3 * size)
            step /= np.maximum(1.0, long)[:, None]
            position = position + step[:, :3]
            if not self.rods.translates:
                rotation = Rotation.from_rotvec(step[:, 3:]).as_matrix() @ rotation
            if np.abs(step).max(initial=0.0) < _AT_REST:
                break
        here = Poses(position, rotation)
        return here, np.abs(at.gap(here)).max(axis=1, initial=0.0) < _CLOSED

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

    def _tool_twist(self, at: PlacedRods, plate: Poses, columns: np.ndarray) -> np.ndarray:
        twist = -self._solve(at.by_pose(plate), columns)
        arm = plate.rotation @ self.rods.tool.translation
        if arm.any():
            twist[:, :3] += np.cross(twist[:, 3:], arm[:, :, None], axis=1)
        return twist

    def _by_parameter(self, at: PlacedRods, plate: Poses) -> np.ndarray:
        index = {name: k for k, name in enumerate(self.parameters.names)}
        out = np.zeros((len(at.q), self.rods.n, len(index)))
        unit = at.directions(plate)
        for (k, name), value in at.columns(unit, plate).items():
            if name in index:
                out[:, k, index[name]] = value
        for joint, place in at.turning():
            for k, column in at.by_turn(joint, place, unit):
                first = index[f"{joint.name}.{TURN}_x"]
                out[:, k, first : first + 3] = column
        k = len(self.rods.geometry)
        by_q = at.by_effective_joint(unit) if self.drives else np.zeros((*unit.shape[:2], 0))
        for actuator, columns in at.moved.columns:
            n = columns.shape[1]
            out[:, :, k : k + n] = by_q[:, :, actuator, None] * columns[:, None]
            k += n
        for shift in at.guide_shifts:
            n = shift.columns.shape[3]
            out[:, :, k : k + n] = np.einsum("nki,nkip->nkp", unit, shift.columns)
            k += n
        return out

    def _by_joint(self, at: PlacedRods, plate: Poses) -> np.ndarray:
        unit = at.directions(plate)
        out = at.by_effective_joint(unit) @ at.moved.by_encoder
        for law, shift in zip(self.guides, at.guide_shifts, strict=True):
            out[:, :, law.actuator] += np.einsum("nki,nki->nk", unit, shift.slope)
        return out


def _priority(name: str, first: str) -> int:
    owner, _, what = name.rpartition(".")
    stem = what.rpartition("_")[0] or what
    if stem in ("length", "drift", "guideway", "drive") or stem.startswith(("bend", "error")):
        return 0
    order: Sequence[str] = ("plate", "base", "direction", "turn", "origin")
    level = 1 + order.index(stem) if stem in order else 1
    return level + (10 if owner == first else 0)
