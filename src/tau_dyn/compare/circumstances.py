"""What was different about two runs besides their answers: files that went in, options, versions, single numbers.

Only what differs is kept, so that one look tells what a change of the answer may be due to.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any


@dataclass(frozen=True)
class InputChange:
    """A file that went in.

    Attributes:
        a: Its path in the first run, None where only the second read it.
        b: Its path in the second.
        same: Whether the content is the same, by its hash.
    """

    a: str | None
    b: str | None
    same: bool

    @property
    def state(self) -> str:
        """`same`, `renamed`, `changed`, `only in the first` or `only in the second`."""
        if self.a is None or self.b is None:
            return "only in the second" if self.a is None else "only in the first"
        if not self.same:
            return "changed"
        return "same" if self.a == self.b else "renamed"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"a": self.a, "b": self.b, "state": self.state}


@dataclass(frozen=True)
class CircumstanceDifference:
    """An option, version or number that differs; None where one side lacks it."""

    name: str
    a: Any
    b: Any


def list_differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[CircumstanceDifference, ...]:
    """Return what differs between two mappings, in the first's order."""
    names = dict.fromkeys([*a, *b])
    return tuple(CircumstanceDifference(n, a.get(n), b.get(n)) for n in names if a.get(n) != b.get(n))


def list_input_changes(a: Mapping[str, str], b: Mapping[str, str]) -> tuple[InputChange, ...]:
    """Match the files of two runs: by path, else by content, else by name; what is left only one of them read.

    Args:
        a: Hashes by path of the first run.
        b: Of the second.
    """
    left, right = dict(a), dict(b)
    both = tuple(_matched(left, right))
    return (*both, *(InputChange(p, None, False) for p in left), *(InputChange(None, p, False) for p in right))


def _matched(left: dict[str, str], right: dict[str, str]) -> Iterator[InputChange]:
    """Take pairs out of both mappings, the surest first."""
    alike = (
        lambda p, q: p == q,
        lambda p, q: left[p] == right[q],
        lambda p, q: PurePath(p).name == PurePath(q).name,
    )
    for rule in alike:
        for p in list(left):
            q = next((q for q in right if rule(p, q)), None)
            if q is not None:
                yield InputChange(p, q, left.pop(p) == right.pop(q))
