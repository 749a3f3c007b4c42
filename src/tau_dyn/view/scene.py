"""Poses of all shapes at given actuated positions, with closed loops; shapes in viser's scene, added once, then moved.

`Window` is the protocol that panels need of the viewer, so that they do not import it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, Protocol

import numpy as np
import pinocchio as pin

from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import Robot
from tau_dyn.view.shapes import NAMED, QUIET, Rgb, Shape

_MIN_LABEL_DISTANCE_M = 1e-3  # m; labels of joints that are closer would cover each other
ShapePoses = list[tuple[np.ndarray, np.ndarray]]
"""Position (3,) [m] and quaternion (4,) w x y z in the world, of each shape."""


class Placer:
    """Computes the poses of a robot's shapes."""

    def __init__(self, robot: Robot, shapes: Sequence[Shape]) -> None:
        """Prepare for a robot and its shapes."""
        self.robot, self.shapes = robot, tuple(shapes)
        self._solver = LoopSolver(robot)
        self._local = [s.local for s in self.shapes]

    def __call__(self, q: np.ndarray) -> ShapePoses:
        """Return the pose of each shape at actuated positions (na,).

        Raises:
            LoopClosureError: The robot cannot reach these positions.
        """
        model, data = self.robot.model, self._solver.data
        pin.forwardKinematics(model, data, self._solver.close(q))
        pin.updateFramePlacements(model, data)
        return [convert_pose(data.oMi[s.joint] * local) for s, local in zip(self.shapes, self._local, strict=True)]

    @property
    def tool(self) -> pin.SE3 | None:
        """The tool's pose at the last call, or None for a robot without a tool."""
        frame = self.robot.tool_frame
        return None if frame is None else pin.SE3(self._solver.data.oMf[frame])

    def pose(self, joint: str) -> pin.SE3:
        """Return a joint's frame at the last call."""
        return self._solver.data.oMi[self.robot.model.getJointId(joint)].copy()

    def at(self, joint: str) -> np.ndarray:
        """Return a joint's position at the last call (3,) [m]."""
        return self._solver.data.oMi[self.robot.model.getJointId(joint)].translation.copy()

    def moved_by(self, joint: str) -> list[int]:
        """Return the indices of the shapes that a joint carries, up to the next actuated joint."""
        model, mine = self.robot.model, self.robot.model.getJointId(joint)
        others = {model.getJointId(j) for j in self.robot.actuated} - {mine}
        carried = {mine}
        for child in range(1, model.njoints):
            if model.parents[child] in carried and child not in others:
                carried.add(child)
        return [k for k, s in enumerate(self.shapes) if s.joint in carried]

    def carried_by(self, part: str) -> list[int]:
        """Return the indices of the shapes of a joint, link or rod; an empty list if the robot has no such part."""
        model = self.robot.model
        if part in self.robot.actuated:
            return self.moved_by(part)
        links = [name for name in (part, f"{part}_link") if model.existFrame(name, pin.FrameType.BODY)]
        joint = model.frames[model.getFrameId(links[0], pin.FrameType.BODY)].parentJoint if links else None
        if joint is None and model.existJointName(part):
            joint = model.getJointId(part)
        return [k for k, s in enumerate(self.shapes) if s.joint == joint]


def convert_pose(place: pin.SE3) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose as position (3,) and quaternion (4,) w x y z."""
    return place.translation.copy(), convert_to_wxyz(pin.Quaternion(place.rotation))


def convert_to_wxyz(turn: pin.Quaternion) -> np.ndarray:
    """Return a quaternion's components (4,) in the order of viser, w x y z."""
    x, y, z, w = turn.coeffs()
    return np.array([w, x, y, z])


class RobotFigure:
    """One robot in the scene.

    Attributes:
        handles: viser's handle of each shape.
    """

    def __init__(
        self, scene: Any, name: str, shapes: Sequence[Shape], *, colour: Rgb | None = None, opacity: float = 1.0
    ) -> None:
        """Add the shapes under a name; a colour, such as that of a ghost, applies to all of them."""
        self._shapes, self._own = tuple(shapes), [colour or s.colour for s in shapes]
        see_through = None if opacity >= 1 else opacity
        self.handles = [
            add_shape(scene, f"/{name}/{k}", s, paint, see_through)
            for k, (s, paint) in enumerate(zip(self._shapes, self._own, strict=True))
        ]

    def move(self, placed: ShapePoses) -> None:
        """Move all shapes."""
        for handle, (position, turn) in zip(self.handles, placed, strict=True):
            handle.position, handle.wxyz = position, turn

    def light(self, named: Collection[int]) -> None:
        """Highlight the named shapes and make the others pale; an empty collection restores all colours."""
        for k, handle in enumerate(self.handles):
            handle.color = self._own[k] if not named else NAMED if k in named else _pale(self._own[k])

    def paint(self, colours: dict[int, Rgb]) -> None:
        """Paint these shapes and make all others pale."""
        for k, handle in enumerate(self.handles):
            handle.color = colours.get(k, QUIET)

    def seen(self, visible: bool) -> None:
        """Show or hide the robot."""
        for handle in self.handles:
            handle.visible = visible


