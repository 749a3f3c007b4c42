"""A robot as a figure of points and lines whose springs may move: what mode shapes are drawn on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from tau_dyn.mechanism import FlexibleModel, LoopSolver
from tau_dyn.robot import Robot

_MAX_DUPLICATE_DISTANCE_M = 1e-4  # [m] between points that are one


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A robot at home as points.

    Attributes:
        links: Points (n, 3) [m] of every link that reaches from somewhere to somewhere else.
        carries: Share (n,) of the tool's motion that each of these points follows where nothing more is known.
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
    """A robot whose springs may move, and what of it is drawn: joints and frames, link by link."""

    robot: Robot
    solver: LoopSolver
    home: dict[str, float]
    flexible: FlexibleModel | None
    marks: tuple[tuple[tuple[str, int], ...], ...]

    @classmethod
    def of(cls, robot: Robot) -> MechanismFigure:
        """Prepare a robot at home, its springs free to move."""
        flexible = FlexibleModel(robot) if robot.springs else None
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
        """Return the frame that a place's name means."""
        if place == "tool":
            return self.robot.tool_frame
        model = self.robot.model
        known = [name for name in (place, f"{place}_link") if model.existFrame(name)]
        return model.getFrameId(known[0]) if known else None

    def points(self, q: np.ndarray) -> list[np.ndarray]:
        """Return every link's points (n, 3) at actuated positions."""
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
        """Return what each link is drawn through: its own joint, its children's, its loops' ends and the tool."""
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
