r"""Read the legs from a robot's tree: the plate, the rods and their end points.

The plate hangs on the world by passive joints alone (three slides: it translates; six freedoms), or on one of its own legs:
then the tool's body is the plate and the path to it is a leg like the others. A leg hangs on an actuated chain, the world or
the plate by passive turns through one point, and is tied at its other end by a ball (a cut loop, or three turns that meet):

    two or three turns        one distance, from the point of the turns to the ball;
    one turn (a triangle)     two distances, from two points of its axis: the ball moves on a circle, where two spheres meet;
    an actuated slide after   the distance grows with the slide (a leg of the Stewart platform, a telescopic arm).

The far hinge of a planar leg, whose ends are parallel hinges, counts as a ball; the other legs' circles keep the plate's plane.
If rods meet in the tool and hold it alone (a five-bar), the plate is that point and the tool turns with its rod.
Everything is seen at home, where the loops are closed. Reference: thesis (4.3), (4.4), section 2.2; Merlet 2006, ch. 2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.legs import Ride
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
        name: Name of the rod.
        carrier: Joint of the chain that carries A, 0 for the world.
        base: A in that joint's frame (3,) [m].
        plate: B in the plate's frame (3,) [m].
        length: Length at home's positions, but with the leg's slide at zero [m].
        slide: Joint of an actuated slide in the rod, 0 without a slide.
        offset: How far the slide's line misses the rod's first point [m].
        gain: 1 if the slide lengthens the rod, -1 if it shortens it.
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
        ride: The tool's turn with its rod where the plate is a point, else None.
        rerooted: Whether the plate hangs on one of its legs in the file.
    """

    rods: tuple[RodFound, ...]
    plate: int
    translates: bool
    home: pin.SE3
    tool: pin.SE3
    ride: Ride | None = None
    rerooted: bool = False


def recognise(robot: Robot) -> Found:
    """Read plate and rods from a robot's tree.

    Raises:
        NotRods: The mechanism is of another kind; the message names the mismatch.
        LoopClosureError: The loops cannot be closed at home.
    """
    if not robot.loops:
        raise NotRods(f"{robot.source}: there are no loops, so no plate held by rods")
    tree = _Tree(robot)
    try:
        plate = tree.plate()
        return _checked(robot, tree, Found(tree.loop_rods(plate), plate, tree.check_plate(plate), *tree.places(plate)))
    except NotRods as fault:
        plate = tree.plate_on_leg()
        if plate is None:
            raise
        try:
            return _checked(robot, tree, tree.point(plate) or tree.rerooted(plate))
        except NotRods:
            raise fault from None


