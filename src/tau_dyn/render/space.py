"""The workspace in space with the robot at home in it, and how far the tool leans.

The cloud is a picture of the border's points, nearest on top, shaded by the way they face; frame, carts and plate are
outlines, rods are lines, drawn over it. The view is that of `sketch.py`.
"""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
import pinocchio as pin
from markupsafe import Markup
from scipy import ndimage

from tau_dyn.kinematics import Box, Capsule, Cylinder, HalfSpace, Obstacle, PlacedSolid
from tau_dyn.kinematics.workspace import Study
from tau_dyn.mechanism import LoopSolver
from tau_dyn.render.sketch import (
    BOX_EDGES,
    Projection,
    compute_box_corners,
    draw_outline,
    draw_triad,
    project_with_depth,
)
from tau_dyn.render.svg import format_path, format_tag
from tau_dyn.results import PolarPicture, SpacePicture

WIDTH, HEIGHT, MARGIN = 700, 520, 30
_FINE = 2  # picture points per drawing unit
_SPLATS = 60_000  # points of the cloud drawn at most
_INK = np.array([46.0, 124.0, 214.0])


def draw_space(picture: SpacePicture) -> Markup:
    """Return the workspace and the robot in space; nothing where the workspace is flat."""
    found = picture.study
    space = found.workspace
    if space.dimension < 3:
        return Markup("")
    machine = space.machine
    solids = machine.solids(machine.robot.home[None], machine.home)
    outlines = [(_outline(s), body.rod >= 0, body.joint == 0) for s, body in zip(solids, machine.bodies, strict=True)]
    walls = [points for o in space.judge.demands.surroundings.obstacles for points in _obstacle(o)]
    box = compute_box_corners(space.lower, space.upper)
    ends = [o for o, _, _ in outlines] or _skeleton(found)
    view = Projection.of(np.concatenate([*ends, box, machine.home.position]), WIDTH, HEIGHT, MARGIN)
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
    return format_tag(
        "svg",
        format_tag("title", words),
        *pieces,
        draw_triad(40, HEIGHT - 34, 26),
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        role="img",
        class_="space",
    )


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
    """Return a picture (rows, columns, 4) of squares, far ones first."""
    rows, columns = HEIGHT * _FINE, WIDTH * _FINE
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
    return format_tag("image", href=uri, x=0, y=0, width=WIDTH, height=HEIGHT)


def encode_png(picture: np.ndarray) -> bytes:
    """Return a picture (rows, columns, 4) of bytes as a PNG file."""
    rows, columns = picture.shape[:2]
    raw = np.concatenate([np.zeros((rows, 1), np.uint8), picture.reshape(rows, -1)], axis=1).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")


def _outline(solid: PlacedSolid) -> np.ndarray:
    """Return points whose hull is a solid's outline (m, 3); of a rod its two ends."""
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
    return [_outline(PlacedSolid(o.shape, o.placement.rotation[None], o.placement.translation[None]))]


def _skeleton(found: Study) -> list[np.ndarray]:
    """Return lines (2, 3) from joint to joint and on to the tool, for a robot that the file draws in meshes."""
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
    """Return a closed line around a point, outwards in degrees."""
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
    return format_tag(
        "svg", format_tag("title", picture.title), *pieces, viewBox="0 0 260 260", role="img", class_="chart tilt"
    )
