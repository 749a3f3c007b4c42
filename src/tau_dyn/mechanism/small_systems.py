r"""Many small linear systems at once: inverses and pseudo-inverses, planned elimination, closing with least motion.

Pseudo-inverses scale columns to length one first, since angles and lengths occur together (Golub & Van Loan 2013, ch. 5.5).

A loop's passive Jacobian is sparse, and its pattern is that of the mechanism. So pivots are chosen once, by Markowitz' count
among entries that are large at a reference sample, and every step is an operation on N numbers; LAPACK on each little matrix
takes ten times as long. Pivots that suit the reference may not suit a sample: `residual` shows it, and the caller then solves
those samples by another method (Duff, Erisman & Reid 2017).

Newton's step of an underdetermined problem closes first, then turns, then moves no more than needed,

    C y = -g,   minimise |T y - t|^2 + damping |(y - p) / s|^2

by its Karush-Kuhn-Tucker equations (Nocedal & Wright 2006, ch. 16); a small diagonal gives least squares where `C` loses rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

ILL = 1e8
"""Conditioning above which an inverse comes from singular values."""
_ROUNDING = 1e-10
"""Singular values and columns smaller than this, relative to the largest, are rounding."""


def invert_matrix(J: np.ndarray) -> np.ndarray:
    """Return the inverse (n, m) of a matrix (m, n) by LU; of one that is singular or not square, the pseudo-inverse."""
    if J.shape[0] == J.shape[1]:
        with suppress(np.linalg.LinAlgError):  # singular
            found = np.linalg.inv(J)
            if np.abs(J).sum(axis=0).max() * np.abs(found).sum(axis=0).max() < ILL:
                return found
    lengths = measure_column_lengths(J)
    u, s, vt = np.linalg.svd(J / lengths, full_matrices=False)
    keep = s > _ROUNDING * s[0]  # a rod's free spin has no influence on anything we report: least norm
    return (vt[keep].T / s[keep]) @ u[:, keep].T / lengths[:, None]


def invert_matrices(J: np.ndarray) -> np.ndarray:
    """Return inverses (N, n, m) of matrices (N, m, n); of one that is singular or not square, the pseudo-inverse.

    Pseudo-inverses are those of unit columns, as of `invert_matrix`.
    """
    if J.shape[1] != J.shape[2]:
        return _pseudo_inverses(J)
    try:
        out = np.linalg.inv(J)
    except np.linalg.LinAlgError:
        return _pseudo_inverses(J)
    with np.errstate(all="ignore"):
        size = np.abs(J).sum(axis=1).max(axis=1) * np.abs(out).sum(axis=1).max(axis=1)
    ill = ~(size < ILL)
    if ill.any():
        out[ill] = _pseudo_inverses(J[ill])
    return out


def _pseudo_inverses(J: np.ndarray) -> np.ndarray:
    out = np.full((len(J), J.shape[2], J.shape[1]), np.nan)
    sound = np.isfinite(J).all(axis=(1, 2))
    out[sound] = _sound_pseudo_inverses(J[sound])
    return out


def _sound_pseudo_inverses(J: np.ndarray) -> np.ndarray:
    lengths = measure_column_lengths(J)
    u, s, vt = np.linalg.svd(J / lengths[:, None, :], full_matrices=False)
    kept = s > _ROUNDING * s[:, :1]  # a rod's free spin has no influence on anything we report: least norm
    weight = np.divide(1.0, s, out=np.zeros_like(s), where=kept)
    return (vt.transpose(0, 2, 1) * weight[:, None, :]) @ u.transpose(0, 2, 1) / lengths[:, :, None]


def measure_column_lengths(J: np.ndarray) -> np.ndarray:
    """Return the columns' lengths (..., n) of matrices (..., m, n), 1 for those that are zero but for rounding."""
    lengths = np.linalg.norm(J, axis=-2)
    return np.where(lengths > _ROUNDING * lengths.max(axis=-1, keepdims=True, initial=0.0), lengths, 1.0)


def measure_rank_distance(matrices: np.ndarray) -> np.ndarray:
    """Return the smallest singular value by the largest (N,); nan where a matrix is not finite."""
    out = np.full(len(matrices), np.nan)
    sound = np.isfinite(matrices).all(axis=(1, 2))
    if sound.any():
        s = np.linalg.svd(matrices[sound], compute_uv=False)
        out[sound] = s[:, -1] / s[:, 0]
    return out


