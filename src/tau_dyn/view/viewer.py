"""The window: a viser server with the robot, its sliders, and the panels of results.

The server listens on loopback unless another address is given: anyone who reaches the port sees the robot and moves the
sliders. viser's sharing through a relay on the internet is switched off. Text from files is never interpreted as HTML:
labels take plain text, and text in panels is escaped.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from html import escape
from io import StringIO
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.robot import Robot, list_missing_meshes, read_visuals
from tau_dyn.view.panels import add_content
from tau_dyn.view.playback import Playback, Player
from tau_dyn.view.results import Content
from tau_dyn.view.scene import JointFrames, Placer, RobotFigure, add_floor, compute_outline, convert_pose, light_scene
from tau_dyn.view.shapes import build_furniture, format_panel

LOOPBACK = "127.0.0.1"
FRAME = 1 / 30
"""Time between frames [s]."""
_MIN_ASPECT = 1.25
"""Smallest ratio of width to height at which `_aim` shows the robot next to the panel; a narrower window needs more distance."""
_DEGREES = 0.1
"""Step of a slider for a revolute joint [deg]."""
_AWAY = np.array([0.56, -0.98, 0.42])
"""Vector from the robot to the camera, relative to the robot's size."""
_FREE = {"m": 0.5, "rad": 3.1416}
"""Range of a slider around home if the robot file gives no limit."""


