"""A sampled linear model in innovation form: simulation and prediction of records, its Gramians, and its file.

    x_{k+1} = A x_k + B u_{k-d} + K e_k,   y_k = C x_k + D u_{k-d} + e_k

`d` whole samples of delay act on every input before the model sees it. Matrix entries depend on the choice of states; poles,
Markov parameters and responses do not, and only they are to be compared. Simulations take the complex Schur form A = Q T Q':
one first-order filter for each state, last state first, which costs n filters whatever the poles and needs no eigenvectors.
References: Ljung 1999, 3.2 (k-step prediction), 4.3; Moore 1981 (Gramians).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.linalg import schur, solve_discrete_lyapunov
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.modes.record import Record, Scales

MAX_RESONANT_DAMPING = float(np.sqrt(0.5))
"""Damping ratio from which on a pair of poles has no peak in its response (Ewins 2000, 2.4)."""


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A sampled linear model.

    Attributes:
        A: (n, n).
        B: (n, m).
        C: (p, n).
        D: (p, m).
        K: Gain of the innovations (n, p); zeros for an output-error model.
        dt: Sampling step [s].
        delay: Whole samples by which the inputs act late.
        noise: Covariance of the innovations (p, p), or of the output noise; None if not known.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    K: np.ndarray
    dt: float
    delay: int = 0
    noise: np.ndarray | None = None

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    def poles(self) -> np.ndarray:
        """Return the poles in the z plane (n,)."""
        return np.linalg.eigvals(self.A)

    def spectral_radius(self) -> float:
        """Return the largest magnitude of a pole; below 1 the model is stable."""
        return float(np.abs(self.poles()).max(initial=0.0))

    def in_coordinates(self, T: np.ndarray) -> StateSpace:
        """Return the same model with states x' = T^-1 x, for a square T (n, n)."""
        solve = np.linalg.solve
        return replace(self, A=solve(T, self.A @ T), B=solve(T, self.B), C=self.C @ T, K=solve(T, self.K))

    def unscaled(self, scales: Scales) -> StateSpace:
        """Return the model in the records' own units, given that of records divided by their scales."""
        u, y = scales.u, scales.y
        noise = None if self.noise is None else self.noise * np.outer(y, y)
        D = y[:, None] * self.D / u
        return replace(self, B=self.B / u, C=y[:, None] * self.C, D=D, K=self.K / y, noise=noise)

    def scaled(self, scales: Scales) -> StateSpace:
        """Return the model of records divided by their scales."""
        return self.unscaled(Scales(1 / scales.u, 1 / scales.y))

    def markov(self, n: int) -> np.ndarray:
        """Return the first `n` samples of the impulse response (n, p, m), without the delay: D, C B, C A B, ..."""
        out = np.empty((n, *self.D.shape))
        out[0], state = self.D, self.B
        for k in range(1, n):
            out[k], state = self.C @ state, self.A @ state
        return out

    def frequency_response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F, p, m) from inputs to outputs at frequencies (F,) [Hz]."""
        z = np.exp(2j * np.pi * np.asarray(frequency) * self.dt)
        eye = np.eye(self.order)
        solved = np.linalg.solve(z[:, None, None] * eye - self.A, np.broadcast_to(self.B, (len(z), *self.B.shape)))
        return (self.C @ solved + self.D) * (z**-self.delay)[:, None, None]


def compute_gramians(model: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Return the controllability and the observability Gramian, each (n, n)."""
    controllable = solve_discrete_lyapunov(model.A, model.B @ model.B.T)
    return controllable, solve_discrete_lyapunov(model.A.T, model.C.T @ model.C)


