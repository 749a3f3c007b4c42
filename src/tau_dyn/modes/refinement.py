"""Refinement of a model to the most likely one, in modal coordinates, with the covariance of the outcome.

Output errors: y = G u + v; v may be coloured, the estimate stays consistent and its covariance accounts for it,

    cov = H^-1 (sum_{t,s} J_t' W R_{t-s} W J_s) H^-1,    H = sum_t J_t' W J_t,

with R the autocovariance of the errors, from a vector autoregression fitted to the residuals; with white residuals it is H^-1.
The double sum is taken in the frequency domain, chunk by chunk. Noise of a hammer's force adds `J' W G s^2 G' W J` to it
(`contact.py`). Prediction errors: the innovation form, whose one-step
predictor is an output-error model with inputs (u, y),

    x+ = (A - K C) x + [B - K D, K] (u, y),    yhat = C x + [D, 0] (u, y),

refined in its own modal coordinates. Every record has its own initial state, estimated along. Another modal form of the same
model (other units; the model of a predictor) gets its covariance by central differences. References: Ljung 1999, (4.91)-(4.95),
7.2-7.5, 9.4, 10.2; Söderström & Stoica 1989, (7.59).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from tau_dyn.estimate import Descent
from tau_dyn.exceptions import InputError
from tau_dyn.modes.contact import compute_noise_responses
from tau_dyn.modes.fit_point import (
    DerivativeMaps,
    FitPoint,
    FittedForm,
    assemble_normal_equations,
    build_columns,
    compute_derivative_maps,
    evaluate,
    mirror_unstable_poles,
    simulate_form,
    solve_input_matrices,
)
from tau_dyn.modes.hankel import compute_spectrum, fit_autoregression
from tau_dyn.modes.modal import Mode, find_resonances
from tau_dyn.modes.modal_descent import minimise, normalise_shapes
from tau_dyn.modes.modal_form import (
    ModalForm,
    ResponseEstimate,
    build_layout,
    build_modal_form,
    flatten_form,
    free_numbers,
    step_form,
)
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.residuals import PREDICTED, SIMULATED
from tau_dyn.modes.state_space import StateSpace
from tau_dyn.results import Brief


def build_predictor(model: StateSpace) -> StateSpace:
    """Return the one-step predictor as a model from (u, y) to the predicted y."""
    B = np.hstack([model.B - model.K @ model.D, model.K])
    D = np.hstack([model.D, np.zeros((len(model.C), len(model.C)))])
    return replace(model, A=model.A - model.K @ model.C, B=B, D=D, K=np.zeros_like(model.K))


def build_innovation_model(form: ModalForm) -> StateSpace:
    """Return the innovation form whose predictor has this modal form."""
    predictor = form.state_space()
    m = form.D.shape[1] - form.D.shape[0]
    K, D = predictor.B[:, m:], predictor.D[:, :m]
    return replace(predictor, A=predictor.A + K @ predictor.C, B=predictor.B[:, :m] + K @ D, D=D, K=K)


def build_predictor_record(record: Record) -> Record:
    """Return a record whose inputs are (u, y)."""
    return replace(record, u=np.hstack([record.u, record.y]), inputs=record.inputs + record.outputs)


OF_STDERR = 1e-3  # step of the derivative, as a part of the standard error ...
OF_VALUE = 1e-6  # ... and at least this part of the number, where rounding would drown it


def propagate_covariance(
    form: ModalForm,
    covariance: np.ndarray,
    direct: np.ndarray,
    change: Callable[[ModalForm], ModalForm],
    reference: ModalForm,
) -> np.ndarray:
    """Return the covariance (size, size) of the full vector of another form of the same model.

    Rows of a mode that cannot be followed (two poles about to meet on the real axis) are nan.

    Args:
        form: The form that was estimated.
        covariance: Covariance of its free numbers (f, f).
        direct: Which entries of its D are free.
        change: Makes the other form, its modes in any order and scale.
        reference: The other form at the estimate.
    """
    free = np.flatnonzero(free_numbers(form, direct))
    values = flatten_form(form)[free]
    steps = np.maximum(
        OF_STDERR * np.sqrt(np.maximum(np.diag(covariance), 0)), OF_VALUE * np.maximum(abs(values), 1e-3)
    )
    jacobian = np.zeros((build_layout(reference).size, len(free)))
    for column, (index, h) in enumerate(zip(free, steps, strict=True)):
        step = np.zeros(build_layout(form).size)
        step[index] = h
        with np.errstate(all="ignore"):  # a mode that is lost on the way may divide by zero; it is nan in the end
            ahead, behind = (_followed(change(step_form(form, s)), reference) for s in (step, -step))
        jacobian[:, column] = (ahead - behind) / (2 * h)
    lost = ~np.isfinite(jacobian).all(axis=1)
    jacobian[lost] = 0.0
    out = jacobian @ covariance @ jacobian.T
    out[lost], out[:, lost] = np.nan, np.nan
    return out


def _followed(form: ModalForm, reference: ModalForm) -> np.ndarray:
    """The full vector of a form with its modes ordered and normalised like those of a neighbour; nan for lost modes."""
    order = [int(np.argmin(np.abs(form.poles - pole))) for pole in reference.poles]
    lost = [
        order.count(k) > 1 or form.oscillates[k] != pair for k, pair in zip(order, reference.oscillates, strict=True)
    ]
    c, b = form.c[:, order], form.b[order]
    factor = c[reference.pivots, np.arange(len(order))]
    factor = np.where((factor == 0) | np.array(lost, bool), 1.0, factor)
    alike = replace(form, poles=form.poles[order], c=c / factor, b=b * factor[:, None], oscillates=reference.oscillates)
    out = flatten_form(alike)
    out[build_layout(alike).modes[np.array(lost, bool)]] = np.nan
    return out


FREQUENCIES = 512  # treated at once; bounds the memory
CHUNK = 16384  # errors further apart than a chunk count as independent


def estimate_error_covariance(
    point: FitPoint, records: Sequence[Record], free: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return the covariance of the model's free numbers (f, f) and the residuals record by record.

    Args:
        point: The minimum.
        records: Aligned and scaled.
        free: Which numbers of the model's full vector are free (size,).
    """
    weight = np.linalg.inv(point.covariance)
    root = np.linalg.cholesky((weight + weight.T) / 2).T
    normal = assemble_normal_equations(point, free, weight)
    inverse = _inverse(normal.H)
    errors = compute_errors(point, records)
    coefficients, noise = fit_autoregression([e @ root.T for e in errors])
    n, own = normal.n_model, np.ix_(normal.free, normal.free)
    white = len(coefficients) == 0
    covariance = inverse if white else inverse @ _middle(point, records, root, coefficients, noise)[own] @ inverse
    if any(r.input_noise is not None for r in records):
        covariance = covariance + inverse @ _add_input_noise(point, records, weight)[own] @ inverse
    return covariance[:n, :n], errors


