"""What a log alone tells of losses on its way to the file: lost, repeated, zeroed and held samples, as coded warnings.

All tests look at raw stamps and raw columns: interpolation and filters hide what they look for.

**Lost samples.** A logger that numbers its samples hides what it lost: the stamps stay even and the motion jumps. Each step
between two samples is held against a local polynomial through its neighbours (Savitzky & Golay 1964), stretched after the step
by `s` sample steps that all joints share:

    q_j(i) = p_j(i)  up to the step,    q_j(i) = p_j(i + s)  behind it

A lost sample gives s = 1, one inserted twice s = -1. `z` is the estimate of `s` over its standard error. Steps with z > 10 and
`s` within 0.25 of a nonzero integer are events. What is not a lost sample (a knock, a rough motion) has no reason to prefer
integers, so steps nearer to the half integers are counted as a control. Alarm: three events, and more than twice the control.

**Forces that drop out.** A missing measurement is often written as zero or as the value before. A zero run is a stretch of
exact zeros whose two neighbours stand six typical steps off, on the same side: a force that passes through zero changes its
side. A held run is a stretch of three or more exactly equal values in a channel that otherwise hardly ever repeats a value.
Joints at rest are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.filtering import estimate_quantisation_step
from tau_dyn.log.log import Log
from tau_dyn.log.resample import examine_clock
from tau_dyn.log.signal_checks import find_constant_runs
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

MIN_STEPS_OFF = 6.0
"""How far the neighbours stand from zero, in median changes of a sample; noise passes four in 1 of 1000 samples."""

MIN_DROPOUTS = 3
"""So many runs are no accident."""

MIN_HELD = 3
"""Samples of a held run; two equal values happen to a rounded channel."""

MAX_REPEATS = 0.02
"""Share of pairs of equal neighbours above which a channel repeats by rounding and held runs cannot be told."""

MAX_RUN_S = 0.5
"""Longer zeros [s] are a drive that was off, or a channel that is frozen, which has a test of its own."""


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
    """Return the first sample (n,) of each run of held values that ends far off, in a channel that hardly repeats itself."""
    x = log.channels[column]
    runs = find_constant_runs(x)
    if np.count_nonzero(runs.lengths == 2) > MAX_REPEATS * log.n_samples or len(runs.starts) < 20:
        return np.zeros(0, np.intp)
    far = np.abs(np.diff(runs.values)) > MIN_STEPS_OFF * float(np.median(np.abs(np.diff(runs.values))))
    held = (runs.lengths >= MIN_HELD) & (runs.values != 0)
    return runs.starts[:-1][held[:-1] & far]


def list_dropout_warnings(log: Log, joints: Sequence[str] = ()) -> list[CodedWarning]:
    """Return `zero_force_runs` and `held_channel` of a log as read, at most one of each a joint."""
    found = []
    for joint in tuple(joints) or log.joints("tau"):
        if not log.has("tau", [joint]):
            continue
        zero = find_zero_runs(log, joint)
        if len(zero) >= MIN_DROPOUTS:
            sentence = (
                f"{log.name}: tau_{joint} is exactly zero in {count(len(zero), 'place')} where the force before and after is far "
                f"from it, first at t = {log.t[zero[0]]:.6g} s: readings were lost. Leave these samples out by a column that "
                "flags them (--exclude), or log the drive's force without gaps."
            )
            found.append(CodedWarning("zero_force_runs", sentence))
        held = find_held_runs(log, f"tau_{joint}")
        if len(held) >= MIN_DROPOUTS:
            sentence = (
                f"{log.name}: tau_{joint} stands still for {MIN_HELD} samples or more in {count(len(held), 'place')}, first at "
                f"t = {log.t[held[0]]:.6g} s, and changes with each sample elsewhere: the logger repeats its last reading. Leave "
                "these samples out (--exclude), or log the drive's force without gaps."
            )
            found.append(CodedWarning("held_channel", sentence))
    return found


MIN_Z = 10.0
"""Least size of a stretch in its standard errors; encoder noise alone reaches 5 in a million steps."""

INTEGER_MARGIN = 0.25
"""How near to an integer a stretch lies [sample steps]; the half integers' share of the axis is the same."""

MIN_EVENTS = 3
"""So many events are no accident: a single one can be a knock."""

MAX_STRETCH = 30
"""Larger stretches [sample steps] are jumps of the position, which have a test of their own."""

MAX_MENDED_SHARE = 0.01
"""Above this share of events among moving steps the clock is not mended: each unseen loss shifts what follows."""

MIN_NET_SHARE = 0.8
"""Net over travelled way in a window from which a joint counts: about a reversal a way back looks like many samples lost."""

_WINDOWS = ((3, 2), (6, 3), (12, 3))
"""Samples on each side and degree of the polynomial: short for fast motions, long for noisy encoders."""

_EXTENDED = 1e-9
"""Rounding of positions, as a share of their range: the least noise of a simulated encoder."""


class LostSamples(NamedTuple):
    """Where a counted clock is wrong.

    Attributes:
        after: Samples after which the clock is wrong (n,).
        steps: Sample steps to be inserted there (n,); negative where samples stand twice.
        n_control: Steps that a half integer would explain.
        n_tested: Steps at which one lost sample would be seen.
    """

    after: NDArray[np.intp]
    steps: NDArray[np.intp]
    n_control: int
    n_tested: int

    @property
    def alarm(self) -> bool:
        """True where samples are missing or stand twice, beyond chance."""
        return len(self.after) >= MIN_EVENTS and len(self.after) > 2 * self.n_control


