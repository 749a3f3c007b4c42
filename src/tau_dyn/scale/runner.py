"""One function, many items: in this process, on Dask's embedded scheduler, or on a cluster by its address.

Results come in the items' order, so the output does not depend on the number of workers. A worker that dies is replaced and its
items are computed again: the result of an item may depend only on the item. While results are awaited, living workers are
counted. An embedded cluster without workers is started again; a cluster that stays without workers is an error after a stated
time. Dask is an extra, `pip install 'tau_dyn[scale]'`, and loaded only when it is needed.
"""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Any, Generic, TypeVar

from tau_dyn.exceptions import InputError, TauDynError

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 4
"""Items under way for each worker; more would only fill memory with results that wait for their turn."""

_DEATHS = 10
"""Workers that may die over one item before it is taken to be the item's fault."""

MAX_STARTS = 3
"""Starts of an embedded cluster: two lost ones may be bad luck of a full machine, a third one is not."""

MAX_TIME_WITHOUT_WORKER_S = 60.0
"""Time without a living worker [s]. A worker takes 2 s to start, on a machine with ten times its load half a minute."""

MAX_START_TIME_S = 120.0
"""Time for one worker to start [s]; twice the above, as all start at once."""

_CLOSING_TIME_S = 30.0
"""Time for an embedded cluster to close [s]; a nanny asks a worker for 4 s and then kills it."""

_LOOK_INTERVAL_S = 1.0
"""Time between two counts of living workers [s]; a count costs 1 ms."""


def run_many(
    function: Callable[[Item], Result], items: Iterable[Item], *, cluster: str | None = None, jobs: int = 1
) -> Iterator[Result]:
    """Yield `function(item)` for every item, in their order.

    Args:
        function: A function of a module, since it may be sent to another process.
        items: Arguments of the function; each may be sent to another process, too.
        cluster: Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`; None for this machine.
        jobs: Processes on this machine; 1 runs everything here, without Dask.

    Raises:
        InputError: Dask is not installed, or no scheduler answers at the address.
        TauDynError: No worker is left, or an item ends each worker that takes it.
    """
    if cluster is None and jobs <= 1:
        yield from map(function, items)
        return

    def prepare(client: Any) -> Callable[[Item], Any]:
        return lambda item: client.submit(function, item, pure=False)

    yield from run_on_workers(prepare, items, cluster=cluster, jobs=jobs, ahead=_AHEAD)


def iterate_in_order(submit: Callable[[Item], Any], items: Iterable[Item], ahead: int) -> Iterator[Any]:
    """Yield the results of submitted items in their order, with only so many under way; what `submit` returns has `result()`."""
    rest = iter(items)
    waiting = deque(submit(item) for item in islice(rest, ahead))
    while waiting:
        done = waiting.popleft().result()
        waiting.extend(submit(item) for item in islice(rest, 1))
        yield done


def run_on_workers(
    prepare: Callable[[Any], Callable[[Item], Any]],
    items: Iterable[Item],
    *,
    cluster: str | None,
    jobs: int,
    ahead: int,
) -> Iterator[Any]:
    """Yield results of items in their order from Dask workers; restart an embedded cluster that has lost all workers.

    Args:
        prepare: Takes a client and returns the function that submits an item to it.
        items: Items to submit; those under way when the last worker dies are submitted again.
        cluster: Address of a Dask scheduler; None for an embedded cluster.
        jobs: Processes of an embedded cluster.
        ahead: Items under way for each worker.

    Raises:
        InputError: As `connect_client`.
        TauDynError: No worker is left, or an item ends each worker that takes it.
    """
    queue = _Queue(iter(items))
    for start in range(1, MAX_STARTS + 1):
        try:
            with _started(cluster, jobs) as client:
                threads = max(1, sum(client.nthreads().values()))
                yield from queue.take(prepare(client), client, ahead * threads)
                return
        except _WorkersLost as fault:
            if cluster is not None or start == MAX_STARTS:
                raise TauDynError("workers_lost", f"{fault}; {_remedy(cluster)}") from fault
        queue.put_back()


class _WorkersLost(Exception):
    """A cluster cannot go on."""


