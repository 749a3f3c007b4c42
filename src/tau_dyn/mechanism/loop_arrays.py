r"""The closed loops solved for many samples at once, as `loops.py` solves them one by one; arrays have samples last.

Every sample starts from the closure at the middle of its cell of actuated positions, moved along `G`, and Newton steps on all
samples together do the rest. The middles are walked to from home in small steps, which selects home's assembly mode, and are
kept. So a closure depends on its own positions alone, not on the order, block or process of the samples. A sample that does not
converge (near a singularity, at the edge of reach) is left to the one-by-one solver, which reports the reason.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, Protocol, cast

import numpy as np
import pinocchio as pin
from scipy import linalg

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.mechanism.frames import (
    FrameMotion,
    Frames,
    Joint,
    compute_frames,
    compute_motion,
    compute_point_acceleration,
    list_joints,
    remove_rounding,
    transform_point,
    yield_columns,
)
from tau_dyn.mechanism.loops import MAX_CORRECTION, LoopSolver
from tau_dyn.mechanism.small_systems import ILL, CellStarts, Elimination, Entries, Known, invert_matrices
from tau_dyn.robot import Robot

_CELL = 0.05  # [m or rad] as far as one-by-one closures step
_DONE = 1e-6  # [m or rad] largest last step of Newton's method; the remaining error is of the order of its square
_MAX_ITERATIONS = 12  # Newton steps from a neighbour's pose; quadratic convergence needs three to five
_MAX_CELLS_FROM_HOME = 2000  # cells from home beyond which positions are taken for a mistake of units
_MAX_GEOMETRIES = 4  # whose cells are kept
_TRUSTED = 1e-12  # relative residual up to which elimination is as good as LAPACK


class PassiveInverse(Protocol):
    """Interface of the passive Jacobian's (pseudo-)inverse, on arrays (n, ..., N)."""

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p^+ b`."""
        ...

    def solve_transposed(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p'^+ b`."""
        ...


class Dense(NamedTuple):
    """Inverses (N, passive, 3 * loops) of matrices that elimination cannot do."""

    inverse: np.ndarray

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p^+ b`."""
        return np.einsum("npc,c...n->p...n", self.inverse, b)

    def solve_transposed(self, b: np.ndarray) -> np.ndarray:
        """Return `J_p'^+ b`."""
        return np.einsum("npc,p...n->c...n", self.inverse, b)


class ClosedLoops(NamedTuple):
    """Closed configurations.

    Attributes:
        x: Positions of all joints (nv, N).
        at: Frames of the joints.
        inverse: Inverse of the passive constraint Jacobian.
        G: Tree velocity per actuated velocity (nv, na, N).
    """

    x: np.ndarray
    at: Frames
    inverse: PassiveInverse
    G: np.ndarray


class _Ends(NamedTuple):
    """One end of a loop: its joint, its point in that joint's frame, and the joints that carry it."""

    joint: int
    local: np.ndarray
    carriers: tuple[int, ...]


class _Cells(threading.local):
    """A thread's cells of the geometries that were used last."""

    def __init__(self) -> None:
        self.of = lru_cache(maxsize=_MAX_GEOMETRIES)(lambda *geometry: {})


_CELLS = _Cells()


def get_cells(robot: Robot) -> Known:
    """Return the known cells of a robot's geometry, independent of its masses."""
    placed = repr((robot.passive_home, robot.drive_scales, robot.mimics)), robot.home.tobytes()
    return _CELLS.of(robot.model, robot.actuated, robot.loops, *placed)


