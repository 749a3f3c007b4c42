"""How far a compressed file may grow: a few bytes can say that they are gigabytes, which recordings never do."""

from __future__ import annotations

from pathlib import Path

from tau_dyn.exceptions import InputError

MAX_INFLATION_RATIO = 200
"""How many times its size a file may become, beside `FREE_BYTES` bytes; recorders reach about ten times."""

FREE_BYTES = 2**26  # bytes; small files may inflate as they like


class DecompressionLimit:
    """Counts what comes out of a file's chunks."""

    def __init__(self, path: Path) -> None:
        """Count for this file."""
        self.name, self.left = path.name, FREE_BYTES + MAX_INFLATION_RATIO * path.stat().st_size

    def take(self, n: int) -> None:
        """Take `n` bytes, or refuse the file."""
        self.left -= n
        if self.left < 0:
            raise InputError(
                "file_too_large",
                f"{self.name} inflates to more than {MAX_INFLATION_RATIO} times its size, which no recording does; "
                f"record it again.",
            )
