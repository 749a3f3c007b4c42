"""Progress of a command: a line on a terminal with the time left, and log messages with `--verbose`.

A step's text states its progress as `3 of 20` or `45 %`, followed by the part that changes: `trying 3 of 20: backlash`.
"""

from __future__ import annotations

import logging
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.text import Text

LOGGER = logging.getLogger("tau_dyn")
"""The library's logger, shown with `--verbose`; a program that imports the library may show it as well."""
MIN_SHOWN_S = 2.0
"""Duration above which a step shows its elapsed time [s]; shorter steps would flicker."""
_SHARE = re.compile(r"(\d+) of (\d+)|(\d+(?:\.\d+)?) %")


class StepClock:
    """A step's text, its elapsed time, and its remaining time at the mean rate since the first reported progress."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Start; `clock` returns seconds."""
        self._clock, self.text = clock, "..."
        self._began, self._pace = clock(), (0.0, 0.0)
        self._first = self._last = (clock(), None)  # time of a report, and the share done

    def tell(self, text: str) -> bool:
        """Update with a step's text; return whether a new step began."""
        now, share = self._clock(), _read_share(text)
        another = _name_step(text) != _name_step(self.text)
        if another:
            self._began, self._first = now, (now, share)
        elif self._first[1] is None:
            self._first = (now, share)
        self.text, self._last = text, (now, share)
        return another

    def seconds_left(self) -> float | None:
        """Return the remaining time of the step [s], or None if it does not report progress."""
        (start, done), (last, share) = self._first, self._last
        if done is None or share is None or not share > done:
            return None
        return max(0.0, (1 - share) * (last - start) / (share - done) - (self._clock() - last))

    def format(self) -> str:
        """Return the line: the text, and for a long step the elapsed time and the time left."""
        spent, left = self._clock() - self._began, self.seconds_left()
        if spent < MIN_SHOWN_S:
            return self.text
        return f"{self.text}  ({spent:.0f} s{'' if left is None else f', {left:.0f} s left'})"

    def __rich__(self) -> Text:
        """Return the current line, for each update of the spinner."""
        return Text(self.format())


def _read_share(text: str) -> float | None:
    """Return the share done that a text states."""
    found = _SHARE.search(text)
    if found is None:
        return None
    k, n, percent = found.groups()
    return float(percent) / 100 if percent else int(k) / max(int(n), 1)


def _name_step(text: str) -> str:
    """Return the part of a text that is constant during a step."""
    return re.split(r"\d", text, maxsplit=1)[0] if _SHARE.search(text) else text


@contextmanager
def show_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show the current step on stderr if it is a terminal; log every new step."""
    clock = StepClock()

    def tell(text: str) -> None:
        LOGGER.log(logging.INFO if clock.tell(text) else logging.DEBUG, "%s", text)

    console = Console(stderr=True)
    if quiet or not console.is_terminal or LOGGER.isEnabledFor(logging.INFO):
        yield tell
        return
    with console.status(clock):
        yield tell


@contextmanager
def log_to_stderr(verbose: bool) -> Iterator[None]:
    """Show the library's log messages on stderr, with the time since the start; existing log handlers are not changed."""
    if not verbose:
        yield
        return
    handler, level = logging.StreamHandler(sys.stderr), LOGGER.level
    handler.setFormatter(logging.Formatter("%(relativeCreated)7.0f ms  %(name)s: %(message)s"))
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(level)
