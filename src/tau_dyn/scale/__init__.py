"""Leaving one process: the same function on many items, here, on this machine's cores or on a cluster, in their order."""

from tau_dyn.scale.journal import run_journaled
from tau_dyn.scale.run_many import run_many

__all__ = ["run_journaled", "run_many"]
