"""How a modal form fits records: outputs, loss, gradient and Gauss-Newton matrix in one pass over the samples.

For every mode i and input j the filtered input x_ij(t+1) = lambda_i x_ij(t) + u_j(t), the free response f_i(t) = lambda_i^t and
the sensitivity s_i(t+1) = lambda_i s_i(t) + xi_i(t) = d xi_i(t+1) / d lambda_i. The output of the model and its derivative with
respect to every parameter are linear in these few columns, for all outputs at once.

The loss is the concentrated likelihood of output errors that are white in time, log det S with S their covariance between
outputs; its Gauss-Newton matrix is sum_t J_t' S^-1 J_t. Given A and C, the rest (B, D, initial states) is linear and found in
one step. References: Ljung 1999, 7.4, 10.2, (10.128); McKelvey, Helmersson, Ribarits 2004; Verhaegen & Verdult 2007, 9.2.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form, free_numbers, step_form
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace

CHUNK = 8192  # samples at a time; arrays stay in the processor's cache
MIN_LENGTH_SHARE = 0.7  # of the longest of the records that are walked through side by side: the rest is zeros
DUST = 1e-60  # a free response below this is dropped: products of such numbers are very slow to compute


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
    moves = form.b.any(axis=1) | (x0 != 0)
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
            if moves[i]:
                sensitivity, slope[i : i + 1] = _states(pole, xi[:, None], slope[i : i + 1])
                X[:, i, m + 1] = _without_dust(sensitivity[:, 0])
        xi = np.einsum("tkm,km->tk", X[:, :, :m], form.b) + X[:, :, m] * x0
        predicted = xi.real @ form.c.T.real - xi.imag @ form.c.T.imag + u @ form.D.T
        flat = X.reshape(n, k * (m + 2))
        yield BasisColumns(slice(start, start + n), np.hstack([flat.real, flat.imag, u]), predicted)


@dataclass(frozen=True, eq=False)
class DerivativeMaps:
    """Derivatives of the outputs with respect to the form's full vector, then Re and Im of each mode's first state.

    Poles, input shapes and first states move all outputs, by one complex column each:
    `dy_o / d(shared[a]) = real[o, a] * Re column + imaginary[o, a] * Im column`. Entries of c and D move one output
    each, in the same way for every output: `dy_o / d(own[o, b]) = columns @ own_map[:, b]`.

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
    for i in range(k):
        first = i * (m + 2)
        state = np.r_[form.b[i], x0[i]]  # xi in terms of the columns of this mode
        for turn, shift in ((1.0, 0), (1j, 1)):
            shared += [layout.pole[i, shift], *layout.b[i, shift], layout.size + 2 * i + shift]
            columns += [first + m + 1, *(first + np.arange(m)), first + m]
            factors += [turn * form.c[:, i]] * (m + 2)
            own[:, 2 * i + shift] = layout.c[i, shift]
            own_map[first : first + m + 1, 2 * i + shift] = (turn * state).real
            own_map[half + first : half + first + m + 1, 2 * i + shift] = -(turn * state).imag
    own[:, 2 * k :] = layout.D
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


FLOOR = 1e-13  # errors below this part of the outputs' power are rounding


@dataclass(frozen=True, eq=False)
class FittedForm:
    """A model with the initial states of all records, and how it fits.

    Attributes:
        form: The model.
        x0: Modal states at each record's first sample (R, k) complex.
        squares: sum_t e e' (p, p).
        n_samples: Samples in all.
        power: Mean square of each output (p,).
    """

    form: ModalForm
    x0: np.ndarray
    squares: np.ndarray
    n_samples: int
    power: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the output errors between outputs (p, p)."""
        return self.squares / self.n_samples + FLOOR * np.diag(self.power)

    @property
    def loss(self) -> float:
        """Log det of that covariance; infinite if the model diverges."""
        if not np.isfinite(self.squares).all():
            return np.inf
        sign, value = np.linalg.slogdet(self.covariance)
        return float(value) if sign > 0 else np.inf


@dataclass(frozen=True, eq=False)
class FitPoint(FittedForm):
    """The same, with the products that steps follow from.

    Attributes:
        grams: For every record columns' columns (q, q).
        cross: For every record columns' e (q, p).
    """

    grams: tuple[np.ndarray, ...]
    cross: tuple[np.ndarray, ...]


def evaluate(form: ModalForm, x0: np.ndarray, records: Sequence[Record]) -> FitPoint:
    """Return the point of a model over records that are aligned and scaled."""
    p, q = form.D.shape[0], 2 * len(form.poles) * (form.D.shape[1] + 2) + form.D.shape[1]
    squares, power = np.zeros((p, p)), np.zeros(p)
    grams, cross = np.zeros((len(records), q, q)), np.zeros((len(records), q, p))
    for together in _group_by_length(records):
        some = [records[r] for r in together]
        parts = _walk_together(form, x0[together], some) if len(some) > 1 else _walk(form, x0[together[0]], some[0])
        for real, predicted, y in parts:
            error = y - predicted
            for e, own in zip(error, y, strict=True):
                squares += e.T @ e
                power += (own**2).sum(axis=0)
            turned = real.transpose(0, 2, 1)
            grams[together] += turned @ real
            cross[together] += turned @ error
    n = sum(record.n_samples for record in records)
    return FitPoint(form, x0, squares, n, power / n, tuple(grams), tuple(cross))


Walk = Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Columns (R, L, q), outputs of the model (R, L, p) and measured ones (R, L, p) of some samples of some records."""


