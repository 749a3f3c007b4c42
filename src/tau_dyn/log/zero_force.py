"""Forces that drop out: a zero, or the last value held, between samples that are far from it.

A missing measurement is often written as zero or as the value before. A zero run is a stretch of exact zeros whose two neighbours
stand six typical steps off, on the same side: a force that passes through zero changes its side. A held run is a stretch of three
or more exactly equal values in a channel that otherwise hardly ever repeats a value. Joints at rest are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.log.column_names import count
from tau_dyn.log.log import Log
from tau_dyn.log.signal_checks import find_constant_runs

MIN_STEPS_OFF = 6.0
"""How far the neighbours stand from zero, in median changes of a sample; noise passes four in 1 of 1000 samples."""

MIN_EVENTS = 3
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
        if len(zero) >= MIN_EVENTS:
            sentence = (
                f"{log.name}: tau_{joint} is exactly zero in {count(len(zero), 'place')} where the force before and after is far "
                f"from it, first at t = {log.t[zero[0]]:.6g} s: readings were lost. Leave these samples out by a column that "
                "flags them (--exclude), or log the drive's force without gaps."
            )
            found.append(CodedWarning("zero_force_runs", sentence))
        held = find_held_runs(log, f"tau_{joint}")
        if len(held) >= MIN_EVENTS:
            sentence = (
                f"{log.name}: tau_{joint} stands still for {MIN_HELD} samples or more in {count(len(held), 'place')}, first at "
                f"t = {log.t[held[0]]:.6g} s, and changes with each sample elsewhere: the logger repeats its last reading. Leave "
                "these samples out (--exclude), or log the drive's force without gaps."
            )
            found.append(CodedWarning("held_channel", sentence))
    return found
