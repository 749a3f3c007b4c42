"""Mutations of binary records in MCAP, bags, MATLAB files and databases: sizes, kinds and contents lie, frames still fit."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from contextlib import closing
from random import Random

from fuzz_parts import mutate_bytes, mutate_trees
from fuzz_parts.hostile import value, word

_EXTREMES = (
    0,
    1,
    2,
    3,
    7,
    64,
    127,
    128,
    255,
    256,
    4095,
    65535,
    2**24,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**53,
    2**63 - 1,
    2**64 - 1,
)

DEFINITIONS = (
    b"float64 data\nfloat64 t\n",
    b"string[] name\nfloat64[] position\nfloat64[] effort\n",
    b"uint8[1] data\n" + b"=" * 80 + b"\nMSG: a/Leaf\nuint8[4] x\n",
    b"a/Leaf[] data\n" + b"=" * 80 + b"\nMSG: a/Leaf\nuint8[4] x\n",
    b"a/Leaf[1000000000] data\n" + b"=" * 80 + b"\nMSG: a/Leaf\nfloat64[0] x\n",
    b"string[100000000] name\n",
    b"a/Self data\n" + b"=" * 80 + b"\nMSG: a/Self\na/Self again\n",
    b"wstring data\nint8 X=9999999999999999999999\n",
    b"float64 def\nfloat64 class\nfloat64 __slots__\n",
)
"""Message definitions that a decoder may trip over."""


def integers(data: bytes, rng: Random) -> bytes:
    """Overwrite one or some whole numbers of 1 to 8 bytes by odd ones."""
    out = bytearray(data or b" ")
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        width = rng.choice((1, 2, 4, 8))
        a = rng.randrange(max(1, len(out) - width))
        out[a : a + width] = (rng.choice(_EXTREMES) % 2 ** (8 * width)).to_bytes(width, rng.choice(("little", "big")))
    return bytes(out)


def same_length(data: bytes, rng: Random) -> bytes:
    """Replace words of message definitions and headers by others of their length, so that all offsets still hold."""
    tokens = (b"float64[]", b"string[]", b"std_msgs/Header", b"position", b"effort", b"name", b"compression=none", b"op=",
              b"time", b"string frame_id", b"float64 data")  # fmt: skip
    others = (b"float64[0]", b"string[9]", b"Leaf[]", b"uint8[4]", b"time", b"duration", b"a/B[2] c", b"int8", b"#", b"\n",
              b"\xff", b"compression=bz2\x20", b"compression=lz4\x20")  # fmt: skip
    there = [token for token in tokens if token in data]
    if not there:
        return integers(data, rng)
    token = rng.choice(there)
    other = rng.choice(others).ljust(len(token))[: len(token)]
    return data.replace(token, other, rng.choice((1, -1)))


def mcap(data: bytes, rng: Random) -> bytes:
    """Change the records of an MCAP file: their order, number, kinds, texts and numbers; chunks are packed anew."""
    try:
        frames = _opened(_frames(data[8:]))
    except Exception:  # the base is no MCAP file any more, each library says so in its own way
        return integers(data, rng)
    if not frames:
        return integers(data, rng)
    for _ in range(rng.choice((1, 1, 2, 4))):
        k, other = rng.randrange(len(frames)), rng.randrange(len(frames))
        match rng.randrange(8):
            case 0:
                frames[k], frames[other] = frames[other], frames[k]
            case 1:
                frames.insert(k, frames[other])
            case 2 if len(frames) > 1:
                del frames[k]
            case 3:
                frames[k] = (rng.choice((1, 2, 3, 4, 5, 6, 15, 200)), frames[k][1])
            case 4:
                frames[k] = (frames[k][0], integers(frames[k][1], rng))
            case _:
                places = [i for i, (kind, _) in enumerate(frames) if kind in (3, 4, 5)] or [k]
                i = rng.choice(places)
                frames[i] = (frames[i][0], _content(*frames[i], rng))
    return data[:8] + b"".join(_packed(frames, rng)) + data[:8]


def _frames(data: bytes) -> list[tuple[int, bytes]]:
    found, at = [], 0
    while at + 9 <= len(data) and data[at] != 0x02:
        kind, size = struct.unpack_from("<BQ", data, at)
        found.append((kind, data[at + 9 : at + 9 + size]))
        at += 9 + size
    if not found:
        raise ValueError
    return found


def _opened(frames: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return frames with those in chunks at their place, and no index."""
    found: list[tuple[int, bytes]] = []
    for kind, payload in frames:
        if kind != 0x06:
            found += [(kind, payload)] if kind in (1, 3, 4, 5, 15) else []
            continue
        (size,) = struct.unpack_from("<I", payload, 28)
        how, records = payload[32 : 32 + size], payload[40 + size :]
        found += _frames(_plain(how, records))
    return found


