"""The status of each selected cause, its gain, and the recommended model.

A cause is `confirmed` if the validation data show it and are not predicted worse with it, if it is plausible and larger than
the inexactness of another cause's law, and if it improves the prediction of the test data; otherwise it is `suspected`, with
the reason. The extended model is recommended if the test error over all outputs decreases by more than the printed resolution,
with its 95 % interval above zero, and the error of no single output increases by more than `MAX_OUTPUT_LOSS_PERCENT`. Neither
model is recommended if the held-out logs are from another machine than the training logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.effects import Effect
from tau_dyn.estimate import PhysicalConstraints
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.confirmation import SIGNIFICANCE_LEVEL, Confirmation, confirm
from tau_dyn.evidence.extended_fit import (
    EvaluatedFit,
    build_extended_regression,
    compute_gain,
    evaluate_fit,
    fit_extended_model,
    restrict_to_parts,
    solve_with_fallback,
)
from tau_dyn.evidence.measurements import TEST, TRAIN, VALIDATION
from tau_dyn.evidence.plausibility import (
    Implausible,
    compute_least_forces,
    find_companion,
    find_implausible,
    find_inconsistent,
    is_distinct_from_zero,
    measure_friction,
    widen_scales,
)
from tau_dyn.evidence.result import Choice, Gain, Step
from tau_dyn.evidence.settings import find_edge
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection, build_effects
from tau_dyn.evidence.validation import drop_unconfirmed_joints
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import format_percent

MAX_HELD_OUT_RATIO = 3.0
"""Held-out over training rms of a joint above which the two are from different machines: another motion changes it by less than
a factor of two (EMPS, TX40, KR300, SO-101), a tool of a kilogram by a factor of ten."""
MIN_AMPLITUDE_Z = 2.0
"""Least distance of a claimed cause's amplitudes from zero in the extended model, in standard errors, by one Wald test."""
MAX_RELATIVE_RMS_INCREASE = 0.005
"""Largest relative increase of the validation error by a cause; a weak cause changes it by less, in both directions."""
MAX_OUTPUT_LOSS_PERCENT = 5.0
"""Loss of a single output [%] that the gain of the whole outweighs: the error of one output changes as much between two motions
of a sound machine (EMPS, TX40, KR300)."""
PRINTED_DIGITS = 3
"""Significant digits of the two errors that a recommendation compares; equal digits mean no gain."""
_NOT_SHOWN = "held-out data do not show it"
_SILENT = "held-out data cannot show it"
_WORSE = "held-out data are predicted worse with it"
_ZERO = "no amplitude of it is distinct from zero next to the other causes"
_VETO = "the test data do not show it"
_NO_FORCE = "its effect is below 1e-5 of the measured force, beyond sensor accuracy"
_NO_GAIN = "its gain is not above zero (95 % interval {:.2g} to {:.2g} %)"


@dataclass(frozen=True, eq=False)
class Claims:
    """The causes found, with the reasons why some of them are not confirmed.

    Attributes:
        found: Causes in the order found.
        why_not: For each the reason why it is not confirmed, in words; empty if it is.
        tests: The test of each on the validation data.
    """

    found: tuple[SelectedCause, ...]
    why_not: tuple[str, ...]
    tests: tuple[Confirmation, ...]

    @property
    def kept(self) -> list[SelectedCause]:
        """The causes that no rule has rejected."""
        return [one for one, why in zip(self.found, self.why_not, strict=True) if not why]

    def judge(self, k: int, why_not: str) -> Claims:
        """Return the claims with another reason for one of them."""
        return replace(self, why_not=(*self.why_not[:k], why_not, *self.why_not[k + 1 :]))

    def reject_all(self, why_not: str) -> Claims:
        """Return the claims with one reason for all causes that were not rejected."""
        return replace(self, why_not=tuple(why or why_not for why in self.why_not))

    def replace_found(self, one: SelectedCause, other: SelectedCause) -> Claims:
        """Return the claims with one cause replaced."""
        return replace(self, found=tuple(other if x is one else x for x in self.found))


