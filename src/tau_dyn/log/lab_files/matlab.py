"""MATLAB files of level 5 (v5 to v7.2, `save -v7`), read in plain Python: variables and structs become columns.

A struct with a time is a topic of its own; its field is `name.field`, a column of a matrix `name.field[0]`, counted from 0.
The clock of a level is its variable `t`, `time`, `Time` or `tout`, and its columns are the variables with as many samples, as in
Simulink's "structure with time". Only MATLAB can open objects (`timeseries`, `timetable`, `datetime`); text, sparse matrices
and functions are skipped.

scipy's reader is not used: damaged bytes make its compiled code read outside its memory, which ends the whole process. Here every
size is checked against the size of the file before memory is allocated, and a compressed variable is inflated no further than a
limit. Reference: MAT-File Format, The MathWorks.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256
from tau_dyn.log.column_names import format_names, is_contract_name
from tau_dyn.log.table import Table
from tau_dyn.log.topic_columns import DEEPEST, LONGEST_LIST, MAX_CELLS, MOST_COLUMNS, Topic
from tau_dyn.log.topics import build_topic_table

MAX_INFLATED_BYTES = 2**29
"""Bytes that a file may hold when it is inflated."""

MAX_ELEMENTS = 2 * 10**6
"""Largest number of parts of a file, as each takes time and memory even if small; an array has four."""


class Opaque:
    """An object that only MATLAB can open."""


_HEADER, _MATRIX, _COMPRESSED, _DEEPEST = 128, 14, 15, 32
_CELL, _STRUCT, _OBJECT, _OPAQUE, _NUMBERS = 1, 2, 3, 17, range(6, 16)
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX = 0x0800  # flag of complex numbers (MAT-file format, level 5)
_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_variables(path: Path) -> dict[str, Any]:
    """Return a file's variables by name.

    Args:
        path: The file.

    Returns:
        Real numbers as arrays of their dimensions; a struct as a mapping, structs and cells in rows as lists; `Opaque` for an
        object; None for other types.

    Raises:
        InputError: It is of another version, breaks off, is damaged or too large.
    """
    data, order = _bytes(path)
    found: dict[str, Any] = {}
    left = iter(range(MAX_ELEMENTS))
    try:
        for inside in _variables(path, data, order):
            name, value = _matrix(inside, order, 0, left)
            found[name] = value
    except (struct.error, ValueError, zlib.error) as fault:
        if isinstance(fault, InputError):
            raise
        raise InputError(
            "damaged_file", f"{path.name} is damaged ({str(fault)[:80]}); copy or save it again."
        ) from None
    return found


def _bytes(path: Path) -> tuple[bytes, str]:
    """Return the file and its byte order."""
    with path.open("rb") as file:
        head = file.read(_HEADER)
        if head.startswith(_HDF5) or head.startswith(b"MATLAB 7.3"):
            raise InputError(
                "unsupported",
                f"{path.name} is a MATLAB file of version 7.3, which is not read; save it with: save(.., '-v7').",
            )
        if len(head) < _HEADER or head[126:128] not in (b"IM", b"MI"):
            raise InputError(
                "file_format", f"{path.name} is not a MATLAB file of version 5 to 7.2; save it with: save(.., '-v7')."
            )
        if path.stat().st_size > MAX_INFLATED_BYTES:
            raise _too_large(path)
        return head + file.read(), "<" if head[126:128] == b"IM" else ">"


def _variables(path: Path, whole_file: bytes, order: str) -> Iterator[memoryview]:
    """Yield the content of each variable, inflated; as views, since nested cells would be copied at every level."""
    at, left, data = _HEADER, MAX_INFLATED_BYTES, memoryview(whole_file)
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if size > len(data) - at - 8:
            raise InputError("damaged_file", f"{path.name} breaks off inside a variable; copy or save it again.")
        inside = data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind == _COMPRESSED:
            inflate = zlib.decompressobj()
            whole = memoryview(inflate.decompress(inside, left + 1))
            left -= len(whole)
            if left < 0:
                raise _too_large(path)
            if not inflate.eof:
                raise ValueError("a compressed variable has no end")
            kind, inside = struct.unpack_from(f"{order}I", whole)[0], whole[8:]
        if kind == _MATRIX:
            yield inside


def _matrix(data: memoryview, order: str, depth: int, left: Iterator[int]) -> tuple[str, Any]:
    """Return an array's name and value."""
    if not data:
        return "", None  # an empty field
    elements = _elements(data, order, left)
    flags = struct.unpack_from(f"{order}I", _next(elements)[1])[0]
    kind = flags & 0xFF
    if kind == _OPAQUE:
        return _text(_next(elements)[1]), Opaque
    shape = struct.unpack(f"{order}{len(dims := _next(elements)[1]) // 4}i", dims)
    name, count = _text(_next(elements)[1]), math.prod(shape)
    if min(shape, default=0) < 0 or depth > _DEEPEST:
        raise ValueError(f"{name or 'a field'} has impossible dimensions")
    if kind in _NUMBERS and not flags & _COMPLEX:
        code, numbers = _next(elements)
        if code not in _DTYPES:
            raise ValueError(f"{name or 'a field'} has numbers of an unknown kind")
        array = np.frombuffer(numbers, dtype=order + _DTYPES[code])
        if array.size != count:
            raise ValueError(f"{name or 'a field'} has {array.size} numbers but its dimensions give {count}")
        return name, array.reshape(shape, order="F")
    if kind == _OBJECT:
        return name, Opaque
    if kind == _STRUCT:
        return name, _read_structs(elements, order, count, depth, left)
    if kind == _CELL:
        return name, [_matrix(inside, order, depth + 1, left)[1] for code, inside in elements if code == _MATRIX]
    return name, None


