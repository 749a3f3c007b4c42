r"""How certain an estimate from whitened equations is, without taking their whiteness on trust.

    cov = J^-1 (K + sum g g') J^-T

`K` are known rows; the scores `g` are sums of `Z' e` over blocks. White residuals need no blocks: `sum g g'` is
`sum_j sigma_j^2 Z_j' Z_j`, which knows the error ten times better than a scatter does. Where neighbours are correlated, blocks of
0.1 s take its place. Blocks of 2 s stand beside them, for what has a longer memory; of any number wanted the larger error
counts (`noise.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.estimate.covariance import BLOCK_S, assign_blocks

SHORT_S = 0.1  # [s] of the short blocks
LAGS = 5  # samples; lags whose correlation is tested
MAX_CORRELATION_Z = 4.0
"""Standard errors that each of the first correlations may be off zero."""


def estimate_score_covariance(
    times: Sequence[np.ndarray], Z: Sequence[np.ndarray], residuals: Sequence[np.ndarray], keep: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the scores' covariance (r, r) twice: by the residual's colour, and from the scatter of long blocks.

    Args:
        times: Time (n,) of each stretch [s].
        Z: White instruments (n, m, r) of each.
        residuals: White residuals (n, m) of each, zero where an equation is left out.
        keep: Which equations count (n, m).
    """
    freedom = 1 - Z[0].shape[2] / max(sum(int(k.sum()) for k in keep), Z[0].shape[2] + 1)
    coloured = np.zeros((Z[0].shape[2],) * 2)
    for k in range(Z[0].shape[1]):
        if _white([e[:, k] for e in residuals], [x[:, k] for x in keep]):
            count = max(sum(int(x[:, k].sum()) for x in keep), 1)
            power = sum(float(np.sum(e[:, k] ** 2)) for e in residuals) / count
            coloured += power * sum(rows[:, k].T @ rows[:, k] for rows in Z)
        else:
            scores = [rows[:, k] * e[:, k, None] for rows, e in zip(Z, residuals, strict=True)]
            coloured += _scatter(times, scores, SHORT_S)
    together = [np.einsum("nmr,nm->nr", rows, e) for rows, e in zip(Z, residuals, strict=True)]
    return coloured / freedom, _scatter(times, together, BLOCK_S)


def _white(residuals: Sequence[np.ndarray], keep: Sequence[np.ndarray]) -> bool:
    """Return whether the first correlations of one output's residual are those of chance."""
    power = sum(float(np.sum(e**2)) for e in residuals) / max(sum(int(x.sum()) for x in keep), 1)
    for lag in range(1, LAGS + 1):
        pairs = sum(int(np.sum(x[lag:] & x[:-lag])) for x in keep)
        total = sum(float(np.sum(e[lag:] * e[:-lag])) for e in residuals)
        if pairs < 10 or abs(total) > MAX_CORRELATION_Z * power * np.sqrt(pairs):
            return False
    return True


def _scatter(times: Sequence[np.ndarray], scores: Sequence[np.ndarray], seconds: float) -> np.ndarray:
    """Return the sum of outer products of the scores of blocks (r, r)."""
    sums = []
    for t, g in zip(times, scores, strict=True):
        _, first = np.unique(assign_blocks(t - t[0], seconds), return_index=True)
        sums.append(np.add.reduceat(g, first, axis=0))
    blocks = np.concatenate(sums)
    blocks = blocks[np.any(blocks != 0, axis=1)]
    return blocks.T @ blocks * (len(blocks) / max(len(blocks) - 1, 1))
