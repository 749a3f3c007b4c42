"""Mutations of any file: bits, stretches and lines moved, lost, repeated or replaced."""

from __future__ import annotations

from random import Random

from fuzz_parts.hostile import GARBAGE, value

LARGEST = 2**18
"""Bytes beyond which a mutated file is cut."""


def flip(data: bytes, rng: Random) -> bytes:
    """Change a few bytes."""
    out = bytearray(data or b" ")
    for _ in range(rng.choice((1, 1, 2, 8))):
        out[rng.randrange(len(out))] = rng.randrange(256)
    return bytes(out)


def cut(data: bytes, rng: Random) -> bytes:
    """End the file early."""
    return data[: rng.randrange(len(data) + 1)]


def drop(data: bytes, rng: Random) -> bytes:
    """Take a stretch out."""
    a = rng.randrange(len(data) + 1)
    return data[:a] + data[a + rng.choice((1, 1, 4, 40)) :]


def repeat(data: bytes, rng: Random) -> bytes:
    """Repeat a stretch, sometimes often."""
    a, b = sorted((rng.randrange(len(data) + 1), rng.randrange(len(data) + 1)))
    return data[:b] + data[a:b] * rng.choice((1, 1, 2, 50)) + data[b:]


def insert(data: bytes, rng: Random) -> bytes:
    """Put garbage or a hostile value somewhere."""
    a = rng.randrange(len(data) + 1)
    return data[:a] + (rng.choice(GARBAGE) if rng.random() < 0.5 else value(rng).encode()) + data[a:]


def lines(data: bytes, rng: Random) -> bytes:
    """Swap, repeat, lose or blank lines."""
    rows = data.split(b"\n")
    a, b = rng.randrange(len(rows)), rng.randrange(len(rows))
    match rng.randrange(4):
        case 0:
            rows[a], rows[b] = rows[b], rows[a]
        case 1:
            rows.insert(a, rows[b])
        case 2:
            del rows[a]
        case _:
            rows[a] = b""
    return b"\n".join(rows)


def line_ends(data: bytes, rng: Random) -> bytes:
    """Use other line ends, or mix them."""
    ends = rng.choice(((b"\r\n",), (b"\r",), (b"\n", b"\r\n", b"\r"), (b"\n\r",)))
    return b"".join(row + rng.choice(ends) for row in data.split(b"\n"))


def recode(data: bytes, rng: Random) -> bytes:
    """Write the text in another coding, or with a byte order mark."""
    text = data.decode("utf-8", "replace")
    coding = rng.choice(("utf-8-sig", "utf-16", "utf-16-le", "utf-32", "latin-1", "cp037"))
    return text.encode(coding, "replace")


def splice(data: bytes, other: bytes, rng: Random) -> bytes:
    """Begin as one file and go on as another."""
    return data[: rng.randrange(len(data) + 1)] + other[rng.randrange(len(other) + 1) :]


ANY = (flip, cut, drop, repeat, insert, lines)
TEXT = (*ANY, line_ends, recode)
