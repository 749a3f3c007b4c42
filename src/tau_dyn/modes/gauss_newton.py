r"""One pass over records: loss, gradient and Gauss-Newton matrix of a modal form; and the step they give.

The loss is the concentrated likelihood of output errors that are white in time, log det S with S their covariance
between outputs; its Gauss-Newton matrix is sum_t J_t' S^-1 J_t. Reference: Ljung 1999, 7.4, 10.2; McKelvey, Helmersson,
Ribarits 2004.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.modes.basis import DerivativeMaps, build_columns, compute_derivative_maps
from tau_dyn.modes.modal_form import ModalForm, build_layout, step_form
from tau_dyn.modes.record import Record

FLOOR = 1e-13  # errors below this part of the outputs' power are rounding


@dataclass(frozen=True, eq=False)
class FitPoint:
    """A model with the initial states of all records, and how it fits.

    Attributes:
        form: The model.
        x0: Modal states at each record's first sample (R, k) complex.
        squares: sum_t e e' (p, p).
        n_samples: Samples in all.
        grams: For every record columns' columns (q, q).
        cross: For every record columns' e (q, p).
        power: Mean square of each output (p,).
    """

    form: ModalForm
    x0: np.ndarray
    squares: np.ndarray
    n_samples: int
    grams: tuple[np.ndarray, ...]
    cross: tuple[np.ndarray, ...]
    power: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the output errors between outputs (p, p)."""
        return self.squares / self.n_samples + FLOOR * np.diag(self.power)

    @property
    def loss(self) -> float:
        """Log det of that covariance; infinite where the model runs away."""
        if not np.isfinite(self.squares).all():
            return np.inf
        sign, value = np.linalg.slogdet(self.covariance)
        return float(value) if sign > 0 else np.inf


def evaluate(form: ModalForm, x0: np.ndarray, records: Sequence[Record]) -> FitPoint:
    """Return the point of a model over records that are aligned and scaled."""
    p = form.D.shape[0]
    squares, power, grams, cross = np.zeros((p, p)), np.zeros(p), [], []
    for record, start in zip(records, x0, strict=True):
        gram, gradient = 0.0, 0.0
        for columns in build_columns(form, start, record):
            y = record.y[columns.part]
            error = y - columns.predicted
            squares += error.T @ error
            power += (y**2).sum(axis=0)
            gram = gram + columns.real.T @ columns.real
            gradient = gradient + columns.real.T @ error
        grams.append(np.asarray(gram))
        cross.append(np.asarray(gradient))
    n = sum(record.n_samples for record in records)
    return FitPoint(form, x0, squares, n, tuple(grams), tuple(cross), power / n)


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
        point: Where.
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
