"""A refined model judged: fit on held-out data, tests of what is left, spectra, uncertainty, mass-damping-stiffness, doubts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import TauDynError
from tau_dyn.modes.checks import CorrelationTest, FitQuality, check_independence, check_whiteness, fit_of
from tau_dyn.modes.delay import DelayChoice
from tau_dyn.modes.feedback_test import Feedback
from tau_dyn.modes.fit_quality import Response
from tau_dyn.modes.mechanical import Mechanical, fit_mechanical
from tau_dyn.modes.noise import NoiseModel, fit_noise_model
from tau_dyn.modes.nonlinearity import detect_nonlinearity
from tau_dyn.modes.order import OrderChoice
from tau_dyn.modes.poles import list_poles, list_zeros
from tau_dyn.modes.preparation import PreparedRecords
from tau_dyn.modes.pulses import compute_impulse_responses
from tau_dyn.modes.record import Record
from tau_dyn.modes.refinement import RefinedModel
from tau_dyn.modes.residuals import compute_residuals
from tau_dyn.modes.result import Modes, Nonlinearity, Trace
from tau_dyn.modes.result_warnings import add_warnings
from tau_dyn.modes.simulate import delay_inputs, predict, simulate
from tau_dyn.modes.spectra import EmpiricalResponse, estimate_empirical_response
from tau_dyn.modes.stabilisation import build_stabilisation_diagram
from tau_dyn.modes.state_space import StateSpace

PREDICTION_HORIZONS = (1, 10)
GRID = 400  # frequencies in a geometric row, beside those near resonances
TRACES = 6
"""Records kept for drawing."""


def validate_model(
    refined: RefinedModel,
    data: PreparedRecords,
    feedback: Feedback,
    delay: DelayChoice,
    order: OrderChoice,
    *,
    final: RefinedModel | None = None,
    sensor: str = "displacement",
    collocated: Sequence[tuple[int, int]] | None = None,
) -> Modes:
    """Return the result with everything that says how far to trust it.

    Args:
        refined: The model of the training data, which held-out data may judge.
        data: What it was fitted to, and what was held out.
        feedback: Whether the inputs answer to the outputs.
        delay: How the delay was chosen.
        order: How the order was chosen.
        final: The model of all data, which is the answer; None takes the one of the training data.
        sensor: What the outputs are: `displacement`, `velocity` or `acceleration`.
        collocated: Pairs of an input's and an output's number at one place.
    """
    final = final or refined
    model, modes = refined.model, tuple(final.modes)
    noise = fit_noise_model(compute_residuals(model, data.train))
    held = data.holdout or data.train
    white, free = _tests(model, noise, held, used=0 if data.holdout else model.order)
    narrow = min((2 * m.damping_ratio * m.frequency_hz for m in modes), default=0.0)
    empirical = estimate_empirical_response(data.train, impulses=data.kind == "impulse", resolve=narrow)
    complete = bool(free) and all(t.passed for t in free)
    mechanical, why_not = _mechanical(final, sensor, collocated, complete)
    first = data.train[0]
    found = Modes(
        inputs=first.inputs,
        outputs=first.outputs,
        dt=first.dt,
        order=model.order,
        delay=model.delay,
        method="",
        model=final.model,
        modes=modes,
        poles=list_poles(final.model, modes),
        zeros=list_zeros(final.model),
        train=_fit(model, noise, data.train),
        holdout=_fit(model, noise, data.holdout) if data.holdout else None,
        whiteness=white,
        independence=free,
        tested_on="holdout" if data.holdout else "train",
        feedback=feedback,
        delay_choice=delay,
        order_choice=order,
        stabilisation=build_stabilisation_diagram({t.order: t.modes for t in order.trials}),
        empirical=empirical,
        response=_response(final, empirical),
        impulse=compute_impulse_responses(model, held, modes, kind=data.kind, held_out=bool(data.holdout)),
        traces=_traces(model, data),
        nonlinearity=None if data.kind == "impulse" else _nonlinearity(model, data.train),
        mechanical=mechanical,
        mechanical_why=why_not,
        kind=data.kind,
        how_held=data.how_held,
        why={},
        warnings=data.warnings,
    )
    return add_warnings(found)


def _fit(model: StateSpace, noise: NoiseModel, records: Sequence[Record]) -> FitQuality:
    errors = compute_residuals(model, records)
    measured = [r.y[model.delay :] for r in records]
    percent = fit_of(measured, [y - e for y, e in zip(measured, errors, strict=True)])
    ahead = {
        k: fit_of(measured, [y - noise.ahead(e, k) for y, e in zip(measured, errors, strict=True)])
        for k in PREDICTION_HORIZONS
    }
    rms = np.sqrt(np.sum([np.sum(e**2, axis=0) for e in errors], axis=0) / sum(len(e) for e in errors))
    return FitQuality(percent, ahead, sum(len(e) for e in errors), rms)


def compute_prediction_errors(
    model: StateSpace, noise: NoiseModel, records: Sequence[Record], k: int
) -> list[np.ndarray]:
    """Return errors of predictions k samples ahead: by the model's own innovations where it has any, else by the noise model."""
    if np.any(model.K):
        return [(r.y - predict(model, r, k))[model.delay :] for r in records]
    return [noise.ahead(e, k) for e in compute_residuals(model, records)]


