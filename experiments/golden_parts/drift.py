"""Values written down, and which of those found are off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from golden_parts.cases import REASONS, Case
from tau_dyn.files import write_whole

FILE = Path(__file__).resolve().parent / "golden.json"
_FLOOR = 1e-12
"""What a number near zero may change by [its unit]."""

Row = tuple[str, Any, Any, str]
"""A value's name, what was written, what was found, the kind of its tolerance."""


def read_golden() -> dict[str, dict[str, Any]]:
    """Return what was written down, case by case."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def write_golden(values: Mapping[str, Mapping[str, Any]]) -> None:
    """Write values down."""
    write_whole(FILE, json.dumps(values, indent=1, sort_keys=True) + "\n")


def drifted(case: Case, found: Mapping[str, Any], written: Mapping[str, Any]) -> list[Row]:
    """Return the values that are off by more than their tolerance, that are new, or that are gone."""
    off: list[Row] = []
    for name in sorted(set(found) | set(written)):
        was, now, kind = written.get(name), found.get(name), case.kind(name)
        if not _same(was, now, REASONS[kind][0]):
            off.append((name, was, now, kind))
    return off


def _same(was: Any, now: Any, tolerance: float) -> bool:
    if isinstance(was, float) and isinstance(now, float):
        return abs(now - was) <= max(tolerance * abs(was), _FLOOR)
    return type(was) is type(now) and was == now
