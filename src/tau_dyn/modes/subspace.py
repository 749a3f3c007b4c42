"""Subspace identification: states from the past, for open loop by projections and under feedback by a predictor.

With past and future block rows U_p, Y_p, U_f, Y_f and the data compressed to L, ordered [U_f; U_p; Y_p; Y_f],

    Y_f given the past, orthogonal to U_f:  L32 Q2;      the rest: L33 Q3,

the singular vectors of W L32 span W Gamma with Gamma the extended observability matrix. The weighting W is (L32 L32' + L33
L33')^-1/2 for CVA and the identity for MOESP; N4SID takes the oblique projection L32 L22^-1 [L21 L22]. B and D follow from the
records, given A and C.

PBSID: the one-step predictor from past inputs and outputs (a long ARX model) needs no independence of input and disturbance, so
it is consistent under feedback. Its coefficients C Atilde^{l-1} [B, K] fill Gamma-tilde K-tilde, whose product with the past is
the state, up to a choice of coordinates. With the state a known function of the past, the matrices and the innovations'
covariance follow from two regressions: y on (x, u), then x one sample later on (x, u, e). References: Van Overschee & De Moor
1996, tables 4.7, 4.8; Verhaegen & Verdult 2007, 9.5-9.6; Larimore 1990; Chiuso 2007; van der Veen, van Wingerden, Bergamasco,
Lovera, Verhaegen 2013 (PBSIDopt, (21)-(24)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from tau_dyn.exceptions import InputError
from tau_dyn.modes.fit_point import fit_input_matrices
from tau_dyn.modes.hankel import (
    MAX_LAGS,
    HankelFactor,
    compress,
    fit_predictor,
    reorder_lower_factor,
    select_length,
    solve_least_squares,
)
from tau_dyn.modes.modal_form import build_modal_form_with_coordinates
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.state_space import StateSpace


def estimate_matrices_from_states(
    T: np.ndarray, factor: HankelFactor, past: int, direct: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C, D, K and the innovations' covariance.

    Args:
        T: (n, past w), states from the past, oldest first.
        factor: Compressed data of at least `past` + 1 block rows.
        past: Block rows of past.
        direct: Whether D may differ from zero.
    """
    n, m = len(T), factor.n_inputs
    x, later = T @ factor.past(0, past), T @ factor.past(1, past + 1)
    u, y = factor.inputs(past, past + 1), factor.outputs(past, past + 1)
    seen = np.vstack([x, u]) if direct else x
    CD = solve_least_squares(y, seen)
    e = y - CD @ seen
    ABK = solve_least_squares(later, np.vstack([x, u, e]))
    D = CD[:, n:] if direct else np.zeros((len(y), m))
    return ABK[:, :n], ABK[:, n : n + m], CD[:, :n], D, ABK[:, n + m :], e @ e.T


