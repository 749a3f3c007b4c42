"""Levenberg-Marquardt steps downhill, in coordinates that stay well-conditioned wherever poles go.

Modal coordinates give the exact derivative cheaply, but degenerate where two poles meet, as real ones do on their way to
becoming a pair. The same tangent vector, written as a change (dA, dB, dC) of a balanced realisation and freed of what only
changes the states' coordinates, does not: steps are measured and made there, until they are small against the standard errors.
Initial states count as further columns of B. References: McKelvey, Helmersson, Ribarits 2004 (data driven local coordinates);
Ljung 1999, 10.2; Nocedal & Wright 2006, 10.3.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgWarning, qr

from tau_dyn.estimate import Descent, DescentRules, descend
from tau_dyn.modes.fit_point import FitPoint, FittedForm, NormalEquations, assemble_normal_equations, evaluate
from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form_with_coordinates, free_numbers
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace, compute_gramians, compute_root

RULES = DescentRules(
    small_step=0.02,  # mean step of a parameter over its standard error
    small_gain=0.05,  # of log-likelihood
    patience=2,
    damping=1e-12,  # of the largest curvature
    first_damping=1e-300,  # it may shrink as long as steps succeed
    growth=20.0,
    max_trials=12,
)
MIN_UNIT_CIRCLE_DISTANCE = 1e-8  # of a pole to the unit circle
MIN_RELATIVE_CURVATURE = 1e-15  # of the largest curvature: directions below it are not moved along
_ROUNDING = 1e-14  # of a Gramian's largest eigenvalue


def minimise(
    point: FittedForm,
    records: Sequence[Record],
    direct: np.ndarray,
    maximum_rounds: int,
    allowed: Callable[[ModalForm], bool] = lambda form: True,
    stop: Callable[[], bool] = lambda: False,
) -> Descent[FitPoint]:
    """Descend from a point; steps are counted without a last small one.

    Args:
        point: Where to start.
        records: Aligned and scaled.
        direct: Which entries of D are free (p, m).
        maximum_rounds: Most accepted steps.
        allowed: Function that returns whether a model may be visited.
        stop: Called before every step; returns whether to end there.
    """
    model = balance_model(append_initial_states(point))
    start = _Visit(model, evaluate(*split_initial_states(model, direct.shape[1]), records))
    end = descend(_Descending(records, direct, allowed), start, replace(RULES, max_steps=maximum_rounds), stop=stop)
    assert end.state.point is not None
    return Descent(end.state.point, end.steps - (end.reason == "small_step"), end.trials, end.reason)


@dataclass(frozen=True, eq=False)
class _Visit:
    """A balanced realisation whose further inputs are initial states, and its point; None if it may not be visited."""

    model: StateSpace
    point: FitPoint | None


@dataclass(frozen=True, eq=False)
class _Descending:
    """The descent as a `LeastSquaresProblem`: its states are models, its steps are changes of their matrices."""

    records: Sequence[Record]
    direct: np.ndarray
    allowed: Callable[[ModalForm], bool]

    def linearise(self, state: _Visit) -> Tangent:
        assert state.point is not None
        normal = assemble_normal_equations(state.point, free_numbers(state.point.form, self.direct))
        return compute_tangent(state.model, state.point, normal)

    def move(self, state: _Visit, step: np.ndarray) -> _Visit:
        assert state.point is not None
        model = state.model
        dA, dB, dC, dD = _unstacked(step, model)
        model = replace(model, A=model.A + dA, B=model.B + dB, C=model.C + dC, D=model.D + dD)
        model = balance_model(_kept_inside(model, state.point.form))
        if not np.isfinite(model.A).all() or model.spectral_radius() >= 1:
            return _Visit(model, None)
        form, x0 = split_initial_states(model, self.direct.shape[1])
        return _Visit(model, evaluate(form, x0, self.records) if self.allowed(form) else None)

    def gain(self, state: _Visit, trial: _Visit) -> float:
        """Return by how much the log-likelihood rises."""
        if state.point is None or trial.point is None or not trial.point.loss < state.point.loss:
            return -np.inf
        return state.point.n_samples * (state.point.loss - trial.point.loss) / 2


@dataclass(frozen=True, eq=False)
class Tangent:
    """Normal equations at a point, in an orthonormal basis of the tangent space.

    Attributes:
        values: Curvatures (d,), ascending.
        slopes: Descent in each of their directions (d,).
        directions: Each as a change of A, B, C, D, stacked row by row (n n + n m + p n + p m, d).
    """

    values: np.ndarray
    slopes: np.ndarray
    directions: np.ndarray

    def step(self, damping: float) -> tuple[np.ndarray, float]:
        """Return a step, and the undamped one's size in standard errors, averaged over the free numbers; a last one is undamped.

        Args:
            damping: A part of the largest curvature.
        """
        top, values = self.values[-1], self.values
        counts = values > 1e-14 * top
        size = float(np.sqrt(np.mean(self.slopes[counts] ** 2 / values[counts])))
        damping = damping if size >= RULES.small_step else 0.0
        along = np.where(values > MIN_RELATIVE_CURVATURE * top, self.slopes / (values + damping * top), 0.0)
        return self.directions @ along, size


def compute_tangent(model: StateSpace, point: FitPoint, normal: NormalEquations) -> Tangent:
    """Return the tangent space at a point.

    Args:
        model: Balanced realisation of the point, initial states as further inputs (`append_initial_states`).
        point: The point; its form is the modal form of `model`.
        normal: Its normal equations.
    """
    _, W = build_modal_form_with_coordinates(model)
    changes = _realised(point, normal, W, model)
    orbit = qr(_orbit(model), mode="economic")[0]
    changes = changes - orbit @ (orbit.T @ changes)
    length = np.linalg.norm(changes, axis=0)
    length[length == 0] = 1.0
    # with changes / length = U S V', a unit step along U is V S^-1 in modal numbers
    U, S, Vt = np.linalg.svd(changes / length, full_matrices=False)
    keep = S > 1e-11 * S[0]
    back = (Vt[keep].T / S[keep]) / length[:, None]
    values, vectors = np.linalg.eigh(back.T @ normal.H @ back)
    return Tangent(values, vectors.T @ (back.T @ normal.g), U[:, keep] @ vectors)


def append_initial_states(point: FittedForm) -> StateSpace:
    """Return a point's model with one more input for each record: its initial state as a column of B."""
    form, no_direct = point.form, np.zeros((len(point.form.D), len(point.x0)))
    wide = replace(form, b=np.hstack([form.b, point.x0.T]), D=np.hstack([form.D, no_direct]))
    return wide.state_space()


