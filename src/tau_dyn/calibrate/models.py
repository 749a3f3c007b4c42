r"""The models that a mechanism offers: a structure (which dimensions move together) and additions (what drives do besides).

Structures of a parallel robot of points and distances, each where it means something else than the ones before:

    frames       the robot file's dimensions; only the device's frame and the target's place are fitted
    ideal        one length, one cart point an arm; guideways in one common direction (thesis (5.2): 15 parameters)
    nonparallel  the same with a direction for each guideway (21 parameters), models 1 and 2 of thesis 5.3
    complete     every rod with its own length and both ends, every joint with its own place and direction (thesis
                 (4.14), 5.4)
    paths        complete, and every rod's end on its own straight path (model 3 of thesis 5.3)

Additions: `periodic` (cyclic errors of the drives; `periodic2` a second one of another period), `piecewise` (crooked
guideways), `compliant` (carts and drives yield to gravity), `backlash`, and between campaigns `base_frame` (the
device or the robot was moved) and `tool_frame` (the target was). Those of a tree are `coupling`, `gravity` and `eccentric`
(`laws.py`, `gravity.py`). A model is written `complete+periodic+compliant`; an addition may name joints:
`nonparallel+periodic:cart2,cart3`, the per-arm mix of thesis 5.3 (model 5). `coupling:j3/j2` adds a share of j2 to j3,
`coupling:j3=j2` and `coupling:j3=-j2` all of it.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tau_dyn.calibrate.geometry import Geometry, constrain_parameters
from tau_dyn.calibrate.gravity import ArmGeometry, GravityLaw, RodLoads, build_gravity_laws, compute_gravity_moments
from tau_dyn.calibrate.joint_laws import (
    CartComplianceLaw,
    CouplingLaw,
    DriveComplianceLaw,
    EccentricityLaw,
    GuideBendLaw,
    Law,
    PeriodicDriveLaw,
    RodPathLaw,
    find_carried_rods,
    find_guideways,
)
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import NotRods, Poses, Rods, build_rods
from tau_dyn.robot import Robot

ADDITIONS = (
    "base_frame", "tool_frame", "coupling", "periodic", "periodic2", "piecewise", "compliant", "gravity", "eccentric", "backlash",
    "delay",
)  # fmt: skip
BETWEEN_CAMPAIGNS = ("base_frame", "tool_frame")
OF_WHOLE = (*BETWEEN_CAMPAIGNS, "delay")
"""Additions that no joint has by itself."""
_KNOTS = 9  # along a guideway: waves of a quarter of the travel still have a shape
_PERIOD = 0.1  # [m]: where a search has nothing better to start from


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
        """Return the model's name, where `joints` could all have additions."""
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


_WHY_NOT = {
    "base_frame": "there is one campaign only; a column `campaign` tells several apart",
    "tool_frame": "there is one campaign only; a column `campaign` tells several apart",
    "backlash": "nothing tells from which side the joints came; give poses in the order of measuring, or columns v_J",
    "delay": "nothing tells how fast the joints moved; give columns v_J",
    "gravity": "no joint of this robot carries gravity, or it has loops",
    "eccentric": "this robot has no actuated joint that turns",
    "coupling": "this robot has one actuated joint",
}
"""Why a robot cannot have an addition."""


