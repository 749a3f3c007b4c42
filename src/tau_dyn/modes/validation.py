"""Validation of a refined model: fit on held-out data, tests of residuals, spectra, uncertainty, M, D, K, warnings.

The test for nonlinear stiffness, damping or friction: with e the residual of a simulation, y the simulated output and u the
inputs,

    A(q) e_t = B(q) u_t + C(q) y_t + T(q) y_t^k + w_t,      k = 2, 3,      e.g. Duffing:  e = -G k3 y^3 + v

has T = 0 if the structure is linear, in open and in closed loop: w is new at t, and everything else is past. A and B
model colour and linear dynamics that the model lacks. An F-test decides whether T differs from zero; the variance of
`T / A y^k` over that of e decides whether it matters. References: Billings & Voon 1986; Söderström & Stoica 1989, 11.3
(nested model structures).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import qr
from scipy.signal import lfilter
from scipy.stats import f as fisher

from tau_dyn.exceptions import TauDynError
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes.contact import remove_input_noise
from tau_dyn.modes.delay import DelayChoice
from tau_dyn.modes.feedback_tests import Feedback
from tau_dyn.modes.hankel import fit_autoregression
from tau_dyn.modes.mechanical import Mechanical, fit_mechanical
from tau_dyn.modes.modal import Mode, build_stabilisation_diagram, list_poles, list_zeros
from tau_dyn.modes.order import OrderChoice
from tau_dyn.modes.record import PreparedRecords, Record, stack_lags
from tau_dyn.modes.refinement import RefinedModel
from tau_dyn.modes.residuals import (
    CorrelationTest,
    FitQuality,
    NoiseModel,
    check_independence,
    check_whiteness,
    compute_mean_squares,
    compute_residuals,
    fit_noise_model,
    fit_of,
)
from tau_dyn.modes.responses import (
    EmpiricalResponse,
    Response,
    compute_impulse_responses,
    estimate_empirical_response,
    find_tones,
    is_coherent,
)
from tau_dyn.modes.result import Modes, Nonlinearity, Trace
from tau_dyn.modes.sensors import DISPLACEMENT, SensorKind
from tau_dyn.modes.state_space import StateSpace, delay_inputs, predict, simulate

PREDICTION_HORIZONS = (1, 10)
GRID = 400  # frequencies in a geometric row, in addition to those near resonances
TRACES = 6  # records kept for drawing


def validate_model(
    refined: RefinedModel,
    data: PreparedRecords,
    feedback: Feedback,
    delay: DelayChoice,
    order: OrderChoice,
    *,
    final: RefinedModel | None = None,
    sensor: SensorKind = DISPLACEMENT,
    collocated: Sequence[tuple[int, int]] | None = None,
) -> Modes:
    """Return the result with its validation.

    Args:
        refined: The model of the training data, which is validated on held-out data.
        data: Training records and held-out records.
        feedback: Whether the inputs respond to the outputs.
        delay: How the delay was chosen.
        order: How the order was chosen.
        final: The model of all data, which is returned; None takes the one of the training data.
        sensor: Quantity that the outputs measure.
        collocated: Pairs of an input's and an output's number at one place.
    """
    final = final or refined
    tones = find_tones(final.modes, data.train)
    model, modes = refined.model, tuple(m for m in final.modes if m not in tones)
    noise = fit_noise_model(compute_residuals(model, data.train))
    held = data.holdout or data.train
    white, free = _tests(model, noise, held, used=0 if data.holdout else model.order)
    narrow = min((2 * m.damping_ratio * m.frequency_hz for m in modes), default=0.0)
    empirical = estimate_empirical_response(data.train, impulses=data.kind == "impulse", resolve=narrow)
    complete = bool(free) and all(t.passed for t in free)
    first = data.train[0]
    mechanical, why_not = _mechanical(final, sensor, collocated, complete, first.outputs)
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
        nonlinearity=None if data.kind == "impulse" else _test_nonlinearity(model, data.train),
        mechanical=mechanical,
        mechanical_why=why_not,
        kind=data.kind,
        how_held=data.how_held,
        why={},
        warnings=data.warnings,
    )
    if tones:
        said = f"{_list_hz(tones)}: tones of the inputs, not resonances; drive with noise or a sweep to see what lies there"
        found = replace(found, warnings=(*found.warnings, CodedWarning("tone_of_input", said)))
    return replace(found, warnings=tuple(dict.fromkeys((*found.warnings, *list_doubts(found, data.clipped)))))


def _fit(model: StateSpace, noise: NoiseModel, records: Sequence[Record]) -> FitQuality:
    errors = compute_residuals(model, records)
    measured = [r.y[model.delay :] for r in records]
    percent = fit_of(measured, [y - e for y, e in zip(measured, errors, strict=True)])
    ahead = {
        k: fit_of(measured, [y - noise.ahead(e, k) for y, e in zip(measured, errors, strict=True)])
        for k in PREDICTION_HORIZONS
    }
    return FitQuality(percent, ahead, sum(len(e) for e in errors), np.sqrt(compute_mean_squares(errors)))


def compute_prediction_errors(
    model: StateSpace, noise: NoiseModel, records: Sequence[Record], k: int
) -> list[np.ndarray]:
    """Return errors of predictions k samples ahead: by the model's own innovations if it has any, else by the noise model."""
    if np.any(model.K):
        return [(r.y - predict(model, r, k))[model.delay :] for r in records]
    return [noise.ahead(e, k) for e in compute_residuals(model, records)]


