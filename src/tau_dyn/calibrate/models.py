r"""Models of a mechanism: a structure (which dimensions move together) and additions (other effects, such as those of drives).

Structures of a parallel robot of points and distances; one that is equal to an earlier one is left out:

    frames       the robot file's dimensions; only the device's frame and the target's place are fitted
    ideal        one length, one cart point an arm; guideways in one common direction (thesis (5.2): 15 parameters)
    nonparallel  the same with a direction for each guideway (21 parameters), models 1 and 2 of thesis 5.3
    complete     every rod with its own length and both ends, every joint with its own place and direction (thesis
                 (4.14), 5.4)
    paths        complete, and every rod's end on its own straight path (model 3 of thesis 5.3)

Additions: `periodic` (cyclic errors of the drives; `periodic2` a second one of another period), `piecewise` (crooked
guideways), `compliant` (elastic carts and drives on guideways), `elastic` (elastic drives), `backlash`, and between campaigns
`base_frame` (the device or the robot was moved) and `tool_frame` (the target was). Those of a tree are `coupling`, `gravity`,
`elastic` and `eccentric` (`laws/`). A model is written `complete+periodic+compliant`; an addition may name joints:
`nonparallel+periodic:cart2,cart3`, the per-arm mix of thesis 5.3 (model 5). `coupling:j3/j2` adds a share of j2 to j3,
`coupling:j3=j2` and `coupling:j3=-j2` all of it.
"""

from __future__ import annotations

import re
from functools import cached_property

import numpy as np

from tau_dyn.calibrate.geometry import Geometry, constrain_parameters
from tau_dyn.calibrate.laws import (
    CartComplianceLaw,
    CouplingLaw,
    DisplacedGeometry,
    EccentricityLaw,
    EncoderLaws,
    GuideBendLaw,
    Law,
    PeriodicDriveLaw,
    RodLoads,
    RodPathLaw,
    find_carried_rods,
    find_guideways,
)
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.model_family import ADDITIONS, BETWEEN_CAMPAIGNS, OF_WHOLE, WHY_NOT, Family, Spec
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.mechanism import NotRods, Poses, Rods, build_rods
from tau_dyn.robot import Robot

_KNOTS = 9  # along a guideway: waves of a quarter of the travel still have a shape
_PERIOD = 0.1  # [m]: default start of a search


class RodFamily(Family):
    """All models of one parallel robot."""

    screened = ("backlash", "periodic", "periodic2", "elastic", "compliant", "piecewise", "delay")
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

    @cached_property
    def nominal(self) -> Geometry:  # type: ignore[override]
        """The robot file's rods."""
        return RodGeometry(self.rods)

    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints on guideways for the effects of guideways and their drives, and the elastic drives.

        Without known loads a drive on a guideway is elastic together with its cart, as `compliant`.
        """
        if addition == "elastic":
            alone = self.joints if self.poses.loads.any() else tuple(j for j in self.joints if j not in self.rails)
            return tuple(joint for joint in self.loading.list_varying() if joint in alone) if alone else ()
        if addition == "compliant" and not self.loads.plate_mass > 0:
            return ()
        return self.rails if addition in self.screened else ()

    def why_not(self, addition: str) -> str:
        """Return why no joint can have an addition."""
        if addition == "compliant" and self.rails:
            return "the robot file gives the plate no mass, so no loads are known"
        if addition == "elastic" and self.rails and not self.poses.loads.any():
            return "without known loads drives on guideways yield together with their carts; use compliant"
        general = addition in ("backlash", "elastic") or addition in OF_WHOLE
        return WHY_NOT[addition] if general else "this robot has no guideways on its base"

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model; `periods` are starting values of cyclic errors by joint."""
        drifts = self._drifts() if spec.structure == "paths" else []
        geometry = RodGeometry(self.rods, (*self._laws(spec, periods or {}), *drifts))
        elastic, compliant = (spec.additions.get(addition, ()) for addition in ("elastic", "compliant"))
        names = dict.fromkeys((*compliant, *elastic), "drive_compliance")
        # without known loads, carts and drives on guideways take masses as they are in the file (thesis 5.3)
        known = not elastic and not self.poses.loads.any()
        drives = self.loading.build(names, load_known=True, masses_known=known) if names else None
        return self._tied(geometry if drives is None else DisplacedGeometry(geometry, drives), spec.structure)

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

    def _tied(self, base: Geometry, structure: str) -> Geometry:
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
        """Return redundant parameters: the place of a slide whose rods are free, the place of a rotary joint on a slide."""
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
    known = (*BETWEEN_CAMPAIGNS, "backlash", "gravity", "elastic", "eccentric", "coupling", "delay")
    place = "place of"

    def __init__(self, robot: Robot, poses: PoseSet) -> None:
        """Look at the mechanism and at how far the poses travel."""
        self.robot, self.poses = robot, poses
        self.joints = robot.actuated
        self.tree = build_tree_geometry(robot)
        # loads at the tool are known with loops, where it is a plate in the file, and where poses state them
        self.loads_known = bool(self.tree.shape.n_loops or poses.loads.any())
        yields = "elastic" if self.loads_known else "gravity"
        self.screened = ("backlash", yields, "eccentric", "coupling", "delay")

    @property
    def nominal(self) -> Geometry:
        """The robot file's tree."""
        return self.tree

    def places(self, addition: str) -> tuple[str, ...]:
        """Return the joints that turn, that carry gravity, or pairs of joints."""
        if addition == "eccentric":
            units = zip(self.joints, self.robot.position_units, strict=True)
            return tuple(joint for joint, unit in units if unit == "rad")
        if addition == "gravity":
            return () if self.tree.shape.n_loops else self.loading.list_carrying()
        if addition == "elastic":
            return self.loading.list_varying()
        return tuple(f"{a}/{b}" for a in self.joints for b in self.joints if a != b) if addition == "coupling" else ()

    def build(self, spec: Spec, periods: dict[str, float] | None = None) -> Geometry:
        """Return the geometry of a model."""
        geometry: Geometry = self.tree
        elastic, gravity = (spec.additions.get(addition, ()) for addition in ("elastic", "gravity"))
        names = dict.fromkeys(gravity, "gravity_compliance") | dict.fromkeys(elastic, "drive_compliance")
        if names:
            geometry = DisplacedGeometry(geometry, self.loading.build(names, load_known=not gravity))
        laws: list[Law] = [self._coupling(text) for text in spec.additions.get("coupling", ())]
        laws += [EccentricityLaw(joint, self.joints.index(joint)) for joint in spec.additions.get("eccentric", ())]
        geometry = DisplacedGeometry(geometry, EncoderLaws(tuple(laws))) if laws else geometry
        return (
            constrain_parameters(geometry, {}, self.tree.parameters.names) if spec.structure == "frames" else geometry
        )

    def move_with_base(self, q: np.ndarray, base: Poses) -> np.ndarray:
        """Return the twists of a turn about each axis by each component of the moments of all masses and of a load."""
        if self.tree.shape.n_loops:
            return super().move_with_base(q, base)
        statics = self.loading.statics
        moments = np.stack([np.cross(x, statics.gravity) for x in statics.weigh(q)], axis=2).reshape(len(q), 1, -1)
        turns = np.broadcast_to(np.eye(3), (len(q), 3, 3))  # rows are axes
        twists = np.concatenate([np.cross(turns, base.position[:, None]), turns], axis=2)
        return np.concatenate([twists[:, axis, :, None] * moments for axis in range(3)], axis=2)

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
