"""Data divided by blocks in time: trained on, confirmed on, and measured on.

Without held-out logs every log is cut into blocks that take turns, 3 : 1 : 1, so that each part sees the whole range of
temperatures and places. With held-out logs these take turns 1 : 1 between confirmation and measurement. Between blocks of
different parts the filter's memory is left out, so that no sample is shared. A block is several times longer than that memory, so
a short log has fewer blocks, and a short piece is one block as a whole; turns go on from piece to piece.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.estimate import RegressionRun

TRAIN, VALIDATION, TEST = EVERY = (0, 1, 2)
_SHARED = (TRAIN, VALIDATION, TRAIN, TEST, TRAIN)
_HELD_OUT = (VALIDATION, TEST)
_WITHIN = (TRAIN, VALIDATION, TRAIN, TRAIN)
_MAX_BLOCK_S = 6.0  # [s] of the longest block
_MIN_BLOCKS = 15
"""Blocks that a log is cut into, where they stay long enough; of fewer none would see all parts of the motion."""
_MIN_GAPS = (6.0, 4.0, 3.0)
"""Least length of a block in gaps at a border: a block between two borders keeps 2/3, 1/2 or 1/3 of its samples. The first that
gives every part something is taken."""


def split_by_blocks(
    runs: Sequence[RegressionRun], held: Sequence[bool], any_held: bool, gap_s: float
) -> list[np.ndarray]:
    """Return the part of each sample (n,) of each run: `TRAIN`, `VALIDATION`, `TEST`, or -1 beside a border.

    Args:
        runs: Stretches of logs.
        held: Whether a run belongs to a held-out log.
        any_held: Whether there are held-out logs at all; then the others are trained on as a whole.
        gap_s: Time left out on both sides of a border [s].
    """
    wanted = set(_HELD_OUT if any_held else _SHARED)
    for gaps in _MIN_GAPS:
        found = _divided(runs, held, any_held, gap_s, gaps * gap_s)
        if wanted <= {int(part) for parts in found for part in np.unique(parts)}:
            break
    return found


def _divided(
    runs: Sequence[RegressionRun], held: Sequence[bool], any_held: bool, gap_s: float, least_s: float
) -> list[np.ndarray]:
    """Divide as `split_by_blocks`, with blocks of a length of `least_s` [s] or more."""
    found, turn = [], {True: 0, False: 0}
    for run, out in zip(runs, held, strict=True):
        if any_held and not out:
            found.append(np.full(len(run.t), TRAIN))
            continue
        pattern = _HELD_OUT if out else _SHARED
        parts, turn[out] = _blocks(run.t - run.t[0], pattern, turn[out], gap_s, least_s)
        found.append(parts)
    return found


def divide_training(runs: Sequence[RegressionRun], parts: Sequence[np.ndarray], gap_s: float) -> list[np.ndarray]:
    """Return parts in which the training logs alone are trained on and confirmed on, 3 : 1 in blocks; the rest is left out."""
    found, turn = [], 0
    for run, part in zip(runs, parts, strict=True):
        if np.all(part == TRAIN):
            inner, turn = _blocks(run.t - run.t[0], _WITHIN, turn, gap_s, _MIN_GAPS[0] * gap_s)
        else:
            inner = np.full(len(run.t), -1)
        found.append(inner)
    return found


def _blocks(
    t: np.ndarray, pattern: tuple[int, ...], first: int, gap_s: float, least_s: float
) -> tuple[np.ndarray, int]:
    """Cut one run into blocks, starting at place `first` of the pattern; return the parts and the next place."""
    duration = float(t[-1])
    length = duration / _count_blocks(duration, len(pattern), least_s) * (1 + 1e-9) or 1.0
    number = (t / length).astype(int)
    parts = np.array([pattern[(first + b) % len(pattern)] for b in range(number[-1] + 1)])
    out = parts[number]
    for border in range(1, len(parts)):
        if parts[border] != parts[border - 1]:
            out[np.abs(t - border * length) < gap_s] = -1
    return out, first + len(parts)


def _count_blocks(duration: float, size: int, least_s: float) -> int:
    """Return how many blocks a run is cut into: whole patterns of a size where they fit, else as many blocks as fit, or one."""
    wanted = max(1, round(max(duration / _MAX_BLOCK_S, _MIN_BLOCKS) / size)) * size
    most = int(duration / least_s) if least_s > 0 else wanted
    if most >= size:
        return min(wanted, most // size * size)
    return max(1, most)
