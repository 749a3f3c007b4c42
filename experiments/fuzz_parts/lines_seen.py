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
        self._left: dict[CodeType, set[int]] = {}

    def __enter__(self) -> LinesSeen:
        """Begin to watch."""
        self.new = False
        sys.settrace(self._call)
        return self

    def __exit__(self, *fault: object) -> None:
        """Stop."""
        sys.settrace(None)

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        """Watch a call of ours that has lines left which never ran; the others run at their own speed."""
        code = frame.f_code
        left = self._left.get(code)
        if left is None:
            ours = self.part in code.co_filename
            left = self._left[code] = {line for _, _, line in code.co_lines() if line is not None} if ours else set()
        return self._line if left else None

    def _line(self, frame: FrameType, event: str, argument: Any) -> Any:
        place = (frame.f_code, frame.f_lineno)
        if place not in self.seen:
            self.seen.add(place)
            self._left[frame.f_code].discard(frame.f_lineno)
            self.new = True
        return self._line
