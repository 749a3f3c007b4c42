"""Measured tool positions and a model -> where forward kinematics is wrong, which cause explains it, and the gain.

The same search, confirmation and measurement as for forces, on the tool channel (`tool.py`). A cyclic error found at places too
far apart to tell its period gives `cannot_tell` and the spacing that would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.aliases import alias_periods, spacing
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.extend import Judged, extended_regression, fitted, gain_of, judged
from tau_dyn.diagnose.findings import finding_of, signature_of
from tau_dyn.diagnose.floor import noise_floor
from tau_dyn.diagnose.ground import Ground
from tau_dyn.diagnose.limits import limits_of
from tau_dyn.diagnose.parts import TRAIN
from tau_dyn.diagnose.result import Diagnosis, Errors, Finding, Gain, Step, TimeTrace, Verdict
from tau_dyn.diagnose.search import FAMILY_LEVEL, Found, Search, columns_of, search
from tau_dyn.diagnose.tool import ToolChannel, tool_channel
from tau_dyn.diagnose.trials import DRAWS
from tau_dyn.effects import Effect
from tau_dyn.effects.words import quantity
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters

_LISTED = 4
"""Periods named in a sentence."""
_PER_PERIOD = 2.5
"""Places that one period needs, with a little to spare above two."""


def diagnose_tool(
    model: Model,
    logs: Iterable[Log],
    *,
    holdout: Iterable[Log] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Diagnosis:
    """Find out what displaces the tool.

    Args:
        model: Its robot's geometry gives forward kinematics, its masses the loads.
        logs: Logs with `q_J` and `x_tool y_tool z_tool`, sampled in time or poses held still.
        holdout: Logs for confirming and for measuring the gain; without any, blocks of the logs are set aside (60/20/20).
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.

    Raises:
        InputError: A log or the robot lacks a tool.
        CannotAnswer: There are too few positions for three parts.
    """
    train, held = list(logs), list(holdout)
    progress("columns")
    channel = tool_channel(model, train, held)
    rng = np.random.default_rng(seed)
    progress("looking for causes")
    hunt = search(channel, rng, progress)
    progress("confirming")
    tests = [_confirmation(channel, hunt, one) for one in hunt.found]
    periods = [_periods(channel, hunt, one) for one in hunt.found]
    kept = [x for x, test, open_to in zip(hunt.found, tests, periods, strict=True) if test.holds and len(open_to) < 2]
    progress("measuring the gain")
    steps, judgements, gains = _waterfall(channel, kept, rng)
    findings = []
    for one, test, open_to in zip(hunt.found, tests, periods, strict=True):
        found = _finding(channel, hunt, one, test, kept, judgements[-1], gains, rng)
        findings.append(_open(channel, one, found, open_to) if len(open_to) > 1 else found)
    aliased = [f for f, open_to in zip(findings, periods, strict=True) if len(open_to) > 1]
    named = [f for f in findings if f.status == "confirmed"]
    limits, untestable = limits_of(channel, hunt, [f.cause for f in findings])
    baseline, extended = judgements[0], judgements[-1]
    floor = noise_floor(channel, hunt, extended, rng)
    verdict: Verdict = "named" if named else "cannot_tell" if aliased else "nothing_found"
    return Diagnosis(
        verdict=verdict,
        sentence=_sentence(baseline.errors, extended.errors, named, aliased),
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=baseline.errors,
        extended=extended.errors,
        noise_floor=floor,
        waterfall=(*steps, Step("noise_floor", floor)),
        findings=tuple(sorted(findings, key=lambda f: (f.status == "suspected", -f.score))),
        unexplained=(),
        limits=tuple(dict.fromkeys(limits)),  # a cause was tried on one joint at a time
        untestable=tuple(dict.fromkeys(untestable)),
        model=model,
        extended_model=_extended(model, extended, tuple(e for one in kept for e in one.candidate.effects)),
        traces=_traces(channel, baseline, extended),
        n_parts=_lengths(channel),
        how=_how(channel, held),
        warnings=(),
        seed=seed,
        experiment=aliased[0].experiment if verdict == "cannot_tell" else "",
        settings={"noise_draws": DRAWS, "family_level": FAMILY_LEVEL, "causes_tried": hunt.n_causes},
    )


def _confirmation(channel: ToolChannel, hunt: Search, one: Found) -> Confirmation:
    others = [e for other in hunt.found if other is not one for e in other.candidate.effects]
    return confirm(
        channel, hunt.noise, columns_of(hunt.library, one.candidate.effects), columns_of(hunt.library, others)
    )


def _waterfall(
    channel: ToolChannel, kept: Sequence[Found], rng: np.random.Generator
) -> tuple[list[Step], list[Judged], list[Gain]]:
    """Return the bars, the fits behind all but the first, and each cause's gain."""
    plain = extended_regression(channel, ())
    steps = [Step("nominal", judged(channel, plain, channel.parameters.values, None, rng).errors)]
    judgements = [fitted(channel, (), None, rng)]
    steps.append(Step("refitted", judgements[0].errors))
    effects: list[Effect] = []
    gains = []
    for one in kept:
        effects += one.candidate.effects
        judgements.append(fitted(channel, effects, None, rng))
        steps.append(Step(one.candidate.cause, judgements[-1].errors))
        gains.append(gain_of(channel, judgements[-2].residuals, judgements[-1].residuals, channel.outputs, rng))
    return steps, judgements, gains


