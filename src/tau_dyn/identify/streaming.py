"""The regression of recordings larger than memory: blocks are computed in parallel, summed in order, and discarded.

The response of a filter decays exponentially. A block is read with so many extra samples on both sides that the effect of its cut
ends is below rounding. It goes through the same preparation as a whole log, and the rows of the extra samples are dropped. Blocks
are therefore independent: they run in parallel and in any process, and the place of a cut changes no row by more than rounding.

The results kept are the outputs' triangular factors, the decimated rows in a temporary file (for the covariance, which needs the
residuals in order), and some blocks in full, for a page to draw. The sum is taken block by block in order, so one thread, many,
or a cluster give the same bits.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from tau_dyn.effects import Bristle, WindingHeat
from tau_dyn.estimate import (
    ROUNDING,
    Preparation,
    Regression,
    RegressionRows,
    RegressionRun,
    StoredRows,
    StreamedData,
    SufficientStatistics,
)
from tau_dyn.exceptions import InputError
from tau_dyn.identify.preparation import choose_preparation, keep_long, list_crumbs, refuse_jumps, select_long
from tau_dyn.identify.regression import prepare_segment
from tau_dyn.log import (
    ROOM_TEMPERATURE,
    EvenSegment,
    InMemorySegment,
    Log,
    Recording,
    compute_edge_samples,
    resample_segments,
    split_even_segments,
)
from tau_dyn.model import Model
from tau_dyn.scale import iterate_in_order, run_on_workers

SIZE = 2**22
"""Numbers in a block's columns."""

MIN_BLOCK_ROWS = 256
"""Least number of decimated rows of a block, so that it does not consist mostly of extra samples."""

OVERLAP_FILTER_MEMORIES = 8
"""Filter memories (to 1 % of a transient) read beyond a block: 1e-16 of a cut end is left."""


class Block(NamedTuple):
    """A part of a stretch: decimated samples `start` to `stop - 1`, and the section they count for."""

    stretch: int
    start: int
    stop: int
    section: int


class BlockRows(NamedTuple):
    """A block's rows and their totals.

    Attributes:
        rows: Rows for the covariance.
        used: Totals of the rows a fit may use.
        whole: Totals of all rows.
        run: The block in full, if requested.
    """

    rows: RegressionRows
    used: SufficientStatistics
    whole: SufficientStatistics
    run: RegressionRun | None


@dataclass(frozen=True, eq=False)
class BlockWork:
    """Data that all blocks share; it is sent to other processes.

    Attributes:
        model: Model that gives the columns.
        at: Model that gives the signals that follow from values.
        stretches: Stretches that are cut into blocks.
        numbers: The number of the recording that each stretch is from.
        preparation: Filters and masks.
        scale: Factor of each output.
        shown: Blocks that are kept in full.
    """

    model: Model
    at: Model
    stretches: tuple[EvenSegment | InMemorySegment, ...]
    numbers: tuple[int, ...]
    preparation: Preparation
    scale: np.ndarray
    shown: frozenset[Block] = frozenset()

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the channels that are read."""
        return list_channels(self.model, self.preparation.exclude)

    def compute(self, block: Block, log: Log | None = None) -> BlockRows:
        """Return a block's rows; `log` is the result of `read`, if it was read elsewhere."""
        stretch, preparation = self.stretches[block.stretch], self.preparation
        factor = preparation.factor(stretch.rate_hz)
        log = self.read(block) if log is None else log
        number = {"campaign": np.full(log.n_samples, float(self.numbers[block.stretch]))}
        refuse_jumps(log, self.model.robot, preparation.exclude)
        prepared = prepare_segment(self.at, log, preparation, signals=number, rate_hz=stretch.rate_hz)
        first = self._around(block)[0] // factor
        run = prepared.run(self.model).window(slice(block.start - first, block.stop - first))
        run = replace(run, y=run.y * self.scale, y_all=run.y_all * self.scale)
        used, whole = SufficientStatistics.of(run.W, run.y, run.usable), SufficientStatistics.of(run.W_all, run.y_all)
        return BlockRows(
            RegressionRows(run.t, run.W, run.y, run.usable), used, whole, run if block in self.shown else None
        )

    def read(self, block: Block) -> Log:
        """Return a block's samples and those around it."""
        return self.stretches[block.stretch].window(*self._around(block), self.wanted)

    def _around(self, block: Block) -> tuple[int, int]:
        stretch = self.stretches[block.stretch]
        factor, margin = self.preparation.factor(stretch.rate_hz), compute_overlap(self.preparation, stretch.rate_hz)
        return max(0, block.start * factor - margin), min(stretch.n_samples, (block.stop - 1) * factor + 1 + margin)


def compute_overlap(preparation: Preparation, rate_hz: float) -> int:
    """Return how many samples around a block its rows depend on, a multiple of the decimation."""
    filters = sum(
        compute_edge_samples(f, rate_hz) for f in (preparation.force_cutoff_hz, preparation.position_cutoff_hz)
    )
    gate = (preparation.window_s + 2 / preparation.position_cutoff_hz) * rate_hz
    factor = preparation.factor(rate_hz)
    return factor * int(np.ceil((OVERLAP_FILTER_MEMORIES * filters + gate + 16) / factor))


