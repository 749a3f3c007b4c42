"""Interface of a mechanism for its workspace: places, inverse kinematics in home's configuration, rates, solids.

A place is a point of the workspace's lattice: the tool's position, at one orientation. If the tool cannot reach every position
nearby (a 3-PRS), places are its commanded coordinates, with turns multiplied by a characteristic length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.dexterity import Rates
from tau_dyn.kinematics.obstacles import PlacedSolid, build_capsule, build_standing_solid, move_solid
from tau_dyn.kinematics.solids import Body, build_rod_body, measure_rod_radius, read_bodies
from tau_dyn.mechanism import Frames, Kinematics, Poses, Rods, build_kinematics, compute_frames, get_rods, list_joints
from tau_dyn.robot import Robot

_SAMPLES = 4000
"""Random positions from which a robot's reach is estimated."""
_TURNED = 1e-6  # [rad] a tool turned by more than this misses the requested orientation
_MAX_WAVES = 300  # in which inverse kinematics spreads from solved poses
_ABOUT, _PROBES = 0.25, 20  # share of the travel about home, and positions, at which the tool's twist is evaluated
_STILL = 1e-9  # [m/s or rad/s per actuated speed] a tool slower than this does not move
_MAX_STEPS = 30  # of Newton's method to commanded coordinates; from a neighbour five do
_SHRINKS = 0.5  # of the deviation that each of them may leave; from a neighbour it leaves far less
_BEYOND = 0.25  # share of the travel beyond its ends up to which they are followed
_FOUND = 1e-10  # [m or rad] deviation from commanded coordinates


class InverseSolution(NamedTuple):
    """Inverse kinematics of N poses.

    Attributes:
        q: Positions (N, na), nan without a solution.
        ok: Whether a solution exists (N,).
        reason: Reason why there is no solution (N,).
        poses: Poses reached by the tool; its orientation differs from the requested one if the robot has too few freedoms.
        turned: Largest angle between requested and reached orientation [rad].
    """

    q: np.ndarray
    ok: np.ndarray
    reason: np.ndarray
    poses: Poses
    turned: float = 0.0


