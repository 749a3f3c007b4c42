"""Losses on the way to the file that a log shows by itself: coded warnings, and the mended log.

All tests look at raw stamps and raw columns, because interpolation and filters hide the losses. A fault that is mended or whose
samples are left out is a `RepairedWarning`, which blocks no result. Only faults that remain in the data can bias a result.

**Low update rates** (`update_rate.py`). If channels are held or interpolated from a lower rate, only the updates are used.

**Doubled channels.** One joint's positions or forces that equal another's to the last digit come from a wrong index.

**Frozen channels** (`signal_checks.py`, `check_motion.py`). Positions and forces that keep one value while the joint moves, and
forces that are only noise about one, are left out.

**Repeated samples.** A row that equals the row before in all positions and forces, while the joints move, is no measurement.
If the next row is two steps ahead, the clock went on, and leaving the row out is exact, however many there are. If it is one
step ahead, the row was inserted, and all later times are moved up.

**Lost samples.** A logger that numbers its samples hides its losses: the stamps stay even and the motion jumps. Each step
between two samples is compared with a local polynomial through its neighbours (Savitzky & Golay 1964), stretched after the step
by `s` sample steps that all joints share:

    q_j(i) = p_j(i)  up to the step,    q_j(i) = p_j(i + s)  behind it

A lost sample gives s = 1, one inserted twice s = -1. `z` is the estimate of `s` over its standard error. Steps with z > 10 and
`s` within 0.25 of a nonzero integer are events. Other causes (a knock, a rough motion) have no reason to prefer
integers, so steps nearer to the half integers are counted as a control. Alarm: three events, and more than twice the control.

**Scattered stamps** (`update_rate.py`). Stamps of a logger that follow the device's even clock loosely are replaced by that
clock. **Short gaps** (`resample.py`) are filled if the rows around them determine the missing ones.

**Forces that drop out.** A missing measurement is often written as zero or as the value before. A zero run is a stretch of
exact zeros whose two neighbours are six typical steps off, on the same side: a force that passes through zero changes its
side. A held run is a stretch of three or more exactly equal values in a channel that otherwise hardly ever repeats a value.
Short zero runs are interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.check_motion import find_clipped_force, find_dead_force, find_moving_samples, find_slip, find_stuck_bit
from tau_dyn.log.filtering import estimate_quantisation_step
from tau_dyn.log.log import Log
from tau_dyn.log.resample import examine_clock, fill_short_gaps, find_true_runs, interpolate
from tau_dyn.log.signal_checks import FrozenStretch, find_constant_runs, find_frozen_force, find_frozen_positions
from tau_dyn.log.update_rate import UpdateRate, find_device_clock, find_update_rates, sample_at_updates
from tau_dyn.message_codes import CodedWarning, RepairedWarning
from tau_dyn.results import count, format_list

MIN_STEPS_OFF = 6.0
"""Distance of the neighbours from zero, in median changes of a sample; noise passes four in 1 of 1000 samples."""

MIN_DROPOUTS = 3
"""Least number of runs that are beyond chance."""

MIN_HELD = 3
"""Least samples of a held run; a rounded channel may repeat a value once."""

MAX_REPEATS = 0.02
"""Share of pairs of equal neighbours above which a channel repeats by rounding and held runs cannot be recognised."""

STALE_COUNTS, STALE_SHARE = 10.0, 4.0
"""Least step behind a gap, in smallest steps and over the step after it, from which the reading there was one of before it."""

MAX_RUN_S = 0.5
"""Longer zeros [s] mean a drive that is off, or a frozen channel, which has a test of its own."""


def find_zero_runs(log: Log, joint: str) -> NDArray[np.intp]:
    """Return the first sample (n,) of each run of zero force between forces of the same sign far from zero."""
    x = log.channels[f"tau_{joint}"]
    steps = np.abs(np.diff(x))
    steps = steps[steps > 0]
    runs = find_constant_runs(x)
    if steps.size < 20 or len(runs.starts) < 3:
        return np.zeros(0, np.intp)
    least = MIN_STEPS_OFF * float(np.median(steps))
    inner = np.flatnonzero((runs.values[1:-1] == 0) & (runs.lengths[1:-1] * log.dt <= MAX_RUN_S)) + 1
    before, behind = x[runs.starts[inner] - 1], x[runs.starts[inner] + runs.lengths[inner]]
    far = (np.minimum(np.abs(before), np.abs(behind)) > least) & (before * behind > 0)
    return runs.starts[inner[far]]


def find_held_runs(log: Log, column: str) -> NDArray[np.intp]:
    """Return the first sample (n,) of each run of held values with a jump at its end, in a channel that hardly repeats itself."""
    x = log.channels[column]
    runs = find_constant_runs(x)
    if np.count_nonzero(runs.lengths == 2) > MAX_REPEATS * log.n_samples or len(runs.starts) < 20:
        return np.zeros(0, np.intp)
    far = np.abs(np.diff(runs.values)) > MIN_STEPS_OFF * float(np.median(np.abs(np.diff(runs.values))))
    held = (runs.lengths >= MIN_HELD) & (runs.values != 0)
    return runs.starts[:-1][held[:-1] & far]


MAX_FILLED = 3
"""Longest zero run [samples] that is interpolated, as one or two lost samples are (`resample.py`)."""


def _mend_dropouts(log: Log, joints: Sequence[str]) -> Repair:
    """Interpolate forces over short zero runs, and list held runs, which are left in."""
    found, filled = [], {}
    for joint in joints:
        column = f"tau_{joint}"
        if column not in log.channels:
            continue
        zero = find_zero_runs(log, joint)
        if len(zero) >= MIN_DROPOUTS:
            filled[column], whole = _interpolate_zeros(log.channels[column], zero)
            kind = RepairedWarning if whole else CodedWarning
            remedy = (
                "they are interpolated. Log the drive's force without gaps."
                if whole
                else "Leave these samples out by a column that flags them (--exclude), or log the drive's force without gaps."
            )
            sentence = (
                f"{log.name}: {column} is exactly zero in {count(len(zero), 'place')} where the force before and after is far "
                f"from it, first at t = {log.t[zero[0]]:.6g} s: readings were lost{'; ' if whole else '. '}{remedy}"
            )
            found.append(kind("zero_force_runs", sentence))
        held = find_held_runs(log, column)
        if len(held) >= MIN_DROPOUTS:
            sentence = (
                f"{log.name}: {column} stands still for {MIN_HELD} samples or more in {count(len(held), 'place')}, first at "
                f"t = {log.t[held[0]]:.6g} s, and changes with each sample elsewhere: the logger repeats its last reading. Leave "
                "these samples out (--exclude), or log the drive's force without gaps."
            )
            found.append(CodedWarning("held_channel", sentence))
    return Repair(log.with_channels(**filled) if filled else log, found)


def _interpolate_zeros(x: NDArray[np.float64], starts: NDArray[np.intp]) -> tuple[NDArray[np.float64], bool]:
    """Return a force (N,) with straight lines over its short zero runs, and whether all of them are short."""
    runs = find_constant_runs(x)
    chosen = np.isin(runs.starts, starts)
    short = chosen & (runs.lengths <= MAX_FILLED)
    lost = np.repeat(short, runs.lengths)
    i = np.arange(len(x))
    return np.where(lost, np.interp(i, i[~lost], x[~lost]), x), bool(np.array_equal(chosen, short))


MIN_Z = 10.0
"""Least size of a stretch in its standard errors; encoder noise alone reaches 5 in a million steps."""

INTEGER_MARGIN = 0.25
"""Largest distance of a stretch from an integer [sample steps]; the half integers' share of the axis is the same."""

