r"""One kind of measurement as the search for causes sees it, and nothing about how it is searched.

A channel holds a baseline's regression (measured outputs and the columns that the baseline may refit), which samples serve
training, confirmation and measurement, and turns any effect into columns of the same regression. Forces, tool positions and
deflections differ only here.

Data are divided by blocks in time. Without held-out logs every log is cut into blocks that take turns, 3 : 1 : 1, so that each
part sees the whole range of temperatures and places. With held-out logs these take turns 1 : 1 between confirmation and
measurement. Between blocks of different parts the filter's memory is left out, so that no sample is shared. A block is several
times longer than that memory, so a short log has fewer blocks, and a short piece is one block as a whole.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from tau_dyn.effects import Effect, Motion, Scene, StructuralCompliance
from tau_dyn.estimate import RegressionRun, Whitener
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import Log, compute_edge_samples, decimate, lowpass
from tau_dyn.parameters import Parameters

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


_USES = {TRAIN: "train on", VALIDATION: "confirm on", TEST: "measure the gain on"}


@dataclass(frozen=True, eq=False)
class Channel(ABC):
    """One kind of measurement of one robot.

    Attributes:
        name: `force`, `tool` or `deflection`.
        outputs: What is measured (m).
        units: Units of the outputs.
        parameters: Parameters of the baseline's columns (p).
        runs: Baseline columns and measurements.
        parts: Part of each sample (n,) of each run, as `channel.py` numbers them.
        scene: What the motion offers.
        causes: Effects that may be found here.
    """

    has_unnamed_structures: ClassVar[bool] = True
    """Whether a residual is searched for structure without a name."""

    name: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    parameters: Parameters
    runs: tuple[RegressionRun, ...]
    parts: tuple[np.ndarray, ...]
    scene: Scene
    causes: tuple[type[Effect], ...]

    @abstractmethod
    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run, filtered and masked as the measurements are."""

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's columns (n, m, k) of each run."""
        return [self.run_columns(effect, k) for k in range(len(self.runs))]

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns without any sample left out, for drawing."""
        return self.columns(effect)

    def quick_columns(self, effect: Effect) -> Sequence[np.ndarray] | None:
        """Return columns (n, m, k) of each run quicker made than the exact ones and as good; None where there are none."""
        return None

    def scan(self, effects: Sequence[Effect], whiten: Whitener, both: np.ndarray) -> np.ndarray | None:
        """Return what thousands of settings explain of white residuals (R, d), as (g, d).

        Settings without a short cut are nan; without any at all the answer is None.
        """
        return None

    @abstractmethod
    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return what an unknown force might depend on: for each run, name -> (n,), such as `v_cart1` or `t`."""

    def masks(self, *parts: int) -> list[np.ndarray]:
        """Return which samples (n, m) of each run are usable and belong to these parts."""
        return [run.usable & np.isin(part, parts)[:, None] for run, part in zip(self.runs, self.parts, strict=True)]

    def gather(self, arrays: Sequence[np.ndarray], output: int, *parts: int) -> np.ndarray:
        """Return the usable samples (R, ...) of one output that belong to these parts, of arrays (n, m, ...) over the runs."""
        return np.concatenate([x[m[:, output], output] for x, m in zip(arrays, self.masks(*parts), strict=True)])

    @cached_property
    def free_columns(self) -> list[np.ndarray]:
        """Columns that the baseline may refit (n, m, p'), of each run."""
        return [run.W[:, :, self.parameters.free] for run in self.runs]

    @cached_property
    def resonance_columns(self) -> list[np.ndarray]:
        """Columns (n, m, k) of each run of the modes that the scene proposes; k is 0 where there are none."""
        if not self.scene.resonances:
            return [np.zeros((*run.y.shape, 0)) for run in self.runs]
        joints = self.scene.joints
        proposal = StructuralCompliance.proposal(self.scene, joints)
        return self.columns(StructuralCompliance(joints, self.scene.units).with_settings(**proposal))

    @cached_property
    def target(self) -> list[np.ndarray]:
        """Measurements less what fixed parameters predict (n, m), of each run."""
        fixed = ~self.parameters.free
        return [run.y - run.W[:, :, fixed] @ self.parameters.values[fixed] for run in self.runs]

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """What was known beforehand as rows of unit noise: (k, p') and (k,)."""
        free = [p for p in self.parameters if p.free]
        known = [(k, p) for k, p in enumerate(free) if p.prior_stderr]
        rows = np.zeros((len(known), len(free)))
        for row, (k, p) in zip(rows, known, strict=True):
            row[k] = 1 / float(p.prior_stderr or 1.0)
        return rows, np.array([p.value / float(p.prior_stderr or 1.0) for _, p in known])


POSE_S = 1.0
"""Poses held still count one by one, whatever the time between them: each stands for this long [s]."""


