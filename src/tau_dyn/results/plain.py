"""Any result as plain data for JSON: dataclasses, arrays, numbers that are none, names, paths."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from enum import Enum
from math import isfinite
from pathlib import PurePath
from typing import Any


def to_plain(value: Any, *, leave_out: Iterable[str] = ()) -> Any:
    """Return a value as dicts, lists, strings, numbers and None.

    A dataclass or a named tuple becomes a dict of its fields, an array nested lists, NaN and infinity None, a complex number
    `re` and `im`, an enum its value, a path and a date their text, a set a sorted list. A value with a `to_dict` of its own says
    itself what it is.

    Args:
        value: What to turn into data.
        leave_out: Fields of the outermost dataclass that are not told.

    Raises:
        TypeError: It holds something that is no data, such as a function.
    """
    if is_dataclass(value) and not isinstance(value, type):
        hidden = set(leave_out)
        return {f.name: _inner(getattr(value, f.name)) for f in fields(value) if f.name not in hidden}
    return _inner(value)


def _inner(value: Any) -> Any:
    if value is None or isinstance(value, str | bool):
        return value if not isinstance(value, Enum) else value.value
    if hasattr(value, "to_dict"):
        return _inner(value.to_dict())
    if is_dataclass(value) and not isinstance(value, type):
        return to_plain(value)
    if hasattr(value, "_asdict"):  # a named tuple
        return _inner(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): _inner(item) for key, item in value.items()}
    if hasattr(value, "dtype") and hasattr(value, "tolist"):  # of numpy, which the command line starts without
        return _inner(value.tolist())
    if isinstance(value, complex):
        return {"re": _inner(value.real), "im": _inner(value.imag)}
    if isinstance(value, float):
        return value if isfinite(value) else None
    if isinstance(value, int):
        return value
    if isinstance(value, Enum):
        return _inner(value.value)
    if isinstance(value, PurePath | date):
        return str(value)
    if isinstance(value, set | frozenset):
        return [_inner(item) for item in sorted(value, key=str)]
    if isinstance(value, Iterable):
        return [_inner(item) for item in value]
    raise TypeError(f"{type(value).__name__} is no data")
