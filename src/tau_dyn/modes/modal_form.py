"""A model as a sum of modes: the coordinates in which it is refined and its uncertainty stated.

    y_t = sum_i Re(c_i xi_i,t) + D u_t,   xi_i,t+1 = lambda_i xi_i,t + b_i u_t,

one complex state for each complex pair (a real 2x2 block), one real state for each real pole (1x1). In every mode the
largest entry of c_i is 1, which fixes the free factor between b_i and c_i. The free numbers are, in this order for mode
after mode, Re and Im of lambda, of c (without the fixed entry) and of b; then D row by row. Imaginary parts of real
modes are left out. Their covariance goes to the frequency response by first-order propagation. Reference: McKelvey & Helmersson
2004 on why any other freedom must be taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.modes.record import Scales
from tau_dyn.modes.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class ModalForm:
    """A model in modal coordinates.

    Attributes:
        poles: (k,) complex, one of each pair, with Im >= 0; real poles have Im = 0.
        c: Output shapes (p, k).
        b: Input shapes (k, m).
        D: (p, m).
        dt: Sampling step [s].
        delay: Whole samples of delay.
        oscillates: Which modes are complex pairs (k,).
    """

    poles: np.ndarray
    c: np.ndarray
    b: np.ndarray
    D: np.ndarray
    dt: float
    delay: int
    oscillates: np.ndarray

    @property
    def order(self) -> int:
        """Number of real states."""
        return int(len(self.poles) + self.oscillates.sum())

    @property
    def pivots(self) -> np.ndarray:
        """The output (k,) whose entry of c is kept at 1."""
        return np.argmax(np.abs(self.c), axis=0) if self.c.size else np.zeros(len(self.poles), dtype=int)

    def state_space(self) -> StateSpace:
        """Return the model with a real block-diagonal A."""
        n, (p, m) = self.order, self.D.shape
        A, B, C = np.zeros((n, n)), np.zeros((n, m)), np.zeros((p, n))
        i = 0
        for pole, b, c, pair in zip(self.poles, self.b, self.c.T, self.oscillates, strict=True):
            A[i, i], B[i], C[:, i] = pole.real, b.real, c.real
            if pair:
                A[i + 1, i + 1], A[i + 1, i], A[i, i + 1] = pole.real, pole.imag, -pole.imag
                B[i + 1], C[:, i + 1] = b.imag, -c.imag
            i += 2 if pair else 1
        return StateSpace(A, B, C, self.D, np.zeros((n, p)), self.dt, self.delay)

    def unscaled(self, scales: Scales) -> ModalForm:
        """Return it in the records' own units, given that of records divided by their scales."""
        return replace(self, c=scales.y[:, None] * self.c, b=self.b / scales.u, D=scales.y[:, None] * self.D / scales.u)

    def normalised(self) -> ModalForm:
        """Return it with the largest entry of every output shape equal to 1."""
        factor = self.c[self.pivots, np.arange(len(self.poles))]
        factor = np.where(factor == 0, 1.0, factor)
        return replace(self, c=self.c / factor, b=self.b * factor[:, None])


def build_modal_form(model: StateSpace) -> ModalForm:
    """Return a model's modes, slowest first; the innovations' gain is left behind."""
    return build_modal_form_with_coordinates(model)[0]