def compute_root(gramian: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Return `S` (n, n) with `S S'` a Gramian, eigenvalues raised to `least` of the largest."""
    values, vectors = np.linalg.eigh((gramian + gramian.T) / 2)
    return vectors * np.sqrt(np.maximum(values, least * values[-1]))


CHUNK = 16384  # samples at a time; arrays stay in the processor's cache
MAX_DECAY_SAMPLES = 50_000  # samples of free response that an initial state is sought in


def simulate(model: StateSpace, record: Record, x0: np.ndarray | None = None) -> np.ndarray:
    """Return the simulated outputs (N, p).

    Args:
        model: The model.
        record: Its inputs are used; before the first sample they are assumed equal to those at the first sample.
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
    known = model.delay if n > 2 * (model.delay + model.order) else 0  # earlier inputs are not in the record
    return np.linalg.lstsq(gamma[known:].reshape(-1, model.order), (rest[known:n] / scale).ravel(), rcond=1e-10)[0]


def predict(model: StateSpace, record: Record, k: int = 1) -> np.ndarray:
    """Return the outputs (N, p) predicted from measured outputs up to `k` samples before, and all inputs.

    The first k rows depend on the initial state alone.
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
        above = i + 1 + np.flatnonzero(T[i, i + 1 :])  # few if A is block-diagonal
        above = above if len(above) < n - i - 1 else slice(i + 1, None)
        pushed = drive[:, i] + out[:-1, above] @ T[i, above]
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
    """A - K C and its input."""
    return model.A - model.K @ model.C, u @ (model.B - model.K @ model.D).T + y @ model.K.T


def _free_responses(A: np.ndarray, C: np.ndarray, n: int) -> np.ndarray:
    """C A^t for t < n (n, p, states), by doubling; stops early when all states have decayed."""
    out, power = C[None], A
    size = np.abs(C).max(initial=0.0)
    while len(out) < n and np.abs(out[-1]).max(initial=0.0) > 1e-9 * size:
        out = np.concatenate([out, out @ power])
        power = power @ power
    whole = np.zeros((n, *C.shape))
    whole[: len(out)] = out[:n]
    return whole


_FORMAT = 1  # version of the model file's layout
_MATRICES = ("A", "B", "C", "D", "K")


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model with the names of its input and output columns.

    Attributes:
        model: The model, for deviations from the operating point.
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        provenance: Origin of the model.
    """

    model: StateSpace
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    provenance: dict[str, Any]


def save_state_space(path: str | Path, content: ModelFile) -> None:
    """Write a model as YAML; the file is written completely or not at all."""
    m = content.model
    rows = {name: getattr(m, name).tolist() for name in _MATRICES}
    entries = {
        "tau_dyn_state_space": _FORMAT,
        "equation": "x[k+1] = A x[k] + B u[k - delay] + K e[k],  y[k] = C x[k] + D u[k - delay] + e[k]",
        "dt": float(m.dt),
        "delay": int(m.delay),
        "inputs": list(content.inputs),
        "outputs": list(content.outputs),
        **rows,
        "noise": None if m.noise is None else m.noise.tolist(),
        "provenance": content.provenance,
    }
    write_whole(path, yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None))


def load_state_space(path: str | Path) -> ModelFile:
    """Read a model that `save_state_space` wrote.

    Raises:
        InputError: The file is missing, not YAML, or not such a model; the message names the entry.
    """
    entries = read_yaml(path)
    if not isinstance(entries, dict) or entries.get("tau_dyn_state_space") != _FORMAT:
        raise InputError(
            "file_format", f"{path}: not a state space model (its first key is 'tau_dyn_state_space: {_FORMAT}')"
        )
    for key, kind in (("inputs", list), ("outputs", list), ("A", list), ("provenance", dict)):
        if not isinstance(entries.get(key) or kind(), kind):
            raise InputError("file_format", f"{path}: '{key}' has to be a {kind.__name__}")
    inputs, outputs = (tuple(map(str, entries.get(k) or ())) for k in ("inputs", "outputs"))
    n, m, p = len(entries.get("A") or ()), len(inputs), len(outputs)
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m), "K": (n, p)}
    matrices = {name: _matrix(path, entries, name, shape) for name, shape in shapes.items()}
    noise = None if entries.get("noise") is None else _matrix(path, entries, "noise", (p, p))
    dt, delay = entries.get("dt"), entries.get("delay")
    if not isinstance(dt, int | float) or not 0 < dt < 1e9 or not isinstance(delay, int) or not 0 <= delay < 1e9:
        raise InputError(
            "file_format", f"{path}: 'dt' has to be a positive number and 'delay' a whole number from 0 up"
        )
    model = StateSpace(**matrices, dt=float(dt), delay=delay, noise=noise)
    return ModelFile(model, inputs, outputs, dict(entries.get("provenance") or {}))


def _matrix(path: str | Path, entries: dict[str, Any], name: str, shape: tuple[int, int]) -> np.ndarray:
    try:
        matrix = np.array(entries.get(name), dtype=float).reshape(shape)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            "file_format", f"{path}: '{name}' has to be a matrix of {shape[0]} by {shape[1]} numbers"
        ) from None
    if not np.all(np.isfinite(matrix)):
        raise InputError("file_format", f"{path}: '{name}' holds a number that is not finite")
    return matrix
