"""What every channel goes through after its search: confirmation, the waterfall, findings, and what a page draws.

`select_confirmed` and `select_supported` set the status of a cause: `confirmed`, or `suspected` with the reason.

Forces, tool positions and deflections differ in how their channel is built and in what is said about them; the stages here are
the same for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.diagnose.candidate_scan import N_NULL_DRAWS, get_columns
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.companions import find_companion
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.data_split import EVERY, TEST, TRAIN, VALIDATION
from tau_dyn.diagnose.extended_fit import (
    EvaluatedFit,
    build_extended_regression,
    compute_gain,
    evaluate_fit,
    fit_extended_model,
    restrict_to_parts,
    solve_with_fallback,
)
from tau_dyn.diagnose.findings import build_finding, build_signature
from tau_dyn.diagnose.floor import estimate_noise_floor
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL
from tau_dyn.diagnose.plausibility import (
    find_edge,
    find_implausible,
    find_inconsistent,
    is_distinct_from_zero,
    measure_friction,
    widen_scales,
)
from tau_dyn.diagnose.result import (
    Choice,
    Diagnosis,
    Finding,
    Gain,
    Limit,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
    Verdict,
)
from tau_dyn.diagnose.stepwise_selection import SelectedCause, StepwiseSelection, build_effects
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.estimate import PhysicalConstraints
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters

MIN_AMPLITUDE_Z = 2.0
"""Standard errors that the amplitudes of a claimed cause must be off zero in the extended model, all in one Wald test."""
MAX_RELATIVE_RMS_INCREASE = 0.005
"""By how much a cause may raise the error on the confirmation part; a weak one changes it by less, either way."""
_NOT_SHOWN = "held-out data do not show it"
_SILENT = "held-out data cannot show it"
_WORSE = "held-out data are predicted worse with it"
_ZERO = "no amplitude of it is distinct from zero beside the other causes"
_VETO = "the last part of the data does not show it"
_NO_GAIN = "its gain is not above zero (95 % interval {:.2g} to {:.2g} %)"
HELD_OUT = "the blocks of the held-out {what} alternate: half are validation data, half are test data"
SHARED = "the blocks of the {what} alternate: 60 % training, 20 % validation and 20 % test data"


@dataclass(frozen=True, eq=False)
class Claims:
    """The causes found, and why some of them are not confirmed.

    Attributes:
        found: Causes in the order found.
        why_not: For each the reason why it is not confirmed, in words; empty where it is.
        tests: For each what the confirmation part says.
    """

    found: tuple[SelectedCause, ...]
    why_not: tuple[str, ...]
    tests: tuple[Confirmation, ...]

    @property
    def kept(self) -> list[SelectedCause]:
        """The causes that stand so far."""
        return [one for one, why in zip(self.found, self.why_not, strict=True) if not why]

    def judge(self, k: int, why_not: str) -> Claims:
        """Return the claims with another reason for one of them."""
        return replace(self, why_not=(*self.why_not[:k], why_not, *self.why_not[k + 1 :]))

    def reject_all(self, why_not: str) -> Claims:
        """Return the claims with one reason for all that stood."""
        return replace(self, why_not=tuple(why or why_not for why in self.why_not))

    def replace_found(self, one: SelectedCause, other: SelectedCause) -> Claims:
        """Return the claims with a cause in another's place."""
        return replace(self, found=tuple(other if x is one else x for x in self.found))


class Waterfall(NamedTuple):
    """The waterfall: its steps, the values before any fit, the fits, and each cause's gain over the bar before it."""

    steps: list[Step]
    judgements: list[EvaluatedFit]
    gains: list[Gain]
    nominal: EvaluatedFit | None = None


