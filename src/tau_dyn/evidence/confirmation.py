r"""Confirmation: a test whether the effect fitted on the training data is present in the held-out data, in the predicted size.

With `C gamma` the effect fitted on the training data and `B` everything else, the misfit predicted on other data is

    x = C gamma - B (B_t^+ C_t gamma),

the part that the baseline's training refit does not absorb. The held-out residual of the baseline's training fit is regressed
on `x`. The coefficients of `B` may change within the uncertainty of the training fit (its information as prior rows), and
freely along the shift that the effect caused: if the effect were in the training data alone, that shift would be in the
residual and resemble a part of `x`. The coefficient of `x` is 1 if the full effect is present and 0 if it is absent; the test
is a one-sided t-test. Its variance includes the scatter between blocks, in the held-out data and, with the weight of at most
ten blocks, in the training data: a misfit that changes over time is not noise.

A law of many amplitudes may be poorly determined in the range of the held-out data: its `x` would be mostly error. With
information `G` on `gamma` in the training data and `H` in the held-out ones, the two estimates of a direction are compared with
the weight `1 / (1/g + 1/h)`; so the residual is regressed on `x~`, computed from `(G + H)^-1 G gamma`, and the share still
refers to `x` (`x~` is its instrument).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.estimate import Whitener, scale_columns
from tau_dyn.evidence.measurements import TRAIN, VALIDATION
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, PRIOR_WEIGHT_BLOCKS, NullModel, WhiteResidual
from tau_dyn.results import Z95

SIGNIFICANCE_LEVEL = 0.02  # level of a confirmation, one test on data not used by the selection
_MIN_EXPECTED_Z = 4.0
"""Least size of a predicted effect, in standard errors, for which its absence counts against it."""
_LEFT = 0.01
"""Least share of a column that everything else in the model must leave."""
MIN_GAINING_SHARE = 0.5
"""Share of a predicted force above which its prediction reduces the error."""


@dataclass(frozen=True)
class Confirmation:
    """Share of a predicted effect in held-out data, its standard error, and its p-value under noise.

    `within`: the data are held-out blocks of the training logs, because the held-out logs could not show it.
    """

    share: float
    stderr: float
    p_value: float
    within: bool = False

    @property
    def is_confirmed(self) -> bool:
        """Whether held-out data confirm the effect."""
        return self.p_value < SIGNIFICANCE_LEVEL

    @property
    def is_inconclusive(self) -> bool:
        """Whether these data neither show the effect nor had enough power to show it."""
        return not self.is_confirmed and not self.stderr < 1 / _MIN_EXPECTED_Z

    @property
    def leaves_gain_open(self) -> bool:
        """Whether its 95 % interval contains the share from which the effect reduces the error."""
        return not abs(self.share - MIN_GAINING_SHARE) > Z95 * self.stderr


def confirm(
    null_model: NullModel,
    columns: Sequence[Sequence[np.ndarray]],
    others: Sequence[Effect],
    parts: tuple[int, ...] = (VALIDATION,),
    fitted_on: tuple[int, ...] = (TRAIN,),
) -> Confirmation:
    """Test columns (lists over runs of (n, m, k)) on parts of the data, with other effects in the model."""
    return confirm_columns(
        null_model, columns, [null_model.library.columns(effect) for effect in others], parts, fitted_on
    )


def confirm_columns(
    null_model: WhiteResidual,
    columns: Sequence[Sequence[np.ndarray]],
    others: Sequence[Sequence[np.ndarray]],
    parts: tuple[int, ...] = (VALIDATION,),
    fitted_on: tuple[int, ...] = (TRAIN,),
) -> Confirmation:
    """Test columns (lists over runs of (n, m, k)) on parts of the data, with the baseline's and other columns in the model.

    The noise model is that of `null_model`.
    """
    data = null_model.measurements
    train, held = (Whitener.of(data.runs, data.masks(*which), null_model.noise) for which in (fitted_on, parts))
    prior_rows, prior_y = data.prior
    B_t, B_c = (np.concatenate([w(data.free_columns), *(w(c) for c in others)], axis=1) for w in (train, held))
    C_t, C_c = (np.concatenate([w(c) for c in columns], axis=1) for w in (train, held))
    y_t, y_c = train(data.target), held(data.target)
    k = B_t.shape[1]
    prior = np.concatenate([prior_rows, np.zeros((len(prior_y), k - prior_rows.shape[1]))], axis=1)
    B_all = np.concatenate([B_t, prior])
    unit, norm = scale_columns(B_all)
    inverse = np.linalg.pinv(unit, rcond=1e-7) / norm[:, None]
    moved = inverse @ np.concatenate([C_t, np.zeros((len(prior_y), C_t.shape[1]))])
    theta = inverse @ np.concatenate([y_t, prior_y])
    left = B_c, np.asarray(np.linalg.qr(B_all, mode="r"))
    H = _information(C_c, B_c @ moved, *left)
    alone, r_t = C_t - B_t @ moved, y_t - B_t @ theta
    whole, shrunk = _amplitudes(alone, r_t, np.linalg.norm(C_t, axis=0), H)
    scatter = _Scatter.of(train.block, alone @ shrunk, r_t - alone @ whole)
    shift = moved @ shrunk
    x, predicted = C_c @ shrunk - B_c @ shift, C_c @ whole - B_c @ (moved @ whole)
    return _regress(np.column_stack([x, B_c @ shift]), predicted, y_c - B_c @ theta, *left, held.block, scatter)


def _information(C: np.ndarray, shifts: np.ndarray, B: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return the Gram matrix (k, k) of the residuals of columns (n, k) on free `shifts` (n, k) and `B` (n, p) with prior `R`."""
    rows = np.concatenate([np.column_stack([shifts, B]), np.column_stack([np.zeros((len(R), shifts.shape[1])), R])])
    own, (unit, _) = np.concatenate([C, np.zeros((len(R), C.shape[1]))]), scale_columns(rows)
    rest = own - unit @ np.linalg.lstsq(unit, own, rcond=1e-9)[0]
    return rest.T @ rest