def _group_by_length(records: Sequence[Record]) -> list[list[int]]:
    """Return records that are walked through together: of like length, and not too many for the processor's cache."""
    order = sorted(range(len(records)), key=lambda r: -records[r].n_samples)
    groups: list[list[int]] = []
    for r in order:
        longest = records[groups[-1][0]].n_samples if groups else 0
        alike = records[r].n_samples > MIN_LENGTH_SHARE * longest
        if groups and alike and longest * (len(groups[-1]) + 1) <= CHUNK:
            groups[-1].append(r)
        else:
            groups.append([r])
    return groups


def _walk(form: ModalForm, x0: np.ndarray, record: Record) -> Walk:
    for columns in build_columns(form, x0, record):
        yield columns.real[None], columns.predicted[None], record.y[None, columns.part]


def _walk_together(form: ModalForm, x0: np.ndarray, records: Sequence[Record]) -> Walk:
    """Walk through several records side by side, zeros after the end of the shorter ones; see `build_columns`."""
    k, (p, m), R, n = len(form.poles), form.D.shape, len(records), max(record.n_samples for record in records)
    u, y, ended = np.zeros((n, R, m)), np.zeros((n, R, p)), np.ones((n, R), bool)
    for r, record in enumerate(records):
        u[: record.n_samples, r], y[: record.n_samples, r], ended[: record.n_samples, r] = record.u, record.y, False
    X = np.zeros((n, R, k, m + 2), dtype=complex)
    for i, pole in enumerate(form.poles):
        X[:, :, i, :m] = _states(pole, u.reshape(n, -1), np.zeros(R * m, dtype=complex))[0].reshape(n, R, m)
        X[:, :, i, m] = _without_dust(_states(pole, np.zeros((n, 1)), np.ones(1, dtype=complex))[0])
        xi = X[:, :, i, :m] @ form.b[i] + x0[:, i] * X[:, :, i, m]
        if xi.any():
            X[:, :, i, m + 1] = _without_dust(_states(pole, xi, np.zeros(R, dtype=complex))[0])
    X[ended] = 0.0
    xi = np.einsum("trkm,km->trk", X[:, :, :, :m], form.b) + X[:, :, :, m] * x0
    predicted = xi.real @ form.c.T.real - xi.imag @ form.c.T.imag + u @ form.D.T
    flat = X.reshape(n, R, -1).transpose(1, 0, 2)
    real = np.concatenate([flat.real, flat.imag, u.transpose(1, 0, 2)], axis=2)
    yield real, predicted.transpose(1, 0, 2), y.transpose(1, 0, 2)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations over the free numbers: the model's, then the initial states record by record.

    Attributes:
        H: Gauss-Newton matrix (f, f).
        g: Descent direction's right-hand side (f,).
        free: Which numbers of the full vector, of all records' initial states behind it, are free.
        n_model: How many of the free ones are the model's.
    """

    H: np.ndarray
    g: np.ndarray
    free: np.ndarray
    n_model: int

    def solve(self) -> np.ndarray:
        """Return the full undamped step (size + 2 k R,)."""
        scale = np.sqrt(np.diag(self.H))
        scale[scale == 0] = 1.0
        inverse = np.linalg.pinv(self.H / np.outer(scale, scale), rcond=1e-13, hermitian=True)
        step = np.zeros(len(self.free))
        step[self.free] = inverse @ (self.g / scale) / scale
        return step


def assemble_normal_equations(point: FitPoint, free: np.ndarray, weight: np.ndarray | None = None) -> NormalEquations:
    """Assemble the normal equations.

    Args:
        point: The point.
        free: Which numbers of the model's full vector are free (size,).
        weight: Weight between outputs (p, p); None takes the inverse covariance of the errors.
    """
    layout = build_layout(point.form)
    weight = np.linalg.inv(point.covariance) if weight is None else weight
    weight = (weight + weight.T) / 2
    k, n_records = layout.n_modes, len(point.grams)
    total = layout.size + 2 * k * n_records
    H, g = np.zeros((total, total)), np.zeros(total)
    for r, (gram, cross) in enumerate(zip(point.grams, point.cross, strict=True)):
        matrix, right = _weigh_derivatives(compute_derivative_maps(point.form, point.x0[r]), gram, cross, weight)
        where = np.r_[np.arange(layout.size), layout.size + 2 * k * r + np.arange(2 * k)]
        H[np.ix_(where, where)] += matrix
        g[where] += right
    start = np.tile(np.column_stack([np.ones(k, bool), point.form.oscillates]).ravel(), n_records)
    everything = np.r_[free, start]
    return NormalEquations(H[np.ix_(everything, everything)], g[everything], everything, int(free.sum()))


def _weigh_derivatives(
    maps: DerivativeMaps, gram: np.ndarray, cross: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return sum_oo' W_oo' J_o' J_o' and sum_oo' W_oo' J_o' e_o' of one record from its columns' products."""
    H, g = np.zeros((maps.size, maps.size)), np.zeros(maps.size)
    own, (p, w) = maps.own.ravel(), maps.own.shape
    parts = ((maps.re, maps.real), (maps.im, maps.imaginary))
    own_gram, own_cross = gram @ maps.own_map, cross @ weight
    both = np.zeros((len(maps.shared), p * w))
    square = np.zeros((len(maps.shared), len(maps.shared)))
    for at, factor in parts:
        weighed = factor.T @ weight  # (s, p)
        both += (weighed[:, :, None] * own_gram[at][:, None, :]).reshape(len(at), -1)
        g[maps.shared] += np.einsum("so,so->s", weighed, cross[at])
        for other, factor_of_other in parts:
            square += (weighed @ factor_of_other) * gram[np.ix_(at, other)]
    H[np.ix_(maps.shared, maps.shared)] = square
    H[np.ix_(maps.shared, own)], H[np.ix_(own, maps.shared)] = both, both.T
    H[np.ix_(own, own)] = np.kron(weight, maps.own_map.T @ own_gram)
    g[own] = (own_cross.T @ maps.own_map).ravel()
    return H, g