def build_modal_form_with_coordinates(model: StateSpace) -> tuple[ModalForm, np.ndarray]:
    """Return a model's modal form and W (n, n): the states of `form.state_space()` are W x."""
    values, vectors = (part.astype(complex) for part in np.linalg.eig(model.A))
    real = np.abs(values.imag) <= 1e-12 * np.abs(values).max(initial=1e-300)
    keep = np.flatnonzero(real | (values.imag > 0))
    keep = keep[np.argsort(np.abs(np.log(np.where(values[keep] == 0, 1e-300, values[keep]))), kind="stable")]
    pair = ~real[keep]
    rows = np.linalg.inv(vectors)[keep].astype(complex)
    c = (model.C @ vectors)[:, keep] * np.where(pair, 2.0, 1.0)  # the conjugate mode adds the same again
    pivot = np.argmax(np.abs(c), axis=0) if c.size else np.zeros(len(keep), dtype=int)
    factor = c[pivot, np.arange(len(keep))]
    factor = np.where(factor == 0, 1.0, factor)
    rows, c = rows * factor[:, None], c / factor
    rows[~pair], c[:, ~pair] = rows[~pair].real, c[:, ~pair].real
    poles = np.where(pair, values[keep], values[keep].real + 0j)
    W = np.array(
        [part for row, two in zip(rows, pair, strict=True) for part in ((row.real, row.imag) if two else (row.real,))]
    )
    return ModalForm(poles, c, rows @ model.B, model.D, model.dt, model.delay, pair), W.reshape(
        model.order, model.order
    )


@dataclass(frozen=True, eq=False)
class ModalLayout:
    """Positions of the numbers of a modal form in the full vector.

    The full vector holds for every mode Re, Im of lambda; Re (p), Im (p) of c; Re (m), Im (m) of b; then D row by row.

    Attributes:
        modes: All numbers of each mode (k, 2 + 2 p + 2 m).
        pole: Re, Im of lambda (k, 2).
        c: Re, Im of the output shapes (k, 2, p).
        b: Re, Im of the input shapes (k, 2, m).
        D: (p, m).
    """

    modes: np.ndarray
    pole: np.ndarray
    c: np.ndarray
    b: np.ndarray
    D: np.ndarray

    @property
    def size(self) -> int:
        """Numbers in all."""
        return self.modes.size + self.D.size

    @property
    def n_modes(self) -> int:
        """K."""
        return len(self.modes)


def build_layout(form: ModalForm) -> ModalLayout:
    """Return the layout of a modal form."""
    k, (p, m) = len(form.poles), form.D.shape
    modes = np.arange(k * (2 + 2 * p + 2 * m)).reshape(k, -1)
    c, b = modes[:, 2 : 2 + 2 * p].reshape(k, 2, p), modes[:, 2 + 2 * p :].reshape(k, 2, m)
    return ModalLayout(modes, modes[:, :2], c, b, modes.size + np.arange(p * m).reshape(p, m))


def free_numbers(form: ModalForm, direct: np.ndarray) -> np.ndarray:
    """Return which numbers of the full vector are free (size,), with the entries of D in `direct` (p, m)."""
    layout = build_layout(form)
    free = np.ones(layout.size, dtype=bool)
    for imaginary in (layout.pole[:, 1:], layout.c[:, 1], layout.b[:, 1]):
        free[imaginary] = form.oscillates[:, None]
    free[layout.c[np.arange(layout.n_modes), :, form.pivots]] = False
    free[layout.D] = direct
    return free


def step_form(form: ModalForm, step: np.ndarray) -> ModalForm:
    """Return the form moved by a full vector (size,)."""
    layout = build_layout(form)
    poles, c, b = (step[where[:, 0]] + 1j * step[where[:, 1]] for where in (layout.pole, layout.c, layout.b))
    return replace(form, poles=form.poles + poles, c=form.c + c.T, b=form.b + b, D=form.D + step[layout.D])


def flatten_form(form: ModalForm) -> np.ndarray:
    """Return all numbers of a form (size,)."""
    layout = build_layout(form)
    out = np.empty(layout.size)
    for where, value in ((layout.pole, form.poles), (layout.c, form.c.T), (layout.b, form.b)):
        out[where[:, 0]], out[where[:, 1]] = value.real, value.imag
    out[layout.D] = form.D
    return out


