"""Methods tried side by side: what each finds, whether a loop was closed, and which one the data bear out.

The open-loop method (`n4sid`) is tried first, and its residuals tell whether the inputs follow them (`feedback.py`). Where
that, an older trace of feedback (`feedback.py`) or a named reference says so, `pbsid` is tried too. Under feedback the error
of a simulation favours the open-loop method, which fits the disturbance too; so `pbsid` may lose a little, but not much: a
model that cannot simulate is no answer, whatever the reason for trying it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.modes.delay import DelayChoice
from tau_dyn.modes.feedback import Acausality, Feedback, find_acausality
from tau_dyn.modes.order import OrderChoice, select_parts
from tau_dyn.modes.record import PreparedRecords
from tau_dyn.modes.residuals import SIMULATED, compute_residuals
from tau_dyn.modes.state_space import delay_inputs

ACAUSALITY_SIGNIFICANCE_LEVEL = 1e-3
"""p-value of the acausality test below which a loop was closed: one false alarm in a thousand open-loop tests by design."""
POSSIBLE = 0.2
"""p-value below which feedback cannot be excluded, and standard errors allow for it."""
WORST_RATIO = 1.15
"""Simulation error of `pbsid` over that of `n4sid` up to which it is believed under feedback: an open-loop fit takes a share of
a disturbance that comes back through the input. A judgement, not calibrated by a study."""

MIN_RELATIVE_ERROR = 0.1
"""Simulation error over the outputs' size below which disturbances are too small for prediction errors to do better."""
MAX_ERROR_RATIO = 0.98
"""Simulation error of a fit of prediction errors over that of simulation errors up to which it is taken."""


@dataclass(frozen=True, eq=False)
class MethodCandidate:
    """What one method made of the training data.

    Attributes:
        method: `n4sid` or `pbsid`.
        kind: What its refinement minimises.
        late: Its delay.
        states: Its order, with the models of the trials.
    """

    method: str
    kind: str
    late: DelayChoice
    states: OrderChoice

    def simulation_errors(self, data: PreparedRecords) -> float:
        """Return the geometric mean over outputs of simulation errors on the quarter kept apart; infinite without a model."""
        trial = self.states.taken
        if trial is None:
            return float("inf")
        _, kept = select_parts(data.train)
        errors = compute_residuals(trial.model, kept, SIMULATED)
        power = _mean_power(errors)
        return float(np.exp(0.5 * np.mean(np.log(np.maximum(power, 1e-300))))) if np.isfinite(power).all() else np.inf

    def relative_error(self, data: PreparedRecords) -> float:
        """Return the same over the geometric mean of the outputs' standard deviations."""
        _, kept = select_parts(data.train)
        power = _mean_power([r.y - r.y.mean(axis=0) for r in kept])
        return self.simulation_errors(data) / float(np.exp(0.5 * np.mean(np.log(np.maximum(power, 1e-300)))))


def _mean_power(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Return each output's mean square (p,)."""
    return np.sum([np.sum(e**2, axis=0) for e in errors], axis=0) / sum(len(e) for e in errors)


def choose_error_kind(
    plain: MethodCandidate, data: PreparedRecords, make: Callable[[], MethodCandidate | None]
) -> tuple[MethodCandidate, str]:
    """Return the candidate whose model simulates the quarter kept apart better, and why where it is not the given one.

    Where disturbances are large and coloured, a model that minimises one-step prediction errors, which has a model of them, may
    simulate better than one that minimises simulation errors (Ljung 1999, 8.5).

    Args:
        plain: The candidate that minimises simulation errors.
        data: Training data.
        make: Makes one that minimises prediction errors; None where there is no model.
    """
    if plain.kind != SIMULATED or data.kind == "impulse" or plain.relative_error(data) < MIN_RELATIVE_ERROR:
        return plain, ""
    other = make()
    ratio = np.inf if other is None else other.simulation_errors(data) / plain.simulation_errors(data)
    if other is None or ratio > MAX_ERROR_RATIO:
        return plain, ""
    return other, f"; minimising prediction errors leaves {ratio:.2g} times the error in simulation, so it is minimised"


def check_candidate(candidate: MethodCandidate, data: PreparedRecords) -> Acausality:
    """Return whether the inputs follow what a candidate leaves of the training data."""
    trial = candidate.states.taken
    if trial is None:
        return Acausality(1.0, 0.0)
    errors = compute_residuals(trial.model, data.train, SIMULATED)
    return find_acausality(errors, [delay_inputs(trial.model, r)[trial.model.delay :] for r in data.train])


def settle(
    data: PreparedRecords, before: Feedback, plain: MethodCandidate, make: Callable[[], MethodCandidate | None]
) -> tuple[MethodCandidate, Feedback, str]:
    """Return the candidate to go on with, what is known of feedback, and why.

    Args:
        data: Training data.
        before: What the innovations say of feedback, or a reference that was named.
        plain: The open-loop candidate.
        make: Makes the candidate that bears feedback; None where the method gives no model.
    """
    found = check_candidate(plain, data)
    named = any(r.reference is not None for r in data.train)
    sure = named or found.p_value < ACAUSALITY_SIGNIFICANCE_LEVEL
    if not sure and not before.suspected:
        quiet = replace(before, possible=found.p_value < POSSIBLE, p_value=found.p_value, share=found.share)
        return plain, quiet, f"{quiet.why}, so n4sid"
    other = make()
    ratio = np.inf if other is None else other.simulation_errors(data) / plain.simulation_errors(data)
    first = data.train[0]
    why = before.why
    if not named and found.p_value < ACAUSALITY_SIGNIFICANCE_LEVEL:
        why = (
            f"input '{first.inputs[found.input]}' follows what a causal model leaves of '{first.outputs[found.output]}' "
            f"(p = {found.p_value:.1g})"
        )
    if other is not None and ratio <= WORST_RATIO:
        p = min(found.p_value, before.p_value)
        closed = replace(
            before, suspected=True, possible=True, p_value=p, share=max(found.share, before.share), why=why
        )
        closed = replace(closed, input=closed.input or ("" if named else first.inputs[found.input]))
        return other, closed, f"{why}, so pbsid, which bears feedback"
    lost = (
        "pbsid gives no model" if other is None else f"pbsid leaves {ratio:.3g} times the error of n4sid in simulation"
    )
    if sure:
        closed = replace(before, suspected=True, possible=True, p_value=min(found.p_value, before.p_value), why=why)
        return plain, closed, f"{why}, but {lost}, so n4sid; standard errors allow for the loop"
    calm = replace(
        before, suspected=False, possible=found.p_value < POSSIBLE, p_value=found.p_value, share=found.share, input=""
    )
    text = "no input follows what a causal model leaves of the outputs"
    return plain, replace(calm, why=text), f"{text}, and {lost}, so n4sid"
