"""A counted clock hides what the logger lost; the motion shows it."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.log import Log, check_log, list_data_warnings, mend_log
from tau_dyn.log.data_integrity import find_lost_samples, find_repeated_rows, repair_log
from tau_dyn.message_codes import RepairedWarning, get_code


def recounted(log: Log, rows: np.ndarray) -> Log:
    """Return rows of a log under an even, counted clock."""
    rows = rows[: log.n_samples]
    return Log(log.t[: len(rows)], {key: x[rows] for key, x in log.channels.items()}, log.name)


def codes(log: Log) -> set[str]:
    """Return the codes of what the data alone show."""
    return {get_code(warning) for warning in list_data_warnings(log)}


@pytest.mark.parametrize("share", [0.002, 0.01, 0.05])
def test_lost_samples_are_found_where_they_were_lost(axis_log, rng, share: float) -> None:
    """A mass does not leap: each leap by a whole number of sample steps is a loss, and is found within a sample."""
    lost = rng.random(axis_log.n_samples) < share
    log = recounted(axis_log, np.flatnonzero(~lost))
    found = find_lost_samples(log)
    assert found.alarm and np.all(found.steps > 0) and codes(log) == {"lost_samples"}
    places = np.flatnonzero(lost) - np.arange(np.count_nonzero(lost)) - 1
    assert np.mean(np.min(np.abs(found.after[:, None] - places[None]), axis=1) <= 1) > 0.98
    assert len(found.after) > 0.6 * len(places)


def test_a_sound_log_has_lost_nothing(axis_log) -> None:
    """Encoder noise and acceleration are no leaps."""
    assert not len(find_lost_samples(axis_log).after) and codes(axis_log) == set()


def test_knocks_are_no_lost_samples(axis_log, rng) -> None:
    """Leaps of any size do not prefer whole steps, so the half integers outvote them."""
    q = axis_log.channels["q_axis"].copy()
    at = rng.integers(100, 19900, 60)
    step = np.abs(np.diff(q)).mean()
    for k in at:
        q[k:] += step * rng.uniform(0.5, 8.5)
    found = find_lost_samples(axis_log.with_channels(q_axis=q))
    assert not found.alarm


def test_samples_that_stand_twice(axis_log, rng) -> None:
    """A line written twice puts the motion back by a step; a stale line in place of a lost one leaves it where it was."""
    n = axis_log.n_samples
    twice = recounted(axis_log, np.sort(np.concatenate([np.arange(n), rng.integers(10, n, 80)])))
    stale = np.arange(n)
    stale[rng.integers(10, n, 80)] -= 1
    assert codes(twice) == {"repeated_samples"}
    assert codes(recounted(axis_log, stale)) == {"repeated_samples"}
    assert len(find_repeated_rows(recounted(axis_log, stale))) > 40


def test_a_clock_with_few_losses_is_mended(axis_log, rng) -> None:
    """With the losses as gaps in the clock, every sample stands within a sample step of its own time again."""
    keep = np.flatnonzero(rng.random(axis_log.n_samples) > 0.003)
    log = recounted(axis_log, keep)
    mended = mend_log(log)
    error = np.abs(mended.t - axis_log.t[keep]) / axis_log.dt
    assert np.abs(log.t - axis_log.t[keep]).max() / axis_log.dt > 40
    assert np.median(error) < 12 and not find_lost_samples(mended).alarm
    assert mend_log(axis_log) is axis_log


def test_too_many_losses_are_not_mended(axis_log, rng) -> None:
    """One in twenty is lost: what passes unseen at low speed shifts everything behind it."""
    log = recounted(axis_log, np.flatnonzero(rng.random(axis_log.n_samples) > 0.05))
    assert mend_log(log) is log
    check = check_log(log)
    assert not check.fit_for_use
    assert "lost_samples" in [finding.get("code") for finding in check.to_dict()["findings"]]


def test_a_measured_clock_is_believed(axis_log, rng) -> None:
    """Stamps that show the loss need no test."""
    keep = np.flatnonzero(rng.random(axis_log.n_samples) > 0.01)
    log = Log(axis_log.t[keep], {key: x[keep] for key, x in axis_log.channels.items()})
    assert codes(log) == set()


def test_a_quick_reversal_is_no_loss(rng):
    """A joint that turns back with a jump of its acceleration leaps over nothing."""
    t = np.arange(0, 40, 0.004)
    v = 0.04 * np.clip(4 * np.sin(2 * np.pi * t / 2.4), -1, 1)
    q = np.cumsum(v) * 0.004 + 2e-6 * rng.standard_normal(len(t))
    assert not find_lost_samples(Log(t, {"q_a": q}, "strokes.csv")).alarm


def test_a_mended_clock_leaps_where_the_samples_were_lost(axis_log) -> None:
    """Thirty samples lost in fast motion: nearly each leap of the mended clock is one step long and stands at its place."""
    speed = np.abs(np.gradient(axis_log.channels["q_axis"]))
    fast = np.flatnonzero(speed[200:-200] > 0.6 * speed.max()) + 200
    lost = fast[:: len(fast) // 30][:30]
    lost = lost[np.diff(lost, prepend=-1000) > 60]
    keep = np.setdiff1d(np.arange(axis_log.n_samples), lost)
    mended = mend_log(recounted(axis_log, keep))
    leaps = np.flatnonzero(np.diff(mended.t) > 1.5 * axis_log.dt)
    assert len(np.intersect1d(leaps, np.flatnonzero(np.diff(keep) == 2))) > 0.7 * len(lost) > 10


@pytest.mark.parametrize("share", [0.026, 0.1])
def test_many_stale_rows_are_left_out(axis_log, rng, share: float) -> None:
    """A row that repeats the one before under a clock that goes on is no measurement; every other row keeps its time."""
    n = axis_log.n_samples
    stale = np.arange(n)
    stale[1:] -= rng.random(n - 1) < share
    log = recounted(axis_log, stale)
    warning, *filled = list_data_warnings(log)
    assert get_code(warning) == "repeated_samples" and isinstance(warning, RepairedWarning)
    assert all("interpolated" in note and isinstance(note, RepairedWarning) for note in filled), (
        "three stale rows in a row"
    )
    mended = mend_log(log)
    assert mended.n_samples < (1 - 0.8 * share) * n and check_log(log).fit_for_use
    kept = np.round(mended.t / axis_log.dt).astype(int)
    assert np.mean(mended.channels["tau_axis"] == axis_log.channels["tau_axis"][kept]) > 1 - 1.2 * share**2


def test_inserted_rows_move_up_what_follows(axis_log, rng) -> None:
    """A line written twice shifts all later times by a step; one in fifty is mended to the sample."""
    n = axis_log.n_samples
    twice = np.sort(np.concatenate([np.arange(n), rng.choice(np.arange(10, n), n // 50, replace=False)]))
    mended = mend_log(recounted(axis_log, twice))
    kept = np.searchsorted(axis_log.t, mended.t - 1e-6)
    assert np.mean(mended.channels["tau_axis"] == axis_log.channels["tau_axis"][kept]) > 0.95


def test_too_many_losses_remain_a_fault(axis_log, rng) -> None:
    """What cannot be mended is no `RepairedWarning`; what can is one."""
    for share, mended in ((0.05, False), (0.003, True)):
        log = recounted(axis_log, np.flatnonzero(rng.random(axis_log.n_samples) > share))
        (warning,) = list_data_warnings(log)
        assert isinstance(warning, RepairedWarning) is mended


def test_a_reading_of_before_a_gap_is_left_out(axis_log) -> None:
    """Behind each of three gaps of half a second the first sample still holds the old position; one that moves on does not."""
    q = axis_log.channels["q_axis"]
    keep = np.ones(axis_log.n_samples, bool)
    starts = (3000, 9000, 15000)
    for k in starts:
        keep[k : k + 500] = False
    gappy = Log(axis_log.t[keep], {key: x[keep] for key, x in axis_log.channels.items()}, "gappy.csv")
    assert not any(get_code(w) == "held_channel" for w in repair_log(gappy).warnings)
    stale = q.copy()
    for k in starts:
        stale[k + 500] = stale[k - 1]
    repaired = repair_log(gappy.with_channels(q_axis=stale[keep]))
    (warning,) = (w for w in repaired.warnings if get_code(w) == "held_channel")
    moved = [k for k in starts if abs(q[k + 501] - q[k - 1]) > 0.005]
    assert len(moved) >= 2 and f"{len(moved)} samples behind gaps" in warning
    assert repaired.log.n_samples == gappy.n_samples - len(moved)
