r"""Resonances from vibration logs: one call from columns of a log to modes with uncertainty and a validated model.

The steps, in order: records are prepared (`record.py`). A method is tried, for which a delay (`delay.py`) and an order
(`order.py`) are chosen from first models (`methods.py`). Its residuals are tested for feedback (`feedback_tests.py`).
If this test, an earlier sign of feedback or a named reference indicates a closed loop, `pbsid`, which is consistent
under feedback, is tried too. The better model is refined (`refinement.py`) and fitted to all data, its standard errors
are widened by the differences to other models, and it is validated (`validation.py`). Each step adds a sentence to
`why`.

Under feedback the simulation error favours the open-loop method, which fits the disturbance too. So `pbsid` is accepted
with a slightly larger error, but not with a much larger one: a model that cannot simulate is rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError, require_names
from tau_dyn.log import LogSource, as_logs
from tau_dyn.modes.contact import window_forces
from tau_dyn.modes.delay import (
    MAX_DELAY_SAMPLES,
    ORDERS,
    DelayChoice,
    DelayScan,
    choose_delay,
    find_response_onset,
    scan_delays,
)
from tau_dyn.modes.feedback_tests import (
    ACAUSALITY_SIGNIFICANCE_LEVEL,
    Acausality,
    Feedback,
    detect_feedback,
    find_acausality,
)
from tau_dyn.modes.methods import (
    METHODS,
    InitialModels,
    Start,
    build_initial_estimator,
    decompose_pulse_tests,
    estimate_first_poles,
)
from tau_dyn.modes.modal import widen_modes
from tau_dyn.modes.order import (
    MANY_NUMBERS,
    NEIGHBOURS,
    TOLERANCE,
    OrderChoice,
    add_standard_errors,
    choose_order,
    read_whole_number,
    select_parts,
)
from tau_dyn.modes.record import PreparedRecords, Record, prepare_records
from tau_dyn.modes.refinement import RefinedModel, refine, refine_predictor
from tau_dyn.modes.residuals import PREDICTED, SIMULATED, compute_mean_squares, compute_residuals
from tau_dyn.modes.result import Modes
from tau_dyn.modes.sensors import find_sensor_kind
from tau_dyn.modes.state_space import StateSpace, delay_inputs
from tau_dyn.modes.time_limit import TimeLimit
from tau_dyn.modes.validation import validate_model
from tau_dyn.results import count

MAX_REQUESTED_ORDER = 200  # states; a dense model of more takes minutes and fits noise
MAX_REQUESTED_DELAY = 10_000  # samples
PULSE_GAIN = 0.1  # share by which a delay must lower the residual of pulse tests to be accepted
MAX_ROUNDS, FEW_ROUNDS = 40, 15
"""Rounds of refinement; few for models of many free numbers, which begin at a refined trial, and for pulse tests, which
can hold more modes than a model and then converge slowly."""
POSSIBLE = 0.2  # p-value below which feedback cannot be excluded, and standard errors allow for it
MAX_LOOP_GAIN = 10.0  # loop gains beyond it are rare within a resonance, and the number would not be informative
WORST_RATIO = 1.15
"""Simulation error of `pbsid` over that of `n4sid` up to which it is accepted under feedback: an open-loop fit also fits a
share of a disturbance that returns through the input. A judgement, not calibrated by a study."""
MIN_RELATIVE_ERROR = 0.1
"""Simulation error over the outputs' size below which disturbances are too small for prediction errors to do better."""
MAX_ERROR_RATIO = 0.98
"""Simulation error of a fit of prediction errors over that of simulation errors up to which it is taken."""
Progress = Callable[[str], None]


