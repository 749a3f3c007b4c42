"""Findings of a check of a log, and tests of each channel by itself: constant, frozen, held, clipped, or jumping.

A `CheckFinding` is one sentence about one topic, with a remedy. `fault` means that the log should not be used as it is,
`warning` that a result will be poorer, `ok` that a property was checked and is fine, or why it was not checked.

Runs of exactly equal values distinguish constant, frozen, held and clipped channels: a live measurement hardly ever repeats
itself to the last digit while its joint moves. A jump is a single large change: larger than ten times nine of ten of the
joint's changes and than a fiftieth of its whole range, while the changes before and after are less than a quarter of it in the
same direction. An encoder jumps if it wraps, is reset, or loses a reading; a joint that moves fast has several such changes in
a row.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.filtering import estimate_quantisation_step
from tau_dyn.log.log import Log
from tau_dyn.message_codes import CodedWarning, RepairedWarning, get_code
from tau_dyn.results import Shown, count

Severity = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class CheckFinding:
    """The result of one check."""

    severity: Severity
    topic: str
    sentence: str
    remedy: str = ""
    """Remedy; empty if no remedy is needed."""
    code: str = ""
    """Stable code, see docs/reference/message_codes.md; empty for findings without a code."""


def choose_finding(topic: str, fine: str, *doubts: tuple[bool, str, str]) -> CheckFinding:
    """Return the first doubt that holds as a warning, else the sentence `fine`; a doubt is (condition, sentence, remedy)."""
    for holds, sentence, remedy in doubts:
        if holds:
            return CheckFinding("warning", topic, sentence, remedy)
    return CheckFinding("ok", topic, fine)


def build_fault(warning: str) -> CheckFinding:
    """Return a coded warning as a fault of the log, or as a warning if it was repaired; its sentence contains the remedy."""
    mended = isinstance(warning, RepairedWarning)
    still = "held" if mended else "frozen"
    topic = {"updated_less_often": "held", "held_channel": still}.get(get_code(warning), "integrity")
    return CheckFinding("warning" if mended else "fault", topic, str(warning), code=get_code(warning))


@dataclass(frozen=True)
class LogCheck(Shown):
    """The judgement of a log.

    Attributes:
        name: The log's name.
        findings: All results, in a fixed order of topics.
        numbers: The figures behind the sentences, plain numbers and lists for JSON; per-joint figures are mappings by
            joint.
    """

    name: str
    findings: tuple[CheckFinding, ...]
    numbers: dict[str, Any]

    @property
    def fit_for_use(self) -> bool:
        """True if no finding is a fault."""
        return not any(finding.severity == "fault" for finding in self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are warnings or faults."""
        doubtful = [finding for finding in self.findings if finding.severity != "ok"]
        return tuple(CodedWarning(f.code, f.sentence) if f.code else f.sentence for f in doubtful)

    def with_faults(self, warnings: Iterable[str], is_compared: bool = True) -> LogCheck:
        """Return the check with coded warnings from the comparison with a robot file, as further faults.

        `is_compared` states whether wiring and timing were compared with masses, which a sound log of forces allows. If a
        warning gives the line of a map for a column, the line that the column's range alone suggested is dropped.
        """
        sentence = f"{self.name}: wiring and the time of the forces were compared with the masses of the robot file."
        judged = CheckFinding("ok", "synchronisation", sentence)
        kept = [f for f in self.findings if not is_compared or (f.topic, f.severity) != ("synchronisation", "ok")]
        faults = [build_fault(warning) for warning in warnings]
        mended = {line for fault in faults for line in re.findall(r"`(\w+): \{", fault.sentence)}
        kept = [
            f for f in kept if not (f.code == "scale_wrong" and mended & set(re.findall(r"`(\w+): \{", f.sentence)))
        ]
        compared = (judged,) if is_compared else ()
        return replace(self, findings=(*kept, *compared, *(f for f in faults if f not in kept)))

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain data for JSON."""
        findings = [{k: x for k, x in asdict(f).items() if k != "code" or x} for f in self.findings]
        return {"name": self.name, "fit_for_use": self.fit_for_use, "findings": findings, "numbers": self.numbers}


_ROUNDING = 1e-12
"""Change of a position, as a share of the largest one, that is rounding of an interpolation."""

_FURTHER = 10.0
"""Least size of a jump over the 90 % quantile of steps."""

_OF_RANGE = 0.02
"""Least size of a jump, as a share of the joint's range."""

