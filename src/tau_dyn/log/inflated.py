"""How far a compressed file may grow: a few bytes can say that they are gigabytes, which recordings never do."""

from __future__ import annotations

from pathlib import Path

from tau_dyn.exceptions import InputError

MOST_INFLATED = 200
"""How many times its size a file may become, beside `FREE` bytes; recorders reach about ten times."""

FREE = 2**26


class Inflated:
    """Counts what comes out of a file's chunks."""

    def __init__(self, path: Path) -> None:
        """Count for this file."""
        self.name, self.left = path.name, FREE + MOST_INFLATED * path.stat().st_size

    def take(self, n: int) -> None:
        """Take `n` bytes, or refuse the file."""
        self.left -= n
        if self.left < 0:
            raise InputError(
                f"{self.name} inflates to more than {MOST_INFLATED} times its size, which no recording does; record it again."
            )
