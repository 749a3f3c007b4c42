"""ROS 1 bags and ROS 2 bags (extra `rosbag`), through the pure Python library `rosbags`, with checks of hostile bags.

A `.bag` file is ROS 1; a folder with `metadata.yaml`, or one `.db3` file, is ROS 2. A folder that holds MCAP files goes to
`mcap_log.py`. No ROS has to be installed: the message definitions are in the bag, or are those of a recent ROS 2.

The library trusts databases, definitions and sizes. A database may hold views and columns that compute without end. A
message definition may require code of a hundred million lines, or lists of entries that take no bytes, so that a message can
declare any number of them. Such bags are refused before the library reads them.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import yaml

from tau_dyn.exceptions import InputError
from tau_dyn.files import YAML_FAULTS, PlainLoader, read_yaml
from tau_dyn.log.table import DecompressionLimit, Table
from tau_dyn.log.topics import Recorded, build_message_table, describe_fault

MAX_DEFINITION_BYTES = 2**20
"""All message definitions of a bag together [bytes]."""

MAX_UNROLLED_ENTRIES = 10_000
"""Entries of fixed arrays of texts or messages in all definitions together; each becomes lines of code."""

MAX_TOPICS = 10_000  # bounds the time on a hostile file

_FILLER = "structure_needs_at_least_one_member"
"""Field that the library puts into an empty message; in ROS 1 it takes no bytes."""

_COMPUTES = re.compile(r"\b(as|virtual)\b", re.IGNORECASE)
_ASIDE = re.compile(r'"(?:\\.|[^"\\])*"|/\*.*?\*/|//[^\n]*', re.DOTALL)


def check_database(path: Path) -> None:
    """Refuse a ROS 2 database that is more than plain tables.

    Raises:
        ValueError: It has computed tables or columns, its definitions are too long, or settings of a topic are no plain YAML.
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
    """Refuse parsed message definitions by which a message could be endless.

    Args:
        definitions: Constants and fields by the type's name.

    Raises:
        ValueError: Arrays without length or of far too many entries; lists of entries that take no bytes.
    """
    from rosbags.interfaces import Nodetype

    known: dict[str, bool] = {}

    def empty(name: str) -> bool:
        """Return whether a message of this type may take no bytes."""
        if name not in known:
            known[name] = False  # one that contains itself never ends, and raises an error when it is read
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
                raise ValueError(f"{label} of {name} is a list of empty messages")


def limit_decompression(decompress: Callable[[bytes], bytes], inflated: DecompressionLimit) -> Callable[[bytes], bytes]:
    """Return a function that opens a chunk of a ROS 1 bag up to a limit; opening a chunk again counts again."""

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


METADATA = "metadata.yaml"


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


