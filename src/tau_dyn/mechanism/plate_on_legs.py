"""Kinematics of a plate on legs: forward by spheres or Newton on SE(3), inverse leg by leg, derivatives of the gaps.

A recognised robot's geometry is read from its tree: actuated chains, the points that they carry, rods and their lengths.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.frames import (
    Carried,
    ChainJoint,
    combine_rotated,
    compute_cross_product,
    compute_subspace,
    remove_rounding,
)
from tau_dyn.mechanism.free_plate import FreePlate
from tau_dyn.mechanism.kinematics import Kinematics, Singularity
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import (
    OK,
    ForwardResult,
    InverseResult,
    InverseSolutions,
    Poses,
    require_poses,
    require_positions,
)
from tau_dyn.mechanism.recognise import Found, NotRods, recognise
from tau_dyn.mechanism.rod_dimensions import Plate, RodDimensions
from tau_dyn.mechanism.rod_inverse import RodInverse
from tau_dyn.mechanism.sliding_plate import SlidingPlate
from tau_dyn.mechanism.small_systems import measure_rank_distance, solve_with_lapack
from tau_dyn.mechanism.tree_pose import TreePose
from tau_dyn.robot import Robot


def read_dimensions(robot: Robot, found: Found) -> RodDimensions:
    """Return the geometry of a robot that was recognised, by arms if its file declares them."""
    joints, index = _chain_joints(robot, found)
    actuator = {robot.model.getJointId(name): k for k, name in enumerate(robot.actuated)}
    rods = found.rods
    numbers = RodDimensions(
        names=tuple(rod.name for rod in rods),
        joints=tuple(joints),
        carried=Carried(tuple(index[rod.carrier] for rod in rods), np.array([rod.base for rod in rods])),
        lengths=np.array([rod.length for rod in rods]),
        on_plate=np.array([rod.plate for rod in rods]),
        slides=np.array([actuator.get(rod.slide, -1) for rod in rods]),
        offsets=np.array([rod.offset for rod in rods]),
        gains=np.array([rod.gain * robot.drive_scales.get(robot.model.names[rod.slide], 1.0) for rod in rods]),
    )
    return _as_arms(robot, found, numbers) if robot.arms else numbers


def _chain_joints(robot: Robot, found: Found) -> tuple[list[ChainJoint], dict[int, int]]:
    """Return the actuated joints that carry rods, parents first, and their indices by Pinocchio's."""
    model = robot.model
    wanted = sorted({j for rod in found.rods for j in model.supports[rod.carrier].tolist()[1:]})
    index, joints = {0: -1}, []
    for j in wanted:
        index[j] = len(joints)
        kind, placement = model.joints[j].shortname(), model.jointPlacements[j]
        slides = kind.startswith("JointModelP")
        motion = compute_subspace(model, j)
        joints.append(
            ChainJoint(
                name=model.names[j],
                parent=index[int(model.parents[j])],
                actuator=robot.actuated.index(model.names[j]),
                slides=slides,
                origin=placement.translation.copy(),
                direction=_clean(placement.rotation @ (motion[:3] if slides else motion[3:]))
                * robot.drive_scales.get(model.names[j], 1.0),
                rotation=_clean(placement.rotation),
            )
        )
    return joints, index


def _clean(x: np.ndarray) -> np.ndarray:
    """Return numbers as `remove_rounding` does, and no negative zeros."""
    return remove_rounding(x) + 0.0


def _as_arms(robot: Robot, found: Found, numbers: RodDimensions) -> RodDimensions:
    """Return the geometry by arms if the file declares a simplified Gantry-Tau and the robot is one."""
    carriers = [numbers.joints[c].name if c >= 0 else "" for c in numbers.carried.carrier]
    carts = [arm.cart_joint for arm in robot.arms]
    alone = all(j.slides and j.parent < 0 for j in numbers.joints)
    if not (found.translates and alone and sorted(carriers) == sorted(carts) and np.all(numbers.slides < 0)):
        return numbers
    joints = list(numbers.joints)
    for k, carrier in enumerate(numbers.carried.carrier):
        joint = joints[carrier]
        shift = joint.rotation @ numbers.carried.local[k] - found.home.rotation @ numbers.on_plate[k]
        joints[carrier] = joint._replace(origin=joint.origin + shift)
    zero = np.zeros((len(carriers), 3))
    return replace(
        numbers,
        joints=tuple(joints),
        carried=Carried(numbers.carried.carrier, zero),
        on_plate=zero,
        arms=tuple(f"arm{carts.index(c) + 1}" for c in carriers),
    )


