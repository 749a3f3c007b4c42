"""Data divided by blocks in time: trained on, confirmed on, and measured on.

Without held-out logs every log is cut into blocks that take turns, 3 : 1 : 1, so that each part sees the whole range of
temperatures and places. With held-out logs these take turns 1 : 1 between confirmation and measurement. Between blocks of
different parts the filter's memory is left out, so that no sample is shared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.estimate import Run

TRAIN, CONFIRM, GAIN = EVERY = (0, 1, 2)
_SHARED = (TRAIN, CONFIRM, TRAIN, GAIN, TRAIN)
_HELD_OUT = (CONFIRM, GAIN)
_WITHIN = (TRAIN, CONFIRM, TRAIN, TRAIN)
_LONGEST_S = 6.0
_FEWEST = 15
"""Blocks that a log is cut into, at least; of fewer none would see all parts of the motion."""


def divide(runs: Sequence[Run], held: Sequence[bool], any_held: bool, gap_s: float) -> list[np.ndarray]:
    """Return the part of each sample (n,) of each run: `TRAIN`, `CONFIRM`, `GAIN`, or -1 beside a border.

    Args:
        runs: Stretches of logs.
        held: Whether a run belongs to a held-out log.
        any_held: Whether there are held-out logs at all; then the others are trained on as a whole.
        gap_s: Time left out on both sides of a border [s].
    """
    found, turn = [], {True: 0, False: 0}
    for run, out in zip(runs, held, strict=True):
        if any_held and not out:
            found.append(np.full(len(run.t), TRAIN))
            continue
        pattern = _HELD_OUT if out else _SHARED
        parts, turn[out] = _blocks(run.t - run.t[0], pattern, turn[out], gap_s)
        found.append(parts)
    return found


def divide_training(runs: Sequence[Run], parts: Sequence[np.ndarray], gap_s: float) -> list[np.ndarray]:
    """Return parts in which the training logs alone are trained on and confirmed on, 3 : 1 in blocks; the rest is left out."""
    found, turn = [], 0
    for run, part in zip(runs, parts, strict=True):
        if np.all(part == TRAIN):
            inner, turn = _blocks(run.t - run.t[0], _WITHIN, turn, gap_s)
        else:
            inner = np.full(len(run.t), -1)
        found.append(inner)
    return found


def _blocks(t: np.ndarray, pattern: tuple[int, ...], first: int, gap_s: float) -> tuple[np.ndarray, int]:
    """Cut one run into blocks, starting at place `first` of the pattern; return the parts and the next place."""
    duration = float(t[-1])
    rounds = max(1, round(max(duration / _LONGEST_S, _FEWEST) / len(pattern)))
    length = duration / (rounds * len(pattern)) * (1 + 1e-9) or 1.0
    number = (t / length).astype(int)
    parts = np.array([pattern[(first + b) % len(pattern)] for b in range(number[-1] + 1)])
    out = parts[number]
    for border in range(1, len(parts)):
        if parts[border] != parts[border - 1]:
            out[np.abs(t - border * length) < gap_s] = -1
    return out, first + len(parts)