def _remedy(cluster: str | None) -> str:
    if cluster is not None:
        return f"start one with dask worker {cluster}"
    return f"the processes were started {MAX_STARTS} times; free memory or ask for fewer jobs"


@contextmanager
def _started(cluster: str | None, jobs: int) -> Iterator[Any]:
    """Give a client as `connect_client`; an embedded cluster that does not start has lost its workers."""
    with ExitStack() as stack:
        try:
            client = stack.enter_context(connect_client(cluster, jobs))
        except (OSError, RuntimeError) as fault:
            raise _WorkersLost(f"no worker process starts ({type(fault).__name__})") from fault
        yield client


@dataclass
class _Queue(Generic[Item]):
    """Items in their order: those under way, and the rest."""

    rest: Iterator[Item]
    waiting: deque[tuple[Item, Any]] = field(default_factory=deque)

    def take(self, submit: Callable[[Item], Any], client: Any, ahead: int) -> Iterator[Any]:
        """Yield the results of all items."""
        self.waiting.extend((item, submit(item)) for item in islice(self.rest, ahead))
        while self.waiting:
            done = _await_result(self.waiting[0][1], client)
            self.waiting.popleft()
            self.waiting.extend((item, submit(item)) for item in islice(self.rest, 1))
            yield done

    def put_back(self) -> None:
        """Return items under way to the items that have not begun."""
        self.rest = chain([item for item, _ in self.waiting], self.rest)
        self.waiting = deque()


def _await_result(future: Any, client: Any) -> Any:
    """Return a future's result; give up when no worker has been alive for the time allowed."""
    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    alive = time.monotonic()
    while True:
        try:
            return future.result(timeout=_LOOK_INTERVAL_S)
        except KilledWorker as fault:
            raise TauDynError(
                "workers_lost", f"an item ended each of the {_DEATHS + 1} processes that took it; run it alone"
            ) from fault
        except FutureCancelledError as fault:
            raise _WorkersLost("the scheduler is gone") from fault
        except TimeoutError:
            if future.done():  # in the last moment, or the item's own exception
                return future.result()
        if _count_workers(client):
            alive = time.monotonic()
        elif time.monotonic() - alive > MAX_TIME_WITHOUT_WORKER_S:
            raise _WorkersLost(f"no worker process has been alive for {MAX_TIME_WITHOUT_WORKER_S:.0f} s")


def _count_workers(client: Any) -> int:
    """Return how many workers the scheduler knows; zero if it does not answer."""
    try:
        return len(client.sync(client.scheduler.ncores, callback_timeout=MAX_TIME_WITHOUT_WORKER_S))
    except (OSError, TimeoutError):
        return 0


@contextmanager
def connect_client(cluster: str | None, jobs: int) -> Iterator[Any]:
    """Give a Dask client of a cluster, or of as many processes on this machine as there are jobs."""
    try:
        from dask import config  # pyright: ignore[reportPrivateImportUsage]
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("missing_package", "this needs Dask; install it with pip install 'tau_dyn[scale]'") from None
    quiet = {
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.nanny.pre-spawn-environ": {**_ONE_THREAD},
        "distributed.logging.distributed": "error",
        # Dask drops a worker for good that is not back after 15 s, which a loaded machine needs to start one.
        "distributed.deploy.lost-worker-timeout": f"{10 * MAX_START_TIME_S:.0f}s",
    }
    with ExitStack() as stack:
        stack.enter_context(config.set(quiet))
        if cluster is None:
            local = LocalCluster(
                n_workers=jobs,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
                death_timeout=MAX_START_TIME_S,
            )
            stack.callback(_close, local)
            yield stack.enter_context(Client(local))
            return
        try:
            client = Client(cluster, timeout="10s")
        except (OSError, ValueError) as fault:
            raise InputError(
                "not_available",
                f"no Dask scheduler answers at {cluster} ({type(fault).__name__}); start one with dask scheduler",
            ) from None
        yield stack.enter_context(client)


def _close(local: Any) -> None:
    """Close an embedded cluster; one whose nannies are gone raises or waits, and its processes end with this one."""
    with suppress(OSError, AssertionError, RuntimeError):
        local.close(timeout=_CLOSING_TIME_S)


_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def count_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
