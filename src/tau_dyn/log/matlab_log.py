"""MATLAB files v5 to v7.2 (`save -v7`): variables and structs become columns, each struct with a time a topic of its own.

A struct's field is `name.field`, a column of a matrix `name.field[0]`, counted from 0. The clock of a level is its variable `t`,
`time`, `Time` or `tout`, and its columns are what has as many samples: Simulink's "structure with time" as it stands. Objects
(`timeseries`, `timetable`, `datetime`) only MATLAB can open.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256
from tau_dyn.log.column_names import format_names, is_contract_name
from tau_dyn.log.matlab_file import Opaque, read_variables
from tau_dyn.log.table import Table
from tau_dyn.log.topic_columns import DEEPEST, LONGEST_LIST, MAX_CELLS, MOST_COLUMNS, Topic
from tau_dyn.log.topics import build_topic_table

CLOCKS = ("t", "time", "Time", "tout")


def read_mat(path: Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a MATLAB file as a table.

    Args:
        path: The file.
        wanted: The columns that a map asks for, by our names; None without a map.

    Raises:
        InputError: It is of another version, damaged or too large, or it is not clear what in it is the log.
    """
    levels = list(_levels(read_variables(path), path.name))
    topics = [topic for topic in (_topic(*level) for level in levels) if topic is not None]
    fields = dict(levels).get("", {})
    timed = bool(topics)
    if not timed:  # without any clock, a map may give a rate, or name one
        counts = Counter(n for array in fields.values() for n in array.shape if n > 1)
        topics = [_clockless(fields, counts.most_common(1)[0][0])] if counts else []
    table = build_topic_table(path, compute_sha256(path), topics, wanted)
    if not timed:
        table.cells.pop("t")
    return table


def _levels(variables: Mapping[str, Any], name: str) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield every level that has numbers of its own, with all numbers below it: the file's, then each struct's."""
    found = list(_structs(variables, "", 0))
    opaque = sorted(key for key, value in variables.items() if key and value is Opaque)
    if not found or not any(fields for _, fields in found):
        about = f"{format_names(opaque)} is an object that only MATLAB can open" if opaque else "it has no numbers"
        raise InputError("file_format", f"{name}: {about}; save numbers, such as t = x.Time, q_axis = x.Data.")
    yield from found


def _structs(fields: Mapping[str, Any], name: str, depth: int) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    flat: dict[str, np.ndarray] = {}
    inner: list[tuple[str, Mapping[str, Any]]] = []
    for key, value in fields.items():
        if not key or key.startswith("_"):
            continue
        array = _numeric(value)
        if array is not None:
            flat[key] = array
        for label, item in _items(value):
            inner.append((f"{key}{label}", item))
    below = [level for key, item in inner if depth < DEEPEST for level in _structs(item, key, depth + 1)]
    for key, own in below:
        if not any(c in own for c in CLOCKS):
            flat |= {f"{key}.{field}": array for field, array in own.items()}
    yield name, dict(list(flat.items())[:MOST_COLUMNS])
    for key, own in below:
        yield (f"{name}.{key}" if name else key), own


def _items(value: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield a variable's structs: one, or a row of them with their places."""
    if isinstance(value, dict):
        yield "", value
    elif isinstance(value, list) and len(value) <= LONGEST_LIST:
        for k, cell in enumerate(value):
            for label, fields in _items(cell):
                yield f"[{k}]{label}", fields


def _numeric(value: Any) -> np.ndarray | None:
    """Return numbers as an array of one or two dimensions, else None."""
    if not isinstance(value, np.ndarray) or value.size < 2:
        return None
    if value.size > MAX_CELLS:  # bytes become numbers of eight bytes
        raise InputError(
            "file_too_large",
            f"a variable holds {value.size} numbers, more than {MAX_CELLS}; save a part of it, or Parquet.",
        )
    array = value.squeeze()
    return array if array.ndim in (1, 2) else None


def _topic(name: str, fields: dict[str, np.ndarray]) -> Topic | None:
    """Return a level that has a clock as a topic, else None."""
    clock = next((c for c in CLOCKS if c in fields and fields[c].ndim == 1), None)
    if clock is None:
        return None
    t = fields[clock].astype(np.float64)
    columns = _columns({key: array for key, array in fields.items() if key != "t"}, t.size)
    return Topic(name, "struct", t, None, columns, _ours(columns))


def _clockless(fields: dict[str, np.ndarray], n: int) -> Topic:
    columns = _columns(fields, n)
    return Topic("", "variables", np.arange(n, dtype=np.float64), None, columns, _ours(columns))


def _columns(fields: Mapping[str, np.ndarray], n: int) -> dict[str, np.ndarray]:
    """Return what has `n` samples, a matrix as its columns."""
    found: dict[str, np.ndarray] = {}
    for key, array in fields.items():
        wide = array.ndim == 2 and n in array.shape and array.size // n <= LONGEST_LIST
        if not wide and array.shape != (n,):
            continue
        if n * len(found) + array.size > MAX_CELLS:  # before they are copied
            raise InputError(
                "file_too_large",
                f"the file holds more than {MAX_CELLS} numbers; save the variables needed, or Parquet.",
            )
        if not wide:
            found[key] = array.astype(np.float64)
        else:
            matrix = array if array.shape[0] == n else array.T
            found |= {f"{key}[{k}]": matrix[:, k].astype(np.float64) for k in range(matrix.shape[1])}
    return found


def _ours(columns: Mapping[str, np.ndarray]) -> dict[str, str]:
    return {column: column for column in columns if is_contract_name(column) and column != "t"}
