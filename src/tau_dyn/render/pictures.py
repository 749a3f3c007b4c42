"""Pictures of a robot: animated modes, the workspace in space, the range of tilt of the tool.

Modes are animated on the screen; on paper, and for readers who request reduced motion, they are drawn at full amplitude, each
scaled to its figure. A shape is complex: the magnitude of an entry is the amplitude of an output, its angle the phase. With the
strongest entry turned to the real axis, outputs with a real entry move in phase, and outputs with an imaginary entry a quarter
of a period later. A workspace is an image of its border's points, nearest on top, shaded by their normals; frame, carts and
plate are drawn over it as outlines, rods as lines.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from markupsafe import Markup
from scipy import ndimage

from tau_dyn.kinematics import Box, Capsule, Cylinder, HalfSpace, Obstacle, PlacedSolid
from tau_dyn.kinematics.workspace import Study
from tau_dyn.mechanism import LoopSolver
from tau_dyn.render.chart import draw_svg, format_path, format_tag
from tau_dyn.render.sketch import (
    BOX_EDGES,
    Projection,
    compute_box_corners,
    compute_hull,
    draw_outline,
    draw_triad,
    project,
    project_with_depth,
)
from tau_dyn.results import PolarPicture, ShapePicture, SpacePicture, SwingPicture, find_space_axes, format_number

WIDTH, HEIGHT, MARGIN = 330, 250, 30
_MAX_REACH = 24.0
"""Largest displacement of a drawing [px]."""
FRAMES = 13
"""Number of drawings per period; the browser interpolates linearly between them."""
_ARROW = 1.8
"""Ratio of arrows to the displacement of the body, so that they remain visible next to it."""
AXES = {"x": (0.90, 0.30), "y": (-0.78, 0.42), "z": (0.0, -1.0)}
"""Directions of the axes of space on the drawing, y down: view from above, front and right."""
SIZE, REACH = 190, 62.0
PERIOD = 2.4
"""Period of an animation on the page [s], independent of the real period."""


def _project(skeleton: Any) -> Projection:
    spots = [at[None] for at in skeleton.places.values()]
    return Projection.of(
        np.concatenate([*skeleton.links, *skeleton.rails, skeleton.joints, *spots]), WIDTH, HEIGHT, MARGIN
    )


def draw_swing(picture: SwingPicture) -> Markup:
    """Return a mode on the robot: outlines at rest, animated outlines, carts, and arrows at the sensors."""
    skeleton, swing = picture.skeleton, picture.swing
    view = _project(skeleton)
    pieces = [format_tag("path", d=format_path(view.place(rail)), class_="rail") for rail in skeleton.rails]
    order = sorted(range(len(skeleton.links)), key=lambda k: -len(skeleton.links[k]))
    pieces += [format_tag("path", d=draw_outline(view.place(skeleton.links[k])), class_="at-rest") for k in order]
    moving, still = [], []
    for k in order:
        if np.abs(swing.links[k]).max() < 1e-3:
            continue
        class_ = "rod" if len(skeleton.links[k]) == 2 else "plate"
        frames = _frames(skeleton.links[k], swing.links[k], view)
        still.append(format_tag("path", d=frames[0], class_=class_))
        run = format_tag(
            "animate", attributeName="d", values=";".join(frames), dur=f"{PERIOD}s", repeatCount="indefinite"
        )
        moving.append(format_tag("path", run, d=frames[0], class_=class_))
    pieces += [format_tag("g", *still, class_="still"), format_tag("g", *moving, class_="moving")]
    spots = view.place(skeleton.joints)
    pieces += [
        format_tag("rect", x=float(x) - 6, y=float(y) - 4.5, width=12, height=9, rx=2, class_="cart") for x, y in spots
    ]
    pieces += [_arrow(view.place(at[None])[0], swing.arrows[name]) for name, at in skeleton.places.items()]
    text = f"{picture.who}: {format_number(swing.frequency_hz, 3)} Hz on the robot"
    return draw_svg(text, (WIDTH, HEIGHT), "robot swinging", *pieces)


def _frames(points: np.ndarray, moved: np.ndarray, view: Projection) -> list[str]:
    """Return one outline for each moment of a period, the first repeated at the end; hulls keep their corners."""
    flat = view.place(points)
    around = compute_hull(flat)
    corners, closed = (np.arange(len(flat)), False) if around is None else (around, True)
    swung = (flat + _MAX_REACH * project(np.real(moved * np.exp(1j * x))) for x in np.linspace(0, 2 * np.pi, FRAMES))
    return [format_path(points[corners], closed=closed) for points in swung]


def _arrow(at: np.ndarray, moved: np.ndarray) -> Markup:
    """Return the motion of a sensor's position as a double arrow between its extremes."""
    tip = _ARROW * _MAX_REACH * project(np.real(moved)[None])[0]
    size = float(np.hypot(*tip))
    if size < 4:
        return format_tag("circle", cx=float(at[0]), cy=float(at[1]), r=3, class_="sensor")
    along, across = tip / size, np.array([-tip[1], tip[0]]) / size
    pieces = []
    for side in (1, -1):
        end = at + side * tip
        head = [end - side * 6 * along + 3.5 * across, end, end - side * 6 * along - 3.5 * across]
        pieces += [format_path(np.array([at, end])), format_path(np.array(head))]
    return format_tag("path", d="".join(pieces), class_="arrow")


