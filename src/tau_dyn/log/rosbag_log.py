"""ROS 1 bags and ROS 2 bags (extra `rosbag`), through the pure Python library `rosbags`.

A `.bag` file is ROS 1; a folder with `metadata.yaml`, or one `.db3` file, is ROS 2. A folder that holds MCAP files goes to
`mcap_log.py`. No ROS has to be installed: the message definitions are in the bag, or are those of a recent ROS 2.
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml
from tau_dyn.log.messages import Recorded, table_of_messages
from tau_dyn.log.table import Table

METADATA = "metadata.yaml"
LARGEST_CHUNK = 2**28
"""A chunk of a ROS 1 bag larger than this [bytes] is not opened."""


def is_bag_folder(path: Path) -> bool:
    """Tell whether a folder is a ROS 2 bag."""
    return path.is_dir() and (path / METADATA).is_file()


def read_bag(path: Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a ROS bag as a table on its main topic's clock.

    Args:
        path: A `.bag` or `.db3` file, or a bag's folder.
        wanted: The columns that a map asks for, by our names; None without a map.

    Raises:
        InputError: The extra is missing, the bag is damaged, or it is not clear what in it is the log.
    """
    files = _files(path)
    if files and all(file.suffix == ".mcap" for file in files):
        from tau_dyn.log.mcap_log import read_mcap

        return read_mcap(path, wanted, files)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError("reading ROS bags needs an extra: pip install 'tau_dyn[rosbag]'.") from None
    with ExitStack() as stack:
        try:
            types = get_typestore(Stores.LATEST)
            reader = stack.enter_context(AnyReader([path], default_typestore=types))
            _bound(reader)
            kinds = {c.topic: c.msgtype for c in reader.connections}
        except Exception as fault:  # a bag that is damaged breaks its reader in many ways
            raise _damaged(path, fault) from None
        return table_of_messages(path, files or (path,), _messages(path, reader), kinds, wanted, [])


def _files(path: Path) -> tuple[Path, ...]:
    """Return the files of a bag's folder, as its metadata lists them; a file alone is its own."""
    if not path.is_dir():
        return (path,)
    content = read_yaml(path / METADATA)
    found = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    about = found if isinstance(found, dict) else {}
    names = about.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise InputError(f"{path / METADATA} does not list the bag's files; 'ros2 bag reindex' writes it anew.")
    if str(about.get("compression_mode") or "none").lower() != "none" or any(n.endswith(".zstd") for n in names):
        raise InputError(
            f"{path.name} is compressed as a whole, which is not read; 'ros2 bag convert' writes it plainly."
        )
    files = tuple(path / Path(n).name for n in names)
    missing = next((f for f in files if not f.is_file()), None)
    if missing is not None:
        raise InputError(f"{path.name} lacks {missing.name}, which its {METADATA} lists; give the whole folder.")
    return files


def _messages(path: Path, reader: Any) -> Iterator[Recorded]:
    stream = reader.messages()
    while True:
        try:
            connection, log, data = next(stream)
        except StopIteration:
            return
        except Exception as fault:
            raise _damaged(path, fault) from None
        yield Recorded(connection.topic, connection.msgtype, log, _decoder(path, reader, connection, data))


def _decoder(path: Path, reader: Any, connection: Any, data: bytes) -> Callable[[], Any]:
    def decode() -> Any:
        try:
            return reader.deserialize(data, connection.msgtype)
        except Exception as fault:  # definitions and messages come from the file
            raise InputError(
                f"{path.name}: a message of {connection.topic} cannot be decoded ({_words(fault)})."
            ) from None

    return decode


def _bound(reader: Any) -> None:
    """Let no chunk of a ROS 1 bag grow beyond bounds when it is decompressed."""
    for one in reader.readers:
        chunks = getattr(one, "chunks", {})
        for key, chunk in chunks.items():
            chunks[key] = chunk._replace(decompressor=_bounded(chunk.decompressor))


def _bounded(decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    def bounded(data: bytes) -> bytes:
        if data[:3] == b"BZh":
            plain = bz2.BZ2Decompressor().decompress(data, LARGEST_CHUNK + 1)
        elif data[:4] == b"\x04\x22\x4d\x18":
            import lz4.frame

            plain = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=LARGEST_CHUNK + 1)
        else:
            plain = decompress(data) if len(data) <= LARGEST_CHUNK else b"\0" * (LARGEST_CHUNK + 1)
        if len(plain) > LARGEST_CHUNK:
            raise ValueError(f"a chunk is larger than {LARGEST_CHUNK / 2**20:.0f} MB")
        return plain

    return bounded


def _damaged(path: Path, fault: Exception) -> InputError:
    remedy = "'ros2 bag reindex' or 'rosbag reindex' may mend it"
    return InputError(f"{path.name} cannot be read as a ROS bag ({_words(fault)}); {remedy}.")


def _words(fault: BaseException) -> str:
    text = " ".join(str(fault).split()).rstrip(".")
    return text[:120] or type(fault).__name__
