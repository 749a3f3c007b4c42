"""Every robot of `urdf/` at home as a small drawing, from its file alone: boxes, cylinders, balls and driven joints.

    python experiments/draw_robots.py [--out docs/figures/robots] [--only delta h4]

Writes one SVG a robot. Orthographic view from the front right and above, z up; `VIEWS` has those that look better from elsewhere.
Blue: driven links and their names; orange: the plate; grey: the frame; dots: ball joints; arrows: the tool's x (red), y (green),
z (blue).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring
from scipy.spatial import ConvexHull

from tau_dyn.files import write_whole
from tau_dyn.kinematics import LoopSolver
from tau_dyn.robot import Robot, load_robot, short_names

WIDTH, HEIGHT, MARGIN = 420, 340, 36
VIEWS = {
    "gantry_tau_f1": (-60, 14),
    "gantry_tau_queensland": (-75, 50),
    "gantry_tau_t2": (-55, 28),
    "h4": (-65, 22),
    "hexaglide": (-55, 30),
    "hexarot": (-30, 22),
    "parallelogram": (-80, 8),
    "scara_tau": (-38, 26),
    "stewart": (-70, 16),
}
VARIANTS = {"gantry_tau": {"arms": "complete"}}
"""Azimuth and elevation in degrees, and arguments, where they are not the usual ones."""


class Shape(NamedTuple):
    """One thing to draw: how far away it is, and its SVG."""

    depth: float
    svg: str


class Solid(NamedTuple):
    """A visual: its link, the joint that moves it, where it is, half its size (3,) [m], and a cylinder's radius or zero."""

    link: str
    joint: int
    place: pin.SE3
    half: np.ndarray
    radius: float

    @property
    def corners(self) -> np.ndarray:
        """Eight corners of a box, both ends of a cylinder (n, 3) [m]."""
        if self.radius:
            local = np.outer([-1, 1], self.half)
        else:
            local = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * self.half
        return local @ self.place.rotation.T + self.place.translation

    def nearest(self, point: np.ndarray) -> np.ndarray:
        """Return its point that is nearest to a point [m]."""
        return self.place.act(np.clip(self.place.actInv(point), -self.half, self.half))


class View:
    """World points to the page."""

    def __init__(self, azimuth: float, elevation: float, points: np.ndarray) -> None:
        """Fit all points (n, 3) [m] into the page."""
        a, e = np.deg2rad([azimuth, elevation])
        self._axes = np.array(
            [
                [-np.sin(a), np.cos(a), 0],
                [np.cos(a) * np.sin(e), np.sin(a) * np.sin(e), -np.cos(e)],
                [-np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), -np.sin(e)],
            ]
        )
        flat = points @ self._axes[:2].T
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
        self.scale = float(np.min(room / np.maximum(high - low, 1e-6)))
        self._shift = np.array([WIDTH, HEIGHT]) / 2 - self.scale * (low + high) / 2

    def page(self, points: np.ndarray) -> np.ndarray:
        """Return places on the page (n, 2)."""
        return self.scale * (np.atleast_2d(points) @ self._axes[:2].T) + self._shift

    def depth(self, point: np.ndarray) -> float:
        """Return how far away a point is [m]; larger is farther."""
        return float(self._axes[2] @ point)


def draw(robot: Robot, azimuth: float, elevation: float) -> str:
    """Return a robot at home as SVG."""
    solver = LoopSolver(robot)
    model, data, q = robot.model, solver.data, solver.close(robot.home)
    pin.computeJointJacobians(model, data, q)
    pin.updateFramePlacements(model, data)
    solids = _solids(robot, data)
    view = View(azimuth, elevation, np.concatenate([solid.corners for solid in solids]))
    shapes = [_shape(view, solid) for solid in solids]
    shapes += _struts(view, robot, data, solids)
    shapes += [_dot(view, data.oMf[loop.frame_a].translation) for loop in robot.loops]
    ordered = [s.svg for s in sorted(shapes, key=lambda s: -s.depth)]
    parts = [*ordered, *_tool(view, robot, data), *_names(view, robot, data)]
    title = f"<title>{robot.name} at home</title>"
    style = "<style>text{font:11px sans-serif;fill:#1f4e79;paint-order:stroke;stroke:#fff;stroke-width:3px}</style>"
    ground = f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
    return "\n".join([head + title + style + ground, *parts, "</svg>\n"])


def _solids(robot: Robot, data: pin.Data) -> list[Solid]:
    """Return all boxes and cylinders of the file."""
    found = []
    for link in fromstring(robot.urdf).findall("link"):
        name = link.get("name", "")
        frame = robot.model.getFrameId(name, pin.FrameType.BODY)
        for visual in link.findall("visual"):
            place = data.oMf[frame] * _origin(visual)
            box, cylinder = visual.find("geometry/box"), visual.find("geometry/cylinder")
            if box is not None:
                half, radius = np.array([float(x) for x in box.get("size", "").split()]) / 2, 0.0
            elif cylinder is not None:
                half = np.array([0, 0, float(cylinder.get("length", "0")) / 2])
                radius = float(cylinder.get("radius", "0"))
            else:
                continue
            found.append(Solid(name, robot.model.frames[frame].parentJoint, place, half, radius))
    return found


