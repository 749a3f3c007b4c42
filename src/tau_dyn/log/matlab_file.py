"""A MATLAB file of level 5 (v5 to v7.2) as numbers, structs and cells, in plain Python.

scipy's reader is not used: bytes that were changed on the way make its compiled code read where nothing is, which ends the whole
process. Here every size is held against what the file has before anything is made of it, and a compressed variable is inflated no
further than a limit. Text, sparse matrices, functions and objects are passed over. Reference: MAT-File Format, The MathWorks.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError

MAX_INFLATED_BYTES = 2**29
"""Bytes that a file may hold when it is inflated."""

MAX_ELEMENTS = 2 * 10**6
"""Parts of a file, each of which costs time and memory however small it is; an array has four."""


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
        object; None for all else.

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
    """Yield what is inside each variable, inflated; as views, since cells inside cells would copy it at every level."""
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
            raise ValueError(f"{name or 'a field'} has {array.size} numbers where its dimensions say {count}")
        return name, array.reshape(shape, order="F")
    if kind == _OBJECT:
        return name, Opaque
    if kind == _STRUCT:
        return name, _structs(elements, order, count, depth, left)
    if kind == _CELL:
        return name, [_matrix(inside, order, depth + 1, left)[1] for code, inside in elements if code == _MATRIX]
    return name, None


def _structs(
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
