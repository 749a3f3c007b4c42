"""A text log too large for memory, as tables of some lines each; every line is checked and counted as in a small one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tau_dyn.exceptions import InputError
from tau_dyn.log.delimited import parse_delimited
from tau_dyn.log.table import Table

CHUNK_BYTES = 2**24
"""Size of the text parsed at once."""


def text_chunks(path: Path) -> Iterator[Table]:
    """Yield a delimited file's rows as tables, each with its lines' numbers in the file."""
    with path.open("rb") as file:
        head, lines = _head(file, path)
        while body := file.readlines(CHUNK_BYTES):
            if not b"".join(body).strip():
                lines += len(body)
                continue
            shift = lines - 1  # the header is line 1 of what is parsed
            try:
                cells, places, warnings = parse_delimited(path.name, b"".join([head, *body]))
            except InputError as fault:
                raise InputError(_shifted(str(fault), shift)) from None
            yield Table(
                path.name, path, "", cells, places + shift, warnings=tuple(_shifted(w, shift) for w in warnings)
            )
            lines += len(body)


def _head(file, path: Path) -> tuple[bytes, int]:
    """Return the header line, and how many lines the file's top has up to it."""
    for number, line in enumerate(file, start=1):
        text = line.removeprefix(b"\xef\xbb\xbf")
        if text.strip() and not text.lstrip().startswith(b"#"):
            return text if text.endswith(b"\n") else text + b"\n", number
    raise InputError(f"{path.name} has no header; a log needs a line naming its columns and one line a sample.")


def _shifted(sentence: str, shift: int) -> str:
    """Return a sentence about `line 7` with that line's number in the file."""
    before, found, after = sentence.partition(", line ")
    digits = len(after) - len(after.lstrip("0123456789"))
    return (
        f"{before}{found}{int(after[:digits]) + shift}{after[digits:]}"
        if digits and int(after[:digits]) > 1
        else sentence
    )
