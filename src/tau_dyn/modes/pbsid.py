r"""Predictor-based subspace identification: consistent under feedback.

The one-step predictor from past inputs and outputs (a long ARX model) needs no independence of input and disturbance.
Its coefficients C Atilde^{l-1} [B, K] fill Gamma-tilde K-tilde, whose product with the past is the state, up to a
choice of coordinates. Reference: Chiuso 2007; van der Veen, van Wingerden, Bergamasco, Lovera, Verhaegen 2013
(PBSIDopt).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.modes.arx import MAX_LAGS, fit_predictor, select_length
from tau_dyn.modes.hankel import HankelFactor, compress
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace
from tau_dyn.modes.states import estimate_matrices_from_states


def pbsid(
    records: Sequence[Record], order: int, *, past: int | None = None, delay: int = 0, direct: bool = False
) -> StateSpace:
    """Return a model in innovation form.

    Args:
        records: Unbroken stretches of inputs and outputs.
        order: States of plant and disturbance together: a coloured disturbance needs states of its own.
        past: Lags of the predictor; None takes Akaike's choice up to 60.
        delay: Whole samples by which the inputs act late.
        direct: Whether the present input enters too (D). Under feedback only where the controller has a delay.

    Raises:
        InputError: The order does not fit the past, or the records are too short.
    """
    scales = Scales.of(records)
    ready = [record.aligned(delay).scaled(scales) for record in records]
    factor = compress_predictor_data(ready, past, least=-(-2 * order // records[0].y.shape[1]))
    past = factor.rows - 1
    if not 1 <= order <= past * factor.n_outputs:
        raise InputError(
            "invalid_value", f"order {order} is not between 1 and {past * factor.n_outputs}; take a longer past"
        )
    T, _ = estimate_states_of_past(factor, order, direct)
    A, B, C, D, K, noise = estimate_matrices_from_states(T, factor, past, direct)
    return StateSpace(A, B, C, D, K, records[0].dt, delay, noise).unscaled(scales)


def compress_predictor_data(records: Sequence[Record], past: int | None, least: int = 1) -> HankelFactor:
    """Return compressed data with past + 1 block rows; where it is None the data choose, but at least `least`."""
    if past is not None:
        return compress(records, past + 1)
    w = records[0].u.shape[1] + records[0].y.shape[1]
    samples, longest = sum(r.n_samples for r in records), max(r.n_samples for r in records)
    most = max(least, int(np.clip(min(samples / (10 * w), longest / 4), 2, MAX_LAGS)))
    factor = compress(records, most + 1)
    chosen = max(least, select_length(factor))
    return factor if chosen == most else compress(records, chosen + 1)


def estimate_states_of_past(factor: HankelFactor, order: int, direct: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return T (n, past w), the states as a function of the past (oldest first), and all singular values."""
    past, w, p = factor.rows - 1, factor.n_inputs + factor.n_outputs, factor.n_outputs
    lags, _, noise = fit_predictor(factor, past, direct)
    white = np.linalg.inv(np.linalg.cholesky(noise + 1e-14 * np.eye(p)))
    oldest_first = lags[::-1].transpose(1, 0, 2).reshape(p, past * w)
    rows = np.zeros((past, p, past * w))
    for i in range(past):  # C Atilde^i times the state: lags move i blocks towards the present
        rows[i, :, i * w :] = oldest_first[:, : (past - i) * w]
    product = (white @ rows).reshape(past * p, past * w)
    U, values, _ = np.linalg.svd(product @ factor.past(0, past), full_matrices=False)
    return (U[:, :order] / np.sqrt(values[:order])).T @ product, values
