r"""ARX models as state space: y_t = sum_k A_k y_{t-k} + sum_k B_k u_{t-d-k} + e_t by linear least squares.

Of high order, an ARX model describes any linear system under any disturbance, also under feedback, at the price of many
parameters; reduce it afterwards. References: Ljung 1999, 4.2, 10.1; Ljung & Wahlberg 1992 on high orders.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.modes.hankel import HankelFactor, compress, reorder_lower_factor, solve_least_squares
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace

MAX_AR_ORDER = 40  # of the autoregression of residuals; BIC chooses below it
MAX_LAGS = 60  # longest memory of a predictor; information criteria stay below it on all but lightly damped modes


def arx(records: Sequence[Record], order: int, *, delay: int = 0, direct: bool = False) -> StateSpace:
    """Return the ARX model of an order, in observer form: `order` times p states.

    Args:
        records: Unbroken stretches of inputs and outputs.
        order: Lags of outputs and of inputs.
        delay: Whole samples by which the inputs act late.
        direct: Whether the present input enters too (D). Not for data under feedback without delay.

    Raises:
        InputError: The order is below 1 or the records are too short for it.
    """
    if order < 1:
        raise InputError("invalid_value", f"an ARX model needs at least one lag, not {order}")
    scales = Scales.of(records)
    factor = compress([record.aligned(delay).scaled(scales) for record in records], order + 1)
    lags, D, noise = fit_predictor(factor, order, direct)
    return convert_to_observer_form(lags, D, noise, records[0].dt, delay).unscaled(scales)


def fit_predictor(factor: HankelFactor, order: int, direct: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the one-step predictor of compressed data.

    Returns:
        The coefficients (order, p, w) of (u, y) one, two, ... samples ago; those of the present input (p, m); the
        covariance of the prediction errors (p, p).
    """
    last, w, p = factor.rows - 1, factor.n_inputs + factor.n_outputs, factor.n_outputs
    y, past, u = factor.outputs(last, last + 1), factor.past(last - order, last), factor.inputs(last, last + 1)
    seen = np.vstack([past, u]) if direct else past
    found = solve_least_squares(y, seen)
    e = y - found @ seen
    D = found[:, order * w :] if direct else np.zeros((p, factor.n_inputs))
    return found[:, : order * w].reshape(p, order, w).transpose(1, 0, 2)[::-1], D, e @ e.T


def convert_to_observer_form(lags: np.ndarray, D: np.ndarray, noise: np.ndarray, dt: float, delay: int) -> StateSpace:
    """Return the state space of a predictor with lags (order, p, m + p)."""
    order, p, _ = lags.shape
    m = D.shape[1]
    n = order * p
    A = np.zeros((n, n))
    A[: n - p, p:] = np.eye(n - p)
    A[:, :p] = lags[:, :, m:].reshape(n, p)
    K = A[:, :p].copy()
    B = lags[:, :, :m].reshape(n, m) + K @ D
    return StateSpace(A, B, np.eye(p, n), D, K, dt, delay, noise)


def select_length(factor: HankelFactor, penalty: float = 2.0, least: int = 1) -> int:
    """Return the number of lags, below the factor's rows, with the smallest information criterion.

    Args:
        factor: Compressed data; one triangular factor holds the losses of all lengths.
        penalty: Price of a parameter: 2 is Akaike's, log N Bayes'.
        least: Fewest lags.
    """
    last, w, p = factor.rows - 1, factor.n_inputs + factor.n_outputs, factor.n_outputs
    newest_first = [factor.past(k, k + 1) for k in range(last - 1, -1, -1)]
    L = reorder_lower_factor(np.vstack([*newest_first, factor.outputs(last, last + 1)]))[-p:]
    scores = []
    for k in range(least, last + 1):
        rest = L[:, k * w :]
        loss = np.linalg.slogdet(rest @ rest.T + 1e-300 * np.eye(p))[1]
        scores.append(factor.n_columns * loss + penalty * k * w * p)
    return least + int(np.argmin(scores))


def fit_autoregression(errors: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the coefficients (order, p, p) and innovations' covariance of a vector autoregression; order 0 for white errors.

    The order is Bayes' choice: it takes white noise for white.
    """
    p = errors[0].shape[1]
    records = [Record(np.zeros((len(e), 0)), e, 1.0, (), ()) for e in errors]
    longest = int(np.clip(max(map(len, errors)) // (20 * p), 1, MAX_AR_ORDER))
    factor = compress(records, longest + 1)
    order = select_length(factor, penalty=np.log(factor.n_columns), least=0)
    if order == 0:
        return np.zeros((0, p, p)), np.eye(p)
    lags, _, noise = fit_predictor(factor, order, False)
    return lags, noise


def compute_spectrum(coefficients: np.ndarray, noise: np.ndarray, n: int) -> np.ndarray:
    """Return the spectral density (n // 2 + 1, p, p) of an autoregression on an FFT's grid of n."""
    p = len(noise)
    polynomial = np.zeros((n, p, p))
    polynomial[0] = np.eye(p)
    polynomial[1 : len(coefficients) + 1] = -coefficients
    transfer = np.linalg.inv(np.fft.rfft(polynomial, axis=0))
    return transfer @ noise @ transfer.conj().transpose(0, 2, 1)