@dataclass(frozen=True, eq=False)
class ResponseEstimate:
    """An estimated modal form, for its frequency response.

    Attributes:
        form: The form, in scaled units, of the model or of its predictor with inputs (u, y). Its delay acts on u only.
        covariance: Covariance of its full vector (size, size).
        scales: The units.
        predictor: Whether the form is a predictor's; with its response [P_u, P_y] the model's is G = (I - P_y)^-1 P_u.
    """

    form: ModalForm
    covariance: np.ndarray
    scales: Scales
    predictor: bool

    def covariance_at(self, frequency: np.ndarray) -> np.ndarray:
        """Return the covariance (F, p, m, 2, 2) of Re and Im of the response in own units at frequencies (F,) [Hz]."""
        form, scale = replace(self.form, delay=0), self.scales.y[:, None] / self.scales.u
        z = np.exp(2j * np.pi * np.asarray(frequency, dtype=float) * self.form.dt)
        late = (z**-self.form.delay)[:, None, None, None]
        if self.predictor:
            slopes = self._through_feedback(compute_response_slopes(form, frequency), frequency)
            return _propagate(slopes * scale[None, :, :, None] * late, self.covariance)
        parts, layout = [], build_layout(form)
        for o in range(len(form.D)):  # an output's response depends on its own entries of c and D only
            alone = replace(form, c=form.c[[o]], D=form.D[[o]])
            own = np.hstack([layout.pole, layout.c[:, :, o], layout.b.reshape(layout.n_modes, -1)])
            at = np.concatenate([own.ravel(), layout.D[o]])
            slopes = compute_response_slopes(alone, frequency) * scale[None, [o], :, None] * late
            parts.append(_propagate(slopes, self.covariance[np.ix_(at, at)]))
        return np.concatenate(parts, axis=1)

    def _through_feedback(self, slopes: np.ndarray, frequency: np.ndarray) -> np.ndarray:
        """DG = (I - P_y)^-1 (dP_u + dP_y G)."""
        p = self.form.D.shape[0]
        m = self.form.D.shape[1] - p
        P = replace(self.form, delay=0).state_space().frequency_response(frequency)
        inverse = np.linalg.inv(np.eye(p) - P[:, :, m:])
        G = inverse @ P[:, :, :m]
        through = slopes[:, :, :m] + np.einsum("foqs,fqm->foms", slopes[:, :, m:], G)
        return np.einsum("fop,fpms->foms", inverse, through)


def _propagate(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance (F, p, m, 2, 2) of Re and Im from slopes (F, p, m, size)."""
    both = np.stack([slopes.real, slopes.imag], axis=3)
    return both @ covariance @ both.swapaxes(-1, -2)


def compute_response_slopes(form: ModalForm, frequency: np.ndarray) -> np.ndarray:
    """Return the derivatives (F, p, m, size) of the response with respect to the full vector."""
    z = np.exp(2j * np.pi * np.asarray(frequency, dtype=float) * form.dt)
    layout, (p, m) = build_layout(form), form.D.shape
    out = np.zeros((len(z), p, m, layout.size), dtype=complex)
    for k, (pole, pair) in enumerate(zip(form.poles, form.oscillates, strict=True)):
        ones = _mode_slopes(z, pole, form.c[:, k], form.b[k])
        # Re and Im of a number x act through x and its conjugate: G = (g(x) + g*(x*)) / 2 for a pair
        others = _mode_slopes(z, np.conj(pole), form.c[:, k].conj(), form.b[k].conj()) if pair else ones
        for where, one, other in zip((layout.pole[k, :, None], layout.c[k], layout.b[k]), ones, others, strict=True):
            out[..., where[0]], out[..., where[1]] = (one + other) / 2, 1j * (one - other) / 2
    out[:, np.arange(p)[:, None], np.arange(m), layout.D] = 1.0
    return out * (z**-form.delay)[:, None, None, None]


def _mode_slopes(
    z: np.ndarray, pole: complex, c: np.ndarray, b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of c b / (z - pole) with respect to pole (F, p, m, 1), c (F, p, m, p), b (F, p, m, m)."""
    gain = (1 / (z - pole))[:, None, None, None]
    by_c, by_b = np.eye(len(c))[:, None] * b[:, None], c[:, None, None] * np.eye(len(b))
    return gain**2 * np.outer(c, b)[:, :, None], gain * by_c, gain * by_b
