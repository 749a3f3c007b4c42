"""Base parameters: the identifiable combinations of parameters of a regressor, and their expressions.

The leftmost of linearly dependent columns are kept, so that a column is explained by those before it: `W_D = W_B K`, and
`W theta = W_B beta` with `beta = theta_B + K theta_D`. The rank is found by QR with column pivoting on columns of unit
norm. Reference: Gautier 1991, Numerical calculation of the base inertial parameters.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy import linalg

MIN_RELATIVE_COLUMN_NORM = 1e-5
"""Size of a column, relative to the largest of its unit, below which it is a rounding of the robot file, not physics."""

RANK_TOLERANCE = 1e-6
"""Part of a unit column that others must leave unexplained; closures are solved to 1e-12, so dependence shows to ~1e-10."""

_CLEAR = 10.0
"""Unexplained part of a dropped column, in tolerances, above which the kept columns are chosen again with a larger tolerance."""
_COARSEST = 1e-2  # relative tolerance of the rank, at most
_NEGLIGIBLE = 1e-6
"""Part of a dropped unit column below which a kept one has no share in it."""
_FACTOR = re.compile(r"[0-9]+(\.[0-9]+)?(e[+-][0-9]+)?")


@dataclass(frozen=True, eq=False)
class BaseParameters:
    """The identifiable combinations of a regressor's parameters.

    Attributes:
        names: All column names (p,).
        kept: Columns of the base parameters (r,).
        dropped: The other columns (p - r,).
        K: How the dropped columns regroup into the kept ones (r, p - r).
    """

    names: tuple[str, ...]
    kept: np.ndarray
    dropped: np.ndarray
    K: np.ndarray

    @property
    def rank(self) -> int:
        """Number of base parameters."""
        return len(self.kept)

    @property
    def alone(self) -> np.ndarray:
        """Mask over all columns (p,): those that are base parameters by themselves."""
        mask = np.zeros(len(self.names), dtype=bool)
        mask[self.kept] = ~np.any(self.K != 0, axis=1)
        return mask

    def by_name(self, values: np.ndarray) -> dict[str, float]:
        """Return those of the base parameters' values (r,) whose parameter is one by itself, by its name."""
        alone = self.alone[self.kept]
        return {self.names[c]: float(x) for c, x, a in zip(self.kept, values, alone, strict=True) if a}

    def combine(self, theta: np.ndarray) -> np.ndarray:
        """Return the base parameters (r,) of a full vector (p,)."""
        return theta[self.kept] + self.K @ theta[self.dropped]

    def expression(self, row: int, more: Mapping[str, float] = MappingProxyType({})) -> str:
        """Return a base parameter in words, such as `rod2a_link.mass + 0.5*rod2b_link.mass`.

        Args:
            row: Its number.
            more: Factors of fixed parameters that it contains, by name; see `find_contained`.
        """
        text, dropped = self.names[self.kept[row]], [self.names[d] for d in self.dropped]
        for name, factor in [*zip(dropped, self.K[row], strict=True), *more.items()]:
            if factor:
                size = abs(factor)
                text += (" + " if factor > 0 else " - ") + (name if abs(size - 1) < 1e-9 else f"{size:.6g}*{name}")
        return text

    def depends_on(self, column: int) -> tuple[str, ...]:
        """Return the names of the parameters that a column shares its base parameters with; empty if alone or not excited."""
        if column in self.dropped:
            d = int(np.flatnonzero(self.dropped == column)[0])
            rows = np.flatnonzero(self.K[:, d])
        else:
            rows = np.flatnonzero(self.kept == column)
        shared = {int(self.kept[r]) for r in rows}
        shared |= {int(self.dropped[d]) for r in rows for d in np.flatnonzero(self.K[r])}
        return tuple(self.names[c] for c in sorted(shared - {column}))


def read_expression(text: str) -> dict[str, float]:
    """Return the coefficient of each parameter in a text from `BaseParameters.expression`, by name.

    Names are not checked; a name that contains a sum is split.
    """
    first, *others = re.split(r" ([+-]) ", text)
    weights: dict[str, float] = {}
    for sign, term in zip(["+", *others[::2]], [first, *others[1::2]], strict=True):
        factor, star, name = term.partition("*")
        if not star or not _FACTOR.fullmatch(factor):
            factor, name = "1", term
        weights[name] = weights.get(name, 0.0) + float(sign + factor)
    return weights


