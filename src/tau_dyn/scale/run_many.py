"""One function, many items: in this process, on Dask's embedded scheduler, or on a cluster by its address.

Results come in the items' order whatever finishes first, so what is made of them does not depend on how many workers there
were. A worker that dies is replaced and its items are done again: they must depend on nothing but themselves. Dask is an extra,
`pip install 'tau_dyn[scale]'`, and loaded only when asked for.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any, TypeVar

from tau_dyn.exceptions import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 4
"""Items under way for each worker; more would only fill memory with results that wait for their turn."""

_DEATHS = 10
"""Workers that may die over one item before it is taken to be the item's fault."""


def run_many(
    function: Callable[[Item], Result], items: Iterable[Item], *, cluster: str | None = None, jobs: int = 1
) -> Iterator[Result]:
    """Yield `function(item)` for every item, in their order.

    Args:
        function: A function of a module, as it may travel to another process.
        items: What it is called with; each travels too.
        cluster: Address of a Dask scheduler, such as `tcp://10.0.0.1:8786`; None for this machine.
        jobs: Processes on this machine; 1 runs everything here, without Dask.

    Raises:
        InputError: Dask is not installed, or nothing answers at the address.
    """
    if cluster is None and jobs <= 1:
        yield from map(function, items)
        return
    with connected(cluster, jobs) as client:
        ahead = _AHEAD * max(1, sum(client.nthreads().values()))
        yield from in_order(lambda item: client.submit(function, item, pure=False), items, ahead)


def in_order(submit: Callable[[Item], Any], items: Iterable[Item], ahead: int) -> Iterator[Any]:
    """Yield the results of submitted items in their order, with only so many under way; what `submit` returns has `result()`."""
    rest = iter(items)
    waiting = deque(submit(item) for item in islice(rest, ahead))
    while waiting:
        done = waiting.popleft().result()
        waiting.extend(submit(item) for item in islice(rest, 1))
        yield done


@contextmanager
def connected(cluster: str | None, jobs: int) -> Iterator[Any]:
    """Give a Dask client of a cluster, or of as many processes on this machine as there are jobs."""
    try:
        from dask import config  # pyright: ignore[reportPrivateImportUsage]
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("this needs Dask; install it with pip install 'tau_dyn[scale]'") from None
    quiet = {
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.nanny.pre-spawn-environ": {**_ONE_THREAD},
        "distributed.logging.distributed": "error",
    }
    with ExitStack() as stack:
        stack.enter_context(config.set(quiet))
        if cluster is None:
            local = LocalCluster(n_workers=jobs, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50)
            yield stack.enter_context(Client(stack.enter_context(local)))
            return
        try:
            client = Client(cluster, timeout="10s")
        except (OSError, ValueError) as fault:
            raise InputError(
                f"no Dask scheduler answers at {cluster} ({type(fault).__name__}); start one with dask scheduler"
            ) from None
        yield stack.enter_context(client)


_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
