"""What a check of a log says, and each channel judged by itself: constant, frozen, held, clipped, or jumping.

A `CheckFinding` is one sentence about one topic, with what would help. `fault` means that the log should not be used as it is,
`warning` that an answer will be poorer, `ok` that a thing was looked at and is fine, or why it was not looked at.

Runs of exactly equal values tell a constant, a frozen, a held and a clipped channel apart: a live measurement hardly ever
repeats itself to the last digit while its joint moves. A jump is a change that stands alone: ten times as far as nine of ten
of the joint's changes and further than a fiftieth of its whole range, and neither the change before nor the one after goes a
quarter as far the same way. An encoder that wraps, was set anew, or lost a reading does so; a joint that moves fast does so
for several samples.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.log import Log
from tau_dyn.message_codes import CodedWarning, get_code
from tau_dyn.results import Shown, count

Severity = Literal["ok", "warning", "fault"]


@dataclass(frozen=True)
class CheckFinding:
    """One thing that was looked at."""

    severity: Severity
    topic: str
    sentence: str
    remedy: str = ""
    """What would help; empty where nothing has to."""
    code: str = ""
    """Stable code, see docs/reference/message_codes.md; empty where there is none."""


def choose_finding(topic: str, fine: str, *doubts: tuple[bool, str, str]) -> CheckFinding:
    """Return the first doubt that holds as a warning, else what is fine; a doubt is (whether it holds, sentence, remedy)."""
    for holds, sentence, remedy in doubts:
        if holds:
            return CheckFinding("warning", topic, sentence, remedy)
    return CheckFinding("ok", topic, fine)


def build_fault(warning: str) -> CheckFinding:
    """Return a coded warning as a fault of the log; its sentence holds the remedy."""
    return CheckFinding("fault", "integrity", str(warning), code=get_code(warning))


@dataclass(frozen=True)
class LogCheck(Shown):
    """The judgement of a log.

    Attributes:
        name: The log's name.
        findings: Everything that was looked at, in a fixed order of topics.
        numbers: The figures behind the sentences, plain numbers and lists for JSON; per-joint figures are mappings by
            joint.
    """

    name: str
    findings: tuple[CheckFinding, ...]
    numbers: dict[str, Any]

    @property
    def fit_for_use(self) -> bool:
        """True where no finding is a fault."""
        return not any(finding.severity == "fault" for finding in self.findings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are warnings or faults."""
        doubtful = [finding for finding in self.findings if finding.severity != "ok"]
        return tuple(CodedWarning(f.code, f.sentence) if f.code else f.sentence for f in doubtful)

    def with_faults(self, warnings: Iterable[str]) -> LogCheck:
        """Return the check with what a robot file says against the log: coded warnings, as further faults.

        A column for which they give a line of a map loses the line that its range alone suggested.
        """
        sentence = f"{self.name}: wiring and the time of the forces were held against the masses of the robot file."
        judged = CheckFinding("ok", "synchronisation", sentence)
        kept = [f for f in self.findings if (f.topic, f.severity) != ("synchronisation", "ok")]
        faults = [build_fault(warning) for warning in warnings]
        mended = {line for fault in faults for line in re.findall(r"`(\w+): \{", fault.sentence)}
        kept = [
            f for f in kept if not (f.code == "scale_wrong" and mended & set(re.findall(r"`(\w+): \{", f.sentence)))
        ]
        return replace(self, findings=(*kept, judged, *(f for f in faults if f not in kept)))

    def to_dict(self) -> dict[str, Any]:
        """Return the check as plain data for JSON."""
        findings = [{k: x for k, x in asdict(f).items() if k != "code" or x} for f in self.findings]
        return {"name": self.name, "fit_for_use": self.fit_for_use, "findings": findings, "numbers": self.numbers}


_FURTHER = 10.0
"""How much further than nine of ten steps a jump is."""

_OF_RANGE = 0.02
"""Least size of a jump, as a share of the joint's range."""

_ALONE = 0.25
"""A change with a neighbour of this share of its size, the same way, is motion: a quick move seen by few samples."""

_TURN = 0.1
"""How near a jump comes to whole turns, as a share of one, where the encoder wraps."""


def find_jumps(q: NDArray[np.float64], fastest: float = 0.0) -> NDArray[np.intp]:
    """Return the samples after which a position (N,) jumps.

    Args:
        q: Positions [m or rad], evenly sampled or nearly so.
        fastest: The joint's own limit [per sample]; slower steps are motion.
    """
    changes = np.flatnonzero(np.diff(q))  # a reading held over several samples is one
    step = np.diff(q)[changes]
    if step.size < 2:
        return np.zeros(0, np.intp)
    size = np.abs(step)
    least = max(_FURTHER * float(np.quantile(size, 0.9)), _OF_RANGE * float(np.ptp(q)), fastest)
    padded = np.concatenate([[0.0], step, [0.0]])
    found = np.flatnonzero(size > least)
    apart = [max(np.sign(step[k]) * padded[[k, k + 2]]) < _ALONE * size[k] for k in found]
    return changes[found[apart]]


