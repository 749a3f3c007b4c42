"""A time limit on the search for a model: the best result so far is kept, and the skipped steps are recorded."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from tau_dyn.message_codes import CodedWarning


@dataclass(eq=False)
class TimeLimit:
    """The time limit of a search.

    Attributes:
        seconds: Wall time [s]; None without a limit.
        clock: Function that returns the time [s].
        left_out: Skipped steps, in the order in which they were skipped.
    """

    seconds: float | None = None
    clock: Callable[[], float] = time.monotonic
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Begin."""
        self._began = self.clock()

    def is_over(self, what: str, share: float = 1.0) -> bool:
        """Return whether the time is over; if so, record the skipped step.

        Args:
            what: The next step, as a part of the warning's sentence.
            share: Share of the time after which this step is skipped; early stages leave the rest to later ones.
        """
        if self.seconds is None or self.clock() - self._began < share * self.seconds:
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def list_warnings(self) -> list[str]:
        """Return the sentence about the skipped steps, if any."""
        if not self.left_out:
            return []
        said = f"the limit of {self.seconds:g} s ended the search; not tried: {', '.join(self.left_out)}"
        return [CodedWarning("time_limit", said)]


NO_LIMIT = TimeLimit()
"""The limit that is never over."""
