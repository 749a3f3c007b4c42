"""MCAP files (extra `mcap`): JSON messages, and ROS 2 messages in CDR whose definition the file carries.

This module finds the frames of the records, and the `mcap` library reads them. So each record is checked against the remaining
size of the file before it is loaded, and a compressed chunk against the size that it declares. Chunks are checked by their
checksums. A file without an end (the recorder lost power) is read up to the point where it breaks off. Reference: the MCAP
specification, mcap.dev/spec.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from tau_dyn.exceptions import InputError
from tau_dyn.log.table import DecompressionLimit, Table
from tau_dyn.log.topics import Recorded, build_message_table, describe_fault

MAX_CHUNK_BYTES = 2**28
"""A chunk larger than this [bytes] is not opened; recorders write chunks of a few MB."""

MAX_DEFINITION_BYTES = 2**20
"""A message definition longer than this [bytes] is not parsed."""

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_BROKEN = -1
"""Code for the missing end of a file, with a sentence."""
_FRAME = struct.Struct("<BQ")


def read_mcap(path: Path, wanted: Mapping[str, str] | None = None, files: Sequence[Path] = ()) -> Table:
    """Read an MCAP file, or several that follow each other, as a table on its main topic's clock.

    Args:
        path: The file, or the folder that `files` are in.
        wanted: The columns that a map asks for, by our names; None without a map.
        files: The files, in order; by default `path` alone.

    Raises:
        InputError: The extra is missing, the file is damaged, or it is ambiguous which part is the log.
    """
    _library()
    paths = tuple(files) or (path,)
    kinds: dict[str, str] = {}
    for file in paths:
        kinds |= {m.topic: m.kind for m in _messages(file) if isinstance(m, Recorded)}
    if not kinds:
        raise InputError("damaged_file", f"{path.name} is an MCAP file without messages; record it again.")
    messages = (message for file in paths for message in _messages(file))
    return build_message_table(path, paths, messages, kinds, wanted)


def _library() -> None:
    try:
        import mcap.records  # noqa: F401
        import mcap_ros2.decoder  # noqa: F401
    except ImportError:
        raise InputError("missing_package", "reading MCAP files needs an extra: pip install 'tau_dyn[mcap]'.") from None


def _messages(path: Path) -> Iterator[Recorded | str]:
    """Yield a file's messages in their order, and a sentence if the file breaks off."""
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    decoders = _Decoders(path.name)
    for opcode, record in _records(path):
        if opcode == _BROKEN:
            yield record
        elif opcode == _SCHEMA:
            schemas[record.id] = record
        elif opcode == _CHANNEL:
            channels[record.id] = record
        elif record.channel_id in channels:
            channel = channels[record.channel_id]
            schema = schemas.get(channel.schema_id)
            decode = decoders.of(channel, schema, record.data)
            kind, log = schema.name if schema else "", min(record.log_time, 2**63 - 1)
            yield Recorded(channel.topic, kind, log, len(record.data), decode)


