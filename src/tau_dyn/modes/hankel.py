"""Block-Hankel data compressed to a square factor, and the autoregressions that follow from it.

With z_t = (u_t, y_t) and `rows` block rows, column t of the data matrix Z is (z_t, ..., z_{t+rows-1}). Least squares on rows of
Z are those on rows of any L with L L' = Z Z'. The Gram matrix Z Z' has a displacement structure,

    G_{i+1,j+1} = G_{i,j} - z_i z_j' + z_{M+i} z_{M+j}'      (M columns),

so that one block row, a correlation, gives all of it: O(N log N) for the samples, whatever the number of rows. Forming it
squares the condition number; if that costs too many digits, a QR factorisation in chunks replaces it.

ARX models, y_t = sum_k A_k y_{t-k} + sum_k B_k u_{t-d-k} + e_t, are linear least squares on these data. An ARX model of
high order describes any linear system under any disturbance, also under feedback, at the cost of many parameters;
reduce it afterwards. References: Mastronardi, Kressner, Sima, Van Dooren, Van Huffel 2001 (fast subspace identification
by displacement structure); Golub & Van Loan 2013, 5.3; Ljung 1999, 4.2, 10.1; Ljung & Wahlberg 1992 on high orders.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, qr

from tau_dyn.exceptions import InputError
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace

WORST_CONDITION = 1e12
"""Of the Gram matrix of scaled rows: above it fewer than four digits of the weakest direction are left."""
CHUNK = 4096  # columns compressed at a time; arrays stay in the processor's cache


@dataclass(frozen=True, eq=False)
class HankelFactor:
    """Compressed data.

    Attributes:
        L: (rows * w, r), with L L' = Z Z' / M; block row i holds z_{t+i} = (u, y), w = m + p wide.
        n_inputs: m.
        n_outputs: p.
        rows: Number of block rows.
        n_columns: Columns M of the data matrix, over all records.
        method: "gram" or "qr".
    """

    L: np.ndarray
    n_inputs: int
    n_outputs: int
    rows: int
    n_columns: int
    method: str

    def past(self, first: int, last: int) -> np.ndarray:
        """Return rows of inputs and outputs of block rows first to last - 1, as compressed data."""
        w = self.n_inputs + self.n_outputs
        return self.L[first * w : last * w]

    def inputs(self, first: int, last: int) -> np.ndarray:
        """Return the rows of the inputs only."""
        return self._part(first, last, slice(0, self.n_inputs))

    def outputs(self, first: int, last: int) -> np.ndarray:
        """Return the rows of the outputs only."""
        return self._part(first, last, slice(self.n_inputs, None))

    def _part(self, first: int, last: int, columns: slice) -> np.ndarray:
        blocks = self.past(first, last).reshape(last - first, self.n_inputs + self.n_outputs, -1)
        return blocks[:, columns].reshape(-1, self.L.shape[1])


def compress(records: Sequence[Record], rows: int, method: str = "auto") -> HankelFactor:
    """Compress the block-Hankel matrix of records, best scaled and aligned before.

    Args:
        records: Unbroken stretches; a column never reaches across two of them. Stretches shorter than `rows` are left out.
        rows: Block rows.
        method: "gram", "qr", or "auto": Gram unless it is ill-conditioned.

    Raises:
        InputError: The records are shorter than twice the unknowns of a row ask for.
    """
    data = [np.hstack([record.u, record.y]) for record in records if record.n_samples >= rows]
    w = records[0].u.shape[1] + records[0].y.shape[1]
    n_columns = sum(len(z) - rows + 1 for z in data)
    if n_columns < rows * w:
        samples = sum(record.n_samples for record in records)
        raise InputError(
            "too_little_data",
            f"{samples} samples are too few for {rows} block rows of {w} signals; shorten the horizon",
        )
    L = None
    if method in ("auto", "gram"):
        L = _cholesky(np.sum([_gram(z, rows) for z in data], axis=0), forced=method == "gram")
    used = "qr" if L is None else "gram"
    if L is None:
        L = _triangle(chunk for z in data for chunk in _hankel_chunks(z, rows))
    return HankelFactor(L / np.sqrt(n_columns), records[0].u.shape[1], records[0].y.shape[1], rows, n_columns, used)


def reorder_lower_factor(L: np.ndarray) -> np.ndarray:
    """Return the lower triangular factor of compressed data whose rows were taken in another order."""
    return np.asarray(qr(L.T, mode="r", check_finite=False)[0])[: min(L.shape)].T


def solve_least_squares(target: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return X of target = X rows + rest, both compressed data; directions without data count as zero."""
    scale = np.linalg.norm(rows, axis=1)
    scale[scale == 0] = 1.0
    solution = np.linalg.lstsq((rows / scale[:, None]).T, target.T, rcond=1e-11)[0]
    return solution.T / scale


