r"""Eigensystem realisation: a model from impulse responses, measured or estimated.

The block-Hankel matrix of Markov parameters is Gamma times the controllability matrix; its singular vectors give A, B,
C. A pulse test is the same with unknown initial states in place of inputs: once the pulse is over, every record is a
free decay. Block rows need not be neighbours, H_ij = h[i s + j], as long as the shifted matrix moves by one sample; so a
few rows span the slowest mode. Reference: Juang & Pappa 1985.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.modes.input_matrices import fit_input_matrices
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace

MAX_BLOCK_ROWS = 100  # block rows
MAX_COLUMNS = 3000  # columns over all inputs or decays
PULSE_OVER = 0.02  # of its largest magnitude: below it the pulse counts as over
HEARD = 0.8  # of a decay's energy, twice that time is looked at: quick modes drown in longer ones


@dataclass(frozen=True, eq=False)
class Realisation:
    """What all orders share.

    Attributes:
        U: Left singular vectors of the Hankel matrix.
        values: Singular values.
        shifted: U' H(1) V.
        start: V' of the first column block: what B follows from.
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
        realisation: Of the decays after each pulse.
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
        InputError: What follows the pulses is too short.
    """
    scales = Scales.of(records)
    ready = tuple(record.aligned(delay).scaled(scales) for record in records)
    decays = [record.y[_first_at_rest(record) :] for record in ready]
    n = _heard(decays)
    if n < 10:
        raise InputError("too_little_data", "the records are too short after their pulses; record the whole decay")
    return EraFactors(ready, scales, Realisation.of(np.stack([decay[:n] for decay in decays], axis=2)), delay)


def realise_pulse_tests(
    records: Sequence[Record], order: int, *, delay: int = 0, direct: bool | None = None
) -> StateSpace:
    """Return the model of pulse tests; see `decompose_pulse_tests`."""
    return decompose_pulse_tests(records, delay=delay).model(order, direct)


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
