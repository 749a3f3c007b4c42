"""Each channel by itself: constant, frozen for a while, held over several samples, clipped at its extremes.

Part of `check.py`. Runs of exactly equal values tell all four apart: a live measurement hardly ever repeats itself to
the last digit while its joint moves.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.check_result import CheckFinding
from tau_dyn.log.log import Log

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
            judges: list[Callable[[], CheckFinding | None]] = [lambda c=column, r=runs: _constant(log, c, r)]
            if signal != "q_ref":
                judges.append(lambda c=column, r=runs, m=moves: _frozen(log, c, r, m))
            if signal == "tau":
                clipped[column] = compute_clipped_share(runs, moves)
                judges.append(lambda c=column: _clipped(log, c, clipped[c]))
            if signal != "q_ref":
                judges.append(lambda c=column, r=runs, m=moves: _check_sample_hold(log, c, r, m))
            findings += [
                next(
                    (f for f in (judge() for judge in judges) if f),
                    CheckFinding("ok", "signal", f"{column}: no fault found."),
                )
            ]
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
