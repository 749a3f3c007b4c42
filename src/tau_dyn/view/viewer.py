"""The window: a viser server with the robot, its sliders, and what is shown beside it.

Loopback only unless another address is given: whoever reaches the port sees the robot and moves the sliders. Names from robot
files and logs are shown as plain text.
"""

from __future__ import annotations

import threading
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.robot import Robot
from tau_dyn.view.overlay import Finding, Playback
from tau_dyn.view.placement import Placer
from tau_dyn.view.shapes import shapes_of

LOOPBACK = "127.0.0.1"
COLOURS = {"world": (150, 155, 165), "robot": (70, 110, 170), "named": (200, 60, 40), "ghost": (120, 190, 140)}
_FREE = {"m": 0.5, "rad": 3.1416}
"""How far a slider goes from home where the robot file gives no limit."""
_FRAME = 1 / 30


class Viewer:
    """A robot in the browser; `close` ends it.

    Attributes:
        robot: The robot.
        q: Actuated positions shown (na,).
        message: What stands under the sliders: empty, or why the last positions cannot be reached.
    """

    def __init__(self, robot: Robot, *, host: str = LOOPBACK, port: int = 8080) -> None:
        """Open the window with the robot at home.

        Raises:
            InputError: viser is not installed, or the port cannot be opened.
        """
        viser = _viser()
        self.robot, self.q, self.message = robot, np.array(robot.home, float), ""
        self._placer = Placer(robot, shapes_of(robot))
        try:
            with redirect_stdout(StringIO()):  # stdout is ours: viser draws a banner there
                self._server = viser.ViserServer(host=host, port=port, label=f"tau_dyn: {robot.name}", verbose=False)
        except OSError as fault:
            raise InputError(f"{host}:{port} cannot be opened: {fault.strerror or fault}") from fault
        self.url = f"http://{host}:{self._server.get_port()}"
        self._lock, self._setting, self._playing = threading.RLock(), False, threading.Event()
        self._closed = threading.Event()
        self._handles = self._add("robot", COLOURS["robot"], 1.0)
        self._ghost: list[Any] = []
        self._sliders = self._add_sliders()
        self._note = self._server.gui.add_markdown("")
        self._server.scene.world_axes.visible = False
        self._server.scene.set_up_direction("+z")
        self.show(self.q)
        self._look()

    def show(self, q: np.ndarray) -> bool:
        """Show the robot at actuated positions (na,); return whether it can be there. Else it stays and `message` says why."""
        with self._lock:
            try:
                placed = self._placer(np.asarray(q, float))
            except TauDynError as fault:
                self.message = str(fault)
                self._note.content = _plain(f"Cannot be reached: {fault}")
                return False
            self.q, self.message = np.array(q, float), ""
            _move(self._handles, placed)
            self._setting = True
            for slider, value in zip(self._sliders, self.q, strict=True):
                slider.value = float(np.clip(value, slider.min, slider.max))
            self._setting = False
            tool = self._placer.tool
            self._note.content = (
                "" if tool is None else _plain(f"tool at {tool[0]:.4f}, {tool[1]:.4f}, {tool[2]:.4f} m")
            )
            return True

    def play(self, playback: Playback) -> None:
        """Add a time slider and a button that play a log; a ghost follows the reference where there is one."""
        gui, end = self._server.gui, float(playback.t[-1])
        time = gui.add_slider("time [s]", 0.0, max(end, 1e-3), max(end / 2000, 1e-4), 0.0)
        button = gui.add_button("play / pause")
        if playback.ghost is not None:
            self._ghost = self._add("ghost", COLOURS["ghost"], 0.35)
        ghost = Placer(self.robot, self._placer.shapes) if playback.ghost is not None else None

        def at(_: Any) -> None:
            k = min(int(np.searchsorted(playback.t, time.value)), len(playback.t) - 1)
            self.show(playback.q[k])
            if ghost is not None and playback.ghost is not None:
                try:
                    _move(self._ghost, ghost(playback.ghost[k]))
                except TauDynError:
                    return  # a reference beyond reach: the ghost waits where it was

        def toggle(_: Any) -> None:
            self._playing.clear() if self._playing.is_set() else self._playing.set()

        time.on_update(at)
        button.on_click(toggle)
        threading.Thread(target=self._run, args=(time, end), daemon=True).start()
        at(None)

    def name(self, findings: list[Finding]) -> None:
        """List a diagnosis' findings; choosing one colours what its joints carry."""
        if not findings:
            return
        lines = [f"{f.text}: {', '.join(f.joints)}" if f.joints else f.text for f in findings]
        choice = self._server.gui.add_dropdown("finding", ["none", *dict.fromkeys(map(_plain, lines))])
        chosen = dict(zip(map(_plain, lines), findings, strict=True))

        def colour(_: Any) -> None:
            self.light(chosen[choice.value].joints if choice.value in chosen else ())

        choice.on_update(colour)

    def light(self, joints: tuple[str, ...]) -> None:
        """Colour what these joints carry, and nothing else; links may be named too."""
        links = {link.link: self.robot.model.names[link.joint_id] for link in self.robot.links}
        known = set(self.robot.model.names)
        named = {links.get(j, j) for j in joints} & known
        lit = {k for joint in named for k in self._placer.moved_by(joint)}
        for k, handle in enumerate(self._handles):
            colour = COLOURS["named"] if k in lit else self._colour(k, COLOURS["robot"])
            handle.color = colour

    def cloud(self, points: np.ndarray, value: np.ndarray | None = None) -> None:
        """Show points (n, 3) [m], coloured from blue (least) to red (most) by a value (n,)."""
        colours = np.tile(np.array([90, 140, 200], np.uint8), (len(points), 1))
        finite = np.zeros(0) if value is None else value[np.isfinite(value)]
        low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 0.0)
        if value is not None and high > low:
            share = np.nan_to_num((value - low) / (high - low))
            colours = np.column_stack([255 * share, 80 + 0 * share, 255 * (1 - share)]).astype(np.uint8)
        size = 0.004 * float(max(np.ptp(points, axis=0).max(), 0.1)) if len(points) else 0.01
        self._server.scene.add_point_cloud(
            "/cloud", points.astype(np.float32), colours, point_size=size, point_shape="circle"
        )

    def wait(self, seconds: float | None = None) -> None:
        """Keep the window open until `close`, an interrupt, or so many seconds."""
        try:
            self._closed.wait(seconds)
        except KeyboardInterrupt:
            pass
        self.close()

    def close(self) -> None:
        """Close the window."""
        if not self._closed.is_set():
            self._closed.set()
            self._playing.clear()
            with redirect_stdout(StringIO()):
                self._server.stop()

    def _run(self, time: Any, end: float) -> None:
        while not self._closed.wait(_FRAME):
            if self._playing.is_set():
                time.value = 0.0 if time.value >= end else min(end, time.value + _FRAME)

    def _add(self, name: str, colour: tuple[int, int, int], opacity: float) -> list[Any]:
        scene, handles = self._server.scene, []
        see_through = None if opacity >= 1 else opacity
        for k, shape in enumerate(self._placer.shapes):
            path, paint = f"/{name}/{k}", self._colour(k, colour)
            if shape.kind == "box":
                handle = scene.add_box(path, paint, tuple(shape.size), opacity=see_through)
            elif shape.kind == "cylinder":
                handle = scene.add_cylinder(
                    path, float(shape.size[0]), float(shape.size[1]), paint, opacity=see_through
                )
            else:
                handle = scene.add_icosphere(path, float(shape.size[0]), paint, opacity=see_through)
            handles.append(handle)
        return handles

    def _colour(self, k: int, colour: tuple[int, int, int]) -> tuple[int, int, int]:
        return colour if self._placer.shapes[k].joint else COLOURS["world"]

    def _add_sliders(self) -> list[Any]:
        robot, sliders = self.robot, []
        for k, (joint, unit) in enumerate(zip(robot.actuated, robot.position_units, strict=True)):
            low = robot.lower[k] if np.isfinite(robot.lower[k]) else robot.home[k] - _FREE[unit]
            high = robot.upper[k] if np.isfinite(robot.upper[k]) else robot.home[k] + _FREE[unit]
            start = float(np.clip(robot.home[k], low, high))
            sliders.append(
                self._server.gui.add_slider(
                    f"{joint} [{unit}]", float(low), float(high), float(high - low) / 1000, start
                )
            )
        for slider in sliders:
            slider.on_update(self._moved)
        return sliders

    def _moved(self, _: Any) -> None:
        if not self._setting:
            self.show(np.array([s.value for s in self._sliders]))

    def _look(self) -> None:
        """Set the first view: from the front right and above, the whole robot in sight."""
        points = np.array([position for position, _ in self._placer(self.q)])
        centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max(initial=0.3))
        camera = self._server.initial_camera
        camera.position = tuple(centre + size * np.array([1.0, -1.6, 0.8]))
        camera.look_at = tuple(centre)
        self._server.scene.add_grid(
            "/floor", width=6.0, height=6.0, plane="xy", position=(0.0, 0.0, float(points[:, 2].min()))
        )


def _move(handles: list[Any], placed: list[tuple[np.ndarray, np.ndarray]]) -> None:
    for handle, (position, wxyz) in zip(handles, placed, strict=True):
        handle.position, handle.wxyz = position, wxyz


def _plain(text: str) -> str:
    """Return text without what Markdown or HTML would read as more than text."""
    return "".join("\\" + c if c in r"\`*_{}[]()#+-.!<>|&" else c for c in " ".join(text.split()))


def _viser() -> Any:
    try:
        import viser
    except ImportError as fault:
        raise InputError(
            "the viewer needs viser, which is not installed; install tau_dyn with its extra: tau_dyn[view]"
        ) from fault
    return viser