def _add_input_noise(point: FitPoint, records: Sequence[Record], weight: np.ndarray) -> np.ndarray:
    """The part of the double sum that the noise of the inputs has, over the full vector and all records' initial states."""
    size, k = build_layout(point.form).size, len(point.form.poles)
    middle = np.zeros((size + 2 * k * len(records),) * 2)
    markov = point.form.state_space().markov(max(r.n_samples for r in records))
    for r, (record, x0) in enumerate(zip(records, point.x0, strict=True)):
        noise = np.einsum("op,npk->nok", weight, compute_noise_responses(record, markov))
        maps = compute_derivative_maps(point.form, x0)
        total = np.zeros((maps.size, noise.shape[2]))
        for columns in build_columns(point.form, x0, record):
            x, part = columns.real, noise[columns.part]
            moved = x[:, None, maps.re] * maps.real + x[:, None, maps.im] * maps.imaginary  # (n, p, s)
            total[maps.shared] += np.einsum("nos,nok->sk", moved, part, optimize=True)
            own = np.einsum("nw,nok->owk", x @ maps.own_map, part, optimize=True)
            total[maps.own.ravel()] += own.reshape(-1, noise.shape[2])
        where = np.r_[np.arange(size), size + 2 * k * r + np.arange(2 * k)]
        middle[np.ix_(where, where)] += total @ total.T
    return middle


