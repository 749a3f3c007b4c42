"""The result of `diagnose`, and its JSON form."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tau_dyn.estimate import Preparation
from tau_dyn.evidence.result import (
    Choice,
    Finding,
    Limit,
    OutputErrors,
    SearchBand,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
    Verdict,
)
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.results import PlottedSegment, Shown, plot_outputs, to_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Diagnosis(Shown):
    """The error of a simulation, its causes, and the improvement by them.

    Attributes:
        verdict: `named`, `nothing_found`, `cannot_tell` or `unexplained`.
        sentence: The answer in one or two sentences, for the top of the page.
        channel: `force`, `tool`, `deflection` or `position` (for servo loops).
        outputs: The measured quantities.
        units: Units of the outputs.
        baseline: Errors of the refitted model.
        extended: Errors of the extended model.
        noise_floor: Lower bound for any model of these variables.
        waterfall: Nominal, refitted, plus each cause in the order found, noise floor.
        findings: Strongest first.
        unexplained: Structure that no cause explains.
        limits: Detection limit of each cause.
        untestable: Causes that could not be tested, with the reason.
        model: The baseline, refitted.
        extended_model: The model with the confirmed causes; the baseline if no cause is confirmed.
        traces: The time view.
        n_parts: Seconds of usable training, validation and test data.
        how: How the data were divided, in words.
        warnings: Warnings, as sentences.
        seed: Seed of all random steps.
        experiment: The experiment that would resolve a verdict `cannot_tell`.
        recommendation: Which model to use: `extended`, `refitted`, or `neither`.
        recommendation_why: The reason, in a sentence.
        simulation: Closed-loop simulation compared with the measured log, before and after, if a controller was given.
        preparation: Filters and masks of forces; None for other channels.
        settings: Preparation of the data and calibration of the tests, for the page's foot.
        further: Keys that a channel adds to the JSON result.
        search_band: Errors of forces in the band in which causes are searched; None if all errors refer to that band.
    """

    verdict: Verdict
    sentence: str
    channel: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    baseline: OutputErrors
    extended: OutputErrors
    noise_floor: OutputErrors
    waterfall: tuple[Step, ...]
    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    limits: tuple[Limit, ...]
    untestable: tuple[Untestable, ...]
    model: Model
    extended_model: Model
    traces: tuple[TimeTrace, ...]
    n_parts: tuple[float, float, float]
    how: str
    warnings: tuple[str, ...]
    seed: int
    experiment: str = ""
    recommendation: Choice = "refitted"
    recommendation_why: str = ""
    simulation: Mapping[str, Any] | None = None
    preparation: Preparation | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    further: Mapping[str, Any] = field(default_factory=dict)
    search_band: SearchBand | None = None

    @property
    def exit_status(self) -> int:
        """3 for the verdict `cannot_tell`, otherwise 0."""
        return 3 if self.verdict == "cannot_tell" else 0

    def plot(self) -> Figure:
        """Return a Matplotlib figure of measured outputs, both models, and the residual of the extended one.

        Raises:
            InputError: Matplotlib is not installed.
        """
        curves = [
            PlottedSegment(one.log, one.t, one.measured, {"baseline": one.before, "extended": one.after}, one.usable)
            for one in self.traces
        ]
        return plot_outputs(curves, self.outputs, self.units)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result, without the entries that the command adds (version, inputs)."""
        told = {
            "seed": self.seed,
            "status": "cannot_answer" if self.verdict == "cannot_tell" else "ok",
            **format_warnings(self.warnings),
            "experiment": self.experiment or None,
            "detection_limits": {limit.cause: limit for limit in self.limits},
            "divided": {"how": self.how, "seconds": self.n_parts},
        }
        return to_plain(told | {key: getattr(self, key) for key in _TOLD} | dict(self.further))


_TOLD = (
    "verdict", "sentence", "channel", "recommendation", "recommendation_why", "baseline", "extended", "noise_floor",
    "waterfall", "findings", "unexplained", "untestable", "simulation", "settings", "search_band",
)  # fmt: skip
"""Fields of a diagnosis that are exported unchanged."""