COARSEST_COUNT = {True: 0.02, False: 1e-3, None: 1e-3}
"""Largest count of an encoder, by whether the joint turns [rad], slides [m], or neither is known: 1 degree of the coarsest servo,
a millimetre of a draw wire."""

_ALONE = 0.25
"""A change with a neighbour of this share of its size in the same direction is motion: a quick move in few samples."""

_TURN = 0.1
"""Largest distance of a jump from whole turns, as a share of one, if the encoder wraps."""


def find_jumps(
    q: NDArray[np.float64], fastest: float = 0.0, count: float = 0.0, t: NDArray[np.float64] | None = None
) -> NDArray[np.intp]:
    """Return the samples after which a position (N,) jumps.

    Args:
        q: Positions [m or rad].
        fastest: The joint's speed limit [per sample]; slower steps are motion.
        count: Largest count that its encoder may have [m or rad]; a joint at rest may step by one.
        t: Times (N,) [s]; None for an even clock.
    """
    # a reading held over several samples is one; interpolated, it changes by rounding
    changes = np.flatnonzero(np.abs(np.diff(q)) > _ROUNDING * np.abs(q).max(initial=0.0))
    step = np.diff(q)[changes]
    if t is not None:  # a longer interval allows a larger step
        passed = np.diff(t)
        step = step * np.median(passed) / np.maximum(passed, np.median(passed))[changes]
    if step.size < 2:
        return np.zeros(0, np.intp)
    size = np.abs(step)
    least = max(_FURTHER * float(np.quantile(size, 0.9)), _OF_RANGE * float(np.ptp(q)), fastest)
    padded = np.concatenate([[0.0], step, [0.0]])
    found = np.flatnonzero(size > least)
    apart = [max(np.sign(step[k]) * padded[[k, k + 2]]) < _ALONE * size[k] for k in found]
    found = found[apart]
    return changes[:0] if found.size and _are_counts(step, found, count) else changes[found]


_SPLIT = 1.5
"""Largest count over the largest change: resampled, a count is split, and less than a quarter is in a neighbouring change."""


def _are_counts(step: NDArray[np.float64], found: NDArray[np.intp], coarsest: float) -> bool:
    """Return whether the largest changes are counts of an encoder at rest: without them the joint moves by one count at most."""
    count, least = float(np.abs(step[found]).max()), float(np.abs(step[found]).min())
    rest = step.copy()
    rest[found] = 0.0
    return count < min(coarsest, 2 * least) and float(np.ptp(np.cumsum(rest))) < _SPLIT * count


def check_jumps(
    log: Log,
    joint: str,
    *,
    revolute: bool | None = None,
    fastest: float = 0.0,
    left_out: NDArray[np.bool_] | None = None,
    gaps: Sequence[int] = (),
) -> CheckFinding | None:
    """Return a finding about a joint's positions if they jump, else None.

    Args:
        log: The log.
        joint: The joint.
        revolute: Whether it turns, None if unknown.
        fastest: Its speed limit [m/s or rad/s], if known.
        left_out: Samples (N,) that are not used; jumps to or from them are ignored.
        gaps: Samples before gaps in the clock, in which a joint may move far.
    """
    q = log.channels[f"q_{joint}"]
    at = find_jumps(q, fastest * log.dt if np.isfinite(fastest) else 0.0, COARSEST_COUNT[revolute], log.t)
    at = at[~np.isin(at, gaps)]
    if left_out is not None:
        at = at[~(left_out[at] | left_out[at + 1])]
    if not at.size:
        return None
    sizes, unit = np.abs(np.diff(q)[at]), {True: " rad", False: " m", None: ""}[revolute]
    turns = sizes / (2 * np.pi)
    wraps = revolute is not False and bool(np.all((turns > 0.5) & (np.abs(turns - np.round(turns)) < _TURN)))
    where = f"first by {sizes[0]:.3g}{unit} after t = {log.t[at[0]]:.6g} s"
    sentence = f"{log.name}: q_{joint} jumps {count(len(at), 'time')}, {where}, further than it can move in a sample"
    if wraps:
        why, remedy = "the encoder restarts each turn", "Unwrap it (numpy.unwrap)."
    else:
        why = "readings were lost, or the encoder was reset"
        remedy = "Leave out the lines of lost readings, or flag them in a column (--exclude); "
        remedy += "cut the log where an encoder was reset."
    return CheckFinding("fault", "jumps", f"{sentence}: {why}.", remedy)