def _read_structs(
    elements: Iterator[tuple[int, memoryview]], order: str, count: int, depth: int, left: Iterator[int]
) -> Any:
    """Return a struct as a mapping, or several as a list of them."""
    width = struct.unpack_from(f"{order}i", _next(elements)[1])[0]
    names = _next(elements)[1]
    if width <= 0:
        raise ValueError("a struct's names have no length")
    fields = [_text(names[k : k + width]) for k in range(0, len(names), width)]
    values = [_matrix(inside, order, depth + 1, left)[1] for code, inside in elements if code == _MATRIX]
    if len(values) != count * len(fields):
        raise ValueError(f"a struct has {len(values)} values where {count * len(fields)} are announced")
    rows = [
        dict(zip(fields, values[k : k + len(fields)], strict=True)) for k in range(0, len(values), len(fields) or 1)
    ]
    return rows[0] if len(rows) == 1 else rows


def _elements(data: memoryview, order: str, left: Iterator[int]) -> Iterator[tuple[int, memoryview]]:
    """Yield the kind and bytes of each element in an array."""
    at = 0
    while at + 8 <= len(data):
        if next(left, None) is None:
            raise ValueError(f"it has more than {MAX_ELEMENTS} parts")
        first, size = struct.unpack_from(f"{order}II", data, at)
        if first >> 16:  # up to four bytes within the tag
            yield first & 0xFFFF, data[at + 4 : at + 4 + min(first >> 16, 4)]
            at += 8
            continue
        if size > len(data) - at - 8:
            raise ValueError("an element is longer than its variable")
        yield first, data[at + 8 : at + 8 + size]
        at += 8 + size + (-size) % 8


def _next(elements: Iterator[tuple[int, memoryview]]) -> tuple[int, memoryview]:
    """Return the next element."""
    for element in elements:
        return element
    raise ValueError("an array breaks off")


def _text(data: memoryview) -> str:
    return bytes(data).partition(b"\0")[0].decode("latin-1")


def _too_large(path: Path) -> InputError:
    return InputError(
        "file_too_large",
        f"{path.name} holds more than {MAX_INFLATED_BYTES / 2**20:.0f} MB; save the variables needed alone, or Parquet.",
    )


CLOCKS = ("t", "time", "Time", "tout")


def read_mat(path: Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a MATLAB file as a table.

    Args:
        path: The file.
        wanted: The columns that a map asks for, by our names; None without a map.

    Raises:
        InputError: It is of another version, damaged or too large, or it is ambiguous which part is the log.
    """
    levels = list(_levels(read_variables(path), path.name))
    topics = [topic for topic in (_topic(*level) for level in levels) if topic is not None]
    fields = dict(levels).get("", {})
    timed = bool(topics)
    if not timed:  # without any clock, a map may give a rate or name a clock
        counts = Counter(n for array in fields.values() for n in array.shape if n > 1)
        topics = [_clockless(fields, counts.most_common(1)[0][0])] if counts else []
    table = build_topic_table(path, compute_sha256(path), topics, wanted)
    if not timed:
        table.cells.pop("t")
    return table


def _levels(variables: Mapping[str, Any], name: str) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yield every level with numbers of its own, with all numbers below it: the file's level, then each struct's."""
    found = list(_list_levels(variables, "", 0))
    opaque = sorted(key for key, value in variables.items() if key and value is Opaque)
    if not found or not any(fields for _, fields in found):
        about = f"{format_names(opaque)} is an object that only MATLAB can open" if opaque else "it has no numbers"
        raise InputError("file_format", f"{name}: {about}; save numbers, such as t = x.Time, q_axis = x.Data.")
    yield from found


def _list_levels(fields: Mapping[str, Any], name: str, depth: int) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
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
    below = [level for key, item in inner if depth < DEEPEST for level in _list_levels(item, key, depth + 1)]
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
    """Return the variables with `n` samples, a matrix as its columns."""
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