def confirm_cause(channel: Channel, hunt: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Test one cause on the confirmation part, the others accounted for."""
    effects, others = (get_columns(hunt.library, x) for x in (one.candidate.effects, hunt.others(one)))
    return confirm(channel, hunt.noise, effects, others)


def select_confirmed(
    channel: Channel,
    hunt: StepwiseSelection,
    tests: Sequence[Confirmation],
    *,
    physics: PhysicalConstraints | None = None,
) -> Claims:
    """Return the causes that the held-out part shows and that do not make its prediction worse.

    A cause may be there and yet, with many amplitudes from a short log, predict badly where the training part never was.
    """
    claims = Claims(hunt.found, tuple(_NOT_SHOWN if not t.is_inconclusive else _SILENT for t in tests), tuple(tests))
    before = _missed(channel, (), physics) if any(test.is_confirmed for test in tests) else 0.0
    for k, test in enumerate(tests):
        if test.is_confirmed:
            after = _missed(channel, [*claims.kept, hunt.found[k]], physics)
            better = after <= (1 + MAX_RELATIVE_RMS_INCREASE) * before
            claims = claims.judge(k, "" if better else _WORSE)
            before = after if better else before
    return claims


def _missed(channel: Channel, found: Sequence[SelectedCause], physics: PhysicalConstraints | None) -> float:
    """Return the rms on the confirmation part, outputs by their own size, of a fit of the training part."""
    regression = build_extended_regression(channel, build_effects(found))
    theta = solve_with_fallback(restrict_to_parts(regression, channel, TRAIN), physics).theta
    masks = channel.masks(VALIDATION)
    shares = []
    for k in range(len(channel.outputs)):
        e, y = (
            np.concatenate([x[m[:, k], k] for x, m in zip(values, masks, strict=True)])
            for values in (regression.residuals(theta), channel.target)
        )
        shares.append(float(np.sum(e**2)) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300) if len(y) else 0.0)
    return float(np.sqrt(np.sum(shares)))


def build_waterfall(
    channel: Channel,
    hunt: StepwiseSelection,
    kept: Sequence[SelectedCause],
    rng: np.random.Generator,
    *,
    nominal: np.ndarray | None = None,
    physics: PhysicalConstraints | None = None,
) -> Waterfall:
    """Fit and judge the baseline, then with one cause more each time.

    Args:
        channel: The data.
        hunt: The search.
        kept: Confirmed causes in the order found.
        rng: For intervals.
        nominal: The baseline's values before any fit (p,); by default its parameters' own.
        physics: What makes the baseline's values physical.
    """
    values = channel.parameters.values if nominal is None else nominal
    first = evaluate_fit(channel, build_extended_regression(channel, ()), values, None, rng)
    steps = [Step("nominal", first.errors)]
    judgements = [fit_extended_model(channel, (), physics, rng)]
    steps.append(Step("refitted", judgements[0].errors))
    gains = []
    for k, one in enumerate(kept):
        judgements.append(fit_extended_model(channel, build_effects(kept[: k + 1]), physics, rng))
        joints = sorted({j for e in one.candidate.effects for j in e.joints}, key=channel.scene.joints.index)
        steps.append(Step(f"{one.candidate.cause} {' '.join(joints)}", judgements[-1].errors))
        own, before = (get_columns(hunt.library, build_effects(x)) for x in ([one], kept[:k]))
        shown = confirm(channel, hunt.noise, own, before, TEST, fitted_on=(TRAIN, VALIDATION))
        gains.append(compute_gain(channel, judgements[-2].residuals, judgements[-1].residuals, joints, rng, shown))
    return Waterfall(steps, judgements, gains, first)


def select_supported(
    channel: Channel,
    hunt: StepwiseSelection,
    claims: Claims,
    rng: np.random.Generator,
    *,
    nominal: np.ndarray | None = None,
    physics: PhysicalConstraints | None = None,
) -> tuple[Claims, Waterfall]:
    """Return the claims that all rules for a confirmed cause let stand, and their bars.

    A confirmed cause has an amplitude distinct from zero, within its plausible range, with settings off the edges of what was
    searched; the last part shows some of it, and the error of its own joints falls there with the 95 % interval above zero. A
    joint of several that becomes significantly worse is dropped, and the others stay. The last part has a veto and no vote. Rules
    that look at one cause alone come first, as what they turn down may be what makes another one worse.
    """
    while True:
        bars = build_waterfall(channel, hunt, claims.kept, rng, nominal=nominal, physics=physics)
        judged_again = _reject_by_amplitude(channel, hunt, claims, bars)
        if judged_again is claims:
            judged_again = _reject_companion(channel, hunt, claims, bars)
        if judged_again is claims:
            judged_again = _drop_worse_joints(channel, claims, bars, rng)
        if judged_again is claims:
            judged_again = _reject_without_gain(claims, bars)
        if judged_again is claims:
            return claims, bars
        claims = judged_again


def _reject_by_amplitude(channel: Channel, hunt: StepwiseSelection, claims: Claims, bars: Waterfall) -> Claims:
    """Reject what is not distinct from zero, implausible, at an edge, or not shown by the last part; all at once."""
    values, before = get_fitted_parameters(bars.judgements[-1]), get_fitted_parameters(bars.judgements[0])
    estimate, scene, kept = bars.judgements[-1].estimate, channel.scene, claims.kept
    assert estimate is not None  # only the nominal bar has none
    scales = scene.scales
    if scales:
        scales = widen_scales(scales, measure_friction(values, scene), measure_friction(before, scene))
    for k, one in enumerate(claims.found):
        if claims.why_not[k]:
            continue
        effects = one.candidate.effects
        why = "" if is_distinct_from_zero(effects, estimate, MIN_AMPLITUDE_Z) else _ZERO
        why = why or find_implausible(effects, values, scales) or find_edge(effects, scene)
        why = why or find_inconsistent(effects, values, scene.step_s)
        if not why and not _borne_out(channel, hunt, claims.tests[k], kept, one):
            why = _VETO
        claims = claims.judge(k, why) if why else claims
    return claims


def _borne_out(
    channel: Channel, hunt: StepwiseSelection, test: Confirmation, kept: Sequence[SelectedCause], one: SelectedCause
) -> bool:
    """Tell whether the last part shows some of a cause, beside the others kept."""
    effects, others = one.candidate.effects, build_effects([other for other in kept if other is not one])
    own, beside = (get_columns(hunt.library, x) for x in (effects, others))
    return test.within or confirm(channel, hunt.noise, own, beside, TEST).share > 0


def _reject_companion(channel: Channel, hunt: StepwiseSelection, claims: Claims, bars: Waterfall) -> Claims:
    """Reject a cause that may only be the inexactness of another one's law."""
    kept = claims.kept
    found = find_companion(channel, hunt.library, kept, get_fitted_parameters(bars.judgements[-1]))
    return claims.judge(claims.found.index(kept[found[0]]), found[1]) if found else claims


def _drop_worse_joints(channel: Channel, claims: Claims, bars: Waterfall, rng: np.random.Generator) -> Claims:
    """Drop, of causes on several joints, those joints whose error grows significantly by the cause on them."""
    for n, one in enumerate(claims.kept):
        fits = one.candidate.fits
        before, after = (bars.judgements[n + k].residuals for k in (0, 1))
        gains = [compute_gain(channel, before, after, fit.effect.joints, rng) for fit in fits]
        left = tuple(fit for fit, gain in zip(fits, gains, strict=True) if not is_worse(gain))
        if 0 < len(left) < len(fits):
            return claims.replace_found(one, replace(one, candidate=replace(one.candidate, fits=left)))
    return claims


def is_worse(gain: Gain) -> bool:
    """Return whether an error grows significantly, and by more than is worth a word."""
    return gain.ci95[1] < 0 and gain.reduction_percent < -100 * MAX_RELATIVE_RMS_INCREASE


def _reject_without_gain(claims: Claims, bars: Waterfall) -> Claims:
    """Reject the cause with the lowest gain where its interval is not above zero."""
    low = [gain.ci95[0] for gain in bars.gains]
    if not low or min(low) > 0:
        return claims
    n = int(np.argmin(low))
    why = _NO_GAIN.format(*bars.gains[n].ci95)
    return claims.judge(claims.found.index(claims.kept[n]), why)


def build_findings(
    channel: Channel,
    hunt: StepwiseSelection,
    claims: Claims,
    bars: Waterfall,
    rng: np.random.Generator,
) -> list[Finding]:
    """Return what is said of every cause found, confirmed or not."""
    found, kept = [], claims.kept
    hunt = replace(hunt, found=claims.found)
    for one, test, why_not in zip(claims.found, claims.tests, claims.why_not, strict=True):
        effects, fit, gain = one.candidate.effects, bars.judgements[-1], None
        if not why_not:
            gain = bars.gains[kept.index(one)]
        else:
            fit = fit_extended_model(channel, [*build_effects(kept), *effects], None, rng)
        names = {n for e in effects for n in e.parameters.names}
        values = Parameters([p for p in get_fitted_parameters(fit) if p.name in names])
        signature = build_signature(channel, effects, fit.residuals, values)
        finding = build_finding(channel, hunt, one, test, values, gain, signature, kept=not why_not)
        found.append(replace(finding, why_not_confirmed=why_not))
    return found


def build_extended_model(model: Model, fit: EvaluatedFit, effects: Sequence[Effect]) -> Model:
    """Return a model with further effects and all values that the fit has; what belongs to the recording stays out."""
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    values = get_fitted_parameters(fit)
    return extended.with_parameters(
        Parameters([values[p.name] if p.name in values else p for p in extended.parameters])
    )


def _with_finding_errors(model: Model, findings: Sequence[Finding]) -> Model:
    """Return the model with its findings' standard errors, which count the settings' uncertainty: a parameter has one."""
    own = {p.name: p.stderr for f in findings if f.status == "confirmed" for p in f.parameters}
    return model.with_parameters(
        Parameters(replace(p, stderr=own[p.name]) if own.get(p.name) else p for p in model.parameters)
    )


def get_fitted_parameters(fit: EvaluatedFit) -> Parameters:
    """Return a fit's parameters."""
    assert fit.estimate is not None  # only the nominal bar has none
    return fit.estimate.parameters


def get_sort_key(finding: Finding) -> tuple[bool, bool, float]:
    """Order findings: confirmed ones first, by how much they take off the held-out error; the rest by score."""
    gain = finding.gain
    worth = finding.score if gain is None else gain.rms_before**2 - gain.rms_after**2
    return finding.status == "parameter", finding.status == "suspected", -worth


def build_time_traces(channel: Channel, before: EvaluatedFit, after: EvaluatedFit) -> tuple[TimeTrace, ...]:
    """Return what the time view draws."""
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def measure_part_durations(channel: Channel) -> tuple[float, float, float]:
    """Return how long each part is [s]."""
    steps = [float(np.median(np.diff(run.t))) if len(run.t) > 1 else 0.0 for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == which)) for dt, part in zip(steps, channel.parts, strict=True)) for which in EVERY
    )
    return one, two, three


