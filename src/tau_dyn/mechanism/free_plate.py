r"""Forward kinematics of a plate with six freedoms: Newton on SE(3) for many samples at once, in home's assembly mode.

A robot like this may be assembled in up to 40 ways at the same actuated positions. Home's is followed: the positions' space is
cut into cells, the middle of a sample's cell is walked to from home in small steps, and Newton starts from there, moved along
the slope `dX/dq`. So a pose depends on its own `q` alone, not on the order, block or process of the samples, and a trajectory
cannot jump. If the straight way from home is blocked, ways along the axes are tried. The sign of the Jacobian's determinant
shows when a solution is beyond a singularity. Reference: thesis (4.32), (4.33); Merlet 2006, ch. 4.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import BRANCH_CHANGE, NOT_A_NUMBER, OK, OUT_OF_REACH, SINGULAR, Poses
from tau_dyn.mechanism.rod_dimensions import Plate, SixRods, build_dense, compute_equation_rows, compute_residual
from tau_dyn.mechanism.small_systems import CellStarts, solve_with_lapack

BLOCK = 8192  # samples at a time; arrays stay in the processor's cache
_CELL = 0.03  # of the mean rod's length for slides; half as much again in rad for turns
_FROZEN = 1e-5  # after a step this small (relative to the rods) one with the same factors is the last
_MAX_ITERATIONS = 8  # Newton steps from a neighbour's pose; quadratic convergence needs three to five
_MAX_CELLS_FROM_HOME = 1000  # cells from home beyond which positions are taken for a mistake of units
_TOLERANCE = 1e-9  # [m] largest last step; relative to the rods' length if that is above one metre
_SINGULAR = 1e-7  # of home's determinant
_ASTRAY = 0.2  # relative to the rods: largest motion of a plate by Newton from the pose that its cell gives


class Solved(NamedTuple):
    """Poses, where Newton came to rest (N,), and the determinants by home's (N,)."""

    plate: Plate
    found: np.ndarray
    determinant: np.ndarray


