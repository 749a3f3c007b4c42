"""The shapes of a robot, coloured by their function: the visuals of its file, and joints, arms and motors in addition.

Visuals of the file, meshes included, are drawn unchanged, in their own colours if they have any. A visual named `envelope`
is the space that a part occupies, for other programs. Here the part is drawn as the hull of balls in its joints if it has
three or more. A body without a visual is drawn as sticks from its own joint to the joints that it carries. Balls in joints,
arms from bodies to them, and motors follow from the tree.

The module also holds the colours by function, and the scale that maps values to colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring
from scipy.spatial import ConvexHull, QhullError

from tau_dyn.robot import Mesh, Robot, Visual, read_visuals

Rgb = tuple[int, int, int]

ROLES: dict[str, Rgb] = {
    "frame": (150, 158, 170),
    "driven": (36, 98, 176),
    "rod": (58, 63, 72),
    "plate": (240, 150, 40),
    "passive": (120, 140, 165),
    "ball": (214, 218, 224),
}
"""Function of a part -> colour; the materials in the robot files are the same."""
CASING: Rgb = (226, 229, 233)
"""Colour of an arm's meshes if the robot file gives none."""
NAMED: Rgb = (214, 40, 57)
GHOST: Rgb = (22, 160, 110)
QUIET: Rgb = (196, 202, 210)
"""Colours of the parts of a finding, of the simulated or commanded robot, and of shapes in the background."""

_VIRIDIS = np.array(
    [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
     [110, 206, 88], [181, 222, 43], [253, 231, 37]]
)  # fmt: skip


def map_to_colours(value: np.ndarray | None, n: int) -> np.ndarray:
    """Return colours (n, 3) of values (n,) from violet (smallest) to yellow (largest); one colour without values."""
    if value is None or not np.isfinite(value).any():
        return np.tile(np.array([90, 140, 200], np.uint8), (n, 1))
    low, high = compute_scale_limits(value)
    share = np.nan_to_num((value - low) / (high - low if high > low else 1.0))
    at = np.clip(share, 0, 1) * (len(_VIRIDIS) - 1)
    steps = np.arange(len(_VIRIDIS))
    return np.column_stack([np.interp(at, steps, channel) for channel in _VIRIDIS.T]).round().astype(np.uint8)


def compute_scale_limits(value: np.ndarray) -> tuple[float, float]:
    """Return both ends of the scale: the 1st and 99th percentile, since outliers would flatten the rest."""
    low, high = np.nanquantile(value[np.isfinite(value)], [0.01, 0.99])
    return float(low), float(high)


def format_legend(name: str, value: np.ndarray) -> str:
    """Return the scale as HTML: name, bar, both ends. The name is escaped."""
    low, high = compute_scale_limits(value)
    stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in _VIRIDIS)
    bar = f'<div style="height:10px;border-radius:5px;background:linear-gradient(90deg,{stops})"></div>'
    ends = (
        f'<div style="display:flex;justify-content:space-between"><span>{low:.4g}</span><span>{high:.4g}</span></div>'
    )
    return format_panel(f"<b>{escape(name)}</b>{bar}{ends}")


def format_keys(rows: dict[str, Rgb]) -> str:
    """Return names with their colours as HTML. The names are escaped."""
    style = "display:inline-block;width:10px;height:10px;border-radius:5px;margin-right:6px"
    dot = f'<span style="{style};background:rgb({{}},{{}},{{}})"></span>'
    return format_panel("".join(f"<div>{dot.format(*rgb)}{escape(name)}</div>" for name, rgb in rows.items()))


def escape_html(text: str) -> str:
    """Return a sentence from outside as escaped HTML."""
    return format_panel(escape(" ".join(text.split())))


def format_panel(html: str) -> str:
    """Return HTML in the small type of the window; the caller escapes text from outside."""
    return f'<div style="font-size:0.85em;line-height:1.45;padding:0.2em 0.9em 0.4em">{html}</div>'


ENVELOPE = "envelope"
_MIN = 1e-6  # m; a body smaller than this is not drawn