def get_travel(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return finite limits (na,); a turning joint without limits gets a whole turn.

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


def commands_positions(kinematics: Kinematics) -> bool:
    """Return whether the tool can reach every position nearby, so that places are positions."""
    commanded = kinematics.commanded
    return commanded.by_position or {k for k in _list_moving(kinematics) if k < 3} <= set(commanded.index)


def _list_moving(kinematics: Kinematics) -> list[int]:
    """Return the components of the tool's twist that are not zero at all tested positions about home."""
    robot = kinematics.robot
    travel = np.where(np.isfinite(robot.upper - robot.lower), robot.upper - robot.lower, 1.0)
    about = robot.home + _ABOUT * travel * np.random.default_rng(0).uniform(-1, 1, (_PROBES, robot.na))
    J = kinematics.jacobian(np.clip(about, robot.lower, robot.upper))
    J = J[np.isfinite(J).all(axis=(1, 2))]
    return [k for k in range(J.shape[1]) if np.abs(J[:, k]).max(initial=0.0) > _STILL]


class WorkspaceModel:
    """Any mechanism; its inverse kinematics start at home and continue from neighbour to neighbour.

    Attributes:
        kinematics: The mechanism.
        robot: The robot.
        rods: Its plate and legs, or None.
        home: Pose of the tool at home (1 sample).
        bodies: Solids of its links.
        meshes: Links that are drawn by meshes alone.
        length: Characteristic length [m].
        by_position: Whether places are the tool's positions, not its commanded coordinates.
        axes: Names of a place's three coordinates.
        units: Units of these coordinates, m or rad.
        scale: Length of one unit of each coordinate (3,) [m].
        home_place: Home's place (3,) [m].
    """

    def __init__(self, kinematics: Kinematics) -> None:
        """Prepare."""
        self.kinematics, self.robot = kinematics, kinematics.robot
        self.rods: Rods | None = None
        self.home = kinematics.forward(self.robot.home[None]).poses
        self.bodies, self.meshes = read_bodies(self.robot)
        self._joints = list_joints(self.robot.model) or []
        self._turns = np.array([kind == "revolute" for kind in self.robot.joint_kinds])
        self.axes, self.units, self.by_position = ("x", "y", "z"), ("m", "m", "m"), True
        self.scale, self.home_place = np.ones(3), self.home.position[0]
        self._set_coordinates()
        self._known, self._widest = (self.home_place[None], self.robot.home[None]), 0.0
        at_home = self.rates(self.robot.home[None], self.home).actuators
        square = at_home.shape[1] == at_home.shape[2]
        self._sign = float(np.sign(np.linalg.det(at_home))[0]) if square else 0.0

    def _set_coordinates(self) -> None:
        """Choose the requested rows of the twist, the characteristic length of turns, and the kind of places."""
        moves = _list_moving(self.kinematics)
        linear = [k for k in moves if k < 3]
        at_home = self.kinematics.jacobian(self.robot.home[None])[0]
        J = at_home[:, self._turns] if commands_positions(self.kinematics) else at_home
        turn = float(np.linalg.norm(J[3:]))
        self.length = float(np.linalg.norm(J[:3])) / turn or 1.0 if turn > _STILL else 1.0
        self._rows = linear if self.robot.na <= max(len(linear), 3) else moves
        self._set_places()

    def _set_places(self) -> None:
        """Use commanded coordinates as places if the tool cannot reach every position nearby."""
        self.by_position = commands_positions(self.kinematics)
        if self.by_position:
            return
        commanded = self.kinematics.commanded
        self._rows = list(commanded.index)
        self.axes = (*commanded.names, "", "")[:3]
        self.units = (*commanded.units, "m", "m")[:3]
        self.scale = np.array([self.length if unit == "rad" else 1.0 for unit in self.units])
        self.home_place = self._place_of(self.home)[0]

    def place(self, places: np.ndarray, rotation: np.ndarray) -> Poses:
        """Return the tool's poses at places (N, 3) [m]; `rotation` (3, 3) is the tool's if places are positions."""
        if self.by_position:
            return Poses(places, np.broadcast_to(rotation, (len(places), 3, 3)))
        commanded = self.kinematics.commanded
        values = np.repeat(commanded.of(self.home), len(places), axis=0)
        k = min(3, values.shape[1])
        values[:, :k] = places[:, :k] / self.scale[:k]
        return commanded.to_poses(values)

    def _place_of(self, poses: Poses) -> np.ndarray:
        """Return the places (N, 3) [m] of poses; the inverse of `place`."""
        if self.by_position:
            return poses.position
        values = self.kinematics.commanded.of(poses)
        values = np.concatenate([values, np.zeros((len(values), 2))], axis=1)[:, :3]
        return values * self.scale

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions in home's configuration; joint limits are ignored."""
        place = self._place_of(poses)
        n = len(place)
        q, code = np.full((n, self.robot.na), np.nan), np.full(n, "out of reach", dtype=object)
        tried, turned = np.full(n, np.inf), 0.0
        if n > 1:
            away, _ = cKDTree(place).query(place[:2000], k=2)
            self._widest = max(self._widest, float(np.median(away[:, 1])))
        reach = 2.0 * self._widest if n > 1 else np.inf
        for _ in range(_MAX_WAVES):
            lost = np.flatnonzero(code != "")
            known_place, known_q = self._known
            away, index = cKDTree(known_place).query(place[lost])
            start = known_q[index]
            go = (away < reach) & (away < 0.99 * tried[lost])
            if not go.any():
                break
            tried[lost[go]] = away[go]
            turned = max(turned, self._try(poses, place, lost[go], start[go], q, code))
        if not self.by_position:
            poses = self._reached(q, poses)
        return InverseSolution(q, code == "", code, poses, turned)

    def _reached(self, q: np.ndarray, poses: Poses) -> Poses:
        """Return the tool's poses (N) at positions (N, na); poses without a solution keep the given ones."""
        there = np.flatnonzero(np.isfinite(q).all(axis=1))
        found = self.kinematics.forward(q[there], start=poses.take(there)).poses
        position, rotation = poses.position.copy(), np.array(poses.rotation)
        position[there], rotation[there] = found
        return Poses(position, rotation)

    def _try(
        self, poses: Poses, place: np.ndarray, index: np.ndarray, start: np.ndarray, q: np.ndarray, code: np.ndarray
    ) -> float:
        """Solve some of the poses from solved neighbours, store the solutions, return the largest error of the orientation."""
        here = poses.take(index)
        if self.by_position:
            inverse = self.kinematics.inverse(here, start=start, limits=False)
            found, ok, turned = inverse.q, inverse.ok, inverse.orientation_error
        else:
            found, ok = self._solve_commanded(here, start)
            turned = np.zeros(len(ok))
        same = ok.copy()
        if self._sign and same.any():
            rates = self.rates(found[same], here.take(same))
            same[same] = np.sign(np.linalg.det(rates.actuators)) == self._sign
        better = same | (ok & (code[index] == "out of reach"))
        q[index[better]] = found[better]
        code[index[better]] = np.where(same[better], "", "branch change")
        self._known = tuple(np.concatenate(x) for x in zip(self._known, (place[index][same], found[same]), strict=True))
        return float(np.max(turned[same], initial=0.0))

    def _solve_commanded(self, poses: Poses, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, na) with these commanded coordinates, by Newton's method, and where it converged (N,).

        Positions far beyond the limits are not followed: most of them do not close.
        """
        commanded, q = self.kinematics.commanded, start.copy()
        wanted, ok, left = commanded.of(poses), np.zeros(len(start), bool), np.arange(len(start))
        before, (lower, upper) = np.full(len(start), np.inf), get_travel(self.robot)
        room = _BEYOND * (upper - lower)
        for _ in range(_MAX_STEPS):
            if not left.size:
                break
            found = self.kinematics.forward(q[left])
            gap = wanted[left] - commanded.of(found.poses)
            size = np.abs(gap).max(axis=1)
            ok[left[size < _FOUND]] = True
            going = found.ok & (size >= _FOUND) & (size < _SHRINKS * before[left])
            before[left] = size
            left, gap = left[going], gap[going]
            if not left.size:
                break
            J = self.kinematics.jacobian(q[left])
            by_q = commanded.by_twist(found.poses.take(going)) @ J
            q[left] += (np.linalg.pinv(by_q) @ gap[:, :, None])[:, :, 0]
            left = left[((q[left] > lower - room) & (q[left] < upper + room)).all(axis=1)]
        return q, ok

    def holders(self, rod: int) -> list[int]:
        """Return the joints whose links hold the joints of a rod among `bodies`."""
        return []

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the closure's derivatives about the tool as rates; for a tree the requested rows of the twist."""
        rows = self._rows
        tool = -self.kinematics.closure_by_pose(q, poses)[:, rows][:, :, rows]
        linear = sum(k < 3 for k in rows)
        return Rates(tool, self.kinematics.closure_by_q(q, poses)[:, rows], self._turns, self.length, linear)

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        at = compute_frames(self._joints, self.kinematics.full_positions(q).T)
        return [_place_body(body, at) for body in self.bodies]

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box around the places that random positions reach, with a margin on every side."""
        found = self.kinematics.forward(draw_positions(self.robot))
        place = self._place_of(found.poses.take(found.ok))
        low, high = place.min(axis=0), place.max(axis=0)
        room = 0.06 * (high - low)
        return low - room, high + room


class LegsWorkspaceModel(WorkspaceModel):
    """A plate on legs: inverse kinematics leg by leg, legs that may touch, reach from their lengths."""

    def __init__(self, kinematics: Kinematics, legs: Rods) -> None:
        """Prepare."""
        self._legs = legs
        super().__init__(kinematics)
        self.rods = legs
        self.home = legs.ridden(self.robot.home[None], legs.tool_poses(legs.home))
        if self.by_position:
            self.home_place = self.home.position[0]
        self.bodies = self._list_bodies(self.bodies)

    def _set_coordinates(self) -> None:
        arm = self._legs.on_plate - self._legs.tool.translation
        self.length = float(np.sqrt(np.mean(np.sum(arm**2, axis=1)))) or 1.0
        self._set_places()

    def _list_bodies(self, drawn: list[Body]) -> list[Body]:
        """Return frame, plate, solids carried by actuated joints alone, and the legs."""
        model, robot, legs = self.robot.model, self.robot, self._legs
        self._plate = model.frames[model.getFrameId(legs.plate)].parentJoint
        active = [model.getJointId(j) for j in robot.actuated]
        chain = [j for j in range(model.njoints) if all(i in active for i in model.supports[j].tolist()[1:])]
        kept = [b for b in drawn if b.joint in (0, self._plate) or (b.joint in chain and self._joints)]
        self._sides = _list_real_legs(legs)
        nominal = legs.leg_lengths(robot.home)[0]
        for k, (name, members) in enumerate(self._sides):
            kept.append(build_rod_body(name, measure_rod_radius(drawn, name), float(nominal[members[0]]), k))
        return kept

    def solve(self, poses: Poses) -> InverseSolution:
        """Return positions in home's configuration; joint limits are ignored."""
        found = self.kinematics.inverse(poses, limits=False)
        if not self.by_position:
            return InverseSolution(found.q, found.ok, found.reason, self._reached(found.q, poses))
        turned = float(np.nanmax(np.where(found.ok, found.orientation_error, 0.0), initial=0.0))
        if turned > _TURNED:
            poses = Poses(poses.position, np.where(found.ok[:, None, None], found.rotation, poses.rotation))
        return InverseSolution(found.q, found.ok, found.reason, poses, turned)

    def rates(self, q: np.ndarray, poses: Poses) -> Rates:
        """Return the closure's derivatives about the tool as rates, one row per leg."""
        by_pose, by_q = self.kinematics.closure_by_pose(q, poses), self.kinematics.closure_by_q(q, poses)
        return Rates(-by_pose, by_q, self._turns, self.length)

    def holders(self, rod: int) -> list[int]:
        """Return the joints whose links hold the joints of a rod among `bodies`."""
        numbers = self._legs.numbers
        carrier = numbers.carried.carrier[self._sides[rod][1][0]]
        name = numbers.joints[carrier].name if carrier >= 0 else ""
        return [self._plate, self.robot.model.getJointId(name) if name else 0]

    def solids(self, q: np.ndarray, poses: Poses) -> list[PlacedSolid]:
        """Return `bodies` at these poses."""
        legs, plate = self._legs, self._legs.plate_poses(poses)
        start, end = legs.base_points(q), legs.plate_points(plate)
        x = np.zeros((self.robot.model.nv, len(q)))  # the tree places only solids on actuated joints alone
        x[self.robot.active_v] = (self.robot.drive_scale * q).T
        at = compute_frames(self._joints, x) if self._joints else None
        out = []
        for body in self.bodies:
            if body.rod >= 0:
                members, capsule = self._sides[body.rod][1], body.shape
                middle = start[:, members].mean(axis=1)
                out.append(build_capsule(capsule.radius, capsule.length, middle, end[:, members[0]]))
            elif body.joint == self._plate:
                out.append(move_solid(body, np.asarray(plate.rotation), plate.position))
            else:
                out.append(_place_body(body, at))
        return out

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a box that contains every place of the tool: each leg's joint is within its length of the cart's travel."""
        if not self.by_position:
            return super().reach()
        legs, q = self._legs, draw_positions(self.robot)
        A, L = legs.base_points(q), legs.leg_lengths(q).max(axis=0)
        lever = np.linalg.norm(legs.on_plate - legs.tool.translation, axis=1)
        pad = 0.02 * np.ptp(A, axis=0).max(axis=1)
        far = (L + (0.0 if legs.translates else lever) + pad)[:, None]
        shift = (legs.tool.translation - legs.on_plate) @ legs.rotation.T if legs.translates else 0.0
        lower, upper = (A.min(axis=0) - far + shift).max(axis=0), (A.max(axis=0) + far + shift).min(axis=0)
        for k in set(range(3)) - set(self.kinematics.commanded.index):  # the tool cannot be brought elsewhere
            lower[k] = upper[k] = self.home.position[0, k]
        return lower, upper


def build_machine(robot: Robot | Kinematics) -> WorkspaceModel:
    """Return the workspace model of a robot."""
    kinematics, legs = build_kinematics(robot), get_rods(robot)
    return WorkspaceModel(kinematics) if legs is None else LegsWorkspaceModel(kinematics, legs)


def _list_real_legs(legs: Rods) -> list[tuple[str, list[int]]]:
    """Return the physical legs: both sides of a triangle on one hinge are one body from the hinge's middle."""
    out = {}
    for k, name in enumerate(legs.names):
        stem = name.rpartition("_")[0]
        twin = [i for i, other in enumerate(legs.names) if stem and other.rpartition("_")[0] == stem
                and np.linalg.norm(legs.on_plate[i] - legs.on_plate[k]) < 1e-9]  # fmt: skip
        out.setdefault(tuple(twin) if len(twin) > 1 else (k,), stem if len(twin) > 1 else name)
    return [(name, list(members)) for members, name in out.items()]


def _place_body(body: Body, at: Frames | None) -> PlacedSolid:
    """Return a body at the pose of its joint, or at its fixed pose."""
    if body.joint == 0 or at is None:
        return build_standing_solid(body.shape, body.placement)
    rotation = np.ascontiguousarray(np.moveaxis(at.rotation[body.joint], 2, 0))
    return move_solid(body, rotation, at.origin[body.joint].T)
