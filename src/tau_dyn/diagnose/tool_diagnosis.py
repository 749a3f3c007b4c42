"""Measured tool positions and a model -> where forward kinematics is wrong, which cause explains it, and the gain.

The same search, confirmation and measurement as for forces, on the tool channel (`tool.py`). A cyclic error found at places too
far apart to tell its period gives `cannot_tell` and the spacing that would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.aliases import compute_alias_periods, compute_position_spacing
from tau_dyn.diagnose.candidate_scan import get_columns
from tau_dyn.diagnose.channel_pipeline import (
    HELD_OUT,
    SHARED,
    Answer,
    build_diagnosis,
    build_findings,
    confirm_cause,
    select_confirmed,
    select_supported,
)
from tau_dyn.diagnose.data_split import TRAIN
from tau_dyn.diagnose.detection_limits import compute_detection_limits
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.recommendation import recommend
from tau_dyn.diagnose.resonances import add_resonances
from tau_dyn.diagnose.result import Diagnosis, Finding, OutputErrors
from tau_dyn.diagnose.stepwise_selection import SelectedCause, StepwiseSelection, select_causes
from tau_dyn.diagnose.tool import ToolChannel, build_tool_channel
from tau_dyn.effects import format_quantity
from tau_dyn.log import Log
from tau_dyn.model import Model

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
    channel = add_resonances(build_tool_channel(model, train, held))
    rng = np.random.default_rng(seed)
    progress("looking for causes")
    hunt = select_causes(channel, rng, progress)
    progress("confirming")
    tests = [confirm_cause(channel, hunt, one) for one in hunt.found]
    periods = [_periods(channel, hunt, one) for one in hunt.found]
    claims = select_confirmed(channel, hunt, tests)
    for k, open_to in enumerate(periods):
        claims = claims.judge(k, "several periods fit alike") if len(open_to) > 1 else claims
    progress("measuring the gain")
    claims, bars = select_supported(channel, hunt, claims, rng)
    said = build_findings(channel, hunt, claims, bars, rng)
    findings = [
        _open(channel, one, finding, open_to) if len(open_to) > 1 else finding
        for one, finding, open_to in zip(hunt.found, said, periods, strict=True)
    ]
    aliased = [f for f, open_to in zip(findings, periods, strict=True) if len(open_to) > 1]
    named = [f for f in findings if f.status == "confirmed"]
    limits, untestable = compute_detection_limits(channel, hunt, [f.cause for f in findings])
    answer = Answer(
        "named" if named else "cannot_tell" if aliased else "nothing_found",
        _sentence(bars.judgements[0].errors, bars.judgements[-1].errors, named, aliased),
        (HELD_OUT if held else SHARED).format(what="poses" if channel.poses else "logs"),
        findings,
        limits=limits,
        untestable=untestable,
        experiment=aliased[0].experiment if aliased and not named else "",
    )
    return build_diagnosis(
        channel, hunt, claims, bars, model, answer, seed, recommend(channel, hunt, claims, bars, rng)
    )


def _periods(channel: ToolChannel, hunt: StepwiseSelection, one: SelectedCause) -> tuple[float, ...]:
    """Return the periods that a cyclic error may have; none for other causes and for motion sampled in time."""
    effect = one.candidate.effects[0]
    if not (channel.poses and effect.dense and "period" in effect.settings):
        return ()
    ground = NullModel.of(channel, (TRAIN,), hunt.noise, get_columns(hunt.library, hunt.others(one)))
    return compute_alias_periods(channel, ground, effect)


def _open(channel: ToolChannel, one: SelectedCause, finding: Finding, periods: tuple[float, ...]) -> Finding:
    """Say that the places measured leave the period of a cyclic error open, and which spacing would not."""
    effect = one.candidate.effects[0]
    joint = effect.joints[0]
    unit = "m" if effect.units[joint] == "N" else "rad"
    listed = ", ".join(format_quantity(p, unit) for p in periods[:_LISTED])
    more = (
        f" and {len(periods) - _LISTED} more down to {format_quantity(periods[-1], unit)}"
        if len(periods) > _LISTED
        else ""
    )
    step, finer = (
        format_quantity(x, unit) for x in (compute_position_spacing(channel, joint), periods[-1] / _PER_PERIOD)
    )
    return replace(
        finding,
        status="suspected",
        gain=None,
        sentence=f"{joint} has a cyclic error, but at places {step} apart periods of {listed}{more} fit alike.",
        experiment=f"measure the tool while {joint} goes in steps of {finer} or less, or at as many places in uneven steps",
    )


def _sentence(before: OutputErrors, after: OutputErrors, named: Sequence[Finding], aliased: Sequence[Finding]) -> str:
    """Return what a colleague would say first."""
    one, other = (format_quantity(float(np.linalg.norm(e.rms)), "m") for e in (before, after))
    text = f"The measured tool is {one} (rms) from forward kinematics"
    if named:
        causes = " and ".join(f"{f.cause} ({', '.join(f.joints)})" for f in named)
        return f"{text}; with {causes} it is {other}."
    if aliased:
        return f"{text}. {aliased[0].sentence} These positions cannot tell which."
    return f"{text}, and no cause that we know explains any of it."
