"""First models of any order from records, by the requested method; every method guards against instability.

`n4sid` is the canonical variate analysis of `subspace.py`, `pbsid` is consistent under feedback, `arx` reduces a long
ARX model, `era` takes pulse tests. Refinement starts from these models and corrects their errors; the method is
selected in `find.py`.

Eigensystem realisation (Juang & Pappa 1985): the block-Hankel matrix of Markov parameters is Gamma times the controllability
matrix; its singular vectors give A, B, C. A pulse test is the same with unknown initial states in place of inputs: once the
pulse is over, every record is a free decay. Block rows need not be neighbours, H_ij = h[i s + j], as long as the shifted matrix
moves by one sample; so a few rows span the slowest mode. Models are reduced by balanced truncation, unstable ones by realising
their impulse response (Moore 1981; Laub, Heath, Paige, Ward 1987; the error is at most twice the sum of the dropped Hankel
singular values).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg import qr

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.modes.fit_point import fit_input_matrices
from tau_dyn.modes.hankel import arx
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace, compute_gramians, compute_root
from tau_dyn.modes.subspace import choose_default_horizon, compress_subspace_data, pbsid

MAX_BLOCK_ROWS = 100  # block rows
MAX_COLUMNS = 3000  # columns over all inputs or decays
PULSE_OVER = 0.02  # of its largest magnitude: below it the pulse counts as over
HEARD = 0.8  # of a decay's energy; twice that time is used: fast modes are hidden by noise in longer ones


@dataclass(frozen=True, eq=False)
class Realisation:
    """The decomposition that all orders share.

    Attributes:
        U: Left singular vectors of the Hankel matrix.
        values: Singular values.
        shifted: U' H(1) V.
        start: V' of the first column block, from which B follows.
        p: Number of outputs.
    """

    U: np.ndarray
    values: np.ndarray
    shifted: np.ndarray
    start: np.ndarray
    p: int

    @classmethod
    def of(cls, h: np.ndarray) -> Realisation:
        """Decompose impulse responses (N, p, m), or free decays side by side."""
        n, p, m = h.shape
        span = n // 2
        rows = min(span, MAX_BLOCK_ROWS)
        step = max(1, (span - 1) // max(rows - 1, 1))
        columns = n - (rows - 1) * step - 1
        first = np.unique(np.linspace(0, columns - 1, min(columns, max(2, MAX_COLUMNS // m))).astype(int))
        both = [h[np.add.outer(step * np.arange(rows), first + k)] for k in (0, 1)]
        H, later = (x.transpose(0, 2, 1, 3).reshape(rows * p, -1) for x in both)
        # the triangle holds all that the long rows do, and V = Q V_R
        R = np.asarray(qr(np.vstack([H, later]).T, mode="r", check_finite=False)[0])[: H.shape[1]]
        U, values, Vt = np.linalg.svd(R[:, : len(H)].T, full_matrices=False)
        start = (U.T @ H[:, :m]) / np.maximum(values, 1e-300)[:, None]
        return cls(U, values, U.T @ R[:, len(H) :].T @ Vt.T, start, p)

    def matrices(self, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return A, B, C with C A^k B = h[k].

        Raises:
            InputError: There are too few samples for the order.
        """
        if not 1 <= order <= min(self.shifted.shape) - self.p:
            raise InputError("too_little_data", f"these responses are too short to give order {order}")
        root = np.sqrt(self.values[:order])
        A = self.shifted[:order, :order] / np.outer(root, root)
        return A, root[:, None] * self.start[:order], self.U[: self.p, :order] * root


