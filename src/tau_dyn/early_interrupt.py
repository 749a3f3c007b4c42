"""Ctrl-C while the command `tau-dyn` loads its own modules: one line and status 130; `cli.ending` takes over after them."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

INTERRUPTED = "interrupted; every output file is as it was, or complete"


def leave_at_interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """End the program at once: an exception would be wrapped or lost by the import that it interrupts."""
    with suppress(OSError):
        os.write(2, f"{INTERRUPTED}\n".encode())
    os._exit(128 + number)


def is_ours_or_default() -> bool:
    """Return whether Ctrl-C has Python's own handler or that of this module."""
    return signal.getsignal(signal.SIGINT) in (signal.default_int_handler, leave_at_interrupt)


def is_command() -> bool:
    """Return whether this process runs the script `tau-dyn`; a program that imports the library keeps its handlers."""
    name = os.path.basename((getattr(sys, "argv", None) or [""])[0])
    return name.removesuffix(".exe").removesuffix("-script.pyw").removesuffix("-script.py") == "tau-dyn"


if is_command() and is_ours_or_default():
    with suppress(ValueError):  # outside the main thread
        signal.signal(signal.SIGINT, leave_at_interrupt)