class LoopArrays:
    """Solves the loops of one robot for arrays of samples."""

    def __init__(self, solver: LoopSolver, joints: list[Joint], known: Known | None = None) -> None:
        """Prepare for the robot and model of a one-by-one solver; `known` are cells of the same geometry."""
        self.solver, self.joints = solver, joints
        robot, model = solver.robot, solver.model
        self.active, self.passive, self.scale = solver.active_v, solver.passive_v, robot.drive_scale
        self._share, self._offset = robot.coupling
        self._by_index = {joint.index: joint for joint in joints}
        self._ends = [(_end(model, loop.frame_a), _end(model, loop.frame_b)) for loop in robot.loops]
        self._cells = CellStarts(np.full(robot.na, _CELL), _MAX_CELLS_FROM_HOME, self._learn, known)
        self._row = {int(v): k for k, v in enumerate(self.passive)}
        self._plan = self._planned()
        self._endless = np.array([model.joints[model.getJointId(j)].nq == 2 for j in robot.actuated])

    def close(self, q: np.ndarray) -> ClosedLoops:
        """Return the closed configurations at actuated positions `q` (N, na).

        Raises:
            LoopClosureError: The robot cannot reach one of them.
        """
        if not self._ends or not len(q):
            return self._without_loops(q)
        x, found = self._newton(*self._started(q))
        for k in np.flatnonzero(~found):
            x[:, k] = self.positions(self.solver.close(q[k]))
        return self._linearised(x)

    def accelerations(self, closed: ClosedLoops, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the tree's accelerations (nv, N) at its velocities `v` (nv, N) and actuated accelerations `a` (na, N)."""
        total = np.einsum("van,an->vn", closed.G, a)
        if self._ends:
            gap = self.gap_acceleration(closed.at, compute_motion(self.joints, closed.at, v, None, np.zeros(3)))
            total[self.passive] -= closed.inverse.solve(gap)
        return total

    def _without_loops(self, q: np.ndarray) -> ClosedLoops:
        x = self._share @ q.T + self._offset[:, None]
        G = np.broadcast_to(self._share[:, :, None], (*self._share.shape, len(q)))
        return ClosedLoops(x, compute_frames(self.joints, x), Dense(np.zeros((len(q), 0, 0))), G)

    def _started(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a first guess of all positions (nv, N), the cell's middle moved along its `G`, and how far they moved (N,)."""
        _, x, G = self._cells.find(self._reduced(q - self.solver.robot.home).T)
        step = np.einsum("van,an->vn", G, self._reduced(q - x[self.active].T / self.scale).T)
        return x + step, np.abs(step).max(axis=0)

    def _reduced(self, away: np.ndarray) -> np.ndarray:
        """Return distances (N, na), without whole turns of joints that turn forever."""
        turn = 2 * np.pi * np.round(away / (2 * np.pi))
        return np.where(self._endless, away - turn, away)

    def _learn(self, cells: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        """Walk from home to the middles of new cells (n, na), all at once; return positions and `G`."""
        x = np.repeat(self.positions(self.solver.close(self.solver.robot.home))[:, None], len(cells), axis=1)
        distance = np.abs(cells).max(axis=1)
        x[:, distance > _MAX_CELLS_FROM_HOME] = np.nan
        steps = int(distance[distance <= _MAX_CELLS_FROM_HOME].max(initial=0))
        with np.errstate(all="ignore"):
            for step in range(steps + 1):
                G = self._linearised(x).G
                if step < steps:
                    move = np.einsum("van,an->vn", G, _CELL / steps * cells.T)
                    x, found = self._newton(x + move, np.abs(move).max(axis=0))
                    x[:, ~found] = np.nan
        return [(x[:, k], G[:, :, k]) for k in range(len(cells))]

    def _newton(self, x: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return closed positions (nv, N), started at `x` after a step of at most `step` (N,), and where that worked (N,)."""
        guess, x, found = x, x.copy(), np.zeros(x.shape[1], bool)
        most = MAX_CORRECTION * step + _DONE
        left = np.flatnonzero(np.isfinite(x).all(axis=0))
        for _ in range(_MAX_ITERATIONS):
            if not left.size:
                break
            now = x[:, left]
            at = compute_frames(self.joints, now)
            change = -self._inverse(self.entries(at))[0].solve(self.gap(at))
            now[self.passive] += change
            x[:, left] = now
            astray = ~(np.abs(now - guess[:, left]).max(axis=0) <= most[left])
            done = ~astray & (np.abs(change).max(axis=0) < _DONE)
            found[left[done]] = True
            left = left[~done & ~astray]
        return x, found

    def _linearised(self, x: np.ndarray) -> ClosedLoops:
        at = compute_frames(self.joints, x)
        entries = self.entries(at)
        J_a = np.zeros((3 * len(self._ends), len(self.active), x.shape[1]))
        for (r, c), value in entries.items():
            for k in np.flatnonzero(self._share[c]):
                J_a[r, k] += self._share[c, k] * value
        inverse, sure = self._inverse(entries, J_a)
        G = np.repeat(self._share[:, :, None], x.shape[1], axis=2)
        G[self.passive] = -(inverse.solve(J_a) if sure is None else sure)
        return ClosedLoops(x, at, inverse, G)

    def _inverse(self, entries: Entries, probe: np.ndarray | None = None) -> tuple[PassiveInverse, np.ndarray | None]:
        """Return the passive Jacobian's inverse, and its product with a probe where elimination was tried and trusted on it."""
        passive = self._passive(entries)
        if self._plan is not None:
            factor = self._plan.factor(passive)
            if probe is None:
                return factor, None
            x = factor.solve(probe)
            if np.all(factor.residual(x, probe) < _TRUSTED):
                return factor, x
        return Dense(invert_matrices(self._dense(passive, len(self.passive)))), None

    def _planned(self) -> Elimination | None:
        """Return how to eliminate at home and near it; None if the passive Jacobian has no inverse."""
        if not self._ends or 3 * len(self._ends) != len(self.passive):
            return None
        home = self.positions(self.solver.close(self.solver.robot.home))
        passive = self._passive(self.entries(compute_frames(self.joints, home[:, None])))
        J = self._dense(passive, len(self.passive))[0]
        return None if np.linalg.cond(J) > ILL else Elimination.plan(set(passive), J)

    def jacobian(self, at: Frames) -> np.ndarray:
        """Return the gaps' derivatives by passive speeds (N, 3 * loops, passive)."""
        return self._dense(self._passive(self.entries(at)), len(self.passive))

    def _passive(self, entries: Entries) -> Entries:
        """Return the passive joints' columns, numbered among themselves."""
        return {(r, self._row[c]): value for (r, c), value in entries.items() if c in self._row}

    def _dense(self, entries: Entries, width: int) -> np.ndarray:
        n = len(next(iter(entries.values())))
        J = np.zeros((n, 3 * len(self._ends), width))
        for (r, c), value in entries.items():
            J[:, r, c] = value
        return J

    def entries(self, at: Frames) -> Entries:
        """Return the gaps' derivatives by the tree's speeds: those that are not zero by structure."""
        found: Entries = {}
        for k, ends in enumerate(self._ends):
            for end, sign in zip(ends, (1.0, -1.0), strict=True):
                place = transform_point(at, end.joint, end.local)
                for joint, column, _ in yield_columns(at, (self._by_index[j] for j in end.carriers), place):
                    signed = column if sign > 0 else -column
                    for r in range(3):
                        before = found.get((3 * k + r, joint.v))
                        found[3 * k + r, joint.v] = signed[r] if before is None else before + signed[r]
        return found

    def gap(self, at: Frames) -> np.ndarray:
        """Return `p_A - p_B` of all loops (3 * loops, N) [m]."""
        return np.concatenate(
            [transform_point(at, a.joint, a.local) - transform_point(at, b.joint, b.local) for a, b in self._ends]
        )

    def closing_points(self, at: Frames) -> list[np.ndarray]:
        """Return the points `p_A` of all loops, each (3, N) [m]."""
        return [transform_point(at, a.joint, a.local) for a, _ in self._ends]

    def carried_force(self, forces: np.ndarray, joint: int) -> np.ndarray:
        """Return the force (3, ...) on the bodies that joint number `joint` carries, from the loops' forces (3 * loops, ...)."""
        total = np.zeros_like(forces, shape=(3, *forces.shape[1:]))
        for force, (a, b) in zip(np.split(forces, len(self._ends)), self._ends, strict=True):
            total = total + force * float((joint in a.carriers) - (joint in b.carriers))
        return total

    def gap_acceleration(self, at: Frames, moving: FrameMotion) -> np.ndarray:
        """Return the gaps' accelerations (3 * loops, N) [m/s^2]."""

        def of(end: _Ends) -> np.ndarray:
            total = compute_point_acceleration(at, moving, end.joint, transform_point(at, end.joint, end.local))
            return np.zeros_like(at.origin[0]) if total is None else total

        return np.concatenate([of(a) - of(b) for a, b in self._ends])

    def positions(self, q: np.ndarray) -> np.ndarray:
        """Return Pinocchio's configuration (nq,) as one position a joint (nv,)."""
        x = np.empty(self.solver.model.nv)
        for joint in self.joints:
            item = self.solver.model.joints[joint.index]
            at = item.idx_q
            x[joint.v] = np.arctan2(q[at + 1], q[at]) if item.nq == 2 else q[at]
        return x


def _end(model: pin.Model, frame: int) -> _Ends:
    item = model.frames[frame]
    return _Ends(
        item.parentJoint,
        remove_rounding(item.placement.translation),
        tuple(model.supports[item.parentJoint].tolist()[1:]),
    )


_MIN_RELATIVE_DIAGONAL = 1e-3
"""Independent part of a chosen joint's motion, relative to the largest of any, below which it does not place the robot."""


def list_loop_joints(robot: Robot) -> tuple[str, ...]:
    """Return the passive joints of one freedom, each of which loops tie to the actuated ones."""
    if not robot.loops:
        return ()
    model, followers = robot.model, set(robot.mimics)
    free = (name for name in model.names if model.existJointName(name) and name not in robot.actuated)
    return tuple(n for n in free if n not in followers and model.joints[model.getJointId(n)].nv == 1)


def compute_actuated_positions_from(robot: Robot, joints: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Return the actuated positions (N, na) [m or rad] at positions of other joints of the same loops.

    A robot with `na` freedoms is placed by any `na` joints whose motions are independent: with `v_tree = G v_a`, rows of `G` of
    full rank. They are chosen at home by QR with column pivoting of `G'`, which takes the most informative joints. The loops
    are then closed with these in the place of the actuated joints, from the same configuration at home, so that the assembly
    mode is the same. Reference: Khalil & Dombre 2002, ch. 7.

    Args:
        robot: A robot with loops.
        joints: Measured joints, actuated or of its loops; at least as many as it has freedoms.
        q: Their positions (N, k) [m or rad].

    Raises:
        CannotAnswer: The joints do not place the robot.
        LoopClosureError: The loops do not close at a position.
    """
    solver = LoopSolver(robot)
    at_home = solver.state(robot.home, np.zeros(robot.na), np.zeros(robot.na))
    rows = [robot.model.joints[robot.model.getJointId(name)].idx_v for name in joints]
    R, order = cast("tuple[np.ndarray, np.ndarray]", linalg.qr(at_home.G[rows].T, mode="r", pivoting=True))
    diagonal = np.abs(np.diag(R))
    if len(diagonal) < robot.na or diagonal[robot.na - 1] < _MIN_RELATIVE_DIAGONAL * np.abs(at_home.G).max():
        raise CannotAnswer(
            "poor_excitation",
            f"{', '.join(joints)} do not place {', '.join(robot.actuated)}",
            "log the positions of the actuated joints",
        )
    chosen = [joints[k] for k in sorted(order[: robot.na])]
    arrays = LoopArrays(solver, _require_joints(robot))
    home = dict(zip(robot.model.names[1:], arrays.positions(at_home.q), strict=True))
    measured = replace(
        robot,
        actuated=tuple(chosen),
        home=np.array([home[name] for name in chosen]),
        passive_home={name: value for name, value in home.items() if name not in chosen},
        drive_scales={},
    )
    closed = LoopArrays(LoopSolver(measured), _require_joints(measured)).close(
        q[:, [joints.index(name) for name in chosen]]
    )
    return closed.x[robot.active_v].T / robot.drive_scale


def _require_joints(robot: Robot) -> list[Joint]:
    """Return the tree's joints; a robot with loops has joints of one freedom only."""
    joints = list_joints(robot.model)
    assert joints is not None
    return joints