def _tests(
    model: StateSpace, noise: NoiseModel, records: Sequence[Record], used: int
) -> tuple[tuple[CorrelationTest, ...], tuple[CorrelationTest, ...]]:
    long = [r for r in records if r.n_samples >= 100]
    if not long:
        return (), ()
    # in a loop a disturbance reaches the inputs, so only the innovation at each sample can be tested against them
    if np.any(model.K):
        one_step = kept = compute_prediction_errors(model, noise, long, 1)
    else:
        kept = _simulation_errors(model, long)
        one_step = [noise.ahead(e, 1) for e in kept]
    one_step = [e[noise.lags :] for e in one_step]
    late = [delay_inputs(model, r)[model.delay :] for r in long]
    outputs, inputs = records[0].outputs, records[0].inputs
    return check_whiteness(one_step, outputs), check_independence(kept, late, outputs, inputs, used=used)


def _simulation_errors(model: StateSpace, records: Sequence[Record]) -> list[np.ndarray]:
    """Return errors of simulations, without the part that the noise of a hammer's force explains."""
    errors = compute_residuals(model, records)
    aligned = [r.aligned(model.delay) for r in records]
    return remove_input_noise(errors, aligned, model.markov(max(r.n_samples for r in aligned)))


def _test_nonlinearity(model: StateSpace, records: Sequence[Record]) -> Nonlinearity | None:
    errors = compute_residuals(model, records)
    simulated = [r.y[model.delay :] - e for r, e in zip(records, errors, strict=True)]
    late = [delay_inputs(model, r)[model.delay :] for r in records]
    return detect_nonlinearity(errors, simulated, late, records[0].outputs)


def _mechanical(
    refined: RefinedModel,
    sensor: SensorKind,
    collocated: Sequence[tuple[int, int]] | None,
    complete: bool,
    outputs: Sequence[str],
) -> tuple[Mechanical | None, str]:
    try:
        found = fit_mechanical(refined, collocated=collocated, output=sensor.kind, complete=complete, names=outputs)
        return found.in_units_of(sensor.unit), ""
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


POOR_FIT = 50.0  # per cent of an output's standard deviation
MAX_RELATIVE_DAMPING_STDERR = 0.3
"""Standard error of a damping ratio over the ratio itself, beyond which it is hardly known."""
MAX_FIT_DROP_PERCENT = 10.0  # per cent from training to held-out data; more indicates overfitting or a changed machine
MIN_RECORD_PERIODS = 10  # of the slowest mode; fewer leave its damping open


