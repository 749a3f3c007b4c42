"""Panels of results: findings, clouds, error vectors, uncertainty, and modes animated over the pale robot at rest."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.transform import Rotation

from tau_dyn.modes import ModeShape, ShapesOnRobot
from tau_dyn.view.results import Cloud, Content, ErrorVectors, Findings, Uncertainty
from tau_dyn.view.scene import Window, compute_link_pose
from tau_dyn.view.shapes import NAMED, ROLES, escape_html, format_legend, format_panel, map_to_colours

MEASURED, OWN = "measured", "robot file's springs"
_REACH = 0.07
"""Largest displacement, as a share of the robot's size."""
_MOVES = 0.04
"""Share of the largest displacement below which a link is not drawn: it would coincide with the link at rest."""
_PERIOD = 1.6
"""Period of a mode on the screen at speed 1 [s]; real frequencies are too fast to see."""


class SwingPanel:
    """Plays the modes of one result."""

    def __init__(self, viewer: Window, shapes: ShapesOnRobot) -> None:
        """Add the panel and animate the first mode."""
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
        """The mode shape that is shown; the measured one if the robot file does not give one."""
        pair = self._pairs[self._mode.value]
        return pair.model if self._source.value == OWN and pair.model is not None else pair.measured

    def tick(self, seconds: float) -> None:
        """Advance the animation by a time [s]."""
        if not self._speed.value:
            return
        self._phase += 2 * np.pi * seconds * float(self._speed.value) / _PERIOD
        self.draw(np.exp(1j * self._phase))

    def draw(self, turn: complex) -> None:
        """Draw the mode at a phase, given as a complex number of magnitude 1."""
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
        """Draw the amplitude of each sensor in both directions."""
        reach = 2.2 * _REACH * self._viewer.size * float(self._size.value)
        rows = []
        for place, at in self._shapes.skeleton.places.items():
            moved = np.real(swing.arrows.get(place, np.zeros(3))) * reach
            rows += [[at, at + moved], [at, at - moved]]
        thick = 0.004 * self._viewer.size
        self._viewer.server.scene.add_arrows("/swing/arrows", np.array(rows, np.float32), NAMED, shaft_radius=thick,
                                             head_radius=2.5 * thick, head_length=6 * thick)  # fmt: skip


class _Body:
    """A link of the skeleton: a rod between two points, or the hull of three or more."""

    def __init__(self, viewer: Window, path: str, points: np.ndarray, size: float) -> None:
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
        """Show or hide the link."""
        (self._rod or self._hull).visible = visible

    def move(self, moved: np.ndarray) -> None:
        """Displace the points by (n, 3) [m]; a hull stays rigid."""
        handle = self._rod or self._hull
        now = self._rest + moved
        if self._rod is not None:
            handle.position, handle.wxyz = compute_link_pose(now[0], now[-1])
            return
        middle = now.mean(axis=0)
        turn = Rotation.align_vectors(now - middle, self._rest - self._middle)[0]  # nearest, by Kabsch's method
        handle.position, handle.wxyz = middle, turn.as_quat(scalar_first=True)


def _faces(points: np.ndarray) -> np.ndarray | None:
    """Return the faces (m, 3) of the hull of points: a fan for points in a plane, `None` for points on a line."""
    try:
        return ConvexHull(points).simplices
    except (QhullError, ValueError):
        flat = points - points.mean(axis=0)
        if np.linalg.matrix_rank(flat, tol=1e-6) < 2:
            return None
        axes = np.linalg.svd(flat)[2][:2]
        order = np.argsort(np.arctan2(flat @ axes[1], flat @ axes[0]))
        return np.array([[order[0], order[k], order[k + 1]] for k in range(1, len(order) - 1)])


NONE = "none"
_STEPS = tuple(str(int(m * 10**e)) for e in range(6) for m in (1, 2, 5))
"""Selectable magnifications of arrows."""


def add_content(viewer: Window, content: Content) -> Any:
    """Add one content and return its panel."""
    if isinstance(content, Findings):
        return FindingsPanel(viewer, content)
    if isinstance(content, Cloud):
        return CloudPanel(viewer, content)
    if isinstance(content, ErrorVectors):
        return ErrorsPanel(viewer, content)
    if isinstance(content, Uncertainty):
        return UncertaintyPanel(viewer, content)
    return SwingPanel(viewer, content)