def _plain(how: bytes, data: bytes) -> bytes:
    if how == b"zstd":
        import zstandard

        return zstandard.ZstdDecompressor().decompress(data, max_output_size=2**20)
    if how == b"lz4":
        import lz4.frame

        return lz4.frame.decompress(data)
    return data


def _content(kind: int, payload: bytes, rng: Random) -> bytes:
    """Return a schema, channel or message with another text in it, its lengths right."""
    if kind == 5:
        return payload[:22] + rng.choice((*mutate_trees.JSON, mutate_bytes.flip))(payload[22:], rng)
    head, texts, at = payload[: 4 if kind == 4 else 2], [], 4 if kind == 4 else 2
    while at + 4 <= len(payload) and len(texts) < 3:
        (size,) = struct.unpack_from("<I", payload, at)
        texts.append(payload[at + 4 : at + 4 + size])
        at += 4 + size
    if not texts:
        return payload
    k = rng.randrange(len(texts))
    odd = (b"json", b"cdr", b"ros2msg", b"ros1msg", b"", b"/", b"sensor_msgs/msg/JointState", b"\xff", *DEFINITIONS)
    texts[k] = rng.choice(odd) if rng.random() < 0.6 else word(rng).encode("utf-8", "replace")
    return head + b"".join(struct.pack("<I", len(text)) + text for text in texts) + payload[at:]


def _packed(frames: list[tuple[int, bytes]], rng: Random) -> list[bytes]:
    whole = [struct.pack("<BQ", kind, len(payload)) + payload for kind, payload in frames]
    how = rng.choice((b"", b"none", b"zstd", b"lz4", b"zlib", b""))
    if not how:
        return whole
    inside = b"".join(whole[1:])
    size = len(inside) if rng.random() < 0.8 else rng.choice(_EXTREMES)
    data = _pressed(how, inside)
    data = data if rng.random() < 0.8 else integers(data, rng)
    how = b"" if how == b"none" else how
    crc = rng.choice((0, 0, zlib.crc32(inside), 7))
    head = struct.pack("<QQQII", 0, 2**63, size, crc, len(how)) + how + struct.pack("<Q", len(data))
    return [whole[0], struct.pack("<BQ", 6, len(head + data)) + head + data]


def _pressed(how: bytes, data: bytes) -> bytes:
    if how == b"zstd":
        import zstandard

        return zstandard.ZstdCompressor().compress(data)
    if how == b"lz4":
        import lz4.frame

        return lz4.frame.compress(data)
    return data


