"""The clock of a log: rate, jitter, lost samples, gaps, rounded stamps, wrong units.

Part of `check.py`. The measuring is in `resample.py`; here its numbers become sentences.
"""

from typing import Any

from tau_dyn.log.check_result import CheckFinding
from tau_dyn.log.column_names import count
from tau_dyn.log.log import Log
from tau_dyn.log.resample import MAX_RELATIVE_JITTER, Clock, describe_gaps, examine_clock

MIN_RATE_HZ = 50.0
"""Below this rate [Hz] accelerations of a machine can hardly be had from positions."""

_UNITS = ((2e5, "nanoseconds", "1e-9"), (200.0, "microseconds", "1e-6"), (0.5, "milliseconds", "0.001"))
"""Steps from which a clock reads like another unit, as machines log at 5 Hz to 2 kHz, and its scale to seconds."""

MIN_DURATION_S = 5.0
"""Shorter logs [s] rarely hold enough independent motion."""


def check_clock(log: Log) -> tuple[list[CheckFinding], dict[str, Any]]:
    """Judge the clock of a log.

    Returns:
        Findings, and the numbers `n_samples`, `duration` [s], `rate_hz`, `jitter` (share of a step), `n_missing`,
        `gaps` (from, to) [s] and `times_rounded`.
    """
    clock = examine_clock(log)
    numbers = {
        "n_samples": log.n_samples,
        "duration": log.duration,
        "rate_hz": 1.0 / clock.dt,
        "jitter": clock.jitter,
        "n_missing": clock.n_missing,
        "gaps": [[float(log.t[i]), float(log.t[i + 1])] for i in clock.gaps],
        "times_rounded": clock.rounded,
    }
    return [_rate(log, clock), _evenness(log, clock), *_gaps(log, clock)], numbers


def _rate(log: Log, clock: Clock) -> CheckFinding:
    rate = 1.0 / clock.dt
    what = f"{log.name} has {log.n_samples} samples at {rate:.6g} Hz, {log.duration:.4g} s."
    if clock.dt >= 0.5:
        unit, scale = next((name, scale) for least, name, scale in _UNITS if clock.dt >= least)
        remedy = f"Give t in s: `t: {{column: t, scale: {scale}}}` in a column map (--columns)."
        return CheckFinding("fault", "sampling", f"{what} The time step suggests {unit}.", remedy)
    if rate < MIN_RATE_HZ:
        return CheckFinding(
            "warning", "sampling", f"{what} The sampling rate is too low for accelerations.", "Log at 250 Hz or more."
        )
    if log.duration < MIN_DURATION_S:
        return CheckFinding("warning", "sampling", f"{what} The log is short.", "Record 10 s or more of varied motion.")
    return CheckFinding("ok", "sampling", what)


def _evenness(log: Log, clock: Clock) -> CheckFinding:
    if clock.rounded:
        sentence = f"{log.name}: uniform clock, rounded stamps."
        return CheckFinding("warning", "jitter", sentence, "Write more digits; a uniform clock is used.")
    sentence = f"{log.name}: steps differ from {clock.dt:.6g} s by up to {100 * clock.jitter:.2g} %."
    if clock.jitter > MAX_RELATIVE_JITTER:
        return CheckFinding("warning", "jitter", sentence, "Stamp samples in the real-time loop; the log is resampled.")
    return CheckFinding("ok", "jitter", sentence)


def _gaps(log: Log, clock: Clock) -> list[CheckFinding]:
    if clock.gaps:
        return [
            CheckFinding(
                "warning",
                "gaps",
                describe_gaps(log, clock),
                "Record without interruption; the parts are used separately.",
            )
        ]
    if clock.n_missing:
        lost = f"{count(clock.n_missing, 'sample')} {'is' if clock.n_missing == 1 else 'are'}"
        sentence = f"{log.name}: {lost} missing, never three in a row."
        return [
            CheckFinding(
                "warning", "gaps", sentence, "Give the logger more priority; missing samples are interpolated."
            )
        ]
    return [CheckFinding("ok", "gaps", f"{log.name}: no sample is missing.")]