def normalise_shape(shape: np.ndarray) -> np.ndarray:
    """Return a shape whose strongest entry is 1 and real."""
    top = shape[np.argmax(np.abs(shape))]
    return shape / top if top != 0 else shape


def draw_shape(picture: ShapePicture) -> Markup:
    """Return the drawing of a mode: a path in space if two or three outputs are axes of one point, else bars."""
    axes, shape = find_space_axes(picture.outputs), normalise_shape(picture.shape)
    return _path(shape, axes) if axes else _bars(shape, picture.outputs)


def _path(shape: np.ndarray, axes: dict[str, int]) -> Markup:
    """Return the tool's path over one period, an ellipse in parallel projection, with a moving dot."""
    middle = np.array([SIZE / 2, SIZE / 2])
    angle = np.linspace(0, 2 * np.pi, 73)
    swing = np.zeros((len(angle), 2))
    for axis, k in axes.items():
        swing += np.outer(np.real(shape[k] * np.exp(1j * angle)), AXES[axis])
    path = middle + REACH * swing / max(float(np.abs(swing).max()), 1e-12)
    d = format_path(path, closed=True)
    pieces = []
    for axis, (a, b) in AXES.items():
        if axis not in axes:
            continue
        end = middle + 84 * np.array([a, b])
        start = middle - 84 * np.array([a, b])
        pieces.append(format_tag("path", d=f"M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}", class_="axis"))
        pieces.append(format_tag("text", axis, x=float(end[0]) + 4, y=float(end[1]) + 4))
    flat = path - middle
    far = flat[np.argmax(np.hypot(*flat.T))]
    wide = float(np.abs(flat @ np.array([-far[1], far[0]])).max() / max(float(far @ far), 1e-12))
    pieces.append(format_tag("path", d=d, class_="swing wide" if wide > 0.03 else "swing"))
    pieces.append(format_tag("path", d=f"M{middle[0]:.1f} {middle[1]:.1f}m-4 0h8m-4-4v8", class_="rest"))
    run = format_tag("animateMotion", path=d, dur=f"{PERIOD}s", repeatCount="indefinite")
    pieces.append(format_tag("circle", run, r=6, class_="tool"))
    return draw_svg("path of the tool through one swing", (SIZE, SIZE), "shape", *pieces)


def _bars(shape: np.ndarray, outputs: Sequence[str]) -> Markup:
    """Return one bar per output: full for the part in phase, pale for the part a quarter of a period later."""
    p = len(outputs)
    width = max(SIZE, 16 + 30 * p)
    step = (width - 16) / p
    base = 92.0
    pieces = [format_tag("path", d=f"M6 {base:.1f}H{width - 6:.1f}", class_="axis")]
    for k, (name, value) in enumerate(zip(outputs, shape, strict=True)):
        x = 8 + step * (k + 0.5)
        up, late = -REACH * float(value.real), -REACH * float(value.imag)
        half = min(9.0, 0.3 * step)
        ghost = f"M{x - half:.1f} {base:.1f}V{base - up:.1f}H{x + half:.1f}V{base:.1f}Z"
        pieces.append(format_tag("path", d=ghost, class_="ghost"))
        pieces.append(
            format_tag(
                "path", d=f"M{x - half:.1f} {base:.1f}V{base + up:.1f}H{x + half:.1f}V{base:.1f}Z", class_="bar-now"
            )
        )
        if abs(late) > 2:
            pieces.append(format_tag("path", d=f"M{x + half + 3:.1f} {base:.1f}V{base + late:.1f}", class_="late"))
        at = {"x": x, "y": SIZE - 6.0, "text_anchor": "middle"}
        pieces.append(format_tag("text", name if len(name) <= 9 else f"{name[:8]}…", **at))
    return draw_svg("swing of every output", (width, SIZE), "shape", *pieces)