def _records(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield schemas, channels and messages with their kind, chunks opened."""
    from mcap.exceptions import McapError

    try:
        with path.open("rb") as file:
            yield from _framed(path, file)
    except InputError:
        raise
    except (McapError, ValueError, struct.error, EOFError, MemoryError, OverflowError) as fault:
        raise InputError(
            "damaged_file", f"{path.name} is damaged: {describe_fault(fault)}; 'mcap recover' may save the rest of it."
        ) from None


def _framed(path: Path, file: BinaryIO) -> Iterator[tuple[int, Any]]:
    size = path.stat().st_size
    if file.read(len(_MAGIC)) != _MAGIC:
        raise InputError(
            "file_format",
            f"{path.name} is not an MCAP file (it does not begin as one); give CSV another suffix than .mcap.",
        )
    opcode, inflated = 0, DecompressionLimit(path)
    while opcode != _DATA_END:
        frame = file.read(_FRAME.size)
        opcode, length = _FRAME.unpack(frame) if len(frame) == _FRAME.size else (0, 1)
        if length > size - file.tell():
            yield _BROKEN, f"{path.name} breaks off before its end; it is read to there, and what came after is lost."
            return
        if opcode == _CHUNK:
            yield from _inside(_opened(path.name, file.read(length), inflated))
        elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
            yield opcode, _read(opcode, file.read(length))
        else:
            file.seek(length, 1)


def _read(opcode: int, data: bytes) -> Any:
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Message, Schema

    stream = ReadDataStream(BytesIO(data))
    if opcode == _MESSAGE:
        return Message.read(stream, len(data))
    return Schema.read(stream) if opcode == _SCHEMA else Channel.read(stream)


def _inside(plain: bytes) -> Iterator[tuple[int, Any]]:
    """Yield a chunk's schemas, channels and messages one by one; a list would take many times their bytes."""
    at = 0
    while at < len(plain):
        opcode, length = _FRAME.unpack_from(plain, at)
        at += _FRAME.size
        if length > len(plain) - at:
            raise ValueError("a record is longer than its chunk")
        if opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
            yield opcode, _read(opcode, plain[at : at + length])
        at += length


def _opened(name: str, data: bytes, inflated: DecompressionLimit) -> bytes:
    """Return the content of a chunk; it is decompressed no further than the size it declares."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk

    chunk = Chunk.read(ReadDataStream(BytesIO(data)))
    if chunk.uncompressed_size > MAX_CHUNK_BYTES:
        raise InputError(
            "file_too_large",
            f"{name} has a chunk of {chunk.uncompressed_size / 2**20:.0f} MB; chunks up to {MAX_CHUNK_BYTES / 2**20:.0f} MB are "
            "opened; write it again with 'mcap filter'.",
        )
    inflated.take(chunk.uncompressed_size)
    plain = _decompressed(name, chunk.compression, chunk.data, chunk.uncompressed_size)
    if len(plain) != chunk.uncompressed_size:
        raise ValueError(f"a chunk does not have the {chunk.uncompressed_size} bytes that it declares")
    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):
        raise ValueError("the checksum of a chunk is wrong")
    return plain


def _decompressed(name: str, kind: str, data: bytes, size: int) -> bytes:
    """Return at most one byte more than `size`."""
    if kind == "":
        return data
    import lz4.frame
    import zstandard

    try:
        if kind == "zstd":
            return zstandard.ZstdDecompressor().stream_reader(BytesIO(data)).read(size + 1)
        if kind == "lz4":
            return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as fault:  # RuntimeError is lz4's
        raise ValueError(f"a chunk cannot be decompressed ({describe_fault(fault)})") from None
    raise InputError(
        "unsupported",
        f"{name} has chunks compressed by '{kind[:20]}', which is not read; write it again with zstd or lz4.",
    )


class _Whole(bytes):
    """A message that refuses to be read beyond its end; for lists of bytes, the decoder does not check the length."""

    def __getitem__(self, key: Any) -> Any:
        """Return a byte, or a slice that is complete."""
        if isinstance(key, slice) and (key.stop or 0) > len(self):
            raise ValueError("it is shorter than its definition")
        return super().__getitem__(key)


class _Decoders:
    """Decodes messages by their channel's encoding."""

    def __init__(self, name: str) -> None:
        from mcap_ros2.decoder import DecoderFactory

        self.name, self._ros2 = name, DecoderFactory()

    def of(self, channel: Any, schema: Any, data: bytes) -> Callable[[], Any]:
        """Return a function that decodes a message when called."""
        return lambda: self._decoded(channel, schema, data)

    def _decoded(self, channel: Any, schema: Any, data: bytes) -> Any:
        encoding = channel.message_encoding
        try:
            if encoding == "json":
                return json.loads(data)
            if schema is not None and len(schema.data) > MAX_DEFINITION_BYTES:
                raise ValueError(f"its definition has {len(schema.data)} bytes")
            decoder = self._ros2.decoder_for(encoding, schema)
            if decoder is not None:
                return decoder(_Whole(data))
        except Exception as fault:  # definitions and messages come from the file: all errors are its fault
            raise InputError(
                "damaged_file",
                f"{self.name}: a message of {channel.topic} cannot be decoded ({describe_fault(fault)}).",
            ) from None
        definition = f" with a definition in {schema.encoding}" if schema is not None and schema.encoding else ""
        raise InputError(
            "unsupported",
            f"{self.name}: messages of {channel.topic} are encoded as '{encoding[:20]}'{definition}; json, and cdr with a "
            "definition in ros2msg, are read.",
        )
