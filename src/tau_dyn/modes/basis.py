r"""The columns from which a modal form's outputs and gradients are made, a chunk of samples at a time.

For every mode i and input j the filtered input x_ij(t+1) = lambda_i x_ij(t) + u_j(t), the free response f_i(t) =
lambda_i^t and the sensitivity s_i(t+1) = lambda_i s_i(t) + xi_i(t) = d xi_i(t+1) / d lambda_i. The output of the model
and its derivative with respect to every parameter are linear in these few columns, for all outputs at once: one pass
over the samples gives the exact gradient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from tau_dyn.modes.modal_form import ModalForm, build_layout
from tau_dyn.modes.record import Record

CHUNK = 8192  # samples at a time; arrays stay in the processor's cache
DUST = 1e-60  # of a free response below this nothing is kept: products of such numbers make processors crawl


@dataclass(frozen=True, eq=False)
class BasisColumns:
    """Columns of some samples.

    Attributes:
        part: The samples of the record.
        real: (L, q): real parts of all complex columns, their imaginary parts, then the inputs.
        predicted: Output of the model (L, p).
    """

    part: slice
    real: np.ndarray
    predicted: np.ndarray


def build_columns(form: ModalForm, x0: np.ndarray, record: Record, chunk: int = CHUNK) -> Iterator[BasisColumns]:
    """Walk through a record whose inputs are already aligned by the delay.

    Args:
        form: The model.
        x0: Its complex modal states at the first sample (k,).
        record: The record.
        chunk: Samples at a time.
    """
    k, m = len(form.poles), form.D.shape[1]
    filtered = np.zeros((k, m), dtype=complex)  # the states at the first sample of the chunk
    free, slope = np.ones(k, dtype=complex), np.zeros(k, dtype=complex)
    for start in range(0, record.n_samples, chunk):
        u = record.u[start : start + chunk]
        n = len(u)
        X = np.zeros((n, k, m + 2), dtype=complex)
        for i, pole in enumerate(form.poles):
            X[:, i, :m], filtered[i] = _states(pole, u, filtered[i])
            if free[i] != 0:
                response, free[i : i + 1] = _states(pole, np.zeros((n, 1)), free[i : i + 1])
                X[:, i, m] = _without_dust(response[:, 0])
                free[i] = _without_dust(free[i])
            xi = X[:, i, :m] @ form.b[i] + x0[i] * X[:, i, m]
            sensitivity, slope[i : i + 1] = _states(pole, xi[:, None], slope[i : i + 1])
            X[:, i, m + 1] = _without_dust(sensitivity[:, 0])
        xi = np.einsum("tkm,km->tk", X[:, :, :m], form.b) + X[:, :, m] * x0
        predicted = xi.real @ form.c.T.real - xi.imag @ form.c.T.imag + u @ form.D.T
        flat = X.reshape(n, k * (m + 2))
        yield BasisColumns(slice(start, start + n), np.hstack([flat.real, flat.imag, u]), predicted)


@dataclass(frozen=True, eq=False)
class DerivativeMaps:
    """Derivatives of the outputs with respect to the form's full vector, then Re and Im of each mode's first state.

    Poles, inputs' shapes and first states move all outputs, by one complex column each:
    `dy_o / d(shared[a]) = real[o, a] * Re column + imaginary[o, a] * Im column`. Entries of c and D move one output each, and all
    outputs alike: `dy_o / d(own[o, b]) = columns @ own_map[:, b]`.

    Attributes:
        size: Numbers of the full vector and of the first states.
        shared: Positions of numbers that move all outputs (s,).
        re, im: Their columns among the real ones (s,).
        real, imaginary: Factors of these columns (p, s).
        own: Positions of the numbers that move one output (p, w).
        own_map: (q, w).
    """

    size: int
    shared: np.ndarray
    re: np.ndarray
    im: np.ndarray
    real: np.ndarray
    imaginary: np.ndarray
    own: np.ndarray
    own_map: np.ndarray


def compute_derivative_maps(form: ModalForm, x0: np.ndarray) -> DerivativeMaps:
    """Return the derivatives of the outputs; `x0` is each mode's state at the first sample (k,)."""
    layout = build_layout(form)
    k, (p, m) = len(form.poles), form.D.shape
    half = k * (m + 2)
    shared, columns, factors = [], [], []
    own, own_map = np.zeros((p, 2 * k + m), dtype=int), np.zeros((2 * half + m, 2 * k + m))
    outputs = np.arange(p)
    for i in range(k):
        first = i * (m + 2)
        state = np.r_[form.b[i], x0[i]]  # xi in terms of the columns of this mode
        for turn, shift in ((1.0, 0), (1j, 1)):
            inputs = layout.b(i).start + np.arange(m) + shift * m
            shared += [layout.pole(i).start + shift, *inputs, layout.size + 2 * i + shift]
            columns += [first + m + 1, *(first + np.arange(m)), first + m]
            factors += [turn * form.c[:, i]] * (m + 2)
            own[:, 2 * i + shift] = layout.c(i).start + shift * p + outputs
            own_map[first : first + m + 1, 2 * i + shift] = (turn * state).real
            own_map[half + first : half + first + m + 1, 2 * i + shift] = -(turn * state).imag
    own[:, 2 * k :] = layout.D.start + outputs[:, None] * m + np.arange(m)
    own_map[2 * half :, 2 * k :] = np.eye(m)
    where, factor = np.array(columns, dtype=int), np.array(factors).reshape(-1, p).T
    size = layout.size + 2 * k
    return DerivativeMaps(
        size, np.array(shared, dtype=int), where, half + where, factor.real, -factor.imag, own, own_map
    )


def _states(pole: complex, u: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States of x+ = pole x + u (n, q) from `first` (q,), and the state after the last sample."""
    n = len(u)
    if n == 0 or u.shape[1] == 0:
        return np.zeros((n, u.shape[1]), dtype=complex), first
    out, _ = lfilter([1.0], [1.0, -pole], u, axis=0, zi=(pole * first)[None])
    states = np.vstack([first[None], out[:-1]])
    return states, out[-1]


def _without_dust(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) < DUST, 0.0, values)