def apply_step(point: FitPoint, step: np.ndarray) -> tuple[ModalForm, np.ndarray]:
    """Return the model and the initial states after a full step."""
    size = build_layout(point.form).size
    start = step[size:].reshape(len(point.grams), -1, 2)
    return step_form(point.form, step[:size]), point.x0 + start[..., 0] + 1j * start[..., 1]


OUTERMOST = 1 - 1e-7  # a pole estimated on or outside the unit circle is put here


def fit_input_matrices(A: np.ndarray, C: np.ndarray, records: Sequence[Record], direct: bool | None) -> FittedForm:
    """Return the modal form of A, C with the B, D and initial states that fit records (aligned and scaled) best.

    Args:
        A: (n, n); poles outside the unit circle are mirrored into it.
        C: (p, n).
        records: The records.
        direct: Whether D may differ from zero; None lets the data choose (Bayes' information criterion).
    """
    p, m = C.shape[0], records[0].u.shape[1]
    model = StateSpace(A, np.zeros((len(A), m)), C, np.zeros((p, m)), np.zeros((len(A), p)), records[0].dt)
    form = mirror_unstable_poles(build_modal_form(model))
    point = evaluate(form, np.zeros((len(records), len(form.poles)), dtype=complex), records)
    if direct is not None:
        return solve_input_matrices(point, records, direct)
    without, whole = solve_input_matrices(point, records, False), solve_input_matrices(point, records, True)
    gain = whole.n_samples * (without.loss - whole.loss)
    return whole if gain > p * m * np.log(whole.n_samples) else without


def solve_input_matrices(point: FitPoint, records: Sequence[Record], direct: np.ndarray | bool) -> FittedForm:
    """Return the form of a point with only its B, D and initial states fitted again.

    The problem is linear, so the point's products are used twice; the second solution weighs the outputs by their
    errors.
    """
    layout = build_layout(point.form)
    free = free_numbers(point.form, np.asarray(direct))
    free[layout.pole], free[layout.c] = False, False
    fitted = _step_to(point, records, free, np.diag(1 / np.maximum(point.power, 1e-300)))
    if len(fitted.power) == 1:  # a single output needs no weight
        return fitted
    return _step_to(point, records, free, np.linalg.inv(fitted.covariance))


def _step_to(point: FitPoint, records: Sequence[Record], free: np.ndarray, weight: np.ndarray) -> FittedForm:
    """Return the form after the full step in some numbers, and the covariance of its residuals on the records."""
    form, x0 = apply_step(point, assemble_normal_equations(point, free, weight).solve())
    errors = [record.y - simulate_form(form, x, record) for x, record in zip(x0, records, strict=True)]
    return FittedForm(form, x0, np.sum([e.T @ e for e in errors], axis=0), point.n_samples, point.power)


def simulate_form(form: ModalForm, x0: np.ndarray, record: Record) -> np.ndarray:
    """Return the outputs (N, p) of a modal form from its modal states at the first sample (k,) complex."""
    out = record.u @ form.D.T
    for pole, b, c, first in zip(form.poles, form.b, form.c.T, x0, strict=True):
        xi = _states(pole, (record.u @ b)[:, None], np.array([first]))[0]
        out += xi.real * c.real - xi.imag * c.imag
    return out


def mirror_unstable_poles(form: ModalForm) -> ModalForm:
    """Return a stable form: poles outside the unit circle mirrored, those on it moved just inside."""
    size = np.abs(form.poles)
    inside = np.where(size > 1, 1 / np.maximum(size, 1e-300), size)
    inside = np.minimum(inside, OUTERMOST)
    return replace(form, poles=form.poles * inside / np.where(size > 0, size, 1.0))
