"""Leaving one process: the same function on many items, here, on this machine's cores or on a cluster, in their order."""

from .journal import run_journaled as run_journaled
from .runner import (
    count_cores as count_cores,
    iterate_in_order as iterate_in_order,
    run_many as run_many,
    run_on_workers as run_on_workers,
)
