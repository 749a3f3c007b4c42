"""How a run ends that is told to end, or whose machine fails it: one line, no traceback, no piece of a file.

SIGTERM and SIGHUP unwind like Ctrl-C, so that temporary files go away (a batch system's time limit sends SIGTERM). SIGKILL
cannot be answered; what it leaves is removed by the next run that writes to the same place (`files.sweep`).

An exception raised by a signal may be lost or changed on its way: an import wraps it (`__set_name__` in CPython 3.11) or prints
it (extensions that load NumPy), a destructor swallows it. So a signal waits while something is imported, and comes again where it
was swallowed.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType
from typing import Any

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


_AGAIN_S = 0.05
"""After how long a signal is sent again that came at a bad time."""

_PATIENCE_S = 30.0
"""For how long a signal waits for imports, longer than any of ours takes."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; where a `KeyboardInterrupt` itself left an `exec` of text, `python -m` ends by the signal, though it was caught."""


class Ended(SystemExit):
    """A signal asked this process to end; its status is 128 and the signal's number, as shells count."""

    def __init__(self, number: int) -> None:
        """Say which signal."""
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


class _Listener:
    """Turns signals into exceptions, where these can travel."""

    def __init__(self) -> None:
        """Nothing was heard yet."""
        self._first: float | None = None
        self._again: threading.Timer | None = None

    def heard(self, number: int, frame: FrameType | None) -> None:
        """Raise, or wait for an import to end."""
        self._first = self._first or time.monotonic()
        if _importing(frame) and time.monotonic() - self._first < _PATIENCE_S:
            self._later(number)
            return
        self._first = None
        raise Interrupted if number == signal.SIGINT else Ended(number)

    def lost(self, what: Any) -> None:
        """Send a signal again whose exception nobody could pass on; show any other as before (`sys.unraisablehook`)."""
        if isinstance(what.exc_value, Interrupted):
            self._later(signal.SIGINT)
        elif isinstance(what.exc_value, Ended):
            self._later(int(what.exc_value.code or 0) - 128)
        else:
            sys.__unraisablehook__(what)

    def over(self) -> None:
        """Send nothing any more."""
        if self._again is not None:
            self._again.cancel()

    def _later(self, number: int) -> None:
        self.over()
        self._again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
        self._again.daemon = True
        self._again.start()


@contextmanager
def unwind_on_signal() -> Iterator[None]:
    """Let Ctrl-C or a request to end unwind the block; what somebody else handles or ignores (nohup) stays theirs."""
    usual = {signal.SIGINT: signal.default_int_handler, **dict.fromkeys(ASKED, signal.SIG_DFL)}
    mine = [number for number in usual if signal.getsignal(number) is usual[number]] if _in_main_thread() else []
    listener, hook = _Listener(), sys.unraisablehook
    for number in mine:
        signal.signal(number, listener.heard)
    if hook is sys.__unraisablehook__:
        sys.unraisablehook = listener.lost
    try:
        yield
    finally:
        listener.over()
        sys.unraisablehook = hook
        for number in mine:
            signal.signal(number, usual[number])


def describe_machine_fault(fault: OSError | MemoryError) -> str | None:
    """Return the sentence about what the machine lacks; None where that is not it."""
    if isinstance(fault, MemoryError):
        return "out of memory; give a shorter log or an excerpt, or a machine with more"
    if fault.errno not in _MACHINE:
        return None
    where = f"{fault.filename}: " if fault.filename else ""
    return f"{where}{fault.strerror}; {_MACHINE[fault.errno]}"


def say(sentence: str) -> None:
    """Write a line to stderr where that takes one; the exit status speaks for itself."""
    with suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()


MIN_COLUMNS = 20
"""Width of a terminal below which text cannot be wrapped; a program that runs ours may set zero."""


def ignore_narrow_terminal() -> None:
    """Remove a terminal width from the environment that is too small to wrap text."""
    columns = os.environ.get("COLUMNS", "")
    if columns.isascii() and columns.isdigit() and int(columns[:6]) < MIN_COLUMNS:
        del os.environ["COLUMNS"]


def replace_unencodable() -> None:
    """Let a screen of another coding show `?` for what it cannot, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


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


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


quiet_start = QuietStart()
