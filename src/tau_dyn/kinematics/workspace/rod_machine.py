"""A plate held by rods, as its workspace needs it."""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.bodies import Body, build_rod_body, measure_rod_radius, read_bodies
from tau_dyn.kinematics.collisions import PlacedSolid, build_capsule, move_solid
from tau_dyn.kinematics.dexterity import Rates
from tau_dyn.kinematics.workspace.machine import InverseSolution, compute_joint_frames, draw_positions, place_body
from tau_dyn.mechanism import Poses, Rods, inverse_kinematics, list_joints

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
        lower, upper = (A.min(axis=0) - far + shift).max(axis=0), (A.max(axis=0) + far + shift).min(axis=0)
        for k in set(range(3)) - set(rods.commanded.index):  # the tool cannot be brought elsewhere
            lower[k] = upper[k] = self.home.position[0, k]
        return lower, upper
