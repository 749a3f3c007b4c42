"""What a command is doing: a line on a watched terminal with the time left, and log messages with `--verbose`.

A step's text says how far it is as `3 of 20` or `45 %`, its numbers before what changes with them: `trying 3 of 20: backlash`.
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
"""The library's logger; `--verbose` shows it, and a program that imports the library may."""
MIN_SHOWN_S = 2.0
"""A step that takes longer shows since when; shorter ones would flicker."""
_SHARE = re.compile(r"(\d+) of (\d+)|(\d+(?:\.\d+)?) %")


class StepClock:
    """A step's text, how long it has taken, and how long it will take: at the pace since the step said first how far it is."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin; `clock` gives seconds."""
        self._clock, self.text = clock, "..."
        self._began, self._pace = clock(), (0.0, 0.0)
        self._first = self._last = (clock(), None)  # when it said so, and the share done

    def tell(self, text: str) -> bool:
        """Take a step's text; return whether another step began."""
        now, share = self._clock(), _read_share(text)
        another = _name_step(text) != _name_step(self.text)
        if another:
            self._began, self._first = now, (now, share)
        elif self._first[1] is None:
            self._first = (now, share)
        self.text, self._last = text, (now, share)
        return another

    def seconds_left(self) -> float | None:
        """Return how long the step will take; None where it does not tell how far it is."""
        (start, done), (last, share) = self._first, self._last
        if done is None or share is None or not share > done:
            return None
        return max(0.0, (1 - share) * (last - start) / (share - done) - (self._clock() - last))

    def format(self) -> str:
        """Return the line: the text, the time it has taken and the time left, once it takes long."""
        spent, left = self._clock() - self._began, self.seconds_left()
        if spent < MIN_SHOWN_S:
            return self.text
        return f"{self.text}  ({spent:.0f} s{'' if left is None else f', {left:.0f} s left'})"

    def __rich__(self) -> Text:
        """Return the line as it is now; a spinner asks each time it turns."""
        return Text(self.format())


def _read_share(text: str) -> float | None:
    """Return the share done that a text says."""
    found = _SHARE.search(text)
    if found is None:
        return None
    k, n, percent = found.groups()
    return float(percent) / 100 if percent else int(k) / max(int(n), 1)


def _name_step(text: str) -> str:
    """Return what stays of a text while its numbers count."""
    return re.split(r"\d", text, maxsplit=1)[0] if _SHARE.search(text) else text


@contextmanager
def show_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show the current step on stderr, if somebody watches; log every new one."""
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
    """Show what the library logs on stderr, with the time since the start; of a program that logs already it stays as it is."""
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
