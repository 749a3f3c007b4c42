"""A robot as its workspace needs it: inverse kinematics in home's configuration, rates, solids and reach."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial import cKDTree

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.collisions import PlacedSolid, build_capsule, build_standing_solid, move_solid
from tau_dyn.kinematics.dexterity import Rates
from tau_dyn.kinematics.solids import Body, build_rod_body, measure_rod_radius, read_bodies
from tau_dyn.mechanism import (
    Frames,
    NotRods,
    Poses,
    Rods,
    TreePose,
    build_rods,
    compute_frames,
    forward_kinematics,
    get_solver,
    inverse_kinematics,
    jacobians,
    list_joints,
)
from tau_dyn.robot import Robot

_SAMPLES = 4000
"""Random positions from which a robot's reach is estimated."""


class InverseSolution(NamedTuple):
    """Inverse kinematics of N poses.

    Attributes:
        q: Positions (N, na), nan where there are none.
        ok: Where there are some (N,).
        reason: Why there are none (N,).
        poses: Of the tool as reached: turned otherwise than asked where the robot has too few freedoms to choose.
        turned: Largest angle by which it is [rad].
    """

    q: np.ndarray
    ok: np.ndarray
    reason: np.ndarray
    poses: Poses
    turned: float = 0.0


class WorkspaceModel(Protocol):
    """What the workspace asks of a robot."""

    robot: Robot
    rods: Rods | None
    home: Poses
    bodies: list[Body]
    meshes: list[str]

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions in home's configuration, whatever their limits."""
        ...

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the closure's rates."""
        ...

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        ...

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box (two corners) that holds every place of the tool."""
        ...

    def holders(self, rod: int) -> list[int]:
        """Return the joints whose links hold the joints of a rod among `bodies`."""
        ...


def get_travel(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return finite limits (na,), a whole turn for a joint that has none.

    Raises:
        InputError: A slide without limits, or limits that are inverted.
    """
    lower, upper = robot.lower.copy(), robot.upper.copy()
    for k, (name, kind) in enumerate(zip(robot.actuated, robot.joint_kinds, strict=True)):
        if not lower[k] < upper[k]:
            raise InputError(
                "robot_structure",
                f"{robot.source}: the limits of joint '{name}' are inverted or equal: {lower[k]:g} is not below {upper[k]:g}",
            )
        if not np.isfinite([lower[k], upper[k]]).all():
            if kind == "prismatic":
                raise InputError(
                    "robot_structure",
                    f"{robot.source}: slide '{name}' has no limits; a workspace needs <limit lower upper>",
                )
            lower[k], upper[k] = -np.pi, np.pi
    return lower, upper


def draw_positions(robot: Robot) -> np.ndarray:
    """Return positions (N, na) over the actuators' travel: its corners, then at random, always the same."""
    lower, upper = get_travel(robot)
    corners = np.array(np.meshgrid(*[(0.0, 1.0)] * min(robot.na, 8))).reshape(min(robot.na, 8), -1).T
    if robot.na > 8:
        corners = np.zeros((0, robot.na))
    share = np.concatenate([corners, np.random.default_rng(0).random((_SAMPLES, robot.na))])
    return lower + share * (upper - lower)


def compute_joint_frames(robot: Robot, joints: list, q: np.ndarray) -> Frames:
    """Return the frames of all joints at actuated positions `q` (N, na) of a tree without loops to close."""
    x = np.zeros((robot.model.nv, len(q)))
    x[robot.active_v] = q.T
    return compute_frames(joints, x)


def place_body(body: Body, at: Frames | None) -> PlacedSolid:
    """Return a body where its joint is, or where it stands."""
    if body.joint == 0 or at is None:
        return build_standing_solid(body.shape, body.placement)
    rotation = np.ascontiguousarray(np.moveaxis(at.rotation[body.joint], 2, 0))
    return move_solid(body, rotation, at.origin[body.joint].T)


_TURNED = 1e-6  # [rad] a tool turned by more than this is not in the orientation asked for