class Waterfall(NamedTuple):
    """The waterfall: its steps, its fits, each cause's gain with all other causes in the model, and the nominal values."""

    steps: list[Step]
    fits: list[EvaluatedFit]
    gains: list[Gain]
    nominal: EvaluatedFit | None = None


def select_confirmed(
    selection: StepwiseSelection, tests: Sequence[Confirmation], physics: PhysicalConstraints | None = None
) -> Claims:
    """Return the causes that the held-out data show and whose prediction of these data is not worse.

    A true cause with many amplitudes from a short log may predict badly outside the range of the training data.
    """
    found = tuple(
        drop_unconfirmed_joints(selection, one) if test.is_confirmed and not test.within else one
        for one, test in zip(selection.found, tests, strict=True)
    )
    claims = Claims(found, tuple(_NOT_SHOWN if not t.is_inconclusive else _SILENT for t in tests), tuple(tests))
    before = _missed(selection.channel, (), physics) if any(test.is_confirmed for test in tests) else 0.0
    for k, test in enumerate(tests):
        if test.is_confirmed:
            after = _missed(selection.channel, [*claims.kept, found[k]], physics)
            better = after <= (1 + MAX_RELATIVE_RMS_INCREASE) * before
            claims = claims.judge(k, "" if better else _WORSE)
            before = after if better else before
    return claims


def _missed(channel: Channel, found: Sequence[SelectedCause], physics: PhysicalConstraints | None) -> float:
    """Return the rms on the validation data, each output divided by its own size, of a fit of the training data."""
    regression = build_extended_regression(channel, build_effects(found))
    theta = solve_with_fallback(restrict_to_parts(regression, channel, TRAIN), physics).theta
    residuals, shares = regression.residuals(theta), []
    for k in range(len(channel.outputs)):
        e, y = (channel.gather(values, k, VALIDATION) for values in (residuals, channel.target))
        shares.append(float(np.sum(e**2)) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300) if len(y) else 0.0)
    return float(np.sqrt(np.sum(shares)))


def build_waterfall(
    selection: StepwiseSelection,
    claims: Claims,
    rng: np.random.Generator,
    nominal: np.ndarray | None = None,
    physics: PhysicalConstraints | None = None,
    inner_parts: Sequence[np.ndarray] = (),
) -> Waterfall:
    """Fit and judge the baseline, then the model with one more cause at each step.

    The gain of a cause that only blocks of the training logs can show is measured there, by a fit of the others.

    Args:
        selection: The search.
        claims: The causes found; confirmed causes come in that order.
        rng: Random numbers for intervals.
        nominal: The baseline's values before any fit (p,); by default its parameters' own.
        physics: Physical consistency of the baseline's values.
        inner_parts: Parts with held-out blocks of the training logs, see `divide_training`.
    """
    channel, gains, kept = selection.channel, [], claims.kept
    values = channel.parameters.values if nominal is None else nominal
    first = evaluate_fit(channel, build_extended_regression(channel, ()), values, None, rng)
    fits = [fit_extended_model(channel, (), physics, rng)]
    steps = [Step("nominal", first.reported.errors), Step("refitted", fits[0].reported.errors)]
    for k, one in enumerate(kept):
        fits.append(fit_extended_model(channel, build_effects(kept[: k + 1]), physics, rng))
        joints = sorted({j for e in one.candidate.effects for j in e.joints}, key=channel.scene.joints.index)
        steps.append(Step(f"{one.candidate.cause} {' '.join(joints)}", fits[-1].reported.errors))
    for one in kept:
        others = [other for other in kept if other is not one]
        without = fits[-2] if one is kept[-1] else fit_extended_model(channel, build_effects(others), physics, rng)
        test = claims.tests[claims.found.index(one)]
        within, pair = test if test.within else None, (without, fits[-1])
        gains.append(
            _measure_gain(
                selection, pair, one.candidate.effects, build_effects(others), rng, physics, within, inner_parts
            )
        )
    return Waterfall(steps, fits, gains, first)