@dataclass(frozen=True, eq=False)
class Answer:
    """What a channel says of its data in its own words; see `Diagnosis`."""

    verdict: Verdict
    sentence: str
    how: str
    findings: Sequence[Finding]
    unexplained: tuple[Unexplained, ...] = ()
    limits: tuple[Limit, ...] = ()
    untestable: tuple[Untestable, ...] = ()
    experiment: str = ""
    warnings: Sequence[str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


def build_diagnosis(
    channel: Channel,
    hunt: StepwiseSelection,
    claims: Claims,
    bars: Waterfall,
    model: Model,
    answer: Answer,
    seed: int,
    recommendation: tuple[Choice, str, Sequence[str]],
) -> Diagnosis:
    """Put a diagnosis together from its stages.

    Args:
        channel: The data.
        hunt: The search.
        claims: What stands of it.
        bars: Its waterfall.
        model: The model before any fit.
        answer: What is said.
        seed: Seed of whatever was random.
        recommendation: Which model to use, why, and what to warn of.
    """
    before, after = bars.judgements[0], bars.judgements[-1]
    floor = estimate_noise_floor(channel, after, np.random.default_rng(seed))
    extended = build_extended_model(model, after, [e for e in build_effects(claims.kept) if e.name in EFFECTS])
    return Diagnosis(
        verdict=answer.verdict,
        sentence=answer.sentence,
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=before.errors,
        extended=after.errors,
        noise_floor=floor,
        waterfall=(*bars.steps, Step("noise_floor", floor)),
        findings=tuple(sorted(answer.findings, key=get_sort_key)),
        unexplained=answer.unexplained,
        limits=tuple(dict.fromkeys(answer.limits)),
        untestable=tuple(dict.fromkeys(answer.untestable)),
        model=build_extended_model(model, before, ()),
        extended_model=_with_finding_errors(extended, answer.findings),
        traces=build_time_traces(channel, before, after),
        n_parts=measure_part_durations(channel),
        how=answer.how,
        warnings=tuple(dict.fromkeys((*answer.warnings, *recommendation[2]))),
        seed=seed,
        experiment=answer.experiment,
        recommendation=recommendation[0],
        recommendation_why=recommendation[1],
        settings={
            **answer.settings,
            "noise_draws": N_NULL_DRAWS,
            "family_level": FAMILY_LEVEL,
            "causes_tried": hunt.n_causes,
        },
    )
