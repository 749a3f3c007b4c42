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

from tau_dyn.modes.fit_point import FitPoint, NormalEquations, assemble_normal_equations, evaluate
from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form_with_coordinates, free_numbers
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace, compute_gramians, compute_root

MIN_RELATIVE_CURVATURE = 1e-15  # of the largest curvature: directions below it are not moved along
_ROUNDING = 1e-14  # of a Gramian's largest eigenvalue


@dataclass(frozen=True, eq=False)
class Tangent:
    """Normal equations at a point, in an orthonormal basis of the tangent space.

    Attributes:
        model: The balanced realisation; its inputs are the model's, then one for each record's initial state.
        n_inputs: Inputs of the model proper.
        values: Curvatures (d,), ascending.
        slopes: Descent in each of their directions (d,).
        directions: Each as a change of A, B, C, D, stacked row by row (n n + n m + p n + p m, d).
    """

    model: StateSpace
    n_inputs: int
    values: np.ndarray
    slopes: np.ndarray
    directions: np.ndarray

    def step(self, damping: float) -> StateSpace:
        """Return the model after a step; damping is a part of the largest curvature."""
        top = self.values[-1]
        size = np.where(self.values > MIN_RELATIVE_CURVATURE * top, self.slopes / (self.values + damping * top), 0.0)
        dA, dB, dC, dD = _unstacked(self.directions @ size, self.model)
        return replace(self.model, A=self.model.A + dA, B=self.model.B + dB, C=self.model.C + dC, D=self.model.D + dD)


def compute_tangent(model: StateSpace, point: FitPoint, normal: NormalEquations) -> Tangent:
    """Return the tangent space at a point.

    Args:
        model: Balanced realisation of the point, initial states as further inputs (`append_initial_states`).
        point: The point; its form is the modal form of `model`.
        normal: Its normal equations.
    """
    m = point.form.D.shape[1]
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
    return Tangent(model, m, values, vectors.T @ (back.T @ normal.g), U[:, keep] @ vectors)


def append_initial_states(point: FitPoint) -> StateSpace:
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
    with warnings.catch_warnings():  # a pole close to the unit circle; the check below sees what matters
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
    (p, m), n_records = form.D.shape, len(point.x0)
    first = np.cumsum(np.r_[0, np.where(form.oscillates, 2, 1)])
    n, wide = model.order, m + n_records
    inverse, free = np.linalg.inv(W), np.flatnonzero(normal.free)
    out = np.zeros((n * n + n * wide + p * n + p * wide, len(free)))
    place = {int(index): column for column, index in enumerate(free)}

    def put(
        index: int, dA: np.ndarray | None = None, dB: np.ndarray | None = None, dC: np.ndarray | None = None
    ) -> None:
        if index in place:
            parts = (
                np.zeros((n, n)) if dA is None else inverse @ dA @ W,
                np.zeros((n, wide)) if dB is None else inverse @ dB,
                np.zeros((p, n)) if dC is None else dC @ W,
            )
            out[: n * n + n * wide + p * n, place[index]] = np.concatenate([part.ravel() for part in parts])

    for k, pair in enumerate(form.oscillates):
        i = first[k]
        for shift in (0, 1) if pair else (0,):
            dA = np.zeros((n, n))
            if not pair:
                dA[i, i] = 1
            elif shift == 0:
                dA[i, i] = dA[i + 1, i + 1] = 1
            else:
                dA[i + 1, i], dA[i, i + 1] = 1, -1
            put(layout.pole(k).start + shift, dA=dA)
            for o in range(p):
                put(layout.c(k).start + o + shift * p, dC=_unit((p, n), o, i + shift) * (-1 if shift else 1))
            for j in range(m):
                put(layout.b(k).start + j + shift * m, dB=_unit((n, wide), i + shift, j))
            for r in range(n_records):
                put(layout.size + 2 * (r * layout.n_modes + k) + shift, dB=_unit((n, wide), i + shift, m + r))
    tail = n * n + n * wide + p * n
    for o in range(p):
        for j in range(m):
            index = layout.D.start + o * m + j
            if index in place:
                out[tail + o * wide + j, place[index]] = 1
    return out


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


def _unit(shape: tuple[int, int], row: int, column: int) -> np.ndarray:
    out = np.zeros(shape)
    out[row, column] = 1.0
    return out


SMALL_STEP = 0.02  # mean step of a parameter over its standard error at which we stop
SMALL_GAIN = 0.05  # log-likelihood gained by a round; two such in a row end the descent
MIN_UNIT_CIRCLE_DISTANCE = 1e-8  # of a pole to the unit circle
MAX_DAMPING_TRIALS = 12  # dampings tried before the point counts as a minimum


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Where the descent ended.

    Attributes:
        point: The best point.
        rounds: Accepted steps.
        converged: Whether the steps had become small, or no step led further down.
    """

    point: FitPoint
    rounds: int
    converged: bool


def minimise(
    point: FitPoint,
    records: Sequence[Record],
    direct: np.ndarray,
    maximum_rounds: int,
    allowed: Callable[[ModalForm], bool] = lambda form: True,
) -> DescentResult:
    """Walk down from a point.

    Args:
        point: Where to start.
        records: Aligned and scaled.
        direct: Which entries of D are free (p, m).
        maximum_rounds: Most accepted steps.
        allowed: Says whether a model may be visited at all.
    """
    damping, slow, easy = 1e-12, 0, False
    model = balance_model(append_initial_states(point))
    point = evaluate(*split_initial_states(model, direct.shape[1]), records)
    for rounds in range(maximum_rounds):
        normal = assemble_normal_equations(point, free_numbers(point.form, direct))
        tangent = compute_tangent(model, point, normal)
        if _mean_step(tangent) < SMALL_STEP:
            return DescentResult(_tried(tangent.step(0.0), point, records, allowed) or point, rounds, True)
        for attempt in range(MAX_DAMPING_TRIALS):
            model = balance_model(_kept_inside(tangent.step(damping), point.form))
            trial = _tried(model, point, records, allowed)
            if trial is not None:
                easy = attempt == 0
                break
            damping *= 20
        else:
            return DescentResult(point, rounds, True)
        gain = point.n_samples * (point.loss - trial.loss) / 2
        point, damping = trial, damping / 20 if easy else damping
        slow = slow + 1 if gain < SMALL_GAIN else 0
        if slow == 2:
            return DescentResult(point, rounds + 1, True)
    return DescentResult(point, maximum_rounds, False)


def _tried(
    model: StateSpace, point: FitPoint, records: Sequence[Record], allowed: Callable[[ModalForm], bool]
) -> FitPoint | None:
    """The point of a model, where it may be visited and is better than the last point."""
    if not np.isfinite(model.A).all() or model.spectral_radius() >= 1:
        return None
    form, x0 = split_initial_states(model, point.form.D.shape[1])
    if not allowed(form):
        return None
    trial = evaluate(form, x0, records)
    return trial if trial.loss < point.loss else None


def _mean_step(tangent: Tangent) -> float:
    """Size of an undamped step in standard errors, averaged over the free numbers."""
    counts = tangent.values > 1e-14 * tangent.values[-1]
    return float(np.sqrt(np.mean(tangent.slopes[counts] ** 2 / tangent.values[counts])))


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