MIN_EVENTS = 3
"""Least number of events that are beyond chance: a single one can be a knock."""

MAX_STRETCH = 30
"""Larger stretches [sample steps] are jumps of the position, which have a test of their own."""

MAX_MENDED_SHARE = 0.01
"""Above this share of events among moving steps the clock is not mended: each unseen loss shifts what follows."""

MIN_NET_SHARE = 0.8
"""Least net over total travel in a window for a joint to count: near a reversal, motion back looks like many lost samples."""

_WINDOWS = ((3, 2), (6, 3), (12, 3))
"""Samples on each side and degree of the polynomial: short for fast motions, long for noisy encoders."""

_EXTENDED = 1e-9
"""Rounding of positions, as a share of their range: the least noise of a simulated encoder."""


class LostSamples(NamedTuple):
    """Samples at which a counted clock is wrong.

    Attributes:
        after: Samples after which the clock is wrong (n,).
        steps: Sample steps to be inserted there (n,); negative if samples occur twice.
        n_control: Steps that a half integer would explain.
        n_tested: Steps at which one lost sample would be seen.
    """

    after: NDArray[np.intp]
    steps: NDArray[np.intp]
    n_control: int
    n_tested: int

    @property
    def alarm(self) -> bool:
        """True if samples are missing or occur twice, beyond chance."""
        return len(self.after) >= MIN_EVENTS and len(self.after) > 2 * self.n_control


