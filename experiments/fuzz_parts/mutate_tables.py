"""Mutations of tables, CSV and Parquet: cells, headers, separators, quotes, types, sizes."""

from __future__ import annotations

import io
from random import Random

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from fuzz_parts.hostile import number, value, word


def _rows(data: bytes) -> list[list[str]]:
    return [line.split(",") for line in data.decode("utf-8", "replace").split("\n")]


def _text(rows: list[list[str]]) -> bytes:
    return "\n".join(",".join(row) for row in rows).encode("utf-8", "replace")


def cells(data: bytes, rng: Random) -> bytes:
    """Replace, swap or lose some cells."""
    rows = _rows(data)
    for _ in range(rng.choice((1, 1, 3, 20))):
        row, other = rng.choice(rows), rng.choice(rows)
        k = rng.randrange(len(row)) if row else 0
        match rng.randrange(5):
            case 0 | 1 if row:
                row[k] = value(rng)
            case 2 if row and other:
                row[k] = other[rng.randrange(len(other))]
            case 3 if row:
                del row[k]
            case _:
                row.insert(k, number(rng))
    return _text(rows)


def column(data: bytes, rng: Random) -> bytes:
    """Replace a whole column by one value, by text, or by an offset or scale of itself; or repeat it."""
    rows = _rows(data)
    k, what, kind = rng.randrange(max(map(len, rows))), value(rng), rng.randrange(4)
    for row in rows[1:]:
        if k < len(row):
            try:
                row[k] = (what, repr(float(row[k]) * 1e12), row[-1], row[0])[kind]
            except ValueError:
                row[k] = what
    return _text(rows)


def header(data: bytes, rng: Random) -> bytes:
    """Rename, repeat, add or lose names; or make a header of thousands."""
    rows = _rows(data)
    first = next((row for row in rows if row and not row[0].startswith("#")), rows[0])
    k = rng.randrange(len(first)) if first else 0
    match rng.randrange(6):
        case 0 if first:
            first[k] = word(rng)
        case 1 if first:
            first[k] = first[rng.randrange(len(first))]
        case 2:
            first.insert(k, word(rng))
        case 3 if first:
            del first[k]
        case 4:
            first[:] = [f"c{i}" for i in range(rng.choice((3000, 15000)))]
        case _:
            first[k : k + 1] = ["x" * rng.choice((100, 140_000))]
    return _text(rows)


def separators(data: bytes, rng: Random) -> bytes:
    """Use other separators or decimal marks, everywhere or on some lines."""
    new = rng.choice((b";", b"\t", b" ", b"|", b", ", b",,"))
    rows = data.split(b"\n")
    return b"\n".join(row.replace(b",", new) if rng.random() < 0.9 else row for row in rows)


def quotes(data: bytes, rng: Random) -> bytes:
    """Quote cells, rightly or not."""
    rows = _rows(data)
    for _ in range(rng.choice((1, 5, 30))):
        row = rng.choice(rows)
        if row:
            k = rng.randrange(len(row))
            row[k] = rng.choice(('"{}"', '"{}', '{}"', '"a""{}"', '"{},{}"', '"{}\n"', "'{}'")).replace("{}", row[k])
    return _text(rows)


def sizes(data: bytes, rng: Random) -> bytes:
    """Keep a few rows, or repeat the rows, with times running on or not."""
    rows = data.split(b"\n")
    if rng.random() < 0.5:
        return b"\n".join(rows[: rng.choice((0, 1, 2, 5, 11, 12))])
    return b"\n".join(rows + rows[1:] * rng.choice((1, 5)))


CSV = (cells, cells, column, header, separators, quotes, sizes)


def parquet_types(data: bytes, rng: Random) -> bytes:
    """Give columns other types, nulls, odd names and metadata; a sound Parquet file all the same."""
    try:
        table = pq.read_table(pa.BufferReader(data))
    except Exception:  # the base is broken already; what broke it is not of interest here
        return data
    names, arrays = list(table.column_names), [table.column(k).combine_chunks() for k in range(table.num_columns)]
    for _ in range(rng.choice((1, 1, 2))):
        if not arrays:
            break
        k, n = rng.randrange(len(arrays)), len(arrays[0])
        arrays[k] = _array(n, rng) if rng.random() < 0.8 else arrays[k]
        if rng.random() < 0.4:
            names[k] = word(rng)
    if rng.random() < 0.2:
        names.append(rng.choice(names) if names else "t")
        arrays.append(_array(len(arrays[0]) if arrays else 3, rng))
    out = io.BytesIO()
    try:
        made = pa.Table.from_arrays(arrays, names=names)
        meta = {b"pandas": rng.choice((b"", b"{}", b"null", b"[1]", b'{"columns": 3}'))} if rng.random() < 0.3 else None
        pq.write_table(made.replace_schema_metadata(meta), out, row_group_size=rng.choice((1, 7, 1000)))
    except (pa.ArrowException, OSError, ValueError):
        return data
    return out.getvalue()


def _array(n: int, rng: Random) -> pa.Array:
    wide = np.arange(n)
    makes = (
        lambda: pa.array([None] * n),
        lambda: pa.array([None] * n, pa.float64()),
        lambda: pa.array([value(rng) for _ in range(n)]),
        lambda: pa.array(["0.1"] * n).dictionary_encode(),
        lambda: pa.array([b"\xff"] * n),
        lambda: pa.array([[1.0, 2.0]] * n),
        lambda: pa.array([{"a": 1}] * n),
        lambda: pa.array(wide % 2 == 0),
        lambda: pa.array(wide, pa.timestamp(rng.choice(("s", "ns")))),
        lambda: pa.array(wide * 10**15, pa.timestamp("s")),
        lambda: pa.array(wide, pa.duration("ns")),
        lambda: pa.array(wide.astype(np.int32), pa.date32()),
        lambda: pa.array(wide.astype(np.int32) * 10**5, pa.date32()),
        lambda: pa.array(wide, pa.uint64()),
        lambda: pa.array(wide.astype(np.float16)),
        lambda: pa.array(wide).cast(pa.decimal128(38, 10)),
        lambda: pa.array([float(x) for x in rng.choices((1e308, -1e308, float("nan"), float("inf"), 0.0), k=n)]),
        lambda: pa.array(np.where(wide % 3 == 0, None, wide.astype(object)).tolist()),
    )
    return rng.choice(makes)()


PARQUET = (parquet_types, parquet_types)
