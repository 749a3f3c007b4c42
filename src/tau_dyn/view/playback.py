"""A log as a motion to play: the measured motion, and a ghost of the simulated or commanded one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.log import Log
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import Robot
from tau_dyn.view.scene import Placer, RobotFigure, Window
from tau_dyn.view.shapes import GHOST, ROLES, escape_html, format_keys

FRAMES_HZ = 30.0  # Hz, a usual frame rate of screens and films
_TRAIL = 2000
"""Largest number of points of the tool's path."""


@dataclass(frozen=True, eq=False)
class Playback:
    """A motion resampled to the frame rate.

    Attributes:
        t: Time (n,) [s] from zero.
        q: Measured actuated positions (n, na).
        ghost: Simulated or commanded positions at the same times (n, na), or None.
        ghost_is: Kind of the ghost: `simulated` or `commanded`.
    """

    t: np.ndarray
    q: np.ndarray
    ghost: np.ndarray | None
    ghost_is: str = "commanded"

    def at(self, t: float) -> int:
        """Return the index of the frame at a time [s]."""
        return min(int(np.searchsorted(self.t, t - 1e-9)), len(self.t) - 1)

    def apart(self) -> np.ndarray | None:
        """Return the largest deviation of the ghost from the measured positions, by joint (na,)."""
        return None if self.ghost is None else np.nanmax(np.abs(self.ghost - self.q), axis=0)


def build_playback(log: Log, robot: Robot, simulated: Log | None = None) -> Playback:
    """Return a log as a playback of this robot.

    Args:
        log: A log with the position of every actuated joint.
        robot: The robot.
        simulated: A log of the same motion from the same start. Its positions are the ghost; the default is the references.

    Raises:
        InputError: A log lacks a joint's position, or the logs share no time.
    """
    q = log.joint("q", robot.actuated)
    keep = slice(None, None, max(1, round(log.rate_hz / FRAMES_HZ)))
    t = (log.t - log.t[0])[keep]
    if simulated is not None:
        return Playback(t, q[keep], _resampled(simulated, robot, t), "simulated")
    ghost = log.joint("q_ref", robot.actuated)[keep] if log.has("q_ref", robot.actuated) else None
    return Playback(t, q[keep], ghost)


def _resampled(log: Log, robot: Robot, t: np.ndarray) -> np.ndarray:
    """Return a log's positions at other times (n, na); nan after the end of the log."""
    own, q = log.t - log.t[0], log.joint("q", robot.actuated)
    if own[-1] <= 0:
        raise InputError("too_little_data", "the simulated log has no duration; simulate the motion that was measured")
    return np.column_stack([np.interp(t, own, column, right=np.nan) for column in q.T])


def compute_trail(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the tool's path (m, 3) [m] along positions (n, na), without unreachable positions; empty without a tool."""
    if robot.tool_frame is None or not len(q):
        return np.zeros((0, 3))
    thin = q[:: max(1, len(q) // _TRAIL)]
    found = forward_kinematics(robot, thin)
    return found.poses.position[found.ok]


_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "5", "10")
_ENLARGED = ("1", "10", "100", "1000")


class Player:
    """Plays one motion in a window.

    Attributes:
        playback: The motion.
        playing: Whether the motion is running.
    """

    def __init__(self, viewer: Window, playback: Playback) -> None:
        """Add the panel and show the first frame."""
        self._viewer, self.playback, self.playing, self._drawn = viewer, playback, False, float("nan")
        gui, end = viewer.server.gui, max(float(playback.t[-1]), 1e-3)
        with gui.add_folder("playback"):
            self._time = gui.add_slider("time [s]", 0.0, end, max(end / 2000, 1e-4), 0.0)
            self._button = gui.add_button("play")
            self._speed = gui.add_dropdown("speed", _SPEEDS, initial_value="1")
            self._path = gui.add_checkbox("tool's path", True)
            if playback.ghost is not None:
                self._enlarged = gui.add_dropdown("ghost's distance ×", _ENLARGED, initial_value="1")
                gui.add_html(
                    format_keys({"measured": ROLES["driven"], playback.ghost_is: GHOST}) + _apart(viewer, playback)
                )
                self._enlarged.on_update(lambda _: self._draw(again=True))
        self._ghost, self._place = self._add_ghost()
        self._add_path()
        self._time.on_update(lambda _: self._draw())
        self._button.on_click(self._toggle)
        viewer.every_frame(self._tick)
        self._draw()

    @property
    def t(self) -> float:
        """Time shown [s]."""
        return float(self._time.value)

    def seek(self, t: float) -> None:
        """Show a time [s]."""
        self._time.value = float(np.clip(t, 0.0, self._time.max))
        self._draw()

    def _add_ghost(self) -> tuple[RobotFigure | None, Placer | None]:
        if self.playback.ghost is None:
            return None, None
        viewer = self._viewer
        moving = [s for s in viewer.placer.shapes if s.joint]
        return RobotFigure(viewer.server.scene, "ghost", moving, colour=GHOST, opacity=0.35), Placer(
            viewer.robot, moving
        )

    def _add_path(self) -> None:
        path = compute_trail(self._viewer.robot, self.playback.q)
        if len(path) < 2:
            self._path.visible = False
            return
        points = np.stack([path[:-1], path[1:]], axis=1)
        line = self._viewer.server.scene.add_line_segments(
            "/path", points, (240, 150, 40), thickness=1.2, thickness_units="screen"
        )
        self._path.on_update(lambda _: setattr(line, "visible", self._path.value))

    def _draw(self, again: bool = False) -> None:
        viewer, t = self._viewer, self.t
        with viewer.lock, viewer.server.atomic():
            if t == self._drawn and not again:
                return
            self._drawn, k = t, self.playback.at(t)
            viewer.show(self.playback.q[k])
            if self._ghost is None or self._place is None or self.playback.ghost is None:
                return
            q, other = self.playback.q[k], self.playback.ghost[k]
            try:
                self._ghost.move(self._place(q + float(self._enlarged.value) * (other - q)))
            except (TauDynError, ValueError):
                return  # out of reach, or after the end of the log: the ghost keeps its last pose

    def _toggle(self, _: Any) -> None:
        self.playing = not self.playing
        self._button.label = "pause" if self.playing else "play"

    def _tick(self, seconds: float) -> None:
        if self.playing:
            t = self.t + seconds * float(self._speed.value)
            self.seek(0.0 if t > self._time.max else t)


def _apart(viewer: Window, playback: Playback) -> str:
    far = playback.apart()
    assert far is not None
    units = viewer.robot.position_units
    k = int(np.nanargmax(np.where(np.isfinite(far), far, -1)))
    size = f"{1e3 * far[k]:.3g} mm" if units[k] == "m" else f"{np.rad2deg(far[k]):.3g} deg"
    return escape_html(f"farthest apart: {viewer.robot.actuated[k]}, {size}")