def list_doubts(found: Modes, clipped: Sequence[str] = ()) -> Iterator[str]:
    """Yield the warnings about a result, one sentence each.

    Args:
        found: The result.
        clipped: Channels that clip; the residual of such an output is no property of the structure.
    """
    if found.feedback.suspected and found.feedback.input:
        said = f"{found.feedback.why}: a loop was closed; log its reference and name it with --reference"
        yield CodedWarning("feedback_found", said)
    limit = found.order_choice.limit
    if limit:
        said = f"order {limit} is the highest that was looked at, and more states may help; try --order {2 * limit}"
        yield CodedWarning("order_at_limit", said)
    seen = found.empirical.frequency[found.empirical.excited]
    if not len(seen):
        yield "the inputs hold no power anywhere that could be resolved; the response is not to be trusted"
    elif out := [m for m in found.modes if not 0.7 * seen.min() <= m.frequency_hz <= 1.3 * seen.max()]:
        yield f"the inputs hold no power near {_list_hz(out)}: do not take it for a resonance"
    if loose := [m for m in found.modes if not is_coherent(m, found.empirical, len(found.inputs))]:
        said = f"near {_list_hz(loose)} the outputs follow the inputs no more than noise would: confirm it by another record"
        yield CodedWarning("no_coherence", said)
    most = MAX_RELATIVE_DAMPING_STDERR
    if vague := [m for m in found.modes if np.inf > m.damping_stderr > most * abs(m.damping_ratio)]:
        yield f"the damping at {_list_hz(vague)} is known to worse than 30 %"
    duration = max((t.t[-1] for t in found.traces), default=0.0)
    if found.modes and duration * found.modes[0].frequency_hz < MIN_RECORD_PERIODS:
        yield f"the longest record holds fewer than {MIN_RECORD_PERIODS} periods of {_list_hz(found.modes[:1])}"
    if not found.modes:
        yield "the model has no resonance: all its poles are real"
    if silent := found.silent_outputs:
        said = f"{', '.join(found.inputs)} explain less than 2 % of {', '.join(silent)}, while other outputs respond"
        yield CodedWarning("faulty_channel", f"{said}: look at sensor and cable, or leave it out of --outputs")
    poor = [
        n
        for n, v in zip(found.outputs, found.judged.percent, strict=True)
        if v < POOR_FIT and n not in found.silent_outputs
    ]
    if poor:
        yield f"the model follows {', '.join(poor)} to less than {POOR_FIT:.0f} %; noise, or a motion that is not linear"
    if found.holdout is not None and found.train.mean - found.holdout.mean > MAX_FIT_DROP_PERCENT:
        yield (
            f"the fit falls from {found.train.mean:.1f} to {found.holdout.mean:.1f} % on held-out data: "
            "too many states, or the plant changed"
        )
    power = found.nonlinearity
    if power is not None and power.suspected and power.output not in clipped:
        what = "size (stiffness, friction)" if power.power == 3 else "sign (preload, play on one side)"
        said = (
            f"{power.output} responds nonlinearly to its {what}: powers of the response explain {100 * power.share:.0f} % of the "
            f"residual (p = {power.p_value:.1g}); modes hold for this level of force only"
        )
        yield CodedWarning("response_nonlinear", said)
    if failed := [t for t in found.independence if not t.passed and t.output not in clipped]:
        worst = min(failed, key=lambda t: t.p_value)
        what = f"what the model leaves of {worst.output} still answers to {worst.input}"
        yield f"{what} (p = {worst.p_value:.1g}): dynamics are missing; try a higher order, or mind nonlinear friction"


def _list_hz(modes: Sequence[Mode]) -> str:
    return ", ".join(f"{m.frequency_hz:.3g} Hz" for m in modes)


