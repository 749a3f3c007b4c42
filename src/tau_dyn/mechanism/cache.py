"""Solvers kept beside the robots that they solve: the last robots of each thread, by identity.

A robot is frozen and stays so; a copy, or one sent to another process, starts without solvers. Threads share none, since
some solvers remember where they were.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

T = TypeVar("T")
_MAX_ROBOTS = 16  # robots whose solvers are kept; the one that was not asked for longest goes first


class _Shelves(threading.local):
    """A thread's shelves, one a robot."""

    def __init__(self) -> None:
        self.of = lru_cache(maxsize=_MAX_ROBOTS)(_make_shelf)


def _make_shelf(owner: object) -> dict[str, object]:
    """Return an empty shelf."""
    return {}


_SHELVES = _Shelves()


def get_cached(owner: object, name: str, make: Callable[[], T]) -> T:
    """Return what is kept for a robot under a name, made at the first call."""
    shelf = _SHELVES.of(owner)
    if name not in shelf:
        shelf[name] = make()
    return shelf[name]  # type: ignore[return-value]
