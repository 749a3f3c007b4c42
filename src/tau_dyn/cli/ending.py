"""How a run ends that is told to end, or whose machine fails it: one line, no traceback, no piece of a file.

SIGTERM and SIGHUP unwind like Ctrl-C, so that temporary files go away (a batch system's time limit sends SIGTERM). SIGKILL
cannot be answered; what it leaves is removed by the next run that writes to the same place (`files.sweep`).
"""

from __future__ import annotations

import errno
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

ASKED = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))

_MACHINE = {
    errno.ENOSPC: "free some space",
    errno.EDQUOT: "free some of your quota",
    errno.EFBIG: "a limit of this shell (ulimit -f) allows no larger file",
    errno.EIO: "a disk reports a fault",
    errno.EROFS: "it cannot be written to",
    errno.EACCES: "you may not do that there",
    errno.EPERM: "you may not do that there",
    errno.EMFILE: "close other programs, or raise ulimit -n",
    errno.ENFILE: "close other programs",
    errno.ENOMEM: "free some memory",
    errno.ENAMETOOLONG: "give it a shorter name",
}
"""What a machine may lack, and what helps; no defect of ours."""


class Ended(SystemExit):
    """A signal asked this process to end; its status is 128 and the signal's number, as shells count."""

    def __init__(self, number: int) -> None:
        """Say which signal."""
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


def _end(number: int, _frame: FrameType | None) -> NoReturn:
    raise Ended(number)


@contextmanager
def unwinding() -> Iterator[None]:
    """Let a request to end unwind the block; what somebody else handles or ignores (nohup) stays theirs."""
    mine = [s for s in ASKED if signal.getsignal(s) is signal.SIG_DFL] if _in_main_thread() else []
    for number in mine:
        signal.signal(number, _end)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, signal.SIG_DFL)


def machine_fault(fault: OSError | MemoryError) -> str | None:
    """Return the sentence about what the machine lacks; None where that is not it."""
    if isinstance(fault, MemoryError):
        return "out of memory; give a shorter log or an excerpt, or a machine with more"
    if fault.errno not in _MACHINE:
        return None
    where = f"{fault.filename}: " if fault.filename else ""
    return f"{where}{fault.strerror}; {_MACHINE[fault.errno]}"


class QuietStart:
    """While the program loads, Ctrl-C ends it without a word: nothing has begun, and a traceback would tell nobody anything."""

    def __init__(self) -> None:
        """Begin."""
        self._before: Any = None
        if _in_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._before = signal.signal(signal.SIGINT, signal.SIG_DFL)

    def over(self) -> None:
        """Return to Python's own answer to Ctrl-C."""
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


quiet_start = QuietStart()