class JointFrames:
    """The frames of the actuated joints with their names, shown on request."""

    def __init__(self, scene: Any, placer: Placer, length: float) -> None:
        """Add the frames, hidden; axes of this length [m]: x red, y green, z blue. Coincident joints share a label."""
        self._joints, names = placer.robot.actuated, dict[tuple[int, ...], tuple[int, list[str]]]()
        self.handles = []
        for k, joint in enumerate(self._joints):
            names.setdefault(tuple((placer.at(joint) / _MIN_LABEL_DISTANCE_M).round().astype(int)), (k, []))[1].append(
                joint
            )
            self.handles.append(
                scene.add_frame(f"/joints/{k}", axes_length=length, axes_radius=0.035 * length, visible=False)
            )
        self.labels = [
            scene.add_label(f"/joints/{k}/name", ", ".join(several), anchor="bottom-left", visible=False)
            for k, several in names.values()
        ]

    def move(self, placer: Placer) -> None:
        """Move the frames to the placer's joints."""
        for joint, handle in zip(self._joints, self.handles, strict=True):
            handle.position, handle.wxyz = convert_pose(placer.pose(joint))

    def seen(self, visible: bool) -> None:
        """Show or hide the frames."""
        for handle in (*self.handles, *self.labels):
            handle.visible = visible


class Window(Protocol):
    """The interface that a panel needs of the viewer; its attributes are those of `Viewer`."""

    robot: Robot
    server: Any
    placer: Placer
    figure: RobotFigure
    size: float
    lock: Any
    names: dict[str, int]

    def show(self, q: np.ndarray) -> bool:
        """Show the robot at actuated positions (na,); return False if it cannot reach them."""
        ...

    def light(self, parts: Iterable[str]) -> list[int]:
        """Highlight the shapes of these parts; return their indices."""
        ...

    def widen(self, points: np.ndarray) -> None:
        """Extend the view to points (n, 3) [m]."""
        ...

    def every_frame(self, ticker: Callable[[float], None]) -> None:
        """Register a function that is called for every frame with the time since the last one [s]."""
        ...


def add_shape(scene: Any, path: str, shape: Shape, colour: Rgb, opacity: float | None) -> Any:
    """Add a shape to the scene and return viser's handle."""
    look = {"color": colour, "opacity": opacity, "cast_shadow": opacity is None, "receive_shadow": opacity is None}
    if shape.kind == "box":
        return scene.add_box(path, dimensions=tuple(map(float, shape.size)), **look)
    if shape.kind == "cylinder":
        return scene.add_cylinder(path, radius=float(shape.size[0]), height=float(shape.size[1]), **look)
    if shape.kind == "sphere":
        return scene.add_icosphere(path, radius=float(shape.size[0]), **look)
    return scene.add_mesh_simple(path, shape.size, shape.faces, **look)


def _pale(colour: Rgb) -> Rgb:
    r, g, b = (round(0.35 * c + 0.65 * q) for c, q in zip(colour, QUIET, strict=True))
    return r, g, b


def compute_link_pose(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and quaternion (4,) of a shape whose z axis points from one point to another."""
    return (start + end) / 2, convert_to_wxyz(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end - start))


def light_scene(scene: Any, shadows: bool) -> None:
    """Add light from above, and ambient light so that no face is black."""
    scene.configure_default_lights(cast_shadow=shadows)
    scene.add_light_ambient("/daylight", intensity=0.55)


def compute_outline(shapes: Sequence[Shape], placed: ShapePoses) -> np.ndarray:
    """Return the corners (n, 3) [m] of shapes at their poses."""
    return np.concatenate([_corners(s, p, w) for s, (p, w) in zip(shapes, placed, strict=True)])


def add_floor(scene: Any, low: np.ndarray, high: np.ndarray) -> None:
    """Add a grid under the box from one corner (3,) to the other, with cells of 1, 10 or 100 mm, cm or m."""
    reach, middle = float(np.linalg.norm(high - low)), (low + high) / 2
    cell = float(10.0 ** np.floor(np.log10(reach / 2.5)))
    scene.add_grid(
        "/floor", width=5 * reach, height=5 * reach, plane="xy", position=(*middle[:2], float(low[2]) - 0.02 * reach),
        cell_size=cell, section_size=5 * cell, cell_color=(238, 240, 243), section_color=(221, 225, 230),
        fade_distance=3.2 * reach, fade_strength=1.5, shadow_opacity=0.2,
    )  # fmt: skip


def _corners(shape: Shape, position: np.ndarray, turn: np.ndarray) -> np.ndarray:
    w, x, y, z = turn
    cube = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    local = shape.size if shape.faces is not None else cube * shape.half
    return local @ pin.Quaternion(w, x, y, z).toRotationMatrix().T + position