def split_initial_states(model: StateSpace, n_inputs: int) -> tuple[ModalForm, np.ndarray]:
    """Return the modal form and the initial states (R, k) of such a model."""
    form, _ = build_modal_form_with_coordinates(model)
    return replace(form, b=form.b[:, :n_inputs], D=form.D[:, :n_inputs]), form.b[:, n_inputs:].T


def balance_model(model: StateSpace) -> StateSpace:
    """Return a stable model with equal, diagonal Gramians, as far as rounding lets it be (weak states are left as they are)."""
    n = model.order
    if not np.isfinite(model.A).all() or model.spectral_radius() >= 1:
        return model
    with warnings.catch_warnings():  # a pole close to the unit circle; the check below detects failures
        warnings.simplefilter("ignore", LinAlgWarning)
        controllable, observable = compute_gramians(model)
    if not (np.isfinite(controllable).all() and np.isfinite(observable).all()):
        return model
    R, Q = compute_root(controllable, _ROUNDING), compute_root(observable, _ROUNDING)
    U, values, Vt = np.linalg.svd(Q.T @ R)
    size = np.sqrt(np.maximum(values, 1e-10 * values[0]))
    T, inverse = (R @ Vt.T) / size, (U / size).T @ Q.T
    if np.abs(inverse @ T - np.eye(n)).max() > 1e-6:
        return model
    return replace(model.in_coordinates(T), B=np.linalg.solve(T, model.B))