def _amplitudes(left: np.ndarray, r: np.ndarray, own: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return amplitudes (k,) of columns with residuals `left` (n, k) on the baseline, and those weighted by the information `H`.

    Only directions that the baseline does not absorb are used. Gains of all drives, for example, equal the masses: a sum that
    only encoder noise separates from the baseline would be fitted to that noise.
    """
    scale = np.where(own > 0, own, 1.0)
    values, vectors = np.linalg.eigh((left / scale).T @ (left / scale))
    values, vectors = values[values > MIN_UNABSORBED_SHARE], vectors[:, values > MIN_UNABSORBED_SHARE]
    s = vectors.T @ ((left / scale).T @ r)
    both = np.diag(values) + vectors.T @ (H / np.outer(scale, scale)) @ vectors
    return vectors @ (s / values) / scale, vectors @ np.linalg.solve(both, s) / scale


@dataclass(frozen=True)
class _Scatter:
    """Variance of blocks' scores over that of white rows of the same variance, and the effective number of blocks."""

    ratio: float
    count: float

    @classmethod
    def of(cls, block: np.ndarray, x: np.ndarray, rest: np.ndarray) -> _Scatter:
        """Compute it along a direction (R,), whose coefficient was fitted with the residual `rest` (R,), in blocks of rows (R,).

        The leverage of each block reduces its score by the fit (Bell and McCaffrey, 2002). A misfit along the direction that
        changes from block to block makes scores proportional to the blocks' squares; the number of blocks is that of
        Satterthwaite (1946) for them.
        """
        _, block = np.unique(block, return_inverse=True)
        square = np.bincount(block, x**2)
        left = 1 - square / max(float(x @ x), 1e-300)
        square, left, scores = (z[left > _LEFT] for z in (square, left, np.bincount(block, x * rest)))
        variance = float(rest @ rest) / max(1, len(rest) - 1)
        expected = variance * float(np.sum(square))
        if expected <= 0:
            return cls(1.0, 0.0)
        return cls(float(np.sum(scores**2 / left)) / expected, float(np.sum(square**2) ** 2 / np.sum(square**4)))


def _regress(
    free: np.ndarray,
    predicted: np.ndarray,
    r: np.ndarray,
    B: np.ndarray,
    R: np.ndarray,
    block: np.ndarray,
    trained: _Scatter,
) -> Confirmation:
    """Regress `r` (n,) on free columns (n, 2), the first an instrument for `predicted` (n,), and on `B` (n, k) with prior `R`."""
    rows = np.concatenate([np.column_stack([free, B]), np.column_stack([np.zeros((len(R), 2)), R])])
    y = np.concatenate([r, np.zeros(len(R))])
    unit, norm = scale_columns(rows)
    solution = np.linalg.lstsq(unit, y, rcond=1e-9)[0] / norm
    rest = (y - rows @ solution)[: len(r)]
    others = rows[:, 1:] / norm[1:]
    along = rows[:, 0] - others @ np.linalg.lstsq(others, rows[:, 0], rcond=1e-9)[0]
    square, seen = float(along @ along), float(along[: len(r)] @ predicted)
    if square <= 0 or seen <= 0:
        return Confirmation(0.0, np.inf, 1.0)
    variance = max(float(rest @ rest) / max(1, len(r) - 1), 1e-300)
    scatter = _Scatter.of(block, along[: len(r)], rest)
    weight = min(trained.count, PRIOR_WEIGHT_BLOCKS)
    inflation = max(1.0, (scatter.count * scatter.ratio + weight * trained.ratio) / (scatter.count + weight))
    share, stderr = float(solution[0]) * square / seen, float(np.sqrt(inflation * variance * square)) / seen
    dof = max(2.0, scatter.count + weight - 1)
    return Confirmation(share, stderr, float(stats.t.sf(share / stderr, dof)))
