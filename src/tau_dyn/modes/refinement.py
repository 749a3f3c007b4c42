r"""Refinement of a model to the most likely one, in modal coordinates, with the covariance of the outcome.

Output errors: y = G u + v; v may be coloured, the estimate stays consistent and its covariance accounts for it.
Prediction errors: the innovation form; its predictor is an output-error model with inputs (u, y) and the poles of A - K
C, which is refined in its own modal coordinates. Every record has its own initial state, estimated along. References:
Ljung 1999, 7.2-7.5, 10.2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import qr

from tau_dyn.exceptions import InputError
from tau_dyn.modes.covariance_propagation import propagate_covariance
from tau_dyn.modes.error_covariance import compute_residuals, estimate_error_covariance
from tau_dyn.modes.gauss_newton import FitPoint, evaluate
from tau_dyn.modes.innovation import build_innovation_model, build_predictor, build_predictor_record
from tau_dyn.modes.input_matrices import mirror_unstable_poles, solve_input_matrices
from tau_dyn.modes.levenberg_marquardt import minimise, normalise_shapes
from tau_dyn.modes.modal import Mode, find_resonances
from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form, flatten_form, free_numbers, step_form
from tau_dyn.modes.record import Record, Scales
from tau_dyn.modes.residuals import PREDICTED, SIMULATED
from tau_dyn.modes.response import ResponseEstimate
from tau_dyn.modes.state_space import StateSpace

KINDS = (SIMULATED, PREDICTED)
MAX_PREDICTOR_OUTPUTS = 6
"""Outputs of a predictor, whose inputs they are too: its free numbers grow with their square."""
PREDICTOR_ROUNDS = 15  # steps of its refinement, which begins near its end


@dataclass(frozen=True, eq=False)
class RefinedModel:
    """A refined model.

    Attributes:
        model: The model; real block-diagonal for output errors.
        covariance: Of the full vector of `build_modal_form(model)`, see `Layout` (size, size); fixed numbers have zero rows,
        modes
            that cannot be told apart (poles about to meet on the real axis) rows of nan.
        modes: Its resonances with standard errors.
        loss: log det of the residuals' covariance, in the outputs' own units.
        residuals: Residuals record by record (N_r - delay, p), in the outputs' own units.
        n_samples: Samples used.
        rounds: Accepted steps.
        converged: Whether the last step was small against the standard errors.
        kind: "output_error" or "prediction_error".
        estimate: What was estimated, from which the response's covariance follows.
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
        """Full vector (size,) of the model's modal form, the one that `covariance` speaks of."""
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
) -> RefinedModel:
    """Refine a model on records.

    Args:
        model: Where to start; unstable poles are mirrored.
        records: Unbroken stretches of inputs and outputs.
        kind: "output_error", or "prediction_error" for innovation form (disturbances inside the loop, feedback).
        direct: Whether D may differ from zero; None as in the model given.
        maximum_rounds: Most accepted steps.
        covariance: Whether to work out uncertainties; without them every standard error is nan, in half the time.

    Raises:
        InputError: The kind is unknown or the records do not fit the model.
    """
    if kind not in KINDS:
        raise InputError("invalid_value", f"there is no refinement '{kind}'; there are {' and '.join(KINDS)}")
    scales = Scales.of(records)
    if model.D.shape != (records[0].y.shape[1], records[0].u.shape[1]):
        raise InputError("mismatch", "the records' inputs or outputs are not those of the model")
    ready = [record.aligned(model.delay).scaled(scales) for record in records]
    direct = bool(np.any(model.D)) if direct is None else direct
    start = replace(model.scaled(scales), delay=0)
    problem = _output_errors if kind == SIMULATED else _prediction_errors
    point, wide, free, as_model, allowed = problem(start, ready, direct)
    path = minimise(point, wide, free, maximum_rounds, allowed)
    point = normalise_shapes(path.point)
    numbers = free_numbers(point.form, free)
    if covariance:
        found, errors = estimate_error_covariance(point, wide, numbers)
    else:
        found, errors = np.full((numbers.sum(), numbers.sum()), np.nan), compute_residuals(point, wide)
    estimated = np.zeros((len(numbers), len(numbers)))
    estimated[np.ix_(numbers, numbers)] = found

    def in_own_units(form: ModalForm) -> StateSpace:
        return replace(as_model(form), delay=model.delay, noise=point.covariance).unscaled(scales)

    refined = in_own_units(point.form)
    size = build_layout(build_modal_form(refined)).size
    spread = (
        propagate_covariance(point.form, found, free, in_own_units) if covariance else np.full((size, size), np.nan)
    )
    return RefinedModel(
        refined,
        spread,
        find_resonances(refined, spread),
        point.loss + 2 * float(np.log(scales.y).sum()),
        tuple(part * scales.y for part in errors),
        point.n_samples,
        path.rounds,
        path.converged,
        kind,
        ResponseEstimate(replace(point.form, delay=model.delay), estimated, scales, kind == "prediction_error"),
    )


Problem = tuple[FitPoint, list[Record], np.ndarray, Callable[[ModalForm], StateSpace], Callable[[ModalForm], bool]]


def _output_errors(start: StateSpace, records: list[Record], direct: bool) -> Problem:
    """Where to start, the records, the free entries of D, the model of a form, and which forms are allowed."""
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
    """Return the model that minimises one-step prediction errors, which holds under feedback; of the outputs that show the modes.

    Args:
        refined: Where to start.
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