def _gram(z: np.ndarray, rows: int) -> np.ndarray:
    """Z Z' from its first block row and rank-2w updates."""
    w, M = z.shape[1], len(z) - rows + 1
    first = _correlations(z, rows)
    out = np.empty((rows, w, rows, w))
    for j in range(rows):
        out[0, :, j] = first[j]
        out[j, :, 0] = first[j].T
    for i in range(1, rows):
        change = np.einsum("a,jb->ajb", z[M + i - 1], z[M + i - 1 : M + rows - 1])
        change -= np.einsum("a,jb->ajb", z[i - 1], z[i - 1 : rows - 1])
        out[i, :, i:] = out[i - 1, :, i - 1 : -1] + change
        out[i:, :, i] = out[i, :, i:].transpose(1, 2, 0)
    return out.reshape(rows * w, rows * w)


def _correlations(z: np.ndarray, rows: int) -> np.ndarray:
    """sum_{t < M} z_t z_{t+j}' for j < rows (rows, w, w), by FFT of short blocks: memory does not grow with N."""
    w, M = z.shape[1], len(z) - rows + 1
    size = 1 << (max(CHUNK, 8 * rows) - 1).bit_length()
    step = size - rows + 1
    cross = np.zeros((size // 2 + 1, w, w), dtype=complex)
    for start in range(0, M, step):
        stop = min(start + step, M)
        head = np.fft.rfft(z[start:stop], size, axis=0)
        whole = np.fft.rfft(z[start : stop + rows - 1], size, axis=0)
        cross += head.conj()[:, :, None] * whole[:, None, :]
    return np.fft.irfft(cross, size, axis=0)[:rows]


def _cholesky(G: np.ndarray, forced: bool) -> np.ndarray | None:
    """The Cholesky factor of a Gram matrix, None if it is too ill-conditioned."""
    size = np.sqrt(np.maximum(np.diag(G), 0.0))
    if not np.all(size > 0):
        return None
    scaled = G / np.outer(size, size)
    L, info = lapack.dpotrf(scaled, lower=1, clean=1)
    if info != 0:
        return None
    rcond, _ = lapack.dpocon(L, np.abs(scaled).sum(axis=0).max(), uplo="L")
    return size[:, None] * L if forced or rcond * WORST_CONDITION > 1 else None


def _hankel_chunks(z: np.ndarray, rows: int) -> Iterable[np.ndarray]:
    """Columns of the Hankel matrix, transposed, some thousands at a time."""
    w = z.shape[1]
    windows = np.lib.stride_tricks.sliding_window_view(z, rows, axis=0).transpose(0, 2, 1)
    for start in range(0, len(windows), max(CHUNK, rows * w)):
        yield windows[start : start + max(CHUNK, rows * w)].reshape(-1, rows * w)


def _triangle(chunks: Iterable[np.ndarray]) -> np.ndarray:
    """L of L L' = sum of chunk' chunk, by QR of each chunk under the triangle so far."""
    R: np.ndarray | None = None
    for chunk in chunks:
        R = np.asarray(qr(chunk if R is None else np.vstack([R, chunk]), mode="r", check_finite=False)[0])
        R = R[: R.shape[1]]
    assert R is not None
    return R.T


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
