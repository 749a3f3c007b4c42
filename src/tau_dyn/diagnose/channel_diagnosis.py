"""A channel of displacements -> its diagnosis: the search, confirmation and measurement that forces have, without their physics.

The baseline is whatever the channel may refit (zeros, a frame); no mass has to stay positive, no parameter is checked against a
nominal, and encoder noise does not become a force.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tau_dyn.diagnose.candidate_scan import N_NULL_DRAWS
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.channel_pipeline import (
    HELD_OUT,
    SHARED,
    Answer,
    build_diagnosis,
    build_findings,
    select_confirmed,
    select_supported,
)
from tau_dyn.diagnose.detection_limits import compute_detection_limits
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL
from tau_dyn.diagnose.internal_validation import confirm_all
from tau_dyn.diagnose.recommendation import recommend
from tau_dyn.diagnose.result import Diagnosis, Finding, OutputErrors, Unexplained
from tau_dyn.diagnose.stepwise_selection import select_causes
from tau_dyn.diagnose.unexplained import build_unexplained
from tau_dyn.diagnose.unknown_structure import find_structure
from tau_dyn.effects import format_quantity
from tau_dyn.model import Model


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
    hunt = select_causes(channel, rng, progress)
    progress("confirming")
    structure = find_structure(channel, hunt.ground, hunt.ground.draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
    tests = confirm_all(channel, hunt, structure)
    claims = select_confirmed(channel, hunt, tests.causes)
    unexplained = build_unexplained(channel, hunt, tests.structure)
    progress("measuring the gain")
    claims, bars = select_supported(channel, hunt, claims, rng)
    findings = build_findings(channel, hunt, claims, bars, rng)
    limits, untestable = compute_detection_limits(channel, hunt, [f.cause for f in findings])
    named = [f for f in findings if f.status == "confirmed"]
    open_end = any(u.status == "confirmed" for u in unexplained)
    answer = Answer(
        "named" if named else "unexplained" if open_end else "nothing_found",
        _sentence(channel, bars.judgements[0].errors, bars.judgements[-1].errors, named, unexplained),
        (HELD_OUT if held else SHARED).format(what="logs"),
        findings,
        unexplained,
        limits,
        untestable,
        warnings=warnings,
    )
    return build_diagnosis(
        channel, hunt, claims, bars, model, answer, seed, recommend(channel, hunt, claims, bars, rng)
    )


def _sentence(
    channel: Channel,
    before: OutputErrors,
    after: OutputErrors,
    named: Sequence[Finding],
    unexplained: Sequence[Unexplained],
) -> str:
    """Return what a colleague would say first."""
    one, other = (
        ", ".join(
            f"{format_quantity(float(r), u)} at {o}" for r, u, o in zip(e.rms, channel.units, e.outputs, strict=True)
        )
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
