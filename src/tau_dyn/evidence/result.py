"""Results of tested hypotheses: errors, gains, findings, detection limits, and their JSON form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.parameters import Parameter
from tau_dyn.results import Z95, Brief, to_plain

DIFFERENCE_LEVEL = 0.01
"""Significance level, over all comparisons together, at which recordings, units or values that should be equal are called
different."""

SINGLE_SET_LEVEL = 1e-8
"""Significance level of the statistic of one data set alone. No other data confirm it, so the level leaves room for errors of the
noise model, which make the p-values of a single set too small."""


@dataclass(frozen=True, eq=False)
class WholeErrors:
    """Errors without masks: reversals and rests included.

    Attributes:
        rms: Residual rms of each output (m,) [unit of the output].
        relative_error_percent: `100 norm(residual) / norm(measured)` over all outputs.
    """

    rms: np.ndarray
    relative_error_percent: float


@dataclass(frozen=True, eq=False)
class OutputErrors:
    """Errors of a model on the test data.

    Attributes:
        outputs: The measured quantities: joints' forces, joints' deflections, or the tool's axes.
        rms: Residual rms of each output (m,) [unit of the output].
        ci95: Its 95 % interval (m, 2), from blocks.
        relative_error_percent: `100 norm(residual) / norm(measured)` over all outputs.
        relative_ci95: Its 95 % interval, from blocks.
        all_samples: Rms of each output and relative error of the same stretches without masks; None if unknown.
        used_shares: Share of these stretches' samples that the masks leave, for each output; empty if not known.
    """

    outputs: tuple[str, ...]
    rms: np.ndarray
    ci95: np.ndarray
    relative_error_percent: float
    relative_ci95: tuple[float, float] = (float("nan"), float("nan"))
    all_samples: WholeErrors | None = None
    used_shares: tuple[float, ...] = ()

    @property
    def used_share(self) -> float:
        """Share of the samples of all outputs that the masks leave; by default all of them."""
        return float(np.mean(self.used_shares)) if self.used_shares else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        found = self._told(self.rms, self.relative_error_percent) | {"relative_ci95": list(self.relative_ci95)}
        if self.all_samples is None:
            return found
        return found | {
            "used_share": self.used_share,
            "used_share_per_joint": dict(zip(self.outputs, self.used_shares, strict=True)),
            "all_samples": self._told(self.all_samples.rms, self.all_samples.relative_error_percent),
        }

    def _told(self, rms: np.ndarray, percent: float) -> dict[str, Any]:
        rows = dict(zip(self.outputs, map(float, rms), strict=True))
        return {"rms_per_joint": rows, "relative_error_percent": percent}


@dataclass(frozen=True, eq=False)
class SearchBand:
    """Errors on the test data in the band in which causes are searched, if errors are reported in a narrower one.

    Attributes:
        cutoff_hz: Upper end of the band [Hz].
        baseline: Errors of the refitted model.
        extended: Errors of the extended model.
        noise_floor: Lower bound of the error of any model of these variables.
    """

    cutoff_hz: float
    baseline: OutputErrors
    extended: OutputErrors
    noise_floor: OutputErrors

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        errors = {key: getattr(self, key).to_dict() for key in ("baseline", "extended", "noise_floor")}
        return {"cutoff_hz": self.cutoff_hz} | errors


@dataclass(frozen=True, eq=False)
class Step:
    """One bar of the waterfall: `nominal`, `refitted`, a cause with its joints, or `noise_floor`."""

    step: str
    errors: OutputErrors

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        ci95 = dict(zip(self.errors.outputs, self.errors.ci95.tolist(), strict=True))
        return {"step": self.step, **self.errors.to_dict(), "ci95": ci95}


@dataclass(frozen=True)
class Gain:
    """Improvement by a cause on the test data.

    Attributes:
        rms_before: Rms over the cause's outputs without it [unit of the output]; for poses, the rms position error [m].
        rms_after: The same with it.
        reduction_percent: Reduction of the error [%]; for poses, of position and orientation, each divided by its noise.
        ci95: Its 95 % interval [%].
        p_value: Probability of so large a gain without an effect, by a paired test over poses; None for data in blocks.
        orientation_rms_before: Rms orientation error of poses without it [rad]; None if orientation is not predicted.
        orientation_rms_after: The same with it.
    """

    rms_before: float
    rms_after: float
    reduction_percent: float
    ci95: tuple[float, float]
    p_value: float | None = None
    orientation_rms_before: float | None = None
    orientation_rms_after: float | None = None

    def compute_score(self, n_numbers: int) -> float:
        """Return twice the gain in log-likelihood of a number of Gaussian values with a free variance."""
        return float(-2 * n_numbers * np.log(max(1 - self.reduction_percent / 100, 1e-300)))

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form; gains of poses have additional keys."""
        of_poses = ("p_value", "orientation_rms_before", "orientation_rms_after")
        return to_plain(self, leave_out=() if self.p_value is not None else of_poses)


