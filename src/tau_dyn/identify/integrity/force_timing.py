"""Time of the force relative to the motion, before the fit: late, early, or low-passed by its drive.

A force that is logged late by `d` is `tau(t - d)`, to first order `tau - d * dtau/dt`; a drive that filters it gives `tau / (1
+ T s)`. The jerk separates both from wrong parameters: no body and no friction makes a force like the rate of the whole force.
`free_fit.py` finds the delays of all joints on an excerpt.

A delay is reported if it exceeds one sample and 8 standard errors, and either all joints agree on it or it removes two fifths
of the joint's residual power: load-dependent friction or an elastic drive also leave a trace of jerk, in single joints. It must
hold with the zeros of the joints fitted as well: positions that are off by a constant miss the force by its slope, and the rate
of the force imitates a part of that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.identify.integrity.excerpt import Excerpt
from tau_dyn.identify.integrity.free_fit import ForceDelay, FreeFit
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

MIN_DELAY_Z = 8.0
"""Least size of a delay in its standard errors: jerk-like model errors of sound robots reach 5."""

MIN_DELAY_SAMPLES = 0.7
"""Smaller delays are the hold of a sampled force, half a sample [samples]."""

MIN_POWER_REMOVED = 0.4
"""Share of a joint's residual power that its delay must remove to be reported for this joint alone."""

MIN_POWER_REMOVED_TOGETHER = 0.2
"""The same, on average, if all joints agree on one delay."""

AGREEMENT = 0.3
"""Joints agree on a delay if theirs are within this share of the mean, or within three standard errors."""

LAG_GAIN_NATS = 5.0
"""Log-likelihood gain [nats] from which a lag and a delay are distinguished."""


def check_timing(robot: Robot, excerpt: Excerpt, name: str) -> list[CodedWarning]:
    """Return the warning `force_late` or `force_lowpassed` of a log, with evidence and remedy.

    Args:
        robot: The robot file; only its geometry counts.
        excerpt: Its log.
        name: The log's name, for the sentences.
    """
    fitter = FreeFit.of(robot, excerpt)
    if fitter is None:
        return []
    found = fitter.delays()
    late = _believed(found, excerpt.log.dt)
    if late.any():
        fitter = fitter.with_zeros(robot)
        found = fitter.delays()
        late = _believed(found, excerpt.log.dt)
    if not late.any():
        return []
    return [_say(robot, name, found, late, _gain_of_lag(fitter, found, late), excerpt.log.dt)]


def _gain_of_lag(fitter: FreeFit, found: ForceDelay, late: np.ndarray) -> float:
    """Return the log-likelihood gain [nats] of a first-order lag over a delay for the joints that are late."""
    late = late & (found.delay_s > 0)
    if not late.any():
        return -np.inf
    by_lag = fitter.residual_with_lags(np.where(late, found.delay_s, 0.0))
    ratio = np.log(np.maximum(found.residual[late], 1e-300) / np.maximum(by_lag[late], 1e-300))
    return float(fitter.used.sum(axis=0)[late] @ ratio / 2)


def _believed(found: ForceDelay, dt: float) -> np.ndarray:
    """Return the joints whose delays are significant (na,)."""
    z = np.abs(found.delay_s) / found.stderr_s
    large = np.abs(found.delay_s) > MIN_DELAY_SAMPLES * dt
    alone = found.judged & large & (z > MIN_DELAY_Z) & (found.removed > MIN_POWER_REMOVED)
    weight = np.where(found.judged, found.stderr_s**-2.0, 0.0)
    mean = float(weight @ found.delay_s / max(weight.sum(), 1e-300))
    near = np.abs(found.delay_s - mean) < np.maximum(AGREEMENT * abs(mean), 3 * found.stderr_s)
    together = (
        found.judged.sum() >= 2
        and bool(np.all(near | ~found.judged))
        and abs(mean) > MIN_DELAY_SAMPLES * dt
        and abs(mean) * np.sqrt(weight.sum()) > MIN_DELAY_Z
        and np.count_nonzero(found.judged & (z > 3)) >= 2
        and float(np.mean(found.removed[found.judged & (z > 3)])) > MIN_POWER_REMOVED_TOGETHER
    )
    return found.judged if together else alone


def _say(robot: Robot, name: str, found: ForceDelay, late: np.ndarray, gain: float, dt: float) -> CodedWarning:
    """Return the warning of a delay or a lag: the mean if all joints are late, else the largest."""
    chosen: Sequence[int] = np.flatnonzero(late).tolist()
    weight = found.stderr_s[late] ** -2.0
    mean = float(weight @ found.delay_s[late] / weight.sum())
    of = ", ".join(robot.actuated[k] for k in chosen)
    size = (
        f"{1e3 * abs(mean):.3g} ms ({abs(mean) / dt:.2g} samples, standard error {1e3 * weight.sum() ** -0.5:.1g} ms)"
    )
    removed = (
        f"taking that into account removes {100 * float(np.max(found.removed[late])):.0f} % of the residual's power"
    )
    if mean > 0 and gain > LAG_GAIN_NATS:
        words = (
            f"{name}: the force of {of} is low-passed: a first-order lag of about {size} explains it better than a delay; "
            f"{removed}. Log the drive's force before its filter, or low-pass the positions with the same filter"
        )
        return CodedWarning("force_lowpassed", words + ".")
    alike = " (a first-order lag of as much would look the same)" if mean > 0 and gain > -LAG_GAIN_NATS else ""
    direction = "late" if mean > 0 else "early"
    words = (
        f"{name}: the force of {of} is {direction} by {size}{alike}; {removed}. Give all channels one clock: shift tau by "
        "that time before use, and look where the logger takes its values"
    )
    return CodedWarning("force_late", words + ".")
