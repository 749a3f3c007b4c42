"""A CSV file that another program still writes, read as a sequence of logs: complete lines only, each once."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import InputError
from tau_dyn.log import ColumnMap, Log, read_log

FIRST_S = 60.0
"""Length of the first segment [s]: the filters are chosen from it."""
STRETCH_S = 10.0
"""Length of later segments [s]: it is the largest delay of an alarm, and filters lose a tenth of it at the ends."""
_POLL_S = 1.0  # s between two looks at the file
_MIN_LINES = 20  # fewer make no log


@dataclass(eq=False)
class GrowingFile:
    """A growing CSV file.

    Attributes:
        path: The file.
        columns: Map of foreign columns.
        patience_s: Time without a new line after which the recording counts as ended [s].
        wait: Function that sleeps; a test replaces it.
    """

    path: Path
    columns: ColumnMap | Path | None = None
    patience_s: float = 60.0
    wait: Callable[[float], Any] = time.sleep
    _digest: Any = field(default_factory=hashlib.sha256)

    @property
    def sha256(self) -> str:
        """Hash of the text read so far."""
        return self._digest.hexdigest()

    def read(self) -> Iterator[Log]:
        """Yield segments of the recording until it has ended, or the user interrupts.

        Raises:
            InputError: The file is not text, or a line is invalid.
        """
        if self.path.suffix.lower() not in (".csv", ".txt", ".tsv", ".dat"):
            raise InputError(
                "bad_option", f"{self.path}: --follow reads a growing CSV file; leave it out for a finished one"
            )
        head, lines, rest, idle, needed = b"", [], b"", 0.0, FIRST_S
        try:
            file = self.path.open("rb")
        except OSError as fault:
            raise InputError("cannot_read", f"{self.path}: cannot be read ({fault.strerror})") from fault
        with file:
            while idle < self.patience_s:
                new = file.read()
                self._digest.update(new)
                *complete, rest = (rest + new).split(b"\n")
                lines += [line for line in complete if line.strip()]
                if not head:
                    head, lines = _split_head(lines)
                log = self._parse(head, lines)
                if log is not None and log.duration >= needed:
                    yield log
                    lines, needed = [], STRETCH_S
                idle = 0.0 if new else idle + _POLL_S
                try:
                    self.wait(_POLL_S)
                except KeyboardInterrupt:
                    break
        log = self._parse(head, lines)
        if log is not None:
            yield log

    def _parse(self, head: bytes, lines: list[bytes]) -> Log | None:
        if len(lines) < _MIN_LINES:
            return None
        with tempfile.TemporaryDirectory(prefix="tau_dyn_") as folder:
            part = Path(folder) / self.path.name
            part.write_bytes(head + b"\n".join(lines) + b"\n")
            return replace(read_log(part, self.columns), name=self.path.name)


def _split_head(lines: list[bytes]) -> tuple[bytes, list[bytes]]:
    """Return comments and header, as soon as they are complete, and the other lines."""
    for k, line in enumerate(lines):
        if not line.lstrip().startswith(b"#"):
            return b"".join(one + b"\n" for one in lines[: k + 1]), lines[k + 1 :]
    return b"", lines
