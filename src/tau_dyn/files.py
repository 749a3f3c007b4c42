"""Bounded reading of files, atomic writing, safe reading of YAML, hashes; every fault is reported in a sentence."""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import select
import shutil
import stat
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from math import inf
from pathlib import Path
from sys import float_info
from typing import Any

import yaml

from tau_dyn.exceptions import InputError, require_kind

_NUMBER = count()
_MAX_NAME_CHARACTERS = 120
"""Characters of a name that its temporary file repeats; file systems allow 255 bytes in all."""

_ADVICE = {
    errno.ENOSPC: "free some space, or name a file on another disk",
    errno.EDQUOT: "free some of your quota, or name a file on another disk",
    errno.EFBIG: "the disk or a limit of this shell (ulimit -f) allows no larger file",
    errno.EROFS: "name a file on a disk that can be written to",
    errno.EACCES: "name a file in a folder that you may write to",
    errno.EPERM: "name a file in a folder that you may write to",
    errno.ENAMETOOLONG: "give it a shorter name",
    errno.EIO: "the disk reports a fault; name a file on another one",
}

MAX_YAML_BYTES = 4 * 2**20
"""[bytes] A model file with its robot is a few hundred kB."""

_MAX_NODES = 10**6
"""Nodes of a YAML file with its aliases written out."""

_MAX_LEVELS = 100  # brackets inside each other; Python's own parser gives up at about 1000
_MAX_NUMBER_CHARACTERS = 400  # of a number in YAML; converting longer ones takes time that grows with the square

_PATIENCE = 10.0
"""[s] How long a pipe may keep silent before anything came through it."""


def read_bytes(path: str | Path, most: int | None = None) -> bytes:
    """Read a file, or a pipe with a writer; a pipe that stays silent is refused after a time limit.

    Args:
        path: A regular file, a link to one, or a pipe such as `/dev/stdin`.
        most: Largest size [bytes]; None for any.

    Raises:
        InputError: The path is a device, a socket or a silent pipe, or the file is larger than `most`.
        OSError: Other faults that `open` reports.
    """
    require_kind(path, str | os.PathLike, "path", "the name of a file")
    if os.path.isdir(path):
        raise IsADirectoryError(21, "is a folder", str(path))
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with os.fdopen(handle, "rb", buffering=0) as file:
        kind = os.fstat(handle)
        if stat.S_ISFIFO(kind.st_mode):
            data = _from_pipe(handle, path, most)
        elif not stat.S_ISREG(kind.st_mode):
            raise InputError("cannot_read", f"{path} is a device or a socket; give a file")
        elif most is not None and kind.st_size > most:
            raise InputError("file_too_large", f"{path} has {kind.st_size} bytes; such a file has {most} at most")
        else:
            data = file.readall()
    return data or b""


def _from_pipe(handle: int, path: str | Path, most: int | None) -> bytes:
    """Read until the writers are done."""
    if not select.select([handle], [], [], _PATIENCE)[0]:
        raise InputError("cannot_read", f"{path} is a pipe without a writer; give a file")
    os.set_blocking(handle, True)
    pieces, size = [], 0
    while piece := os.read(handle, 2**20):
        pieces.append(piece)
        size += len(piece)
        if most is not None and size > most:
            raise InputError("file_too_large", f"{path} gives more than {most} bytes, which such a file has at most")
    return b"".join(pieces)


def compute_sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's bytes, in hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def compute_joint_sha256(digests: Iterable[str]) -> str:
    """Return one hash for all of them: that of a single file, or the hash of the hashes."""
    digests = list(digests)
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


class PlainLoader(yaml.SafeLoader):
    """YAML as plain data: no code, no aliases that grow without bound, no foreign tags.

    xacro adds tags that evaluate expressions to PyYAML's own safe loader; this class has its own table of tags.
    """

    yaml_constructors = yaml.SafeLoader.yaml_constructors.copy()

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping; refuse equal keys, of which PyYAML keeps the last one without a warning."""
        keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key, times in keys.items():
            if times > 1:
                raise yaml.constructor.ConstructorError(None, None, f"key {key} stands twice", node.start_mark)
        return super().construct_mapping(node, deep)

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:  # noqa: N803
        """Open a bracket; PyYAML's time grows with the square of how many are open."""
        if self.flow_level >= _MAX_LEVELS:
            raise yaml.YAMLError(f"brackets are nested more than {_MAX_LEVELS} deep inside each other")
        super().fetch_flow_collection_start(TokenClass)

    def whole_number(self, node: Any) -> int | float:
        """Read a whole number; beyond the range of floats it is infinite, like a number with an exponent."""
        whole = int(self.construct_yaml_int(node))
        return whole if abs(whole) <= float_info.max else (inf if whole > 0 else -inf)

    def get_single_node(self) -> Any:
        """Compose the document; refuse aliases that hold themselves or grow beyond bounds, and endless numbers."""
        node = super().get_single_node()
        _written_out(node, {}, set())
        return node


_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
PlainLoader.add_constructor(_NUMBERS[0], PlainLoader.whole_number)


def _written_out(node: Any, known: dict[int, int], above: set[int]) -> int:
    """Return how many nodes a node has with its aliases written out."""
    if id(node) in above:
        raise yaml.YAMLError("an alias is inside the node that it names")
    if id(node) not in known:
        if isinstance(node, yaml.ScalarNode) and node.tag in _NUMBERS and len(node.value) > _MAX_NUMBER_CHARACTERS:
            raise yaml.YAMLError(
                f"a number of {len(node.value)} characters"
            )  # takes long to read and cannot be printed
        above.add(id(node))
        inside: Any = node.value if isinstance(node, yaml.SequenceNode) else ()
        if isinstance(node, yaml.MappingNode):
            inside = [child for pair in node.value for child in pair]
        known[id(node)] = 1 + sum(_written_out(child, known, above) for child in inside)
        above.discard(id(node))
        if known[id(node)] > _MAX_NODES:
            raise yaml.YAMLError(f"with its aliases written out it has more than {_MAX_NODES} entries")
    return known[id(node)]


