"""Many items give the same results in the same order, in this process or in others, and when a worker dies."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.scale import run_many

pytestmark = pytest.mark.filterwarnings("ignore")  # Dask's own, at the end of its processes


def draw(seed: int) -> float:
    """Return a number that depends on the seed alone."""
    return float(np.random.default_rng(seed).standard_normal(1000).sum())


def draw_or_die(item: tuple[int, str]) -> float:
    """Kill this worker once, at seed 3, then answer."""
    seed, mark = item
    if seed == 3 and not Path(mark).exists():
        Path(mark).touch()
        os._exit(9)
    return draw(seed)


def test_one_process_needs_no_dask() -> None:
    """With one job nothing leaves the process."""
    assert list(run_many(lambda x: x + 1, [1, 2, 3])) == [2, 3, 4]


def test_processes_give_the_same_and_a_killed_worker_changes_nothing(tmp_path) -> None:
    """What an item gives depends on the item; a dead worker's items are done again, and order is kept."""
    items = [(seed, str(tmp_path / "died")) for seed in range(12)]
    found = list(run_many(draw_or_die, items, jobs=2))
    assert (tmp_path / "died").exists()
    assert found == [draw(seed) for seed in range(12)]


def test_no_scheduler_at_the_address_is_one_sentence() -> None:
    """An address where nobody listens is the caller's mistake, not a traceback."""
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        list(run_many(draw, [1], cluster="not-an-address"))