def _tests(
    model: StateSpace, noise: NoiseModel, records: Sequence[Record], used: int
) -> tuple[tuple[CorrelationTest, ...], tuple[CorrelationTest, ...]]:
    long = [r for r in records if r.n_samples >= 100]
    if not long:
        return (), ()
    one_step = [e[noise.lags :] for e in compute_prediction_errors(model, noise, long, 1)]
    # in a loop a disturbance reaches the inputs, so that only what is new at each sample can be asked of them
    kept = compute_prediction_errors(model, noise, long, 1) if np.any(model.K) else compute_residuals(model, long)
    late = [delay_inputs(model, r)[model.delay :] for r in long]
    outputs, inputs = records[0].outputs, records[0].inputs
    return check_whiteness(one_step, outputs), check_independence(kept, late, outputs, inputs, used=used)


def _nonlinearity(model: StateSpace, records: Sequence[Record]) -> Nonlinearity | None:
    errors = compute_residuals(model, records)
    simulated = [r.y[model.delay :] - e for r, e in zip(records, errors, strict=True)]
    late = [delay_inputs(model, r)[model.delay :] for r in records]
    return detect_nonlinearity(errors, simulated, late, records[0].outputs)


def _mechanical(
    refined: RefinedModel, sensor: str, collocated: Sequence[tuple[int, int]] | None, complete: bool
) -> tuple[Mechanical | None, str]:
    try:
        return fit_mechanical(refined, collocated=collocated, output=sensor, complete=complete), ""
    except (TauDynError, np.linalg.LinAlgError) as fault:
        return None, str(fault)


def _response(refined: RefinedModel, empirical: EmpiricalResponse) -> Response:
    model = refined.model
    f = _grid(refined, empirical)
    spread = refined.response_covariance(f)
    deviation = np.sqrt(np.maximum(spread[..., 0, 0] + spread[..., 1, 1], 0.0))
    return Response(f, model.frequency_response(f), deviation)


def _grid(refined: RefinedModel, empirical: EmpiricalResponse) -> np.ndarray:
    """Return frequencies over the excited band, denser around each mode."""
    nyquist = 0.5 / refined.model.dt
    seen = empirical.frequency[empirical.excited]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.01 * nyquist, nyquist)
    slow = [m.frequency_hz for m in refined.modes if m.frequency_hz < nyquist]
    low = max(min([low, *(0.3 * f for f in slow)]), 1e-4 * nyquist, 0.05 * min(slow, default=0.0))
    near = [
        m.frequency_hz * (1 + max(m.damping_ratio, 1e-4) * x) for m in refined.modes for x in np.linspace(-8, 8, 33)
    ]
    f = np.unique(np.concatenate([np.geomspace(low, 0.999 * max(high, 2 * low), GRID), near]))
    return f[(f >= low) & (f <= min(0.999 * nyquist, max(high, 2 * low)))]


def _traces(model: StateSpace, data: PreparedRecords) -> tuple[Trace, ...]:
    chosen = [*((r, True) for r in data.holdout), *((r, False) for r in data.train)][:TRACES]
    return tuple(Trace(r.name, np.arange(r.n_samples) * r.dt, r.u, r.y, simulate(model, r), held) for r, held in chosen)
