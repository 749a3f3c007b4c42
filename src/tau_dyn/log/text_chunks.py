"""A text log too large for memory, as tables of some lines each; every line is checked and counted as in a small one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from tau_dyn.exceptions import InputError
from tau_dyn.log.delimited import parse_delimited
from tau_dyn.log.table import Table

CHUNK_BYTES = 2**24
"""Size of the text parsed at once."""


def iterate_text_chunks(path: Path, digest: Any = None) -> Iterator[Table]:
    """Yield a delimited file's rows as tables, each with its lines' numbers in the file.

    A file that grows meanwhile is read as far as it went at the start.

    Args:
        path: The file.
        digest: A hash of `hashlib` that is given every byte read.
    """
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        head, lines, taken = _head(file, path)
        _count(digest, taken)
        left -= len(taken)
        while left > 0:
            body = _next_lines(file, left)
            left -= sum(map(len, body))
            for line in body:
                _count(digest, line)
            if not body:
                return
            if not b"".join(body).strip():
                lines += len(body)
                continue
            shift = lines - 1  # the header is line 1 of what is parsed
            try:
                cells, places, warnings = parse_delimited(path.name, b"".join([head, *body]))
            except InputError as fault:
                raise InputError(fault.code, _shifted(str(fault), shift)) from None
            yield Table(
                path.name, path, "", cells, places + shift, warnings=tuple(_shifted(w, shift) for w in warnings)
            )
            lines += len(body)


def _next_lines(file: BinaryIO, left: int) -> list[bytes]:
    """Return the lines to parse at once; the last ones come together, as an incomplete line is told by those above it."""
    body = file.readlines(CHUNK_BYTES if left > 2 * CHUNK_BYTES else left)
    over = sum(map(len, body)) - left
    if over > 0:
        body[-1] = body[-1][:-over]
    return body


def _count(digest: Any, data: bytes) -> None:
    if digest is not None:
        digest.update(data)


def _head(file: BinaryIO, path: Path) -> tuple[bytes, int, bytes]:
    """Return the header line, how many lines the file's top has up to it, and all of them."""
    taken = []
    for number, line in enumerate(file, start=1):
        taken.append(line)
        text = line.removeprefix(b"\xef\xbb\xbf")
        if text.strip() and not text.lstrip().startswith(b"#"):
            return text if text.endswith(b"\n") else text + b"\n", number, b"".join(taken)
    raise InputError(
        "missing_column", f"{path.name} has no header; a log needs a line naming its columns and one line a sample."
    )


def _shifted(sentence: str, shift: int) -> str:
    """Return a sentence about `line 7` with that line's number in the file."""
    before, found, after = sentence.partition(", line ")
    digits = len(after) - len(after.lstrip("0123456789"))
    return (
        f"{before}{found}{int(after[:digits]) + shift}{after[digits:]}"
        if digits and int(after[:digits]) > 1
        else sentence
    )