class RodMachine:
    """A plate held by rods."""

    def __init__(self, rods: Rods) -> None:
        """Prepare."""
        self.rods: Rods | None = rods
        self._rods, self.robot = rods, rods.robot
        self.home = rods.tool_poses(rods.home)
        self._joints = list_joints(self.robot.model) or []
        arm = rods.on_plate - rods.tool.translation
        self.length = float(np.sqrt(np.mean(np.sum(arm**2, axis=1)))) or 1.0
        drawn, self.meshes = read_bodies(self.robot)
        self.bodies = self._bodies(drawn)

    def _bodies(self, drawn: list[Body]) -> list[Body]:
        model, robot = self.robot.model, self.robot
        plate = model.frames[model.getFrameId(self._rods.plate)].parentJoint
        active = [model.getJointId(j) for j in robot.actuated]
        chain = [j for j in range(model.njoints) if all(i in active for i in model.supports[j].tolist()[1:])]
        kept = [b for b in drawn if b.joint in (0, plate) or (b.joint in chain and self._joints)]
        self._plate = plate
        self._sides = self._real_rods()
        nominal = self._rods.leg_lengths(robot.home)[0]
        for k, (name, members) in enumerate(self._sides):
            kept.append(build_rod_body(name, measure_rod_radius(drawn, name), float(nominal[members[0]]), k))
        return kept

    def _real_rods(self) -> list[tuple[str, list[int]]]:
        """Return the rods that are there: both sides of a triangle on one hinge are one body from the hinge's middle."""
        rods, out = self._rods, {}
        for k, name in enumerate(rods.names):
            stem = name.rpartition("_")[0]
            twin = [i for i, other in enumerate(rods.names) if stem and other.rpartition("_")[0] == stem
                    and np.linalg.norm(rods.on_plate[i] - rods.on_plate[k]) < 1e-9]  # fmt: skip
            out.setdefault(tuple(twin) if len(twin) > 1 else (k,), stem if len(twin) > 1 else name)
        return [(name, list(members)) for members, name in out.items()]

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions in home's configuration, whatever their limits."""
        found = inverse_kinematics(self._rods, poses, limits=False)
        turned = float(np.nanmax(np.where(found.ok, found.orientation_error, 0.0), initial=0.0))
        if turned > _TURNED:
            poses = Poses(poses.position, np.where(found.ok[:, None, None], found.rotation, poses.rotation))
        return InverseSolution(found.q, found.ok, found.reason, poses, turned)

    def holders(self, rod: int) -> list[int]:
        """Return the joints whose links hold the joints of a rod among `bodies`."""
        carrier = self._rods.numbers.carried.carrier[self._sides[rod][1][0]]
        name = self._rods.numbers.joints[carrier].name if carrier >= 0 else ""
        return [self._plate, self.robot.model.getJointId(name) if name else 0]

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the closure's rates about the tool."""
        rods, plate = self._rods, self._rods.plate_poses(poses)
        unit = rods.rod_directions(q, plate)
        tool = unit
        if not rods.translates:
            arms = rods.plate_points(plate) - poses.position[:, None]
            tool = np.concatenate([unit, np.cross(arms, unit)], axis=2)
        turns = np.array([kind == "revolute" for kind in self.robot.joint_kinds])
        return Rates(tool, rods.gap_by_q(q, plate), turns, self.length)

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        rods, plate = self._rods, self._rods.plate_poses(poses)
        start, end = rods.base_points(q), rods.plate_points(plate)
        at = compute_joint_frames(self.robot, self._joints, q) if self._joints else None
        out = []
        for body in self.bodies:
            if body.rod >= 0:
                members, capsule = self._sides[body.rod][1], body.shape
                out.append(
                    build_capsule(capsule.radius, capsule.length, start[:, members].mean(axis=1), end[:, members[0]])
                )
            elif body.joint == self._plate:
                out.append(move_solid(body, np.asarray(plate.rotation), plate.position))
            else:
                out.append(place_body(body, at))
        return out

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box that holds every place of the tool: each rod's joint is within its length of the cart's travel."""
        rods, q = self._rods, draw_positions(self.robot)
        A, L = rods.base_points(q), rods.leg_lengths(q).max(axis=0)
        lever = np.linalg.norm(rods.on_plate - rods.tool.translation, axis=1)
        pad = np.where(np.ptp(A, axis=0).max(axis=1) > 0, 0.02 * np.ptp(A, axis=0).max(axis=1), 0.0)
        far = (L + (0.0 if rods.translates else lever) + pad)[:, None]
        shift = (rods.tool.translation - rods.on_plate) @ rods.rotation.T if rods.translates else 0.0
        return (A.min(axis=0) - far + shift).max(axis=0), (A.max(axis=0) + far + shift).min(axis=0)


_WAVES = 300
"""Most waves in which a tree's inverse kinematics spreads from what is known."""


