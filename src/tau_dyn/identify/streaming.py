"""The regression of recordings larger than memory: blocks computed side by side, summed up in their order, and forgotten.

What stays is the outputs' triangular factors, the decimated rows in a temporary file (for the covariance, which needs the
residuals in order), and some blocks in full, for a page to draw. The sum is taken block by block in order, whoever computed
them, so one thread, many, or a cluster give the same bits.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tau_dyn.estimate import Regression, RegressionRun, StoredRows, StreamedData, SufficientStatistics
from tau_dyn.exceptions import InputError
from tau_dyn.identify.blocks import Block, BlockRows, BlockWork, list_channels, refuse_memory, split_blocks
from tau_dyn.identify.freed_memory import give_back
from tau_dyn.identify.preparation import Preparation, choose_preparation
from tau_dyn.identify.short_pieces import choose_from_long, keep_long, list_crumbs
from tau_dyn.log import EvenSegment, InMemorySegment, Log, Recording, resample_segments, split_even_segments
from tau_dyn.model import Model
from tau_dyn.scale import iterate_in_order, run_on_workers

SURVEYED = 2**20
"""Samples from which filters and masks are chosen; of a longer recording, windows spread over it."""

SHOWN = 12
"""Blocks of all recordings together that are kept for a page to draw."""

_TIDIED = 16
"""Blocks after which freed memory is handed back."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class BlockExecutor:
    """Who computes blocks: threads of this process, or a Dask cluster.

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
        own = threading.local()  # a mechanism remembers its last closure, so each thread has one

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
            shared = client.submit(_given, work, pure=False)  # made again where the worker that holds it dies
            return lambda block: client.submit(_compute, shared, block, pure=False)

        yield from run_on_workers(prepare, blocks, cluster=address, jobs=self.jobs, ahead=3)


def sample_recordings(
    pieces: Sequence[EvenSegment | InMemorySegment], model: Model, exclude: tuple[str, ...]
) -> list[Log]:
    """Return what filters and masks are chosen from."""
    return [log for piece in pieces for log in piece.survey(list_channels(model, exclude), SURVEYED // len(pieces))]


def build_stream_regression(
    model: Model,
    recordings: Sequence[Log | Recording],
    *,
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    at: Model,
    campaigns: Sequence[str],
    factors: dict[str, float],
    share: float,
    engine: BlockExecutor,
    progress: Progress,
) -> tuple[Regression, Regression, Regression]:
    """Build the regression of a model on recordings, and those of their first and last parts.

    Args:
        model: Gives the columns.
        recordings: Recordings on disk, or logs beside them; never joined across their ends.
        preparation: Filters and masks; by default chosen from samples all over the recordings.
        exclude: Columns whose nonzero samples are left out.
        at: The model at the values from which signals are computed.
        campaigns: Names of recordings that are numbered before these.
        factors: Factor of an output's measurements, by name.
        share: Share of each stretch that makes the first part.
        engine: Who computes.
        progress: Told how far it is.

    Returns:
        The regressions of all data, of the first part, and of the last; the parts without rows, for errors only.
    """
    refuse_memory(model)
    refuse_missing(model, [log for log in recordings if isinstance(log, Recording)], exclude)
    pieces = tuple(piece for log in recordings for piece in _pieces(log))
    if not pieces:
        raise InputError("too_little_data", f"{recordings[0].name} has no stretch of 10 samples without a gap")
    preparation = preparation or choose_from_long(
        pieces, lambda long: choose_preparation(model.robot, sample_recordings(long, model, exclude), exclude)
    )
    kept = keep_long(pieces, preparation.force_cutoff_hz, preparation.factor)
    pieces = tuple(kept.of(pieces))
    names = list(dict.fromkeys([*campaigns, *(piece.name for piece in pieces)]))
    width = model.robot.na * len(model.parameters)
    blocks = [b for k, piece in enumerate(pieces) for b in split_blocks(piece, k, preparation, width, share)]
    chosen = np.unique(np.linspace(0, len(blocks) - 1, SHOWN).astype(int))
    scale = np.array([factors.get(joint, 1.0) for joint in model.robot.actuated])
    work = BlockWork(model, at, pieces, tuple(names.index(p.name) for p in pieces), preparation, scale,
                frozenset(blocks[i] for i in chosen))  # fmt: skip
    whole, first, last = _summed(work, blocks, engine, progress)
    settings = {**whole.settings, "left_out": (*list_crumbs(recordings), *kept.warnings)}
    return replace(whole, settings=settings), first, last


def _summed(
    work: BlockWork, blocks: list[Block], engine: BlockExecutor, progress: Progress
) -> tuple[Regression, Regression, Regression]:
    model = work.model
    zero = SufficientStatistics.zero(model.robot.na, len(model.parameters))
    used, whole = [zero] * 3, [zero] * 3
    stored, shown, before, began = StoredRows(len(model.parameters)), [], -1, time.monotonic()
    for number, (block, done) in enumerate(zip(blocks, engine.compute(work, blocks), strict=True), start=1):
        if block.stretch != before:
            stored.begin()
            before = block.stretch
        stored.add(done.rows)
        used[block.section] += done.used
        whole[block.section] += done.whole
        if done.run is not None:
            shown.append(_named(done.run, len(blocks)))
        if number % _TIDIED == 0:
            give_back()
        left = (time.monotonic() - began) * (len(blocks) / number - 1)
        progress(f"columns: block {number} of {len(blocks)}, {left:.0f} s left")

    def regression(sections: Sequence[int], runs: Sequence[RegressionRun], rows) -> Regression:
        totals = [sum((of[s] for s in sections), zero) for of in (used, whole)]
        settings = {"preparation": work.preparation}
        everything = StreamedData(totals[0], totals[1], rows)
        return Regression(
            model.parameters, model.robot.actuated, model.robot.force_units, tuple(runs), settings, everything
        )

    return regression((0, 1, 2), shown, stored.runs), regression((0,), (), ()), regression((2,), (), ())


def _named(run: RegressionRun, n_blocks: int) -> RegressionRun:
    return run if n_blocks == 1 else replace(run, name=f"{run.name}, from {run.t[0]:.0f} s")


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
    """Return the same work with mechanisms of its own."""
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