_NONE = LostSamples(np.zeros(0, np.intp), np.zeros(0, np.intp), 0, 0)


def find_lost_samples(log: Log, joints: Sequence[str] = ()) -> LostSamples:
    """Find lost and inserted samples under an even clock.

    Args:
        log: A log as read; a measured (uneven) clock tells its losses by itself and is not tested.
        joints: The joints to look at; by default all that have a `q`.
    """
    names = tuple(joints) or log.joints("q")
    looked_at = _LOOKED_AT.setdefault(log, {})
    if names not in looked_at:
        looked_at[names] = _find_lost_samples(log, names)
    return looked_at[names]


_LOOKED_AT: WeakKeyDictionary[Log, dict[tuple[str, ...], LostSamples]] = WeakKeyDictionary()
"""What logs in use were found to have lost: a log is judged, and mended, one after the other."""


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


def list_sample_warnings(log: Log, joints: Sequence[str] = ()) -> list[CodedWarning]:
    """Return `lost_samples` and `repeated_samples` of a log as read."""
    found, repeated = find_lost_samples(log, joints), find_repeated_rows(log, joints)
    warnings = []
    ahead = (found.steps > 0) & ~np.isin(found.after, [repeated - 1, repeated, repeated + 1])
    if found.alarm and np.count_nonzero(ahead) >= MIN_EVENTS:
        lost = found.after[ahead]
        warnings.append(CodedWarning("lost_samples", _lost_sentence(log, found, lost)))
    inserted = found.after[found.steps < 0]
    twice = inserted if found.alarm and len(inserted) > len(repeated) else repeated
    if len(twice) >= MIN_EVENTS:
        sentence = (
            f"{log.name}: {count(len(twice), 'sample')} stand twice, first after t = {log.t[twice[0]]:.6g} s: nothing changes "
            f"there although the joints move; {_share(log, len(twice))}. The logger repeated what it had not received; "
            "log time stamps of the measurement, or leave the repeated lines out (--exclude)."
        )
        warnings.append(CodedWarning("repeated_samples", sentence))
    return warnings


def find_repeated_rows(log: Log, joints: Sequence[str] = ()) -> NDArray[np.intp]:
    """Return samples (n,) at which no position and no force changes although the neighbours move.

    The joint moves surely where the mean of four steps around exceeds six of their standard deviations and one encoder step.
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


def mend_clock(log: Log, joints: Sequence[str] = ()) -> Log | None:
    """Return the log with its lost samples as gaps in the clock and inserted ones left out; None where that is not safe.

    A few events can be mended: each is known to the sample. Many cannot, as some pass unseen while the robot is slow.
    """
    found, twice = find_lost_samples(log, joints), find_repeated_rows(log, joints)
    stale = twice[~np.isin(twice, found.after)] if len(twice) >= MIN_EVENTS else twice[:0]
    if not (found.alarm or len(stale)) or len(found.after) + len(stale) > MAX_MENDED_SHARE * max(found.n_tested, 1):
        return None
    late = np.zeros(log.n_samples)
    keep = np.ones(log.n_samples, bool)
    keep[stale + 1] = False
    if found.alarm:
        np.add.at(late, found.after + 1, found.steps)
    else:
        found = _NONE
    for k, n in zip(found.after, found.steps, strict=True):
        if n < 0:
            keep[k + 1 : k + 1 - n] = False
    t = log.t + np.cumsum(late) * log.dt
    if np.any(np.diff(t[keep]) <= 0):
        return None
    channels = {name: x[keep] for name, x in log.channels.items()}
    return Log(t[keep], channels, log.name, log.sha256, log.warnings)


def _stretches(
    q: NDArray[np.float64], half: int, degree: int, floor: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return for each step (N-1,) its stretch [sample steps], that over its standard error, and one step over it."""
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
    """Return the events; of steps whose windows overlap the surest counts."""
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
    """Return whether a channel is renewed less often than it is logged; its steps tell nothing of the clock."""
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


def _share(log: Log, n: int) -> str:
    return f"{100 * n / log.n_samples:.2g} % of all"


MIN_SAMPLES = 50
"""Shorter logs show no pattern."""


def list_data_warnings(log: Log, joints: Sequence[str] = ()) -> list[CodedWarning]:
    """Return lost, repeated, zeroed and held samples of a log as read; sound logs give none.

    Args:
        log: A log as read, before any interpolation.
        joints: The joints that count; by default all that are logged.
    """
    if log.n_samples < MIN_SAMPLES:
        return []
    joints = [joint for joint in joints if log.has("q", [joint])] or log.joints("q")
    return [*list_sample_warnings(log, joints), *list_dropout_warnings(log, joints)]


def mend_log(log: Log, joints: Sequence[str] = ()) -> Log:
    """Return a log whose few lost samples are gaps in its clock and whose repeated lines are left out; else the log itself."""
    joints = [joint for joint in joints if log.has("q", [joint])] or log.joints("q")
    return mend_clock(log, joints) or log
