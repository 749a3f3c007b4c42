r"""Measurements of one kind with the columns that a fit may use, divided into training, validation and test data.

Data are divided by blocks in time. Without held-out logs every log is cut into alternating blocks, 3 : 1 : 1, so that each part
covers the whole range of temperatures and positions. With held-out logs these take turns 1 : 1 between confirmation and
measurement. Between blocks of different parts the filter's memory is left out, so that no sample is shared. A block is several
times longer than that memory, so a short log has fewer blocks, and a short piece is one block as a whole.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.estimate import RegressionRun, build_prior_rows
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.parameters import Parameters

TRAIN, VALIDATION, TEST = EVERY = (0, 1, 2)
HELD_OUT = VALIDATION, TEST
_SHARED = (TRAIN, VALIDATION, TRAIN, TEST, TRAIN)
_WITHIN = (TRAIN, VALIDATION, TRAIN, TRAIN)
_MAX_BLOCK_S = 6.0  # [s] of the longest block
_MIN_BLOCKS = 15
"""Least number of blocks of a log, if they are long enough; with fewer blocks, no part would contain all of the motion."""
_MIN_GAPS = (6.0, 4.0, 3.0)
"""Least length of a block in gaps at a border: a block between two borders keeps 2/3, 1/2 or 1/3 of its samples. The first
value for which no part is empty is used."""


def split_by_blocks(runs: Sequence[RegressionRun], held: Sequence[bool], gap_s: float) -> tuple[np.ndarray, ...]:
    """Return the part of each sample (n,) of each run: `TRAIN`, `VALIDATION`, `TEST`, or -1 next to a border.

    Args:
        runs: Stretches of logs.
        held: Whether a run belongs to a held-out log; if any does, all others are training data.
        gap_s: Time left out on both sides of a border [s].
    """
    wanted = set(HELD_OUT if any(held) else _SHARED)
    for gaps in _MIN_GAPS:
        found = _divided(runs, held, gap_s, gaps * gap_s)
        if wanted <= {int(part) for parts in found for part in np.unique(parts)}:
            break
    return found


def _divided(
    runs: Sequence[RegressionRun], held: Sequence[bool], gap_s: float, least_s: float
) -> tuple[np.ndarray, ...]:
    """Divide as `split_by_blocks`, with blocks of a length of `least_s` [s] or more."""
    found, turn = [], {True: 0, False: 0}
    for run, out in zip(runs, held, strict=True):
        if any(held) and not out:
            found.append(np.full(len(run.t), TRAIN))
            continue
        pattern = HELD_OUT if out else _SHARED
        parts, turn[out] = _blocks(run.t - run.t[0], pattern, turn[out], gap_s, least_s)
        found.append(parts)
    return tuple(found)


def describe_split(held: bool, what: str) -> str:
    """Return how data of a kind `what` ("logs", "poses") are divided, with held-out ones or without."""
    if held:
        return f"the blocks of the held-out {what} alternate: half are validation data, half are test data"
    return f"the blocks of the {what} alternate: 60 % training, 20 % validation and 20 % test data"


def divide_training(runs: Sequence[RegressionRun], parts: Sequence[np.ndarray], gap_s: float) -> tuple[np.ndarray, ...]:
    """Return parts that divide the training logs alone into training and validation data, 3 : 1 in blocks."""
    found, turn = [], 0
    for run, part in zip(runs, parts, strict=True):
        if np.all(part == TRAIN):
            inner, turn = _blocks(run.t - run.t[0], _WITHIN, turn, gap_s, _MIN_GAPS[0] * gap_s)
        else:
            inner = np.full(len(run.t), -1)
        found.append(inner)
    return tuple(found)


def _blocks(
    t: np.ndarray, pattern: tuple[int, ...], first: int, gap_s: float, least_s: float
) -> tuple[np.ndarray, int]:
    """Cut one run into blocks, starting at index `first` of the pattern; return the parts and the next index."""
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
    """Return the number of blocks of a run: whole patterns of a size if they fit, otherwise as many blocks as fit, or one."""
    wanted = max(1, round(max(duration / _MAX_BLOCK_S, _MIN_BLOCKS) / size)) * size
    most = int(duration / least_s) if least_s > 0 else wanted
    if most >= size:
        return min(wanted, most // size * size)
    return max(1, most)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of one kind: the data for a fit, a noise model, a confirmation of columns and a gain.

    Attributes:
        name: `force`, `tool`, `deflection` or `position`.
        outputs: The measured quantities (m).
        units: Units of the outputs.
        parameters: Parameters of the baseline's columns (p).
        runs: Baseline columns and measurements.
        parts: Part of each sample (n,) of each run: `TRAIN`, `VALIDATION`, `TEST`, or -1 for unused samples.
    """

    name: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    parameters: Parameters
    runs: tuple[RegressionRun, ...]
    parts: tuple[np.ndarray, ...]

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return the variables of an unknown dependence: for each run, name -> (n,), such as `v_cart1` or `t`."""
        return [name_by_joint(self.outputs, **run.signals) | {"t": run.t} for run in self.runs]

    def list_known_columns(self) -> list[Sequence[np.ndarray]]:
        """Return the columns (n, m, k) of each run that are not noise: those that the baseline may refit."""
        return [self.free_columns]

    def masks(self, *parts: int) -> list[np.ndarray]:
        """Return the masks (n, m) of each run's samples that are usable and belong to these parts."""
        return [run.usable & np.isin(part, parts)[:, None] for run, part in zip(self.runs, self.parts, strict=True)]

    def gather(self, arrays: Sequence[np.ndarray], output: int, *parts: int) -> np.ndarray:
        """Return the usable samples (R, ...) of one output that belong to these parts, of arrays (n, m, ...) over the runs."""
        return np.concatenate([x[m[:, output], output] for x, m in zip(arrays, self.masks(*parts), strict=True)])

    @property
    def free_columns(self) -> list[np.ndarray]:
        """Columns that the baseline may refit (n, m, p'), of each run."""
        return [run.W[:, :, self.parameters.free] for run in self.runs]

    @property
    def target(self) -> list[np.ndarray]:
        """Measurements minus the prediction of fixed parameters (n, m), of each run."""
        fixed = ~self.parameters.free
        return [run.y - run.W[:, :, fixed] @ self.parameters.values[fixed] for run in self.runs]

    @property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Prior knowledge as rows of unit noise: (k, p') and (k,)."""
        return build_prior_rows(Parameters([p for p in self.parameters if p.free]))


def name_by_joint(joints: Sequence[str], **arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of arrays (n, na) by name and joint, such as `v_cart1`."""
    return {f"{key}_{joint}": x[:, k] for key, x in arrays.items() for k, joint in enumerate(joints)}


_USES = {TRAIN: "train on", VALIDATION: "confirm on", TEST: "measure the gain on"}


def refuse_scarce(channel: Measurements, least: Sequence[int], short: str, have: str, wanted: str) -> None:
    """Reject measurements with too few data for one of the three parts.

    Args:
        channel: The measurements.
        least: Usable values that each part needs.
        short: The shortage, such as `too little is left`; its purpose is added.
        have: The data that there are.
        wanted: What to record instead.

    Raises:
        CannotAnswer: A part has fewer.
    """
    for part, needed in zip(EVERY, least, strict=True):
        if sum(int(mask.sum()) for mask in channel.masks(part)) < needed:
            raise CannotAnswer("too_little_data", f"{short} to {_USES[part]}: {have}", wanted)
