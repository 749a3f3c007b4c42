"""Shapes in viser's scene: added once, then moved and painted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from tau_dyn.view.palette import NAMED, QUIET, Rgb
from tau_dyn.view.placement import Placed, convert_to_wxyz
from tau_dyn.view.shapes import Shape


class RobotFigure:
    """One robot in the scene.

    Attributes:
        handles: viser's handle of each shape.
    """

    def __init__(
        self, scene: Any, name: str, shapes: Sequence[Shape], *, colour: Rgb | None = None, opacity: float = 1.0
    ) -> None:
        """Add the shapes under a name; a colour makes them all alike, as a ghost is."""
        self._shapes, self._own = tuple(shapes), [colour or s.colour for s in shapes]
        see_through = None if opacity >= 1 else opacity
        self.handles = [
            add_shape(scene, f"/{name}/{k}", s, paint, see_through)
            for k, (s, paint) in enumerate(zip(self._shapes, self._own, strict=True))
        ]

    def move(self, placed: Placed) -> None:
        """Move all shapes."""
        for handle, (position, turn) in zip(self.handles, placed, strict=True):
            handle.position, handle.wxyz = position, turn

    def light(self, named: Collection[int]) -> None:
        """Paint the named shapes in one colour and let the others step back; with none all have their own again."""
        for k, handle in enumerate(self.handles):
            handle.color = self._own[k] if not named else NAMED if k in named else _pale(self._own[k])

    def paint(self, colours: dict[int, Rgb]) -> None:
        """Paint these shapes, all others pale."""
        for k, handle in enumerate(self.handles):
            handle.color = colours.get(k, QUIET)

    def seen(self, visible: bool) -> None:
        """Show or hide it."""
        for handle in self.handles:
            handle.visible = visible


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
    """Return position (3,) and quaternion (4,) of what lies along z from one point to another."""
    return (start + end) / 2, convert_to_wxyz(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), end - start))


def light_scene(scene: Any, shadows: bool) -> None:
    """Light from above, and from all sides so that no face is black."""
    scene.configure_default_lights(cast_shadow=shadows)
    scene.add_light_ambient("/daylight", intensity=0.55)


def compute_outline(shapes: Sequence[Shape], placed: Placed) -> np.ndarray:
    """Return the corners (n, 3) [m] of shapes where they are."""
    return np.concatenate([_corners(s, p, w) for s, (p, w) in zip(shapes, placed, strict=True)])


def add_floor(scene: Any, low: np.ndarray, high: np.ndarray) -> None:
    """Add a grid under what reaches from one corner (3,) to the other, in cells of 1, 10 or 100 mm, cm or m."""
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
    local = shape.size if shape.kind == "hull" else cube * shape.half
    return local @ pin.Quaternion(w, x, y, z).toRotationMatrix().T + position