@dataclass(frozen=True, eq=False)
class EraFactors:
    """Pulse tests ready to give models of any order.

    Attributes:
        records: Aligned by the delay and scaled.
        scales: Their scales.
        realisation: Realisation of the decays after each pulse.
        delay: Whole samples of delay.
    """

    records: tuple[Record, ...]
    scales: Scales
    realisation: Realisation
    delay: int

    def dynamics(self, order: int) -> tuple[np.ndarray, np.ndarray]:
        """Return A (n, n) and C (p, n), in scaled outputs."""
        A, _, C = self.realisation.matrices(order)
        return A, C

    def model(self, order: int, direct: bool | None = None) -> StateSpace:
        """Return the model: A, C from the decays after each pulse, then B, D from the whole records.

        Args:
            order: Number of states.
            direct: Whether D may differ from zero; None lets the data choose.
        """
        point = fit_input_matrices(*self.dynamics(order), self.records, direct)
        return replace(point.form.state_space(), delay=self.delay, noise=point.covariance).unscaled(self.scales)

    def measure_loss(self, order: int) -> float:
        """Return log det of the residual covariance of an order's model, of fewer states if the decays are short."""
        most = min(self.realisation.shifted.shape) - self.realisation.p
        return fit_input_matrices(*self.dynamics(min(order, most)), self.records, True).loss + self.scales.log_size


def era(impulse_response: np.ndarray, dt: float, order: int) -> StateSpace:
    """Return the model of an impulse response.

    Args:
        impulse_response: Response (N, p, m) to one sample of unit input, its first sample D.
        dt: Sampling step [s].
        order: Number of states.

    Raises:
        InputError: The response is too short for the order.
    """
    h = np.asarray(impulse_response, dtype=float)
    if h.ndim != 3:
        raise InputError("wrong_shape", "an impulse response has the shape (samples, outputs, inputs)")
    A, B, C = Realisation.of(h[1:]).matrices(order)
    return StateSpace(A, B, C, h[0], np.zeros((order, h.shape[1])), dt)


def decompose_pulse_tests(records: Sequence[Record], *, delay: int = 0) -> EraFactors:
    """Decompose pulse tests.

    Args:
        records: Each one pulse (a hammer's blow, a step back to zero) and what follows.
        delay: Whole samples by which the inputs act late.

    Raises:
        CannotAnswer: A record's input never comes to rest.
        InputError: The records after the pulses are too short.
    """
    scales = Scales.of(records)
    ready = tuple(record.aligned(delay).scaled(scales) for record in records)
    decays = [record.y[_first_at_rest(record) :] for record in ready]
    n = _heard(decays)
    if n < 10:
        raise InputError("too_little_data", "the records are too short after their pulses; record the whole decay")
    return EraFactors(ready, scales, Realisation.of(np.stack([decay[:n] for decay in decays], axis=2)), delay)


