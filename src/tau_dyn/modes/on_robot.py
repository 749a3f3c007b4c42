"""Mode shapes drawn on the robot: measured ones, and those computed from the springs of the robot file.

A measured shape is known only at the sensors. Outputs named by axis and place (`x_tool`, `ay_plate`) move that place.
The body that carries the tool is drawn in translation without rotation, and the links joined to it are deformed: the
rods of a parallel robot at one end, the links of a serial arm more the farther out they are. A robot file with springs
has computed shapes (`FlexibleModel`), in which every link moves as the mechanism requires. The two are compared over
the outputs by the modal assurance criterion,

    MAC = |a' b|^2 / (|a|^2 |b|^2),

and paired so that agreement in shape and in frequency together is largest. Reference: Allemang 2003; Ewins 2000, 5.4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from tau_dyn.exceptions import TauDynError
from tau_dyn.modes.modal import Mode

if TYPE_CHECKING:
    from tau_dyn.mechanism import FlexibleModel, LoopSolver
    from tau_dyn.robot import Robot

_MAX_DUPLICATE_DISTANCE_M = 1e-4  # [m] between points that are one


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A robot in its home position, as points.

    Attributes:
        links: Points (n, 3) [m] of every link that reaches from somewhere to somewhere else.
        carries: Share (n,) of the tool's motion that each of these points follows if no other motion is known.
        rails: Both ends (2, 3) of the travel of every slide.
        joints: Where the actuated joints are (na, 3).
        places: Where sensors are, by the name of their place.
    """

    links: tuple[np.ndarray, ...]
    carries: tuple[np.ndarray, ...]
    rails: tuple[np.ndarray, ...]
    joints: np.ndarray
    places: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class MechanismFigure:
    """A robot whose springs may move, with the joints and frames to draw, link by link."""

    robot: Robot
    solver: LoopSolver
    home: dict[str, float]
    flexible: FlexibleModel | None
    marks: tuple[tuple[tuple[str, int], ...], ...]

    @classmethod
    def of(cls, robot: Robot) -> MechanismFigure:
        """Prepare a robot at home, its springs free to move."""
        from tau_dyn.mechanism import FlexibleModel, LoopSolver

        flexible = FlexibleModel(robot) if robot.springs or robot.drive_springs else None
        drawn = robot if flexible is None else flexible.freed
        home = dict(zip(robot.actuated, map(float, robot.home), strict=True)) | {s.joint: 0.0 for s in robot.springs}
        bare = cls(drawn, LoopSolver(drawn), home, flexible, ())
        bare.points(bare.q)
        return cls(drawn, bare.solver, home, flexible, bare._marks())

    @property
    def q(self) -> np.ndarray:
        """Home of all joints that may move (n,)."""
        return np.array([self.home[j] for j in self.robot.actuated])

    def frame(self, place: str) -> int | None:
        """Return the frame that a place's name denotes."""
        if place == "tool":
            return self.robot.tool_frame
        model = self.robot.model
        known = [name for name in (place, f"{place}_link") if model.existFrame(name)]
        return model.getFrameId(known[0]) if known else None

    def points(self, q: np.ndarray) -> list[np.ndarray]:
        """Return every link's points (n, 3) at actuated positions."""
        import pinocchio as pin

        data = self.solver.data
        pin.computeJointJacobians(self.robot.model, data, self.solver.close(q))
        pin.updateFramePlacements(self.robot.model, data)
        return [np.array([self.at(mark) for mark in marks]) for marks in self.marks]

    def at(self, mark: tuple[str, int]) -> np.ndarray:
        """Return where a joint or frame was drawn last (3,)."""
        kind, number = mark
        data = self.solver.data
        return (data.oMi[number] if kind == "joint" else data.oMf[number]).translation.copy()

    def _marks(self) -> tuple[tuple[tuple[str, int], ...], ...]:
        """Return the points of each link's drawing: its joint, its children's joints, its loops' ends and the tool."""
        model, robot = self.robot.model, self.robot
        ends = [end for loop in robot.loops for end in (loop.frame_a, loop.frame_b)]
        ends += [] if robot.tool_frame is None else [robot.tool_frame]
        found = []
        for joint in range(1, model.njoints):
            marks = [("joint", joint), *(("joint", c) for c in range(1, model.njoints) if model.parents[c] == joint)]
            marks += [("frame", f) for f in ends if model.frames[f].parentJoint == joint]
            kept: list[tuple[str, int]] = []
            for mark in marks:
                if all(np.linalg.norm(self.at(mark) - self.at(k)) > 1e-6 for k in kept):
                    kept.append(mark)
            if len(kept) > 1:
                found.append(tuple(kept))
        return tuple(found)

    def skeleton(self, links: list[np.ndarray], places: tuple[str, ...]) -> Skeleton:
        """Return the robot at home; its data must be there."""
        model, data, robot = self.robot.model, self.solver.data, self.robot
        joints = {j: data.oMi[model.getJointId(j)].translation.copy() for j in self._driven()}
        rails = []
        for j, at in joints.items():
            k = robot.actuated.index(j)
            if robot.joint_kinds[k] == "prismatic":
                axis = np.reshape(data.J, (6, -1))[:3, model.joints[model.getJointId(j)].idx_v]
                travel = np.array([robot.lower[k], robot.upper[k]]) - self.home[j]
                rails.append(at + np.where(np.isfinite(travel), travel, [-0.5, 0.5])[:, None] * axis)
        where = {p: self.at(("frame", f)) for p in places if (f := self.frame(p)) is not None}
        return Skeleton(tuple(links), self._carried(links), tuple(rails), np.array(list(joints.values())), where)

    def _driven(self) -> tuple[str, ...]:
        """Return the actuated joints, springs left out."""
        return self.robot.actuated if self.flexible is None else self.flexible.robot.actuated

    def _carried(self, links: list[np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return which share of the tool's motion each point follows: the tool's body all, what touches it at that point."""
        model, tool = self.robot.model, self.robot.tool_frame
        if tool is None:
            return tuple(np.zeros(len(x)) for x in links)
        if not self.robot.loops:
            reach = np.linalg.norm(self.at(("frame", tool)) - self.at(("joint", 1))) or 1.0
            root = self.at(("joint", 1))
            return tuple(np.clip(np.linalg.norm(x - root, axis=1) / reach, 0, 1) ** 2 for x in links)
        body = model.frames[tool].parentJoint
        bodies = [x for x, marks in zip(links, self.marks, strict=True) if marks[0] == ("joint", body)]
        held = np.concatenate([*bodies, self.at(("frame", tool))[None]])
        fixed = [x for x, marks in zip(links, self.marks, strict=True) if len(x) > 2 and marks[0] != ("joint", body)]
        slides = [self.at(("joint", model.getJointId(j))) for j in self._driven()]
        return _stretched(links, held, np.concatenate([*fixed, np.array(slides)]))


def _stretched(links: Sequence[np.ndarray], held: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return shares of motion (n,) of links' points (n, 3): 1 where held, 0 where fixed, in proportion to length in between."""
    nodes = np.unique(np.round(np.concatenate(links), 5), axis=0)
    number = [np.array([int(np.argmin(np.linalg.norm(nodes - p, axis=1))) for p in x]) for x in links]
    known = np.full(len(nodes), np.nan)
    for points, share in ((fixed, 0.0), (held, 1.0)):
        near = np.linalg.norm(nodes[:, None] - points[None], axis=2).min(axis=1) < _MAX_DUPLICATE_DISTANCE_M
        known[near] = share
    pull = np.zeros((len(nodes), len(nodes)))
    for x, k in zip(links, number, strict=True):
        if len(k) == 2:
            pull[k[0], k[1]] = pull[k[1], k[0]] = 1 / max(float(np.linalg.norm(x[1] - x[0])), _MAX_DUPLICATE_DISTANCE_M)
    free = np.isnan(known)
    balance = np.diag(pull.sum(axis=1)) - pull
    share = np.where(free, 0.0, known)
    share[free] = np.linalg.lstsq(
        balance[np.ix_(free, free)], -balance[np.ix_(free, ~free)] @ known[~free], rcond=None
    )[0]
    return tuple(np.clip(share[k], 0, 1) for k in number)


_STEP = 1e-4  # [m or rad] of the largest spring: how far shapes are followed
_MAX_LOG_FREQUENCY_RATIO = 0.7  # logarithm of a ratio of frequencies from which on two modes are never the same


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
        measured: The mode measured by the sensors.
        model: The mode computed from the file's springs; None if the file has no springs or no such mode is near.
        mac: Modal assurance criterion of the two over the outputs; nan without a model.
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
    """Return measured modes paired with the robot file's; None if no output names a place or it cannot be drawn."""
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
    """Return the modes of the robot file's springs, slowest first; empty if it has no springs."""
    if figure.flexible is None:
        return []
    found = []
    for mode in figure.flexible.at().modes():
        parts = []
        for s in (mode.springs.real, mode.springs.imag):
            size = max(float(np.abs(s).max()), 1e-12)
            moved = dict(zip([x.joint for x in figure.flexible.springs], _STEP * s / size, strict=True))
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
    """Return the modal assurance criterion of two shapes (p,) complex; 0 if one is zero."""
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