POWERS = (2, 3)
SIGNIFICANCE_LEVEL = 1e-3  # of a nonlinearity that is not there; one set in a thousand
MIN_VARIANCE_SHARE = 0.1
"""Share of the residual's variance that a power must explain to count: everything real is slightly nonlinear."""
INPUT_LAGS = 30  # lags of B
RESPONSE_LAGS = 2  # lags of C
POWER_LAGS = 5  # lags of T
MAX_NONLINEARITY_SAMPLES = 10_000  # samples used


def detect_nonlinearity(
    errors: Sequence[np.ndarray], simulated: Sequence[np.ndarray], u: Sequence[np.ndarray], outputs: Sequence[str]
) -> Nonlinearity | None:
    """Test the longest record; None if it is too short.

    Args:
        errors: Measured minus simulated outputs, one (N, p) a record.
        simulated: Simulated outputs (N, p) of the same samples.
        u: Inputs (N, m), as late as the model's delay makes them act.
        outputs: Names of the outputs.
    """
    longest = int(np.argmax([len(e) for e in errors]))
    e, y, inputs = (x[longest][:MAX_NONLINEARITY_SAMPLES] for x in (errors, simulated, u))
    if len(e) < 20 * INPUT_LAGS * max(1, inputs.shape[1]):
        return None
    lagged = np.hstack([np.ones((len(y), 1)), _lagged(inputs, INPUT_LAGS)])
    basis = np.asarray(qr(lagged, mode="economic")[0])
    found: list[tuple[float, float, int, int]] = []
    for i in range(len(outputs)):
        size = y[:, i].std()
        if size > 0 and e[:, i].std() > 0:
            error = e[:, i] - e[:, i].mean()
            found += [(*_test(error, y[:, i] / size, basis, power), i, power) for power in POWERS]
    if not found:
        return None
    p, share, i, power = min(found)
    p = min(1.0, p * len(found))
    return Nonlinearity(p < SIGNIFICANCE_LEVEL and share > MIN_VARIANCE_SHARE, p, share, outputs[i], power)


def _test(e: np.ndarray, y: np.ndarray, basis: np.ndarray, power: int) -> tuple[float, float]:
    """Return the p-value of T and the share that it explains, for one output and power; `basis` spans the lags of u (N, q)."""
    n = max(2, len(fit_autoregression([e[:, None]])[0]))
    past = _lagged(np.r_[0.0, e[:-1]][:, None], n - 1)
    linear = np.hstack([past, _lagged(y[:, None], RESPONSE_LAGS)])
    whole = np.hstack([linear, _lagged(y[:, None] ** power, POWER_LAGS)])
    before, missed_before = _regress(e, linear, basis, n)
    after, missed = _regress(e, whole, basis, n)
    free, extra = len(e) - basis.shape[1] - whole.shape[1], POWER_LAGS + 1
    statistic = (before - after) / extra / max(after / free, 1e-300)
    share = 1 - missed / min(missed_before, float(np.var(e)))
    return float(fisher.sf(statistic, extra, free)), max(share, 0.0)


def _regress(e: np.ndarray, columns: np.ndarray, basis: np.ndarray, n: int) -> tuple[float, float]:
    """Return the sum of squares one step ahead, and the variance that simulating e leaves; the first n columns are its past."""
    right = e - basis @ (basis.T @ e)
    apart = columns - basis @ (basis.T @ columns)
    theta = np.linalg.lstsq(apart, right, rcond=None)[0]
    new = right - apart @ theta
    drive = e - new - columns[:, :n] @ theta[:n]
    with np.errstate(all="ignore"):  # an unstable autoregression diverges and has no explanatory power
        missed = float(np.var(e - lfilter([1.0], np.r_[1.0, -theta[:n]], drive)))
    return float(new @ new), missed if np.isfinite(missed) else float("inf")


def _lagged(x: np.ndarray, lags: int) -> np.ndarray:
    """Return columns (N, c) as they were 0 to `lags` samples before, side by side; zero before the record."""
    return stack_lags(np.vstack([np.zeros((lags, x.shape[1])), x]), lags, 0)