def _measure_gain(
    selection: StepwiseSelection,
    fits: Sequence[EvaluatedFit],
    effects: Sequence[Effect],
    others: Sequence[Effect],
    rng: np.random.Generator,
    physics: PhysicalConstraints | None,
    within: Confirmation | None = None,
    inner_parts: Sequence[np.ndarray] = (),
    outputs: Sequence[str] = (),
) -> Gain:
    """Return the gain of effects between two fits on the test data, for their own joints or for `outputs`.

    If the test data do not decide about the gain, the validation data are used as well or, for a cause with a test `within` the
    training logs, the held-out blocks of these logs. In both cases the fits are those of the remaining training data.
    """
    channel, own = selection.channel, selection.columns(effects)
    joints = outputs or list_felt_joints(channel, effects)
    shown = confirm(selection.null_model, own, others, (TEST,), fitted_on=(TRAIN, VALIDATION))
    before, after = (fit.residuals for fit in fits)
    if shown.leaves_gain_open:
        parts = inner_parts if within else channel.parts
        channel = replace(channel, parts=tuple(np.where(p == VALIDATION, TEST, p) for p in parts))
        known = [restrict_to_parts(fit.regression, channel, TRAIN) for fit in fits]
        before, after = (r.residuals(solve_with_fallback(r, physics).theta) for r in known)
        shown = within or confirm(selection.null_model, own, others, (VALIDATION, TEST))
    return compute_gain(channel, before, after, joints, rng, shown)


def list_felt_joints(channel: Channel, effects: Sequence[Effect]) -> list[str]:
    """Return the joints whose error effects change: their own, or all joints if an effect changes the forces of all."""
    own = {joint for effect in effects for joint in effect.joints}
    everywhere = any(effect.felt_by_all for effect in effects)
    return [joint for joint in channel.scene.joints if everywhere or joint in own]


def select_supported(
    selection: StepwiseSelection,
    claims: Claims,
    rng: np.random.Generator,
    nominal: np.ndarray | None = None,
    physics: PhysicalConstraints | None = None,
    inner_parts: Sequence[np.ndarray] = (),
) -> tuple[Claims, Waterfall]:
    """Return the claims that pass all rules for a confirmed cause, and their waterfall.

    A confirmed cause has an amplitude distinct from zero, within its plausible range, with settings away from the edges of the
    search; it is not absent from the test data, and the error of its own joints decreases with the 95 % interval above zero. A
    joint of several that becomes significantly worse is dropped, and the others are kept. The test data can only reject. Rules
    about one cause alone come first: a cause that they reject may be the reason why another one becomes worse.
    """
    while True:
        waterfall = build_waterfall(selection, claims, rng, nominal, physics, inner_parts)
        judged_again = _reject_by_amplitude(selection, claims, waterfall)
        if judged_again is claims:
            judged_again = _reject_companion(selection, claims, waterfall)
        if judged_again is claims:
            judged_again = _drop_worse_joints(selection.channel, claims, waterfall, rng)
        if judged_again is claims:
            judged_again = _reject_without_gain(selection.channel, claims, waterfall)
        if judged_again is claims:
            return claims, waterfall
        claims = judged_again


def _reject_by_amplitude(selection: StepwiseSelection, claims: Claims, waterfall: Waterfall) -> Claims:
    """Reject causes that are not distinct from zero, implausible, at an edge, or absent from the test data; all at once."""
    values, before = waterfall.fits[-1].parameters, waterfall.fits[0].parameters
    estimate, scene, kept = waterfall.fits[-1].estimate, selection.channel.scene, claims.kept
    assert estimate is not None  # only the nominal bar lacks one
    scales = scene.scales
    if scales:
        scales = widen_scales(scales, measure_friction(values, scene), measure_friction(before, scene))
    for k, one in enumerate(claims.found):
        if claims.why_not[k]:
            continue
        effects = one.candidate.effects
        why = "" if is_distinct_from_zero(effects, estimate, MIN_AMPLITUDE_Z) else _ZERO
        if not why:
            why = find_implausible(effects, values, scales) or find_edge(effects, scene)
            why = Implausible(why or find_inconsistent(effects, values, scene.step_s))
        others = build_effects([other for other in kept if other is not one])
        if not (why or claims.tests[k].within):
            shown = confirm(selection.null_model, selection.columns(effects), others, (TEST,))
            why = "" if shown.share > 0 or shown.leaves_gain_open else _VETO
        claims = claims.judge(k, why) if why else claims
    return claims