def _origin(visual: Element) -> pin.SE3:
    origin = visual.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    xyz, rpy = (np.array([float(x) for x in origin.get(key, "0 0 0").split()]) for key in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz)


def _shape(view: View, solid: Solid) -> Shape:
    fill, line = _colours(solid.link)
    places = view.page(solid.corners)
    depth = np.inf if solid.link == "base_link" else view.depth(solid.place.translation)
    if solid.radius:
        width = max(2 * solid.radius * view.scale, 1.6)
        return Shape(
            depth, f'<path d="{_path(places)}" stroke="{line}" stroke-width="{width:.1f}" stroke-linecap="round"/>'
        )
    hull = places[ConvexHull(places).vertices]
    return Shape(depth, f'<path d="{_path(hull)}Z" fill="{fill}" fill-opacity=".85" stroke="{line}" stroke-width="1"/>')


def _struts(view: View, robot: Robot, data: pin.Data, solids: list[Solid]) -> list[Shape]:
    """Return thin lines from bodies to the joints they carry beside what is drawn of them."""
    found = []
    for joint, place in _carried(robot, data):
        spots = [(s.nearest(place), s.link) for s in solids if s.joint == joint]
        if not spots:
            continue
        spot, link = min(spots, key=lambda s: float(np.linalg.norm(s[0] - place)))
        if np.linalg.norm(spot - place) * view.scale < 2:
            continue
        ends = _path(view.page(np.array([spot, place])))
        line = f'<path d="{ends}" stroke="{_colours(link)[1]}" stroke-width="1.6"/>'
        found.append(Shape(np.inf if link == "base_link" else view.depth(place), line))
    return found


def _carried(robot: Robot, data: pin.Data) -> list[tuple[int, np.ndarray]]:
    """Return the carrying body's joint and the place [m] of all joints, loop ends and the tool, but the plate's first."""
    model = robot.model
    joints = [j for j in range(1, model.njoints) if model.names[j] != "plate_x"]
    frames = [f for loop in robot.loops for f in (loop.frame_a, loop.frame_b)]
    frames += [] if robot.tool_frame is None else [robot.tool_frame]
    return [(model.parents[j], data.oMi[j].translation) for j in joints] + [
        (model.frames[f].parentJoint, data.oMf[f].translation) for f in frames
    ]


def _colours(name: str) -> tuple[str, str]:
    """Return fill and line of a link."""
    if name == "base_link":
        return "#d9d9d9", "#a0a0a0"
    if name.startswith(("plate", "bar")):
        return "#f6c28b", "#b5651d"
    return ("#555", "#555") if name.startswith(("rod", "triangle")) else ("#9dc3e6", "#2e75b6")


def _dot(view: View, point: np.ndarray) -> Shape:
    x, y = view.page(point)[0]
    return Shape(view.depth(point) - 1e-3, f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="#222"/>')


def _tool(view: View, robot: Robot, data: pin.Data) -> list[str]:
    if robot.tool_frame is None:
        return []
    tool, size, parts = data.oMf[robot.tool_frame], 26 / view.scale, []
    for axis, colour in zip(tool.rotation.T, ("#d62728", "#2ca02c", "#1f77b4"), strict=True):
        ends = view.page(np.array([tool.translation, tool.translation + size * axis]))
        parts.append(f'<path d="{_path(ends)}" stroke="{colour}" stroke-width="2"/>')
    return parts


def _names(view: View, robot: Robot, data: pin.Data) -> list[str]:
    """Return the driven joints' names, those of joints close together in one label, which stands left of the joint."""
    groups: list[tuple[np.ndarray, list[str]]] = []
    for name in robot.actuated:
        spot = view.page(data.oMi[robot.model.getJointId(name)].translation)[0]
        near = next((names for place, names in groups if np.linalg.norm(place - spot) < 16), None)
        if near is None:
            groups.append((spot, [name]))
        else:
            near.append(name)
    return [
        f'<text x="{max(x - 16, 5.5 * len(", ".join(names))):.1f}" y="{y - 4:.1f}" text-anchor="end">{", ".join(names)}</text>'
        for (x, y), names in groups
    ]


def _path(points: np.ndarray) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def main() -> None:
    """Draw them all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "figures" / "robots")
    parser.add_argument("--only", nargs="*", help="short names; all without it")
    given = parser.parse_args()
    for name in given.only or short_names():
        robot = load_robot(name, **VARIANTS.get(name, {}))
        write_whole(given.out / f"{name}.svg", draw(robot, *VIEWS.get(name, (-62, 18))))
        print(f"{given.out / name}.svg")


if __name__ == "__main__":
    main()