_NONE = LostSamples(np.zeros(0, np.intp), np.zeros(0, np.intp), 0, 0)


def find_lost_samples(log: Log, joints: Sequence[str] = ()) -> LostSamples:
    """Find lost and inserted samples under an even clock.

    Args:
        log: A log as read; a measured (uneven) clock shows its losses by itself and is not tested.
        joints: The joints to look at; by default all that have a `q`.
    """
    names = tuple(joints) or log.joints("q")
    looked_at = _LOOKED_AT.setdefault(log, {})
    if names not in looked_at:
        looked_at[names] = _find_lost_samples(log, names)
    return looked_at[names]


_LOOKED_AT: WeakKeyDictionary[Log, dict[tuple[str, ...], LostSamples]] = WeakKeyDictionary()
"""Lost samples of logs in use: a log is judged first and mended later."""


def _find_lost_samples(log: Log, names: tuple[str, ...]) -> LostSamples:
    clock = examine_clock(log)
    if not names or log.n_samples < 50 or not (clock.even or clock.rounded):
        return _NONE
    q = log.joint("q", names)
    q = q[:, np.ptp(q, axis=0) > 0]
    q = q[:, ~np.array([_is_held(x) for x in q.T], bool)] if q.shape[1] else q
    if not q.shape[1]:
        return _NONE
    floor = np.maximum(estimate_quantisation_step(q) / np.sqrt(12), _EXTENDED * np.ptp(q, axis=0))
    stretch, z, best, visible = (np.zeros(len(q) - 1) for _ in range(4))
    for half, degree in _WINDOWS:
        s, certainty, unit = _stretches(q, half, degree, floor)
        better = certainty > z
        stretch[better], z[better], best[better] = s[better], certainty[better], half
        visible = np.maximum(visible, unit)
    return _sort(stretch, z, best, int(np.count_nonzero(visible > MIN_Z)))


def find_repeated_rows(log: Log, joints: Sequence[str] = ()) -> NDArray[np.intp]:
    """Return samples (n,) at which no position and no force changes although the neighbours move.

    A joint surely moves if the mean of four steps around exceeds six of their standard deviations and one encoder step.
    """
    names = tuple(joints) or log.joints("q")
    columns = [log.channels[f"q_{joint}"] for joint in names if log.has("q", [joint])]
    forces = [log.channels[f"tau_{joint}"] for joint in names if log.has("tau", [joint])]
    if not columns or log.n_samples < 50:
        return np.zeros(0, np.intp)
    same = np.all([np.diff(x) == 0 for x in (*columns, *forces)], axis=0)
    if not same.any() or same.mean() > 0.4:  # held channels have a test of their own
        return np.zeros(0, np.intp)
    moving = np.zeros(len(same), bool)
    for x in columns:
        steps = np.diff(x)
        around = np.stack([np.roll(steps, shift) for shift in (2, 3, -2, -3)])
        mean, spread = around.mean(axis=0), np.ptp(around, axis=0)
        moving |= (np.abs(mean) > 1.9 * float(estimate_quantisation_step(x))) & (np.abs(mean) > 3 * spread)
    moving[:3] = moving[-3:] = False
    return np.flatnonzero(same & moving)


