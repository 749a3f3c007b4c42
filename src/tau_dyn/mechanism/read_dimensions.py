"""Reads a recognised robot's geometry from its tree: actuated chains, the points that they carry, rods and their lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.mechanism.chains import Carried, ChainJoint
from tau_dyn.mechanism.recognise import Found
from tau_dyn.mechanism.rod_dimensions import RodDimensions
from tau_dyn.mechanism.tree_arrays import compute_subspace, remove_rounding
from tau_dyn.robot import Robot


def read_dimensions(robot: Robot, found: Found) -> RodDimensions:
    """Return the geometry of a robot that was recognised, by arms where its file declares them."""
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
        gains=np.array([rod.gain for rod in rods]),
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
                direction=_clean(placement.rotation @ (motion[:3] if slides else motion[3:])),
                rotation=_clean(placement.rotation),
            )
        )
    return joints, index


def _clean(x: np.ndarray) -> np.ndarray:
    """Return numbers as `remove_rounding` does, and no negative zeros."""
    return remove_rounding(x) + 0.0


def _as_arms(robot: Robot, found: Found, numbers: RodDimensions) -> RodDimensions:
    """Return the geometry by arms where the file declares a simplified Gantry-Tau and it is one."""
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
