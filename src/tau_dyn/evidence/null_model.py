r"""The null model on one part of the data, and the score statistic of further columns.

With white rows `y = B theta + C gamma + e`, `Q` an orthonormal basis of `B` and `e_0 = (I - Q Q') y`,

    s = C' e_0,   G = C' C - (Q'C)'(Q'C),   T = s' G^-1 s,

the gain in twice the log-likelihood by `C`, the baseline refitted (Frisch & Waugh 1933). Under the null it is chi-square with
as many degrees of freedom as columns; `T` of the true column alone has the noncentrality `lambda`.

The noise that whitens is estimated on the residual of a rich model: on the baseline's residual a hidden effect would count as
noise. So every output may depend smoothly on all variables of its own joint, times the direction of motion, and resonate at the
frequencies that a black-box fit proposes (an autoregressive model would otherwise attribute a resonance to the noise).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, cast

import numpy as np
from numpy.polynomial import legendre
from scipy import linalg, stats

from tau_dyn.effects import Effect
from tau_dyn.estimate import Autoregression, Whitener, fit_autoregression, solve_scaled
from tau_dyn.evidence.channel import Channel, ColumnCache
from tau_dyn.evidence.measurements import Measurements
from tau_dyn.log import find_true_runs

WHOLE_TIME = "t_whole"
"""Time through all logs, one after the other, if there are several: a transient may continue in the next log, or start
again."""
SMOOTH_DEGREE = 4  # of the smooth functions of a variable
_MAX_ORDER = 8  # of the autoregressive model of the residual, selected below it


def fit_noise_models(
    measurements: Measurements, parts: Sequence[int], extra: Sequence[Sequence[np.ndarray]] = ()
) -> tuple[Autoregression, ...]:
    """Return the noise model of each output, from samples of these parts, with further columns (n, m, k) in the model."""
    masks, variables, target = measurements.masks(*parts), measurements.variables(), measurements.target
    known = [*measurements.list_known_columns(), *extra]
    models = []
    for k, output in enumerate(measurements.outputs):
        rich = build_smooth_columns(variables, output)
        columns = [np.concatenate([*(c[r][:, k] for c in known), x], axis=1) for r, x in enumerate(rich)]
        measured = [y[:, k] for y in target]
        models.append(fit_noise_model(columns, measured, [mask[:, k] for mask in masks], _MAX_ORDER))
    return tuple(models)


def fit_noise_model(
    columns: Sequence[np.ndarray],
    measured: Sequence[np.ndarray],
    masks: Sequence[np.ndarray],
    max_order: int,
    *,
    unbiased: bool = False,
) -> Autoregression:
    """Return the noise of one output: the autoregressive model of the residual of a least-squares fit.

    Args:
        columns: Columns (n, c) of each run.
        measured: Measurements (n,) of each run.
        masks: Samples that are used (n,).
        max_order: Largest order of the model; 0 for independent noise.
        unbiased: Whether the variance is enlarged for the rank of the columns.

    Returns:
        The model; independent noise of variance 1 for an output without a usable sample.
    """
    y = np.concatenate([x[m] for x, m in zip(measured, masks, strict=True)])
    if not len(y):
        return Autoregression(np.zeros(0), 1.0)
    rows = np.concatenate([x[m] for x, m in zip(columns, masks, strict=True)])
    theta = solve_scaled(rows, y, 1e-7)
    stretches = []
    for x, y_run, mask in zip(columns, measured, masks, strict=True):
        e = y_run - x @ theta
        stretches += [e[s] for s in find_true_runs(mask)]
    found = fit_autoregression(stretches, max_order)
    if not unbiased:
        return found
    return replace(found, variance=found.variance * len(y) / max(1, len(y) - np.linalg.matrix_rank(rows)))


def build_smooth_columns(variables: Sequence[Mapping[str, np.ndarray]], output: str) -> list[np.ndarray]:
    """Return smooth functions (n, c) of an output's own variables, and the same times the direction of motion, of each run."""
    joined = JoinedVariables(variables)
    return joined.split(_smooth_own(joined.values, output))