def check_jumps(
    log: Log,
    joint: str,
    *,
    revolute: bool | None = None,
    fastest: float = 0.0,
    left_out: NDArray[np.bool_] | None = None,
) -> CheckFinding | None:
    """Return what is wrong with a joint's positions if they jump.

    Args:
        log: The log.
        joint: The joint.
        revolute: Whether it turns, None if unknown.
        fastest: Its speed limit [m/s or rad/s], where one is known.
        left_out: Samples (N,) that nobody uses; jumps to or from them are let pass.
    """
    q = log.channels[f"q_{joint}"]
    at = find_jumps(q, fastest * log.dt if np.isfinite(fastest) else 0.0)
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
        why, remedy = "the encoder begins anew each turn", "Unwrap it (numpy.unwrap)."
    else:
        why = "readings were lost, or the encoder was set anew"
        remedy = "Leave out the lines of lost readings, or flag them in a column (--exclude); "
        remedy += "cut the log where an encoder was set anew."
    return CheckFinding("fault", "jumps", f"{sentence}: {why}.", remedy)


MIN_CLIPPED_SAMPLES = 5
"""So many equal samples in a row at the largest or smallest value are a plateau."""

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
        moving: For each joint, whether it moves (N,), as positions or, where they freeze, references say.

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
            found, measured = _constant(log, column, runs), signal != "q_ref"
            found = found or (_frozen(log, column, runs, moves) if measured else None)
            if signal == "tau":
                clipped[column] = compute_clipped_share(runs, moves)
                found = found or _clipped(log, column, clipped[column])
            found = found or (_check_sample_hold(log, column, runs, moves) if measured else None)
            findings.append(found or CheckFinding("ok", "signal", f"{column}: no fault found."))
    return findings, {"clipped": clipped}


def compute_clipped_share(runs: ConstantRuns, moves: NDArray[np.bool_]) -> float:
    """Return the share of samples on plateaus at a channel's largest or smallest value while its joint moves.

    A plateau is 5 samples or more, and the extreme value stands five times as often as the value next to it, so that
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
    """Find a long stretch without a change during motion, away from the extremes, which would be clipping."""
    extreme = (runs.values == runs.values.max()) | (runs.values == runs.values.min())
    needed = max(MIN_FROZEN_S * log.rate_hz, 5 * float(np.median(runs.lengths)))
    inside = np.flatnonzero((runs.lengths >= needed) & ~(extreme & column.startswith("tau_")))
    for k in inside:
        start, stop = runs.starts[k], runs.starts[k] + runs.lengths[k]
        if np.mean(moves[start:stop]) > 0.5:
            span = f"{log.t[start]:.6g} to {log.t[stop - 1]:.6g} s"
            sentence = f"{log.name}: {column} stays at {runs.values[k]:.6g} from {span}, while the joint moves."
            return CheckFinding(
                "fault", "frozen", sentence, "Leave that stretch out; look at the sensor or its bus.", "held_channel"
            )
    return None


def _clipped(log: Log, column: str, share: float) -> CheckFinding | None:
    if share < 1e-4:
        return None
    x = log.channels[column]
    extremes = f"its extremes ({x.min():.5g}, {x.max():.5g})"
    sentence = f"{log.name}: {column} sits on a plateau at {extremes} in {100 * share:.2g} % of samples."
    severity = "fault" if share > 0.05 else "warning"
    return CheckFinding(severity, "clipping", sentence, "Move more gently, or widen the drive's or logger's range.")


def _check_sample_hold(log: Log, column: str, runs: ConstantRuns, moves: NDArray[np.bool_]) -> CheckFinding | None:
    """Find a channel that is renewed less often than it is logged: nearly all its runs have the same length above 1."""
    during = moves[runs.starts]
    lengths = runs.lengths[during]
    usual = int(np.median(lengths)) if lengths.size else 1
    if usual < 2 or np.mean(lengths == usual) < 0.8:
        return None
    late = (usual - 1) / 2 * log.dt
    sentence = f"{log.name}: {column} is updated every {usual} samples; it is {late:.2g} s late on average."
    remedy = f"Log it at the full rate, or the others at {log.rate_hz / usual:.6g} Hz."
    return CheckFinding("warning", "held", sentence, remedy, "held_channel")
