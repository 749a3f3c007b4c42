r"""Many small sparse systems `A x = b` of one pattern, solved together: elimination planned once, done on rows of samples.

A loop's passive Jacobian is sparse (an arm's joints touch its own loop only), and its pattern is that of the mechanism. So pivots
are chosen once, by Markowitz' count among entries that are large at a reference sample, and every step is an operation on N
numbers. LAPACK on each little matrix takes ten times as long. Pivots that suit the reference may not suit a sample: `residual`
tells, and the caller then solves those otherwise. Reference: Duff, Erisman & Reid 2017, Direct Methods for Sparse Matrices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
        """Choose pivots for a pattern at a reference matrix (n, n); None where it is singular or not square."""
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
