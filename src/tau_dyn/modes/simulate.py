r"""What a model says of a record: simulated, and predicted k samples ahead.

States follow from the complex Schur form A = Q T Q': one first-order filter for each state, last state first. That
costs n filters whatever the poles, and no eigenvectors. Reference: Ljung 1999, 3.2 (k-step prediction).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import schur
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace

CHUNK = 16384  # samples at a time; arrays stay in the processor's cache
MAX_DECAY_SAMPLES = 50_000  # samples of free response that an initial state is sought in


def simulate(model: StateSpace, record: Record, x0: np.ndarray | None = None) -> np.ndarray:
    """Return the simulated outputs (N, p).

    Args:
        model: The model.
        record: Its inputs are used; before its first sample they are taken to have been what they are there.
        x0: State at the first sample (n,); None takes the one that fits the record's outputs best.
    """
    u = delay_inputs(model, record)
    x0 = estimate_initial_state(model, record) if x0 is None else np.asarray(x0, dtype=float)
    return simulate_states(model.A, u @ model.B.T, x0) @ model.C.T + u @ model.D.T


def estimate_initial_state(model: StateSpace, record: Record, predictor: bool = False) -> np.ndarray:
    """Return the state (n,) at the first sample with which the simulation, or the one-step predictor, fits best."""
    u = delay_inputs(model, record)
    n = min(record.n_samples, MAX_DECAY_SAMPLES)
    A, drive = (model.A, u @ model.B.T) if not predictor else _predictor(model, u, record.y)
    rest = record.y - simulate_states(A, drive, np.zeros(model.order)) @ model.C.T - u @ model.D.T
    scale = np.sqrt(np.mean(rest**2, axis=0))
    scale[scale == 0] = 1.0
    gamma = _free_responses(A, model.C / scale[:, None], n)
    known = model.delay if n > 2 * (model.delay + model.order) else 0  # what acted before is not in the record
    return np.linalg.lstsq(gamma[known:].reshape(-1, model.order), (rest[known:n] / scale).ravel(), rcond=1e-10)[0]


def predict(model: StateSpace, record: Record, k: int = 1) -> np.ndarray:
    """Return the outputs (N, p) predicted from measured outputs up to `k` samples before, and all inputs.

    The first k rows rest on the initial state alone.
    """
    if k < 1:
        raise InputError("invalid_value", f"predictions look at least one sample ahead, not {k}")
    u = delay_inputs(model, record)
    A, drive = _predictor(model, u, record.y)
    first = estimate_initial_state(model, record, predictor=True)
    x = simulate_states(A, drive, first)
    for _ in range(min(k, len(x)) - 1):  # one sample further without the measured output
        x[1:] = x[:-1] @ model.A.T + u[:-1] @ model.B.T
        x[0] = first
    return x @ model.C.T + u @ model.D.T


def simulate_states(A: np.ndarray, drive: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Return x (N, n) of x+ = A x + drive, from x0 at the first sample."""
    T, Q = schur(A, output="complex")[:2]
    out, first = np.empty(drive.shape), np.asarray(x0, dtype=complex)
    for start in range(0, len(drive), CHUNK):
        forced = drive[start : start + CHUNK] @ Q.conj()
        part, last = _triangular(T, forced, Q.conj().T @ first)
        out[start : start + CHUNK], first = (part @ Q.T).real, Q @ last
    return out


def _triangular(T: np.ndarray, drive: np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States of x+ = T x + drive with upper triangular T, and the state after the last sample."""
    n = len(T)
    out = np.zeros((len(drive) + 1, n), dtype=complex, order="F")
    out[0] = x0
    for i in range(n - 1, -1, -1):
        pushed = drive[:, i] + out[:-1, i + 1 :] @ T[i, i + 1 :]
        out[1:, i] = lfilter([1.0], [1.0, -T[i, i]], pushed, zi=T[i, i] * x0[i : i + 1])[0]
    return out[:-1], out[-1]


def delay_inputs(model: StateSpace, record: Record) -> np.ndarray:
    """Return the inputs as the model sees them (N, m): late by its delay, the first one held before the record."""
    if record.u.shape[1] != model.B.shape[1] or record.y.shape[1] != len(model.C):
        raise InputError("mismatch", "the record's inputs or outputs are not those of the model")
    if model.delay == 0 or record.n_samples == 0:
        return record.u
    late = min(model.delay, record.n_samples)
    return np.vstack([np.repeat(record.u[:1], late, axis=0), record.u[: record.n_samples - late]])


def _predictor(model: StateSpace, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A - K C and what drives it."""
    return model.A - model.K @ model.C, u @ (model.B - model.K @ model.D).T + y @ model.K.T


def _free_responses(A: np.ndarray, C: np.ndarray, n: int) -> np.ndarray:
    """C A^t for t < n (n, p, states), by doubling; stops early where all has decayed."""
    out, power = C[None], A
    size = np.abs(C).max(initial=0.0)
    while len(out) < n and np.abs(out[-1]).max(initial=0.0) > 1e-9 * size:
        out = np.concatenate([out, out @ power])
        power = power @ power
    whole = np.zeros((n, *C.shape))
    whole[: len(out)] = out[:n]
    return whole