YAML_FAULTS = (yaml.YAMLError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError, RecursionError)
"""Exceptions of PyYAML for bad YAML: its own, and others for `2026-13-01`, `!!int ''`, `!!timestamp soon`, long `1:2:..`."""


def read_yaml(path: str | Path) -> Any:
    """Read YAML with a safe loader; faults become sentences."""
    with _yaml_of(path) as text:
        return yaml.load(text, Loader=PlainLoader)  # noqa: S506


def format_yaml(path: str | Path) -> str:
    """Return the text of a YAML file for another loader; it is checked first, so that reading time and size are bounded."""
    with _yaml_of(path) as text:
        yaml.compose(text, Loader=PlainLoader)
        return text


@contextmanager
def _yaml_of(path: str | Path) -> Iterator[str]:
    """Give a YAML file's text; faults of it become sentences."""
    try:
        text = read_bytes(path, MAX_YAML_BYTES).decode("utf-8")
        if text.lstrip().startswith(("<?xml", "<robot", "<mujoco", "<!")):
            raise InputError("file_format", f"{path} is XML, such as a robot file; a YAML file is needed here")
        yield text
    except InputError:
        raise
    except FileNotFoundError as fault:
        raise InputError("file_not_found", f"{path}: no such file") from fault
    except UnicodeDecodeError as fault:
        raise InputError("cannot_read", f"{path} is no text in UTF-8; a YAML file is needed here") from fault
    except OSError as fault:
        raise InputError(
            "cannot_read", f"{path}: cannot be read ({fault.strerror}); a YAML file is needed here"
        ) from fault
    except YAML_FAULTS as fault:
        mark, problem = getattr(fault, "problem_mark", None), getattr(fault, "problem", None) or str(fault)
        line = "" if mark is None else f", line {mark.line + 1}"
        raise InputError("file_format", f"{path}{line}: not valid YAML ({' '.join(problem.split())})") from fault


def resolve_destination(path: str | Path) -> Path:
    """Return the path of a file to be written: links are followed, but a pipe or a device keeps its name.

    Raises:
        InputError: It is no path, a link leads to itself, or the current folder does not exist any more.
    """
    require_kind(path, str | os.PathLike, "path", "the name of a file")
    path = Path(path)
    try:
        kind = os.stat(path).st_mode
        return path.resolve() if stat.S_ISREG(kind) or stat.S_ISDIR(kind) else path
    except OSError as fault:
        if fault.errno == errno.ELOOP:
            raise InputError(
                "cannot_write", f"{path} cannot be written: it is a link that leads to itself; name another file"
            ) from fault
    try:
        return path.resolve()
    except (OSError, RuntimeError) as fault:
        raise InputError(
            "cannot_write", f"{path} cannot be written: the folder that you are in is gone, or a link leads to itself"
        ) from fault


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """Give a temporary file to write; it replaces `path` if the block succeeds and is removed if the block fails.

    Files that a killed process left next to `path` are removed too. An existing file keeps its permissions; a
    write-protected one is not replaced.

    Raises:
        InputError: The destination cannot be written.
    """
    path = resolve_destination(path)  # a link keeps pointing where it did
    if path.is_dir():
        raise InputError("cannot_write", f"{path} cannot be written: it is a folder; name a file")
    if (
        path.name.endswith(".part") and f".{get_owner_name()}." in path.name
    ):  # temporary already: whoever gave it sees to it
        yield path
        return
    temporary = path.with_name(f".{path.name[:_MAX_NAME_CHARACTERS]}.{get_owner_name()}.{next(_NUMBER)}.part")
    try:
        if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
            yield path
            return
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError("cannot_write", f"{path} is write-protected; name another file, or allow writing to it")
        remove_stale_files(path.parent, f".{path.name[:_MAX_NAME_CHARACTERS]}.")
        try:
            yield temporary
            _settle(temporary, path)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except BrokenPipeError:
        raise
    except OSError as fault:
        raise build_write_error(path, fault) from fault


def build_write_error(path: Path, fault: OSError) -> InputError:
    """Return the sentence about a file that cannot be written."""
    advice = _ADVICE.get(fault.errno or 0, "name a file in an existing folder")
    return InputError("cannot_write", f"{path} cannot be written: {fault.strerror or fault}; {advice}")


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file so that it appears whole or not at all."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def get_owner_name() -> str:
    """Return a name for this process among all that may share a folder, without dots."""
    return f"{platform.node().replace('.', '_')[:40] or 'here'}-{os.getpid()}"


def remove_stale_files(folder: Path, start: str) -> None:
    """Remove the files that dead processes of this machine left behind: names `<start><owner>.<number>.part`."""
    machine, _, _ = get_owner_name().rpartition("-")
    for left in folder.glob("*.part"):
        name, _, _ = left.name.removeprefix(start).partition(".")
        theirs, _, number = name.rpartition("-")
        if left.name.startswith(start) and theirs == machine and number.isdigit() and not _alive(int(number)):
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)


def _settle(temporary: Path, path: Path) -> None:
    """Put the bytes on the disk before the name: after a power cut the file must not be there and empty."""
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    if path.exists():
        shutil.copymode(path, temporary)


def _alive(process: int) -> bool:
    """Return whether a process of this machine is alive; True if that cannot be tested without side effects."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
