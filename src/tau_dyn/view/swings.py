"""Mode shapes on the robot: the swung robot over the pale one at rest, and arrows where the sensors are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull, QhullError

from tau_dyn.modes import ModeShape, ShapesOnRobot
from tau_dyn.view.palette import NAMED, ROLES, escape_html
from tau_dyn.view.placement import convert_to_wxyz
from tau_dyn.view.scene import compute_link_pose

if TYPE_CHECKING:
    from tau_dyn.view.viewer import Viewer

MEASURED, OWN = "measured", "robot file's springs"
_REACH = 0.07
"""Largest displacement, as a share of the robot's size."""
_MOVES = 0.04
"""Share of the largest displacement below which a link is not drawn: it would lie on the one at rest."""
_PERIOD = 1.6
"""Time of one swing on the screen at speed 1 [s]; real frequencies are too fast to see."""


class SwingPanel:
    """Plays the modes of one result."""

    def __init__(self, viewer: Viewer, shapes: ShapesOnRobot) -> None:
        """Add the panel with the first mode swinging."""
        self._viewer, self._shapes, self._phase = viewer, shapes, 0.0
        gui = viewer.server.gui
        titles = [f"{k + 1}. {p.measured.frequency_hz:.4g} Hz" for k, p in enumerate(shapes.pairs)]
        self._pairs = dict(zip(titles, shapes.pairs, strict=True))
        with gui.add_folder("modes"):
            self._mode = gui.add_dropdown("mode", titles, initial_value=titles[0])
            self._source = gui.add_dropdown("shape", (MEASURED, OWN), initial_value=MEASURED)
            self._size = gui.add_slider("size", 0.1, 3.0, 0.1, 1.0)
            self._speed = gui.add_slider("speed", 0.0, 3.0, 0.1, 1.0)
            self._said = gui.add_html("")
        viewer.figure.paint({})
        self._bodies = [_Body(viewer, f"/swing/{k}", x, viewer.size) for k, x in enumerate(shapes.skeleton.links)]
        self._mode.on_update(lambda _: self._say())
        self._source.on_update(lambda _: self._say())
        viewer.every_frame(self.tick)
        self._say()

    @property
    def swing(self) -> ModeShape:
        """The shape that is shown; the measured one where the robot file has none."""
        pair = self._pairs[self._mode.value]
        return pair.model if self._source.value == OWN and pair.model is not None else pair.measured

    def tick(self, seconds: float) -> None:
        """Go on by so much time [s]."""
        if not self._speed.value:
            return
        self._phase += 2 * np.pi * seconds * float(self._speed.value) / _PERIOD
        self.draw(np.exp(1j * self._phase))

    def draw(self, turn: complex) -> None:
        """Draw the swing at a phase, a complex number of size 1."""
        reach = _REACH * self._viewer.size * float(self._size.value)
        with self._viewer.lock, self._viewer.server.atomic():
            for body, moved in zip(self._bodies, self.swing.links, strict=True):
                body.move(reach * np.real(moved * turn))

    def _say(self) -> None:
        pair, swing = self._pairs[self._mode.value], self.swing
        said = f"{swing.frequency_hz:.5g} Hz, damping {100 * swing.damping_ratio:.2g} %"
        if pair.model is None:
            said += "; the robot file has no spring whose mode is like it"
        else:
            said += f"; measured and robot file agree in shape to MAC {pair.mac:.3f}"
        self._said.content = escape_html(said)
        for body, moved in zip(self._bodies, swing.links, strict=True):
            body.seen(bool(np.abs(moved).max() > _MOVES))
        self._draw_arrows(swing)
        self.draw(np.exp(1j * self._phase))

    def _draw_arrows(self, swing: ModeShape) -> None:
        """Draw how far each sensor swings to either side."""
        reach = 2.2 * _REACH * self._viewer.size * float(self._size.value)
        rows = []
        for place, at in self._shapes.skeleton.places.items():
            moved = np.real(swing.arrows.get(place, np.zeros(3))) * reach
            rows += [[at, at + moved], [at, at - moved]]
        thick = 0.004 * self._viewer.size
        self._viewer.server.scene.add_arrows("/swing/arrows", np.array(rows, np.float32), NAMED, shaft_radius=thick,
                                             head_radius=2.5 * thick, head_length=6 * thick)  # fmt: skip


class _Body:
    """A link of the skeleton: a rod between two points, or the hull of more."""

    def __init__(self, viewer: Viewer, path: str, points: np.ndarray, size: float) -> None:
        self._rest = points
        scene, radius = viewer.server.scene, 0.006 * size
        self._rod: Any = None
        self._hull: Any = None
        if len(points) > 2 and (faces := _faces(points)) is not None:
            self._middle = points.mean(axis=0)
            self._hull = scene.add_mesh_simple(
                path, points - self._middle, faces, color=ROLES["plate"], side="double", opacity=0.85, flat_shading=True
            )
        else:
            length = float(np.linalg.norm(points[-1] - points[0]))
            self._rod = scene.add_cylinder(path, radius, length, ROLES["plate"])
        self.move(np.zeros_like(points))

    def seen(self, visible: bool) -> None:
        """Show or hide it."""
        (self._rod or self._hull).visible = visible

    def move(self, moved: np.ndarray) -> None:
        """Move the points by so much (n, 3) [m]; a hull stays rigid."""
        handle = self._rod or self._hull
        now = self._rest + moved
        if self._rod is not None:
            handle.position, handle.wxyz = compute_link_pose(now[0], now[-1])
            return
        middle = now.mean(axis=0)
        handle.position, handle.wxyz = middle, _turn(self._rest - self._middle, now - middle)


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the turn that takes points (n, 3) nearest to others (Kabsch), as quaternion (4,) w x y z."""
    u, _, vt = np.linalg.svd(before.T @ after)
    sign = np.sign(np.linalg.det(u @ vt)) or 1.0
    return convert_to_wxyz(pin.Quaternion(vt.T @ np.diag([1.0, 1.0, sign]) @ u.T))


def _faces(points: np.ndarray) -> np.ndarray | None:
    """Return the faces (m, 3) of the hull of points; three or more in a plane make a fan; None on a line."""
    try:
        return ConvexHull(points).simplices
    except (QhullError, ValueError):
        flat = points - points.mean(axis=0)
        if np.linalg.matrix_rank(flat, tol=1e-6) < 2:
            return None
        axes = np.linalg.svd(flat)[2][:2]
        order = np.argsort(np.arctan2(flat @ axes[1], flat @ axes[0]))
        return np.array([[order[0], order[k], order[k + 1]] for k in range(1, len(order) - 1)])
