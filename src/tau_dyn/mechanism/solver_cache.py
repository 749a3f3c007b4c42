"""Solvers kept on what they solve, so that they live exactly as long as it does.

A table beside the robots would keep them alive: a solver knows its robot. On the robot itself both go together. A copy or
a robot sent to another process starts without.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
_NAME = "_kinematics_kept"


class _Kept(dict[str, object]):
    """What is kept; copies are empty."""

    def __reduce__(self) -> tuple[type[_Kept], tuple[()]]:
        return _Kept, ()


def get_cached(owner: object, name: str, make: Callable[[], T]) -> T:
    """Return what is kept on a robot or its rods under a name, made at the first call."""
    own = owner.__dict__.setdefault(_NAME, _Kept())
    if name not in own:
        own[name] = make()
    return own[name]