def _free_name(viewer: Window, stem: str) -> str:
    """Return a name in the scene that no earlier panel uses."""
    viewer.names[stem] = viewer.names.get(stem, 0) + 1
    return f"/{stem}{viewer.names[stem]}"


class FindingsPanel:
    """A list of findings; the parts of the chosen finding are highlighted, with its sentence and a label next to them."""

    def __init__(self, viewer: Window, findings: Findings) -> None:
        """Add the panel with the first finding chosen."""
        self._viewer, gui = viewer, viewer.server.gui
        titles = [f"{k + 1}. {f.title}" for k, f in enumerate(findings.rows)]
        self._rows = dict(zip(titles, findings.rows, strict=True))
        self._name, self._label = _free_name(viewer, "finding"), None
        with gui.add_folder("findings"):
            gui.add_html(
                escape_html(findings.headline or f"{len(titles)} findings" if titles else "Nothing was found.")
            )
            if titles:
                self._choice = gui.add_dropdown("finding", (NONE, *titles), initial_value=titles[0])
                self._said = gui.add_html("")
                self._choice.on_update(lambda _: self.choose(self._choice.value))
                self.choose(titles[0])

    def choose(self, title: str) -> None:
        """Highlight the parts of a finding."""
        row, viewer = self._rows.get(title), self._viewer
        if self._label is not None:
            self._label.remove()
            self._label = None
        lit = viewer.light(row.parts if row else ())
        if row is None:
            self._said.content = ""
            return
        parts = ", ".join(row.parts) or "the whole robot"
        self._said.content = format_panel(f"<b>{escape(parts)}</b><br>{escape(' '.join(row.sentence.split()))}")
        if lit:
            top = max((viewer.figure.handles[k].position for k in lit[:1]), key=lambda p: p[2])
            place = np.asarray(top) + np.array([0, 0, 0.06 * viewer.size])
            text = f"{row.title}: {row.parts[0]}" + ("" if len(row.parts) == 1 else " …")
            self._label = viewer.server.scene.add_label(self._name, text, position=place, anchor="bottom-center")


class CloudPanel:
    """Points coloured by one of their values, with a colour scale and a cutting plane."""

    def __init__(self, viewer: Window, cloud: Cloud) -> None:
        """Add the panel and the points."""
        self._viewer, self._cloud = viewer, cloud
        self._name = _free_name(viewer, "cloud")
        gui, points = viewer.server.gui, cloud.points
        with gui.add_folder(" ".join(cloud.name.split())):
            if cloud.note:
                gui.add_html(escape_html(cloud.note))
            if len(points):
                self._legend = gui.add_html("")
                self._by = gui.add_dropdown("colour", (*cloud.values, NONE)) if cloud.values else None
                self._cut = None if cloud.flat or np.ptp(points[:, 1]) <= 0 else self._add_cut(gui, points)
                self._shown = gui.add_checkbox("show", True)
        sight = [x for x in (cloud.box, points) if x is not None and len(x)]
        if sight:
            viewer.widen(np.concatenate(sight))
        if cloud.box is not None:
            viewer.server.scene.add_line_segments(f"{self._name}/box", _edges(cloud.box), (120, 128, 140), thickness=1.5,
                                                  thickness_units="screen")  # fmt: skip
        if len(points):
            self._size = _spacing(points) * (1.0 if cloud.flat else 0.3)
            for handle in (self._by, self._cut, self._shown):
                if handle is not None:
                    handle.on_update(lambda _: self.draw())
            self.draw()

    def _add_cut(self, gui: Any, points: np.ndarray) -> Any:
        low, high = float(points[:, 1].min()), float(points[:, 1].max())
        return gui.add_slider("cut: y above [m]", low, high, (high - low) / 200, low)

    def draw(self) -> None:
        """Draw the points with the settings of the panel."""
        cloud, by = self._cloud, None if self._by is None else self._by.value
        value = cloud.values.get(by) if by is not None else None
        colours = map_to_colours(value, len(cloud.points))
        keep = np.ones(len(cloud.points), bool) if self._cut is None else cloud.points[:, 1] >= self._cut.value - 1e-9
        self._legend.content = "" if value is None else format_legend(str(by), value)
        self._viewer.server.scene.add_point_cloud(
            f"{self._name}/points", cloud.points[keep].astype(np.float32), colours[keep], point_size=self._size,
            point_shape="square" if cloud.flat else "circle", point_shading="flat" if cloud.flat else "gradient",
            precision="float32", visible=self._shown.value,
        )  # fmt: skip