def mat(data: bytes, rng: Random) -> bytes:
    """Change a MATLAB file's tags and contents, or pack its variables; some are put into cells inside each other."""
    order = ">" if data[126:128] == b"MI" else "<"
    out, at = [data[:128]], 128
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        inside = data[at + 8 : at + 8 + size]
        at += 8 + size
        if kind == 15 and rng.random() < 0.5:
            try:
                whole = zlib.decompressobj().decompress(inside, 2**20)
                kind, inside = struct.unpack_from(f"{order}I", whole)[0], whole[8:]
            except (zlib.error, struct.error):
                pass
        match rng.randrange(6):
            case 0:
                inside = integers(inside, rng)
            case 1 if kind == 14:
                inside = in_cells(inside, rng.choice((1, 2, 40)), order)
            case 2 if kind == 14:
                whole = struct.pack(f"{order}II", 14, len(inside)) + inside
                kind, inside = 15, zlib.compress(whole)
            case 3:
                out.append(struct.pack(f"{order}II", kind, len(inside)) + inside)
        out.append(struct.pack(f"{order}II", kind, len(inside)) + inside)
    return b"".join(out)


def in_cells(matrix: bytes, depth: int, order: str) -> bytes:
    """Return a MATLAB array inside so many cells."""
    for _ in range(depth):
        head = struct.pack(f"{order}IIII", 6, 8, 1, 0) + struct.pack(f"{order}IIii", 5, 8, 1, 1)
        name = struct.pack(f"{order}II", 1, 1) + b"c".ljust(8, b"\0")
        matrix = head + name + struct.pack(f"{order}II", 14, len(matrix)) + matrix
    return matrix


_SQL = (
    "UPDATE topics SET {column} = ? WHERE id = 1",
    "UPDATE topics SET {column} = ?",
    "UPDATE messages SET timestamp = ? WHERE id = 5",
    "UPDATE messages SET timestamp = ?",
    "UPDATE messages SET data = ? WHERE id = 3",
    "UPDATE messages SET topic_id = ? WHERE id < 9",
    "UPDATE message_definitions SET encoded_message_definition = ?",
    "UPDATE message_definitions SET encoding = ?",
    "UPDATE message_definitions SET topic_type = ?",
    "UPDATE schema SET schema_version = ?",
    "DELETE FROM messages WHERE id > ?",
    "DELETE FROM topics WHERE id = ?",
    "INSERT INTO topics SELECT 9, ?, type, serialization_format, offered_qos_profiles, type_description_hash FROM topics LIMIT 1",
)
_TABLES = ("messages", "topics", "schema", "message_definitions", "metadata")


def database(data: bytes, rng: Random) -> bytes:
    """Change rows and tables of a ROS 2 bag's database with SQL; a sound database all the same."""
    with closing(sqlite3.connect(":memory:")) as base:
        try:
            base.deserialize(data)
            for _ in range(rng.choice((1, 1, 2))):
                _statement(base, rng)
            base.commit()
            return base.serialize()
        except (sqlite3.Error, OverflowError, UnicodeError):  # the base is no database any more
            return data


def _statement(base: sqlite3.Connection, rng: Random) -> None:
    columns = ("name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash", "id")
    odd = (
        None,
        0,
        -1,
        1.5,
        4,
        2,
        1,
        2**63 - 1,
        "cdr",
        "ros2msg",
        "ros2idl",
        b"\xff\x00",
        "[[" * 40,
        "a: &a [*a]",
        value(rng),
        word(rng),
    )
    table = rng.choice(_TABLES)
    match rng.randrange(8):
        case 0:
            base.execute(f"DROP TABLE {table}")
        case 1:
            base.execute(f"ALTER TABLE {table} RENAME TO {rng.choice(('other', 'old'))}")
            base.execute(f"CREATE VIEW {table} AS SELECT * FROM {rng.choice(('other', 'old'))}")
        case 2:
            text = rng.choice(DEFINITIONS).decode()
            base.execute("UPDATE message_definitions SET encoded_message_definition = ?", (text,))
            base.execute("UPDATE topics SET type_description_hash = ''")
        case _:
            base.execute(rng.choice(_SQL).format(column=rng.choice(columns)), (rng.choice(odd),))


MCAP = (mcap, mcap, integers)
BAG = (integers, integers, same_length)
MAT = (mat, mat, integers)
DATABASE = (database, database, integers)
