"""Which family of models a robot belongs to: rods between carts and a plate, or any other tree."""

from __future__ import annotations

import re
from functools import cached_property
from typing import Protocol

from tau_dyn.calibrate.geometry import Geometry, constrain_parameters
from tau_dyn.calibrate.joint_laws import (
    ArmGeometry,
    CouplingLaw,
    EccentricityLaw,
    GravityLaw,
    JointLaw,
    build_gravity_laws,
)
from tau_dyn.calibrate.models import BETWEEN_CAMPAIGNS, RodFamily, Spec, list_between_campaigns
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import NotRods, build_rods
from tau_dyn.robot import Robot

_WHY_NOT = {
    "base_frame": "there is one campaign only; a column `campaign` tells several apart",
    "backlash": "nothing tells from which side the joints came; give poses in the order of measuring, or columns v_J",
    "gravity": "no joint of this robot carries gravity, or it has loops",
    "eccentric": "this robot has no actuated joint that turns",
    "coupling": "this robot has one actuated joint",
}
"""Why a tree cannot have an addition."""


class Family(Protocol):
    """All models of one robot."""

    @property
    def structures(self) -> tuple[str, ...]:
        """Structures, smallest first."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """Actuated joints."""
        ...

    @property
    def screened(self) -> tuple[str, ...]:
        """Additions that residuals may ask for."""
        ...

    def spec(self, name: str) -> Spec:
        """Read a model's name."""
        ...

    def can_have(self, addition: str) -> tuple[str, ...]:
        """Return the joints that an addition makes sense for."""
        ...

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model."""
        ...


class TreeFamily:
    """All models of a robot that is a tree, with or without loops.

    Its file's dimensions, or all of them free; joints that are coupled, yield to gravity, turn eccentrically or have backlash.
    """

    structures = ("frames", "complete")
    screened = ("backlash", "gravity", "eccentric", "coupling")

    def __init__(self, robot: Robot, poses: PoseSet) -> None:
        """Look at the mechanism and at how far the poses travel."""
        self.robot, self.poses = robot, poses
        self.joints = robot.actuated
        self.tree = build_tree_geometry(robot)

    def spec(self, name: str) -> Spec:
        """Read a model's name, such as `complete+gravity+eccentric:j2,j3`.

        Raises:
            UnknownName: No such structure, addition or joint.
            InputError: An addition that this robot or these poses cannot have.
        """
        first, *rest = name.split("+")
        known = [*self.structures, *BETWEEN_CAMPAIGNS, *self.screened]
        if first.partition(":")[0] in known[len(self.structures) :]:
            first, rest = "complete", [first, *rest]
        if first not in self.structures:
            raise UnknownName("model", first, known)
        spec = Spec(first)
        for part in rest:
            addition, _, joints = part.partition(":")
            if addition not in known[len(self.structures) :]:
                raise UnknownName("addition to a model", addition, known[len(self.structures) :])
            can = self.can_have(addition)
            if not can:
                raise InputError("unsupported", f"{part}: {_WHY_NOT.get(addition, _WHY_NOT['base_frame'])}")
            if addition == "coupling" and not joints:
                raise InputError("bad_option", "coupling needs its joints, such as complete+coupling:j3/j2")
            wanted = joints.split(",") if joints else can
            for joint in wanted:
                if joint.replace("=-", "/").replace("=", "/") not in can:
                    raise UnknownName(f"place of {addition}", joint, can)
            spec = spec.plus(addition, wanted)
        return spec

    def can_have(self, addition: str) -> tuple[str, ...]:
        """Return the joints that an addition makes sense for; of couplings the pairs `JOINT/OTHER`."""
        if addition in BETWEEN_CAMPAIGNS:
            return list_between_campaigns(addition, self.poses)
        if addition == "backlash":
            return self.joints if self.poses.approach.any() else ()
        if addition == "eccentric":
            units = zip(self.joints, self.robot.position_units, strict=True)
            return tuple(joint for joint, unit in units if unit == "rad")
        if addition == "gravity":
            return tuple(self._gravity_laws)
        return tuple(f"{a}/{b}" for a in self.joints for b in self.joints if a != b) if addition == "coupling" else ()

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model."""
        laws: list[JointLaw] = [self._coupling(text) for text in spec.additions.get("coupling", ())]
        laws += [self._gravity_laws[joint] for joint in spec.additions.get("gravity", ())]
        laws += [EccentricityLaw(joint, self.joints.index(joint)) for joint in spec.additions.get("eccentric", ())]
        geometry = ArmGeometry(self.tree, tuple(laws)) if laws else self.tree
        return (
            constrain_parameters(geometry, {}, self.tree.parameters.names) if spec.structure == "frames" else geometry
        )

    @cached_property
    def _gravity_laws(self) -> dict[str, GravityLaw]:
        """The laws of the joints that carry gravity; none of a robot with loops, whose loads this does not compute."""
        if self.tree.shape.n_loops:
            return {}
        low, high = self.poses.q.min(axis=0), self.poses.q.max(axis=0)
        return {law.joint: law for law in build_gravity_laws(self.tree, self.joints, low, high)}

    def _coupling(self, text: str) -> CouplingLaw:
        """Return the law of `JOINT/OTHER`, `JOINT=OTHER` or `JOINT=-OTHER`."""
        joint, sign, other = re.split("(/|=-|=)", text, maxsplit=1)
        ratio = {"/": 0.0, "=": 1.0, "=-": -1.0}[sign]
        return CouplingLaw(joint, self.joints.index(joint), other, self.joints.index(other), ratio)


def get_family(robot: Robot, poses: PoseSet) -> Family:
    """Return the models that a robot's mechanism offers."""
    try:
        return RodFamily(build_rods(robot), poses)
    except NotRods:
        return TreeFamily(robot, poses)