def split_blocks(
    stretch: EvenSegment | InMemorySegment, number: int, preparation: Preparation, width: int, share: float
) -> list[Block]:
    """Cut a stretch into blocks.

    Args:
        stretch: The stretch that is cut.
        number: Its number.
        preparation: Filters and masks.
        width: Numbers of one sample's columns.
        share: Share of its samples that make section 0; the rest is section 2, except for a gap, section 1, as wide as the
            filters' memory.
    """
    factor = preparation.factor(stretch.rate_hz)
    n = -(-stretch.n_samples // factor)
    size = max(MIN_BLOCK_ROWS, SIZE // width // factor)
    middle = int(share * n)
    gap = int(np.ceil(preparation.rate_hz / preparation.force_cutoff_hz - ROUNDING))
    edges = (0, middle, min(middle + gap, n - 1), n)
    found = []
    for section, (start, stop) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        cuts = np.linspace(start, stop, max(1, -(-(stop - start) // size)) + 1).astype(int)
        found += [Block(number, int(a), int(b), section) for a, b in zip(cuts[:-1], cuts[1:], strict=True) if b > a]
    return found


def list_channels(model: Model, exclude: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the channels that a fit of a model reads."""
    joints = model.robot.actuated
    return (*(f"{s}_{j}" for s in ("q", "tau", "temp") for j in joints), ROOM_TEMPERATURE, *exclude)


def refuse_memory(model: Model) -> None:
    """Refuse effects whose force depends on a longer past than the memory of any filter."""
    for effect in model.effects:
        if isinstance(effect, Bristle | WindingHeat) or {"reversal", "temperature"} & set(effect.needs):
            raise InputError(
                "unsupported",
                f"effect {effect.name} remembers more than a block of a recording holds; give logs that fit in memory "
                "(split the recording, or take the effect out of the model)",
            )


SURVEYED = 2**20
"""Number of samples for the choice of filters and masks; for a longer recording, in windows spread over it."""

SHOWN = 12
"""Blocks of all recordings together that are kept for a page to draw."""

_TIDIED = 16
"""Number of blocks after which freed memory is returned."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class BlockExecutor:
    """Executor of blocks: threads of this process, or a Dask cluster.

    Attributes:
        jobs: Threads, or processes of an embedded cluster.
        cluster: Address of a Dask scheduler; `local` for one on this machine; None for threads.
    """

    jobs: int = 1
    cluster: str | None = None

    def compute(self, work: BlockWork, blocks: Sequence[Block]) -> Iterator[BlockRows]:
        """Yield the blocks' rows in their order."""
        with threadpool_limits(1):
            if self.cluster is None:
                yield from self._here(work, blocks)
            else:
                yield from self._there(work, blocks)

    def _here(self, work: BlockWork, blocks: Sequence[Block]) -> Iterator[BlockRows]:
        own = threading.local()  # a mechanism caches its last closure, so each thread has one

        def compute(block: Block, log: Log) -> BlockRows:
            if not hasattr(own, "work"):
                own.work = copy_with_own_mechanisms(work)
            return own.work.compute(block, log)

        with ThreadPoolExecutor(self.jobs) as pool:
            yield from iterate_in_order(
                lambda block: pool.submit(compute, block, work.read(block)), blocks, self.jobs + 1
            )

    def _there(self, work: BlockWork, blocks: Sequence[Block]) -> Iterator[BlockRows]:
        address = None if self.cluster == "local" else self.cluster

        def prepare(client: Any) -> Callable[[Block], Any]:
            shared = client.submit(_given, work, pure=False)  # computed again if the worker that holds it dies
            return lambda block: client.submit(_compute, shared, block, pure=False)

        yield from run_on_workers(prepare, blocks, cluster=address, jobs=self.jobs, ahead=3)


class StreamedRegressions(NamedTuple):
    """Regressions of all data, of the first and the last part (these without rows), and warnings on pieces without rows."""

    whole: Regression
    first: Regression
    last: Regression
    left_out: tuple[str, ...]


def build_stream_regression(
    model: Model,
    recordings: Sequence[Log | Recording],
    *,
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    at: Model,
    campaigns: Sequence[str],
    factors: Mapping[str, float],
    share: float,
    engine: BlockExecutor,
    progress: Progress,
) -> StreamedRegressions:
    """Build the regression of a model on recordings, and those of their first and last parts.

    Args:
        model: Gives the columns.
        recordings: Recordings on disk and logs in memory; never joined across their ends.
        preparation: Filters and masks; by default chosen from samples all over the recordings.
        exclude: Columns whose nonzero samples are left out.
        at: The model at the values from which signals are computed.
        campaigns: Names of recordings that are numbered before these.
        factors: Factor of an output's measurements, by name.
        share: Share of each stretch that makes the first part.
        engine: Executor that computes the blocks.
        progress: Callback that receives the progress.
    """
    refuse_memory(model)
    refuse_missing(model, [log for log in recordings if isinstance(log, Recording)], exclude)
    pieces = tuple(piece for log in recordings for piece in _pieces(log))
    if not pieces:
        raise InputError("too_little_data", f"{recordings[0].name} has no stretch of 10 samples without a gap")
    if preparation is None:
        wanted, long = list_channels(model, exclude), select_long(pieces)
        surveyed = [log for piece in long for log in piece.survey(wanted, SURVEYED // len(long))]
        preparation = choose_preparation(model.robot, surveyed, exclude)
    kept = keep_long(pieces, preparation.force_cutoff_hz, preparation.factor)
    pieces = tuple(kept.of(pieces))
    names = list(dict.fromkeys([*campaigns, *(piece.name for piece in pieces)]))
    width = model.robot.na * len(model.parameters)
    blocks = [b for k, piece in enumerate(pieces) for b in split_blocks(piece, k, preparation, width, share)]
    chosen = np.unique(np.linspace(0, len(blocks) - 1, SHOWN).astype(int))
    scale = np.array([factors.get(joint, 1.0) for joint in model.robot.actuated])
    numbers = tuple(names.index(piece.name) for piece in pieces)
    work = BlockWork(model, at, pieces, numbers, preparation, scale, frozenset(blocks[i] for i in chosen))
    return StreamedRegressions(
        *_summed(work, blocks, engine, progress), left_out=(*list_crumbs(recordings), *kept.warnings)
    )


def _summed(
    work: BlockWork, blocks: list[Block], engine: BlockExecutor, progress: Progress
) -> tuple[Regression, Regression, Regression]:
    model = work.model
    zero = SufficientStatistics.zero(model.robot.na, len(model.parameters))
    used, whole = [zero] * 3, [zero] * 3
    stored, shown, before = StoredRows(len(model.parameters)), [], -1
    for number, (block, done) in enumerate(zip(blocks, engine.compute(work, blocks), strict=True), start=1):
        if block.stretch != before:
            stored.begin()
            before = block.stretch
        stored.add(done.rows)
        used[block.section] += done.used
        whole[block.section] += done.whole
        if done.run is not None:
            name = f"{done.run.name}, from {done.run.t[0]:.0f} s"
            shown.append(done.run if len(blocks) == 1 else replace(done.run, name=name))
        if number % _TIDIED == 0:
            give_back()
        progress(f"columns: block {number} of {len(blocks)}")

    def regression(sections: Sequence[int], runs: Sequence[RegressionRun], rows) -> Regression:
        totals = [sum((of[s] for s in sections), zero) for of in (used, whole)]
        robot, everything = model.robot, StreamedData(totals[0], totals[1], rows)
        return Regression(
            model.parameters, robot.actuated, robot.force_units, tuple(runs), work.preparation, everything
        )

    return regression((0, 1, 2), shown, stored.runs), regression((0,), (), ()), regression((2,), (), ())


def give_back() -> None:
    """Return freed memory to the system, if the C library supports it (glibc's `malloc_trim`).

    Otherwise it is kept for the next request. With blocks of many sizes on several threads it fragments into pieces that fit no
    request: 12 bytes a sample, 1.9 GiB at 10^8 samples.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):  # no glibc; Windows has no library without a name
        return


def refuse_missing(model: Model, recordings: Sequence[Recording], exclude: tuple[str, ...]) -> None:
    """Refuse recordings that lack a column before any is read."""
    needed = [*(f"{signal}_{joint}" for signal in ("q", "tau") for joint in model.robot.actuated), *exclude]
    for recording in recordings:
        for name in needed:
            if not recording.has(name):
                raise InputError(
                    "missing_column", f"{recording.name} has no column {name}; it has {', '.join(recording.columns)}."
                )


def _pieces(log: Log | Recording) -> Sequence[EvenSegment | InMemorySegment]:
    return (
        split_recording_evenly(log)
        if isinstance(log, Recording)
        else [InMemorySegment(piece) for piece in resample_segments(log)]
    )


@lru_cache(maxsize=8)
def split_recording_evenly(recording: Recording) -> list[EvenSegment]:
    """Return a recording's even stretches; its clock is read once."""
    return split_even_segments(recording)


def copy_with_own_mechanisms(work: BlockWork) -> BlockWork:
    """Return the same work with its own mechanisms."""
    model = replace(work.model)
    return replace(work, model=model, at=model if work.at is work.model else replace(work.at))


def _given(work: BlockWork) -> BlockWork:
    return work


_BUILT: dict[int, tuple[BlockWork, BlockWork]] = {}


def _compute(work: BlockWork, block: Block) -> BlockRows:
    """Compute a block in a worker, which builds mechanisms once for each piece of work that reaches it."""
    if id(work) not in _BUILT:
        _BUILT.clear()
        _BUILT[id(work)] = work, copy_with_own_mechanisms(work)
    with threadpool_limits(1):
        return _BUILT[id(work)][1].compute(block)