def find_modes(
    logs: LogSource | Sequence[LogSource],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    holdout: LogSource | Sequence[LogSource] = (),
    references: Sequence[str] = (),
    method: str = "auto",
    order: str | int = "auto",
    delay: str | int = "auto",
    sensor: str = "auto",
    collocated: Sequence[tuple[str, str]] = (),
    time_limit: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Modes:
    """Identify resonances, a black-box model, and mass, damping and stiffness if the data determine them.

    Args:
        logs: Logs to fit on, each a log, the path of its file, or a table; never joined.
        inputs: Columns that excite.
        outputs: Columns that respond.
        holdout: Logs for validation; the last 30 % of every log if not given.
        references: Columns that a feedback loop was asked to follow.
        method: `auto`, `n4sid`, `pbsid`, `arx` or `era`.
        order: `auto` or a number of states.
        delay: `auto` or a number of samples.
        sensor: Quantity that the outputs measure: `displacement`, `velocity` or `acceleration`; `auto` uses their
            names, or the fit of M, D, K if the names do not state it. Accelerations in g are named so (`acc1_g`).
        collocated: Pairs of an input and an output at one place and in one direction; if not given and there are as
            many outputs as inputs, each input and the output of the same rank.
        time_limit: Wall time [s] after which the search ends; the best model so far is returned, and the warning
            `time_limit` names the skipped steps. One model is always fitted and validated, which may take longer.
        seed: Kept with the result; the method is deterministic.
        progress: Called with a description of each step.

    Raises:
        InputError: A column, an option or the logs do not fit.
        CannotAnswer: The data are sound but too few, or no stable model follows from them.

    Example:
        >>> from scipy.signal import lfilter
        >>> t, force = np.arange(1200) * 0.01, np.random.default_rng(0).choice([-1.0, 1.0], 600).repeat(2)
        >>> pole = np.exp(0.01 * 2 * np.pi * 8.0 * (-0.02 + 1j))
        >>> x = lfilter([0.0, 1.0], [1.0, -2 * pole.real, abs(pole) ** 2], force)
        >>> found = td.find_modes(td.Log(t, {"force": force, "x": x}), ["force"], ["x"], order=2, delay=0)
        >>> round(found.modes[0].frequency_hz, 2)
        8.0
    """
    say, limit = progress or (lambda step: None), TimeLimit(time_limit)
    asked = read_whole_number("order", order, 1, MAX_REQUESTED_ORDER, f"states from 1 to {MAX_REQUESTED_ORDER}")
    fixed = read_whole_number("delay", delay, 0, MAX_REQUESTED_DELAY, "samples from 0 up")
    if method not in ("auto", *METHODS):
        raise InputError("bad_option", f"--method {method}: there are auto, {', '.join(METHODS)}")
    require_names(inputs, "inputs")
    require_names(outputs, "outputs")
    places = _places(collocated, inputs, outputs)
    several, held = as_logs(logs), as_logs(holdout)
    data = prepare_records(several, tuple(inputs), tuple(outputs), holdout=held, references=tuple(references))
    _refuse_costly(asked, data)
    measured, forces, pulses = find_sensor_kind(outputs, sensor), "", data.kind == "impulse"
    if pulses:
        say("looking for contact")
        data, forces = window_forces(data)

    say("looking for feedback")
    feedback = Feedback(False, 1.0, 0.0, "pulses get no answer") if pulses else detect_feedback(data.train)
    first, why = _choose_first_method(method, data, feedback)

    starts: dict[tuple[str, int], Start] = {}  # by method and delay: compared models share their first models
    scans: list[DelayScan] = []

    def attempt(name: str, kind: str) -> MethodCandidate:
        late = _choose_delay(data, name, kind, asked, fixed, measured.kind, say, scans, limit)

        def start(records: Sequence[Record]) -> Start:
            if (name, late.delay) not in starts:
                made = build_initial_estimator(name, records, delay=late.delay, highest=max(20, asked or 0))
                starts[name, late.delay] = made
            return starts[name, late.delay]

        states = choose_order(data.train, start, kind=kind, asked=asked, pulses=pulses, progress=say, limit=limit)
        return MethodCandidate(name, kind, late, states)

    def attempt_predicted(name: str) -> MethodCandidate | None:
        if limit.is_over(f"{name} with prediction errors"):
            return None
        say(f"trying {name} with prediction errors")
        try:
            return attempt(name, PREDICTED)
        except (TauDynError, np.linalg.LinAlgError):
            return None

    best = attempt(first, PREDICTED if first == "pbsid" else SIMULATED)
    if method == "auto" and not pulses:
        best, feedback, why = settle(data, feedback, best, lambda: attempt_predicted("pbsid"))
        best, more = choose_error_kind(best, data, lambda: attempt_predicted("n4sid"))
        why += more

    best = replace(best, states=add_standard_errors(best.states))
    say(f"refining order {best.states.order}")
    refined, how = _refine_best(data, best, limit, alone=method != "auto")
    say("fitting all data")
    final, whole = _refit(refined, data, best, limit)
    final = _widen(final, refined, data, best, feedback, limit)
    say("judging")
    found = validate_model(
        refined, data, feedback, best.late, best.states, final=final, sensor=measured, collocated=places
    )
    reasons = {"method": why, "delay": best.late.why, "order": best.states.why, "refinement": f"{how}; {whole}"}
    reasons |= {"forces": forces} if forces else {}
    return replace(
        found, method=best.method, why=reasons, seed=seed, warnings=(*found.warnings, *limit.list_warnings())
    )


def _places(
    pairs: Sequence[tuple[str, str]], inputs: Sequence[str], outputs: Sequence[str]
) -> list[tuple[int, int]] | None:
    """Return collocated pairs as numbers of columns; `None` if no pairs were given."""
    for one, other in pairs:
        if one not in inputs or other not in outputs:
            raise InputError(
                "bad_option",
                f"--collocated {one}:{other}: write an input of {list(inputs)} and an output of {list(outputs)}",
            )
    return [(list(inputs).index(a), list(outputs).index(b)) for a, b in pairs] or None


def _refuse_costly(order: int | None, data: PreparedRecords) -> None:
    """Refuse an order whose free numbers have fewer than four samples each."""
    p, m = data.train[0].y.shape[1], data.train[0].u.shape[1]
    most = data.n_train * p // (4 * (p + m))
    if order is not None and order > most:
        raise InputError(
            "bad_option",
            f"--order {order}: {data.n_train} training samples cannot pay for it with {m} inputs and {p} outputs; "
            f"at most {most}, better far fewer",
        )


def _choose_first_method(method: str, data: PreparedRecords, feedback: Feedback) -> tuple[str, str]:
    """Return the method to begin with, and why."""
    if method == "era" and data.kind != "impulse":
        raise CannotAnswer(
            "poor_excitation",
            "era needs impulse tests, and these inputs are not short pulses followed by rest",
            "a hammer's blow and its decay, or another method for these data",
        )
    if method != "auto":
        biased = feedback.suspected and method != "pbsid"
        return method, f"{method} was asked for" + (
            f", although {feedback.why}; its damping may be biased" if biased else ""
        )
    if data.kind == "impulse":
        return "era", "the inputs are short pulses followed by free decay, so era"
    return "n4sid", f"{feedback.why}, so n4sid"


def _choose_delay(
    data: PreparedRecords,
    method: str,
    kind: str,
    asked: int | None,
    fixed: int | None,
    sensor: str,
    say: Progress,
    scans: list[DelayScan],
    limit: TimeLimit,
) -> DelayChoice:
    """Return the delay; the scan over first models, the same for every method, is kept in `scans`."""
    if fixed is not None:
        return DelayChoice(fixed, (), float("nan"), f"a delay of {fixed} samples was asked for")
    orders = ORDERS if asked is None else sorted({o for o in ORDERS if o < asked} | {min(asked, 20)})
    decays = decompose_pulse_tests(data.train, delay=MAX_DELAY_SAMPLES) if method == "era" else None
    most = MAX_DELAY_SAMPLES
    if decays is not None:  # an output that does not respond within the sample responds one sample after the delay
        most = max(0, find_response_onset(data.train, decays, MAX_DELAY_SAMPLES) - (sensor != "acceleration"))

    def look(records: Sequence[Record], d: int) -> InitialModels:
        return estimate_first_poles(method, records, delay=d, decays=decays)

    if not scans:
        scans.append(scan_delays(data.train, look, orders=orders, most=most, progress=say, limit=limit))
    return choose_delay(
        data.train,
        look,
        kind=kind,
        least_gain=0.0 if decays is None else PULSE_GAIN,
        progress=say,
        scan=scans[0],
        limit=limit,
    )


@dataclass(frozen=True, eq=False)
class MethodCandidate:
    """The model that one method fitted to the training data.

    Attributes:
        method: `n4sid` or `pbsid`.
        kind: The criterion that its refinement minimises.
        late: Its delay.
        states: Its order, with the models of the trials.
    """

    method: str
    kind: str
    late: DelayChoice
    states: OrderChoice

    def simulation_errors(self, data: PreparedRecords) -> float:
        """Return the geometric mean of the outputs' simulation errors on the reserved quarter; infinite without a model."""
        if self.states.taken is None:
            return float("inf")
        return _mean_size(compute_residuals(self.states.taken.model, select_parts(data.train)[1], SIMULATED))

    def relative_error(self, data: PreparedRecords) -> float:
        """Return the same over the geometric mean of the outputs' standard deviations."""
        return self.simulation_errors(data) / _mean_size([r.y - r.y.mean(axis=0) for r in select_parts(data.train)[1]])


def _mean_size(errors: Sequence[np.ndarray]) -> float:
    """Return the geometric mean over columns of root mean squares; infinite if one diverges."""
    power = compute_mean_squares(errors)
    return float(np.exp(0.5 * np.mean(np.log(np.maximum(power, 1e-300))))) if np.isfinite(power).all() else np.inf


def check_candidate(candidate: MethodCandidate, data: PreparedRecords) -> Acausality:
    """Return whether the inputs follow the residuals of a candidate on the training data."""
    trial = candidate.states.taken
    if trial is None:
        return Acausality(1.0, 0.0)
    errors = compute_residuals(trial.model, data.train, SIMULATED)
    return find_acausality(errors, [delay_inputs(trial.model, r)[trial.model.delay :] for r in data.train], trial.model)


def settle(
    data: PreparedRecords, before: Feedback, plain: MethodCandidate, make: Callable[[], MethodCandidate | None]
) -> tuple[MethodCandidate, Feedback, str]:
    """Return the selected candidate, the result of the feedback tests, and the reason.

    Args:
        data: Training data.
        before: Result of the feedback test on the innovations, or a reference that was named.
        plain: The open-loop candidate.
        make: Builds the candidate that is consistent under feedback; None if the method gives no model.
    """
    found = check_candidate(plain, data)
    follows = found.p_value < ACAUSALITY_SIGNIFICANCE_LEVEL
    named = any(r.reference is not None for r in data.train)
    before = replace(before, detectable_loop_gain=found.detectable_gain)
    calm = replace(before, possible=found.p_value < POSSIBLE, p_value=found.p_value, share=found.share)
    if not (named or follows or before.suspected):
        return plain, calm, f"{calm.why}, so n4sid{_describe_limit(found.detectable_gain)}"
    other = make()
    ratio = np.inf if other is None else other.simulation_errors(data) / plain.simulation_errors(data)
    first = data.train[0]
    why = before.why
    if follows and not named:
        why = (
            f"input '{first.inputs[found.input]}' follows what a causal model leaves of '{first.outputs[found.output]}' "
            f"(p = {found.p_value:.1g})"
        )
    closed = replace(before, suspected=True, possible=True, p_value=min(found.p_value, before.p_value), why=why)
    if other is not None and ratio <= WORST_RATIO:
        who = closed.input or ("" if named else first.inputs[found.input])
        closed = replace(closed, share=max(found.share, before.share), input=who)
        return other, closed, f"{why}, so pbsid, which allows feedback"
    lost = (
        "pbsid gives no model" if other is None else f"pbsid leaves {ratio:.3g} times the error of n4sid in simulation"
    )
    if named or follows:
        return plain, closed, f"{why}, but {lost}, so n4sid; standard errors allow for the loop"
    text = "no input follows what a causal model leaves of the outputs"
    return plain, replace(calm, suspected=False, input="", why=text), f"{text}, and {lost}, so n4sid"


def _describe_limit(gain: float) -> str:
    """Return the detection limit of the acausality test (loop gain), as the end of a sentence."""
    if np.isnan(gain):
        return ""
    if gain > MAX_LOOP_GAIN:
        return "; a loop of any usual gain could stay unseen in this record"
    return f"; a loop gain below {gain:.2g} may stay unseen"


def choose_error_kind(
    plain: MethodCandidate, data: PreparedRecords, make: Callable[[], MethodCandidate | None]
) -> tuple[MethodCandidate, str]:
    """Return the candidate that simulates the reserved quarter better, and why if it is not the given one.

    If disturbances are large and coloured, a model that minimises one-step prediction errors, which includes a
    disturbance model, may simulate better than one that minimises simulation errors (Ljung 1999, 8.5).

    Args:
        plain: The candidate that minimises simulation errors.
        data: Training data.
        make: Builds one that minimises prediction errors; None if there is no model.
    """
    if plain.kind != SIMULATED or data.kind == "impulse" or plain.relative_error(data) < MIN_RELATIVE_ERROR:
        return plain, ""
    other = make()
    ratio = np.inf if other is None else other.simulation_errors(data) / plain.simulation_errors(data)
    if other is None or ratio > MAX_ERROR_RATIO:
        return plain, ""
    return other, f"; minimising prediction errors leaves {ratio:.2g} times the error in simulation, so it is minimised"


def _refine_best(
    data: PreparedRecords, best: MethodCandidate, limit: TimeLimit, *, alone: bool
) -> tuple[RefinedModel, str]:
    """Return the most likely model of the order and its method; further starts are tried if one does not converge."""
    method, delay, order, taken = best.method, best.late.delay, best.states.order, best.states.taken

    def begin(name: str) -> StateSpace:
        return build_initial_estimator(name, data.train, delay=delay, highest=order)(order)

    if taken is not None and taken.plain:
        made = refine(begin(method), data.train, kind=best.kind, maximum_rounds=0)
        if _is_sound(made):
            return made, f"{method} alone: refinement made the simulation of other data worse"
    rounds = _count_rounds(data, order)
    starts = [] if taken is None else [(method, lambda: taken.model)]
    if taken is None or rounds > FEW_ROUNDS:
        alone = alone or best.kind == PREDICTED or rounds == FEW_ROUNDS
        names = (method,) if alone else dict.fromkeys((method, "n4sid", "arx"))
        # a refined trial has the same start as its method
        starts += [(name, partial(begin, name)) for name in names if taken is None or alone or name != method]
    found: list[tuple[float, str, RefinedModel]] = []
    fault: Exception | None = None
    for name, start in starts:
        if found and limit.is_over("refinement from other first models"):
            break
        try:
            made = refine(
                start(),
                data.train,
                kind=best.kind,
                maximum_rounds=rounds,
                stop=lambda: limit.is_over("more rounds of refinement"),
            )
        except (TauDynError, np.linalg.LinAlgError) as failed:
            fault = failed
            continue
        if _is_sound(made):
            found.append((made.loss, name, made))
            if made.converged:
                break
    if not found:
        if isinstance(fault, InputError):
            raise fault
        raise CannotAnswer(
            "no_solution",
            f"no stable model of order {order} follows from these data",
            "a longer log, or a lower --order",
        )
    _, name, made = min(found, key=lambda row: row[0])
    what = "simulation" if best.kind == SIMULATED else "one-step predictions"
    ended = "converged" if made.converged else "stopped before it converged"
    return made, f"the error of {what} was minimised from {name}; it {ended} after {count(made.rounds, 'round')}"


def _is_sound(made: RefinedModel) -> bool:
    return made.model.spectral_radius() < 1 and bool(np.isfinite(made.loss))


def _count_rounds(data: PreparedRecords, order: int) -> int:
    """Return the maximum number of refinement steps for a model."""
    width = data.train[0].u.shape[1] + data.train[0].y.shape[1]
    return FEW_ROUNDS if data.kind == "impulse" or order * width > MANY_NUMBERS else MAX_ROUNDS


def _refit(
    refined: RefinedModel, data: PreparedRecords, best: MethodCandidate, limit: TimeLimit
) -> tuple[RefinedModel, str]:
    """Return the model fitted to all data, including held-out data, and a description; the given one if that fails."""
    if not data.whole or not data.holdout:
        return refined, "no order was left to add"
    if limit.is_over("a fit to all data"):
        return refined, "the model is that of the training data"
    plain = best.states.taken is not None and best.states.taken.plain
    rounds = 0 if plain else _count_rounds(data, refined.model.order)
    try:
        final = refine(refined.model, data.whole, kind=best.kind, maximum_rounds=rounds)
    except (TauDynError, np.linalg.LinAlgError):
        final = None
    if final is None or not _is_sound(final):
        return refined, "a fit to all data failed"
    return final, "the model was then fitted to all data; the held-out fit is that of the model of the training data"


def _widen(
    final: RefinedModel,
    refined: RefinedModel,
    data: PreparedRecords,
    best: MethodCandidate,
    feedback: Feedback,
    limit: TimeLimit,
) -> RefinedModel:
    """Return the model with standard errors that allow for missing modes, and for feedback if it is possible."""
    pairs, taken = [], best.states.taken
    if taken is not None:
        others = [
            t for t in best.states.refined if 0 < abs(t.order - taken.order) <= NEIGHBOURS and t.behind <= TOLERANCE
        ]
        pairs = [(taken.modes, t.modes) for t in others]
    alone = "standard errors that allow for feedback"
    if feedback.possible and best.kind == SIMULATED and not limit.is_over(alone):
        try:
            pairs.append((refined.modes, refine_predictor(refined, data.train).modes))
        except (TauDynError, np.linalg.LinAlgError):
            pass
    return replace(final, modes=widen_modes(final.modes, pairs))