def find_base(
    W: np.ndarray, names: tuple[str, ...], tolerance: float = RANK_TOLERANCE, *, units: Sequence[str] | None = None
) -> BaseParameters:
    """Find the base parameters of a regressor.

    Args:
        W: Stacked columns (N, p), whitened or not.
        names: Column names.
        tolerance: Unexplained part of a unit column below which it is dependent.
        units: The parameters' units; columns far smaller than the largest of their unit count as not excited.
    """
    norm = np.linalg.norm(W, axis=0)
    seen = _visible(norm, units)
    unit = np.divide(W, norm, out=np.zeros_like(W), where=seen)
    R = np.asarray(np.linalg.qr(unit, mode="r")) if len(unit) > len(names) else unit
    rank = _rank(R, tolerance)
    kept, small = _leftmost(R, seen, rank, tolerance), _NEGLIGIBLE
    while tolerance < _COARSEST and _left_out(R, seen, kept) > _CLEAR * tolerance:
        tolerance *= 2  # noise made dependent columns on the left look independent
        kept, small = _leftmost(R, seen, rank, tolerance), _CLEAR * tolerance
    dropped = [c for c in range(len(names)) if c not in kept]
    K = (
        np.linalg.lstsq(R[:, kept], R[:, dropped], rcond=None)[0]
        if kept and dropped
        else np.zeros((len(kept), len(dropped)))
    )
    K = K * norm[dropped] / norm[kept][:, None]
    relative = np.abs(K) * norm[kept][:, None] / np.where(norm[dropped] > 0, norm[dropped], 1.0)
    return BaseParameters(names, np.array(kept, int), np.array(dropped, int), np.where(relative > small, K, 0.0))


def find_contained(W: np.ndarray, kept: Sequence[int], fixed: Sequence[int]) -> np.ndarray:
    """Return the factors (r, k) by which base parameters contain fixed parameters; zero if data separate the two.

    The column of a fixed parameter that is a combination of base columns, `W_F = W_B K_F`, adds `K_F theta_F` to the sum that the
    data determine: `W_B beta + W_F theta_F = W_B (beta + K_F theta_F)`.

    Args:
        W: Columns (N, p), or a triangular factor of them.
        kept: Base columns (r).
        fixed: Columns of the fixed parameters (k).
    """
    found = np.zeros((len(kept), len(fixed)))
    norm = np.linalg.norm(W, axis=0)
    unit = W / np.where(norm > 0, norm, 1.0)
    basis = unit[:, kept]
    for k, column in enumerate(fixed):
        if not len(kept) or not norm[column]:
            continue
        factors = np.linalg.lstsq(basis, unit[:, column], rcond=None)[0]
        if np.linalg.norm(unit[:, column] - basis @ factors) < _CLEAR * RANK_TOLERANCE:
            scale = np.divide(
                norm[column], norm[kept], out=np.zeros(len(kept)), where=norm[kept] > 0
            )  # zero norm: known only from a prior
            found[:, k] = np.where(np.abs(factors) > _CLEAR * RANK_TOLERANCE, factors * scale, 0.0)
    return found


def _leftmost(R: np.ndarray, seen: np.ndarray, rank: int, tolerance: float) -> list[int]:
    """Return the first columns, at most as many as the rank, that those before them leave unexplained."""
    kept: list[int] = []
    for column in np.flatnonzero(seen):
        if len(kept) < rank and (not kept or _unexplained(R[:, kept], R[:, column]) > tolerance):
            kept.append(int(column))
    return kept


def _left_out(R: np.ndarray, seen: np.ndarray, kept: list[int]) -> float:
    """Return the largest part of a seen unit column that the kept ones do not explain."""
    rest = [c for c in np.flatnonzero(seen) if c not in kept]
    if not rest or not kept:
        return 0.0
    q, _ = np.linalg.qr(R[:, kept])
    return float(np.linalg.norm(R[:, rest] - q @ (q.T @ R[:, rest]), axis=0).max())


def _visible(norm: np.ndarray, units: Sequence[str] | None) -> np.ndarray:
    seen = norm > 1e-12 * max(norm.max(initial=0.0), 1e-300)
    for unit in set(units or ()):
        alike = np.array([u == unit for u in units or ()])
        seen &= ~alike | (norm > MIN_RELATIVE_COLUMN_NORM * norm[alike].max())
    return seen


def _rank(R: np.ndarray, tolerance: float) -> int:
    if R.size == 0:
        return 0
    diagonal = np.abs(np.diag(linalg.qr(R, mode="r", pivoting=True)[0]))
    return int(np.sum(diagonal > tolerance))


def _unexplained(basis: np.ndarray, column: np.ndarray) -> float:
    q, _ = np.linalg.qr(basis)
    rest = column - q @ (q.T @ column)
    return float(np.linalg.norm(rest - q @ (q.T @ rest)))
