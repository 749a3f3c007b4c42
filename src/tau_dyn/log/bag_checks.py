"""What a ROS bag has to be before the library `rosbags` reads it; that library believes databases, definitions and sizes.

A database may hold views and columns that compute without end; a message definition may ask for code of a hundred million lines,
or for lists of entries that take no bytes, of which any message has as many as it likes.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import yaml

from tau_dyn.files import YAML_FAULTS, PlainLoader
from tau_dyn.log.decompression_limit import DecompressionLimit

MAX_DEFINITION_BYTES = 2**20
"""All message definitions of a bag together [bytes]."""

MAX_UNROLLED_ENTRIES = 10_000
"""Entries of fixed arrays of texts or messages in all definitions together; each becomes lines of code."""

MAX_TOPICS = 10_000  # bounds the time on a hostile file

_FILLER = "structure_needs_at_least_one_member"
"""What the library puts into an empty message; in ROS 1 it takes no bytes."""

_COMPUTES = re.compile(r"\b(as|virtual)\b", re.IGNORECASE)
_ASIDE = re.compile(r'"(?:\\.|[^"\\])*"|/\*.*?\*/|//[^\n]*', re.DOTALL)


def check_database(path: Path) -> None:
    """Refuse a ROS 2 database that is more than plain tables.

    Raises:
        ValueError: It computes what it holds, its definitions are too long, or settings of a topic are no plain YAML.
        sqlite3.Error: It is no database.
    """
    if set("?%#") & set(str(path)):
        raise ValueError("its path has one of ? % #, by which databases are opened otherwise; rename it")
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as base:
        tables = base.execute("SELECT type, name, sql FROM sqlite_master LIMIT 1000").fetchall()
        for kind, name, sql in tables:
            if kind not in ("table", "index") or _COMPUTES.search(str(sql or "")):
                raise ValueError(f"{name} is not stored but computed")
        columns = {name: {row[1] for row in base.execute(f"PRAGMA table_info({name})")} for name in _tables(tables)}
        if "encoded_message_definition" in columns.get("message_definitions", ()):
            _check_texts(base)
        if "offered_qos_profiles" in columns.get("topics", ()):
            for (profiles,) in base.execute(f"SELECT offered_qos_profiles FROM topics LIMIT {MAX_TOPICS + 1}"):
                check_profiles(profiles)
        if "topics" in columns and base.execute("SELECT count(*) FROM topics").fetchone()[0] > MAX_TOPICS:
            raise ValueError(f"it has more than {MAX_TOPICS} topics")


def check_profiles(profiles: Any) -> None:
    """Refuse settings of a topic that would fill the stack when they are read.

    Raises:
        ValueError: Text that is no plain YAML.
    """
    if not isinstance(profiles, str) or not profiles:
        return
    try:
        if len(profiles) > MAX_DEFINITION_BYTES:
            raise yaml.YAMLError("too long")
        yaml.load(profiles, Loader=PlainLoader)  # noqa: S506
    except YAML_FAULTS:
        raise ValueError("the settings of a topic are no plain YAML") from None


def check_definitions(definitions: Mapping[str, Any]) -> None:
    """Refuse message definitions, as the library parsed them, that any message could make endless.

    Args:
        definitions: Constants and fields by the type's name.

    Raises:
        ValueError: Arrays without length or of far too many entries; lists of entries that take no bytes.
    """
    from rosbags.interfaces import Nodetype

    known: dict[str, bool] = {}

    def empty(name: str) -> bool:
        """Tell whether a message of this type may take no bytes."""
        if name not in known:
            known[name] = False  # one that holds itself never ends, and says so when it is read
            fields = definitions[name][1] if name in definitions else (("unknown", (0, ())),)
            known[name] = all(label == _FILLER or nothing(field) for label, field in fields)
        return known[name]

    def nothing(field: Any) -> bool:
        kind, about = field
        if kind == Nodetype.ARRAY:
            return nothing(about[0])
        return kind == Nodetype.NAME and empty(about)

    unrolled = 0
    for name, (_, fields) in definitions.items():
        for label, (kind, about) in fields:
            if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                continue
            inside, length = about
            simple = inside[0] == Nodetype.BASE and inside[1][0] != "string"
            if kind == Nodetype.ARRAY:
                unrolled += 0 if simple else length
            if (kind == Nodetype.ARRAY and not 1 <= length <= 2**24) or unrolled > MAX_UNROLLED_ENTRIES:
                raise ValueError(f"{label} of {name} is an array of {length}")
            if nothing(inside):
                raise ValueError(f"{label} of {name} is a list of messages that hold nothing")


def limit_decompression(decompress: Callable[[bytes], bytes], inflated: DecompressionLimit) -> Callable[[bytes], bytes]:
    """Return what opens a chunk of a ROS 1 bag no further than bounds; opening one again counts again."""

    def opened(data: bytes) -> bytes:
        if data[:3] == b"BZh":
            import bz2

            plain = bz2.BZ2Decompressor().decompress(data, inflated.left + 1)
        elif data[:4] == b"\x04\x22\x4d\x18":
            import lz4.frame

            plain = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=inflated.left + 1)
        else:
            plain = data if len(data) > inflated.left else decompress(data)
        inflated.take(len(plain))
        return plain

    return opened


def _tables(rows: list[tuple[str, str, str]]) -> list[str]:
    known = ("topics", "message_definitions")
    return [name for kind, name, _ in rows if kind == "table" and name in known]


def _check_texts(base: sqlite3.Connection) -> None:
    """Refuse definitions that take long to parse: too long, or in IDL with arithmetic in parentheses, or with shifts."""
    (size,) = base.execute("SELECT sum(length(encoded_message_definition)) FROM message_definitions").fetchone()
    if size and size > MAX_DEFINITION_BYTES:
        raise ValueError(f"its message definitions have {size} bytes")
    for (text,) in base.execute("SELECT encoded_message_definition FROM message_definitions"):
        depth, plain = 0, _ASIDE.sub("", str(text))
        for sign in re.findall(r"[()]", plain) if "module" in plain else ():
            depth += 1 if sign == "(" else -1
            if depth > 1:
                raise ValueError("a definition in IDL computes in parentheses")
        if "<<" in plain:
            raise ValueError("a definition in IDL shifts numbers")
