"""What every channel goes through after its search: confirmation, the waterfall, findings, and what a page draws.

Forces, tool positions and deflections differ in how their channel is built and in what is said about them; the stages here are
the same for all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.extend import Judged, extended_regression, fitted, gain_of, judged, masked, solved
from tau_dyn.diagnose.findings import finding_of, signature_of
from tau_dyn.diagnose.fits import FAMILY_LEVEL
from tau_dyn.diagnose.floor import noise_floor
from tau_dyn.diagnose.parts import CONFIRM, EVERY, GAIN, TRAIN
from tau_dyn.diagnose.result import (
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
from tau_dyn.diagnose.search import Found, Search, effects_of
from tau_dyn.diagnose.trials import DRAWS, columns_of
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.estimate import Physics
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters

SURE = 2.0
"""Standard errors that an amplitude of the extended model must be off zero for its cause to be claimed."""
WORSE = 0.005
"""By how much a cause may raise the error on the confirmation part; a weak one changes it by less, either way."""
HELD_OUT = "held-out {what}, blocks in turn: one half confirms, the other measures the gain"
SHARED = "60 % of the {what} train, 20 % confirm, 20 % measure the gain, in blocks that take turns"


class Bars(NamedTuple):
    """The waterfall: its steps, the fits behind all but the first, and each cause's gain over the bar before it."""

    steps: list[Step]
    judgements: list[Judged]
    gains: list[Gain]


def confirmation(channel: Channel, hunt: Search, one: Found) -> Confirmation:
    """Test one cause on the confirmation part, the others accounted for."""
    effects, others = (columns_of(hunt.library, x) for x in (one.candidate.effects, hunt.others(one)))
    return confirm(channel, hunt.noise, effects, others)


def confirmed(
    channel: Channel, hunt: Search, tests: Sequence[Confirmation], *, physics: Physics | None = None
) -> list[Found]:
    """Return the causes that the held-out part shows and that do not make its prediction worse.

    A cause may be there and yet, with many amplitudes from a short log, predict badly where the training part never was.
    """
    kept: list[Found] = []
    before = _missed(channel, kept, physics) if any(test.holds for test in tests) else 0.0
    for one, test in zip(hunt.found, tests, strict=True):
        if test.holds:
            after = _missed(channel, [*kept, one], physics)
            if after <= (1 + WORSE) * before:
                kept.append(one)
                before = after
    return kept


def _missed(channel: Channel, found: Sequence[Found], physics: Physics | None) -> float:
    """Return the rms on the confirmation part, outputs by their own size, of a fit of the training part."""
    regression = extended_regression(channel, effects_of(found))
    theta = solved(masked(regression, channel, TRAIN), physics).theta
    masks = channel.masks(CONFIRM)
    shares = []
    for k in range(len(channel.outputs)):
        e, y = (
            np.concatenate([x[m[:, k], k] for x, m in zip(values, masks, strict=True)])
            for values in (regression.residuals(theta), channel.target)
        )
        shares.append(float(np.sum(e**2)) / max(float(np.sum((y - y.mean()) ** 2)), 1e-300) if len(y) else 0.0)
    return float(np.sqrt(np.sum(shares)))


def waterfall(
    channel: Channel,
    kept: Sequence[Found],
    rng: np.random.Generator,
    *,
    nominal: np.ndarray | None = None,
    physics: Physics | None = None,
) -> Bars:
    """Fit and judge the baseline, then with one cause more each time.

    Args:
        channel: The data.
        kept: Confirmed causes in the order found.
        rng: For intervals.
        nominal: The baseline's values before any fit (p,); by default its parameters' own.
        physics: What makes the baseline's values physical.
    """
    values = channel.parameters.values if nominal is None else nominal
    steps = [Step("nominal", judged(channel, extended_regression(channel, ()), values, None, rng).errors)]
    judgements = [fitted(channel, (), physics, rng)]
    steps.append(Step("refitted", judgements[0].errors))
    gains = []
    for k, one in enumerate(kept):
        judgements.append(fitted(channel, effects_of(kept[: k + 1]), physics, rng))
        joints = sorted({j for e in one.candidate.effects for j in e.joints}, key=channel.scene.joints.index)
        steps.append(Step(f"{one.candidate.cause} {' '.join(joints)}", judgements[-1].errors))
        gains.append(gain_of(channel, judgements[-2].residuals, judgements[-1].residuals, joints, rng))
    return Bars(steps, judgements, gains)