def _reject_companion(selection: StepwiseSelection, claims: Claims, waterfall: Waterfall) -> Claims:
    """Reject a cause that may only be the inexactness of another one's law."""
    kept = claims.kept
    found = find_companion(selection.library, kept, waterfall.fits[-1].parameters)
    return claims.judge(claims.found.index(kept[found[0]]), found[1]) if found else claims


def _drop_worse_joints(channel: Channel, claims: Claims, waterfall: Waterfall, rng: np.random.Generator) -> Claims:
    """Drop those joints of causes on several joints whose error increases significantly by the cause."""
    for n, one in enumerate(claims.kept):
        fits = one.candidate.fits
        before, after = (waterfall.fits[n + k].residuals for k in (0, 1))
        gains = [compute_gain(channel, before, after, fit.effect.joints, rng) for fit in fits]
        left = tuple(fit for fit, gain in zip(fits, gains, strict=True) if not is_worse(gain))
        if 0 < len(left) < len(fits):
            return claims.replace_found(one, replace(one, candidate=replace(one.candidate, fits=left)))
    return claims


def is_worse(gain: Gain, tolerance_percent: float = 100 * MAX_RELATIVE_RMS_INCREASE) -> bool:
    """Return whether an error increases significantly and by more than a tolerance [%]."""
    return gain.ci95[1] < 0 and gain.reduction_percent < -tolerance_percent


def explain_gain(gain: Gain) -> str:
    """Return the reason why a gain on held-out data does not confirm its cause; empty if it does."""
    if gain.p_value is not None and not gain.p_value < SIGNIFICANCE_LEVEL:
        return _NOT_SHOWN
    return _NO_GAIN.format(*gain.ci95) if gain.ci95[0] <= 0 else ""


def _reject_without_gain(channel: Channel, claims: Claims, waterfall: Waterfall) -> Claims:
    """Reject the cause with the lowest gain if its interval is not above zero, and one whose gain is not a measurable force."""
    low = [gain.ci95[0] for gain in waterfall.gains]
    if low and (why := explain_gain(waterfall.gains[n := int(np.argmin(low))])):
        return claims.judge(claims.found.index(claims.kept[n]), why)
    if channel.name != "force":
        return claims
    for one, gain in zip(claims.kept, waterfall.gains, strict=True):
        joints = list_felt_joints(channel, one.candidate.effects)
        felt = [k for k, output in enumerate(channel.outputs) if output in joints] or slice(None)
        least = float(np.sqrt(np.mean(compute_least_forces(channel)[felt] ** 2)))
        own = np.sqrt(max(0.0, gain.rms_before**2 - gain.rms_after**2))  # rms of the force that the cause explains
        if own < least:
            return claims.judge(claims.found.index(one), _NO_FORCE)
    return claims


class Recommendation(NamedTuple):
    """The recommended model, the reason in a sentence, and warnings."""

    choice: Choice
    why: str
    warnings: Sequence[str] = ()