@dataclass(eq=False)
class _Start:
    """Positions found so far, to start the next ones nearby."""

    place: list[np.ndarray] = field(default_factory=list)
    q: list[np.ndarray] = field(default_factory=list)

    def add(self, place: np.ndarray, q: np.ndarray) -> None:
        if len(place):
            self.place.append(place)
            self.q.append(q)

    def near(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions of the nearest known places, and how far those are (N,) [m]."""
        away, index = cKDTree(np.concatenate(self.place)).query(place)
        return np.concatenate(self.q)[index], away


def _spacing(places: np.ndarray) -> float:
    """Return the distance [m] at which places (N, 3) stand from each other, inf for one alone."""
    if len(places) < 2:
        return np.inf
    away, _ = cKDTree(places).query(places[:2000] if len(places) > 2000 else places, k=2)
    return float(np.median(away[:, 1]))


class TreeMachine:
    """A serial arm, or a mechanism whose loops are solved by its tree."""

    def __init__(self, robot: Robot) -> None:
        """Prepare."""
        self.robot = robot
        self.rods: Rods | None = None
        self.home = forward_kinematics(robot, robot.home[None]).poses
        engine = get_solver(robot)
        assert isinstance(engine, TreePose)
        self._engine = engine
        self.bodies, self.meshes = read_bodies(robot)
        self._turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
        self._start, self._widest = _Start(), 0.0
        self._start.add(self.home.position, robot.home[None])
        self.length = 1.0
        J = self._jacobian(robot.home[None], self.home)[0][:, self._turns]
        if J.size and np.linalg.norm(J[3:]) > 1e-9:
            self.length = float(np.linalg.norm(J[:3]) / np.linalg.norm(J[3:])) or 1.0
        self._rows = _rows(self._jacobian(draw_positions(robot)[: 2 ** min(robot.na, 8) + 50], None), robot.na)
        square = len(self._rows) == robot.na
        at_home = self._jacobian(robot.home[None], self.home)[:, self._rows]
        self._sign = float(np.sign(np.linalg.det(at_home))[0]) if square else 0.0

    def _jacobian(self, q: np.ndarray, poses: Poses | None) -> np.ndarray:
        return jacobians.jacobian(self.robot, q, poses)

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions that are home's carried on from neighbour to neighbour, from home outwards."""
        n = len(poses.position)
        q, code = np.full((n, self.robot.na), np.nan), np.full(n, "out of reach", dtype=object)
        tried, turned = np.full(n, np.inf), 0.0
        if n > 1:
            self._widest = max(self._widest, _spacing(poses.position))
        reach = 2.0 * self._widest if n > 1 else np.inf
        for _ in range(_WAVES):
            lost = np.flatnonzero(code != "")
            start, away = self._start.near(poses.position[lost])
            go = (away < reach) & (away < 0.99 * tried[lost])
            if not go.any():
                break
            tried[lost[go]] = away[go]
            turned = max(turned, self._try(poses, lost[go], start[go], q, code))
        return InverseSolution(q, code == "", code, poses, turned)

    def _try(self, poses: Poses, index: np.ndarray, start: np.ndarray, q: np.ndarray, code: np.ndarray) -> float:
        """Solve some of the poses from known neighbours, write what was found, return how far the tool is turned."""
        here = Poses(poses.position[index], np.asarray(poses.rotation)[index])
        found = inverse_kinematics(self.robot, here, start=start, limits=False)
        same = found.ok.copy()
        if self._sign and same.any():
            rates = self.rates(found.q[same], here.take(same))
            same[same] = np.sign(np.linalg.det(rates.actuators)) == self._sign
        better = same | (found.ok & (code[index] == "out of reach"))
        q[index[better]] = found.q[better]
        code[index[better]] = np.where(same[better], "", "branch change")
        self._start.add(here.position[same], found.q[same])
        return float(np.max(found.orientation_error[same], initial=0.0))

    def holders(self, rod: int) -> list[int]:
        """Return nothing: a tree has no rods of its own."""
        return []

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the Jacobian as rates, `J_x = 1`; up to three actuators by the tool's translation alone."""
        J = self._jacobian(q, poses)[:, self._rows]
        one = np.broadcast_to(np.eye(len(self._rows)), (len(q), len(self._rows), len(self._rows))).copy()
        return Rates(one, J, self._turns, self.length)

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        at = self._engine.loops.close(q).at
        return [place_body(body, at) for body in self.bodies]

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box around the places that random positions reach, with room to every side."""
        found = forward_kinematics(self.robot, draw_positions(self.robot))
        place = found.poses.position[found.ok]
        low, high = place.min(axis=0), place.max(axis=0)
        room = 0.06 * (high - low)
        return low - room, high + room


def _rows(J: np.ndarray, na: int) -> list[int]:
    """Return which components of the twist are asked for: what the tool can do, of translations first."""
    J = J[np.isfinite(J).all(axis=(1, 2))]
    moves = [k for k in range(6) if np.abs(J[:, k]).max(initial=0.0) > 1e-9]
    linear = [k for k in moves if k < 3]
    return linear if na <= len(linear) or na <= 3 else list(range(6))


def build_machine(robot: Robot) -> RodMachine | TreeMachine:
    """Return the machine of a robot."""
    try:
        return RodMachine(build_rods(robot))
    except NotRods:
        return TreeMachine(robot)
