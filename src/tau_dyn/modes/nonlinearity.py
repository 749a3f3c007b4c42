r"""Does what a linear model leaves depend on powers of the response: a test for nonlinear stiffness, damping or friction.

With e the residual of a simulation, y the simulated output and u the inputs, the regression

    A(q) e_t = B(q) u_t + C(q) y_t + T(q) y_t^k + w_t,      k = 2, 3,      e.g. Duffing:  e = -G k3 y^3 + v

has T = 0 where the structure is linear, in open and in closed loop: w is new at t, and everything else is past. A and B take up
colour and linear dynamics that the model lacks. An F-test says whether T differs from zero, the variance of `T / A y^k` over that
of e whether it matters. References: Billings & Voon 1986; Söderström & Stoica 1989, 11.3 (nested model structures).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr
from scipy.signal import lfilter
from scipy.stats import f as fisher

from tau_dyn.modes.arx import fit_autoregression
from tau_dyn.modes.result import Nonlinearity

POWERS = (2, 3)
SIGNIFICANCE_LEVEL = 1e-3  # of a nonlinearity that is not there; one set in a thousand
MIN_VARIANCE_SHARE = 0.1
"""Share of the residual's variance that a power must explain to count: everything real is slightly nonlinear."""
INPUT_LAGS = 30  # lags of B
RESPONSE_LAGS = 2  # lags of C
POWER_LAGS = 5  # lags of T
MAX_SAMPLES = 10_000  # samples looked at


def detect_nonlinearity(
    errors: Sequence[np.ndarray], simulated: Sequence[np.ndarray], u: Sequence[np.ndarray], outputs: Sequence[str]
) -> Nonlinearity | None:
    """Test the longest record; None where it is too short.

    Args:
        errors: Measured minus simulated outputs, one (N, p) a record.
        simulated: Simulated outputs (N, p) of the same samples.
        u: Inputs (N, m), as late as the model's delay makes them act.
        outputs: Names of the outputs.
    """
    longest = int(np.argmax([len(e) for e in errors]))
    e, y, inputs = (x[longest][:MAX_SAMPLES] for x in (errors, simulated, u))
    if len(e) < 20 * INPUT_LAGS * max(1, inputs.shape[1]):
        return None
    lagged = np.hstack([np.ones((len(y), 1)), _lagged(inputs, INPUT_LAGS)])
    basis = np.asarray(qr(lagged, mode="economic")[0])
    found: list[tuple[float, float, int, int]] = []
    for i in range(len(outputs)):
        size = y[:, i].std()
        if size > 0 and e[:, i].std() > 0:
            error = e[:, i] - e[:, i].mean()
            found += [(*_test(error, y[:, i] / size, basis, power), i, power) for power in POWERS]
    if not found:
        return None
    p, share, i, power = min(found)
    p = min(1.0, p * len(found))
    return Nonlinearity(p < SIGNIFICANCE_LEVEL and share > MIN_VARIANCE_SHARE, p, share, outputs[i], power)


def _test(e: np.ndarray, y: np.ndarray, basis: np.ndarray, power: int) -> tuple[float, float]:
    """Return the p-value of T and the share that it explains, for one output and power; `basis` spans the lags of u (N, q)."""
    n = max(2, len(fit_autoregression([e[:, None]])[0]))
    past = _lagged(np.r_[0.0, e[:-1]][:, None], n - 1)
    linear = np.hstack([past, _lagged(y[:, None], RESPONSE_LAGS)])
    whole = np.hstack([linear, _lagged(y[:, None] ** power, POWER_LAGS)])
    before, missed_before = _regress(e, linear, basis, n)
    after, missed = _regress(e, whole, basis, n)
    free, extra = len(e) - basis.shape[1] - whole.shape[1], POWER_LAGS + 1
    statistic = (before - after) / extra / max(after / free, 1e-300)
    share = 1 - missed / min(missed_before, float(np.var(e)))
    return float(fisher.sf(statistic, extra, free)), max(share, 0.0)


def _regress(e: np.ndarray, columns: np.ndarray, basis: np.ndarray, n: int) -> tuple[float, float]:
    """Return the sum of squares one step ahead, and the variance that simulating e leaves; the first n columns are its past."""
    right = e - basis @ (basis.T @ e)
    apart = columns - basis @ (basis.T @ columns)
    theta = np.linalg.lstsq(apart, right, rcond=None)[0]
    new = right - apart @ theta
    drive = e - new - columns[:, :n] @ theta[:n]
    with np.errstate(all="ignore"):  # an unstable autoregression runs away and explains nothing
        missed = float(np.var(e - lfilter([1.0], np.r_[1.0, -theta[:n]], drive)))
    return float(new @ new), missed if np.isfinite(missed) else float("inf")


def _lagged(x: np.ndarray, lags: int) -> np.ndarray:
    """Return columns (N, c) as they were 0 to `lags` samples before, side by side; zero before the record."""
    return np.hstack([np.vstack([np.zeros((k, x.shape[1])), x[: len(x) - k]]) for k in range(lags + 1)])
