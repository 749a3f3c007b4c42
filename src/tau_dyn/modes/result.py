"""Results of `find_modes` and `find_operational_modes`: models, modes with uncertainty, and validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.modes.delay import DelayChoice
from tau_dyn.modes.feedback_tests import Feedback
from tau_dyn.modes.mechanical import Mechanical
from tau_dyn.modes.modal import Mode, Pole, StabilityPoint
from tau_dyn.modes.order import OrderChoice
from tau_dyn.modes.residuals import CorrelationTest, FitQuality
from tau_dyn.modes.responses import EmpiricalResponse, ImpulseResponses, Response
from tau_dyn.modes.state_space import ModelFile, StateSpace
from tau_dyn.results import Brief, PlottedResponse, Shown, plot_responses, plot_stability, to_plain
from tau_dyn.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_SILENT_FIT_PERCENT = 1.0
"""Fit, 2 % of the variance, that a model reaches by chance on noise in some hundred samples."""
NOT_IDENTIFIED: dict[str, Any] = {"status": "not_identifiable", **dict.fromkeys(("M", "D", "K", "stderr", "valid_hz"))}


@dataclass(frozen=True, eq=False)
class Trace(Brief):
    """One record, measured and simulated.

    Attributes:
        log: The log's name.
        t: (N,) [s] from the record's start.
        u: (N, m).
        measured: (N, p).
        simulated: (N, p).
        held_out: Whether the model was not fitted to it.
    """

    log: str
    t: np.ndarray
    u: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    held_out: bool


@dataclass(frozen=True)
class Nonlinearity:
    """Whether a structure responds nonlinearly.

    Attributes:
        suspected: Whether a power is significant and explains enough.
        p_value: p-value over all outputs and powers, under the hypothesis of a linear structure.
        share: Share of the residual's variance that the power explains.
        output: The output concerned.
        power: 2 if the response depends on its sign, 3 if on its size.
    """

    suspected: bool
    p_value: float
    share: float
    output: str
    power: int


@dataclass(frozen=True, eq=False)
class Modes(Shown):
    """The answer of `find_modes`.

    Attributes:
        inputs: Columns that excite.
        outputs: Columns that respond.
        dt: Sampling step [s].
        order: Number of states.
        delay: Whole samples by which the inputs act late, beyond the one that sampling itself adds.
        method: Method of the model, `n4sid`, `pbsid`, `arx` or `era`, and how it was refined.
        model: The refined model.
        modes: Oscillating modes, slowest first, with standard errors.
        poles: All poles, with the uncertainty of those that oscillate.
        zeros: Transmission zeros in the s plane [1/s]; empty unless there are as many outputs as inputs.
        train: Fit of the training records.
        holdout: Fit of the held-out records; None without held-out data.
        whiteness: Tests of the one-step errors.
        independence: Tests of the simulation residuals against the inputs.
        tested_on: `holdout` or `train`.
        feedback: Whether the inputs respond to the outputs.
        delay_choice: How the delay was chosen.
        order_choice: How the order was chosen.
        stabilisation: Modes of many orders.
        empirical: Response and coherence without a model.
        response: The model's response, with uncertainty.
        impulse: Impulse responses, measured and of the model.
        traces: Records, measured and simulated.
        nonlinearity: Whether the residuals are correlated with powers of the response; None if not tested.
        mechanical: Mass, damping and stiffness; None if not available, for the reason in `mechanical_why`.
        mechanical_why: Why `mechanical` is not available.
        kind: `driven` or `impulse`.
        how_held: Description of the held-out data.
        why: Decisions and their reasons: method, delay, order, refinement; sentences by topic.
        warnings: Doubts about the result, one sentence each.
        seed: Seed of the random numbers.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    order: int
    delay: int
    method: str
    model: StateSpace
    modes: tuple[Mode, ...]
    poles: tuple[Pole, ...]
    zeros: np.ndarray
    train: FitQuality
    holdout: FitQuality | None
    whiteness: tuple[CorrelationTest, ...]
    independence: tuple[CorrelationTest, ...]
    tested_on: str
    feedback: Feedback
    delay_choice: DelayChoice
    order_choice: OrderChoice
    stabilisation: tuple[StabilityPoint, ...]
    empirical: EmpiricalResponse
    response: Response
    impulse: ImpulseResponses | None
    traces: tuple[Trace, ...]
    nonlinearity: Nonlinearity | None
    mechanical: Mechanical | None
    mechanical_why: str
    kind: str
    how_held: str
    why: Mapping[str, str]
    warnings: tuple[str, ...] = ()
    seed: int = 0

    @property
    def judged(self) -> FitQuality:
        """The fit to be reported: of held-out data if there are any, else of training data."""
        return self.holdout or self.train

    @property
    def silent_outputs(self) -> tuple[str, ...]:
        """Outputs of which the inputs explain nothing, in training or held out, while others respond: dead sensors, cables."""
        best = np.maximum(self.judged.percent, self.train.percent)
        silent = [name for name, fit in zip(self.outputs, best, strict=True) if fit < MAX_SILENT_FIT_PERCENT]
        return tuple(silent) if len(silent) < len(self.outputs) else ()

    def plot(self) -> Figure:
        """Return a Matplotlib figure of the measured and the model's frequency responses with the modes.

        Raises:
            InputError: Matplotlib is not installed.
        """
        measured, model = self.empirical, self.response
        responses = [
            PlottedResponse("measured", measured.frequency, measured.response),
            PlottedResponse("model", model.frequency, model.value),
        ]
        return plot_responses(responses, self.outputs, self.inputs, [mode.frequency_hz for mode in self.modes])

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result."""
        mdk: dict[str, Any] = {"why": self.mechanical_why}
        if self.mechanical is not None:
            mdk = self.mechanical.to_dict() | {"units": "of the inputs per those of the outputs"}
        return {
            "order": self.order,
            "delay_samples": self.delay,
            "method": self.method,
            "dt": self.dt,
            "inputs_used": list(self.inputs),
            "outputs_used": list(self.outputs),
            "kind": self.kind,
            "held_out": self.how_held,
            "modes": [m.to_dict(self.outputs) for m in self.modes],
            "poles": [p.to_dict() for p in self.poles],
            "fit_percent": {
                "train": self.train.mean,
                "holdout": None if self.holdout is None else self.holdout.mean,
                "per_output": {
                    "train": self._per_output(self.train.percent),
                    "holdout": None if self.holdout is None else self._per_output(self.holdout.percent),
                },
                "ahead": {str(k): self._per_output(v) for k, v in self.judged.ahead.items()},
                "n_samples": {
                    "train": self.train.n_samples,
                    "holdout": 0 if self.holdout is None else self.holdout.n_samples,
                },
            },
            "residual_tests": {
                "on": self.tested_on,
                "whiteness": [t.to_dict() for t in self.whiteness],
                "input_correlation": [t.to_dict() for t in self.independence],
            },
            "nonlinearity": to_plain(self.nonlinearity),
            "mdk": NOT_IDENTIFIED | mdk,
            "feedback": to_plain(self.feedback, leave_out=("input",)),
            "delay_scan": self.delay_choice.to_dict(),
            "order_scan": self.order_choice.to_dict(),
            "stabilisation": to_plain(self.stabilisation),
            "why": dict(self.why),
            "model": self.model_dict(),
        }

    def model_dict(self) -> dict[str, Any]:
        """Return the state space model as plain lists, for files."""
        m = self.model
        matrices = {name: getattr(m, name).tolist() for name in ("A", "B", "C", "D", "K")}
        noise = None if m.noise is None else m.noise.tolist()
        return {"dt": m.dt, "delay": m.delay, **matrices, "noise": noise}

    def model_file(self, logs: Sequence[Mapping[str, str]]) -> ModelFile:
        """Return the model with its columns and provenance, ready to be written.

        Args:
            logs: Path and hash of every log.
        """
        made = {
            "method": self.method,
            "order": self.order,
            "fit_percent": {
                "train": self.train.mean,
                "holdout": None if self.holdout is None else self.holdout.mean,
            },
            "logs": [dict(log) for log in logs],
            "tau_dyn": __version__,
        }
        return ModelFile(self.model, self.inputs, self.outputs, made)

    def _per_output(self, values: Sequence[float] | np.ndarray) -> dict[str, float]:
        return {name: float(v) for name, v in zip(self.outputs, values, strict=True)}


REASON_WITHOUT_SCALE = (
    "the forces were not measured, so responses have no scale: modal masses, M, D, K and a model from input to output "
    "do not follow"
)


@dataclass(frozen=True, eq=False)
class OperationalModes(Shown):
    """The answer of `find_operational_modes`.

    Attributes:
        outputs: Columns that respond.
        dt: Sampling step [s].
        order: Highest order of model.
        modes: Modes of the structure, slowest first; shapes are relative to their largest output.
        stabilisation: Modes of all orders.
        n_samples: Samples used.
        warnings: Doubts about the result, one sentence each.
        seed: Kept with the result; the method is deterministic.
    """

    outputs: tuple[str, ...]
    dt: float
    order: int
    modes: tuple[Mode, ...]
    stabilisation: tuple[StabilityPoint, ...]
    n_samples: int
    warnings: tuple[str, ...] = ()
    seed: int = 0

    def plot(self) -> Figure:
        """Return a Matplotlib figure of the modes of all orders, the stabilisation diagram.

        Raises:
            InputError: Matplotlib is not installed.
        """
        points = self.stabilisation
        hz, order = np.array([x.frequency_hz for x in points]), np.array([x.order for x in points])
        is_stable = np.array([x.kind == "stable" for x in points], bool)
        return plot_stability(hz, order, is_stable, [mode.frequency_hz for mode in self.modes])

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result; quantities that responses alone cannot determine are null, with the reason."""
        return {
            "order": self.order,
            "delay_samples": None,
            "method": "ssi-cov",
            "dt": self.dt,
            "inputs_used": [],
            "outputs_used": list(self.outputs),
            "kind": "operational",
            "modes": [mode.to_dict(self.outputs) for mode in self.modes],
            "fit_percent": {"train": None, "holdout": None},
            "residual_tests": None,
            "mdk": NOT_IDENTIFIED | {"why": REASON_WITHOUT_SCALE},
            "stabilisation": to_plain(self.stabilisation),
            "n_samples": self.n_samples,
        }
