"""A limit of time on the search for a model: the best answer so far stands, and what was left out is remembered."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from tau_dyn.message_codes import CodedWarning


@dataclass(eq=False)
class TimeLimit:
    """How long a search may go on.

    Attributes:
        seconds: Wall time [s]; None without a limit.
        clock: Gives seconds.
        left_out: What was not tried, in the order in which it was given up.
    """

    seconds: float | None = None
    clock: Callable[[], float] = time.monotonic
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin."""
        self._began = self.clock()

    def is_over(self, what: str, share: float = 1.0) -> bool:
        """Return whether the time is over; if so, remember what is left out for it.

        Args:
            what: What would come next, as a part of the warning's sentence.
            share: Of the time after which it is over for this; early stages leave the rest to later ones.
        """
        if self.seconds is None or self.clock() - self._began < share * self.seconds:
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def list_warnings(self) -> list[str]:
        """Return the sentence about what was left out, if anything was."""
        if not self.left_out:
            return []
        said = f"the limit of {self.seconds:g} s ended the search; not tried: {', '.join(self.left_out)}"
        return [CodedWarning("time_limit", said)]


NO_LIMIT = TimeLimit()
"""The limit that is never over."""
