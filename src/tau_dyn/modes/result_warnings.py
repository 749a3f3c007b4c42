"""What a careful colleague would mention about a result, as warnings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes.result import Modes

POOR_FIT = 50.0  # per cent of an output's standard deviation
MAX_RELATIVE_DAMPING_STDERR = 0.3
"""Standard error of a damping ratio over the ratio itself, beyond which it is hardly known."""
MAX_FIT_DROP_PERCENT = 10.0  # per cent from training to held-out data; more is overfitting or another machine
MIN_RECORD_PERIODS = 10  # of the slowest mode; fewer leave its damping open


def add_warnings(found: Modes) -> Modes:
    """Return the result with its doubts among the warnings."""
    parts = (_feedback, _order, _band, _modes, _fits, _nonlinearity, _tests)
    sentences = [sentence for part in parts for sentence in part(found)]
    return replace(found, warnings=tuple(dict.fromkeys((*found.warnings, *sentences))))


def _feedback(found: Modes) -> list[str]:
    if found.feedback.suspected and found.feedback.input:
        said = f"{found.feedback.why}: a loop was closed; log its reference and name it with --reference"
        return [CodedWarning("feedback_found", said)]
    return []


def _order(found: Modes) -> list[str]:
    limit = found.order_choice.limit
    if not limit:
        return []
    said = f"order {limit} is the highest that was looked at, and more states may help; try --order {2 * limit}"
    return [CodedWarning("order_at_limit", said)]


def _band(found: Modes) -> list[str]:
    seen = found.empirical.frequency[found.empirical.excited]
    if not len(seen):
        return ["the inputs hold no power anywhere that could be resolved; the response is not to be trusted"]
    out = [m.frequency_hz for m in found.modes if not 0.7 * seen.min() <= m.frequency_hz <= 1.3 * seen.max()]
    text = ", ".join(f"{f:.3g} Hz" for f in out)
    return [f"the inputs hold no power near {text}: do not take it for a resonance"] if out else []


def _modes(found: Modes) -> list[str]:
    vague = [
        m
        for m in found.modes
        if np.isfinite(m.damping_stderr) and m.damping_stderr > MAX_RELATIVE_DAMPING_STDERR * abs(m.damping_ratio)
    ]
    text = ", ".join(f"{m.frequency_hz:.3g} Hz" for m in vague)
    said = [f"the damping at {text} is known to worse than 30 %"] if vague else []
    duration = max(t.t[-1] for t in found.traces) if found.traces else 0.0
    if found.modes and duration * found.modes[0].frequency_hz < MIN_RECORD_PERIODS:
        said.append(
            f"the longest record holds fewer than {MIN_RECORD_PERIODS} periods of {found.modes[0].frequency_hz:.3g} Hz"
        )
    if not found.modes:
        said.append("the model has no resonance: all its poles are real")
    return said


def _fits(found: Modes) -> list[str]:
    said = []
    poor = [n for n, v in zip(found.outputs, found.judged.percent, strict=True) if v < POOR_FIT]
    if poor:
        said.append(
            f"the model follows {', '.join(poor)} to less than {POOR_FIT:.0f} %; noise, or a motion that is not linear"
        )
    if found.holdout is not None and found.train.mean - found.holdout.mean > MAX_FIT_DROP_PERCENT:
        said.append(
            f"the fit falls from {found.train.mean:.1f} to {found.holdout.mean:.1f} % on held-out data: "
            "too many states, or the plant changed"
        )
    return said


def _nonlinearity(found: Modes) -> list[str]:
    seen = found.nonlinearity
    if seen is None or not seen.suspected:
        return []
    what = "size (stiffness, friction)" if seen.power == 3 else "sign (preload, play on one side)"
    said = (
        f"{seen.output} responds nonlinearly to its {what}: powers of the response explain {100 * seen.share:.0f} % of the "
        f"residual (p = {seen.p_value:.1g}); modes hold for this level of force only"
    )
    return [CodedWarning("response_nonlinear", said)]


def _tests(found: Modes) -> list[str]:
    failed = [t for t in found.independence if not t.passed]
    if not failed:
        return []
    worst = min(failed, key=lambda t: t.p_value)
    what = f"what the model leaves of {worst.output} still answers to {worst.input}"
    return [f"{what} (p = {worst.p_value:.1g}): dynamics are missing; try a higher order, or mind nonlinear friction"]
