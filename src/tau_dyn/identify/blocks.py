r"""A stretch of a recording cut into blocks whose rows are those of the whole: each is prepared with its neighbourhood.

Filters forget exponentially. A block is read with so many samples more on both sides that what is left of its cut ends is below
rounding, goes through the same preparation as a whole log, and gives up the rows of its neighbourhood. So blocks need nothing
of each other: they run side by side and in any process, and where they are cut changes no row by more than rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.effects import Hysteresis
from tau_dyn.estimate import RegressionRows, RegressionRun, SufficientStatistics
from tau_dyn.exceptions import InputError
from tau_dyn.identify.preparation import ROUNDING, Preparation
from tau_dyn.identify.regression import prepare_segment
from tau_dyn.log import ROOM_TEMPERATURE, EvenSegment, InMemorySegment, Log, compute_edge_samples
from tau_dyn.model import Model

SIZE = 2**22
"""Numbers in a block's columns."""

MIN_BLOCK_ROWS = 256
"""Decimated rows that a block has at least, so that it is not mostly neighbourhood."""

OVERLAP_FILTER_MEMORIES = 8
"""Filter memories (to 1 % of a transient) read beyond a block: 1e-16 of a cut end is left."""


class Block(NamedTuple):
    """Which part of which stretch: decimated samples `start` to `stop - 1`, and the section they count for."""

    stretch: int
    start: int
    stop: int
    section: int


class BlockRows(NamedTuple):
    """A block's rows and their totals.

    Attributes:
        rows: What the covariance needs.
        used: Totals of the rows a fit may use.
        whole: Totals of all rows.
        run: Everything, where it was asked for.
    """

    rows: RegressionRows
    used: SufficientStatistics
    whole: SufficientStatistics
    run: RegressionRun | None


@dataclass(frozen=True, eq=False)
class BlockWork:
    """What all blocks share; it travels to other processes.

    Attributes:
        model: Gives the columns.
        at: Gives the signals that follow from values.
        stretches: What is cut.
        numbers: The number of the recording that each stretch is from.
        preparation: Filters and masks.
        scale: Factor of each output.
        shown: Blocks of which everything is wanted.
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
        """Return a block's rows; `log` is what `read` gives, where somebody else has read it."""
        stretch, preparation = self.stretches[block.stretch], self.preparation
        factor = preparation.factor(stretch.rate_hz)
        log = self.read(block) if log is None else log
        number = {"campaign": np.full(log.n_samples, float(self.numbers[block.stretch]))}
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
        stretch: What is cut.
        number: Its number.
        preparation: Filters and masks.
        width: Numbers of one sample's columns.
        share: Share of its samples that make section 0; the rest is section 2, but for a gap, section 1, as wide as the filters'
            memory.
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
    """Refuse effects whose force depends on what happened longer ago than any filter remembers."""
    for effect in model.effects:
        if isinstance(effect, Hysteresis) or {"reversal", "temperature"} & set(effect.needs):
            raise InputError(
                "unsupported",
                f"effect {effect.name} remembers more than a block of a recording holds; give logs that fit in memory "
                "(split the recording, or take the effect out of the model)",
            )
