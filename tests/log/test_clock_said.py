"""What a check says of a clock: a sentence for each fault by itself, at the limit and beyond it, and the numbers behind it."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.log import Log
from tau_dyn.log.check import check_clock


def log_of(t: np.ndarray) -> Log:
    return Log(t, {"q_axis": np.sin(t)}, name="monday.csv")


def said(t: np.ndarray, topic: str) -> tuple[str, str, str]:
    """Return severity, sentence and remedy of the one finding on a topic."""
    (found,) = [finding for finding in check_clock(log_of(t))[0] if finding.topic == topic]
    return found.severity, found.sentence, found.remedy


@pytest.mark.parametrize(
    ("dt", "unit", "scale"),
    [(0.5, "milliseconds", "0.001"), (4.0, "milliseconds", "0.001"), (199.0, "milliseconds", "0.001"),
     (200.0, "microseconds", "1e-6"), (4e3, "microseconds", "1e-6"), (1.9e5, "microseconds", "1e-6"),
     (2e5, "nanoseconds", "1e-9"), (4e6, "nanoseconds", "1e-9")],
)  # fmt: skip
def test_a_clock_in_another_unit_is_recognised_by_its_step(dt: float, unit: str, scale: str) -> None:
    """Machines log at 5 Hz to 2 kHz: a step of half a second or more is none of theirs."""
    severity, sentence, remedy = said(dt * np.arange(50), "sampling")
    assert severity == "fault" and sentence.endswith(f"The time step suggests {unit}.")
    assert f"scale: {scale}" in remedy


@pytest.mark.parametrize(
    ("dt", "n", "severity", "words"),
    [
        (0.49, 100, "warning", "The sampling rate is too low for accelerations."),
        (1 / 49.9, 1000, "warning", "The sampling rate is too low for accelerations."),
        (0.02, 1000, "ok", ""),
        (0.001, 4999, "warning", "The log is short."),
        (0.001, 5002, "ok", ""),
    ],
)
def test_slow_and_short_logs_are_told(dt: float, n: int, severity: str, words: str) -> None:
    """Fifty samples a second and five seconds are enough; with its samples, rate and length in numbers."""
    found, sentence, remedy = said(dt * np.arange(n), "sampling")
    assert found == severity and sentence.endswith(words or "s.")
    assert sentence.startswith(f"monday.csv has {n} samples at {1 / dt:.6g} Hz, {dt * (n - 1):.4g} s.")
    assert bool(remedy) is (severity != "ok")


@pytest.mark.parametrize(("jitter", "severity"), [(0.001, "ok"), (0.009, "ok"), (0.02, "warning")])
def test_jitter_is_told_in_per_cent_of_a_step(jitter: float, severity: str) -> None:
    """One sample late by a share of a step: a step longer and one shorter by it; 1 % is the limit."""
    t = 0.004 * np.arange(2000)
    t[700] += jitter * 0.004
    found, sentence, _ = said(t, "jitter")
    assert found == severity and sentence == f"monday.csv: steps differ from 0.004 s by up to {100 * jitter:.2g} %."
    assert check_clock(log_of(t))[1]["jitter"] == pytest.approx(jitter, abs=1e-9)


def test_rounded_stamps_are_told_as_such() -> None:
    """300 Hz in whole milliseconds: an even clock with too few digits, and neither jitter nor a gap."""
    t = np.round(np.arange(3000) / 300, 3)
    severity, sentence, remedy = said(t, "jitter")
    assert severity == "warning" and sentence == "monday.csv: uniform clock, rounded stamps."
    assert "more digits" in remedy and check_clock(log_of(t))[1]["times_rounded"] is True
    assert said(t, "gaps")[0] == "ok" and check_clock(log_of(0.004 * np.arange(2000)))[1]["times_rounded"] is False


@pytest.mark.parametrize(
    ("lost", "severity", "sentence"),
    [([], "ok", "monday.csv: no sample is missing."),
     ([500], "warning", "monday.csv: 1 sample is missing, never three in a row."),
     ([500, 501, 900], "warning", "monday.csv: 3 samples are missing, never three in a row."),
     ([500, 501, 502], "warning", "monday.csv has 1 gap in time: 0.016 s after t = 1.996 s; it is cut there, not bridged.")],
)  # fmt: skip
def test_lost_samples_are_counted_and_three_in_a_row_are_a_gap(lost: list[int], severity: str, sentence: str) -> None:
    """With where the gap is, and how long."""
    t = 0.004 * np.arange(2000)
    found = said(np.delete(t, lost), "gaps")
    assert found[:2] == (severity, sentence)
    numbers = check_clock(log_of(np.delete(t, lost)))[1]
    assert numbers["n_missing"] == len(lost) and numbers["n_samples"] == 2000 - len(lost)
    assert numbers["gaps"] == ([[pytest.approx(1.996), pytest.approx(2.012)]] if "gap" in sentence else [])
    assert numbers["duration"] == pytest.approx(1999 * 0.004) and numbers["rate_hz"] == pytest.approx(250)


@pytest.mark.parametrize(("gaps", "more"), [(3, ""), (4, " and 1 more"), (7, " and 4 more")])
def test_three_gaps_are_named(gaps: int, more: str) -> None:
    """The first three, and how many beyond."""
    t = 0.004 * np.arange(2000)
    for k in range(1, gaps + 1):
        t[200 * k :] += 0.1
    _, sentence, _ = said(t, "gaps")
    assert sentence.startswith(f"monday.csv has {gaps} gaps in time: 0.104 s after t = 0.796 s, ")
    assert sentence.count("after t") == 3 and sentence.endswith(f"{more}; it is cut there, not bridged.")
