"""Memory that blocks of a long recording have used goes back to the system.

The C library keeps what was freed for the next request. Where blocks of many sizes come and go on several threads, it is kept
in ever more pieces that fit nothing: 12 bytes a sample, 1.9 GiB at 10^8 samples. glibc hands them back when it is told to.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache


def give_back() -> None:
    """Hand freed memory back, where the C library knows how (glibc's `malloc_trim`); elsewhere nothing happens."""
    trim = _trim()
    if trim is not None:
        trim(0)


@lru_cache(maxsize=1)
def _trim():
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError, TypeError):  # no glibc; Windows has no library without a name
        return None