@dataclass(frozen=True, eq=False)
class MeasuredSegment:
    """One even stretch of a log, or its poses held still, with a position that the encoders do not read.

    Attributes:
        log: The stretch.
        motion: Motion of the encoders at the log's rate, with what effects feel.
        measured: Measured outputs (N, m) [m or rad].
        predicted: What the encoders alone say of them (N, m).
        usable: Samples that count (N,) or (N, m).
        cutoff_hz: Low-pass on both sides [Hz]; None for poses.
        factor: Decimation.
    """

    log: Log
    motion: Motion
    measured: np.ndarray
    predicted: np.ndarray
    usable: np.ndarray
    cutoff_hz: float | None
    factor: int

    def passed(self, x: np.ndarray) -> np.ndarray:
        """Return an array (N, ...) as the fit sees it (n, ...): low-passed and decimated."""
        if self.cutoff_hz is None:
            return x
        return decimate(lowpass(x, self.cutoff_hz, self.log.rate_hz), self.factor)

    @property
    def t(self) -> np.ndarray:
        """Time of the fit's samples (n,) [s]."""
        return POSE_S * np.arange(len(self.measured)) if self.cutoff_hz is None else decimate(self.log.t, self.factor)

    def run(self, W: np.ndarray) -> RegressionRun:
        """Return the baseline's regression with these columns (n, m, p)."""
        y, usable = self.passed(self.measured - self.predicted), self.usable
        if self.cutoff_hz is not None:
            usable = mask_filter_edges(usable, self.cutoff_hz, self.log.rate_hz, self.factor)
        usable = np.broadcast_to(usable.reshape(len(y), -1), y.shape)
        signals = {key: decimate(getattr(self.motion, key), self.factor) for key in ("q", "v", "a")}
        return RegressionRun(self.log.name, self.t, W, y, usable, W, y, signals)


def name_by_joint(joints: Sequence[str], **arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of arrays (n, na) by name and joint, such as `v_cart1`."""
    return {f"{key}_{joint}": x[:, k] for key, x in arrays.items() for k, joint in enumerate(joints)}


def refuse_scarce(channel: Channel, least: int | Mapping[int, int], short: str, have: str, wanted: str) -> None:
    """Refuse measurements that leave one of the three parts too little.

    Args:
        channel: The measurements.
        least: Usable values that each part needs, one number for all or one for each part.
        short: What is missing, such as `too little is left`; for what is added.
        have: What there is.
        wanted: What to record instead.

    Raises:
        CannotAnswer: A part has fewer.
    """
    for part, use in _USES.items():
        needed = least if isinstance(least, int) else least[part]
        if sum(int(mask.sum()) for mask in channel.masks(part)) < needed:
            raise CannotAnswer("too_little_data", f"{short} to {use}: {have}", wanted)


_FASTEST = 0.98  # quantile of the speed that counts as fast
_RARE = 0.01
"""Share of the training beyond either end of the range that a joint visits often."""


def build_scene(
    motions: Sequence[Motion],
    joints: tuple[str, ...],
    units: tuple[str, ...],
    *,
    slow: np.ndarray,
    cutoff_hz: float,
    duration: float,
    signals: frozenset[str],
    campaigns: int = 1,
    trained: Sequence[np.ndarray] | None = None,
    coupled: tuple[tuple[str, str], ...] = (),
) -> Scene:
    """Return what motions offer together.

    Args:
        motions: The motions.
        joints: Their joints.
        units: The joints' force units, 'N' or 'N m'.
        slow: Slowest speed with a sure sign (na,) [m/s or rad/s].
        cutoff_hz: Frequency above which nothing is seen [Hz].
        duration: Length of all of them [s].
        signals: What effects may feel; see `find_shared_signals`.
        campaigns: Number of logs that are told apart.
        trained: Which samples of each motion causes are fitted to (n,); by default all.
        coupled: Pairs of joints that a shared motor may drive.
    """
    q, v = (np.concatenate([getattr(motion, key) for motion in motions]) for key in ("q", "v"))
    seen = q if trained is None else q[np.concatenate(trained)]
    often = np.quantile(seen, (_RARE, 1 - _RARE), axis=0)
    ends = q.min(axis=0), q.max(axis=0)
    hard = compute_fast_speeds(np.concatenate([motion.a for motion in motions]))
    return Scene(
        joints,
        units,
        *ends,
        slow,
        compute_fast_speeds(v),
        cutoff_hz,
        duration,
        signals,
        campaigns,
        often=often,
        coupled=coupled,
        hard=hard,
    )


def find_shared_signals(motions: Sequence[Motion]) -> frozenset[str]:
    """Return the names of the signals that all motions give."""
    return frozenset.intersection(*(frozenset(motion.signals) for motion in motions))


def compute_fast_speeds(v: np.ndarray) -> np.ndarray:
    """Return the speed that each joint exceeds in 2 % of the samples (na,), of speeds (n, na)."""
    return np.quantile(np.abs(v), _FASTEST, axis=0)


def find_directions(v: np.ndarray, threshold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of the last motion that was surely one, and from when on there was any.

    Args:
        v: Speeds (N, na) [m/s or rad/s].
        threshold: Slowest speed with a sure sign (na,).

    Returns:
        -1 or 1 (N, na), before a joint's first sure motion that of the first, 0 where there is none at all; and whether a
        sure motion came before (N, na).
    """
    sides = [_direction(v[:, k], float(threshold[k])) for k in range(v.shape[1])]
    return np.column_stack([sign for sign, _ in sides]), np.column_stack([known for _, known in sides])


def _direction(v: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    sure = np.flatnonzero(np.abs(v) >= threshold)
    if not len(sure):
        return np.zeros_like(v), np.zeros(len(v), bool)
    last = np.searchsorted(sure, np.arange(len(v)), side="right") - 1
    return np.sign(v[sure[np.maximum(last, 0)]]), last >= 0


def mask_filter_edges(mask: np.ndarray, cutoff_hz: float, rate_hz: float, factor: int) -> np.ndarray:
    """Return which samples count, without those at both ends that the low-pass disturbs.

    Args:
        mask: Samples (N, ...) at the log's rate.
        cutoff_hz: The low-pass [Hz].
        rate_hz: Rate of the log [Hz].
        factor: Decimation.

    Returns:
        Samples (n, ...) after decimation.
    """
    inner = mask[::factor].copy()
    edge = int(np.ceil(compute_edge_samples(cutoff_hz, rate_hz) / factor))
    inner[:edge] = inner[len(inner) - edge :] = False
    return inner