class Family(ABC):
    """All models of one robot.

    Attributes:
        structures: Structures, smallest first.
        joints: Actuated joints.
        poses: Measured poses, which tell campaigns, travel and approach.
        screened: Additions that residuals may ask for.
        known: Additions that a name may have.
        place: What messages call a place of an addition.
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
        """Return the joints that an addition makes sense for; of couplings the pairs `JOINT/OTHER`."""
        if addition in BETWEEN_CAMPAIGNS:  # targets that are told apart have their own frames anyway
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
        return _WHY_NOT[addition]

    def move_with_base(self, q: np.ndarray, base: Poses) -> np.ndarray:
        """Return the tool's twists (N, 6, k) of a base that turns in proportion to the robot's weight; none unless overridden.

        Args:
            q: Actuated positions (N, na).
            base: Tool poses there (N) in the robot's base frame.
        """
        return np.zeros((len(q), 6, 0))

    @abstractmethod
    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints that an addition of this mechanism makes sense for."""

    @abstractmethod
    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model; `periods` are starting values of cyclic errors by joint."""


class RodFamily(Family):
    """All models of one parallel robot."""

    screened = ("backlash", "periodic", "periodic2", "compliant", "piecewise", "delay")
    known = ADDITIONS
    place = "joint that can be"

    def __init__(self, rods: Rods, poses: PoseSet) -> None:
        """Look at the mechanism and at how far the poses travel."""
        self.rods, self.poses = rods, poses
        self.joints = rods.robot.actuated
        self.slides = find_guideways(rods)
        self.rails = tuple(self.joints[a] for a in self.slides)
        self.loads = RodLoads(rods)
        self.structures = self._structures()

    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints on guideways, for what guideways and their drives do."""
        if addition == "compliant" and not self.loads.plate_mass > 0:
            return ()
        return self.rails if addition in self.screened else ()

    def why_not(self, addition: str) -> str:
        """Return why no joint can have an addition."""
        if addition == "compliant" and self.rails:
            return "the robot file gives the plate no mass, so no loads are known"
        general = addition == "backlash" or addition in OF_WHOLE
        return _WHY_NOT[addition] if general else "this robot has no guideways that stand on its base"

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model; `periods` are starting values of cyclic errors by joint."""
        drifts = self._drifts() if spec.structure == "paths" else []
        return self._tied(RodGeometry(self.rods, (*self._laws(spec, periods or {}), *drifts)), spec.structure)

    def _structures(self) -> tuple[str, ...]:
        if not self.rails:
            return ("frames", "complete")
        found = ["frames"]
        several = len(self.rods.names) > len(self.joints)
        if len(self.rails) > 1:
            found.append("ideal")
        if self.rods.numbers.arms:
            return (*found, "nonparallel")
        if several and all(j.slides and j.parent < 0 for j in self.rods.numbers.joints):
            found.append("nonparallel")
        found.append("complete")
        if several and self._drifts():
            found.append("paths")
        return tuple(found)

    def _laws(self, spec: Spec, periods: dict[str, float]) -> list[Law]:
        """Return the laws of drives, then those of guideways."""
        drives: list[Law] = []
        guides: list[Law] = []
        for addition, label in (("periodic", ""), ("periodic2", "2")):
            for joint in spec.additions.get(addition, ()):
                drives.append(
                    PeriodicDriveLaw(joint, self.joints.index(joint), periods.get(joint + label, _PERIOD), label)
                )
        for joint in spec.additions.get("compliant", ()):
            a, direction = self._rail(joint)
            drives.append(DriveComplianceLaw(joint, a, direction, self.loads))
            guides.append(CartComplianceLaw(joint, a, find_carried_rods(self.rods, a), direction, self.loads))
        for joint in spec.additions.get("piecewise", ()):
            a, _ = self._rail(joint)
            x = self.poses.q[:, a]
            knots = np.linspace(x.min() - 1e-6, x.max() + 1e-6, _KNOTS)
            guides.append(GuideBendLaw(joint, a, find_carried_rods(self.rods, a), knots))
        return [*drives, *guides]

    def _rail(self, joint: str) -> tuple[int, np.ndarray]:
        a = self.joints.index(joint)
        d = next(j.direction for j in self.rods.numbers.joints if j.actuator == a)
        return a, d / np.linalg.norm(d)

    def _drifts(self) -> list[RodPathLaw]:
        found, joints = [], self.rods.numbers.joints
        for k, carrier in enumerate(self.rods.numbers.carried.carrier):
            if carrier >= 0 and joints[carrier].slides:
                found.append(RodPathLaw(self.rods.names[k], (k,), joints[carrier].actuator))
        return found

    def _tied(self, base: RodGeometry, structure: str) -> Geometry:
        names = base.parameters.names
        own = [p for p in self.rods.geometry.names if p in names] + [n for n in names if ".turn_" in n]
        if structure == "frames":
            return constrain_parameters(base, {}, own)
        if structure in ("complete", "paths"):
            return constrain_parameters(base, {}, self._superfluous(structure))
        together: dict[str, list[str]] = {}
        if structure == "ideal":
            together |= self._one_direction()
        if self.rods.numbers.arms:
            return constrain_parameters(base, together)
        if structure == "ideal" and not self._simplifies():
            return constrain_parameters(base, together)
        lengths, left_out = self._one_arm_a_cart()
        return constrain_parameters(base, together | lengths, left_out)

    def _superfluous(self, structure: str) -> list[str]:
        """Return parameters that others say already: a slide's place where its rods are free, a turn's on a slide."""
        joints = self.rods.numbers.joints
        if self.rods.numbers.arms:
            return []
        carrying = {c for c in self.rods.numbers.carried.carrier if c >= 0}
        placed = [j.name for k, j in enumerate(joints) if j.slides and k in carrying]
        placed += [j.name for j in joints if not j.slides and j.parent >= 0 and joints[j.parent].slides]
        out = [f"{name}.origin_{a}" for name in placed for a in "xyz"]
        if structure == "paths":  # each rod has a direction of its own
            out += [f"{joints[k].name}.direction_{a}" for k in carrying if joints[k].slides for a in "xyz"]
        return out

    def _simplifies(self) -> bool:
        return "nonparallel" in self.structures

    def _one_direction(self) -> dict[str, list[str]]:
        owners = [j.name for j in self.rods.numbers.joints if j.slides and j.parent < 0]
        if self.rods.numbers.arms:
            owners = list(self.rods.numbers.arms)
        return {f"guideways.direction_{a}": [f"{o}.direction_{a}" for o in owners] for a in "xyz"}

    def _one_arm_a_cart(self) -> tuple[dict[str, list[str]], list[str]]:
        """Return ties that keep the rods of a cart parallel and equally long: lengths together, ends where they are."""
        joints = self.rods.numbers.joints
        lengths: dict[str, list[str]] = {}
        left_out = []
        for name, carrier in zip(self.rods.names, self.rods.numbers.carried.carrier, strict=True):
            lengths.setdefault(f"{joints[carrier].name}.rods_length", []).append(f"{name}.length")
            left_out += [f"{name}.{what}_{a}" for what in ("base", "plate") for a in "xyz"]
        return lengths, left_out


class TreeFamily(Family):
    """All models of a robot that is a tree, with or without loops.

    Its file's dimensions, or all of them free; joints that are coupled, yield to gravity, turn eccentrically,
    have backlash or were read at another time than the tool.
    """

    structures = ("frames", "complete")
    screened = ("backlash", "gravity", "eccentric", "coupling", "delay")
    known = (*BETWEEN_CAMPAIGNS, *screened)
    place = "place of"

    def __init__(self, robot: Robot, poses: PoseSet) -> None:
        """Look at the mechanism and at how far the poses travel."""
        self.robot, self.poses = robot, poses
        self.joints = robot.actuated
        self.tree = build_tree_geometry(robot)

    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints that turn, that carry gravity, or pairs of joints."""
        if addition == "eccentric":
            units = zip(self.joints, self.robot.position_units, strict=True)
            return tuple(joint for joint, unit in units if unit == "rad")
        if addition == "gravity":
            return tuple(self._gravity_laws)
        return tuple(f"{a}/{b}" for a in self.joints for b in self.joints if a != b) if addition == "coupling" else ()

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model."""
        laws: list[Law | GravityLaw] = [self._coupling(text) for text in spec.additions.get("coupling", ())]
        laws += [self._gravity_laws[joint] for joint in spec.additions.get("gravity", ())]
        laws += [EccentricityLaw(joint, self.joints.index(joint)) for joint in spec.additions.get("eccentric", ())]
        geometry = ArmGeometry(self.tree, tuple(laws)) if laws else self.tree
        return (
            constrain_parameters(geometry, {}, self.tree.parameters.names) if spec.structure == "frames" else geometry
        )

    def move_with_base(self, q: np.ndarray, base: Poses) -> np.ndarray:
        """Return the twists of a turn about each axis by each component of the moments of all masses and of a load."""
        if self.tree.shape.n_loops:
            return super().move_with_base(q, base)
        gravity = np.asarray(self.robot.model.gravity.linear)
        moments = compute_gravity_moments(self.tree, q).base_moments(gravity).reshape(len(q), 1, -1)
        turns = np.broadcast_to(np.eye(3), (len(q), 3, 3))  # rows are axes
        twists = np.concatenate([np.cross(turns, base.position[:, None]), turns], axis=2)
        return np.concatenate([twists[:, axis, :, None] * moments for axis in range(3)], axis=2)

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
    if poses.of_encoders.any():  # passive joints are those of the tree
        return TreeFamily(robot, poses)
    try:
        return RodFamily(build_rods(robot), poses)
    except NotRods:
        return TreeFamily(robot, poses)