def read_bag(path: Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a ROS bag as a table on its main topic's clock.

    Args:
        path: A `.bag` or `.db3` file, or a bag's folder.
        wanted: The columns that a map asks for, by our names; None without a map.

    Raises:
        InputError: The extra is missing, the bag is damaged, or it is ambiguous which part is the log.
    """
    files, in_mcap = _files(path)
    if in_mcap:
        from tau_dyn.log.mcap_log import read_mcap

        return read_mcap(path, wanted, files)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError("missing_package", "reading ROS bags needs an extra: pip install 'tau_dyn[rosbag]'.") from None
    if path.is_dir() and path.suffix == ".bag":  # by this name the library takes it for a ROS 1 file
        raise InputError(
            "file_format",
            f"{path.name} is a ROS 2 folder called as a ROS 1 file; give it a name that does not end in .bag.",
        )
    with ExitStack() as stack:
        try:
            for file in files:
                if path.is_dir() or file.suffix != ".bag":
                    check_database(file)
            types = get_typestore(Stores.LATEST)
            reader = AnyReader([path], default_typestore=types)
            stack.callback(_close, reader)
            reader.open()
            check_definitions(reader.typestore.fielddefs)
            _bound(path, reader)
            kinds = _kinds(reader)
        except Exception as fault:  # a damaged bag makes its reader fail in many ways
            raise _damaged(path, fault) from None
        return build_message_table(path, files, _messages(path, reader), kinds, wanted)


def _files(path: Path) -> tuple[tuple[Path, ...], bool]:
    """Return the files of a bag's folder from its metadata, and whether they are MCAP; for a file, the file itself."""
    if not path.is_dir():
        return (path,), False
    content = read_yaml(path / METADATA)
    found = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    about = found if isinstance(found, dict) else {}
    names = about.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise InputError(
            "damaged_file", f"{path / METADATA} does not list the bag's files; 'ros2 bag reindex' writes it again."
        )
    if str(about.get("compression_mode") or "none").lower() != "none" or any(n.endswith(".zstd") for n in names):
        raise InputError(
            "unsupported",
            f"{path.name} is compressed as a whole, which is not read; 'ros2 bag convert' writes it plainly.",
        )
    files = tuple(path / Path(n).name for n in names)
    missing = next((f for f in files if not _there(f)), None)
    if missing is not None:
        raise InputError(
            "file_not_found", f"{path.name} lacks {missing.name}, which its {METADATA} lists; give the whole folder."
        )
    _check_topics(path, about)
    return files, about.get("storage_identifier") == "mcap" or all(f.suffix.lower() == ".mcap" for f in files)


def _close(reader: Any) -> None:
    with suppress(Exception):  # damaged metadata may leave anything in it
        reader.close()


def _there(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long, or with a NUL in it
        return False


def _check_topics(path: Path, about: Mapping[str, Any]) -> None:
    rows = about.get("topics_with_message_count")
    for row in rows if isinstance(rows, list) else ():
        topic = row.get("topic_metadata") if isinstance(row, dict) else None
        try:
            check_profiles(topic.get("offered_qos_profiles") if isinstance(topic, dict) else None)
        except ValueError as fault:
            raise _damaged(path, fault) from None


def _kinds(reader: Any) -> dict[str, str]:
    """Return the type of each topic."""
    kinds = {c.topic: c.msgtype for c in reader.connections}
    if not all(isinstance(word, str) for pair in kinds.items() for word in pair):
        raise ValueError("a topic's name or type is no text")
    return kinds


def _messages(path: Path, reader: Any) -> Iterator[Recorded]:
    stream = reader.messages()
    while True:
        try:
            connection, log, data = next(stream)
            if not isinstance(log, int) or not 0 <= log < 2**63 or not isinstance(data, bytes):
                raise ValueError("a message has no time, or is no bytes")
        except StopIteration:
            return
        except InputError:
            raise
        except Exception as fault:  # as above: any failure of the reader
            raise _damaged(path, fault) from None
        yield Recorded(connection.topic, connection.msgtype, log, len(data), _decoder(path, reader, connection, data))


def _decoder(path: Path, reader: Any, connection: Any, data: bytes) -> Callable[[], Any]:
    def decode() -> Any:
        try:
            return reader.deserialize(data, connection.msgtype)
        except Exception as fault:  # definitions and messages come from the file
            raise InputError(
                "damaged_file",
                f"{path.name}: a message of {connection.topic} cannot be decoded ({describe_fault(fault)}).",
            ) from None

    return decode


def _bound(path: Path, reader: Any) -> None:
    """Limit the decompressed size of a ROS 1 bag's chunks."""
    inflated = DecompressionLimit(path)
    for one in reader.readers:
        chunks = getattr(one, "chunks", {})
        for key, chunk in chunks.items():
            chunks[key] = chunk._replace(decompressor=limit_decompression(chunk.decompressor, inflated))


def _damaged(path: Path, fault: Exception) -> InputError:
    remedy = "'ros2 bag reindex' or 'rosbag reindex' may mend it"
    return InputError("damaged_file", f"{path.name} cannot be read as a ROS bag ({describe_fault(fault)}); {remedy}.")