def recommend(
    selection: StepwiseSelection,
    claims: Claims,
    waterfall: Waterfall,
    rng: np.random.Generator,
    physics: PhysicalConstraints | None = None,
    *,
    has_load: bool = False,
    overfit: float = 1.0,
) -> Recommendation:
    """Return the recommended model, from the causes with their status and their waterfall.

    Args:
        selection: The selection.
        claims: The causes with their status.
        waterfall: The waterfall.
        rng: Random numbers for intervals.
        physics: Physical consistency of the baseline's values.
        has_load: Whether some logs carry a confirmed load, which is part of neither model.
        overfit: Held-out over training rms that the number of parameters explains; see `compute_overfit_factor`.
    """
    channel = selection.channel
    before, after = waterfall.fits[0], waterfall.fits[-1]
    if foreign := describe_foreign_joints(find_foreign_joints(channel, after, overfit)):
        return Recommendation("neither", str(foreign[0]), foreign)
    if waterfall.nominal is not None and is_worse(
        loss := compute_gain(channel, waterfall.nominal.residuals, before.residuals, channel.outputs, rng)
    ):
        more = -loss.reduction_percent
        why = f"the held-out error of the refitted model is {more:.2g} % larger than with the robot file's values"
        return Recommendation("neither", why)
    if not claims.kept:
        load = "no cause but the load is confirmed, which is the log's own"
        return Recommendation("refitted", load if has_load else "no cause is confirmed")
    bands = [(channel.report(), before.reported, after.reported), (channel, before, after)]
    worse = {
        output: -gain.reduction_percent
        for data, one, other in bands
        for output in channel.outputs
        if is_worse(gain := compute_gain(data, one.residuals, other.residuals, [output], rng), MAX_OUTPUT_LOSS_PERCENT)
    }
    if worse:
        listed = ", ".join(f"{output} by {loss:.2g} %" for output, loss in worse.items())
        return Recommendation("refitted", f"the confirmed causes increase the held-out error at {listed}")
    pairs = ((before.reported.errors, after.reported.errors), (before.errors, after.errors))
    printed = [[format_percent(e.relative_error_percent, PRINTED_DIGITS) for e in pair] for pair in pairs]
    one = printed[0][0]
    if all(a == b for a, b in printed):
        return Recommendation("refitted", f"the held-out error is {one} with and without the confirmed causes: no gain")
    gain = _measure_gain(
        selection, (before, after), build_effects(claims.kept), (), rng, physics, outputs=channel.outputs
    )
    low, high = gain.ci95
    if low <= 0:
        return Recommendation(
            "refitted", f"the held-out error does not fall significantly (95 % interval [{low:.2g}, {high:.2g}] %)"
        )
    what = "all outputs" if channel.name == "force" else f"the {channel.name}"
    why = f"the held-out error of {what} falls by {gain.reduction_percent:.2g} %"
    tolerance = f"no output loses more than {MAX_OUTPUT_LOSS_PERCENT:g} %"
    return Recommendation("extended", f"{why} (95 % interval [{low:.2g}, {high:.2g}] %), and {tolerance}")


def compute_overfit_factor(n_values: float, rank: int) -> float:
    """Return held-out over training rms of a true model with `rank` parameters fitted to `n_values` independent values.

    The training residual has the variance `s^2 (1 - r)` and the prediction of new data `s^2 (1 + r)`, with `r = rank / n_values`
    (Akaike 1970, final prediction error). It is infinite if there are fewer values than parameters.
    """
    share = rank / n_values if n_values > 0 else np.inf
    return float(np.sqrt((1 + share) / (1 - share))) if share < 1 else np.inf


def find_foreign_joints(channel: Channel, fit: EvaluatedFit, overfit: float = 1.0) -> list[tuple[str, float]]:
    """Return the outputs whose held-out rms is many times the training rms, with the ratio; empty without held-out logs.

    Args:
        channel: The data.
        fit: The fit.
        overfit: The ratio that the number of parameters explains.
    """
    if not any(np.all(part == TRAIN) for part in channel.parts):
        return []
    found = []
    for k, output in enumerate(channel.outputs):
        trained, held = (
            float(np.sqrt(np.mean(e**2))) if len(e := channel.gather(fit.residuals, k, *parts)) else 0.0
            for parts in ((TRAIN,), (VALIDATION, TEST))
        )
        if trained > 0 and held > MAX_HELD_OUT_RATIO * overfit * trained:
            found.append((output, held / trained))
    return found


def describe_foreign_joints(ratios: Sequence[tuple[str, float]]) -> list[str]:
    """Return the warning that the held-out logs are from another machine, with joints and their ratio of rms."""
    if not ratios:
        return []
    listed = ", ".join(f"{joint} ({ratio:.1f} times)" for joint, ratio in ratios)
    sentence = (
        f"the held-out error is many times the training error at {listed}; the held-out log probably belongs to another "
        "machine or tool"
    )
    return [CodedWarning("holdout_differs", sentence)]