SPACE_WIDTH, SPACE_HEIGHT, SPACE_MARGIN = 700, 520, 30
_FINE = 2  # picture points per drawing unit
_SPLATS = 60_000  # points of the cloud drawn at most
_INK = np.array([46.0, 124.0, 214.0])


def draw_space(picture: SpacePicture) -> Markup:
    """Return the workspace and the robot in space; empty if the workspace is flat."""
    found = picture.study
    space = found.workspace
    if space.dimension < 3:
        return Markup("")
    machine = space.machine
    solids = machine.solids(machine.robot.home[None], machine.home)
    outlines = [
        (outline_solid(s), body.rod >= 0, body.joint == 0) for s, body in zip(solids, machine.bodies, strict=True)
    ]
    walls = [points for o in space.judge.demands.surroundings.obstacles for points in _obstacle(o)]
    box = compute_box_corners(space.lower, space.upper)
    ends = [o for o, _, _ in outlines] or _skeleton(found)
    view = Projection.of(np.concatenate([*ends, box, machine.home.position]), SPACE_WIDTH, SPACE_HEIGHT, SPACE_MARGIN)
    place = view.place
    pieces = [_cloud(found, view)]
    pieces += [format_tag("path", d=format_path(place(box[list(edge)])), class_="w-box") for edge in BOX_EDGES]
    pieces += [format_tag("path", d=draw_outline(place(points)), class_="w-wall") for points in walls]
    for points, is_rod, fixed in sorted(outlines, key=lambda o: o[1]):
        if is_rod:
            pieces.append(format_tag("path", d=format_path(place(points)), class_="rod"))
        else:
            pieces.append(format_tag("path", d=draw_outline(place(points)), class_="w-frame" if fixed else "plate"))
    if not outlines:
        pieces += [format_tag("path", d=format_path(place(line)), class_="rod") for line in _skeleton(found)]
    x, y = (float(c) for c in place(machine.home.position)[0])
    pieces.append(format_tag("circle", cx=x, cy=y, r=5, class_="cart"))
    words = f"workspace of {machine.robot.name}, the robot at home in it"
    return draw_svg(words, (SPACE_WIDTH, SPACE_HEIGHT), "space", *pieces, draw_triad(40, SPACE_HEIGHT - 34, 26))


def _cloud(found: Study, view: Projection) -> Markup:
    """Return the border's points as a picture."""
    space = found.workspace
    inside, lattice = space.inside, space.lattice
    border = inside & ~np.asarray(ndimage.binary_erosion(inside), bool)
    soft = np.asarray(ndimage.gaussian_filter(inside.astype(np.float32), 1.6))
    index = np.argwhere(border)
    step = max(1, len(index) // _SPLATS)
    index = index[::step]
    slope = np.stack([np.asarray(g)[tuple(index.T)] for g in np.gradient(soft)], axis=1)
    facing = -project_with_depth(slope)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-9)
    at = project_with_depth(lattice.points(index))
    wide = int(np.ceil(1.5 * view.scale * lattice.step * np.sqrt(step) * _FINE))
    pixel = np.rint((view.scale * at[:, :2] + view.shift) * _FINE).astype(int)
    light = 0.62 + 0.38 * np.clip(facing @ np.array([-0.35, -0.55, 0.75]), -0.5, 1.0)
    return _image(_splat(pixel, at[:, 2], light, max(wide, 1)))


def _splat(pixel: np.ndarray, depth: np.ndarray, light: np.ndarray, wide: int) -> np.ndarray:
    """Return an image (rows, columns, 4) of squares, drawn from far to near."""
    rows, columns = SPACE_HEIGHT * _FINE, SPACE_WIDTH * _FINE
    picture = np.zeros((rows, columns, 4), np.uint8)
    order = np.argsort(depth, kind="stable")
    span = depth[order[[0, -1]]] if len(order) else np.zeros(2)
    near = (depth[order] - span[0]) / max(float(span[1] - span[0]), 1e-9)
    colour = (_INK[None] * (light[order] * (0.80 + 0.28 * near))[:, None]).clip(0, 255).astype(np.uint8)
    offsets = np.arange(wide) - wide // 2
    x = (pixel[order, 0, None, None] + offsets[None, :, None] + 0 * offsets).reshape(len(order), -1)
    y = (pixel[order, 1, None, None] + 0 * offsets[:, None] + offsets[None, None, :]).reshape(len(order), -1)
    good = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    which = np.broadcast_to(np.arange(len(order))[:, None], x.shape)[good]
    picture[y[good], x[good], :3] = colour[which]
    picture[y[good], x[good], 3] = 150
    return picture