@dataclass(frozen=True, eq=False)
class Shape:
    """A solid in the frame of the joint that carries it.

    Attributes:
        kind: `box`, `cylinder` (along z), `sphere`, `hull` or `mesh`.
        size: Side lengths (3,), radius and height (2,), radius (1,) [m]; for a hull or mesh its vertices (n, 3) [m].
        joint: Pinocchio's index of the joint; 0 for the world.
        rotation: Rotation in the joint's frame (3, 3).
        position: Position in the joint's frame (3,) [m].
        role: Function: a key of `ROLES`.
        colour: Its colour.
        faces: Faces (m, 3) of a hull or mesh, oriented outwards; else None.
        envelope: Whether it is only the space that a part occupies; see the module.
    """

    kind: str
    size: np.ndarray
    joint: int
    rotation: np.ndarray
    position: np.ndarray
    role: str = "passive"
    colour: Rgb = ROLES["passive"]
    faces: np.ndarray | None = None
    envelope: bool = False

    @property
    def local(self) -> pin.SE3:
        """Pose in the joint's frame."""
        return pin.SE3(self.rotation, self.position)

    @property
    def half(self) -> np.ndarray:
        """Half the side lengths of its bounding box (3,) [m]; zero for a hull or mesh."""
        if self.kind == "box":
            return self.size / 2
        if self.kind == "cylinder":
            return np.array([self.size[0], self.size[0], self.size[1] / 2])
        return np.full(3, self.size[0]) if self.kind == "sphere" else np.zeros(3)

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Return its point nearest to a point (3,) of the joint's frame; for a cylinder, the nearest point of its axis."""
        half = self.half * (np.array([0.0, 0.0, 1.0]) if self.kind == "cylinder" else 1.0)
        return self.local.act(np.clip(self.local.actInv(point), -half, half))


def build_visual_shapes(robot: Robot, visuals: Sequence[Visual] | None = None) -> list[Shape]:
    """Return the shapes of the file's visuals, which are read if not given; an unreadable mesh is left out."""
    rooms, role = _list_envelopes(robot), list_body_roles(robot)
    found = []
    for visual in read_visuals(robot)[0] if visuals is None else visuals:
        shape = _convert_visual(visual)
        if shape is not None:
            own = CASING if shape.kind == "mesh" and not robot.loops else ROLES[role[shape.joint]]
            colour = own if visual.colour is None else _rgb(visual.colour)
            found.append(replace(shape, role=role[shape.joint], colour=colour, envelope=visual.name in rooms))
    return found