def solve_with_lapack(matrices: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return least-squares solutions (c, ..., N) of matrices (N, n, c) and right sides (n, ..., N); nan without a solution."""
    sides = np.moveaxis(b.reshape(len(b), -1, b.shape[-1]), 2, 0)
    out = np.full((len(matrices), matrices.shape[2], sides.shape[2]), np.nan)
    sound = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)) & np.isfinite(sides).all(axis=(1, 2)))
    if sound.size:
        try:
            if matrices.shape[1] != matrices.shape[2]:
                raise np.linalg.LinAlgError
            out[sound] = np.linalg.solve(matrices[sound], sides[sound])
        except np.linalg.LinAlgError:
            out[sound] = np.linalg.pinv(matrices[sound], rcond=1e-12) @ sides[sound]
    return np.moveaxis(out, 0, 2).reshape(matrices.shape[2], *b.shape[1:])


Entries = dict[tuple[int, int], np.ndarray]
"""Nonzero entries of a matrix by row and column, each (N,)."""

_LARGE = 0.1
"""A pivot has at least this share of the largest entry of its row."""


class _Step(NamedTuple):
    """One pivot, the rows it is taken out of, and the columns of its row that are left."""

    row: int
    column: int
    rows: tuple[int, ...]
    columns: tuple[int, ...]


class Elimination:
    """The plan for one pattern."""

    def __init__(self, steps: list[_Step]) -> None:
        """Keep the steps; `plan` finds them."""
        self.steps = steps

    @classmethod
    def plan(cls, pattern: set[tuple[int, int]], reference: np.ndarray) -> Elimination | None:
        """Choose pivots for a pattern at a reference matrix (n, n); None if it is singular or not square."""
        if reference.shape[0] != reference.shape[1]:
            return None
        size = len(reference)
        A, filled = reference.copy(), {r: {c for i, c in pattern if i == r} for r in range(size)}
        left, steps, smallest = set(range(size)), [], 1e-9 * np.abs(reference).max(initial=0.0)
        while left:
            chosen = _pivot(A, filled, left, smallest)
            if chosen is None:
                return None
            row, column = chosen
            left.remove(row)
            rows = tuple(r for r in sorted(left) if column in filled[r])
            columns = tuple(sorted(filled[row] - {column}))
            for r in rows:
                A[r] -= A[r, column] / A[row, column] * A[row]
                filled[r] = (filled[r] | set(columns)) - {column}
            steps.append(_Step(row, column, rows, columns))
        return cls(steps)

    def factor(self, entries: Entries) -> Factor:
        """Return the factors of matrices with these entries."""
        work, multipliers, inverses = dict(entries), {}, {}
        with np.errstate(all="ignore"):  # a singular sample shows in the residual
            for step in self.steps:
                inverse = inverses[step.row] = 1.0 / work[step.row, step.column]
                for r in step.rows:
                    m = multipliers[r, step.row] = work[r, step.column] * inverse
                    for c in step.columns:
                        change = m * work[step.row, c]
                        work[r, c] = work[r, c] - change if (r, c) in work else -change
        return Factor(self.steps, entries, work, multipliers, inverses)


class Factor(NamedTuple):
    """Factored matrices; right-hand sides are (n, ..., N)."""

    steps: list[_Step]
    entries: Entries
    upper: Entries
    multipliers: Entries
    inverses: dict[int, np.ndarray]

    def solve(self, b: np.ndarray) -> np.ndarray:
        """Return `A^-1 b`."""
        b, x = b.copy(), np.empty_like(b)
        with np.errstate(all="ignore"):
            for step in self.steps:
                for r in step.rows:
                    b[r] -= self.multipliers[r, step.row] * b[step.row]
            for step in reversed(self.steps):
                rest = b[step.row]
                for c in step.columns:
                    rest = rest - self.upper[step.row, c] * x[c]
                x[step.column] = rest * self.inverses[step.row]
        return x

    def solve_transposed(self, b: np.ndarray) -> np.ndarray:
        """Return `A'^-1 b`."""
        b, x = b.copy(), np.empty_like(b)
        with np.errstate(all="ignore"):
            for step in self.steps:
                x[step.row] = b[step.column] * self.inverses[step.row]
                for c in step.columns:
                    b[c] -= self.upper[step.row, c] * x[step.row]
            for step in reversed(self.steps):
                for r in step.rows:
                    x[step.row] -= self.multipliers[r, step.row] * x[r]
        return x

    def residual(self, x: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the largest entry (N,) of `A x - b` relative to those of `A`, `x` and `b`."""
        rest = -b
        with np.errstate(all="ignore"):
            for (r, c), value in self.entries.items():
                rest[r] += value * x[c]
            scale = np.max(np.abs(np.stack(list(self.entries.values()))), axis=0)
            axes = tuple(range(x.ndim - 1))
            return np.abs(rest).max(axis=axes) / (scale * np.abs(x).max(axis=axes) + np.abs(b).max(axis=axes) + 1e-300)


def _pivot(A: np.ndarray, filled: dict[int, set[int]], left: set[int], smallest: float) -> tuple[int, int] | None:
    """Return row and column of the entry that is large enough and fills in least."""
    best, chosen = np.inf, None
    for r in sorted(left):
        largest = max((abs(A[r, c]) for c in filled[r]), default=0.0)
        for c in sorted(filled[r]):
            if abs(A[r, c]) < max(_LARGE * largest, smallest):
                continue
            count = (len(filled[r]) - 1) * (sum(c in filled[other] for other in left) - 1) - 1e-3 * abs(
                A[r, c]
            ) / largest
            if count < best:
                best, chosen = count, (r, c)
    return chosen


def solve_least_motion_step(
    C: np.ndarray,
    gap: np.ndarray,
    turning: np.ndarray,
    turn: np.ndarray,
    weight: np.ndarray,
    pull: np.ndarray,
    softness: float,
) -> np.ndarray:
    """Return the steps `y` (N, m).

    Args:
        C: Derivatives of the closure (N, n, m).
        gap: Closure (N, n).
        turning: Derivatives `T` of the tool's rotation (N, 3, m), or empty (N, 0, m).
        turn: Remaining rotation `t` (N, 3 or 0) [rad].
        weight: Cost of motion (m,), or (N, m or 1), small compared with 1; 0 if `T` depends on all of the motion.
        pull: Motion `p` without cost (N, m).
        softness: Square root of the weight of lost rows relative to the others.
    """
    n, rows, m = C.shape
    K = np.zeros((n, m + rows, m + rows))
    K[:, :m, :m] = np.swapaxes(turning, 1, 2) @ turning
    index = np.arange(m)
    K[:, index, index] += weight
    K[:, m:, :m], K[:, :m, m:] = C, np.swapaxes(C, 1, 2)
    index = np.arange(m, m + rows)
    K[:, index, index] = -(softness**2)
    right = np.empty((n, m + rows))
    right[:, :m] = np.einsum("nij,ni->nj", turning, turn) + weight * pull
    right[:, m:] = -gap
    return solve_with_pseudo_inverse(K, right)[:, :m]


def solve_with_pseudo_inverse(K: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return `K^-1 b` (N, m); for a singular matrix by its pseudo-inverse; nan where numbers are missing."""
    out = np.full(right.shape, np.nan)
    sound = np.isfinite(K).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    K, right = (K, right) if sound.all() else (K[sound], right[sound])
    try:
        out[sound] = np.linalg.solve(K, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        out[sound] = np.einsum("nij,nj->ni", np.linalg.pinv(K, rcond=1e-13), right)
    return out


_MAX_ROUNDING_STEP = 1e-8  # [m or rad] steps below this that stopped shrinking are rounding


class NewtonRules(NamedTuple):
    """When damped Newton steps end.

    Attributes:
        rounds: Most steps.
        patience: Rounds without a smaller gap after which a sample is given up.
        step: Largest step, in the steps' own measure.
        closed: Largest gap [m] that counts as closed.
        still: Largest next step of a sample that counts as closed.
        done: Size of a step below which there is only rounding.
    """

    rounds: int
    patience: int
    step: float
    closed: float
    still: float
    done: float = 1e-13

    def roughly(self, rounds: int, closed: float) -> NewtonRules:
        """Return the rules for intermediate points of a path: few rounds and a larger gap."""
        return self._replace(rounds=rounds, closed=closed, still=np.inf)


Move = Callable[[np.ndarray], None]
"""Moves samples by a share (k,) of their steps."""


def iterate_newton(
    sound: ArrayLike, advance: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, Move]], rules: NewtonRules
) -> np.ndarray:
    """Take damped Newton steps on many samples, each until it closes and rests, or its gap stops shrinking.

    Args:
        sound: Which samples have numbers (N,).
        advance: Function of samples' indices (k,) that returns their gaps (k,), the sizes of their next steps (k,), and a
            function that takes the steps.
        rules: When a sample is done.

    Returns:
        Which samples are closed (N,).
    """
    left = np.flatnonzero(sound)
    n = np.size(sound)
    closed, smallest, since, last = np.zeros(n, bool), np.full(n, np.inf), np.zeros(n, int), np.full(n, np.inf)
    for _ in range(rules.rounds):
        if not left.size:
            break
        gap, size, move = advance(left)
        move(np.minimum(1.0, rules.step / np.maximum(size, 1e-300)))
        tight, better = gap < rules.closed, gap < 0.6 * smallest[left]
        closed[left] = tight & (size < rules.still)
        smallest[left] = np.where(better, gap, smallest[left])
        since[left] = np.where(better, 0, since[left] + 1)
        rests = (size < rules.done) | ((size < _MAX_ROUNDING_STEP) & (size > 0.5 * last[left]))
        last[left] = size
        over = np.where(tight, rests, since[left] > rules.patience)
        left = left[~over & np.isfinite(size)]
    return closed


_KEPT = 200_000  # cells kept at most

Learn = Callable[[np.ndarray], Iterable[tuple[np.ndarray, ...]]]
"""Computes the stored results of cells from their numbers (n, na)."""

Known = dict[tuple[int, ...], tuple[np.ndarray, ...]]
"""Cells' numbers -> stored results of each."""


class CellStarts:
    """Starts of Newton's method that depend on a sample's own positions alone: the solution at the middle of its cell.

    The space of actuated positions is cut into cells. Their middles are walked to from home in small steps, which selects home's
    assembly mode, and are kept with the slope there. The order, block or process of the samples has no influence.
    """

    def __init__(self, size: np.ndarray, most: int, learn: Learn, known: Known | None = None) -> None:
        """Start with the known cells, or without cells; new cells are added to them.

        Args:
            size: Size of a cell for each actuator (na,) [m or rad].
            most: Cells from home beyond which positions are taken for a mistake of units; `learn` gives nan there.
            learn: Walks to the middles of new cells.
            known: Cells by their numbers.
        """
        self.size, self._most, self._learn = size, most, learn
        self._known: Known = {} if known is None else known

    def find(self, away: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the cells' middles and their stored results, samples last, at distances from home (na, N)."""
        index = np.round(away / self.size[:, None])
        whole = np.where(np.abs(index) <= self._most, index, self._most + 1).astype(np.int64)
        names, which = _find_unique_columns(whole)
        if len(self._known) > _KEPT:
            self._known.clear()
        new = names[[tuple(name) not in self._known for name in names.tolist()]]
        if len(new):
            self._known |= zip(map(tuple, new.tolist()), self._learn(new), strict=True)
        found = zip(*(self._known[tuple(name)] for name in names.tolist()), strict=True)
        return whole * self.size[:, None], *(np.stack(part, axis=-1)[..., which] for part in found)


def _find_unique_columns(whole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distinct columns (n, na) of integers (na, N) and which one each sample has (N,)."""
    if np.all(whole == whole[:, :1]):
        return whole[:, :1].T, np.zeros(whole.shape[1], int)
    low = whole.min(axis=1)
    spans = (whole.max(axis=1) - low + 1).tolist()
    key, factor = np.zeros(whole.shape[1], np.int64), 1
    for row, start, span in zip(whole, low, spans, strict=True):
        key += (row - start) * factor
        factor *= int(span)
    if factor > 2**62:
        names, which = np.unique(whole.T, axis=0, return_inverse=True)
        return names, which.ravel()
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return whole[:, first].T, which.ravel()