def _is_inserted(log: Log, joints: Sequence[str], repeated: NDArray[np.intp]) -> bool:
    """Return whether the motion goes on by one step behind repeated rows, under an even clock; else it is two steps ahead.

    Args:
        log: A log as read.
        joints: Joints with positions.
        repeated: Samples (n,) after which a row is repeated.
    """
    clock = examine_clock(log)
    if not (clock.even or clock.rounded):
        return False
    steps = np.diff(log.joint("q", joints), axis=0)
    at = repeated[(repeated > 3) & (repeated < len(steps) - 4)]
    around = np.mean([steps[at + shift] for shift in (-3, -2, 2, 3)], axis=0)
    ahead = np.sum(steps[at + 1] * around, axis=1) / np.maximum(np.sum(around**2, axis=1), 1e-300)
    return bool(at.size and np.median(ahead) < 1.5)


def _list_repeated(log: Log, joints: Sequence[str], seen: NDArray[np.intp], inserted: bool) -> NDArray[np.intp]:
    """Return the samples (n,) after which a row is repeated: those seen in motion, and short equal runs beyond chance.

    Leaving out a sound row does no harm if the clock went on. If rows were inserted, the share of equal neighbours in each
    channel, outside rows that are equal as a whole, gives the number of rows expected to be equal by chance; if it is one or
    more, only rows seen in motion count.
    """
    x = np.column_stack([log.channels[f"{s}_{j}"] for s in ("q", "tau") for j in joints if log.has(s, [j])])
    equal = np.diff(x, axis=0) == 0
    whole = equal.all(axis=1)
    if inserted and len(x) * np.prod(equal[~whole].mean(axis=0)) >= 1:
        return seen
    short = np.zeros(len(whole), bool)
    for run in find_true_runs(whole):
        short[run] = run.stop - run.start <= MAX_FILLED
    return np.union1d(np.flatnonzero(short), seen)


def _mend_repeated(log: Log, joints: Sequence[str]) -> Repair:
    """Leave out repeated rows, and move up later times if rows were inserted."""
    seen = find_repeated_rows(log, joints)
    if len(seen) < MIN_EVENTS:
        return Repair(log, [])
    inserted = _is_inserted(log, joints, seen)
    rows = _list_repeated(log, joints, seen, inserted)
    keep = np.ones(log.n_samples, bool)
    keep[rows + 1] = False
    t = log.t - log.dt * np.cumsum(~keep) if inserted else log.t
    share = 100 * len(rows) / log.n_samples
    sentence = (
        f"{log.name}: {count(len(rows), 'sample')} repeat the one before ({share:.2g} % of all), first after "
        f"t = {log.t[rows[0]]:.6g} s: no value changes there although the joints move. They are left out"
        f"{' and later times moved up' if inserted else ''}; log time stamps of the measurement, each sample once."
    )
    return Repair(_take(log, keep, t), [RepairedWarning("repeated_samples", sentence)])


def _mend_lost(log: Log, joints: Sequence[str]) -> Repair:
    """Return the log with its lost samples as gaps in the clock and inserted ones left out, if they are few.

    A few events can be mended: each is known to the sample. Many cannot, as some are not detected while the robot is slow.
    """
    even, rows = _fill_single_gaps(log)
    found, keep = find_lost_samples(even, joints), np.isin(np.arange(even.n_samples), rows)
    found = _leave_out_late(found, keep)
    log = _take(log, keep[rows], log.t)
    if not found.alarm:
        return Repair(log, [])
    mended = len(found.after) <= MAX_MENDED_SHARE * max(found.n_tested, 1)
    kind = RepairedWarning if mended else CodedWarning
    ahead, twice = found.after[found.steps > 0], found.after[found.steps < 0]
    warnings: list[CodedWarning] = []
    if len(ahead) >= MIN_EVENTS:
        warnings.append(kind("lost_samples", _lost_sentence(even, found, ahead)))
    if len(twice) >= MIN_EVENTS:
        sentence = (
            f"{log.name}: {count(len(twice), 'sample')} are logged twice, first after t = {even.t[twice[0]]:.6g} s: the motion "
            f"goes back by a step there. {'They are left out' if mended else 'That is too many to correct'}; log time stamps "
            "of the measurement, each sample once."
        )
        warnings.append(kind("repeated_samples", sentence))
    if not mended:
        return Repair(log, warnings)
    late = np.zeros(even.n_samples)
    np.add.at(late, found.after + 1, found.steps)
    for k, n in zip(found.after, found.steps, strict=True):
        if n < 0:
            keep[k + 1 : k + 1 - n] = False
    t = even.t + np.cumsum(late) * even.dt
    if np.any(np.diff(t[keep]) <= 0):
        return Repair(log, [CodedWarning(w.code, str(w)) for w in warnings])
    return Repair(_take(even, keep, t), warnings)


