"""Many items give the same results in the same order, in this process or in others, and when a worker dies."""

from __future__ import annotations

import importlib
import os
import time
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.scale import iterate_in_order, run_many

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


def die(item: int) -> None:
    """Kill this worker."""
    os._exit(9)


def raise_timeout(item: int) -> None:
    """Fail as a function may that asks a device."""
    raise TimeoutError(f"device {item} is silent")


@pytest.fixture
def settings(monkeypatch):
    """The module that counts workers, with times for a test."""
    pytest.importorskip("distributed")
    module = importlib.import_module("tau_dyn.scale.runner")
    monkeypatch.setattr(module, "MAX_TIME_WITHOUT_WORKER_S", 2.0)
    monkeypatch.setattr(module, "_LOOK_INTERVAL_S", 0.2)
    return module


@pytest.fixture
def careless(monkeypatch) -> list[int]:
    """A nanny that does nothing when its worker dies; the list counts the deaths."""
    from distributed import Nanny

    deaths: list[int] = []

    async def look_away(self, exitcode: int) -> None:
        deaths.append(exitcode)

    monkeypatch.setattr(Nanny, "_on_worker_exit", look_away)
    return deaths


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
    with raises_code("not_available"):
        list(run_many(draw, [1], cluster="not-an-address"))


def test_an_item_may_fail_with_a_timeout_of_its_own(settings) -> None:
    """The exception of an item is the caller's to see, also where it has the name of the watch's own."""
    with pytest.raises(TimeoutError, match="device 1 is silent"):
        list(run_many(raise_timeout, [1, 2], jobs=2))


def test_workers_that_nobody_replaces_are_started_again(tmp_path, settings, careless) -> None:
    """The only worker dies and its nanny lets it lie: a second cluster does the rest, and order is kept."""
    items = [(seed, str(tmp_path / "died")) for seed in range(6)]
    found = list(settings.run_on_workers(_submit(draw_or_die), items, cluster=None, jobs=1, ahead=4))
    assert 9 in careless and found == [draw(seed) for seed in range(6)]


def test_without_a_living_worker_it_ends_after_the_stated_time(settings, careless) -> None:
    """Workers and nannies are gone each time: after three starts one sentence, which is exit status 1."""
    began = time.monotonic()
    with raises_code("workers_lost", "2") as fault:
        list(run_many(die, range(4), jobs=2))
    assert fault.value.exit_status == 1 and "started 3 times" in str(fault.value)
    assert time.monotonic() - began < 90, "three starts, three times 2 s, and three closings"


def test_workers_that_do_not_start_end_it(settings, monkeypatch) -> None:
    """A worker that dies while it starts is tried again, and then said; a full machine does this."""
    from distributed import Nanny

    async def fail(self) -> None:
        raise RuntimeError("Nanny failed to start worker process")

    monkeypatch.setattr(Nanny, "instantiate", fail)
    with raises_code("workers_lost"):
        list(run_many(draw, range(4), jobs=2))


def test_an_item_that_ends_each_of_its_workers_is_named_as_such(settings, monkeypatch) -> None:
    """Workers are replaced, but not for ever: the item is at fault."""
    monkeypatch.setattr(settings, "_DEATHS", 1)
    monkeypatch.setattr(settings, "MAX_TIME_WITHOUT_WORKER_S", 60.0)
    with raises_code("workers_lost", "2"):
        list(run_many(die, [1], jobs=2))


def test_a_cluster_elsewhere_without_workers_is_said(settings) -> None:
    """A scheduler answers and no worker has come: the sentence names the command that starts one."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", silence_logs=50) as cluster:
        with raises_code("workers_lost", f"{cluster.scheduler_address}"):
            list(run_many(draw, [1], cluster=cluster.scheduler_address))


def _submit(function):
    return lambda client: lambda item: client.submit(function, item, pure=False)


def test_results_keep_the_order_of_their_items():
    """With three under way at once and the last to be sent done first, results come as their items were given."""
    running: list[Promise] = []

    class Promise:
        def __init__(self, item: int) -> None:
            self.item = item
            running.append(self)

        def result(self) -> int:
            running.remove(self)
            return 10 * self.item

    made = iterate_in_order(Promise, range(7), 3)
    assert next(made) == 0 and len(running) == 3
    assert list(made) == [10, 20, 30, 40, 50, 60]
