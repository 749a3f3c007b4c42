"""A stretch cut into blocks: every decimated sample in one, sections in order, and rows that do not feel where they were cut."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.effects import EFFECTS
from tau_dyn.identify import Preparation, build_model, prepare_segment, streaming
from tau_dyn.identify.streaming import Block, BlockWork, compute_overlap, list_channels, refuse_memory, split_blocks
from tau_dyn.log import InMemorySegment, Log, compute_edge_samples
from tau_dyn.model import Model

RATE = 1000.0
FILTERS = Preparation(100.0, 40.0, 100.0, np.array([0.01]), 0.02)


def stretch_of(n: int) -> Any:
    return SimpleNamespace(n_samples=n, rate_hz=RATE)


@pytest.mark.parametrize("n", [2600, 2601, 2609, 100_000, 123_457])
@pytest.mark.parametrize("share", [0.7, 0.5])
def test_blocks_hold_every_decimated_sample_once(monkeypatch, n: int, share: float) -> None:
    """In order, none empty or larger than asked; a first part, a gap as wide as the filters' memory, and the rest."""
    monkeypatch.setattr(streaming, "SIZE", 10_000)
    monkeypatch.setattr(streaming, "MIN_BLOCK_ROWS", 50)
    found = split_blocks(stretch_of(n), 3, FILTERS, 4, share)
    places = np.concatenate([np.arange(b.start, b.stop) for b in found])
    total = -(-n // 10)  # decimated by ten: 100 Hz
    assert_array_equal(places, np.arange(total))
    assert all(b.stretch == 3 and 0 < b.stop - b.start <= 250 for b in found)
    sections = np.concatenate([np.full(b.stop - b.start, b.section) for b in found])
    assert np.all(np.diff(sections) >= 0)
    assert np.sum(sections == 0) == int(share * total)
    assert np.sum(sections == 1) == 3  # 100 Hz / 40 Hz, rounded up


def test_a_block_has_rows_enough_however_many_columns_there_are(monkeypatch) -> None:
    """Not mostly neighbourhood: at least so many, though its columns then hold more numbers."""
    monkeypatch.setattr(streaming, "SIZE", 100)
    for b in split_blocks(stretch_of(100_000), 0, FILTERS, 1000, 0.7):
        assert b.section == 1 or streaming.MIN_BLOCK_ROWS / 2 < b.stop - b.start <= streaming.MIN_BLOCK_ROWS


def test_what_is_read_around_a_block_is_what_filters_and_gate_remember() -> None:
    """Eight memories of both filters, the gate and its filter's periods, in whole decimated samples."""
    filters = compute_edge_samples(40.0, RATE) + compute_edge_samples(100.0, RATE)
    least = 8 * filters + (0.02 + 2 / 100.0) * RATE + 16
    assert compute_overlap(FILTERS, RATE) % 10 == 0 and least <= compute_overlap(FILTERS, RATE) < least + 10


@pytest.fixture(scope="module")
def work(axis) -> BlockWork:
    """A drive in two stretches of memory."""
    rng = np.random.default_rng(4)
    t = np.arange(12_000) / RATE
    q = 0.2 * np.sin(2 * t) + 0.05 * np.sin(7 * t)
    log = Log(t, {"q_axis": q + 1e-6 * rng.normal(size=t.size), "tau_axis": 50 * np.cos(2 * t)}, "made.csv")
    model = build_model(axis, "asymmetric")
    pieces = (InMemorySegment(log.window(0, 4000)), InMemorySegment(log.window(4000, 12_000)))
    return BlockWork(model, model, pieces, (0, 0), FILTERS, np.array([1.1]))


@pytest.mark.parametrize(("start", "stop"), [(0, 90), (90, 300), (337, 519), (700, 800)])
def test_a_blocks_rows_are_those_of_the_whole_stretch(work, start: int, stop: int) -> None:
    """Columns, forces times their factor, masks and times, at its ends too; totals and what is shown are of the same rows."""
    block = Block(1, start, stop, 0)
    whole = prepare_segment(work.at, work.stretches[1].log, FILTERS).run(work.model)
    found = work.compute(block)
    part = slice(start, stop)
    assert_allclose(found.rows.t, whole.t[part], rtol=0, atol=1e-12)
    assert_array_equal(found.rows.usable, whole.usable[part])
    scale = np.abs(whole.W).max(axis=(0, 1))
    assert_allclose(found.rows.W / scale, whole.W[part] / scale, atol=1e-9)
    assert_allclose(found.rows.y, 1.1 * whole.y[part], atol=1e-8)
    assert_allclose(found.used.power(), np.sum(np.where(whole.usable, 1.1 * whole.y, 0)[part] ** 2, axis=0), rtol=1e-9)
    assert_allclose(found.whole.power(), np.sum((1.1 * whole.y_all[part]) ** 2, axis=0), rtol=1e-9)
    assert found.run is None
    shown = BlockWork(
        work.model, work.at, work.stretches, work.numbers, FILTERS, work.scale, frozenset({block})
    ).compute(block)
    assert shown.run is not None
    assert_array_equal(shown.run.y, found.rows.y)


def test_the_channels_read_are_those_a_fit_may_want(two_link) -> None:
    """Positions, forces and temperatures of each joint, the room's, and the flags."""
    assert list_channels(Model.of(two_link), ("flag", "bad")) == (
        "q_shoulder", "q_elbow", "tau_shoulder", "tau_elbow", "temp_shoulder", "temp_elbow", "temp_room", "flag", "bad",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "fits"),
    [
        ("stribeck", True),
        ("quadratic_drag", True),
        ("hysteresis", False),
        ("backlash", False),
        ("thermal_drift", False),
    ],
)
def test_effects_with_a_long_memory_cannot_go_in_blocks(two_link, name: str, fits: bool) -> None:
    """What happened at the last reversal, or an hour of warmth ago, is in no block."""
    model = Model.of(two_link, [EFFECTS[name](two_link.actuated, two_link.force_units)])
    if fits:
        refuse_memory(model)
    else:
        with raises_code("unsupported", name):
            refuse_memory(model)