_NEARBY = 0.02  # of the rods' length or rad: where a plate that hung on a leg is compared with the tree
_AGREE = 1e-7  # [m or 1] by how much it may differ there
_SINGULAR = 1e-6  # smallest singular value of its legs' directions by the largest


@dataclass(frozen=True, eq=False)
class PlateOnLegs(Legs, Kinematics):
    """A plate on legs and its solvers; see `Legs` for its attributes and `Kinematics` for its methods."""

    @property
    def equations(self) -> str:
        """Either "sliding plate" or "free plate"."""
        return "sliding plate" if self.translates else "free plate"

    @property
    def legs(self) -> Legs:
        """Itself."""
        return self

    @cached_property
    def engine(self) -> SlidingPlate | FreePlate:
        """Solver of the forward kinematics.

        Raises:
            LoopClosureError: The rods cannot be closed at home.
        """
        return SlidingPlate(self) if self.translates else FreePlate(self)

    @cached_property
    def inverse_engine(self) -> RodInverse:
        """Solver of the inverse kinematics."""
        return RodInverse(self, lambda: self.commanded)

    def _forward(self, q: np.ndarray, start: Poses | None) -> ForwardResult:
        plate, code = self.engine.forward(q, None if start is None else self.plate_poses(start))
        return ForwardResult(self.ridden(q, self.tool_poses(plate)), plate, code)

    def both_forward(self, q: np.ndarray) -> np.ndarray:
        """Return both tool positions (N, 2, 3) [m]; see `Kinematics.both_forward`."""
        if not self.translates:
            return super().both_forward(q)
        positions = SlidingPlate(self).both(require_positions(self.robot, q))
        return positions + self.rotation @ self.tool.translation

    def full_positions(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (N, nv), from the tree; see `Kinematics.full_positions`."""
        return self._tree.full_positions(require_positions(self.robot, q))

    @cached_property
    def _tree(self) -> TreePose:
        return TreePose(self.robot)

    def _inverse(
        self, poses: Poses, configuration: Sequence[int] | np.ndarray | None, start: np.ndarray | None, limits: bool
    ) -> InverseResult:
        signs = self.inverse_engine.signs(configuration)
        return self.inverse_engine.inverse(poses, signs, start, configuration is None)

    def _solutions(self, poses: Poses) -> InverseSolutions:
        closed = all(0 not in chain.signs for chain in self.inverse_engine.chains)
        n, why = len(poses.position), "in closed form" if closed else "from many starts"
        return InverseSolutions(self.inverse_engine.all(poses), np.full(n, closed), [why] * n)

    @property
    def configurations(self) -> np.ndarray:
        """Configurations by name (n, chains); see `Kinematics.configurations`."""
        return np.array(list(product(*(chain.signs for chain in self.inverse_engine.chains))))

    @property
    def home_configuration(self) -> np.ndarray:
        """Home's configuration (chains,)."""
        return np.array(self.inverse_engine.signs(None))

    def nearest_configuration(self, poses: Poses, q: np.ndarray) -> np.ndarray:
        """Return the configuration (chains,) that has positions (na,) at or near a pose (1 sample)."""
        return np.array(self.inverse_engine.signs_near(require_poses(poses), q))

    def _twists_at_home(self) -> tuple[np.ndarray, float]:
        J = self.jacobian(self.robot.home[None])[0]
        J = np.vstack([J, np.zeros((6 - len(J), self.na))])
        middle = self.on_plate.mean(axis=0)
        arm = self.home.rotation[0] @ (middle - self.tool.translation)
        J[:3] += np.cross(J[3:].T, arm).T
        return J, float(np.sqrt(np.mean(np.sum((self.on_plate - middle) ** 2, axis=1)))) or 1.0

    def closure(self, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the gaps (N, n) [m]; see `Kinematics.closure`."""
        return self.gap(q, self.plate_poses(poses))

    def closure_by_pose(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return how fast each gap opens per tool twist (N, n, 6), or (N, n, 3) for a translating plate."""
        return self._by_tool(*self._plate_at(q, poses))

    def _by_tool(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return how fast each gap opens per tool twist, at poses of the plate."""
        columns = self.gap_by_pose(q, plate)
        if self.translates:
            return columns[:, :, :3]
        r = plate.rotation @ self.tool.translation  # the plate's origin moves with v_tool - w x r
        turned = columns[:, :, 3:] + np.cross(columns[:, :, :3], r[:, None])
        return np.concatenate([columns[:, :, :3], turned], axis=2)

    def closure_by_q(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the gaps' derivative by the actuated positions (N, n, na)."""
        return self.gap_by_q(*self._plate_at(q, poses))

    def closure_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the gaps' derivative by the geometric parameters (N, n, p)."""
        return self.gap_by_geometry(*self._plate_at(q, poses))

    def jacobian(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated velocity; see `Kinematics.jacobian`."""
        q, plate = self._plate_at(q, poses)
        if self.translates:
            return self._twist_by(self.gap_by_q, q, plate)
        at = Plate(plate.position.T, np.moveaxis(np.asarray(plate.rotation), 0, 2))
        slope = self.engine.slope(q.T, at)  # type: ignore[union-attr]
        if self.tool.translation.any():
            arm = np.broadcast_to(combine_rotated(at.rotation, self.tool.translation)[:, None], slope[3:].shape)
            slope[:3] += compute_cross_product(slope[3:], arm)
        return slope.transpose(2, 0, 1)

    def pose_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per geometric parameter (N, 6 or 3, p), the rods kept closed."""
        return self._twist_by(self.gap_by_geometry, *self._plate_at(q, poses))

    def _twist_by(self, by: Callable[..., np.ndarray], q: np.ndarray, plate: Poses) -> np.ndarray:
        return -solve_with_lapack(self._by_tool(q, plate), np.moveaxis(by(q, plate), 0, 2)).transpose(2, 0, 1)

    def _plate_at(self, q: np.ndarray, poses: Poses | None) -> tuple[np.ndarray, Poses]:
        """Return positions, checked, and the plate's poses there."""
        q = require_positions(self.robot, q)
        return q, self.plate_poses(self.poses_at(q, poses))

    def singularity(self, q: np.ndarray, poses: Poses | None = None) -> Singularity:
        """Return how near the robot is to singularities of both kinds."""
        q, plate = self._plate_at(q, poses)
        radius = float(np.sqrt(np.mean(np.sum(self.on_plate**2, axis=1)))) or 1.0
        by_pose, by_q = self.gap_by_pose(q, plate), self.gap_by_q(q, plate)
        by_pose = by_pose[:, :, :3] if self.translates else by_pose / np.array([1, 1, 1, radius, radius, radius])
        speed = np.linalg.norm(self.base_jacobian(q), axis=2).max(axis=1)
        speed = np.maximum(speed, np.abs(self.leg_rates(q)).max(axis=1))
        return Singularity(measure_rank_distance(by_pose), measure_rank_distance(by_q / speed[:, None]))

    def acceleration_bias(self, q: np.ndarray, v: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        r"""Return the tool's acceleration at rest of the actuators; see `Kinematics.acceleration_bias`.

        With `f = (|d|^2 - L^2) / 2`, `d . T'' + (r x d) . w' = |d'|^2 + d . (A'' - w x (w x r)) - (L L')'`, and `(L L')'` is
        the square of a slide's speed.
        """
        q, v = self._velocities(q, v)
        plate = self.plate_poses(self.poses_at(q, poses))
        by_pose, by_q = self.gap_by_pose(q, plate), self.gap_by_q(q, plate)
        by_pose = by_pose[:, :, :3] if self.translates else by_pose
        twist = -solve_with_lapack(by_pose, np.einsum("nka,na->kn", by_q, v)).T
        w = np.zeros((len(q), 3)) if self.translates else twist[:, 3:]
        r = self.plate_points(plate) - plate.position[:, None]
        rate = np.einsum("nkia,na->nki", self.base_jacobian(q), v) - twist[:, None, :3] - np.cross(w[:, None], r)
        joints, carried, qt = self.numbers.joints, self.numbers.carried, q.T
        places = frames.compute_points(joints, carried, qt)
        pushed = frames.compute_accelerations(joints, carried, qt, v.T).transpose(2, 0, 1)
        pushed = pushed - np.cross(w[:, None], np.cross(w[:, None], r))
        d = places.transpose(2, 0, 1) - self.plate_points(plate)
        right = np.sum(rate**2, axis=2) + np.sum(d * pushed, axis=2)
        for k in np.flatnonzero(self.numbers.slides >= 0):
            right[:, k] -= (self.numbers.gains[k] * v[:, self.numbers.slides[k]]) ** 2
        total = solve_with_lapack(-by_pose, (right / np.linalg.norm(d, axis=2)).T).T
        if self.translates:
            return total
        arm = plate.rotation @ self.tool.translation
        total[:, :3] += np.cross(total[:, 3:], arm) + np.cross(w, np.cross(w, arm))
        return total


Rods = PlateOnLegs
"""The same by another name."""


def build_rods(robot: Robot) -> PlateOnLegs:
    """Read a parallel robot's points and distances from its tree.

    Raises:
        NotRods: The mechanism is of another kind (a serial arm, an articulated plate, a planar loop).
        LoopClosureError: The loops cannot be closed at home.
    """
    found = recognise(robot)
    numbers = read_dimensions(robot, found)
    home = Poses(found.home.translation[None].copy(), found.home.rotation[None].copy())
    rods = PlateOnLegs(
        robot=robot,
        names=numbers.names,
        lengths=numbers.lengths,
        on_plate=numbers.on_plate,
        plate=_link_of(robot, found.plate),
        translates=found.translates,
        rotation=home.rotation[0],
        tool=found.tool,
        geometry=rod_dimensions.build_parameters(numbers),
        nominal_home=home,
        numbers=numbers,
        ride=found.ride,
    )
    if found.rerooted:
        _require_agreement(rods)
    return rods


def _require_agreement(rods: PlateOnLegs) -> None:
    """Refuse legs that hold the plate otherwise than the robot's tree does, near home.

    Raises:
        NotRods: They are singular at home, or lead elsewhere.
    """
    robot, size = rods.robot, float(np.mean(rods.lengths))
    unit = np.where([kind == "revolute" for kind in robot.joint_kinds], 1.0, size)
    q = robot.home + _NEARBY * np.random.default_rng(0).uniform(-1, 1, (4, robot.na)) * unit
    try:
        held = measure_rank_distance(rods.gap_by_pose(robot.home[None], rods.home)[:, :, : 3 if rods.translates else 6])
        if held[0] < _SINGULAR * min(size, 1.0):
            raise NotRods(f"{robot.source}: the legs do not hold the plate at home")
        tree, code = TreePose(robot).forward(q)
        found = rods.forward(q)
    except LoopClosureError as fault:
        raise NotRods(str(fault)) from None
    both = (code == OK) & found.ok
    gap = np.concatenate(
        [(found.poses.position - tree.position)[both], (found.poses.rotation - tree.rotation)[both].reshape(-1, 3)]
    )
    if not both.any() or np.any((code == OK) != found.ok) or np.abs(gap).max() > _AGREE:
        raise NotRods(f"{robot.source}: distances do not describe all constraints of its legs on the plate")


def _link_of(robot: Robot, joint: int) -> str:
    for frame in robot.model.frames:
        if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
            return frame.name
    return robot.model.names[joint]
