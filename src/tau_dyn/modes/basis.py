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


def compute_derivative_maps(form: ModalForm, x0: np.ndarray) -> np.ndarray:
    """Return T (p, q, size + 2 k): the derivative of output o is `real @ T[o]`.

    The parameters are the full vector of the form's `Layout`, then Re and Im of each mode's state at the first sample.
    """
    layout = build_layout(form)
    k, (p, m) = len(form.poles), form.D.shape
    half = k * (m + 2)
    T = np.zeros((p, 2 * half + m, layout.size + 2 * k))
    for i in range(k):
        c, first = form.c[:, i], i * (m + 2)
        state = np.r_[form.b[i], x0[i]]  # xi in terms of the columns of this mode
        for turn, shift in ((1.0, 0), (1j, 1)):
            _add(T, layout.pole(i).start + shift, first + m + 1, half, turn * c)
            for j in range(m + 1):
                _add_diagonal(T, layout.c(i).start + shift * p, first + j, half, turn * state[j])
            for j in range(m):
                _add(T, layout.b(i).start + j + shift * m, first + j, half, turn * c)
            _add(T, layout.size + 2 * i + shift, first + m, half, turn * c)
    for o in range(p):
        for j in range(m):
            T[o, 2 * half + j, layout.D.start + o * m + j] = 1.0
    return T


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


def _add_diagonal(T: np.ndarray, parameter: int, column: int, half: int, factor: complex) -> None:
    """Let the derivative of each output by its own parameter hold Re(factor * column)."""
    o = np.arange(len(T))
    T[o, column, parameter + o] += factor.real
    T[o, half + column, parameter + o] -= factor.imag


def _add(T: np.ndarray, parameter: int, column: int, half: int, factor: np.ndarray) -> None:
    """Let the derivative hold Re(factor * column)."""
    T[:, column, parameter] += factor.real
    T[:, half + column, parameter] -= factor.imag