MIN_CLIPPED_SAMPLES = 5
"""Least number of equal consecutive samples at the largest or smallest value that are a plateau."""

MIN_FROZEN_S = 0.1
"""A channel that does not change for so long [s] while its joint moves is frozen."""


class ConstantRuns(NamedTuple):
    """Stretches of equal values of one channel."""

    starts: NDArray[np.intp]
    lengths: NDArray[np.intp]
    values: NDArray[np.float64]


def find_constant_runs(x: NDArray[np.float64]) -> ConstantRuns:
    """Cut a channel (N,) into stretches of exactly equal values."""
    starts = np.concatenate(([0], np.flatnonzero(np.diff(x) != 0.0) + 1))
    return ConstantRuns(starts, np.diff(np.append(starts, len(x))), x[starts])


def check_signals(log: Log, moving: dict[str, NDArray[np.bool_]]) -> tuple[list[CheckFinding], dict[str, Any]]:
    """Judge every joint's `q`, `q_ref` and `tau`.

    Args:
        log: The log.
        moving: For each joint, whether it moves (N,), from its positions or, while they are frozen, from its reference.

    Returns:
        Findings, and the number `clipped` (share of samples on a plateau at an extreme, by channel).
    """
    findings: list[CheckFinding] = []
    clipped: dict[str, float] = {}
    for signal in ("q", "q_ref", "tau"):
        for joint in log.joints(signal):
            column = f"{signal}_{joint}"
            runs = find_constant_runs(log.channels[column])
            moves = moving.get(joint, np.ones(log.n_samples, dtype=bool))
            found = _constant(log, column, runs)
            if signal == "q":
                found = found or _frozen(log, column, runs, moves)
            if signal == "tau":
                still = find_frozen_force(log, joint, moves)
                found = found or (_describe_frozen(log, still[0]) if still else None)
                clipped[column] = compute_clipped_share(runs, moves)
                found = found or _clipped(log, column, clipped[column])
            findings.append(found or CheckFinding("ok", "signal", f"{column}: no fault found."))
    return findings, {"clipped": clipped}