def list_body_roles(robot: Robot) -> list[str]:
    """Return the function of each joint's body (njoints,), which follows from the tree, not from names."""
    model, driven = robot.model, {robot.model.getJointId(j) for j in robot.actuated}
    ends = [model.frames[f].parentJoint for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    tool = None if robot.tool_frame is None or not robot.loops else model.frames[robot.tool_frame].parentJoint
    found = ["frame"] + ["passive"] * (model.njoints - 1)
    for joint in range(model.njoints - 1, 0, -1):
        carried = [found[c] for c in range(joint + 1, model.njoints) if model.parents[c] == joint and c not in driven]
        if joint in driven:
            found[joint] = "driven"
        elif joint == tool or ends.count(joint) > 1 or "plate" in carried:
            found[joint] = "plate"
        elif joint in ends or "rod" in carried or _telescopes(robot, joint, driven):
            found[joint] = "rod"
    return found


def _telescopes(robot: Robot, joint: int, driven: set[int]) -> bool:
    ends = {robot.model.frames[f].parentJoint for loop in robot.loops for f in (loop.frame_a, loop.frame_b)}
    return any(c in driven and c in ends and robot.model.parents[c] == joint for c in range(robot.model.njoints))


def _list_envelopes(robot: Robot) -> set[str]:
    """Return the visuals named `envelope` in the robot file, as `LINK_NUMBER`."""
    links = {
        link.get("name", ""): link.findall("visual") for link in fromstring(robot.urdf, forbid_dtd=True).findall("link")
    }
    return {f"{n}_{k}" for n, all_ in links.items() for k, v in enumerate(all_) if v.get("name") == ENVELOPE}


def _convert_visual(visual: Visual) -> Shape | None:
    shape, kind, faces = visual.shape, type(visual.shape).__name__, None
    if isinstance(shape, Mesh):
        name, size, faces = "mesh", shape.vertices, shape.faces
    elif kind == "Box":
        name, size = "box", 2 * np.asarray(shape.halfSide, float)
    elif kind == "Cylinder":
        name, size = "cylinder", np.array([shape.radius, 2 * shape.halfLength])
    elif kind == "Sphere":
        name, size = "sphere", np.array([shape.radius])
    else:
        return None
    if np.ptp(size) < _MIN if faces is not None else np.max(size) < _MIN:
        return None
    place = visual.placement
    return Shape(name, size, visual.joint, place.rotation.copy(), place.translation.copy(), faces=faces)


def _rgb(rgba: np.ndarray) -> Rgb:
    r, g, b = (round(255 * float(np.clip(c, 0, 1))) for c in rgba[:3])
    return r, g, b


STICK = 0.012
"""Radius of a stick, as a share of the robot's size."""
_ROUND = 8
"""Directions around a ball of a hull, and half as many layers."""
_BALL, _BRACKET, _MOTOR = 1.5, 0.9, 1.5
"""Radii, relative to the radius of rods (balls, brackets) and of arms (motors)."""
_MAX_DUPLICATE_DISTANCE_M = 1e-6
"""Distance [m] below which two joints coincide."""
_DRUM = (104, 112, 124)


@dataclass(frozen=True, eq=False)
class _Spot:
    """A joint that a body holds: its position, and whether it turns freely (a ball is drawn)."""

    body: int
    place: np.ndarray
    ball: bool


def build_furniture(robot: Robot, visuals: Sequence[Visual] | None = None) -> tuple[Shape, ...]:
    """Return all shapes of a robot: the visuals of its file, and arms, balls, motors and sticks."""
    drawn, role = build_visual_shapes(robot, visuals), list_body_roles(robot)
    spots, thin = _spots(robot, role), _thickness(robot, drawn)
    bare = set(range(1, robot.model.njoints)) - {shape.joint for shape in drawn}
    kept = [shape for shape in drawn if not shape.envelope]
    for shape in (s for s in drawn if s.envelope):
        kept.append(_hull(shape, [s.place for s in spots if s.body == shape.joint], thin) or shape)
    furniture = [*_brackets(kept, spots, thin), *_balls(spots, thin), *_motors(robot, kept)]
    return (*kept, *furniture, *_sticks(robot, bare, role))


def _spots(robot: Robot, role: list[str]) -> list[_Spot]:
    """Return the joints that each body holds: its children's joints that turn or are driven, ends of loops, the tool."""
    model, driven = robot.model, {robot.model.getJointId(j) for j in robot.actuated}
    ends = [(f, model.frames[f]) for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    at_rod = {loop.frame_a for loop in robot.loops}  # either end of a loop: one ball for both
    found = [_Spot(f.parentJoint, f.placement.translation.copy(), k in at_rod) for k, f in ends]
    for joint in range(1, model.njoints):
        slides = model.joints[joint].shortname().startswith("JointModelP")
        body, place = model.parents[joint], model.jointPlacements[joint].translation.copy()
        hangs = role[joint] == "plate" and role[body] in ("frame", "plate")  # the plate's own chain supports no load
        own = np.linalg.norm(place) < _MAX_DUPLICATE_DISTANCE_M and body > 0  # the second axis of a universal joint
        if not slides and not hangs and not own:
            found.append(_Spot(body, place, role[joint] == "rod" and joint not in driven))
    if robot.tool_frame is not None:
        tool = model.frames[robot.tool_frame]
        found.append(_Spot(tool.parentJoint, tool.placement.translation.copy(), False))
    return found


def _thickness(robot: Robot, drawn: list[Shape]) -> float:
    """Return the radius [m] of a rod: that of the file's visuals, else a share of the robot's size."""
    rods = [s.size[0] for s in drawn if s.role == "rod" and s.kind == "cylinder"]
    return float(np.median(rods)) if rods else STICK * _size(robot) / 2


def _size(robot: Robot) -> float:
    """Return the longest distance [m] from a joint to a joint that it carries or to an end of a loop on it."""
    model = robot.model
    frames = [model.frames[f].placement.translation for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    if robot.tool_frame is not None:
        frames.append(model.frames[robot.tool_frame].placement.translation)
    places = [p.translation for p in model.jointPlacements.tolist()]
    return max([float(np.linalg.norm(p)) for p in (*frames, *places)] + [0.05])


def _hull(shape: Shape, places: list[np.ndarray], thin: float) -> Shape | None:
    """Return the hull of balls at these points, or `None` if they are on a line or fewer than three."""
    if len(places) < 3 or np.linalg.matrix_rank(np.array(places) - np.mean(places, axis=0), tol=thin) < 2:
        return None
    points = np.concatenate([p + _BALL * thin * _sphere() for p in places])
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    faces = hull.simplices.copy()
    sides = points[faces[:, 1:]] - points[faces[:, :1]]
    inwards = np.einsum("ij,ij->i", np.cross(sides[:, 0], sides[:, 1]), hull.equations[:, :3]) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    number = np.full(len(points), -1)
    number[hull.vertices] = np.arange(len(hull.vertices))
    return replace(
        shape, kind="hull", size=points[hull.vertices], faces=number[faces], rotation=np.eye(3), position=np.zeros(3)
    )


def _sphere() -> np.ndarray:
    """Return points (n, 3) of the unit sphere."""
    turn = 2 * np.pi * np.arange(_ROUND) / _ROUND
    rise = np.pi * (np.arange(_ROUND // 2) / (_ROUND // 2 - 1) - 0.5)
    t, r = (a.ravel() for a in np.meshgrid(turn, rise))
    return np.column_stack([np.cos(r) * np.cos(t), np.cos(r) * np.sin(t), np.sin(r)])


def _balls(spots: list[_Spot], thin: float) -> list[Shape]:
    """Return one ball for every joint of a rod."""
    seen: set[tuple[int, ...]] = set()
    found = []
    for spot in (s for s in spots if s.ball):
        key = (spot.body, *(int(x) for x in np.round(1e5 * spot.place)))
        if key not in seen:
            seen.add(key)
            size = np.array([_BALL * thin])
            found.append(Shape("sphere", size, spot.body, np.eye(3), spot.place, "ball", ROLES["ball"]))
    return found


def _brackets(drawn: list[Shape], spots: list[_Spot], thin: float) -> list[Shape]:
    """Return arms from the shapes of a body to its joints outside of them."""
    found = []
    for spot in spots:
        own = [s for s in drawn if s.joint == spot.body]
        if not own or any(s.faces is not None for s in own):
            continue
        nearest, shape = min(
            ((s.nearest(spot.place), s) for s in own), key=lambda x: float(np.linalg.norm(x[0] - spot.place))
        )
        if np.linalg.norm(nearest - spot.place) > max(thin, _axis_radius(shape)):
            found.append(
                replace(_stick(spot.body, nearest, spot.place, _BRACKET * thin), role=shape.role, colour=shape.colour)
            )
    return found


def _axis_radius(shape: Shape) -> float:
    return float(shape.size[0]) if shape.kind == "cylinder" else 0.0


def _motors(robot: Robot, drawn: list[Shape]) -> list[Shape]:
    """Return a cylinder about the axis of every driven revolute joint, sized by the shape that it turns."""
    model, found = robot.model, []
    for name in robot.actuated:
        joint = model.getJointId(name)
        arm = [s for s in drawn if s.joint == joint and s.kind == "cylinder"]
        axis = _axis(model, joint)
        if axis is None or not arm or not robot.loops:
            continue
        radius = _MOTOR * float(arm[0].size[0])
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).toRotationMatrix()
        size = np.array([radius, 2.6 * radius])
        found.append(Shape("cylinder", size, joint, turn, np.zeros(3), "frame", _DRUM))
    return found


def _axis(model: pin.Model, joint: int) -> np.ndarray | None:
    """Return the axis (3,) of a revolute joint in its own frame, None for other joints."""
    if not model.joints[joint].shortname().startswith("JointModelR"):
        return None
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    local = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
    return np.asarray(local)[3:, model.joints[joint].idx_v].copy()


def _sticks(robot: Robot, joints: set[int], role: list[str]) -> list[Shape]:
    """Return sticks from these joints to the joints that they carry."""
    model = robot.model
    ends = [f for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    ends += [] if robot.tool_frame is None else [robot.tool_frame]
    reaches = {
        j: [model.jointPlacements[c].translation for c in range(1, model.njoints) if model.parents[c] == j]
        for j in joints
    }
    for frame in (model.frames[k] for k in ends):
        if frame.parentJoint in reaches:
            reaches[frame.parentJoint].append(frame.placement.translation)
    radius = STICK * _size(robot)
    return [
        replace(_stick(j, np.zeros(3), np.asarray(p), radius), role=role[j], colour=ROLES[role[j]])
        for j, points in reaches.items()
        for p in points
        if np.linalg.norm(p) > radius
    ]


def _stick(joint: int, start: np.ndarray, end: np.ndarray, radius: float) -> Shape:
    length = float(np.linalg.norm(end - start))
    along = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (end - start) / length).toRotationMatrix()
    return Shape("cylinder", np.array([radius, length]), joint, along, (start + end) / 2)