def _leave_out_late(found: LostSamples, keep: NDArray[np.bool_]) -> LostSamples:
    """Return the events away from rows that were left out, and leave out rows between such a row and an event right behind it.

    If two consecutive rows were late, the second one is not equal to the first, and the motion jumps ahead behind it.
    """
    if keep.all():
        return found
    before = np.maximum.accumulate(np.where(keep, -len(keep), np.arange(len(keep))))
    after = len(keep) - 1 - np.maximum.accumulate(np.where(keep[::-1], -len(keep), np.arange(len(keep))))[::-1]
    behind = found.after - before[found.after]
    near = (behind <= MAX_FILLED) | (after[found.after] - found.after <= MAX_FILLED)
    for k in np.flatnonzero((behind <= MAX_FILLED) & (found.steps > 0)):
        keep[before[found.after[k]] : found.after[k] + 1] = False
    return found._replace(after=found.after[~near], steps=found.steps[~near])


def _fill_single_gaps(log: Log) -> tuple[Log, NDArray[np.intp]]:
    """Return a log on an even clock with left-out rows interpolated, and the places of its own rows; else the log itself."""
    place = np.round((log.t - log.t[0]) / log.dt).astype(int)
    even = np.abs((log.t - log.t[0]) / log.dt - place).max() < MAX_OFF_GRID and np.all(np.diff(place) > 0)
    if not even or place[-1] == len(place) - 1 or np.diff(place).max() > MAX_FILLED + 1:
        return log, np.arange(log.n_samples)
    grid = np.arange(place[-1] + 1)
    channels = {key: interpolate(place.astype(float), x, grid.astype(float)) for key, x in log.channels.items()}
    return Log(log.t[0] + grid * log.dt, channels, log.name, log.sha256, log.warnings), place


MAX_OFF_GRID = 0.1
"""Distance of stamps from an even clock [sample steps] up to which rows are missing from it and not measured at other times."""


def _take(log: Log, keep: NDArray[np.bool_], t: NDArray[np.float64]) -> Log:
    """Return the kept rows of a log at other times (N,); the log itself if neither changes."""
    if keep.all() and t is log.t:
        return log
    return Log(t[keep], {k: x[keep] for k, x in log.channels.items()}, log.name, log.sha256, log.warnings)