def _checked(robot: Robot, tree: _Tree, found: Found) -> Found:
    """Return the result with distinct rod names; refuse a plate that the rods do not hold."""
    rods = _renamed(list(found.rods))
    moved = {j for rod in rods for j in (*tree.path(rod.carrier), rod.slide)}
    idle = [name for name, joint in zip(robot.actuated, tree.actuated, strict=True) if joint not in moved]
    if idle:
        raise NotRods(f"{robot.source}: {', '.join(idle)} moves no rod")
    if len(rods) < (3 if found.translates else 6):
        raise NotRods(
            f"{robot.source}: {len(rods)} distances cannot hold a plate of {3 if found.translates else 6} freedoms"
        )
    return replace(found, rods=tuple(rods))


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
        """Return whether the plate translates only; refuse a plate that neither translates only nor is free."""
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

    def places(self, plate: int) -> tuple[pin.SE3, pin.SE3]:
        """Return where the plate is at home, and the tool frame in the plate's."""
        index = self.robot.tool_frame
        if index is None:
            return self.placement(plate), pin.SE3.Identity()
        frame = self.model.frames[index]
        if frame.parentJoint != plate:
            raise NotRods(f"{self.robot.source}: its tool does not sit on the plate")
        return self.placement(plate), pin.SE3(frame.placement)

    def plate_on_leg(self) -> int | None:
        """Return the joint of the tool's body where passive joints hang it on an actuated chain, else None."""
        index = self.robot.tool_frame
        joint = self.model.frames[index].parentJoint if index is not None else 0
        return None if self.is_chain(joint) else int(joint)

    def rerooted(self, plate: int) -> Found:
        """Return a free plate on the leg that it hangs on in the file, and on the loops' legs."""
        rods = (*self._own_leg(plate), *self.loop_rods(plate))
        home, tool = self.places(plate)
        return Found(rods, plate, False, home, tool, rerooted=True)

    def point(self, plate: int) -> Found | None:
        """Return a plate that is one point, if rods alone meet in the tool; None if they do not."""
        frames = [self.model.frames[f] for loop in self.robot.loops for f in (loop.frame_a, loop.frame_b)]
        tool = self.model.frames[self.robot.tool_frame]
        tip = (self.data.oMi[plate] * tool.placement).translation
        ends = list(dict.fromkeys([plate, *(int(frame.parentJoint) for frame in frames)]))
        off = [(self.data.oMi[f.parentJoint] * f.placement).translation - tip for f in frames]
        if np.abs(off).max() > _MEET or any(self.is_chain(end) for end in ends):
            return None
        rods: list[RodFound] = []
        for end in ends:
            joints = self._between(end, -1)
            if joints[-1] in self.actuated or (end == plate and len(joints) > 1):
                return None  # the length of the rod, or the rotation of the tool, is not determined
            own = self._rows(self._name(end), joints, 0, (int(self.model.parents[joints[0]]), None), (plate, tip))
            if len(own) + len(rods) > 3 and len(own) == 2:  # the tool stays in the first rod's plane
                both = np.array([rod.base for rod in own])
                length = float(np.sqrt(own[0].length ** 2 - np.sum((both[1] - both[0]) ** 2) / 4))
                own = [replace(own[0], name=self._name(end), base=both.mean(axis=0), length=length)]
            rods += own
        hinge = self._between(plate, -1)[0]
        carrier = int(self.model.parents[hinge])
        back = self.data.oMi[carrier].rotation.T
        axis, origin = self._line(hinge)
        rotation = self.data.oMi[plate].rotation @ tool.placement.rotation
        ride = Ride(back @ (tip - origin - axis * (axis @ (tip - origin))), back @ rotation)
        on_point = tuple(replace(rod, plate=np.zeros(3)) for rod in rods)
        return Found(on_point, plate, True, pin.SE3(rotation, tip), pin.SE3.Identity(), ride, rerooted=True)

    def loop_rods(self, plate: int) -> tuple[RodFound, ...]:
        """Return the distances that the loops keep."""
        return tuple(rod for loop in self.robot.loops for rod in self._loop(plate, loop.frame_a, loop.frame_b))

    def _loop(self, plate: int, frame_a: int, frame_b: int) -> list[RodFound]:
        """Return the distances that one loop keeps."""
        ends = [self.model.frames[f] for f in (frame_a, frame_b)]
        hanging = [end for end in ends if end.parentJoint != plate and not self.is_chain(end.parentJoint)]
        if len(hanging) != 1:
            raise NotRods(f"{self.robot.source}: a loop ties plate and chain without a rod between them")
        rod, tied = hanging[0], next(end for end in ends if end is not hanging[0])
        joints = self._between(rod.parentJoint, plate)
        root = int(self.model.parents[joints[0]])
        slide = joints.pop() if joints[-1] in self.actuated else 0
        tip = (self.data.oMi[rod.parentJoint] * rod.placement).translation
        near, far = (root, None), (int(tied.parentJoint), tip)
        if root == plate:
            near, far = far, near
        if not self.is_chain(near[0]) or far[0] != plate:
            raise NotRods(
                f"{self.robot.source}: rod {self._name(rod.parentJoint)} does not reach from a driven chain to the plate"
            )
        return self._rows(self._name(rod.parentJoint), joints, slide, near, far)

    def _own_leg(self, plate: int) -> list[RodFound]:
        """Return the distances that the leg keeps on which the plate hangs in the file."""
        joints = [j for j in self.path(plate) if not self.is_chain(j)]
        root = int(self.model.parents[joints[0]])
        slides = [k for k, j in enumerate(joints) if j in self.actuated]
        for split in slides or range(1, len(joints)):
            near, far = joints[:split], joints[split + len(slides) :]
            slide = joints[split] if slides else 0
            if not near or not far or any(not self._turns(j) for j in (*near, *far)):
                continue
            name = self._name(joints[split - 1] if not slides else slide)
            tip = self._meet(far)
            if tip is not None and (len(far) == 3 or self._parallel(near, far)):
                return self._rows(name, near, slide, (root, None), (plate, tip))
            tip = self._meet(near)
            if tip is not None and len(near) == 3 and not slide:
                return self._rows(name, far, 0, (root, tip), (plate, None))
        raise NotRods(f"{self.robot.source}: the plate's own leg has no ball at either end")

    def _turns(self, joint: int) -> bool:
        return joint not in self.actuated and self.model.joints[joint].shortname().startswith("JointModelR")

    def _parallel(self, near: list[int], far: list[int]) -> bool:
        """Return whether a leg is planar: one hinge at either end, parallel."""
        if len(near) != 1 or len(far) != 1:
            return False
        return float(np.linalg.norm(np.cross(self._line(near[0])[0], self._line(far[0])[0]))) < _MEET

    def _line(self, joint: int) -> tuple[np.ndarray, np.ndarray]:
        """Return a turn's axis and the point of it that is nearest to the joint's origin: the origin."""
        column = np.reshape(self.data.J, (6, -1))[:, self.model.joints[joint].idx_v]
        return column[3:], self.data.oMi[joint].translation

    def _meet(self, joints: list[int]) -> np.ndarray | None:
        """Return the point in which turns meet, for one turn its joint's origin; None if they do not."""
        lines = [self._line(j) for j in joints]
        if len(lines) == 1:
            return lines[0][1]
        A = np.concatenate([np.eye(3) - np.outer(a, a) for a, _ in lines])
        b = np.concatenate([o - a * (a @ o) for a, o in lines])
        point, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-9)
        return point if rank == 3 and np.abs(A @ point - b).max() <= _MEET else None

    def _rows(
        self,
        name: str,
        joints: list[int],
        slide: int,
        near: tuple[int, np.ndarray | None],
        far: tuple[int, np.ndarray | None],
    ) -> list[RodFound]:
        """Return the distances of a rod with a ball at one end and turns at the other.

        Args:
            name: Name of the rod.
            joints: The turns.
            slide: An actuated slide between them and the ball, 0 without a slide.
            near: The joint that carries the driven end, and the ball if it is at that end.
            far: The plate's joint, and the ball if it is at the plate.
        """
        ball = far[1] if near[1] is None else near[1]
        assert ball is not None
        found = []
        hinges = self._hinges(joints, ball, name)
        for k, hinge in enumerate(hinges):
            length, offset, gain = self._length(hinge, ball, slide)
            ends = (near[0], hinge if near[1] is None else ball), (far[0], hinge if far[1] is None else ball)
            suffix = f"_{k + 1}" if len(hinges) > 1 else ""
            A, B = (self.data.oMi[j].actInv(p) for j, p in ends)
            found.append(RodFound(name + suffix, near[0], A, B, length, slide, offset, gain))
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
            raise NotRods(f"{self.robot.source}: slide '{self.model.names[slide]}' at zero is behind its rod's hinge")
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
