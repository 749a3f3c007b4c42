"""How sure a model's frequency response is: first-order propagation from the covariance of its modal form."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.modes.modal_form import ModalForm, build_layout
from tau_dyn.modes.record import Scales


@dataclass(frozen=True, eq=False)
class ResponseEstimate:
    """An estimated modal form, seen as a frequency response.

    Attributes:
        form: The form, in scaled units: of the model, or of its predictor with inputs (u, y). Its delay acts on u only.
        covariance: Of its full vector (size, size).
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
        parts = []
        for o in range(len(form.D)):  # an output's response depends on its own entries of c and D only
            alone = replace(form, c=form.c[[o]], D=form.D[[o]])
            at = _positions(form, o)
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


def _positions(form: ModalForm, output: int) -> np.ndarray:
    """Return where the full vector of a form with one output alone stands in that of all."""
    layout = build_layout(form)
    p, m = form.D.shape
    found = []
    for k in range(len(form.poles)):
        pole, c, b = layout.pole(k), layout.c(k), layout.b(k)
        found += [*range(pole.start, pole.stop), c.start + output, c.start + p + output, *range(b.start, b.stop)]
    return np.array([*found, *(layout.D.start + output * m + np.arange(m))], dtype=int)


def compute_response_slopes(form: ModalForm, frequency: np.ndarray) -> np.ndarray:
    """Return the derivatives (F, p, m, size) of the response with respect to the full vector."""
    z = np.exp(2j * np.pi * np.asarray(frequency, dtype=float) * form.dt)
    layout = build_layout(form)
    p, m = form.D.shape
    out = np.zeros((len(z), p, m, layout.size), dtype=complex)
    for k, (pole, pair) in enumerate(zip(form.poles, form.oscillates, strict=True)):
        one = _mode_slopes(z, pole, form.c[:, k], form.b[k])
        # Re and Im of a number x act through x and its conjugate: G = (g(x) + g*(x*)) / 2 for a pair
        other = _mode_slopes(z, np.conj(pole), form.c[:, k].conj(), form.b[k].conj()) if pair else one
        half = 2 + 2 * p + 2 * m
        first = layout.pole(k).start
        real, imaginary = (one + other) / 2, 1j * (one - other) / 2
        out[..., first : first + half] = _interleaved(real, imaginary, p, m)
    for o in range(p):
        for j in range(m):
            out[:, o, j, layout.D.start + o * m + j] = 1.0
    return out * (z**-form.delay)[:, None, None, None]


def _mode_slopes(z: np.ndarray, pole: complex, c: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Derivatives of c b / (z - pole) with respect to pole, c (p), b (m): (F, p, m, 1 + p + m)."""
    p, m = len(c), len(b)
    out = np.zeros((len(z), p, m, 1 + p + m), dtype=complex)
    gain = 1 / (z - pole)
    out[..., 0] = (gain**2)[:, None, None] * np.outer(c, b)
    for o in range(p):
        out[:, o, :, 1 + o] = gain[:, None] * b
    for j in range(m):
        out[:, :, j, 1 + p + j] = gain[:, None] * c
    return out


def _interleaved(real: np.ndarray, imaginary: np.ndarray, p: int, m: int) -> np.ndarray:
    """Order the derivatives as the layout does: Re, Im of the pole; Re, Im of c; Re, Im of b."""
    parts = (slice(0, 1), slice(1, 1 + p), slice(1 + p, 1 + p + m))
    return np.concatenate([block[..., part] for part in parts for block in (real, imaginary)], axis=-1)
