r"""One kind of measurement as the selection of causes uses it.

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
from typing import ClassVar

import numpy as np

from tau_dyn.effects import Effect, Motion, Scene
from tau_dyn.estimate import Autoregression, RegressionRun, Whitener, build_prior_rows
from tau_dyn.exceptions import CannotAnswer
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


def split_by_blocks(runs: Sequence[RegressionRun], held: Sequence[bool], gap_s: float) -> tuple[np.ndarray, ...]:
    """Return the part of each sample (n,) of each run: `TRAIN`, `VALIDATION`, `TEST`, or -1 beside a border.

    Args:
        runs: Stretches of logs.
        held: Whether a run belongs to a held-out log; where any does, the others are trained on as a whole.
        gap_s: Time left out on both sides of a border [s].
    """
    wanted = set(_HELD_OUT if any(held) else _SHARED)
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
        pattern = _HELD_OUT if out else _SHARED
        parts, turn[out] = _blocks(run.t - run.t[0], pattern, turn[out], gap_s, least_s)
        found.append(parts)
    return tuple(found)


def describe_split(held: bool, what: str) -> str:
    """Return how data of a kind `what` ("logs", "poses") are divided, with held-out ones or without."""
    if held:
        return f"the blocks of the held-out {what} alternate: half are validation data, half are test data"
    return f"the blocks of the {what} alternate: 60 % training, 20 % validation and 20 % test data"


def divide_training(runs: Sequence[RegressionRun], parts: Sequence[np.ndarray], gap_s: float) -> tuple[np.ndarray, ...]:
    """Return parts in which the training logs alone are trained on and confirmed on, 3 : 1 in blocks; the rest is left out."""
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

    def report(self) -> Channel:
        """Return the same measurements as errors are reported of them; by default as causes are searched in them."""
        return self

    @abstractmethod
    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run, filtered and masked as the measurements are."""

    def run_columns_together(self, effects: Sequence[Effect], run: int) -> list[np.ndarray]:
        """Return the columns (n, m, k) of several effects of one run; see `Channel.run_columns`."""
        return [self.run_columns(effect, run) for effect in effects]

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
        """Return what thousands of settings of a dense effect explain of white residuals (R, d), as (g, d).

        Settings without a short cut are nan; without any at all the answer is None.
        """
        return None

    @property
    def poses(self) -> bool:
        """Whether some of the logs are poses held still, of which several periods of a cyclic error may fit equally."""
        return False

    @abstractmethod
    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return what an unknown force might depend on: for each run, name -> (n,), such as `v_cart1` or `t`."""

    def masks(self, *parts: int) -> list[np.ndarray]:
        """Return which samples (n, m) of each run are usable and belong to these parts."""
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
        """Measurements less what fixed parameters predict (n, m), of each run."""
        fixed = ~self.parameters.free
        return [run.y - run.W[:, :, fixed] @ self.parameters.values[fixed] for run in self.runs]

    @property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """What was known beforehand as rows of unit noise: (k, p') and (k,)."""
        return build_prior_rows(Parameters([p for p in self.parameters if p.free]))


def name_by_joint(joints: Sequence[str], **arrays: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of arrays (n, na) by name and joint, such as `v_cart1`."""
    return {f"{key}_{joint}": x[:, k] for key, x in arrays.items() for k, joint in enumerate(joints)}


def refuse_scarce(channel: Channel, least: Sequence[int], short: str, have: str, wanted: str) -> None:
    """Refuse measurements that leave one of the three parts too little.

    Args:
        channel: The measurements.
        least: Usable values that each part needs.
        short: What is missing, such as `too little is left`; for what is added.
        have: What there is.
        wanted: What to record instead.

    Raises:
        CannotAnswer: A part has fewer.
    """
    for part, needed in zip(EVERY, least, strict=True):
        if sum(int(mask.sum()) for mask in channel.masks(part)) < needed:
            raise CannotAnswer("too_little_data", f"{short} to {_USES[part]}: {have}", wanted)


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
        campaigns: Number of logs that are distinguished.
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


class EffectColumns(Sequence[np.ndarray]):
    """An effect's columns (n, m, k) of each run, made when first asked for: most are tried on the training logs alone."""

    def __init__(self, channel: Channel, effect: Effect) -> None:
        """Make nothing yet."""
        self._channel, self.effect = channel, effect
        self.made: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self._channel.runs)

    def __getitem__(self, run: int) -> np.ndarray:  # type: ignore[override]  # slices are of no use here
        """Return the columns of one run."""
        if run >= len(self):
            raise IndexError(run)
        if run not in self.made:
            self.made[run] = self._channel.run_columns(self.effect, run)
        return self.made[run]


class ColumnCache:
    """Columns of effects on one channel, made once."""

    def __init__(self, channel: Channel) -> None:
        """Start empty."""
        self.channel = channel
        self._made: dict[tuple, EffectColumns] = {}
        self._white: dict[tuple, tuple[Whitener, np.ndarray, np.ndarray]] = {}

    def columns(self, effect: Effect) -> EffectColumns:
        """Return an effect's exact columns."""
        key = (effect.name, effect.joints, tuple(sorted(effect.settings.items())), effect.label)
        return self._made.setdefault(key, EffectColumns(self.channel, effect))

    def make_together(self, effects: Sequence[Effect], runs: Sequence[int]) -> list[EffectColumns]:
        """Return the exact columns of several effects, those of the runs given made, together."""
        found = [self.columns(effect) for effect in effects]
        for run in runs:
            new = [one for one in dict.fromkeys(found) if run not in one.made]
            together = self.channel.run_columns_together([one.effect for one in new], run) if new else []
            for one, columns in zip(new, together, strict=True):
                one.made[run] = columns
        return found

    def whiten_baseline(
        self, parts: tuple[int, ...], noise: tuple[Autoregression, ...]
    ) -> tuple[Whitener, np.ndarray, np.ndarray]:
        """Return what whitens these parts under a noise model of each output, the baseline's white columns and measurements.

        The last ones asked for are kept: many effects are tried beside the same baseline.
        """
        if (parts, noise) not in self._white:
            whiten = Whitener.of(self.channel.runs, self.channel.masks(*parts), noise)
            self._white = {(parts, noise): (whiten, whiten(self.channel.free_columns), whiten(self.channel.target))}
        return self._white[parts, noise]
