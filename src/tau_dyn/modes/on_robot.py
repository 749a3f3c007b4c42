r"""Mode shapes on the robot itself: what sensors saw moves the drawing, and a robot file's springs say what else should move.

A measured shape is known where sensors are. Outputs named by axis and place (`x_tool`, `ay_plate`) move that place; the body
that carries the tool goes along without turning, and what joins it yields: rods of a parallel robot at one end, the
links of a serial arm more the farther out they are. A robot file with springs has shapes of its own (`FlexibleModel`), in which
every link moves as it must. The two are compared over the outputs by the modal assurance criterion,

    MAC = |a' b|^2 / (|a|^2 |b|^2),

and paired so that agreement in shape and in frequency together is largest. Reference: Allemang 2003; Ewins 2000, 5.4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from tau_dyn.exceptions import TauDynError
from tau_dyn.modes.figure import MechanismFigure, Skeleton
from tau_dyn.modes.modal import Mode
from tau_dyn.robot import Robot

_STEP = 1e-4  # [m or rad] of the largest spring: how far shapes are followed
_MAX_LOG_FREQUENCY_RATIO = 0.7
"""Logarithm of a ratio of frequencies from which on two modes are never the same."""


@dataclass(frozen=True, eq=False)
class ModeShape:
    """One shape on a skeleton.

    Attributes:
        frequency_hz: Undamped natural frequency [Hz].
        damping_ratio: Part of critical damping.
        links: Displacement (n, 3) of the skeleton's points, complex, the largest of them 1.
        arrows: Displacement (3,) of each place, complex, on the same scale.
    """

    frequency_hz: float
    damping_ratio: float
    links: tuple[np.ndarray, ...]
    arrows: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class ModePair:
    """A measured mode, and the robot file's own mode that is most like it.

    Attributes:
        measured: As sensors saw it.
        model: From the file's springs; None where it has none, or none is near.
        mac: Modal assurance criterion of the two over the outputs; nan where there is no model.
    """

    measured: ModeShape
    model: ModeShape | None
    mac: float


@dataclass(frozen=True, eq=False)
class ShapesOnRobot:
    """All modes on one robot."""

    robot: Robot
    skeleton: Skeleton
    pairs: tuple[ModePair, ...]

    def to_list(self) -> list[dict[str, float | None]]:
        """Return for every measured mode the robot file's own that is most like it, and the likeness."""
        return [
            {
                "frequency_hz": pair.measured.frequency_hz,
                "model_frequency_hz": None if pair.model is None else pair.model.frequency_hz,
                "mac": None if pair.model is None else pair.mac,
            }
            for pair in self.pairs
        ]


def find_sensed_places(outputs: Sequence[str]) -> dict[str, dict[int, int]]:
    """Return place -> axis (0, 1, 2) -> output, of outputs such as `x_tool`, `ay_tool`; without a place they are the tool's."""
    found: dict[str, dict[int, int]] = {}
    for k, name in enumerate(outputs):
        match = re.fullmatch(r"[av]?([xyz])(?:_(\w+))?", name)
        if match:
            found.setdefault(match[2] or "tool", {}).setdefault("xyz".index(match[1]), k)
    return found


def project_shapes_on_robot(robot: Robot, modes: Sequence[Mode], outputs: Sequence[str]) -> ShapesOnRobot | None:
    """Return measured modes on a robot, beside its own; None where no output names a place of it or it cannot be drawn."""
    try:
        figure = MechanismFigure.of(robot)
    except TauDynError:
        return None
    places = {name: axes for name, axes in find_sensed_places(outputs).items() if figure.frame(name) is not None}
    if not places or not modes:
        return None
    rest = figure.points(figure.q)
    skeleton = figure.skeleton(rest, tuple(places))
    measured = [_measured(mode, places, skeleton) for mode in modes]
    own = _own(figure, places, rest)
    pairs = _paired(modes, measured, own, places)
    return ShapesOnRobot(robot, skeleton, pairs)