def compute_errors(point: FitPoint, records: Sequence[Record]) -> tuple[np.ndarray, ...]:
    """Return measured minus modelled outputs, record by record."""
    return tuple(r.y - simulate_form(point.form, x0, r) for r, x0 in zip(records, point.x0, strict=True))


def _middle(
    point: FitPoint, records: Sequence[Record], root: np.ndarray, coefficients: np.ndarray, noise: np.ndarray
) -> np.ndarray:
    """The double sum over the full vector and all records' initial states."""
    size, k = build_layout(point.form).size, len(point.form.poles)
    total = size + 2 * k * len(records)
    middle = np.zeros((total, total))
    for r, (record, x0) in enumerate(zip(records, point.x0, strict=True)):
        n = 1 << (2 * min(CHUNK, record.n_samples) - 1).bit_length()
        density = compute_spectrum(coefficients, noise, n)
        weight = np.where((np.arange(n // 2 + 1) == 0) | (2 * np.arange(n // 2 + 1) == n), 1.0, 2.0) / n
        weighted = (root.T @ density @ root) * weight[:, None, None]
        maps = compute_derivative_maps(point.form, x0)
        where = np.r_[np.arange(size), size + 2 * k * r + np.arange(2 * k)]
        inner = np.zeros((size + 2 * k, size + 2 * k))
        for columns in build_columns(point.form, x0, record, min(CHUNK, record.n_samples)):
            inner += _correlate(np.fft.rfft(columns.real, n, axis=0), weighted, maps)
        middle[np.ix_(where, where)] += inner
    return middle


def _correlate(columns: np.ndarray, weighted: np.ndarray, maps: DerivativeMaps) -> np.ndarray:
    """Return the sum over outputs o, o' and frequencies of J_o^H S_oo' J_o' (size, size), from columns (F, q) and S (F, p, p)."""
    out = np.zeros((maps.size, maps.size))
    own, (p, w) = maps.own.ravel(), maps.own.shape
    s = len(maps.shared)
    square, both, alone = np.zeros((s, s)), np.zeros((p, w, s)), np.zeros((p, w, p, w))
    for first in range(0, len(columns), FREQUENCIES):
        x, S = columns[first : first + FREQUENCIES], weighted[first : first + FREQUENCIES]
        moved = x[:, None, maps.re] * maps.real + x[:, None, maps.im] * maps.imaginary  # (F, p, s)
        passed = S @ moved
        square += (moved.reshape(-1, s).conj().T @ passed.reshape(-1, s)).real
        z = x @ maps.own_map
        both += (z.conj().T @ passed.reshape(len(x), -1)).real.reshape(w, p, s).swapaxes(0, 1)
        products = (z.conj()[:, :, None] * z[:, None, :]).reshape(len(x), -1)
        alone += (S.reshape(len(x), -1).T @ products).real.reshape(p, p, w, w).swapaxes(1, 2)
    flat = both.reshape(p * w, s)
    out[np.ix_(maps.shared, maps.shared)] = square
    out[np.ix_(own, maps.shared)], out[np.ix_(maps.shared, own)] = flat, flat.T
    out[np.ix_(own, own)] = alone.reshape(p * w, p * w)
    return (out + out.T) / 2


def _inverse(H: np.ndarray) -> np.ndarray:
    """Inverse of a Gauss-Newton matrix whose numbers have unlike units."""
    scale = np.sqrt(np.diag(H))
    scale[scale == 0] = 1.0
    return np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-14, hermitian=True) / np.outer(scale, scale)


KINDS = (SIMULATED, PREDICTED)
MAX_PREDICTOR_OUTPUTS = 6  # outputs of a predictor, whose inputs they are too: its free numbers grow with their square
PREDICTOR_ROUNDS = 15  # steps of its refinement, which begins near its end


@dataclass(frozen=True, eq=False)
class RefinedModel:
    """A refined model.

    Attributes:
        model: The model; real block-diagonal for output errors.
        covariance: Covariance of the full vector of `build_modal_form(model)`, see `Layout` (size, size); fixed numbers
            have zero rows, modes that cannot be distinguished (poles about to meet on the real axis) have rows of nan.
        modes: Its resonances with standard errors.
        loss: log det of the residuals' covariance, in the outputs' own units.
        residuals: Residuals record by record (N_r - delay, p), in the outputs' own units.
        n_samples: Samples used.
        rounds: Accepted steps.
        converged: Whether the last step was small against the standard errors.
        kind: "output_error" or "prediction_error".
        estimate: The estimated modal form, from which the response's covariance follows.
    """

    model: StateSpace
    covariance: np.ndarray
    modes: tuple[Mode, ...]
    loss: float
    residuals: tuple[np.ndarray, ...]
    n_samples: int
    rounds: int
    converged: bool
    kind: str
    estimate: ResponseEstimate

    @property
    def theta(self) -> np.ndarray:
        """Full vector (size,) of the model's modal form, to which `covariance` refers."""
        return flatten_form(build_modal_form(self.model))

    def model_at(self, theta: np.ndarray) -> StateSpace:
        """Return the model at another full vector near `theta`."""
        form = build_modal_form(self.model)
        return replace(step_form(form, np.asarray(theta) - flatten_form(form)).state_space(), noise=self.model.noise)

    def response_covariance(self, frequency: np.ndarray) -> np.ndarray:
        """Return the covariance (F, p, m, 2, 2) of Re and Im of the response at frequencies (F,) [Hz]."""
        return self.estimate.covariance_at(frequency)


def refine(
    model: StateSpace,
    records: Sequence[Record],
    *,
    kind: str = "output_error",
    direct: bool | None = None,
    maximum_rounds: int = 40,
    covariance: bool = True,
    stop: Callable[[], bool] = lambda: False,
) -> RefinedModel:
    """Refine a model on records.

    Args:
        model: Start of the search; unstable poles are mirrored.
        records: Unbroken stretches of inputs and outputs.
        kind: "output_error", or "prediction_error" for innovation form (disturbances inside the loop, feedback).
        direct: Whether D may differ from zero; None as in the model given.
        maximum_rounds: Most accepted steps.
        covariance: Whether to compute uncertainties; without them every standard error is nan, in half the time.
        stop: Called before every step; returns whether to end there.

    Raises:
        InputError: The kind is unknown or the records do not fit the model.
    """
    path = descend_to_fit(model, records, kind=kind, direct=direct, maximum_rounds=maximum_rounds, stop=stop)
    return path.finish(covariance)


@dataclass(frozen=True, eq=False)
class RefinementPath(Brief):
    """End of the descent of a model to a set of records, before uncertainties are computed.

    Attributes:
        model: Start of the descent.
        kind: As of `refine`.
        scales: Units of the descent.
        records: The records used, in these units.
        free: Which entries of D were free.
        as_model: The model of a form, in these units.
        path: The descent.
    """

    model: StateSpace
    kind: str
    scales: Scales
    records: list[Record]
    free: np.ndarray
    as_model: Callable[[ModalForm], StateSpace]
    path: Descent[FitPoint]

    @property
    def loss(self) -> float:
        """Log det of the errors' covariance."""
        return self.path.state.loss + 2 * float(np.log(self.scales.y).sum())

    def finish(self, covariance: bool = True) -> RefinedModel:
        """Return the model, with uncertainties or without."""
        model, scales, free = self.model, self.scales, self.free
        point = normalise_shapes(self.path.state)
        numbers = free_numbers(point.form, free)
        if covariance:
            found, errors = estimate_error_covariance(point, self.records, numbers)
        else:
            found, errors = np.full((numbers.sum(), numbers.sum()), np.nan), compute_errors(point, self.records)
        estimated = np.zeros((len(numbers), len(numbers)))
        estimated[np.ix_(numbers, numbers)] = found

        def in_own_units(form: ModalForm) -> StateSpace:
            return replace(self.as_model(form), delay=model.delay, noise=point.covariance).unscaled(scales)

        def in_own_form(form: ModalForm) -> ModalForm:
            # simulations are fitted in the model's own modes, predictions in those of the predictor
            return form.unscaled(scales) if self.kind == SIMULATED else build_modal_form(in_own_units(form))

        refined = in_own_units(point.form)
        reference = build_modal_form(refined)
        size = build_layout(reference).size
        spread = np.full((size, size), np.nan)
        if covariance:
            spread = propagate_covariance(point.form, found, free, in_own_form, reference)
        return RefinedModel(
            refined,
            spread,
            find_resonances(refined, spread),
            self.loss,
            tuple(part * scales.y for part in errors),
            point.n_samples,
            self.path.steps,
            self.path.converged,
            self.kind,
            ResponseEstimate(
                replace(point.form, delay=model.delay), estimated, scales, self.kind == "prediction_error"
            ),
        )


def descend_to_fit(
    model: StateSpace,
    records: Sequence[Record],
    *,
    kind: str = "output_error",
    direct: bool | None = None,
    maximum_rounds: int = 40,
    stop: Callable[[], bool] = lambda: False,
) -> RefinementPath:
    """Descend from a model to the one that fits records best; see `refine`."""
    if kind not in KINDS:
        raise InputError("invalid_value", f"there is no refinement '{kind}'; there are {' and '.join(KINDS)}")
    scales = Scales.of(records)
    if model.D.shape != (records[0].y.shape[1], records[0].u.shape[1]):
        raise InputError("mismatch", "the records' inputs or outputs are not those of the model")
    ready = [record.aligned(model.delay).scaled(scales) for record in records]
    direct = bool(np.any(model.D)) if direct is None else direct
    problem = _output_errors if kind == SIMULATED else _prediction_errors
    point, wide, free, as_model, allowed = problem(replace(model.scaled(scales), delay=0), ready, direct)
    path = minimise(point, wide, free, maximum_rounds, allowed, stop)
    return RefinementPath(model, kind, scales, wide, free, as_model, path)


Problem = tuple[FittedForm, list[Record], np.ndarray, Callable[[ModalForm], StateSpace], Callable[[ModalForm], bool]]


def _output_errors(start: StateSpace, records: list[Record], direct: bool) -> Problem:
    """The start, the records, the free entries of D, the model of a form, and which forms are allowed."""
    free = np.full(start.D.shape, direct)
    return (
        solve_input_matrices(_at(start, records), records, free),
        records,
        free,
        ModalForm.state_space,
        lambda form: True,
    )


def _prediction_errors(start: StateSpace, records: list[Record], direct: bool) -> Problem:
    """The same for the one-step predictor with inputs (u, y)."""
    wide = [build_predictor_record(record) for record in records]
    free = np.hstack([np.full(start.D.shape, direct), np.zeros((len(start.C), len(start.C)), dtype=bool)])
    limit = max(1.0, start.spectral_radius() * (1 + 1e-9))

    def allowed(form: ModalForm) -> bool:
        return build_innovation_model(form).spectral_radius() <= limit

    first = _at(build_predictor(start), wide)
    point = solve_input_matrices(first, wide, free)
    return point if allowed(point.form) else first, wide, free, build_innovation_model, allowed


def _at(model: StateSpace, records: Sequence[Record]) -> FitPoint:
    form = mirror_unstable_poles(build_modal_form(model))
    return evaluate(form, np.zeros((len(records), len(form.poles)), dtype=complex), records)


def refine_predictor(refined: RefinedModel, records: Sequence[Record]) -> RefinedModel:
    """Return the model that minimises one-step prediction errors, valid under feedback, for outputs that show the modes.

    Args:
        refined: Start of the search.
        records: Training records.
    """
    sizes = np.std(np.vstack(refined.residuals), axis=0)
    seen = np.array([m.shape / sizes for m in refined.modes]).reshape(-1, len(sizes))
    pivots = np.asarray(qr(np.vstack([seen.real, seen.imag]), mode="r", pivoting=True)[-1])
    some = sorted(int(o) for o in pivots[:MAX_PREDICTOR_OUTPUTS])
    whole = refined.model
    noise = None if whole.noise is None else whole.noise[np.ix_(some, some)]
    model = replace(whole, C=whole.C[some], D=whole.D[some], K=whole.K[:, some], noise=noise)
    fewer = [replace(r, y=r.y[:, some], outputs=tuple(r.outputs[o] for o in some)) for r in records]
    return refine(model, fewer, kind=PREDICTED, maximum_rounds=PREDICTOR_ROUNDS)