def _stretches(
    q: NDArray[np.float64], half: int, degree: int, floor: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return for each step (N-1,) its stretch [sample steps], the stretch over its standard error, and one step over it."""
    n = len(q)
    out = tuple(np.zeros(n - 1) for _ in range(3))
    if n < 4 * half:
        return out  # type: ignore[return-value]
    i = np.arange(1 - half, half + 1) - 0.5
    behind = (i > 0).astype(float)
    powers = np.stack([i**k for k in range(degree + 1)], axis=1) / half ** np.arange(degree + 1)
    slopes = np.stack([k * i ** max(k - 1, 0) / half**k for k in range(degree + 1)], axis=1)
    orthogonal, _ = np.linalg.qr(powers)
    with_jump = np.linalg.pinv(np.column_stack([powers, behind]))[: degree + 1]
    top, bottom, power = np.zeros(n - 2 * half + 1), np.zeros(n - 2 * half + 1), np.zeros(n - 2 * half + 1)
    freedom = 2 * half - degree - 1
    for j in range(q.shape[1]):
        windows = np.lib.stride_tricks.sliding_window_view(q[:, j], 2 * half)
        windows = windows - windows.mean(axis=1, keepdims=True)
        residual = windows - (windows @ orthogonal) @ orthogonal.T
        turned = ((windows @ with_jump.T) @ slopes.T) * behind
        turned -= (turned @ orthogonal) @ orthogonal.T
        squares = np.einsum("ni,ni->n", residual, residual)
        moving = np.ptp(windows, axis=1) > 0
        usual = float(np.median(squares[moving])) / (freedom - 0.6) if moving.any() else 0.0
        scale = max(usual, float(floor[j]) ** 2)
        onward = np.abs(windows[:, -1] - windows[:, 0]) > MIN_NET_SHARE * np.abs(np.diff(windows, axis=1)).sum(axis=1)
        turned, squares = turned * onward[:, None], squares * onward
        top += np.einsum("ni,ni->n", turned, residual) / scale
        bottom += np.einsum("ni,ni->n", turned, turned) / scale
        power += squares / scale
    left = np.maximum(power - np.where(bottom > 0, top**2 / np.maximum(bottom, 1e-300), 0.0), 0.0)
    overdispersion = np.maximum(1.0, left / max(freedom * q.shape[1] - 1, 1))
    stretch = top / np.maximum(bottom, 1e-300)
    unit = np.sqrt(bottom / overdispersion)
    place = slice(half - 1, half - 1 + len(stretch))
    for whole, part in zip(out, (stretch, np.abs(stretch) * unit, unit), strict=True):
        whole[place] = part
    return out  # type: ignore[return-value]


def _sort(
    stretch: NDArray[np.float64], z: NDArray[np.float64], half: NDArray[np.float64], n_tested: int
) -> LostSamples:
    """Return the events; of steps with overlapping windows, the most significant one counts."""
    sure = np.flatnonzero((z > MIN_Z) & (np.abs(stretch) > INTEGER_MARGIN) & (np.abs(stretch) < MAX_STRETCH))
    taken = np.zeros(len(z) + 1, bool)
    after, steps, n_control = [], [], 0
    for k in sure[np.argsort(-z[sure], kind="stable")]:
        reach = max(int(half[k]) - 1, 2)
        if taken[k]:
            continue
        taken[max(0, k - reach) : k + reach + 1] = True
        whole = round(float(stretch[k]))
        if whole and abs(stretch[k] - whole) <= INTEGER_MARGIN:
            after.append(int(k))
            steps.append(whole)
        else:
            n_control += 1
    order = np.argsort(after)
    return LostSamples(np.array(after, np.intp)[order], np.array(steps, np.intp)[order], n_control, n_tested)


def _is_held(x: NDArray[np.float64]) -> bool:
    """Return whether a channel is updated less often than it is logged, so that its steps carry no information on the clock."""
    changes = np.flatnonzero(np.diff(x) != 0)
    gaps = np.diff(changes)
    usual = int(np.median(gaps)) if gaps.size else 1
    return usual >= 2 and bool(np.mean(gaps == usual) > 0.8)


def _lost_sentence(log: Log, found: LostSamples, lost: NDArray[np.intp]) -> str:
    n = int(found.steps[np.isin(found.after, lost)].sum())
    share = len(lost) / max(found.n_tested, 1)
    sentence = (
        f"{log.name}: samples are missing under an even clock: all joints leap {count(n, 'sample step')} ahead in "
        f"{count(len(lost), 'place')}, first after t = {log.t[lost[0]]:.6g} s "
        f"({100 * share:.2g} % of the steps at which a loss can be seen)"
    )
    if len(found.after) <= MAX_MENDED_SHARE * max(found.n_tested, 1):
        return f"{sentence}; the clock is corrected there. Log time stamps of the measurement, not of a counter."
    return (
        f"{sentence}. That is too many to correct; errors exceed the stated standard errors: log time stamps of the "
        "measurement, not of a counter, and record it again."
    )


MIN_SAMPLES = 50
"""Shorter logs are not tested for patterns [samples]."""


class Repair(NamedTuple):
    """A log with its faults mended, and a warning for each fault: `RepairedWarning` if it was mended, else `CodedWarning`."""

    log: Log
    warnings: list[CodedWarning]


def _mend_updates(log: Log, joints: Sequence[str]) -> Repair:
    """Sample a log at the updates of channels that are updated less often than it is logged."""
    columns = [c for s in ("q", "tau") for j in joints if (c := f"{s}_{j}") in log.channels]
    rates = find_update_rates(log, columns)
    if not rates:
        return Repair(log, [])
    sampled = sample_at_updates(log, rates)
    kind = CodedWarning if sampled is None else RepairedWarning
    return Repair(sampled or log, [w for rate in rates for w in _describe_updates(log, rate, columns, kind)])


def _describe_updates(
    log: Log, rate: UpdateRate, columns: Sequence[str], kind: type[CodedWarning]
) -> list[CodedWarning]:
    """Return a warning that channels are updated less often than logged, with the delay of held ones."""
    names = "all positions and forces" if set(rate.columns) >= set(columns) else ", ".join(rate.columns)
    verb = "are" if len(rate.columns) > 1 else "is"
    between = "held" if rate.held else "interpolated linearly"
    use = (
        "only the updates are used"
        if kind is RepairedWarning
        else "standard errors are too small and the motion is distorted"
    )
    rates = f"at {log.rate_hz / rate.period:.4g} Hz instead of {log.rate_hz:.4g} Hz"
    sentence = (
        f"{log.name}: {names} {verb} updated less often than logged, {rates}, and {between} between; {use}. Log at the rate of "
        "the measurement."
    )
    found = [kind("updated_less_often", sentence)]
    if rate.held:
        late_s, it = (rate.period - 1) / 2 * log.dt, "they are" if len(rate.columns) > 1 else "it is"
        late = (
            f"{log.name}: {names} {verb} updated every {rate.period:.3g} samples; {it} {late_s:.2g} s late on average"
        )
        found.insert(0, kind("held_channel", late + (", except at the updates." if kind is RepairedWarning else ".")))
    return found


def _leave_out_frozen(log: Log, joints: Sequence[str]) -> Repair:
    """Leave out the samples at which a position or a force keeps one value although the joint moves."""
    stretches: list[FrozenStretch] = []
    for joint in joints:
        if not log.has("q", [joint]):
            continue
        stretches += (frozen := find_frozen_positions(log, joint))
        if not frozen and log.has("tau", [joint]):
            frozen = find_frozen_force(log, joint, find_moving_samples(log, joint))
            stretches += frozen or find_dead_force(log, joint)
    keep = np.ones(log.n_samples, bool)
    for s in stretches:
        keep[s.start : s.stop] = False
    warnings = [CodedWarning("held_channel", _frozen_sentence(log, s)) for s in stretches]
    return Repair(_take(log, keep, log.t) if stretches and np.count_nonzero(keep) >= MIN_SAMPLES else log, warnings)


def _leave_out_stale(log: Log, joints: Sequence[str]) -> Repair:
    """Leave out readings right behind a gap that are those before it, if the joint is elsewhere in the next sample."""
    before = np.array([k for k in examine_clock(log).gaps if k + 2 < log.n_samples], dtype=np.intp)
    keep, stale = np.ones(log.n_samples, bool), []
    for joint in joints if before.size else ():
        q = log.joint("q", [joint])[:, 0]
        steps = np.abs(np.diff(q, append=q[-1]))
        smallest = steps[steps > 0].min(initial=np.inf)
        alone = steps[before + 1] > np.maximum(STALE_COUNTS * smallest, STALE_SHARE * steps[before + 2])
        held = before[(q[before + 1] == q[before]) & alone]
        keep[held + 1] = False
        stale += [joint] * bool(held.size)
    if keep.all():
        return Repair(log, [])
    n, first = int(np.count_nonzero(~keep)), float(log.t[np.argmin(keep)])
    sentence = (
        f"{log.name}: {count(n, 'sample')} behind {'a gap' if n == 1 else 'gaps'} (first at {first:.6g} s) still "
        f"{'holds' if n == 1 else 'hold'} the position of {format_list(stale)} before it; left out."
    )
    return Repair(_take(log, keep, log.t), [RepairedWarning("held_channel", sentence)])


def _frozen_sentence(log: Log, frozen: FrozenStretch) -> str:
    span = f"from {log.t[frozen.start]:.6g} to {log.t[frozen.stop - 1]:.6g} s"
    return (
        f"{log.name}: {frozen.column} {frozen.state} {span}, although {frozen.reason}. These samples are left out; look "
        "at the sensor or its bus."
    )


def _find_faulty_channels(log: Log, joints: Sequence[str]) -> Repair:
    """Warn of encoders that slip or have a stuck bit and of forces that clip; all remain in the data."""
    found = [find_stuck_bit(log, joint) or find_slip(log, joint) for joint in joints]
    found += [find_clipped_force(log, joint) for joint in joints if log.has("tau", [joint])]
    return Repair(log, [warning for warning in found if warning])


def _find_doubled_channels(log: Log, joints: Sequence[str]) -> Repair:
    """Warn of a joint's channel that equals another joint's in every sample, while their other channels differ."""
    warnings = []
    for one, other in combinations(joints, 2):
        same = [signal for signal in ("q", "tau") if log.has(signal, [one, other]) and np.ptp(log.channels[f"{signal}_{one}"])
                and np.array_equal(log.channels[f"{signal}_{one}"], log.channels[f"{signal}_{other}"])]  # fmt: skip
        if len(same) == 1:
            sentence = (
                f"{log.name}: {same[0]}_{one} and {same[0]}_{other} are equal in every sample, although the joints move "
                "differently: one column holds the other joint's channel. Map the right columns, or log them."
            )
            warnings.append(CodedWarning("joints_exchanged", sentence))
    return Repair(log, warnings)


def _mend_samples(log: Log, joints: Sequence[str]) -> Repair:
    """Mend repeated rows, and under an even clock lost samples too; a measured clock shows its losses by itself."""
    clock = examine_clock(log)
    repeated = _mend_repeated(log, joints)
    next_step = _mend_lost if clock.even or clock.rounded else _mend_stamps
    mended = next_step(repeated.log, joints)
    return Repair(mended.log, [*repeated.warnings, *mended.warnings])


def _mend_stamps(log: Log, joints: Sequence[str]) -> Repair:
    """Return a log with the even times of its device if its stamps scatter around them."""
    if log.n_samples < MIN_SAMPLES or not log.has("q", joints):
        return Repair(log, [])
    found = find_device_clock(log.t, log.joint("q", joints))
    if found is None:
        return Repair(log, [])
    sentence = (
        f"{log.name}: its time stamps scatter by {found.scatter_s:.2g} s around an even clock of "
        f"{1 / found.tick_s:.6g} Hz, which the motion shows; that clock is used. Log time stamps of the measurement."
    )
    keep = np.diff(found.t, prepend=-np.inf) > 0
    return Repair(_take(log, keep, found.t), [RepairedWarning("stamps_scatter", sentence)])


def _fill_gaps(log: Log, joints: Sequence[str]) -> Repair:
    """Fill gaps in which the motion is known as accurately as if it were measured."""
    filled, n, longest_s = fill_short_gaps(log, joints)
    if not n:
        return Repair(log, [])
    sentence = (
        f"{log.name}: {count(n, 'gap')} of up to {longest_s:.2g} s {'is' if n == 1 else 'are'} interpolated: samples around them "
        "give the positions there to within their noise. Record without interruption."
    )
    return Repair(filled, [RepairedWarning("lost_samples", sentence)])


_STEPS = (
    _find_doubled_channels,
    _mend_updates,
    _leave_out_frozen,
    _leave_out_stale,
    _mend_samples,
    _mend_dropouts,
    _fill_gaps,
    _find_faulty_channels,
)
"""Repairs in their order: a low update rate looks like lost samples, and repeated rows look like both."""

_REPAIRED: WeakKeyDictionary[Log, dict[tuple[str, ...], Repair]] = WeakKeyDictionary()
"""Repairs of logs in use: a log is judged first and mended later."""


def repair_log(log: Log, joints: Sequence[str] = ()) -> Repair:
    """Return the log with its repairable faults mended, and all faults that it shows by itself; no faults for sound logs.

    Args:
        log: A log as read, before any interpolation.
        joints: The joints that count; by default all that are logged.
    """
    names = tuple(joint for joint in joints if log.has("q", [joint])) or log.joints("q")
    known = _REPAIRED.setdefault(log, {})
    if names not in known:
        repair = Repair(log, [])
        for step in _STEPS if log.n_samples >= MIN_SAMPLES else ():
            done = step(repair.log, names)
            repair = Repair(done.log, [*repair.warnings, *done.warnings])
        known[names] = repair
    return known[names]


def list_data_warnings(log: Log, joints: Sequence[str] = ()) -> list[CodedWarning]:
    """Return the faults that a log as read shows by itself; see `repair_log`."""
    return list(repair_log(log, joints).warnings)


def mend_log(log: Log, joints: Sequence[str] = ()) -> Log:
    """Return a log with its faults mended or left out if that is safe; a sound log itself."""
    return repair_log(log, joints).log