def _finding(
    channel: ToolChannel,
    hunt: Search,
    one: Found,
    test: Confirmation,
    kept: list[Found],
    final: Judged,
    gains: Sequence[Gain],
    rng: np.random.Generator,
) -> Finding:
    effects = one.candidate.effects
    gain = gains[kept.index(one)] if one in kept else None
    if one not in kept:
        final = fitted(channel, [e for k in kept for e in k.candidate.effects] + list(effects), None, rng)
    assert final.estimate is not None
    names = {n for e in effects for n in e.parameters.names}
    values = Parameters([p for p in final.estimate.parameters if p.name in names])
    found = finding_of(channel, hunt, one, test, values, gain, signature_of(channel, effects, final.residuals, values))
    others = tuple(cause for cause in found.indistinguishable_from if cause != found.cause)
    return replace(found, indistinguishable_from=others, experiment=found.experiment if others else "")


def _periods(channel: ToolChannel, hunt: Search, one: Found) -> tuple[float, ...]:
    """Return the periods that a cyclic error may have; none for other causes and for motion sampled in time."""
    effect = one.candidate.effects[0]
    if not (channel.poses and effect.dense and "period" in effect.settings):
        return ()
    others = [e for other in hunt.found if other is not one for e in other.candidate.effects]
    ground = Ground.of(channel, (TRAIN,), hunt.noise, columns_of(hunt.library, others))
    return alias_periods(channel, ground, effect)


def _open(channel: ToolChannel, one: Found, finding: Finding, periods: tuple[float, ...]) -> Finding:
    """Say that the places measured leave the period of a cyclic error open, and which spacing would not."""
    effect = one.candidate.effects[0]
    joint = effect.joints[0]
    unit = "m" if effect.units[joint] == "N" else "rad"
    listed = ", ".join(quantity(p, unit) for p in periods[:_LISTED])
    more = f" and {len(periods) - _LISTED} more down to {quantity(periods[-1], unit)}" if len(periods) > _LISTED else ""
    step, finer = (quantity(x, unit) for x in (spacing(channel, joint), periods[-1] / _PER_PERIOD))
    return replace(
        finding,
        status="suspected",
        gain=None,
        sentence=f"{joint.capitalize()} has a cyclic error, but at places {step} apart periods of {listed}{more} fit alike.",
        experiment=f"measure the tool while {joint} goes in steps of {finer} or less, or at as many places in uneven steps",
    )


def _sentence(before: Errors, after: Errors, named: Sequence[Finding], aliased: Sequence[Finding]) -> str:
    """Return what a colleague would say first."""
    one, other = (quantity(float(np.linalg.norm(e.rms)), "m") for e in (before, after))
    text = f"The measured tool is {one} (rms) from forward kinematics"
    if named:
        causes = " and ".join(f"{f.cause} ({', '.join(f.joints)})" for f in named)
        return f"{text}; with {causes} it is {other}."
    if aliased:
        return f"{text}. {aliased[0].sentence} These positions cannot tell which."
    return f"{text}, and no cause that we know explains any of it."


def _extended(model: Model, fit: Judged, effects: tuple[Effect, ...]) -> Model:
    """Return the model with further effects at fitted values; the measuring frame is none of its business."""
    assert fit.estimate is not None
    extended = replace(
        model,
        effects=(*model.effects, *effects),
        effect_parameters=model.effect_parameters + Parameters([p for e in effects for p in e.parameters]),
    )
    names = {n for e in effects for n in e.parameters.names}
    return extended.with_values({p.name: p.value for p in fit.estimate.parameters if p.name in names})


def _how(channel: ToolChannel, held: Sequence[Log]) -> str:
    what = "poses" if channel.poses else "samples"
    if held:
        return f"held-out {what}, blocks in turn: one half confirms, the other measures the gain"
    return f"60 % of the {what} train, 20 % confirm, 20 % measure the gain, in blocks that take turns"


def _traces(channel: ToolChannel, before: Judged, after: Judged) -> tuple[TimeTrace, ...]:
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def _lengths(channel: ToolChannel) -> tuple[float, float, float]:
    """Return how long each part is [s]; a pose counts a second."""
    steps = [float(np.median(np.diff(run.t))) for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == number)) for dt, part in zip(steps, channel.parts, strict=True))
        for number in range(3)
    )
    return one, two, three