def _heard(decays: Sequence[np.ndarray]) -> int:
    """Return the samples in which the decays have lost nearly all their energy beyond the noise at their ends."""
    n = min(map(len, decays))
    power = np.sum([np.sum(decay[:n] ** 2, axis=1) for decay in decays], axis=0)
    energy = np.cumsum(power - power[-max(1, n // 5) :].mean())
    loud = int(np.searchsorted(energy, HEARD * energy.max())) if energy.max() > 0 else n
    return min(n, max(2 * loud, 4 * MAX_BLOCK_ROWS))


def _first_at_rest(record: Record) -> int:
    """The first sample after which the input stays near zero."""
    size = np.abs(record.u).max(axis=1)
    busy = np.flatnonzero(size > PULSE_OVER * size.max(initial=0.0))
    first = int(busy[-1]) + 1 if len(busy) else 0
    if first > 0.7 * record.n_samples:
        raise CannotAnswer(
            "poor_excitation",
            f"the input of {record.name or 'a record'} never comes to rest, so there is no decay to see",
            "use a method for lasting excitation, or record longer after the pulse",
        )
    return first


MARKOV = 400  # samples of the impulse response of an unstable model


def reduce_order(model: StateSpace, order: int) -> StateSpace:
    """Return a model with fewer states and nearly the same response from inputs to outputs.

    Args:
        model: The model; inputs and outputs of unlike size should be scaled first.
        order: States to keep. The innovations' gain is carried along, not approximated on its own.

    Raises:
        InputError: The order is not between 1 and the model's.
    """
    if not 1 <= order <= model.order:
        raise InputError("invalid_value", f"cannot reduce a model of order {model.order} to {order}")
    if model.spectral_radius() >= 1:
        small = era(model.markov(MARKOV), model.dt, order)
        return replace(small, delay=model.delay, noise=model.noise)
    controllable, observable = (compute_root(gramian) for gramian in compute_gramians(model))
    U, values, Vt = np.linalg.svd(observable.T @ controllable)
    size = np.sqrt(np.maximum(values[:order], 1e-300))
    left, right = (observable @ U[:, :order]) / size, (controllable @ Vt[:order].T) / size
    return replace(model, A=left.T @ model.A @ right, B=left.T @ model.B, C=model.C @ right, K=left.T @ model.K)


METHODS = ("n4sid", "pbsid", "arx", "era")
ARX_LAGS = 60  # lags of the long ARX model, if the data suffice for them
SLOWEST = 1 - 1e-6  # largest magnitude of a pole that a first model may have

Start = Callable[[int], StateSpace]


def build_initial_estimator(method: str, records: Sequence[Record], *, delay: int = 0, highest: int = 20) -> Start:
    """Return a function from an order to a stable first model; each order, and what all share, is computed once.

    Args:
        method: `n4sid`, `pbsid`, `arx` or `era`.
        records: To fit on.
        delay: Whole samples by which the inputs act late.
        highest: The highest order that will be asked for.

    Raises:
        InputError: There is no such method, or the records are too short for it.
    """
    if method == "n4sid":
        factors = compress_subspace_data(records, delay=delay)
        return cache(lambda order: stabilise_poles(factors.model(order)))
    if method == "pbsid":
        return cache(lambda order: stabilise_poles(pbsid(records, order, delay=delay)))
    if method == "arx":
        long = arx(records, _lags(records, highest), delay=delay)
        return cache(lambda order: stabilise_poles(reduce_order(long, order)))
    if method == "era":
        decays = decompose_pulse_tests(records, delay=delay)
        return cache(lambda order: stabilise_poles(decays.model(order)))
    raise InputError("bad_option", f"--method {method}: there are auto, {', '.join(METHODS)}")


@dataclass(frozen=True, eq=False)
class InitialModels:
    """First poles and models of records under one delay.

    Attributes:
        poles: Function from an order to poles (n,) in the z plane; cheap.
        model: Function from an order to a first model.
    """

    poles: Callable[[int], np.ndarray]
    model: Start


def estimate_first_poles(
    method: str,
    records: Sequence[Record],
    *,
    delay: int,
    horizon: int = 30,
    decays: EraFactors | None = None,
) -> InitialModels:
    """Return first poles and models of any order, as cheaply as a scan over many delays needs them.

    Args:
        method: `n4sid`, `pbsid`, `arx` or `era`; poles come from the subspace method, or from `era` for pulses.
        records: To fit on.
        delay: Whole samples by which the inputs act late.
        horizon: Block rows of past and of future; fewer if the records are short.
        decays: For `era`, the decays as the longest delay leaves them: their poles are those of every delay.
    """
    if method == "era":
        here = decompose_pulse_tests(records, delay=delay)
        dynamics, model = (decays or here).dynamics, lambda n: stabilise_poles(here.model(n))
    else:
        aligned = [r.aligned(delay) for r in records]
        factors = compress_subspace_data(records, delay=delay, horizon=min(horizon, choose_default_horizon(aligned)))
        dynamics, model = factors.dynamics, lambda n: stabilise_poles(factors.model(n))
        if method == "pbsid":
            model = build_initial_estimator(method, records, delay=delay)
    return InitialModels(lambda n: np.linalg.eigvals(dynamics(n)[0]), model)


def stabilise_poles(model: StateSpace) -> StateSpace:
    """Return the model with unstable poles mirrored into the unit circle; frequencies stay, growth becomes decay."""
    if model.spectral_radius() < SLOWEST:
        return model
    values, vectors = np.linalg.eig(model.A)
    size = np.abs(values)
    inside = np.where(
        size >= SLOWEST, values / np.maximum(size, 1e-300) * np.minimum(1 / np.maximum(size, 1), SLOWEST), values
    )
    return replace(model, A=np.real(vectors @ np.diag(inside) @ np.linalg.inv(vectors)))


def _lags(records: Sequence[Record], highest: int) -> int:
    """Return the number of lags: at least ten samples per unknown, and never fewer lags than the order needs."""
    p, m = records[0].y.shape[1], records[0].u.shape[1]
    paid = sum(r.n_samples for r in records) // (10 * (p + m))
    needed = -(-highest // p)
    return max(needed, min(ARX_LAGS, paid), 2)
