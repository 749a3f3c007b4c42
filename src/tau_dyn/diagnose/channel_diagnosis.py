"""A channel of displacements -> its diagnosis: the search, confirmation and measurement that forces have, without their physics.

The baseline is whatever the channel may refit (zeros, a frame); no mass has to stay positive, no parameter is checked against a
nominal, and encoder noise does not become a force.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.extend import Judged, extended_regression, fitted, gain_of, judged
from tau_dyn.diagnose.findings import finding_of, signature_of
from tau_dyn.diagnose.floor import noise_floor
from tau_dyn.diagnose.limits import limits_of
from tau_dyn.diagnose.result import Diagnosis, Errors, Finding, Gain, Step, TimeTrace, Unexplained, Verdict
from tau_dyn.diagnose.search import FAMILY_LEVEL, Found, Search, columns_of, search
from tau_dyn.diagnose.trials import DRAWS
from tau_dyn.diagnose.unknown import find_structure
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.effects.words import quantity
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters


def diagnose_channel(
    channel: Channel,
    model: Model,
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
    warnings: Sequence[str] = (),
    held: bool = False,
) -> Diagnosis:
    """Find causes on a channel of displacements.

    Args:
        channel: The measurements.
        model: The model that is extended by what is found.
        seed: Seed of noise draws and intervals.
        progress: Called with a word for each step.
        warnings: What was doubtful before.
        held: Whether some logs were held out.
    """
    rng = np.random.default_rng(seed)
    progress("looking for causes")
    hunt = search(channel, rng, progress)
    progress("confirming")
    tests = [_confirmation(channel, hunt, one) for one in hunt.found]
    kept = [one for one, test in zip(hunt.found, tests, strict=True) if test.holds]
    unexplained = _unexplained(channel, hunt, rng)
    progress("measuring the gain")
    steps, judgements, gains = _waterfall(channel, kept, rng)
    baseline, extended = judgements[0], judgements[-1]
    findings = [
        _finding(channel, hunt, one, test, kept, extended, gains, rng)
        for one, test in zip(hunt.found, tests, strict=True)
    ]
    limits, untestable = limits_of(channel, hunt, [f.cause for f in findings])
    floor = noise_floor(channel, hunt, extended, rng)
    named = [f for f in findings if f.status == "confirmed"]
    open_end = any(u.status == "confirmed" for u in unexplained)
    verdict: Verdict = "named" if named else "unexplained" if open_end else "nothing_found"
    return Diagnosis(
        verdict=verdict,
        sentence=_sentence(channel, baseline.errors, extended.errors, named, unexplained),
        channel=channel.name,
        outputs=channel.outputs,
        units=channel.units,
        baseline=baseline.errors,
        extended=extended.errors,
        noise_floor=floor,
        waterfall=(*steps, Step("noise_floor", floor)),
        findings=tuple(sorted(findings, key=lambda f: (f.status == "suspected", -f.score))),
        unexplained=unexplained,
        limits=limits,
        untestable=untestable,
        model=model,
        extended_model=_extended(model, extended, [e for one in kept for e in one.candidate.effects]),
        traces=_traces(channel, baseline, extended),
        n_parts=_seconds(channel),
        how=_HELD_OUT if held else _BLOCKS,
        warnings=tuple(dict.fromkeys(warnings)),
        seed=seed,
        settings={"noise_draws": DRAWS, "family_level": FAMILY_LEVEL, "causes_tried": hunt.n_causes},
    )


_HELD_OUT = "held-out logs, blocks in turn: one half confirms, the other measures the gain"
_BLOCKS = "60 % of each log trains, 20 % confirms, 20 % measures the gain, in blocks that take turns"


def _confirmation(channel: Channel, hunt: Search, one: Found) -> Confirmation:
    others = [e for other in hunt.found if other is not one for e in other.candidate.effects]
    mine = columns_of(hunt.library, one.candidate.effects)
    return confirm(channel, hunt.noise, mine, columns_of(hunt.library, others))


def _unexplained(channel: Channel, hunt: Search, rng: np.random.Generator) -> tuple[Unexplained, ...]:
    structure = find_structure(channel, hunt.ground, hunt.ground.draws(DRAWS, rng), FAMILY_LEVEL)
    if structure is None:
        return ()
    others = columns_of(hunt.library, [e for one in hunt.found for e in one.candidate.effects])
    holds = confirm(channel, hunt.noise, [structure.columns], others).holds
    status = "confirmed" if holds else "suspected"
    return (
        Unexplained(
            structure.output, structure.variables, structure.share, structure.formula, structure.p_value, status
        ),
    )


def _waterfall(
    channel: Channel, kept: Sequence[Found], rng: np.random.Generator
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
        joints = list(dict.fromkeys(j for e in one.candidate.effects for j in e.joints))
        steps.append(Step(f"{one.candidate.cause} {' '.join(joints)}", judgements[-1].errors))
        gains.append(gain_of(channel, judgements[-2].residuals, judgements[-1].residuals, joints, rng))
    return steps, judgements, gains


def _finding(
    channel: Channel,
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
    signature = signature_of(channel, effects, final.residuals, values)
    found = finding_of(channel, hunt, one, test, values, gain, signature)
    others = tuple(cause for cause in found.indistinguishable_from if cause != found.cause)
    return replace(found, indistinguishable_from=others, experiment=found.experiment if others else "")


def _sentence(
    channel: Channel, before: Errors, after: Errors, named: Sequence[Finding], unexplained: Sequence[Unexplained]
) -> str:
    """Return what a colleague would say first."""
    one, other = (
        ", ".join(f"{quantity(float(r), u)} at {o}" for r, u, o in zip(e.rms, channel.units, e.outputs, strict=True))
        for e in (before, after)
    )
    text = f"The {channel.name} is {one} (rms)"
    if named:
        causes = " and ".join(f"{f.cause} ({', '.join(f.joints)})" for f in named)
        text += f"; with {causes}, {other} is left unexplained"
    else:
        text += ", and no cause that we know explains any of it"
    left = next((u for u in unexplained if u.status == "confirmed"), None)
    if left is not None:
        share = f"{100 * left.share_of_residual_variance:.0f} % of its residual"
        text += f". What is left at {left.joint} depends on {', '.join(left.depends_on)} and has no name ({share})"
    return f"{text}."


def _extended(model: Model, fit: Judged, effects: Sequence[Effect]) -> Model:
    """Return the model with further effects at fitted values; what belongs to the recording alone stays out."""
    assert fit.estimate is not None
    effects = [e for e in effects if e.name in EFFECTS]
    more = Parameters([p for e in effects for p in e.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    return extended.with_values({p.name: p.value for p in fit.estimate.parameters if p.name in more.names})


def _traces(channel: Channel, before: Judged, after: Judged) -> tuple[TimeTrace, ...]:
    found = []
    for k, run in enumerate(channel.runs):
        one, other = (j.regression.runs[k].W_all @ j.theta for j in (before, after))
        found.append(TimeTrace(run.name, run.t, run.y_all, one, other, run.usable, channel.parts[k]))
    return tuple(found)


def _seconds(channel: Channel) -> tuple[float, float, float]:
    """Return how long each part is [s]."""
    steps = [float(np.median(np.diff(run.t))) for run in channel.runs]
    one, two, three = (
        sum(dt * int(np.sum(part == number)) for dt, part in zip(steps, channel.parts, strict=True))
        for number in range(3)
    )
    return one, two, three