def _measured(mode: Mode, places: dict[str, dict[int, int]], skeleton: Skeleton) -> ModeShape:
    arrows = {name: _vector(mode.shape, axes) for name, axes in places.items()}
    tool = arrows.get("tool", next(iter(arrows.values())))
    return _scaled(mode.frequency_hz, mode.damping_ratio, [np.outer(share, tool) for share in skeleton.carries], arrows)


def _vector(shape: np.ndarray, axes: dict[int, int]) -> np.ndarray:
    out = np.zeros(3, complex)
    for axis, k in axes.items():
        out[axis] = shape[k]
    return out


def _scaled(frequency: float, damping: float, links: Sequence[np.ndarray], arrows: dict[str, np.ndarray]) -> ModeShape:
    """Return a swing whose largest displacement is 1 and real."""
    everything = np.concatenate([*links, *(x[None] for x in arrows.values())])
    top = everything.flat[np.argmax(np.abs(everything))] or 1.0
    return ModeShape(frequency, damping, tuple(x / top for x in links), {k: x / top for k, x in arrows.items()})


def _own(figure: MechanismFigure, places: dict[str, dict[int, int]], rest: list[np.ndarray]) -> list[ModeShape]:
    """Return the modes of the robot file's springs, slowest first; none where it has none."""
    if figure.flexible is None:
        return []
    found = []
    for mode in figure.flexible.at().modes():
        parts = []
        for s in (mode.springs.real, mode.springs.imag):
            size = max(float(np.abs(s).max()), 1e-12)
            moved = dict(zip([x.joint for x in figure.flexible.robot.springs], _STEP * s / size, strict=True))
            q = np.array([figure.home[j] + moved.get(j, 0.0) for j in figure.robot.actuated])
            links = [(x - y) * size / _STEP for x, y in zip(figure.points(q), rest, strict=True)]
            parts.append((links, {p: figure.at(("frame", figure.frame(p) or 0)) for p in places}, size))
        figure.points(figure.q)
        home = {p: figure.at(("frame", figure.frame(p) or 0)) for p in places}
        (one, at_one, a), (other, at_other, b) = parts
        links = [x + 1j * y for x, y in zip(one, other, strict=True)]
        arrows = {p: ((at_one[p] - home[p]) * a + 1j * (at_other[p] - home[p]) * b) / _STEP for p in places}
        found.append(_scaled(mode.frequency_hz, mode.damping_ratio, links, arrows))
    return found


def compute_mac(a: np.ndarray, b: np.ndarray) -> float:
    """Return the modal assurance criterion of two shapes (p,) complex; 0 where one is zero."""
    size = float(np.vdot(a, a).real * np.vdot(b, b).real)
    return float(abs(np.vdot(a, b)) ** 2 / size) if size > 0 else 0.0


def _paired(
    modes: Sequence[Mode], measured: Sequence[ModeShape], own: Sequence[ModeShape], places: dict[str, dict[int, int]]
) -> tuple[ModePair, ...]:
    """Return each measured mode with the robot's own that agrees best in shape and frequency."""
    seen = [(name, axis, k) for name, axes in places.items() for axis, k in axes.items()]
    mac = np.zeros((len(modes), len(own)))
    away = np.full((len(modes), len(own)), np.inf)
    for i, mode in enumerate(modes):
        for j, swing in enumerate(own):
            mac[i, j] = compute_mac(
                mode.shape[[k for _, _, k in seen]], np.array([swing.arrows[n][x] for n, x, _ in seen])
            )
            away[i, j] = abs(np.log(mode.frequency_hz / swing.frequency_hz))
    fits = np.where(away < _MAX_LOG_FREQUENCY_RATIO, mac * (1 - away / _MAX_LOG_FREQUENCY_RATIO), 0.0)
    chosen = dict(zip(*linear_sum_assignment(-fits), strict=True)) if own else {}
    pairs = []
    for i, swing in enumerate(measured):
        j = chosen.get(i)
        near = j is not None and fits[i, j] > 0
        pairs.append(
            ModePair(swing, own[j] if near and j is not None else None, float(mac[i, j]) if near else float("nan"))
        )
    return tuple(pairs)
