"""Which model to use: the extended one, the refitted one, or neither; a result with its reason.

`extended` asks that the held-out error of the causes' joints falls with its 95 % interval above zero, and that no joint becomes
significantly worse. `neither` says that the held-out logs are not of the machine that was trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.diagnose.candidate_scan import get_columns
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.channel_pipeline import Claims, Waterfall, is_worse
from tau_dyn.diagnose.confirm import confirm
from tau_dyn.diagnose.data_split import TEST, TRAIN, VALIDATION
from tau_dyn.diagnose.extended_fit import EvaluatedFit, compute_gain
from tau_dyn.diagnose.result import Choice, Gain
from tau_dyn.diagnose.stepwise_selection import StepwiseSelection, build_effects
from tau_dyn.identify import MAX_HELD_OUT_RATIO, describe_foreign_joints


class Recommendation(NamedTuple):
    """What to use, and why, in a sentence; and what to warn of."""

    choice: Choice
    why: str
    warnings: Sequence[str] = ()


def recommend(
    channel: Channel, hunt: StepwiseSelection, claims: Claims, bars: Waterfall, rng: np.random.Generator
) -> Recommendation:
    """Return the recommendation.

    Args:
        channel: The data.
        hunt: The search.
        claims: Causes, with those that stand.
        bars: The waterfall.
        rng: For intervals.
    """
    before, after = bars.judgements[0], bars.judgements[-1]
    if foreign := describe_foreign_joints(find_foreign_joints(channel, after)):
        return Recommendation("neither", str(foreign[0]), foreign)
    if bars.nominal is not None and is_worse(loss := _whole_gain(channel, bars.nominal, before, rng)):
        more = -loss.reduction_percent
        why = f"the held-out error of the refitted model is {more:.2g} % larger than with the robot file's values"
        return Recommendation("neither", why)
    if not claims.kept:
        return Recommendation("refitted", "no cause is confirmed")
    worse = [
        (joint, -gain.reduction_percent)
        for joint in channel.outputs
        if is_worse(gain := compute_gain(channel, before.residuals, after.residuals, [joint], rng))
    ]
    if worse:
        listed = ", ".join(f"{joint} by {loss:.2g} %" for joint, loss in worse)
        return Recommendation("refitted", f"the confirmed causes increase the held-out error at {listed}")
    effects = build_effects(claims.kept)
    joints = {joint for effect in effects for joint in effect.joints}
    shown = confirm(channel, hunt.noise, get_columns(hunt.library, effects), (), TEST, fitted_on=(TRAIN, VALIDATION))
    gain = compute_gain(channel, before.residuals, after.residuals, sorted(joints), rng, shown)
    low, high = gain.ci95
    if low <= 0:
        return Recommendation(
            "refitted", f"the held-out error does not fall significantly (95 % interval [{low:.2g}, {high:.2g}] %)"
        )
    why = f"the held-out error of the causes' joints falls by {gain.reduction_percent:.2g} %"
    return Recommendation("extended", f"{why} (95 % interval [{low:.2g}, {high:.2g}] %), and no joint becomes worse")


def find_foreign_joints(channel: Channel, fit: EvaluatedFit) -> list[tuple[str, float]]:
    """Return the outputs whose held-out rms is many times the training rms, with the ratio; none without held-out logs."""
    if not any(np.all(part == TRAIN) for part in channel.parts):
        return []
    found = []
    for k, output in enumerate(channel.outputs):
        trained, held = (_rms(channel, fit.residuals, parts, k) for parts in ((TRAIN,), (VALIDATION, TEST)))
        if trained > 0 and held > MAX_HELD_OUT_RATIO * trained:
            found.append((output, held / trained))
    return found


def _rms(channel: Channel, residuals: Sequence[np.ndarray], parts: tuple[int, ...], k: int) -> float:
    masks = channel.masks(*parts)
    e = np.concatenate([x[m[:, k], k] for x, m in zip(residuals, masks, strict=True)])
    return float(np.sqrt(np.mean(e**2))) if len(e) else 0.0


def _whole_gain(channel: Channel, one: EvaluatedFit, other: EvaluatedFit, rng: np.random.Generator) -> Gain:
    return compute_gain(channel, one.residuals, other.residuals, channel.outputs, rng)