def _image(picture: np.ndarray) -> Markup:
    uri = "data:image/png;base64," + base64.b64encode(encode_png(picture)).decode("ascii")
    return format_tag("image", href=uri, x=0, y=0, width=SPACE_WIDTH, height=SPACE_HEIGHT)


def encode_png(picture: np.ndarray) -> bytes:
    """Return a picture (rows, columns, 4) of bytes as a PNG file."""
    rows, columns = picture.shape[:2]
    raw = np.concatenate([np.zeros((rows, 1), np.uint8), picture.reshape(rows, -1)], axis=1).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")


def outline_solid(solid: PlacedSolid) -> np.ndarray:
    """Return points (m, 3) whose hull is a solid's outline; for a rod its two ends."""
    shape, turn, place = solid.shape, solid.rotation[0], solid.position[0]
    if isinstance(shape, Capsule):
        length = float(solid.length[0]) if solid.length is not None else shape.length
        local = np.array([[0, 0, -length / 2], [0, 0, length / 2]])
    elif isinstance(shape, Box):
        half = np.array(shape.size) / 2
        local = compute_box_corners(-half, half)
    elif isinstance(shape, Cylinder):
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = shape.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        local = np.concatenate([np.column_stack([ring, np.full(24, z)]) for z in (-shape.height / 2, shape.height / 2)])
    else:
        assert not isinstance(shape, HalfSpace)
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        ring = shape.radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        local = np.concatenate([ring[:, order] for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0])])
    return place + local @ turn.T


def _obstacle(o: Obstacle) -> list[np.ndarray]:
    if isinstance(o.shape, HalfSpace):
        return []
    return [outline_solid(PlacedSolid(o.shape, o.placement.rotation[None], o.placement.translation[None]))]


def _skeleton(found: Study) -> list[np.ndarray]:
    """Return lines (2, 3) from joint to joint and to the tool, for a robot whose file has meshes."""
    robot = found.workspace.machine.robot
    solver = LoopSolver(robot)
    pin.framesForwardKinematics(robot.model, solver.data, solver.close(robot.home))
    at, parents = solver.data.oMi, robot.model.parents
    lines = [np.array([at[parents[j]].translation, at[j].translation]) for j in range(1, robot.model.njoints)]
    if robot.tool_frame is not None:
        frame = robot.model.frames[robot.tool_frame]
        lines.append(np.array([at[frame.parentJoint].translation, solver.data.oMf[robot.tool_frame].translation]))
    return lines


def draw_polar(picture: PolarPicture) -> Markup:
    """Return a closed line around a point in polar coordinates, with the radius in degrees."""
    middle, far = 130.0, 104.0
    most = max(30.0, float(np.ceil(picture.degrees.max() / 15) * 15))
    pieces = []
    for degrees in np.arange(15, most + 1, 15 if most <= 60 else 30):
        r = far * float(degrees) / most
        pieces.append(format_tag("circle", cx=middle, cy=middle, r=r, class_="ring"))
        pieces.append(format_tag("text", f"{degrees:.0f}°", x=middle + 3, y=middle - r - 2, class_="axis-name"))
    r = far * picture.degrees / most
    points = np.stack([middle + r * np.cos(picture.angle), middle - r * np.sin(picture.angle)], axis=1)
    pieces.append(format_tag("path", d=format_path(points, closed=True), class_="lean"))
    pieces.append(format_tag("text", "x", x=middle + far + 10, y=middle + 4, class_="name"))
    pieces.append(format_tag("text", "y", x=middle, y=middle - far - 14, text_anchor="middle", class_="name"))
    return draw_svg(picture.title, (260, 260), "chart tilt", *pieces)


def draw_picture(picture: SwingPicture | ShapePicture | SpacePicture | PolarPicture) -> Markup:
    """Return any of these pictures as SVG."""
    match picture:
        case SwingPicture():
            return draw_swing(picture)
        case ShapePicture():
            return draw_shape(picture)
        case SpacePicture():
            return draw_space(picture)
        case PolarPicture():
            return draw_polar(picture)