Progress = Callable[[str], None]
Verdict = Literal["named", "nothing_found", "cannot_tell", "unexplained"]
Choice = Literal["extended", "refitted", "neither"]
Status = Literal["confirmed", "suspected", "parameter"]


@dataclass(frozen=True, eq=False)
class Signature(Brief):
    """A plot of a cause: the residual of one output against the relevant variable.

    Attributes:
        output: The joint or axis shown.
        x_label: Quantity on the horizontal axis with its unit, such as `speed of cart1 [m/s]`.
        y_label: Quantity on the vertical axis with its unit.
        x: Horizontal values of samples (n,), thinned to at most 2000.
        y: Residual of the model without this cause but with all others (n,).
        fitted: Contribution of the cause at each sample (n,).
    """

    output: str
    x_label: str
    y_label: str
    x: np.ndarray
    y: np.ndarray
    fitted: np.ndarray


@dataclass(frozen=True)
class Limit:
    """The smallest amplitude that is detected with 95 % power.

    Attributes:
        cause: Its name.
        amplitude: The amplitude at the joint where the cause is hardest to detect.
        unit: Its unit.
        phrase: The same in words.
        per_joint: The amplitude at each joint, if known.
    """

    cause: str
    amplitude: float
    unit: str
    phrase: str
    per_joint: tuple[tuple[str, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        found = to_plain(self, leave_out=("cause", "per_joint"))
        return found | {"per_joint": dict(self.per_joint)} if self.per_joint else found


@dataclass(frozen=True, eq=False)
class Finding(Brief):
    """A cause that the data show.

    Attributes:
        cause: Its name in the contract.
        joints: Joints it acts on.
        status: `confirmed` on held-out data, `suspected`, or `parameter` (a refit that differs from its trusted nominal value).
        score: Twice the gain in log-likelihood on the training data (for a move between two files, on the later one).
        p_value: p-value of the score on clean data, corrected for all causes and settings tried.
        parameters: Amplitudes and settings with their standard errors.
        gain: Its gain on the test data; None if the baseline's refit absorbs it.
        indistinguishable_from: Causes that these data do not separate from it.
        equation: The law in one line.
        sentence: The finding in one sentence.
        experiment: The experiment that separates it from indistinguishable causes; empty if there are no such causes.
        effects: The effects that extend the model; empty for `parameter`.
        signature: Its plot; None for `parameter`.
        channel: `force`, `tool`, `deflection`, `position` (of servo loops) or `pose`.
        confirmation: Share of the predicted effect that the held-out data show, with its standard error; 1 is the full effect.
        why_not_confirmed: The reason why it is only `suspected`; empty if it is confirmed.
        is_shown: Whether the validation data show it; a suspected cause that they show is a residual above the noise.
        detection_limit: The smallest amplitude that these data show with 95 % power; None for a rejected candidate.
        logs: Logs to which it applies; empty for all.
        dof: Degrees of freedom of the standard errors.
    """

    cause: str
    joints: tuple[str, ...]
    status: Status
    score: float
    p_value: float
    parameters: tuple[Parameter, ...]
    gain: Gain | None
    indistinguishable_from: tuple[str, ...]
    equation: str
    sentence: str
    experiment: str = ""
    effects: tuple[Effect, ...] = ()
    signature: Signature | None = None
    channel: str = "force"
    confirmation: tuple[float, float] | None = None
    why_not_confirmed: str = ""
    is_shown: bool = False
    detection_limit: Limit | None = None
    logs: tuple[str, ...] = ()
    dof: float = np.inf

    def reject(self, why: str) -> Finding:
        """Return the finding as suspected, with the reason; an already suspected finding keeps its reason."""
        return replace(self, status="suspected", why_not_confirmed=self.why_not_confirmed or why)

    @property
    def contradicts_noise(self) -> bool:
        """Whether a suspected cause is a residual above the noise: other data show it, or one set of data beyond doubt."""
        return self.status == "suspected" and (self.is_shown or self.p_value < SINGLE_SET_LEVEL)

    @property
    def rank(self) -> tuple[bool, bool, float]:
        """Sort key: confirmed findings first, by the reduction of the held-out error; the rest by score."""
        worth = self.score if self.gain is None else self.gain.rms_before**2 - self.gain.rms_after**2
        return self.status == "parameter", self.status == "suspected", -worth

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        shown = self.confirmation and dict(zip(("share", "stderr"), self.confirmation, strict=True))
        changed = {"why_not_confirmed": self.why_not_confirmed or None, "confirmation": shown}
        times = Z95 if np.isinf(self.dof) else float(stats.t.ppf(0.975, self.dof))
        changed["parameters"] = [_row(p, times) for p in self.parameters]
        return to_plain(self, leave_out=("effects", "signature", "is_shown", "dof")) | changed


@dataclass(frozen=True, eq=False)
class Unexplained:
    """Structure in the residual that no named cause explains.

    Attributes:
        joint: The joint whose force shows it.
        depends_on: Variables it depends on, such as `v_cart1`, `q_cart2`, `t`.
        share_of_residual_variance: Its share of the residual's variance, 0 to 1.
        suggested_formula: A simple expression that fits, or empty.
        p_value: Its p-value on clean data.
        signature: Its plot.
        status: `confirmed` on held-out data or `suspected`.
        indistinguishable_from: Other sets of variables that explain it as well.
    """

    joint: str
    depends_on: tuple[str, ...]
    share_of_residual_variance: float
    suggested_formula: str
    p_value: float
    status: Status
    signature: Signature | None = None
    indistinguishable_from: tuple[tuple[str, ...], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        return to_plain(self, leave_out=("signature",)) | {"suggested_formula": self.suggested_formula or None}


@dataclass(frozen=True)
class Untestable:
    """A cause that these logs cannot show, the reason, and the experiment that would show it."""

    cause: str
    why: str
    experiment: str


@dataclass(frozen=True, eq=False)
class TimeTrace(Brief):
    """One run for the time view, all at the regression's rate.

    Attributes:
        log: The log's name.
        t: Time (n,) [s].
        measured: Measured outputs (n, m).
        before: Prediction of the refitted baseline (n, m).
        after: Prediction of the extended model (n, m).
        usable: Samples that are used (n, m).
        part: 0 training, 1 validation, 2 test, -1 unused (n,).
    """

    log: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    usable: np.ndarray
    part: np.ndarray


def _row(p: Parameter, times: float) -> dict[str, Any]:
    ci95 = None if p.stderr is None else [p.value - times * p.stderr, p.value + times * p.stderr]
    return {"name": p.name, "value": p.value, "unit": p.unit, "stderr": p.stderr, "ci95": ci95}
