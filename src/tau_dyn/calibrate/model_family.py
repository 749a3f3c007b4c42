"""Names of models, and the part that is common to all mechanisms: the additions that a robot and its poses can have."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.laws import JointLoading, StaticForces
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses

ADDITIONS = (
    "base_frame", "tool_frame", "coupling", "periodic", "periodic2", "piecewise", "compliant", "gravity", "elastic", "eccentric",
    "backlash", "delay",
)  # fmt: skip
BETWEEN_CAMPAIGNS = ("base_frame", "tool_frame")
OF_WHOLE = (*BETWEEN_CAMPAIGNS, "delay")
"""Additions of the whole robot, not of a joint."""


@dataclass(frozen=True, eq=False)
class Spec:
    """A model, before it is fitted.

    Attributes:
        structure: Which dimensions are free.
        additions: Addition -> joints that have it.
    """

    structure: str
    additions: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def name_for(self, joints: Sequence[str]) -> str:
        """Return the model's name; `joints` are all joints that can have additions."""
        parts = [self.structure]
        for addition in ADDITIONS:
            own = self.additions.get(addition, ())
            if own:
                parts.append(
                    addition if addition in OF_WHOLE or set(own) == set(joints) else f"{addition}:{','.join(own)}"
                )
        return "+".join(parts)

    def plus(self, addition: str, joints: Sequence[str]) -> Spec:
        """Return the model with an addition at more joints."""
        own = dict(self.additions)
        own[addition] = tuple(dict.fromkeys((*own.get(addition, ()), *joints)))
        return Spec(self.structure, own)


WHY_NOT = {
    "base_frame": "there is one campaign only; a column `campaign` separates several",
    "tool_frame": "there is one campaign only; a column `campaign` separates several",
    "backlash": "the side from which the joints came is unknown; give poses in the order of measuring, or columns v_J",
    "delay": "the speed of the joints is unknown; give columns v_J",
    "gravity": "no joint of this robot carries gravity, or it has loops; drives in loops have elastic",
    "elastic": "no load on a drive varies over these poses: the robot file has no masses, and the poses no loads",
    "eccentric": "this robot has no actuated joint that turns",
    "coupling": "this robot has one actuated joint",
}
"""Why a robot cannot have an addition."""


class Family(ABC):
    """All models of one robot.

    Attributes:
        structures: Structures, smallest first.
        joints: Actuated joints.
        poses: Measured poses, which give campaigns, travel and approach.
        screened: Additions that are tested on the residuals.
        known: Additions that a name may have.
        place: Word for a place of an addition in messages.
    """

    structures: tuple[str, ...]
    joints: tuple[str, ...]
    poses: PoseSet
    screened: tuple[str, ...]
    known: tuple[str, ...]
    place: str

    def spec(self, name: str) -> Spec:
        """Read a model's name, such as `complete+gravity+eccentric:j2,j3`.

        Raises:
            UnknownName: No such structure, addition or joint.
            InputError: An addition that this robot or these poses cannot have.
        """
        first, *rest = name.split("+")
        if first.partition(":")[0] in self.known:
            first, rest = "complete" if "complete" in self.structures else self.structures[-1], [first, *rest]
        if first == "mixed":
            raise InputError(
                "bad_option",
                "mixed is what auto finds when joints differ; name additions by joint, such as complete+periodic:cart2",
            )
        if first not in self.structures:
            raise UnknownName("model", first, [*self.structures, *self.known])
        spec = Spec(first)
        for part in rest:
            addition, _, joints = part.partition(":")
            if addition not in self.known:
                raise UnknownName("addition to a model", addition, self.known)
            can = self.can_have(addition)
            if not can:
                raise InputError("unsupported", f"{part}: {self.why_not(addition)}")
            if addition == "coupling" and not joints:
                raise InputError("bad_option", "coupling needs its joints, such as complete+coupling:j3/j2")
            wanted = joints.split(",") if joints else can
            for joint in wanted:
                if joint.replace("=-", "/").replace("=", "/") not in can:
                    raise UnknownName(f"{self.place} {addition}", joint, can)
            spec = spec.plus(addition, wanted)
        return spec

    def can_have(self, addition: str) -> tuple[str, ...]:
        """Return the joints that can have an addition; for couplings the pairs `JOINT/OTHER`."""
        if addition in BETWEEN_CAMPAIGNS:  # separate targets have their own frames anyway
            own = addition == "tool_frame" and len(self.poses.targets) > 1
            several = len(self.poses.devices) > 1  # each of which has a frame of its own in every campaign
            return ("all",) if len(self.poses.campaigns) > 1 and not own and not several else ()
        if addition == "backlash":
            return self.joints if self.poses.approach.any() else ()
        if addition == "delay":
            return ("all",) if self.poses.speed.any() else ()
        return self.places(addition)

    def why_not(self, addition: str) -> str:
        """Return why no joint can have an addition."""
        return WHY_NOT[addition]

    def move_with_base(self, q: np.ndarray, base: Poses) -> np.ndarray:
        """Return the tool's twists (N, 6, k) of a base that turns in proportion to the robot's weight; k = 0 unless overridden.

        Args:
            q: Actuated positions (N, na).
            base: Tool poses there (N) in the robot's base frame.
        """
        return np.zeros((len(q), 6, 0))

    @property
    @abstractmethod
    def nominal(self) -> Geometry:
        """The robot file's geometry, all dimensions free."""

    @cached_property
    def loading(self) -> JointLoading:
        """Loads of each joint over the poses."""
        low, high = self.poses.q.min(axis=0), self.poses.q.max(axis=0)
        return JointLoading(StaticForces(self.nominal), low, high, self.poses.loads)

    @abstractmethod
    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints that can have an addition of this mechanism."""

    @abstractmethod
    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model; `periods` are starting values of cyclic errors by joint."""
