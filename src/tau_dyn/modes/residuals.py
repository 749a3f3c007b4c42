r"""What a model leaves of records, and how likely that makes it.

    loss = log det (1/N) sum e_t e_t',     BIC = N loss + k log N,   AIC = N loss + 2 k

`e` is the error of a free simulation, or of a prediction one step ahead where a loop was closed; `k` counts free
numbers. With coloured noise the criteria of a simulation reward too many states: they assume that `e` is white (Ljung
1999, 16.4).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.modes.record import Record
from tau_dyn.modes.simulate import predict, simulate
from tau_dyn.modes.state_space import StateSpace

SIMULATED = "output_error"
PREDICTED = "prediction_error"


def compute_residuals(model: StateSpace, records: Sequence[Record], kind: str = SIMULATED) -> list[np.ndarray]:
    """Return measured minus simulated, or minus predicted one step ahead, (N - delay, p) a record.

    Initial states are estimated; the first `delay` samples answer to inputs before the record and are left out.
    """
    follow = simulate if kind == SIMULATED else lambda m, r: predict(m, r, 1)
    return [(r.y - follow(model, r))[model.delay :] for r in records]


def compute_covariance(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of e e' over all records (p, p)."""
    return np.sum([e.T @ e for e in errors], axis=0) / sum(len(e) for e in errors)


def compute_log_det_loss(errors: Sequence[np.ndarray]) -> float:
    """Return log det of the errors' covariance; infinite where a simulation ran away."""
    sigma = compute_covariance(errors)
    if not np.all(np.isfinite(sigma)):
        return float("inf")
    sign, value = np.linalg.slogdet(sigma)
    return float(value) if sign > 0 else float("-inf")


def measure_spread(errors: Sequence[np.ndarray]) -> float:
    """Return the sum of the outputs' log mean squares: what fits an output at a time judge; infinite where one ran away."""
    power = np.diag(compute_covariance(errors))
    return float(np.sum(np.log(np.maximum(power, 1e-300)))) if np.all(np.isfinite(power)) else float("inf")


def count_free_parameters(order: int, p: int, m: int, *, direct: bool, predicts: bool) -> int:
    """Return the free numbers of a model: its states' freedom of basis taken out (McKelvey & Helmersson 2004)."""
    return order * (p + m) + (p * m if direct else 0) + (order * p if predicts else 0)


def compute_aic_bic(loss: float, n_samples: int, k: int) -> tuple[float, float]:
    """Return AIC and BIC."""
    return n_samples * loss + 2 * k, n_samples * loss + k * float(np.log(n_samples))


def compare_errors_paired(errors: Sequence[np.ndarray], best: Sequence[np.ndarray], blocks: int = 20) -> float:
    """Return by how many standard errors some errors are larger than the best ones on the same samples.

    Every output is weighed by its best errors. Blocks of time are compared in pairs, so neither colour nor what
    both miss counts; and in ratios, so that a decay's loud beginning does not hide the rest.
    """
    weight = 1 / np.maximum(np.diag(compute_covariance(best)), 1e-300)
    length = max(20, sum(len(e) for e in best) // blocks)
    rows = []
    for e, b in zip(errors, best, strict=True):
        pair = np.column_stack([x**2 @ weight for x in (e, b)])
        parts = [part.mean(axis=0) for part in np.array_split(pair, max(1, len(pair) // length))]
        rows += [float(np.log(one / other)) for one, other in parts if one > 0 and other > 0]
    if not np.all(np.isfinite(rows)):
        return float("inf")
    scatter = float(np.std(rows, ddof=1)) / np.sqrt(len(rows)) if len(rows) > 2 else float(np.abs(np.mean(rows)))
    return float(np.mean(rows)) / scatter if scatter > 0 else 0.0