class Viewer:
    """A robot in the browser; `close` ends it.

    Attributes:
        robot: The robot.
        q: Actuated positions shown (na,) [m or rad].
        message: Empty, or the reason why the last requested positions cannot be reached.
        warnings: Warnings of the robot, and missing meshes.
        figure: The robot in the scene.
        placer: Poses of its shapes.
        size: Longest side of the robot [m].
        panels: Panels of the results shown.
        names: Number of objects of each kind in the scene.
        server: viser's server.
    """

    def __init__(self, robot: Robot, *, host: str = LOOPBACK, port: int = 8080, shadows: bool = True) -> None:
        """Open the window with the robot at home.

        Args:
            robot: The robot.
            host: Address; the default is this computer only.
            port: Port, or the next free one.
            shadows: Whether shadows are drawn; they are slow without a graphics card.

        Raises:
            InputError: viser is not installed, or the port cannot be opened.
        """
        viser = _viser()
        _refuse_address(host)
        self.robot, self.q, self.message = robot, np.array(robot.home, float), ""
        visuals, missing = read_visuals(robot)
        self.warnings = (*robot.warnings, *list_missing_meshes(missing))
        self.placer = Placer(robot, build_furniture(robot, visuals))
        try:
            with redirect_stdout(StringIO()):  # stdout belongs to the command: viser prints a banner there
                self.server = viser.ViserServer(host=host, port=port, label=f"tau_dyn: {robot.name}", verbose=False)
        except OSError as fault:
            raise InputError("not_available", f"{host}:{port} cannot be opened: {fault.strerror or fault}") from fault
        self.url = f"http://{host}:{self.server.get_port()}"
        self.lock, self.closed = threading.RLock(), threading.Event()
        self.panels: list[Any] = []
        self.names: dict[str, int] = {}
        self._tickers: list[Callable[[float], None]] = []
        self._show_nothing_of_viser()
        light_scene(self.server.scene, shadows)
        self.figure = RobotFigure(self.server.scene, "robot", self.placer.shapes)
        length = self._measure_axes()
        self._tool = self._add_tool(length)
        self._frames = JointFrames(self.server.scene, self.placer, length)
        self._sliders, self._told = self._add_sliders()
        self._add_switch(missing)
        self.show(self.q)
        self.size = self._look()
        self.server.on_client_connect(self._fit)
        threading.Thread(target=self._run, daemon=True).start()

    def show(self, q: np.ndarray) -> bool:
        """Show the robot at actuated positions (na,); return False, with the reason in `message`, if it cannot reach them."""
        with self.lock, self.server.atomic():
            try:
                placed = self.placer(np.asarray(q, float))
            except (TauDynError, ValueError) as fault:
                self.message = str(fault)
                self._note.content = _refusal(f"Cannot be reached, the robot waits. {fault}")
                return False
            self.q, self.message = np.array(q, float), ""
            self.figure.move(placed)
            self._frames.move(self.placer)
            self._tell()
            tool = self.placer.tool
            if tool is not None and self._tool is not None:
                self._tool.position, self._tool.wxyz = convert_pose(tool)
            self._note.content = _where(None if tool is None else tool.translation)
            return True

    def play(self, playback: Playback) -> None:
        """Add the playback of a motion: time, speed, the tool's path, and the ghost if there is one."""
        self.player = Player(self, playback)

    def add(self, contents: Iterable[Content]) -> None:
        """Show contents of results, each with its own panel."""
        self.panels += [add_content(self, content) for content in contents]

    def light(self, parts: Iterable[str]) -> list[int]:
        """Highlight the shapes of these joints, links or rods and make the others pale; return the highlighted ones."""
        lit = sorted({k for part in parts for k in self.placer.carried_by(part)})
        with self.lock, self.server.atomic():
            self.figure.light(lit)
        return lit

    def every_frame(self, ticker: Callable[[float], None]) -> None:
        """Register a function that is called for every frame with the time since the last one [s]."""
        self._tickers.append(ticker)

    def wait(self, seconds: float | None = None) -> None:
        """Keep the window open until `close`, an interrupt, or the end of a time [s]."""
        try:
            self.closed.wait(seconds)
        except KeyboardInterrupt:
            pass
        self.close()

    def close(self) -> None:
        """Close the window."""
        if not self.closed.is_set():
            self.closed.set()
            with redirect_stdout(StringIO()):
                self.server.stop()

    def _run(self) -> None:
        while not self.closed.wait(FRAME):
            for ticker in list(self._tickers):
                ticker(FRAME)

    def _show_nothing_of_viser(self) -> None:
        """Remove viser's logo, and its sharing, which would open the robot to the internet."""
        self.server.request_share_url = lambda *_, **__: None
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", brand_color=(36, 98, 176))
        scene.world_axes.visible = False
        scene.set_up_direction("+z")
        robot = self.robot
        freedoms = (
            f"{robot.na} driven joint{'s' * (robot.na != 1)}, {len(robot.loops)} loop{'s' * (len(robot.loops) != 1)}"
        )
        gui.add_html(format_panel(f'<b style="font-size:1.2em">{escape(robot.name)}</b><br>{freedoms}'))

    def _measure_axes(self) -> float:
        """Return the length of drawn axes [m]."""
        points = np.array([position for position, _ in self.placer(self.q)])
        return 0.09 * float(np.ptp(points, axis=0).max(initial=0.3))

    def _add_tool(self, length: float) -> Any:
        """Add the tool's axes: x red, y green, z blue."""
        if self.robot.tool_frame is None:
            return None
        return self.server.scene.add_frame("/tool", axes_length=length, axes_radius=0.035 * length)

    def _add_sliders(self) -> tuple[list[Any], np.ndarray]:
        robot, sliders = self.robot, []
        self._scale = np.array([1.0 if unit == "m" else 180 / np.pi for unit in robot.position_units])
        with self.server.gui.add_folder("joints [deg]" if "rad" in robot.position_units else "joints"):
            for k, (joint, unit) in enumerate(zip(robot.actuated, robot.position_units, strict=True)):
                low = robot.lower[k] if np.isfinite(robot.lower[k]) else robot.home[k] - _FREE[unit]
                high = robot.upper[k] if np.isfinite(robot.upper[k]) else robot.home[k] + _FREE[unit]
                low, high = float(low * self._scale[k]), float(max(high, low + 1e-6) * self._scale[k])
                if unit == "rad" and high - low > 10 * _DEGREES:  # round numbers within the limits
                    low, high = (np.ceil(low / _DEGREES) * _DEGREES, np.floor(high / _DEGREES) * _DEGREES)
                start = float(np.clip(robot.home[k] * self._scale[k], low, high))
                label = f"{joint} [m]" if unit == "m" else joint
                step = (high - low) / 1000 if unit == "m" else min(_DEGREES, (high - low) / 1000)
                shown = start if unit == "m" else float(np.clip(round(start, 1), low, high))  # as shown: one decimal
                sliders.append(self.server.gui.add_slider(label, round(low, 9), round(high, 9), step, shown))
            home = self.server.gui.add_button("home")
            self._note = self.server.gui.add_html("")
        for slider in sliders:
            slider.on_update(self._moved)
        home.on_click(lambda _: self.show(self.robot.home))
        return sliders, np.array([s.value for s in sliders])

    def _add_switch(self, missing: list[str]) -> None:
        """Add the switch for joint frames, and list missing meshes."""
        switch = self.server.gui.add_checkbox("joint frames", False)
        switch.on_update(lambda _: self._frames.seen(switch.value))
        for sentence in list_missing_meshes(missing):
            self.server.gui.add_html(format_panel(escape(sentence)))

    def _fit(self, client: Any) -> None:
        """Move the camera back in a narrow window, and show the robot above the panel."""
        aspect = float(client.camera.aspect)
        if aspect < _MIN_ASPECT:
            low, high = self._sight.min(axis=0), self._sight.max(axis=0)
            centre, far = (low + high) / 2, _MIN_ASPECT / aspect
            reach = far * float(np.linalg.norm(high - low))
            below = np.array([0.0, 0.0, 0.22 * reach])  # a phone's panel covers the lower half
            client.camera.position = centre + reach * _AWAY - below
            client.camera.look_at = centre - below

    def _tell(self) -> None:
        """Set the sliders to the robot's positions, and store these, so that the change is not taken for a user's input."""
        told = [float(np.clip(x, s.min, s.max)) for s, x in zip(self._sliders, self._scale * self.q, strict=True)]
        self._told = np.array(told)
        for slider, value in zip(self._sliders, told, strict=True):
            if slider.value != value:
                slider.value = value

    def _moved(self, _: Any) -> None:
        with self.lock:
            asked = np.array([s.value for s in self._sliders])
            if not np.array_equal(asked, self._told):
                self._told = asked
                self.show(asked / self._scale)

    def widen(self, points: np.ndarray) -> None:
        """Extend the first view of a page to points (n, 3) [m]."""
        self._sight = np.vstack([self._sight, points])
        self._aim()

    def _look(self) -> float:
        """Set the first view and put the robot on a floor; return its size [m]."""
        self._sight = compute_outline(self.placer.shapes, self.placer(self.q))
        low, high = self._sight.min(axis=0), self._sight.max(axis=0)
        add_floor(self.server.scene, low, high)
        self._aim()
        return float((high - low).max())

    def _aim(self) -> None:
        """Set the camera to the front right and above, with everything in view and space for the panel."""
        low, high = self._sight.min(axis=0), self._sight.max(axis=0)
        centre, reach = (low + high) / 2, float(np.linalg.norm(high - low))
        aside = 0.13 * reach * np.array([-_AWAY[1], _AWAY[0], 0.0]) / np.hypot(*_AWAY[:2])
        camera = self.server.initial_camera
        camera.position = tuple(centre + reach * _AWAY + aside)
        camera.look_at = tuple(centre + aside)
        camera.fov = 0.75


def _where(tool: np.ndarray | None) -> str:
    return "" if tool is None else format_panel(f"tool at x {tool[0]:.4f}, y {tool[1]:.4f}, z {tool[2]:.4f} m")


def _refusal(text: str) -> str:
    return format_panel(f'<span style="color:#d62839">{escape(" ".join(text.split()))}</span>')


def _viser() -> Any:
    try:
        import viser
    except ImportError as fault:
        raise InputError(
            "missing_package",
            "the viewer needs viser, which is not installed; install tau_dyn with its extra: tau_dyn[view]",
        ) from fault
    return viser


def _refuse_address(host: str) -> None:
    """Reject an address that is not of this computer; viser would wait for it without a message.

    Raises:
        InputError: No server can listen there.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(address)
    except (OSError, UnicodeError, ValueError) as fault:
        reason = getattr(fault, "strerror", None) or "no such address"
        raise InputError(
            "not_available",
            f"no server can listen at {host!r}: {reason}; give an address of this computer, such as {LOOPBACK}",
        ) from fault
