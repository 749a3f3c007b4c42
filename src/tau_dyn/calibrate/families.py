"""Which family of models a robot belongs to: rods between carts and a plate, or any other tree."""

from __future__ import annotations

from typing import Protocol

from tau_dyn.calibrate.geometry import Geometry, constrain_parameters
from tau_dyn.calibrate.models import BETWEEN_CAMPAIGNS, RodFamily, Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.kinematics.rods import NotRods, build_rods
from tau_dyn.robot import Robot


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
    """All models of a robot that is a tree, with or without loops: its file's dimensions, or all of them free; backlash."""

    structures = ("frames", "complete")

    def __init__(self, robot: Robot, poses: PoseSet) -> None:
        """Look at the mechanism."""
        self.robot, self.poses = robot, poses
        self.joints = robot.actuated
        self.geometry: Geometry = build_tree_geometry(robot)

    def spec(self, name: str) -> Spec:
        """Read a model's name: `frames` or `complete`, perhaps with `+backlash`."""
        first, *rest = name.split("+")
        if first not in self.structures:
            raise UnknownName("model", first, [*self.structures, "backlash"])
        spec = Spec(first)
        for part in rest:
            addition, _, joints = part.partition(":")
            can = self.can_have(addition)
            if not can:
                raise InputError(
                    "unsupported",
                    f"{part}: this robot's models take backlash alone, with poses that tell from which side joints came",
                )
            spec = spec.plus(addition, joints.split(",") if joints else can)
        return spec

    def can_have(self, addition: str) -> tuple[str, ...]:
        """Return the joints that can have backlash; other additions need guideways."""
        if addition in BETWEEN_CAMPAIGNS:
            return ("all",) if len(self.poses.campaigns) > 1 else ()
        return self.joints if addition == "backlash" and self.poses.approach.any() else ()

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model."""
        if spec.structure == "frames":
            return constrain_parameters(self.geometry, {}, self.geometry.parameters.names)
        return self.geometry


def get_family(robot: Robot, poses: PoseSet) -> Family:
    """Return the models that a robot's mechanism offers."""
    try:
        return RodFamily(build_rods(robot), poses)
    except NotRods:
        return TreeFamily(robot, poses)