def estimate_innovation_gain(
    A: np.ndarray, C: np.ndarray, T: np.ndarray, factor: HankelFactor, past: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return K and the innovations' covariance for given A and C, states T of the past.

    K is drawn back towards zero until A - K C is stable.
    """
    x, later = T @ factor.past(0, past), T @ factor.past(1, past + 1)
    u, y = factor.inputs(past, past + 1), factor.outputs(past, past + 1)
    rest = y - C @ x
    e = rest - solve_least_squares(rest, u) @ u if len(u) else rest
    K = solve_least_squares(later - A @ x, np.vstack([u, e]))[:, len(u) :]
    for _ in range(40):
        if np.abs(np.linalg.eigvals(A - K @ C)).max(initial=0) < 1:
            return K, e @ e.T
        K = K * 0.8
    return np.zeros_like(K), e @ e.T


WEIGHTINGS = ("cva", "moesp", "n4sid")
MAX_BLOCK_ROWS = 60  # block rows taken if the horizon is not given


@dataclass(frozen=True, eq=False)
class SubspaceFactors:
    """Matrices of the subspace method; models of any order follow without further passes over most of the data.

    Attributes:
        records: The records, aligned by the delay and scaled.
        scales: Their scales.
        factor: The compressed data.
        horizon: Block rows s of past and of future.
        delay: Whole samples of delay.
        lower: L21, L22, L32 of the data ordered [U_f; U_p, Y_p; Y_f].
        oblique: L32 L22^-1 (s p, s w), future outputs from the past.
        canonical: Singular values of the projection weighted for "cva", and the matrix whose first columns are Gamma.
    """

    records: tuple[Record, ...]
    scales: Scales
    factor: HankelFactor
    horizon: int
    delay: int
    lower: tuple[np.ndarray, np.ndarray, np.ndarray]
    oblique: np.ndarray
    canonical: tuple[np.ndarray, np.ndarray]

    def _decomposed(self, weighting: str) -> tuple[np.ndarray, np.ndarray]:
        """Singular values and the matrix whose first columns are Gamma."""
        L21, L22, L32 = self.lower
        if weighting == "cva":
            return self.canonical
        if weighting not in WEIGHTINGS:
            raise InputError("invalid_value", f"there is no weighting '{weighting}'; there are {', '.join(WEIGHTINGS)}")
        U, values, _ = np.linalg.svd(
            L32 if weighting == "moesp" else self.oblique @ np.hstack([L21, L22]), full_matrices=False
        )
        return values, U

    @property
    def largest_order(self) -> int:
        """The highest order that a model may have."""
        return (self.horizon - 1) * self.factor.n_outputs

    def observability(self, order: int, weighting: str = "cva") -> np.ndarray:
        """Return the extended observability matrix (s p, n), in scaled outputs."""
        if not 1 <= order <= self.largest_order:
            raise InputError(
                "invalid_value", f"order {order} is not between 1 and {self.largest_order}; take a longer horizon"
            )
        values, columns = self._decomposed(weighting)
        return columns[:, :order] * np.sqrt(values[:order])

    def dynamics(self, order: int, weighting: str = "cva") -> tuple[np.ndarray, np.ndarray]:
        """Return A (n, n) and C (p, n), in scaled outputs: cheap, for a stabilisation diagram."""
        p = self.factor.n_outputs
        gamma = self.observability(order, weighting)
        A = np.linalg.lstsq(gamma[:-p], gamma[p:], rcond=None)[0]
        return A, gamma[:p]

    def model(self, order: int, weighting: str = "cva", direct: bool | None = None) -> StateSpace:
        """Return the model of an order.

        Args:
            order: Number of states.
            weighting: "cva", "moesp" or "n4sid".
            direct: Whether D may differ from zero; None lets the data choose.
        """
        A, C = self.dynamics(order, weighting)
        point = fit_input_matrices(A, C, self.records, direct)
        model = point.form.state_space()
        past = np.linalg.lstsq(self.observability(order, weighting), self.oblique, rcond=None)[0]
        bare = StateSpace(A, np.zeros((order, 0)), C, np.zeros((len(C), 0)), np.zeros((order, len(C))), model.dt)
        _, W = build_modal_form_with_coordinates(bare)
        K, _ = estimate_innovation_gain(model.A, model.C, W @ past, self.factor, self.horizon)
        return replace(model, K=K, delay=self.delay, noise=point.covariance).unscaled(self.scales)


def compress_subspace_data(records: Sequence[Record], *, horizon: int | None = None, delay: int = 0) -> SubspaceFactors:
    """Compress records for the subspace method.

    Args:
        records: Unbroken stretches of inputs and outputs.
        horizon: Block rows of past and of future; it should span the slowest resonance's period, and (horizon - 1) p
            must reach the order. None takes the largest that the data permit, at most 60.
        delay: Whole samples by which the inputs act late.

    Raises:
        InputError: The records are too short, or unlike.
    """
    scales = Scales.of(records)
    ready = tuple(record.aligned(delay).scaled(scales) for record in records)
    horizon = choose_default_horizon(ready) if horizon is None else horizon
    if horizon < 2:
        raise InputError("invalid_value", "the horizon must be at least 2 samples")
    factor = compress(ready, 2 * horizon)
    L21, L22, L32, L33 = _order_by_future(factor, horizon)
    oblique = np.linalg.lstsq(L22.T, L32.T, rcond=1e-11)[0].T
    return SubspaceFactors(
        ready, scales, factor, horizon, delay, (L21, L22, L32), oblique, _decompose_canonically(L32, L33)
    )


def _order_by_future(factor: HankelFactor, s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return L21, L22, L32, L33 of the data ordered [U_f; U_p, Y_p; Y_f]."""
    f, w = s * factor.n_inputs, s * (factor.n_inputs + factor.n_outputs)
    rows = [factor.inputs(s, 2 * s), factor.past(0, s), factor.outputs(s, 2 * s)]
    L = reorder_lower_factor(np.vstack(rows))
    a, b = slice(f, f + w), slice(f + w, None)
    return L[a, :f], L[a, a], L[b, a], L[b, b]


def _decompose_canonically(L32: np.ndarray, L33: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the singular values of (L32 L32' + L33 L33')^-1/2 L32, and their vectors taken back to the outputs."""
    values, vectors = eigh(L32 @ L32.T + L33 @ L33.T)
    root = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    U, singular, _ = np.linalg.svd((vectors / root) @ vectors.T @ L32, full_matrices=False)
    return singular, (vectors * root) @ vectors.T @ U


def choose_default_horizon(records: Sequence[Record]) -> int:
    """Return a horizon with at least ten samples for every row of data."""
    w = records[0].u.shape[1] + records[0].y.shape[1]
    samples, longest = sum(r.n_samples for r in records), max(r.n_samples for r in records)
    return int(np.clip(min(samples / (20 * w), longest / 4), 2, MAX_BLOCK_ROWS))


def pbsid(
    records: Sequence[Record], order: int, *, past: int | None = None, delay: int = 0, direct: bool = False
) -> StateSpace:
    """Return a model in innovation form.

    Args:
        records: Unbroken stretches of inputs and outputs.
        order: States of plant and disturbance together: a coloured disturbance needs states of its own.
        past: Lags of the predictor; None takes Akaike's choice up to 60.
        delay: Whole samples by which the inputs act late.
        direct: Whether the present input enters too (D). Under feedback only if the controller has a delay.

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
    """Return compressed data with past + 1 block rows; if `past` is None, selected from the data, at least `least`."""
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
