"""Which lines of the package ran: what tells a fuzzer that a case went where none went before."""

from __future__ import annotations

import sys
from types import CodeType, FrameType
from typing import Any


class LinesSeen:
    """Collects the package's lines that run inside the block; `new` tells whether some had never run before."""

    def __init__(self, part: str = "/tau_dyn/") -> None:
        """Watch files whose path has this part."""
        self.part, self.seen, self.new = part, set[tuple[CodeType, int]](), False
        self._ours: dict[CodeType, bool] = {}

    def __enter__(self) -> LinesSeen:
        """Begin to watch."""
        self.new = False
        sys.settrace(self._call)
        return self

    def __exit__(self, *fault: object) -> None:
        """Stop."""
        sys.settrace(None)

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        code = frame.f_code
        ours = self._ours.get(code)
        if ours is None:
            ours = self._ours[code] = self.part in code.co_filename
        return self._line if ours else None

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        place = (frame.f_code, frame.f_lineno)
        if place not in self.seen:
            self.seen.add(place)
            self.new = True
        return self._line
