"""Warnings that programs can tell apart: a sentence for people that carries a stable code.

A `CodedWarning` is a `str`, so every list of sentences may hold it. The codes are part of the results: `warning_codes` in JSON
stands parallel to `warnings`. `message_codes.py` lists them with cause and remedy.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

UNCODED = "note"
"""Code of a sentence that no program needs to tell from others."""


class CodedWarning(str):
    """A sentence with a code, such as `lost_samples`."""

    code: str

    def __new__(cls, code: str, sentence: str) -> CodedWarning:
        """Keep the code beside the sentence."""
        made = super().__new__(cls, sentence)
        made.code = code
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """Keep the code where a result travels between processes."""
        return CodedWarning, (self.code, str(self))


def get_code(sentence: str) -> str:
    """Return the code of a warning; `note` for a plain sentence."""
    return getattr(sentence, "code", UNCODED)


def format_with_code(sentence: str) -> str:
    """Return a warning with its code in brackets behind it; a plain sentence as it is."""
    code = get_code(sentence)
    return str(sentence) if code == UNCODED else f"{sentence} [{code}]"


def format_warnings(warnings: Iterable[str]) -> dict[str, list[str]]:
    """Return the two parallel lists of a JSON result, each sentence once."""
    once = list(dict.fromkeys(warnings))
    return {
        "warnings": [str(sentence) for sentence in once],
        "warning_codes": [get_code(sentence) for sentence in once],
    }
