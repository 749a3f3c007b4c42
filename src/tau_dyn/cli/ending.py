"""End of a run after a signal or a fault of the machine: one line, no traceback, no partial file.

SIGTERM and SIGHUP unwind like Ctrl-C, so that temporary files are removed (a batch system's time limit sends SIGTERM). SIGKILL
cannot be handled; the next run that writes to the same place removes its remains (`files.sweep`).

An exception raised by a signal may be lost or changed on its way: an import wraps it (`__set_name__` in CPython 3.11) or prints
it (extensions that load NumPy), a destructor swallows it. Therefore a signal waits during an import, and is sent again if its
exception was lost.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from types import FrameType, TracebackType
from typing import Any

from tau_dyn.early_interrupt import INTERRUPTED as INTERRUPTED, is_ours_or_default, leave_at_interrupt
from tau_dyn.exceptions import InputError

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
"""Resources that a machine may lack, and the remedy; these are no defects of the program."""

_NO_MEMORY = ("failed to map segment", "annot allocate memory", "can't start new thread")
"""Words of errors that the system's loader and Python raise under a limit of memory (`ulimit -v`)."""

_AGAIN_S = 0.05
"""Delay before a lost signal is sent again [s]."""

_PATIENCE_S = 30.0
"""Longest wait of a signal for imports [s], longer than any import of this package takes."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C; a `KeyboardInterrupt` that leaves an `exec` of text ends `python -m` by the signal although it was caught."""


class Ended(SystemExit):
    """A signal asked this process to end; the exit status is 128 plus the signal's number, as in shells."""

    def __init__(self, number: int) -> None:
        """Store the exit status of the signal."""
        super().__init__(128 + number)
        self.name = signal.Signals(number).name


class _Listener:
    """Turns signals into exceptions at times when these are not lost."""

    def __init__(self) -> None:
        """Start without a pending signal."""
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
        """Send a signal again if its exception was lost; show any other exception as usual (`sys.unraisablehook`)."""
        if isinstance(what.exc_value, Interrupted):
            self._later(signal.SIGINT)
        elif isinstance(what.exc_value, Ended):
            self._later(int(what.exc_value.code or 0) - 128)
        else:
            sys.__unraisablehook__(what)

    def over(self) -> None:
        """Stop sending signals again."""
        if self._again is not None:
            self._again.cancel()

    def _later(self, number: int) -> None:
        self.over()
        self._again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
        self._again.daemon = True
        self._again.start()


@contextmanager
def unwind_on_signal() -> Iterator[None]:
    """Let Ctrl-C or a request to end unwind the block; signals that are already handled or ignored (nohup) are not changed."""
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


def describe_machine_fault(fault: BaseException) -> str | None:
    """Return a sentence about the resource that the machine lacks, or None for other faults."""
    if isinstance(fault, MemoryError):
        return "out of memory; give a shorter log or an excerpt, or a machine with more"
    if isinstance(fault, ImportError | RuntimeError) and any(words in str(fault) for words in _NO_MEMORY):
        return "out of memory while a library was loaded; raise the limit (ulimit -v), or free some memory"
    if not isinstance(fault, OSError) or fault.errno not in _MACHINE:
        return None
    where = f"{fault.filename}: " if fault.filename else ""
    return f"{where}{fault.strerror}; {_MACHINE[fault.errno]}"


MIN_ADDRESS_SPACE = 7e8
"""[bytes] `identify` of a small log ends well at this limit of address space, and not at 6e8 (measured on Linux)."""


def require_address_space() -> None:
    """Refuse a limit of address space (`ulimit -v`) below the libraries' size: their loaders abort without a Python error.

    Raises:
        InputError: The limit is below `MIN_ADDRESS_SPACE`.
    """
    with suppress(ImportError):  # Windows has no such limit
        import resource

        allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
        if 0 <= allowed < MIN_ADDRESS_SPACE:
            raise InputError(
                "not_available",
                f"out of memory: this shell allows {allowed / 1e6:.0f} MB and the libraries of a command take "
                f"{MIN_ADDRESS_SPACE / 1e6:.0f} MB; raise the limit (ulimit -v)",
            )


def say(sentence: str) -> None:
    """Write a line to stderr if possible; a failure is ignored, since the exit status is set in any case."""
    with suppress(OSError, ValueError, AttributeError):
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()


MIN_COLUMNS = 20
"""Smallest width of a terminal at which text can be wrapped; a calling program may set zero."""


def ignore_odd_environment() -> None:
    """Remove settings of the environment under which libraries fail.

    These are a terminal's width that is too small to wrap text, and PYTHONWARNINGS, whose `error` makes a fault of each warning
    in a library and in the processes that a command starts.
    """
    columns = os.environ.get("COLUMNS", "")
    if columns.isascii() and columns.isdigit() and int(columns[:6]) < MIN_COLUMNS:
        del os.environ["COLUMNS"]
    os.environ.pop("PYTHONWARNINGS", None)


def replace_unencodable() -> None:
    """Show `?` for characters that the terminal's encoding lacks, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


class QuietStart:
    """Ends the program in one line while it loads, at Ctrl-C and where memory is short, and hides warnings of libraries."""

    def __init__(self) -> None:
        """Begin."""
        self._hidden = warnings.catch_warnings(action="ignore")
        self._hidden.__enter__()
        self._hook, sys.excepthook = sys.excepthook, self._end
        self._is_ours = _in_main_thread() and is_ours_or_default()
        if self._is_ours:
            signal.signal(signal.SIGINT, leave_at_interrupt)

    def over(self) -> None:
        """Restore Python's own handler of Ctrl-C, its filters of warnings and its display of errors."""
        if self._is_ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.excepthook = self._hook
        self._hidden.__exit__(None, None, None)

    def _end(self, kind: type[BaseException], fault: BaseException, trace: TracebackType | None) -> None:
        """Show an error that ends the program while it loads (`sys.excepthook`)."""
        if (sentence := describe_machine_fault(fault)) is None:
            self._hook(kind, fault, trace)
            return
        say(f"error: {sentence}")
        raise SystemExit(2)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


quiet_start = QuietStart()
