"""Positions that jump: an encoder that wraps, was set anew, or lost a reading; no joint moves so.

A jump is a change that stands alone: ten times as far as nine of ten of the joint's changes and further than a fiftieth of its
whole range, and neither the change before nor the one after goes a quarter as far the same way. A joint that moves fast does so
for several samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.check_result import CheckFinding
from tau_dyn.log.column_names import count
from tau_dyn.log.log import Log

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
        return CheckFinding(
            "fault", "jumps", f"{sentence}: the encoder begins anew each turn.", "Unwrap it (numpy.unwrap)."
        )
    return CheckFinding(
        "fault",
        "jumps",
        f"{sentence}: readings were lost, or the encoder was set anew.",
        "Leave out the lines of lost readings, or flag them in a column (--exclude); cut the log where an encoder was set anew.",
    )
