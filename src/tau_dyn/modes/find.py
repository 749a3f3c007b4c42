"""Resonances from vibration logs: one call from columns of a log to modes with uncertainty, a model, and how far to trust it.

The steps, each in its own file: `record.py` (what is used), `feedback.py` (which methods are valid), `delay.py`,
`order.py`, `methods.py` (a first model), `refine.py` (the most likely one), `judge.py` (fit, tests, spectra). Each
leaves a sentence in `why`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.log import Log
from tau_dyn.modes.contest import MethodCandidate, choose_error_kind, settle
from tau_dyn.modes.delay import MAX_DELAY_SAMPLES, ORDERS, DelayChoice, choose_delay, find_response_onset
from tau_dyn.modes.feedback import Feedback, detect_feedback
from tau_dyn.modes.methods import METHODS, build_initial_estimator, decompose_pulse_tests, estimate_first_poles
from tau_dyn.modes.modal import widen_modes
from tau_dyn.modes.order import MANY_NUMBERS, TOLERANCE, OrderChoice, choose_order
from tau_dyn.modes.record import PreparedRecords, prepare_records
from tau_dyn.modes.refinement import RefinedModel, refine, refine_predictor
from tau_dyn.modes.residuals import PREDICTED, SIMULATED
from tau_dyn.modes.result import Modes
from tau_dyn.modes.validation import validate_model

MAX_REQUESTED_ORDER = 200  # states; a dense model of more takes minutes and tells noise
PULSE_GAIN = 0.1
"""Share by which a delay must lower what pulse tests leave, to be believed."""
MAX_LARGE_MODEL_ITERATIONS = 15
"""Rounds of refinement for models of many free numbers; they begin at a trial that was refined."""
NEIGHBOURS = 4
"""States by which a model may differ, whose modes standard errors have to allow for if it simulates as well."""
PULSE_ROUNDS = 15
"""Rounds of refinement for pulse tests, which can hold more modes than a model and then creep."""
Progress = Callable[[str], None]


def find_modes(
    logs: Log | Sequence[Log],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    holdout: Log | Sequence[Log] = (),
    references: Sequence[str] = (),
    method: str = "auto",
    order: str | int = "auto",
    delay: str | int = "auto",
    sensor: str = "displacement",
    collocated: Sequence[tuple[str, str]] = (),
    seed: int = 0,
    progress: Progress | None = None,
) -> Modes:
    """Identify resonances, a black-box model, and mass, damping and stiffness where the data hold them.

    Args:
        logs: Logs to fit on; never joined.
        inputs: Columns that excite.
        outputs: Columns that respond.
        holdout: Logs to judge on; the last 30 % of every log where none are given.
        references: Columns that a feedback loop was asked to follow.
        method: `auto`, `n4sid`, `pbsid`, `arx` or `era`.
        order: `auto` or a number of states.
        delay: `auto` or a number of samples.
        sensor: What the outputs are: `displacement`, `velocity` or `acceleration`.
        collocated: Pairs of an input and an output at one place and in one direction; where none are given and there are
            as many outputs as inputs, each input and the output of its rank.
        seed: Kept with the result; nothing here is random.
        progress: Told what is done.

    Raises:
        InputError: A column, an option or the logs do not fit.
        CannotAnswer: The data are sound but too few, or no stable model follows from them.
    """
    say = progress or (lambda step: None)
    asked, fixed = _order(order), _delay(delay)
    if method not in ("auto", *METHODS):
        raise InputError("bad_option", f"--method {method}: there are auto, {', '.join(METHODS)}")
    places = _places(collocated, inputs, outputs)
    data = prepare_records(
        _several(logs), tuple(inputs), tuple(outputs), holdout=_several(holdout), references=tuple(references)
    )
    _refuse_costly(asked, data)
    say("looking for feedback")
    feedback = _feedback(data)
    chosen, why = _method(method, data, feedback)

    def candidate(name: str, kind: str = "") -> MethodCandidate:
        kind = kind or (PREDICTED if name == "pbsid" else SIMULATED)
        late = _late(data, name, kind, asked, fixed, sensor, say)
        start = partial(build_initial_estimator, name, delay=late.delay, highest=max(20, asked or 0))
        pulses = data.kind == "impulse"
        states = choose_order(data.train, start, kind=kind, asked=asked, pulses=pulses, progress=say)
        return MethodCandidate(name, kind, late, states)

    def trial(name: str) -> MethodCandidate | None:
        say(f"trying {name} with prediction errors")
        try:
            return candidate(name, PREDICTED)
        except (TauDynError, np.linalg.LinAlgError):
            return None

    best = candidate(chosen)
    if method == "auto" and data.kind != "impulse":
        best, feedback, why = settle(data, feedback, best, lambda: trial("pbsid"))
        best, more = choose_error_kind(best, data, lambda: trial("n4sid"))
        why += more
    late, states = best.late, best.states
    say(f"refining order {states.order}")
    refined, how = _refined(data, best.method, best.kind, late.delay, states, alone=method != "auto")
    say("fitting all data")
    final, whole = _refitted(refined, data, best, how)
    final = _widened(final, refined, data, best, feedback)
    say("judging")
    found = validate_model(refined, data, feedback, late, states, final=final, sensor=sensor, collocated=places)
    reasons = {"method": why, "delay": late.why, "order": states.why, "refinement": f"{how}; {whole}"}
    return replace(found, method=best.method, why=reasons, seed=seed)


def _refitted(
    refined: RefinedModel, data: PreparedRecords, best: MethodCandidate, how: str
) -> tuple[RefinedModel, str]:
    """Return the model fitted to all data, held-out ones included, and what was done; the one given where that fails."""
    if not data.whole or not data.holdout:
        return refined, "nothing was left to add"
    rounds = 0 if best.states.taken is not None and best.states.taken.plain else _rounds(data, refined.model.order)
    try:
        final = refine(refined.model, data.whole, kind=best.kind, maximum_rounds=rounds)
    except (TauDynError, np.linalg.LinAlgError):
        return refined, "a fit to all data failed"
    if final.model.spectral_radius() >= 1 or not np.isfinite(final.loss):
        return refined, "a fit to all data failed"
    return final, "the model was then fitted to all data; the held-out fit is that of the model of the training data"


def _widened(
    final: RefinedModel, refined: RefinedModel, data: PreparedRecords, best: MethodCandidate, feedback: Feedback
) -> RefinedModel:
    """Return the model with standard errors that allow for missing modes, and for feedback where it is possible."""
    taken = best.states.taken
    pairs = []
    if taken is not None:
        others = [
            t for t in best.states.refined if 0 < abs(t.order - taken.order) <= NEIGHBOURS and t.behind <= TOLERANCE
        ]
        pairs = [(taken.modes, t.modes) for t in others]
    if feedback.possible and best.kind == SIMULATED:
        try:
            other = refine_predictor(refined, data.train)
            pairs.append((refined.modes, other.modes))
        except (TauDynError, np.linalg.LinAlgError):
            pass
    return replace(final, modes=widen_modes(final.modes, pairs))


def _rounds(data: PreparedRecords, order: int) -> int:
    """Return how many rounds of refinement a model is given."""
    if data.kind == "impulse":
        return PULSE_ROUNDS
    return (
        MAX_LARGE_MODEL_ITERATIONS
        if order * sum(data.train[0].u.shape[1:] + data.train[0].y.shape[1:]) > MANY_NUMBERS
        else 40
    )


def _several(logs: Log | Sequence[Log]) -> list[Log]:
    return [logs] if isinstance(logs, Log) else list(logs)


def _places(
    pairs: Sequence[tuple[str, str]], inputs: Sequence[str], outputs: Sequence[str]
) -> list[tuple[int, int]] | None:
    """Return collocated pairs as numbers of columns; None where none were named."""
    for one, other in pairs:
        if one not in inputs or other not in outputs:
            raise InputError(
                "bad_option",
                f"--collocated {one}:{other}: write an input of {list(inputs)} and an output of {list(outputs)}",
            )
    return [(list(inputs).index(a), list(outputs).index(b)) for a, b in pairs] or None


def _order(order: str | int) -> int | None:
    """Return the order asked for, None for `auto`."""
    if order == "auto":
        return None
    try:
        value = int(order)
    except ValueError:
        value = 0
    if not 1 <= value <= MAX_REQUESTED_ORDER:
        raise InputError(
            "bad_option", f"--order {order}: write auto, or a number of states from 1 to {MAX_REQUESTED_ORDER}"
        )
    return value


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


def _delay(delay: str | int) -> int | None:
    """Return the delay asked for, None for `auto`."""
    if delay == "auto":
        return None
    try:
        value = int(delay)
    except ValueError:
        value = -1
    if not 0 <= value <= 10_000:
        raise InputError("bad_option", f"--delay {delay}: write auto, or a number of samples from 0 up")
    return value


def _feedback(data: PreparedRecords) -> Feedback:
    if data.kind == "impulse":
        return Feedback(False, 1.0, 0.0, "pulses answer to nothing")
    return detect_feedback(data.train)


def _method(method: str, data: PreparedRecords, feedback: Feedback) -> tuple[str, str]:
    """Return the method to begin with, and why."""
    if method == "era" and data.kind != "impulse":
        raise CannotAnswer(
            "poor_excitation",
            "era needs impulse tests, and these inputs are not short pulses followed by rest",
            "a hammer's blow and its decay, or another method for these data",
        )
    if method != "auto":
        bears = (
            ""
            if method == "pbsid" or not feedback.suspected
            else f", although {feedback.why}; its damping may be biased"
        )
        return method, f"{method} was asked for{bears}"
    if data.kind == "impulse":
        return "era", "the inputs are short pulses followed by free decay, so era"
    return "n4sid", f"{feedback.why}, so n4sid"


def _late(
    data: PreparedRecords, method: str, kind: str, asked: int | None, fixed: int | None, sensor: str, say: Progress
) -> DelayChoice:
    if fixed is not None:
        return DelayChoice(fixed, (), float("nan"), f"a delay of {fixed} samples was asked for")
    orders = ORDERS if asked is None else sorted({o for o in ORDERS if o < asked} | {min(asked, 20)})
    decays = decompose_pulse_tests(data.train, delay=MAX_DELAY_SAMPLES) if method == "era" else None
    most = MAX_DELAY_SAMPLES
    if decays is not None:  # what does not answer to a force within the sample, answers one sample after the delay
        most = max(0, find_response_onset(data.train, decays, MAX_DELAY_SAMPLES) - (sensor != "acceleration"))
    return choose_delay(
        data.train,
        lambda records, d: estimate_first_poles(method, records, delay=d, decays=decays),
        kind=kind,
        orders=orders,
        most=most,
        least_gain=0.0 if decays is None else PULSE_GAIN,
        progress=say,
    )


def _refined(
    data: PreparedRecords, method: str, kind: str, delay: int, states: OrderChoice, *, alone: bool
) -> tuple[RefinedModel, str]:
    """Return the most likely model of the order, and how it was had; further starts are tried where one does not converge."""
    order, taken = states.order, states.taken
    rounds = _rounds(data, order)
    if taken is not None and taken.plain:
        first = build_initial_estimator(method, data.train, delay=delay, highest=order)(order)
        made = refine(first, data.train, kind=kind, maximum_rounds=0)
        if made.model.spectral_radius() < 1 and np.isfinite(made.loss):
            return made, f"{method} alone: refinement made the simulation of other data worse"
    starts = [(method, lambda: taken.model)] if taken is not None else []
    alone = alone or kind == PREDICTED or data.kind == "impulse" or rounds == MAX_LARGE_MODEL_ITERATIONS
    names = (method,) if alone else tuple(dict.fromkeys((method, "n4sid", "arx")))
    if not (taken is not None and (data.kind == "impulse" or rounds == MAX_LARGE_MODEL_ITERATIONS)):
        starts += [
            (n, lambda n=n: build_initial_estimator(n, data.train, delay=delay, highest=order)(order)) for n in names
        ]
    found: list[tuple[float, str, RefinedModel]] = []
    fault: Exception | None = None
    for name, first in starts:
        try:
            made = refine(first(), data.train, kind=kind, maximum_rounds=rounds)
        except (TauDynError, np.linalg.LinAlgError) as failed:
            fault = failed
            continue
        if made.model.spectral_radius() < 1 and np.isfinite(made.loss):
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
    _, name, best = min(found, key=lambda row: row[0])
    what = "simulation" if kind == SIMULATED else "one-step predictions"
    ended = "converged" if best.converged else "stopped before it converged"
    return best, f"the error of {what} was minimised from {name}; it {ended} after {best.rounds} rounds"
