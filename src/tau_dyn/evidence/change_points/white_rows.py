"""White rows of one log in time order, with the model and smooth functions of each joint's own motion projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.estimate import Autoregression, Regression, Whitener
from tau_dyn.evidence.change_points.log_data import Columns, Hypothesis, LogData
from tau_dyn.evidence.null_model import fit_noise_model, orthonormalise, smooth

SLOW_SPEED_SHARES = (0.02, 0.06, 0.2)
"""Speeds, relative to the fastest, at which missing Stribeck friction of the model may have decreased to a third: a logarithmic
grid, as polynomials of the speed do not fit it."""


@dataclass(frozen=True, eq=False)
class OrderedRows:
    """White rows of one log in time order; only changes in the columns are in the model.

    Attributes:
        whiten: Converts arrays over the runs to white rows.
        order: Order of those rows in time (R,).
        y: Forces (R,).
        Q: Orthonormal basis of everything in the model (R, r).
        t: Times (R,) [s].
        output: Outputs (R,).
        block: Numbers of blocks of 2 s (R,).
    """

    whiten: Whitener
    order: np.ndarray
    y: np.ndarray
    Q: np.ndarray
    t: np.ndarray
    output: np.ndarray
    block: np.ndarray

    @property
    def fit(self) -> np.ndarray:
        """Predicted forces (R,)."""
        return self.Q @ (self.Q.T @ self.y)

    def whiten_columns(self, columns: Columns) -> np.ndarray:
        """Return rows (R, d) of columns (n, m, d) over the runs."""
        return self.whiten(columns)[self.order]

    def make_rows(self, hypothesis: Hypothesis) -> np.ndarray:
        """Return the rows (R, d) whose step is the hypothesis; the predicted force for a factor."""
        if hypothesis.columns:
            return self.whiten_columns(hypothesis.columns)
        return np.where(self.output == hypothesis.output, self.fit, 0.0)[:, None]


def make_rows(data: LogData, noise: Sequence[Autoregression]) -> OrderedRows | None:
    """Return white rows; None if the log is too short for its columns."""
    runs, rich = data.runs, _build_smooth_columns(data.regression)
    known = data.columns
    if sum(int(run.usable.sum()) for run in runs) < 2 * (sum(x[0].shape[1] for x in rich) + known[0].shape[2]):
        return None
    whiten = Whitener.of(runs, [run.usable for run in runs], noise)
    order = np.argsort(whiten.t, kind="stable")
    own = []
    for k, x in enumerate(rich):
        placed = np.zeros((whiten.n_rows, x[0].shape[1]))
        placed[whiten.index == k] = whiten.one(k, x)
        own.append(placed)
    Q = orthonormalise(np.concatenate([whiten(known), *own], axis=1)[order])
    y, output = whiten([run.y for run in runs])[order], whiten.index[order]
    # A torque constant that is wrong throughout contradicts the bodies that the joints share. Without a constant factor of each
    # output in the model, a change of the factor right after the start of the log explains that.
    made = (output[:, None] == np.unique(output)) * (Q @ (Q.T @ y))[:, None]
    new = made - Q @ (Q.T @ made)
    new = new[:, np.linalg.norm(new, axis=0) > 1e-6 * np.linalg.norm(made, axis=0)]
    Q = np.column_stack([Q, orthonormalise(new)])
    return OrderedRows(whiten, order, y, Q, whiten.t[order], output, whiten.block[order])


def _build_smooth_columns(regression: Regression) -> list[list[np.ndarray]]:
    """Return smooth functions (n, c) of each joint's own position and speed, and the same times the direction, of each run."""
    ends = np.cumsum([len(run.t) for run in regression.runs])[:-1]
    found = []
    for k in range(len(regression.outputs)):
        q, v = (np.concatenate([run.signals[x][:, k] for run in regression.runs]) for x in ("q", "v"))
        slow = [np.exp(-np.abs(v) / max(share * np.abs(v).max(), 1e-300)) for share in SLOW_SPEED_SHARES]
        basis = [*smooth(q), *smooth(v), *slow]
        basis += [np.sign(v) * c for c in (np.ones(len(v)), *basis)]
        found.append(np.split(np.column_stack(basis), ends))
    return found


def estimate_noise(data: LogData, order: int) -> tuple[Autoregression, ...]:
    """Return the noise model of each output, up to an order, with its variance corrected for the fitted columns."""
    runs, known, rich = data.runs, data.columns, _build_smooth_columns(data.regression)
    found = []
    for k in range(len(data.regression.outputs)):
        columns = [np.concatenate([c[:, k], x], axis=1) for c, x in zip(known, rich[k], strict=True)]
        measured, masks = [run.y[:, k] for run in runs], [run.usable[:, k] for run in runs]
        found.append(fit_noise_model(columns, measured, masks, order, unbiased=True))
    return tuple(found)