class FreePlate:
    """Solves one robot."""

    def __init__(self, rods: Legs) -> None:
        """Close the robot at home and plan the elimination there."""
        self.rods, self.numbers = rods, rods.numbers
        self.scale = float(np.mean(rods.lengths))
        turning = np.array([kind == "revolute" for kind in rods.robot.joint_kinds])
        self.cell = np.where(turning, _CELL * 1.5, _CELL * self.scale)
        self._cells = CellStarts(self.cell, _MAX_CELLS_FROM_HOME - 1, self._learn)
        nominal = Plate(rods.home.position.T.copy(), np.moveaxis(rods.home.rotation, 0, 2).copy())
        points, squares = self._given(rods.robot.home[:, None])
        self._six = (
            SixRods(build_dense(compute_equation_rows(points, rods.on_plate, squares, nominal))[0])
            if rods.n == 6
            else None
        )
        self._reference = 1.0
        solved = self._newton(points, squares, nominal)
        if not solved.found[0]:
            raise LoopClosureError(f"{rods.robot.source}: with this geometry the rods cannot be closed at home")
        self.home = solved.plate
        self._reference = float(solved.determinant[0])

    def forward(self, q: np.ndarray, start: Poses | None = None) -> tuple[Poses, np.ndarray]:
        """Return the plate's poses and codes at `q` (N, na), from home's mode or from a start for each sample."""
        position, rotation = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        code = np.empty(len(q), np.int8)
        for first in range(0, len(q), BLOCK):
            part = slice(first, first + BLOCK)
            given = None if start is None else _columns(start, part)
            plate, code[part] = self._block(np.ascontiguousarray(q[part].T), given)
            position[part], rotation[part] = plate.position.T, plate.rotation.transpose(2, 0, 1)
        return Poses(position, rotation), code

    def _block(self, q: np.ndarray, start: Plate | None) -> tuple[Plate, np.ndarray]:
        guess = self._started(q) if start is None else start
        points, squares = self._given(q)
        solved = self._newton(points, squares, guess)
        code = self._judged(solved, q)
        if start is None:
            again = np.flatnonzero((code == OUT_OF_REACH) | (code == BRANCH_CHANGE))
            if again.size:
                self._detour(q, again, solved, code)
        bad = code != OK
        if bad.any():
            solved.plate.position[:, bad] = np.nan
            solved.plate.rotation[:, :, bad] = np.nan
        return solved.plate, code

    def _judged(self, solved: Solved, q: np.ndarray) -> np.ndarray:
        code = np.zeros(len(solved.found), np.int8)
        if solved.found.all() and np.all(solved.determinant > _SINGULAR):
            return code
        with np.errstate(invalid="ignore"):
            code[solved.determinant < 0] = BRANCH_CHANGE
            code[np.abs(solved.determinant) < _SINGULAR] = SINGULAR
        code[~solved.found] = OUT_OF_REACH
        code[~np.isfinite(q).all(axis=0)] = NOT_A_NUMBER
        return code

    def _detour(self, q: np.ndarray, again: np.ndarray, solved: Solved, code: np.ndarray) -> None:
        """Try other ways from home for these samples, and write their results into `solved` and `code`."""
        home = self.rods.robot.home
        order = range(self.rods.na)
        for way in (None, list(order), list(order)[::-1]):
            goal = q[:, again]
            via = [goal] if way is None else _corners(home, goal, way)
            plate, at = _repeated(self.home, len(again)), np.repeat(home[:, None], len(again), axis=1)
            for corner in via:
                plate = self.walk(at, corner, plate)
                at = corner
            points, squares = self._given(goal)
            tried = self._newton(points, squares, plate)
            got = self._judged(tried, goal)
            better = (got == OK) | ((got == SINGULAR) & (code[again] == OUT_OF_REACH))
            taken = again[better]
            solved.plate.position[:, taken] = tried.plate.position[:, better]
            solved.plate.rotation[:, :, taken] = tried.plate.rotation[:, :, better]
            code[taken] = got[better]
            again = again[got != OK]
            if not again.size:
                return

    def walk(self, start: np.ndarray, goal: np.ndarray, plate: Plate) -> Plate:
        """Return the poses at `goal` (na, N) reached in small steps from `start`; nan where the way is blocked."""
        away = np.abs(goal - start) / self.cell[:, None]
        distance = np.where(np.isfinite(away).all(axis=0), away.max(axis=0), np.inf)
        steps = int(np.ceil(distance[distance < _MAX_CELLS_FROM_HOME].max(initial=0.0)))
        plate = Plate(plate.position.copy(), plate.rotation.copy())
        plate.position[:, ~(distance < _MAX_CELLS_FROM_HOME)] = np.nan
        with np.errstate(all="ignore"):
            for step in range(steps):
                plate = self._stepped(start, goal, step / steps, (step + 1) / steps, plate)
        return plate

    def _stepped(self, start: np.ndarray, goal: np.ndarray, here: float, there: float, plate: Plate) -> Plate:
        now, then = start + here * (goal - start), start + there * (goal - start)
        alive = np.flatnonzero(np.isfinite(plate.position[0]))
        if not alive.size:
            return plate
        slope = self.slope(now[:, alive], plate.take(alive))
        guess = plate.take(alive).moved(np.einsum("xan,an->xn", slope, (then - now)[:, alive]))
        points, squares = self._given(then[:, alive])
        solved = self._newton(points, squares, guess)
        ok = solved.found & ((solved.determinant > 0) if self._six else True)
        position, rotation = np.full_like(plate.position, np.nan), plate.rotation.copy()
        position[:, alive[ok]] = solved.plate.position[:, ok]
        rotation[:, :, alive[ok]] = solved.plate.rotation[:, :, ok]
        return Plate(position, rotation)

    def slope(self, q: np.ndarray, plate: Plate) -> np.ndarray:
        """Return the plate's twist per actuated velocity (6, na, N)."""
        points, squares = self._given(q)
        at = compute_equation_rows(points, self.rods.on_plate, squares, plate)
        sides = rod_dimensions.compute_closure_by_q(self.numbers, q, points, at.d)
        return self._six.accurate(at, sides) if self._six else solve_with_lapack(build_dense(at), sides)

    def _given(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        points = frames.compute_points(self.numbers.joints, self.numbers.carried, q)
        return points, rod_dimensions.compute_squared_lengths(self.numbers, q)

    def _started(self, q: np.ndarray) -> Plate:
        """Return a first guess: the cell's middle, moved along its slope."""
        away = q - self.rods.robot.home[:, None]
        middle, position, rotation, slope = self._cells.find(away)
        twist = np.zeros((6, q.shape[1]))
        for a, row in enumerate(away - middle):
            twist += slope[:, a] * row
        return Plate(position, rotation).moved(twist)

    def _learn(self, cells: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        """Walk from home to the middles of new cells (n, na), all at once; return poses and slopes."""
        home = np.repeat(self.rods.robot.home[:, None], len(cells), axis=1)
        goal = home + cells.T * self.cell[:, None]
        plate = self.walk(home, goal, _repeated(self.home, len(cells)))
        with np.errstate(all="ignore"):
            slope = self.slope(goal, plate)
        parts = (plate.position, plate.rotation, slope)
        return [tuple(part[..., k] for part in parts) for k in range(len(cells))]

    def _newton(self, points: np.ndarray, squares: np.ndarray, guess: Plate) -> Solved:
        """Close the rods from a guess; samples that are done leave the work."""
        n = points.shape[2]
        plate = Plate(np.full((3, n), np.nan), np.full((3, 3, n), np.nan))
        found, determinant = np.zeros(n, bool), np.full(n, np.nan)
        left = np.flatnonzero(np.isfinite(guess.position[0]))
        now, A = guess, points
        if left.size < n:
            now, A = guess.take(left), points[:, :, left]
        begun = now.position
        for _ in range(_MAX_ITERATIONS):
            if not left.size:
                break
            sq = squares if squares.shape[1] == 1 else squares[:, left]
            now, size, det = self._step(A, sq, now)
            done = size < _TOLERANCE * max(1.0, self.scale)
            if left.size == n and done.all():
                return Solved(now, np.ones(n, bool), det)
            ready = left[done]
            plate.position[:, ready], plate.rotation[:, :, ready] = now.position[:, done], now.rotation[:, :, done]
            found[ready], determinant[ready] = True, det[done]
            astray = ~(np.abs(now.position - begun).max(axis=0) < _ASTRAY * self.scale)
            on = ~done & ~astray
            left, now, A, begun = left[on], now.take(on), A[:, :, on], begun[:, on]
        return Solved(plate, found, determinant)

    def _step(self, points: np.ndarray, squares: np.ndarray, plate: Plate) -> tuple[Plate, np.ndarray, np.ndarray]:
        """Return the poses after one Newton step, the last displacement (N,), and determinants by home's (N,).

        After a small step a second one reuses its factors.
        """
        B = self.rods.on_plate
        at = compute_equation_rows(points, B, squares, plate)
        f = np.stack(at.f)
        if self._six is None:
            twist = solve_with_lapack(build_dense(at), f)
            return plate.moved(twist), _size(twist, self.scale), np.ones(len(f[0]))
        factor = self._six.factor(at)
        if factor is None:
            twist = solve_with_lapack(build_dense(at), f)
            return plate.moved(twist), _size(twist, self.scale), np.linalg.det(build_dense(at)) / self._reference
        twist = factor.solve(f)
        with np.errstate(all="ignore"):
            det = 1.0 / (np.prod(list(factor.inverses.values()), axis=0) * self._reference)
        plate = plate.moved(twist)
        size = _size(twist, self.scale)
        if np.all(size < _FROZEN * self.scale):
            twist = factor.solve(compute_residual(points, B, squares, plate))
            plate, size = plate.moved(twist), _size(twist, self.scale)
        return plate, size, det


def _size(twist: np.ndarray, scale: float) -> np.ndarray:
    """Return the largest displacement (N,) [m], turns taken at a rod's length."""
    angular = np.abs(twist[3:]).max(axis=0)
    angular *= scale
    return np.maximum(np.abs(twist[:3]).max(axis=0), angular)


def _corners(home: np.ndarray, goal: np.ndarray, order: list[int]) -> list[np.ndarray]:
    """Return the corners of a way from home to goal (na, N) along one axis after another."""
    at, out = np.repeat(home[:, None], goal.shape[1], axis=1), []
    for axis in order:
        at = at.copy()
        at[axis] = goal[axis]
        out.append(at)
    return out


def _repeated(plate: Plate, n: int) -> Plate:
    return Plate(np.repeat(plate.position, n, axis=1), np.repeat(plate.rotation, n, axis=2))


def _columns(start: Poses, part: slice) -> Plate:
    chosen = start if len(start.position) == 1 else start.take(part)
    return Plate(np.ascontiguousarray(chosen.position.T), np.ascontiguousarray(np.moveaxis(chosen.rotation, 0, 2)))