def _realised(point: FitPoint, normal: NormalEquations, W: np.ndarray, model: StateSpace) -> np.ndarray:
    """The changes of A, B, C, D (rows) that a unit of every free number makes (columns)."""
    form, layout = point.form, build_layout(point.form)
    (p, m), n_records, n = form.D.shape, len(point.x0), model.order
    count = int(normal.free.sum())
    place = np.where(
        normal.free, np.cumsum(normal.free) - 1, count
    )  # fixed numbers fall into a last row, left out in the end
    dA, dB = np.zeros((count + 1, n, n)), np.zeros((count + 1, n, m + n_records))
    dC, dD = np.zeros((count + 1, p, n)), np.zeros((count + 1, p, m + n_records))
    outputs, inputs, records = np.arange(p), np.arange(m), np.arange(n_records)
    first = np.cumsum(np.r_[0, np.where(form.oscillates, 2, 1)])
    for k, pair in enumerate(form.oscillates):
        i, pole = first[k], place[layout.pole[k]]
        dA[pole[0], i, i] = 1
        if pair:
            dA[pole[0], i + 1, i + 1], dA[pole[1], i + 1, i], dA[pole[1], i, i + 1] = 1, 1, -1
        for shift in range(1 + pair):
            dC[place[layout.c[k, shift]], outputs, i + shift] = -1 if shift else 1
            dB[place[layout.b[k, shift]], i + shift, inputs] = 1
            dB[place[layout.size + 2 * (records * layout.n_modes + k) + shift], i + shift, m + records] = 1
    dD[place[layout.D], outputs[:, None], inputs] = 1
    inverse = np.linalg.inv(W)
    parts = (inverse @ dA[:count] @ W, inverse @ dB[:count], dC[:count] @ W, dD[:count])
    return np.concatenate([part.reshape(count, -1) for part in parts], axis=1).T


def _orbit(model: StateSpace) -> np.ndarray:
    """The changes that only turn the states' coordinates: (X A - A X, X B, -C X, 0) for every unit X."""
    n, (p, m) = model.order, model.D.shape
    eye = np.eye(n)
    dA = np.kron(eye, model.A.T) - np.kron(model.A, eye)
    dB, dC = np.kron(eye, model.B.T), -np.kron(model.C, eye)
    return np.vstack([dA, dB, dC, np.zeros((p * m, n * n))])


def _unstacked(change: np.ndarray, model: StateSpace) -> list[np.ndarray]:
    shapes = [model.A.shape, model.B.shape, model.C.shape, model.D.shape]
    ends = np.cumsum([a * b for a, b in shapes])[:-1]
    return [part.reshape(shape) for part, shape in zip(np.split(change, ends), shapes, strict=True)]


def _kept_inside(model: StateSpace, old: ModalForm) -> StateSpace:
    """The model with poles beyond the unit circle drawn back to a tenth of the old model's distance from it."""
    limit = 1 - max(0.1 * (1 - np.abs(old.poles).max(initial=0.0)), MIN_UNIT_CIRCLE_DISTANCE)
    if not np.isfinite(model.A).all():
        return model
    values, vectors = np.linalg.eig(model.A)
    size = np.abs(values)
    if (size <= limit).all():
        return model
    A = (vectors * (values * np.minimum(1, limit / np.maximum(size, 1e-300)))) @ np.linalg.inv(vectors)
    return replace(model, A=A.real)


def normalise_shapes(point: FitPoint) -> FitPoint:
    """Return the point with the largest entry of every output shape equal to 1."""
    form = point.form.normalised()
    index = np.arange(len(form.poles))
    factor = point.form.c[point.form.pivots, index]
    return replace(point, form=form, x0=point.x0 * np.where(factor == 0, 1.0, factor))
