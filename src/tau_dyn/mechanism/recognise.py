r"""Rods read from a robot's tree: which body is the plate, which links are rods, between which points.

The plate hangs on the world by passive joints alone: three slides (it translates) or six freedoms. A rod hangs on an
actuated chain, the world or the plate by passive turns through one point, and is tied at its other end by a ball:

    two or three turns        one distance, from the point of the turns to the ball;
    one turn (a triangle)     two distances, from two points of its axis: the ball moves on a circle, where two spheres meet;
    an actuated slide after   the distance grows with the slide (a leg of the Stewart platform, a telescopic arm).

Everything is seen at home, where the loops are closed. Reference: thesis (4.3), (4.4), section 2.2; Merlet 2006, ch. 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.robot import Robot

_MEET = 1e-9  # [m] by how much lines may miss each other's point


class NotRods(InputError):
    """The mechanism is no plate held by rods between actuated chains."""

    def __init__(self, sentence: str) -> None:
        """Build it from its sentence."""
        super().__init__("unsupported", sentence)


@dataclass(frozen=True, eq=False)
class RodFound:
    """One distance.

    Attributes:
        name: Of the rod.
        carrier: Joint of the chain that carries A, 0 for the world.
        base: A in that joint's frame (3,) [m].
        plate: B in the plate's frame (3,) [m].
        length: At home's positions but with the leg's slide at zero [m].
        slide: Joint of an actuated slide in the rod, 0 for none.
        offset: How far the slide's line misses the rod's first point [m].
        gain: 1 where the slide lengthens the rod, -1 where it shortens it.
    """

    name: str
    carrier: int
    base: np.ndarray
    plate: np.ndarray
    length: float
    slide: int = 0
    offset: float = 0.0
    gain: float = 1.0


@dataclass(frozen=True, eq=False)
class Found:
    """All that was recognised.

    Attributes:
        rods: Distances.
        plate: The plate's joint.
        translates: Whether the plate keeps its rotation.
        home: Placement of the plate at home.
        tool: The tool frame in the plate's.
    """

    rods: tuple[RodFound, ...]
    plate: int
    translates: bool
    home: pin.SE3
    tool: pin.SE3


def recognise(robot: Robot) -> Found:
    """Read plate and rods from a robot's tree.

    Raises:
        NotRods: The mechanism is of another kind; the message says what does not fit.
        LoopClosureError: The loops cannot be closed at home.
    """
    if not robot.loops:
        raise NotRods(f"{robot.source}: there are no loops, so no plate held by rods")
    tree = _Tree(robot)
    plate = tree.plate()
    translates = tree.check_plate(plate)
    rods = [rod for loop in robot.loops for rod in tree.rods(plate, loop.frame_a, loop.frame_b)]
    rods = _renamed(rods)
    moved = {j for rod in rods for j in (*tree.path(rod.carrier), rod.slide)}
    idle = [name for name, joint in zip(robot.actuated, tree.actuated, strict=True) if joint not in moved]
    if idle:
        raise NotRods(f"{robot.source}: {', '.join(idle)} moves no rod")
    if len(rods) < (3 if translates else 6):
        raise NotRods(f"{robot.source}: {len(rods)} distances cannot hold a plate of {3 if translates else 6} freedoms")
    return Found(tuple(rods), plate, translates, tree.placement(plate), tree.tool(plate))


class _Tree:
    """A robot's joints at home."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.model = robot, robot.model
        self.data = self.model.createData()
        q = LoopSolver(robot).close(robot.home)
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        self.q = q
        self.actuated = [self.model.getJointId(j) for j in robot.actuated]

    def path(self, joint: int) -> list[int]:
        return self.model.supports[joint].tolist()[1:]

    def placement(self, joint: int) -> pin.SE3:
        return pin.SE3(self.data.oMi[joint])

    def is_chain(self, joint: int) -> bool:
        """Whether a body is the world or moved by actuated joints alone."""
        return all(j in self.actuated for j in self.path(joint))

    def plate(self) -> int:
        """Return the joint of the body on which all passive sides of the loops meet."""
        common: list[int] | None = None
        for loop in self.robot.loops:
            sides = [self.model.frames[f].parentJoint for f in (loop.frame_a, loop.frame_b)]
            passive = [s for s in sides if s and not any(j in self.actuated for j in self.path(s))]
            if len(passive) != 1:
                raise NotRods(f"{self.robot.source}: loop {loop.name} does not lie between a plate and a driven chain")
            way = self.path(passive[0])
            common = way if common is None else [j for j in common if j in way]
        if not common:
            raise NotRods(f"{self.robot.source}: its loops do not meet on one plate")
        return common[-1]

    def check_plate(self, plate: int) -> bool:
        """Return whether the plate translates only; refuse what is neither that nor free."""
        joints = [self.model.joints[j] for j in self.path(plate)]
        columns = [np.arange(j.idx_v, j.idx_v + j.nv) for j in joints]
        J = np.reshape(self.data.J, (6, -1))[:, np.concatenate(columns)]
        rank = np.linalg.matrix_rank(J, tol=1e-6)
        if J.shape[1] == 3 and np.abs(J[3:]).max() < 1e-12 and rank == 3:
            return True
        if J.shape[1] == 6 and rank == 6:
            return False
        raise NotRods(
            f"{self.robot.source}: its plate has {J.shape[1]} freedoms of rank {rank}; a plate held by rods has three "
            "slides or six freedoms"
        )

    def tool(self, plate: int) -> pin.SE3:
        index = self.robot.tool_frame
        if index is None:
            return pin.SE3.Identity()
        frame = self.model.frames[index]
        if frame.parentJoint != plate:
            raise NotRods(f"{self.robot.source}: its tool does not sit on the plate")
        return pin.SE3(frame.placement)

    def rods(self, plate: int, frame_a: int, frame_b: int) -> list[RodFound]:
        """Return the distances that one loop keeps."""
        ends = [self.model.frames[f] for f in (frame_a, frame_b)]
        hanging = [end for end in ends if end.parentJoint != plate and not self.is_chain(end.parentJoint)]
        if len(hanging) != 1:
            raise NotRods(f"{self.robot.source}: a loop ties plate and chain without a rod between them")
        rod, tied = hanging[0], next(end for end in ends if end is not hanging[0])
        joints = self._between(rod.parentJoint, plate)
        root = self.model.parents[joints[0]]
        slide = joints.pop() if joints[-1] in self.actuated else 0
        name = self._name(rod.parentJoint)
        tip = (self.data.oMi[rod.parentJoint] * rod.placement).translation
        found = []
        hinges = self._hinges(joints, tip, name)
        for k, hinge in enumerate(hinges):
            length, offset, gain = self._length(hinge, tip, slide)
            base, far = (root, hinge), (tied.parentJoint, tip)
            if root == plate:
                base, far = far, base
            if not self.is_chain(base[0]) or far[0] != plate:
                raise NotRods(f"{self.robot.source}: rod {name} does not reach from a driven chain to the plate")
            suffix = f"_{k + 1}" if len(hinges) > 1 else ""
            A, B = (self.data.oMi[j].actInv(p) for j, p in (base, far))
            found.append(RodFound(name + suffix, base[0], A, B, length, slide, offset, gain))
        return found

    def _between(self, joint: int, plate: int) -> list[int]:
        """Return the joints of a rod, from the body it hangs on: passive turns, then perhaps an actuated slide."""
        joints: list[int] = []
        while joint != plate and not self.is_chain(joint):
            joints.insert(0, joint)
            joint = self.model.parents[joint]
        for k, j in enumerate(joints):
            kind = self.model.joints[j].shortname()
            turns = kind.startswith(("JointModelR", "JointModelSpherical")) and j not in self.actuated
            slides = kind.startswith("JointModelP") and self.model.joints[j].nv == 1 and j in self.actuated
            if not (turns or (slides and k == len(joints) - 1 and k > 0)):
                raise NotRods(
                    f"{self.robot.source}: joint '{self.model.names[j]}' is neither a passive turn at a rod's end nor an "
                    "actuated slide along it"
                )
        return joints

    def _hinges(self, joints: list[int], tip: np.ndarray, name: str) -> list[np.ndarray]:
        """Return the fixed points [m] from which a rod's tip keeps its distance."""
        J = np.reshape(self.data.J, (6, -1))
        columns = np.concatenate([np.arange(self.model.joints[j].idx_v, self.model.joints[j].idx_v + self.model.joints[j].nv)
                                  for j in joints])  # fmt: skip
        axes = J[3:, columns].T
        origins = np.cross(axes, J[:3, columns].T)  # the points of the axes nearest to the world's origin
        if len(axes) == 1:
            foot = origins[0] + axes[0] * (axes[0] @ (tip - origins[0]))
            radius = float(np.linalg.norm(tip - foot))
            return [foot - radius * axes[0], foot + radius * axes[0]]
        A = np.concatenate([np.eye(3) - np.outer(a, a) for a in axes])
        b = np.concatenate([o - a * (a @ o) for a, o in zip(axes, origins, strict=True)])
        meet, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-9)
        if rank < 3 or np.abs(A @ meet - b).max() > _MEET:
            raise NotRods(f"{self.robot.source}: the turns of rod {name} do not meet in one point")
        reach = np.cross(axes, tip - meet)
        if np.linalg.matrix_rank(reach, tol=1e-6 * np.linalg.norm(tip - meet)) < 2:
            raise NotRods(f"{self.robot.source}: the turns of rod {name} do not let it point everywhere")
        return [meet]

    def _length(self, hinge: np.ndarray, tip: np.ndarray, slide: int) -> tuple[float, float, float]:
        """Return a rod's length with its slide at zero, how far the slide's line misses the hinge, and the slide's sense."""
        d = tip - hinge
        if not slide:
            return float(np.linalg.norm(d)), 0.0, 1.0
        item = self.model.joints[slide]
        axis = np.reshape(self.data.J, (6, -1))[:3, item.idx_v]
        gain = 1.0 if axis @ d > 0 else -1.0
        d = d - axis * self.q[item.idx_q]
        offset = float(np.linalg.norm(d - axis * (axis @ d)))
        if gain * (axis @ d) < -_MEET:
            raise NotRods(
                f"{self.robot.source}: slide '{self.model.names[slide]}' at zero stands behind its rod's hinge"
            )
        return float(np.linalg.norm(d)), offset if offset > _MEET else 0.0, gain

    def _name(self, joint: int) -> str:
        for frame in self.model.frames:
            if frame.parentJoint == joint and frame.type == pin.FrameType.BODY:
                return frame.name.removesuffix("_link")
        return self.model.names[joint]


def _renamed(rods: list[RodFound]) -> list[RodFound]:
    """Return rods whose names differ: a link with several balls numbers them."""
    names = [rod.name for rod in rods]
    out = []
    for k, rod in enumerate(rods):
        several = names.count(rod.name) > 1
        name = f"{rod.name}_{names[:k].count(rod.name) + 1}" if several else rod.name
        out.append(replace(rod, name=name))
    return out