def supported(
    channel: Channel,
    hunt: Search,
    tests: Sequence[Confirmation],
    kept: Sequence[Found],
    rng: np.random.Generator,
    *,
    nominal: np.ndarray | None = None,
    physics: Physics | None = None,
) -> tuple[list[Found], Bars]:
    """Return the confirmed causes that the fit of everything tells from zero and that the last part bears out; their bars.

    The last part has a veto and no vote: a cause of which it shows nothing, or the opposite, is suspected only, and of what
    stands nothing is chosen by it. White rows say so: raw force scatters by more than a weak cause takes off it.
    """
    kept = list(kept)
    while True:
        bars = waterfall(channel, kept, rng, nominal=nominal, physics=physics)
        told = told_from_zero(kept, bars.judgements[-1])
        sure = [one for one in told if _borne_out(channel, hunt, tests, kept, one)]
        if len(sure) == len(kept):
            return kept, bars
        kept = sure


def _borne_out(
    channel: Channel, hunt: Search, tests: Sequence[Confirmation], kept: Sequence[Found], one: Found
) -> bool:
    """Tell whether the last part shows some of a cause, beside the others kept; unless held-out logs cannot show it."""
    test = next(test for other, test in zip(hunt.found, tests, strict=True) if other is one)
    effects, others = one.candidate.effects, effects_of([other for other in kept if other is not one])
    own, beside = (columns_of(hunt.library, x) for x in (effects, others))
    return test.within or confirm(channel, hunt.noise, own, beside, GAIN).share > 0


def told_from_zero(kept: Sequence[Found], fit: Judged) -> list[Found]:
    """Return the causes of which the fit of everything tells an amplitude from zero, by `SURE` standard errors.

    A cause may be significant in white rows and yet, weighed against all that scatters over seconds, be nothing.
    """
    values = estimated(fit)

    def told(one: Found) -> bool:
        own = [values[n] for e in one.candidate.effects for n in e.parameters.names]
        return any(p.stderr is None or abs(p.value) > SURE * p.stderr for p in own)

    return [one for one in kept if told(one)]


def findings_of(
    channel: Channel,
    hunt: Search,
    tests: Sequence[Confirmation],
    kept: Sequence[Found],
    bars: Bars,
    rng: np.random.Generator,
) -> list[Finding]:
    """Return what is said of every cause found, confirmed or not."""
    found = []
    for one, test in zip(hunt.found, tests, strict=True):
        effects, fit, gain = one.candidate.effects, bars.judgements[-1], None
        if one in kept:
            gain = bars.gains[list(kept).index(one)]
        else:
            fit = fitted(channel, [*effects_of(kept), *effects], None, rng)
        names = {n for e in effects for n in e.parameters.names}
        values = Parameters([p for p in estimated(fit) if p.name in names])
        signature = signature_of(channel, effects, fit.residuals, values)
        found.append(finding_of(channel, hunt, one, test, values, gain, signature, kept=one in kept))
    return found


def extended_model(model: Model, fit: Judged, effects: Sequence[Effect]) -> Model:
    """Return a model with further effects and all values that the fit has; what belongs to the recording stays out."""
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    values = estimated(fit)
    return extended.with_parameters(
        Parameters([values[p.name] if p.name in values else p for p in extended.parameters])
    )


def estimated(fit: Judged) -> Parameters:
    """Return a fit's parameters."""
    assert fit.estimate is not None  # only the nominal bar has none
    return fit.estimate.parameters


def strength(finding: Finding) -> tuple[bool, bool, float]:
    """Order findings: confirmed ones first, by how much they take off the held-out error; the rest by score."""
    gain = finding.gain
    worth = finding.score if gain is None else gain.rms_before**2 - gain.rms_after**2
    return finding.status == "parameter", finding.status == "suspected", -worth


def traces(channel: Channel, before: Judged, after: Judged) -> tuple[TimeTrace, ...]:
    """Return what the time view draws."""
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def seconds(channel: Channel) -> tuple[float, float, float]:
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


def assembled(
    channel: Channel,
    hunt: Search,
    kept: Sequence[Found],
    bars: Bars,
    model: Model,
    answer: Answer,
    seed: int,
) -> Diagnosis:
    """Put a diagnosis together from its stages.

    Args:
        channel: The data.
        hunt: The search.
        kept: Confirmed causes in the order found.
        bars: What `waterfall` returned.
        model: The model before any fit.
        answer: What is said.
        seed: Seed of whatever was random.
    """
    before, after = bars.judgements[0], bars.judgements[-1]
    floor = noise_floor(channel, after, np.random.default_rng(seed))
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
        findings=tuple(sorted(answer.findings, key=strength)),
        unexplained=answer.unexplained,
        limits=tuple(dict.fromkeys(answer.limits)),
        untestable=tuple(dict.fromkeys(answer.untestable)),
        model=extended_model(model, before, ()),
        extended_model=extended_model(model, after, [e for e in effects_of(kept) if e.name in EFFECTS]),
        traces=traces(channel, before, after),
        n_parts=seconds(channel),
        how=answer.how,
        warnings=tuple(dict.fromkeys(answer.warnings)),
        seed=seed,
        experiment=answer.experiment,
        settings={
            **answer.settings,
            "noise_draws": DRAWS,
            "family_level": FAMILY_LEVEL,
            "causes_tried": hunt.n_causes,
        },
    )
