"""ROS 1 bags and ROS 2 bags (extra `rosbag`), through the pure Python library `rosbags`.

A `.bag` file is ROS 1; a folder with `metadata.yaml`, or one `.db3` file, is ROS 2. A folder that holds MCAP files goes to
`mcap_log.py`. No ROS has to be installed: the message definitions are in the bag, or are those of a recent ROS 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml
from tau_dyn.log.bag_checks import check_database, check_definitions, check_profiles, limit_decompression
from tau_dyn.log.decompression_limit import DecompressionLimit
from tau_dyn.log.messages import Recorded, build_message_table, describe_fault
from tau_dyn.log.table import Table

METADATA = "metadata.yaml"


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
        except Exception as fault:  # a bag that is damaged breaks its reader in many ways
            raise _damaged(path, fault) from None
        return build_message_table(path, files, _messages(path, reader), kinds, wanted, [])


def _files(path: Path) -> tuple[tuple[Path, ...], bool]:
    """Return the files of a bag's folder, as its metadata lists them, and whether they are MCAP; a file alone is its own."""
    if not path.is_dir():
        return (path,), False
    content = read_yaml(path / METADATA)
    found = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    about = found if isinstance(found, dict) else {}
    names = about.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise InputError(
            "damaged_file", f"{path / METADATA} does not list the bag's files; 'ros2 bag reindex' writes it anew."
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
        except Exception as fault:  # as above: whatever a damaged bag breaks
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
    """Let the chunks of a ROS 1 bag not grow beyond bounds when they are decompressed."""
    inflated = DecompressionLimit(path)
    for one in reader.readers:
        chunks = getattr(one, "chunks", {})
        for key, chunk in chunks.items():
            chunks[key] = chunk._replace(decompressor=limit_decompression(chunk.decompressor, inflated))


def _damaged(path: Path, fault: Exception) -> InputError:
    remedy = "'ros2 bag reindex' or 'rosbag reindex' may mend it"
    return InputError("damaged_file", f"{path.name} cannot be read as a ROS bag ({describe_fault(fault)}); {remedy}.")