def compute_clipped_share(runs: ConstantRuns, moves: NDArray[np.bool_]) -> float:
    """Return the share of samples on plateaus at a channel's largest or smallest value while its joint moves.

    A plateau is 5 samples or more, and the extreme value occurs five times as often as the value next to it, so that
    neither coarse resolution nor the round top of a wave is taken for clipping.
    """
    levels, level = np.unique(runs.values, return_inverse=True)
    if len(levels) < 4:
        return 0.0
    counts = np.bincount(level, weights=runs.lengths)
    crowded = [k for k, beside in ((0, 1), (len(levels) - 1, len(levels) - 2)) if counts[k] > 5 * counts[beside]]
    plateau = np.isin(level, crowded) & (runs.lengths >= MIN_CLIPPED_SAMPLES) & moves[runs.starts + runs.lengths // 2]
    return float(runs.lengths[plateau].sum() / runs.lengths.sum())


def _constant(log: Log, column: str, runs: ConstantRuns) -> CheckFinding | None:
    if len(runs.values) > 1:
        return None
    sentence = f"{log.name}: {column} is {runs.values[0]:.6g} in every sample."
    fatal = column.startswith("tau_")
    remedy = (
        "Log the drive's force." if fatal else "Move the joint, or leave it out of the map if it was parked on purpose."
    )
    return CheckFinding("fault" if fatal else "warning", "constant", sentence, remedy)


def _frozen(log: Log, column: str, runs: ConstantRuns, moves: NDArray[np.bool_]) -> CheckFinding | None:
    """Find a long stretch of a position without a change during motion."""
    needed = max(MIN_FROZEN_S * log.rate_hz, 5 * float(np.median(runs.lengths)))
    for k in np.flatnonzero(runs.lengths >= needed):
        start, stop = int(runs.starts[k]), int(runs.starts[k] + runs.lengths[k])
        if np.mean(moves[start:stop]) > 0.5:
            return _describe_frozen(log, FrozenStretch(column, start, stop, ""))
    return None


def _describe_frozen(log: Log, frozen: FrozenStretch) -> CheckFinding:
    span = f"{log.t[frozen.start]:.6g} to {log.t[frozen.stop - 1]:.6g} s"
    value = log.channels[frozen.column][frozen.start]
    sentence = f"{log.name}: {frozen.column} stays at {value:.6g} from {span}, while the joint moves."
    remedy = "Leave that stretch out; look at the sensor or its bus."
    return CheckFinding("fault", "frozen", sentence, remedy, "held_channel")


MIN_LONGER = 10.0
"""Least length of a frozen stretch over the sixth longest stretch without a change; an encoder fails a few times at most."""

_SIXTH = 6
"""Rank of the stretch that represents the usual ones: up to five stretches of one log may be frozen."""

STOP_RATIO = 3.0
"""Change of speed at the ends of a frozen stretch, over the largest one anywhere else within the same time."""

STOP_S = 0.02
"""Time over which such speeds are measured [s]."""

SLOW_SHARE = 0.1
"""Share of the fast speed below which a channel must be as noisy as above it: noise that fades with the speed is vibration, and
fades at rest."""

MIN_SLOW = 30
"""Samples at low speed from which the noise of a channel there is measured."""

MIN_COUNTS = 0.7
"""Noise in counts from which a channel flickers at rest: twenty equal values in a row are then no chance, 0.5^20 = 1e-6."""

MAX_NEIGHBOUR = -0.4
"""Correlation of neighbouring fourth differences in white noise is -0.8, in a smooth motion 1."""

MIN_ACTIVE = 0.3
"""Spread of a joint's force during a frozen stretch, as a share of that elsewhere, from which the joint does not rest."""

FORCE_S = 0.1
"""Time over which forces are averaged before they are compared [s]."""


class FrozenStretch(NamedTuple):
    """Samples `start` to `stop - 1` at which a channel measures nothing although its joint moves, why, and how it looks there."""

    column: str
    start: int
    stop: int
    reason: str
    state: str = "stays at the same value"


def find_frozen_positions(log: Log, joint: str) -> list[FrozenStretch]:
    """Return the stretches in which an encoder keeps one value although its joint moves, or although it flickers otherwise.

    Two signs distinguish a dead encoder from a joint at rest: the speed changes at an end of the stretch by more than anywhere
    else, or the channel flickers wherever the joint is slow and the joint's force goes on. An encoder coarser than its noise
    does not flicker at rest.
    """
    x = log.channels[f"q_{joint}"]
    long, live = list_long_runs(x, log.rate_hz)
    found = []
    for start, stop in long:
        reason = _find_sudden_stop(x, live, start, stop, log.dt) or _find_flicker(log, joint, live, start, stop)
        if reason:
            found.append(FrozenStretch(f"q_{joint}", start, stop, reason))
    return found


def list_long_runs(x: NDArray[np.float64], rate_hz: float) -> tuple[list[tuple[int, int]], NDArray[np.bool_]]:
    """Return first sample and end of unusually long stretches of one value, and a mask of the other samples (N,).

    A stretch is unusual if it takes 0.1 s or more and is ten times as long as the sixth longest of the channel (N,).
    """
    runs, live = find_constant_runs(x), np.ones(len(x), bool)
    if len(runs.starts) < 10 * _SIXTH:
        return [], live
    least = max(MIN_FROZEN_S * rate_hz, MIN_LONGER * float(np.sort(runs.lengths)[-_SIXTH]))
    long = [(int(a), int(a + n)) for a, n in zip(runs.starts, runs.lengths, strict=True) if n >= least]
    for start, stop in long:
        live[max(start - 1, 0) : stop + 1] = False
    return long, live


def find_frozen_force(log: Log, joint: str, moves: NDArray[np.bool_]) -> list[FrozenStretch]:
    """Return the stretches in which a force keeps one value while its joint moves.

    Stretches of zeros (a drive that is off) and of extremes (its limit) do not count.
    """
    column = f"tau_{joint}"
    runs = find_constant_runs(log.channels[column])
    if len(runs.starts) < 10 * _SIXTH:
        return []
    least = max(MIN_FROZEN_S * log.rate_hz, MIN_LONGER * float(np.sort(runs.lengths)[-_SIXTH]))
    extreme = (runs.values == runs.values.max()) | (runs.values == runs.values.min()) | (runs.values == 0)
    long = [(int(runs.starts[k]), int(runs.lengths[k])) for k in np.flatnonzero((runs.lengths >= least) & ~extreme)]
    return [FrozenStretch(column, a, a + n, f"{joint} moves") for a, n in long if np.mean(moves[a : a + n]) > 0.5]


def _find_sudden_stop(x: NDArray[np.float64], live: NDArray[np.bool_], start: int, stop: int, dt: float) -> str:
    """Return how fast a position (N,) moved right before or after a stretch of one value, if no other stop is as sudden."""
    width = max(4, round(STOP_S / dt))
    if len(x) < 4 * width:
        return ""
    speed = (x[width:] - x[:-width]) / width
    usable = np.convolve(live, np.ones(2 * width + 1), "valid") > 2 * width
    changes = np.abs(speed[width:] - speed[:-width])[: len(usable)][usable]
    if changes.size < 10 * width:
        return ""
    before = speed[start - width] if start >= width else 0.0
    after = speed[stop - 1] if stop - 1 < len(speed) else 0.0
    for v, word in ((before, "before"), (after, "after")):
        if abs(v) > STOP_RATIO * float(changes.max()):
            return f"it moves by {abs(v) / dt:.2g} a second right {word}"
    return ""


def _find_flicker(log: Log, joint: str, live: NDArray[np.bool_], start: int, stop: int) -> str:
    """Return how far a channel flickers at low speed too, if its joint's force goes on in a stretch of one value."""
    x = log.channels[f"q_{joint}"]
    rough, alive = np.diff(x, 4), np.convolve(live, np.ones(5), "valid") > 4
    speed = np.abs(x[4:] - x[:-4])
    if np.count_nonzero(alive) < MIN_SLOW:
        return ""
    slow = alive & (speed < SLOW_SHARE * float(np.quantile(speed[alive], 0.9)))
    pairs = slow[1:] & slow[:-1]
    if np.count_nonzero(pairs) < MIN_SLOW:
        return ""
    power = float(np.mean(rough[slow] ** 2))
    neighbours = float(np.mean((rough[1:] * rough[:-1])[pairs])) / max(power, 1e-300)
    noise = np.sqrt(power / 70)  # fourth differences remove the motion and multiply white power by 70
    fades = power < 0.25 * float(np.median(rough[alive] ** 2)) / 0.455  # the median of chi-square with one degree
    if fades or neighbours > MAX_NEIGHBOUR or noise < MIN_COUNTS * float(estimate_quantisation_step(x)):
        return ""
    if not _is_force_active(log, joint, live, start, stop):
        return ""
    return f"it flickers by {noise:.2g} elsewhere, and tau_{joint} goes on"


def _is_force_active(log: Log, joint: str, live: NDArray[np.bool_], start: int, stop: int) -> bool:
    """Return whether a joint's force varies in a stretch about as much as elsewhere; a joint at rest is held by a steady one."""
    if not log.has("tau", [joint]):
        return False
    width = max(1, round(FORCE_S * log.rate_hz))
    smooth = np.convolve(log.channels[f"tau_{joint}"], np.ones(width) / width, "same")
    return float(np.std(smooth[start:stop])) > MIN_ACTIVE * float(np.std(smooth[live])) > 0


def _clipped(log: Log, column: str, share: float) -> CheckFinding | None:
    if share < 1e-4:
        return None
    x = log.channels[column]
    extremes = f"its extremes ({x.min():.5g}, {x.max():.5g})"
    sentence = f"{log.name}: {column} is on a plateau at {extremes} in {100 * share:.2g} % of samples."
    severity = "fault" if share > 0.05 else "warning"
    return CheckFinding(severity, "clipping", sentence, "Move more gently, or widen the drive's or logger's range.")