class ErrorsPanel:
    """Error vectors as enlarged arrows, coloured by their length."""

    def __init__(self, viewer: Window, errors: ErrorVectors) -> None:
        """Add the panel and the arrows of the first model."""
        self._viewer, self._errors = viewer, errors
        self._name, gui = _free_name(viewer, "errors"), viewer.server.gui
        first = next(iter(errors.models))
        size = float(np.nanmedian(np.linalg.norm(errors.models[first], axis=1)))
        spread = float(np.ptp(errors.points, axis=0).max()) or viewer.size
        wanted = 0.09 * spread / max(size, 1e-9)
        start = min(_STEPS, key=lambda s: abs(np.log(float(s) / max(wanted, 1e-9))))
        with gui.add_folder("calibration errors"):
            self._said = gui.add_html("")
            self._model = gui.add_dropdown("model", tuple(errors.models), initial_value=first)
            self._enlarged = gui.add_dropdown("arrows enlarged ×", _STEPS, initial_value=start)
        viewer.widen(errors.points)
        self._model.on_update(lambda _: self.draw())
        self._enlarged.on_update(lambda _: self.draw())
        self.draw()

    def draw(self) -> None:
        """Draw the chosen model's errors."""
        errors, viewer = self._errors, self._viewer
        vectors = errors.models[self._model.value]
        good = np.isfinite(vectors).all(axis=1)
        length = 1e3 * np.linalg.norm(vectors[good], axis=1)
        first = 1e3 * np.linalg.norm(next(iter(errors.models.values())), axis=1)
        ends = errors.points[good] + float(self._enlarged.value) * vectors[good]
        scale = np.concatenate([length, [0.0, float(np.nanmax(first, initial=0.0))]])  # one scale for all models
        colours = map_to_colours(scale, len(scale))[:-2]
        thick = 0.0035 * viewer.size
        viewer.server.scene.add_arrows(
            self._name, np.stack([errors.points[good], ends], axis=1).astype(np.float32), colours, shaft_radius=thick,
            head_radius=2.4 * thick, head_length=6 * thick,
        )  # fmt: skip
        rms, most = (f"{x:.3g} mm" for x in (np.sqrt(np.mean(length**2)), length.max(initial=0.0)))
        said = f"measured minus predicted at {int(good.sum())} poses: rms {rms}, largest {most}"
        self._said.content = escape_html(said) + format_legend("error [mm]", scale)


class UncertaintyPanel:
    """Links coloured by the relative standard error of their masses; a link is pale if its mass is not determined."""

    def __init__(self, viewer: Window, known: Uncertainty) -> None:
        """Paint the links and add the scale."""
        percent = {k: 100 * v for k, v in known.links.items()}
        finite = {k: v for k, v in percent.items() if np.isfinite(v)}
        value = np.array(list(finite.values()))
        colours = map_to_colours(np.log10(np.maximum(value, 1e-6)), len(value))
        paints = {link: tuple(map(int, c)) for link, c in zip(finite, colours, strict=True)}
        shapes = {k: rgb for link, rgb in paints.items() for k in viewer.placer.carried_by(link)}
        viewer.figure.paint({k: (r, g, b) for k, (r, g, b) in shapes.items()})
        with viewer.server.gui.add_folder("how well masses are known"):
            if len(value):
                viewer.server.gui.add_html(format_legend("standard error [%], logarithmic", value))
            said = {k: f"{v:.2g} %" if np.isfinite(v) else "not determined" for k, v in percent.items()}
            rows = "".join(f"<div>{escape(k)}: {v}</div>" for k, v in said.items())
            viewer.server.gui.add_html(format_panel(rows))


def _spacing(points: np.ndarray) -> float:
    """Return the spacing of points (n, 3) [m]."""
    if len(points) < 2:
        return 0.05
    away, _ = cKDTree(points).query(points[:3000], k=2)
    return max(float(np.median(away[:, 1])), 1e-4)


def _edges(box: np.ndarray) -> np.ndarray:
    """Return the edges (12, 2, 3) of a box with the corners (2, 3)."""
    corner = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    pairs = [(i, j) for i in range(8) for j in range(i) if np.abs(corner[i] - corner[j]).sum() == 1]
    place = np.where(corner == 1, box[1], box[0])
    return np.array([[place[i], place[j]] for i, j in pairs], np.float32)
