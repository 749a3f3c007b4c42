"""Bounds of a motion as numbers that must not exceed zero, with the derivatives that a search needs.

Each bound is relative to its limit: `|x| / limit - 1`, or the distance beyond a range over half of it. Bounds on states (speed,
acceleration, force) follow from the path and the forces; bounds on places (the loops' conditioning, the tool's box, passive
joints) are functions of q alone, differenced joint by joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import LoopArrays, LoopSolver, list_joints
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import MotionProfile, compute_condition_bound

MARGIN = 0.05
"""Share of every limit that stays unused, as of all motions (`simulate/limits.py`)."""
_STEP = 1e-6  # m or rad, of forward differences; places are known to 1e-15 of their size


class Excess(NamedTuple):
    """One family of bounds along a path: values (n, m), and their derivatives.

    `by` lists (kind, joint, derivative (n, m)); kind is 0, 1, 2 for q, v, a.
    """

    name: str
    values: np.ndarray
    by: list[tuple[int, int, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Bounds:
    """The limits of one design.

    Attributes:
        model: The robot, with the friction that forces include.
        low: Lowest positions (na,) [m or rad].
        high: Highest positions (na,).
        speed: Highest speeds (na,).
        acceleration: Highest accelerations (na,).
        effort: Largest forces (na,), inf without a limit.
        condition: Largest conditioning of the loops.
        box: Corners of the tool's box (2, 3) [m], or None.
        passive: Whether passive joints keep the limits of the robot file.
    """

    model: Model
    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    effort: np.ndarray
    condition: float
    box: np.ndarray | None = None
    passive: bool = True

    @classmethod
    def of(
        cls,
        model: Model,
        reach: np.ndarray,
        speed: np.ndarray,
        acceleration: np.ndarray,
        box: np.ndarray | None = None,
        condition: float | None = None,
    ) -> Bounds:
        """Return the limits of a robot with the usual margin; `reach` (na,) limits joints without a range.

        Raises:
            InputError: The tool is outside its box at home, or the robot has no tool.
        """
        robot = model.robot
        inset = MARGIN / 2 * np.where(np.isfinite(robot.upper - robot.lower), robot.upper - robot.lower, 0.0)
        low = np.where(np.isfinite(robot.lower), robot.lower + inset, robot.home - reach)
        high = np.where(np.isfinite(robot.upper), robot.upper - inset, robot.home + reach)
        if box is not None:
            tool = model.mechanism.tool_position(robot.home[None])[0]
            if np.any(box[0] >= box[1]):
                raise InputError(
                    "invalid_value", "the tool's box must be given as its lowest corner, then its highest: X Y Z X Y Z"
                )
            if np.any((tool < box[0]) | (tool > box[1])):
                place = ", ".join(f"{x:.3g}" for x in tool)
                raise InputError(
                    "invalid_value",
                    f"the tool's box does not hold the tool at home ({place}) m, where every motion starts",
                )
        speed = np.minimum(speed, (1 - MARGIN) * robot.velocity_limit)
        most = compute_condition_bound(model) if condition is None else condition
        return cls(model, low, high, speed, acceleration, (1 - MARGIN) * robot.effort_limit, most, box)

    def of_states(
        self, path: MotionProfile, tau: np.ndarray, by_tau: list[tuple[int, int, np.ndarray]]
    ) -> list[Excess]:
        """Return bounds on range, speed, acceleration and force along a path (n, na); `by_tau` are the forces' derivatives."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        made = [
            _symmetric("range", 0, path.q - middle, half),
            _symmetric("speed", 1, path.v, self.speed),
            _symmetric("acceleration", 2, path.a, self.acceleration),
        ]
        if np.isfinite(self.effort).any():
            by = [(kind, j, np.sign(tau) * d / self.effort) for kind, j, d in by_tau]
            made.append(Excess("force", np.abs(tau) / self.effort - 1, by))
        return made

    def of_places(self, q: np.ndarray, *, slopes: bool = True) -> list[Excess]:
        """Return the bounds that depend on the place alone, at positions (n, na).

        Raises:
            LoopClosureError: A position is out of reach.
        """
        values = self._places(q)
        if values.shape[1] == 0:
            return []
        by = []
        for j in range(q.shape[1] if slopes else 0):
            moved = q.copy()
            moved[:, j] += _STEP
            by.append((0, j, (self._places(moved) - values) / _STEP))
        found = [Excess("place", values, by)]
        return found + ([self._passive(q, slopes)] if self.passive and len(self._limited[0]) else [])

    def _places(self, q: np.ndarray) -> np.ndarray:
        parts = [np.zeros((len(q), 0))]
        if self.model.robot.loops:
            parts.append(np.log(self.model.mechanism.condition(q) / self.condition)[:, None])
        if self.box is not None:
            middle, half = self.box.mean(axis=0), (1 - MARGIN) * (self.box[1] - self.box[0]) / 2
            off = (self.model.mechanism.tool_position(q) - middle) / half
            parts += [off - 1, -off - 1]
        return np.hstack(parts)

    @property
    def _limited(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return indices into configuration and velocity of the passive joints with a range, and its middle and half."""
        model, robot = self.model.robot.model, self.model.robot
        found = []
        for j in range(1, model.njoints):
            one = model.joints[j]
            if model.names[j] in robot.actuated or one.nq != 1 or not robot.loops:
                continue
            low, high = model.lowerPositionLimit[one.idx_q], model.upperPositionLimit[one.idx_q]
            if np.isfinite(high - low) and 0 < high - low < 1e6:
                found.append((one.idx_q, one.idx_v, (low + high) / 2, (1 - MARGIN) * (high - low) / 2))
        q, v, middle, half = np.array(found).reshape(-1, 4).T
        return q.astype(int), v.astype(int), middle, half

    def _passive(self, q: np.ndarray, slopes: bool) -> Excess:
        """Return the bounds of passive joints by their ranges."""
        index_q, index_v, middle, half = self._limited
        solver, arrays = _build_closer(self.model.robot)
        if arrays is not None:
            closed = arrays.close(q)
            place, slope = closed.x[index_v].T, np.moveaxis(closed.G[index_v], 2, 0)
        else:
            rest = np.zeros(q.shape[1])
            states = [solver.state(one, rest, rest) for one in q]
            place, slope = np.array([x.q[index_q] for x in states]), np.array([x.G[index_v] for x in states])
        off = (place - middle) / half
        by = [(0, j, np.sign(off) * slope[:, :, j] / half) for j in range(q.shape[1])] if slopes else []
        return Excess("passive joints", np.abs(off) - 1, by)


@lru_cache(maxsize=2)
def _build_closer(robot: Robot) -> tuple[LoopSolver, LoopArrays | None]:
    """Return the solvers of a robot's loops, for one position and for many."""
    solver = LoopSolver(robot)
    joints = list_joints(solver.model)
    return solver, None if joints is None else LoopArrays(solver, joints)


def _symmetric(name: str, kind: int, x: np.ndarray, limit: np.ndarray) -> Excess:
    by = []
    for j in range(x.shape[1]):
        slope = np.zeros_like(x)
        slope[:, j] = np.sign(x[:, j]) / limit[j]
        by.append((kind, j, slope))
    return Excess(name, np.abs(x) / limit - 1, by)