class JoinedVariables:
    """All runs' variables one after the other: the same function for all runs, independent of their range."""

    def __init__(self, variables: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Join the variables of all runs."""
        common = [name for name in variables[0] if all(name in v for v in variables)]
        self.values = {name: np.concatenate([v[name] for v in variables]) for name in common}
        self._ends = np.cumsum([len(next(iter(v.values()))) for v in variables])[:-1]
        self._smooth: dict[tuple[str, int], list[np.ndarray]] = {}

    def split(self, columns: np.ndarray) -> list[np.ndarray]:
        """Return joined columns (N, c) run by run (n, c)."""
        return np.split(columns, self._ends)

    def smooth(self, name: str, degree: int) -> list[np.ndarray]:
        """Return smooth functions (N,) of a variable; see `smooth`."""
        if (name, degree) not in self._smooth:
            self._smooth[name, degree] = smooth(self.values[name], degree)
        return self._smooth[name, degree]


def _smooth_own(variables: Mapping[str, np.ndarray], output: str) -> np.ndarray:
    own = [x for name, x in variables.items() if name.split("_", 1)[-1] == output or name in ("t", WHOLE_TIME)]
    sign = np.sign(variables.get(f"v_{output}", np.zeros(1)))
    basis = [c for x in own for c in smooth(x)]
    basis += [sign * c for c in basis] if np.any(sign) else []
    return np.column_stack(basis)


def smooth(x: np.ndarray, degree: int = SMOOTH_DEGREE) -> list[np.ndarray]:
    """Return Legendre polynomials of degree 1 to `degree` of a variable (n,) scaled to its range; empty if it is constant."""
    low, high = float(x.min()), float(x.max())
    if not high > low:
        return []
    scaled = 2 * (x - low) / (high - low) - 1
    return list(legendre.legvander(scaled, degree).T[1:])


PRIOR_WEIGHT_BLOCKS = 10.0
"""Weight against the scatter of blocks, in blocks: of 'the noise model is right' on the training data, and of the training
part's own scatter on the held-out one."""
MIN_UNABSORBED_SHARE = 1e-4
"""Share of a column's square that the baseline leaves, below which the baseline's refit absorbs it. It is not smaller because
the baseline's columns contain encoder noise: a smooth copy of one of them would keep that noise as its residual, and detect
it."""
_MIN_FREE_SHARE = 0.02
"""Least share of a direction in a block that its fit is taken to leave: a direction that one block alone shows has no scatter."""


@dataclass(frozen=True, eq=False)
class WhiteResidual:
    """White rows of one part of measurements, with everything in the model projected out.

    Attributes:
        measurements: The measurements.
        parts: The parts of the data.
        whiten: Converts arrays over the runs to white rows.
        Q: Orthonormal basis of all columns in the model (R, r).
        e: The residual (R,).
        noise: Noise model of each output.
        scale: Standard deviation of white rows (1 if the noise model is right); rows are divided by it.
    """

    measurements: Measurements
    parts: tuple[int, ...]
    whiten: Whitener
    Q: np.ndarray
    e: np.ndarray
    noise: tuple[Autoregression, ...]
    scale: float

    @classmethod
    def of_columns(
        cls,
        measurements: Measurements,
        parts: Sequence[int],
        noise: Sequence[Autoregression],
        more: Sequence[Sequence[np.ndarray]] = (),
    ) -> WhiteResidual:
        """Project out the baseline's free columns and further ones (n, m, k) of each run."""
        whiten = Whitener.of(measurements.runs, measurements.masks(*parts), noise)
        rows = [whiten(columns) for columns in (measurements.free_columns, *more)]
        Q, e, scale = _project_out_rows(measurements, rows, whiten(measurements.target))
        return WhiteResidual(measurements, tuple(parts), whiten, Q, e, tuple(noise), scale)

    @property
    def n_rows(self) -> int:
        """Number of white rows R."""
        return len(self.e)

    def whiten_columns(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        """Return white rows (R, k) of columns over the runs, scaled like the residual."""
        return self.whiten(columns) / self.scale

    def draw_null_residuals(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return residuals (R, count) of pure noise after the same projection."""
        return self.project_out(rng.standard_normal((self.n_rows, count)))

    def gram(self, C: np.ndarray) -> np.ndarray:
        """Return `G` (k, k) of white rows (R, k)."""
        A = self.Q.T @ C
        return C.T @ C - A.T @ A

    def project_out(self, C: np.ndarray) -> np.ndarray:
        """Return white rows (R, k) with everything in the model projected out."""
        return C - self.Q @ (self.Q.T @ C)


def _project_out_rows(
    measurements: Measurements, rows: Sequence[np.ndarray], target: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return `Q` (R, r), the residual (R,) over its scale, and the scale.

    Args:
        measurements: The measurements, for the prior of the baseline's free columns.
        rows: White rows of these columns, then of further ones.
        target: White rows of the measurements (R,).
    """
    prior_rows, prior_y = measurements.prior
    blank = np.zeros((len(prior_y), sum(c.shape[1] for c in rows[1:])))
    stacked = np.concatenate([np.concatenate(rows, axis=1), np.concatenate([prior_rows, blank], axis=1)])
    y = np.concatenate([target, prior_y])
    Q = orthonormalise(stacked)
    e = y - Q @ (Q.T @ y)
    n = len(target)
    scale = float(np.sqrt(e @ e / max(1, n - Q.shape[1])))
    return Q[:n], e[:n] / scale, scale


@dataclass(frozen=True, eq=False)
class NullModel(WhiteResidual):
    """The white residual of a channel, with effects in the model.

    Attributes:
        library: Cache of columns of effects on the channel.
    """

    library: ColumnCache

    @classmethod
    def of(
        cls, library: ColumnCache, parts: Sequence[int], noise: Sequence[Autoregression], effects: Sequence[Effect] = ()
    ) -> NullModel:
        """Project out the baseline's free columns and those of effects."""
        channel = library.channel
        whiten, free, target = library.whiten_baseline(tuple(parts), tuple(noise))
        rows = [free, *(whiten(library.columns(effect)) for effect in effects)]
        Q, e, scale = _project_out_rows(channel, rows, target)
        return cls(channel, tuple(parts), whiten, Q, e, tuple(noise), scale, library)

    def with_effects(self, effects: Sequence[Effect]) -> NullModel:
        """Return the same part under the same noise, with these effects in the model."""
        return NullModel.of(self.library, self.parts, self.noise, effects)

    @property
    def channel(self) -> Channel:
        """The source of the data."""
        return self.library.channel

    def rows(self, effect: Effect) -> np.ndarray:
        """Return white rows (R, k) of an effect's exact columns, scaled like the residual."""
        return self.whiten_columns(self.library.columns(effect))

    def augment(self, effects: Sequence[Effect]) -> NullModel:
        """Return the null model with further effects."""
        more = orthonormalise(self.project_out(np.concatenate([self.rows(effect) for effect in effects], axis=1)))
        return replace(self, Q=np.concatenate([self.Q, more], axis=1), e=self.e - more @ (more.T @ self.e))

    def explained(
        self, settings: Sequence[Sequence[np.ndarray]], both: np.ndarray, nonnegative: np.ndarray
    ) -> np.ndarray:
        """Return score statistics (g, d) of g settings' columns, each over the runs (n, m, k), for residuals (R, d).

        Rows of outputs at which all of them are zero are left out: most effects act on one joint.
        """
        whiten, k = self.whiten, len(nonnegative)
        parts, rows, first = [], [], 0
        for number, L in enumerate(whiten.rows):
            run, output = divmod(number, whiten.n_outputs)
            last = first + len(L.indptr) - 1
            if L.nnz:
                columns = np.concatenate([made[run][:, output] for made in settings], axis=1)
                if columns.any():
                    parts.append(L @ columns)
                    rows.append(np.arange(first, last))
            first = last
        if not parts:
            return np.zeros((len(settings), both.shape[1]))
        C, index = np.concatenate(parts) / self.scale, np.concatenate(rows)
        all_of_them = len(index) == self.n_rows
        both, Q = (both, self.Q) if all_of_them else (both[index], self.Q[index])
        return compute_statistics_of_rows(C.reshape(len(C), len(settings), k), both, Q, nonnegative)


def orthonormalise(B: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """Return an orthonormal basis (R, r) of columns (R, p), dependent ones left out."""
    norm = np.linalg.norm(B, axis=0)
    B = B[:, norm > 0] / norm[norm > 0]
    if B.size == 0:
        return np.zeros((len(B), 0))
    tall, triangle = np.linalg.qr(B)  # pivots are searched in the triangle: exchanging long columns is slow
    Q, R, _ = cast(Any, linalg.qr(triangle, mode="economic", pivoting=True))
    diagonal = np.abs(np.diag(R))
    return tall @ Q[:, : int(np.sum(diagonal > tolerance * diagonal[0]))]


def compute_overdispersion(block: np.ndarray, scores: np.ndarray, square: float) -> float:
    """Return the scatter of 2 s blocks' scores (R,) over their variance under the noise model, at least 1.

    Args:
        block: Number of each row's block (R,).
        scores: Products of rows of a direction and of the residual (R,).
        square: Variance of their sum by the noise model.
    """
    if square <= 0:
        return 1.0
    count, ratio = len(np.unique(block)), float(np.sum(np.bincount(block, scores) ** 2)) / square
    return max(1.0, (count * ratio + PRIOR_WEIGHT_BLOCKS) / (count + PRIOR_WEIGHT_BLOCKS))


def compute_robust_chance(null_model: WhiteResidual, C: np.ndarray, absorbed: float = MIN_UNABSORBED_SHARE) -> float:
    """Return the p-value of the statistic of white rows (R, k) by the scatter of 2 s blocks instead of the noise model.

    The covariance of the scores is that of the blocks around the fit, corrected for the fit's share of each block ("CR2", Bell
    & McCaffrey 2002); the statistic is a weighted sum of squares under it, of as many degrees of freedom as its trace and square
    give (Satterthwaite). Many functions over few blocks with motion have few of them.
    """
    s, G = C.T @ null_model.e, null_model.gram(C)
    norm = np.sqrt(np.maximum(np.sum(C**2, axis=0), 1e-300))
    values, vectors = np.linalg.eigh(G / np.outer(norm, norm))
    kept = values > absorbed
    if not np.any(kept):
        return 1.0
    W = vectors[:, kept] / np.sqrt(values[kept]) / norm[:, None]
    rows, z = null_model.project_out(C) @ W, W.T @ s
    M = np.zeros((len(z), len(z)))
    for block in np.unique(null_model.whiten.block):
        inside = null_model.whiten.block == block
        share = rows[inside].T @ rows[inside]
        left = rows[inside].T @ null_model.e[inside] - share @ z
        values, vectors = np.linalg.eigh(share)
        left = vectors @ (vectors.T @ left / np.sqrt(np.maximum(1 - values, _MIN_FREE_SHARE)))
        M += np.outer(left, left)
    trace, square = float(np.trace(M)), float(np.sum(M**2))
    return float(stats.chi2.sf(z @ z * trace / square, trace**2 / square)) if square > 0 else 1.0


def count_effective_tests(tails: np.ndarray, seen: int) -> float:
    """Return the effective number of independent tests `m` with `P(T <= t) = F(t)^m`, by maximum likelihood.

    Args:
        tails: p-values `1 - F(t)` of the largest `T` of each draw of noise (D,).
        seen: Draws whose `T` is known, not only bounded by zero.
    """
    return float(max(1.0, -seen / np.sum(np.log1p(-tails))))


def compute_score_test(
    null_model: WhiteResidual, C: np.ndarray, nonnegative: np.ndarray, absorbed: float = MIN_UNABSORBED_SHARE
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return `T` of one setting's white rows (R, k), their scores `s` (k,) and `G` (k, k); see `compute_score_statistics`."""
    s, G = C.T @ null_model.e, null_model.gram(C)
    T = compute_score_statistics(s[None, :, None], G[None], np.sum(C**2, axis=0)[None], nonnegative, absorbed)
    return float(T[0, 0]), s, G


def compute_statistics_of_rows(
    C: np.ndarray, both: np.ndarray, Q: np.ndarray, nonnegative: np.ndarray, absorbed: float = MIN_UNABSORBED_SHARE
) -> np.ndarray:
    """Return statistics (g, d) of g settings' white rows (R, g, k) for residuals (R, d), `Q` (R, r) projected out.

    See `compute_score_statistics`.
    """
    R, g, k = C.shape
    flat = C.reshape(R, g * k)
    s = (flat.T @ both).reshape(g, k, -1)
    rows, absorbing = (np.ascontiguousarray(x.T).reshape(g, k, -1) for x in (flat, Q.T @ flat))
    square = rows @ rows.transpose(0, 2, 1)
    G = square - absorbing @ absorbing.transpose(0, 2, 1)
    return compute_score_statistics(s, G, np.diagonal(square, axis1=1, axis2=2), nonnegative, absorbed)


_ROUNDING = 1e-24
"""Square of a column, as a share of the largest one's, below which it is zero: columns of other settings may be 1e-6 as large."""


def compute_score_statistics(
    s: np.ndarray, G: np.ndarray, raw: np.ndarray, nonnegative: np.ndarray, absorbed: float = MIN_UNABSORBED_SHARE
) -> np.ndarray:
    """Return `T` for many settings and many residuals.

    Args:
        s: Scores (g, k, d) of g settings with k columns each and d residuals.
        G: Gram matrices (g, k, k), baseline projected out.
        raw: The columns' own squares (g, k), to detect those that the baseline absorbs.
        nonnegative: Amplitudes that must not be negative (k,).
        absorbed: Least share of a column that the baseline must leave.

    Returns:
        (g, d); zero where the best admissible amplitude is zero or the baseline absorbs the columns.
    """
    best = np.zeros((s.shape[0], s.shape[2]))
    k = s.shape[1]
    constrained = np.flatnonzero(nonnegative)
    for size in range(len(constrained) + 1):
        for off in combinations(constrained, size):
            on = [c for c in range(k) if c not in off]
            if not on:
                continue
            T, amplitude = _unconstrained(s[:, on], G[:, on][:, :, on], raw[:, on], absorbed)
            bound = [i for i, c in enumerate(on) if nonnegative[c]]
            feasible = np.all(amplitude[:, bound] >= 0, axis=1) if bound else np.ones_like(T, bool)
            best = np.maximum(best, np.where(feasible, T, 0.0))
    return best


def _unconstrained(s: np.ndarray, G: np.ndarray, raw: np.ndarray, absorbed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return `T` (g, d) and the amplitudes (g, k, d)."""
    norm = np.sqrt(np.where(raw > _ROUNDING * raw.max(axis=0), raw, np.inf))  # columns of rounding leave nothing
    scaled = G / norm[:, :, None] / norm[:, None, :]
    values, vectors = np.linalg.eigh(scaled)
    inverse = np.where(values > absorbed, 1 / np.maximum(values, absorbed), 0.0)
    along = np.einsum("gkl,gkd->gld", vectors, s / norm[:, :, None])
    T = np.einsum("gld,gl->gd", along**2, inverse)
    amplitude = np.einsum("gkl,gl,gld->gkd", vectors, inverse, along) / norm[:, :, None]
    return T, amplitude
