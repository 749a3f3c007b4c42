"""One set of measured logs in a folder: from `$TAU_DYN_DATA` if it is there, else from its published address.

Every published file is compared with its sha256 before anything is written. The folder gets the logs, the robot files, the
column map `columns.yaml`, the servo law `controller.yaml` if it is known, and `SOURCE.txt`.

`catalogue.yaml` lists the public measured logs: source, licence, checksums, and the question that each answers.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import build_write_error, get_owner_name, read_bytes, read_yaml, remove_stale_files, write_atomically


@dataclass(frozen=True)
class DataFile:
    """A file of a set.

    Attributes:
        name: Name under which it is written.
        n_bytes: Size [bytes]; without an address that of the converted file.
        address: Address of the published file; empty if its published form cannot be read.
        sha256: Checksum of the published file; empty without an address.
        converted: Name of a copy in another format that the data folder may hold; empty if no such copy exists.
    """

    name: str
    n_bytes: int
    address: str = ""
    sha256: str = ""
    converted: str = ""


@dataclass(frozen=True)
class DataSet:
    """Logs of one machine.

    Attributes:
        name: Short name.
        about: Machine, rate and length.
        question: Question that the logs answer.
        licence: Licence of the published files.
        source: Page where they are published.
        files: The files.
        robots: Robot files that are written next to the logs: file names, or short names of built-in robots.
        columns: File name of the column map.
        controller: File name of the servo law; empty if the law is unknown.
        next: Commands to run on the folder; @ is replaced by the folder.
    """

    name: str
    about: str
    question: str
    licence: str
    source: str
    files: tuple[DataFile, ...]
    robots: tuple[str, ...]
    columns: str
    controller: str
    next: tuple[str, ...]

    @property
    def n_bytes(self) -> int:
        """Size of all files [bytes]."""
        return sum(file.n_bytes for file in self.files)

    @property
    def is_published(self) -> bool:
        """Whether every file can be fetched."""
        return all(file.address for file in self.files)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry as plain data."""
        return {
            "name": self.name,
            "about": self.about,
            "question": self.question,
            "licence": self.licence,
            "source": self.source,
            "bytes": self.n_bytes,
            "downloadable": self.is_published,
            "files": [
                {"name": f.name, "bytes": f.n_bytes, "address": f.address or None, "sha256": f.sha256 or None}
                for f in self.files
            ],
        }


@cache
def list_sets() -> tuple[DataSet, ...]:
    """Return the known sets.

    Example:
        >>> from tau_dyn.measured_data import list_sets
        >>> list_sets()[0].name
        'emps'
    """
    content = read_yaml(Path(str(files("tau_dyn.measured_data"))) / "catalogue.yaml")
    return tuple(_read_set(name, entry) for name, entry in content.items())


def find_set(name: str) -> DataSet:
    """Return a set by its name.

    Raises:
        InputError: No set has this name.
    """
    known = {one.name: one for one in list_sets()}
    if str(name) not in known:
        raise UnknownName("data set", name, known)
    return known[name]


def find_shared_file(kind: str, name: str) -> Path:
    """Return a column map, robot file or servo law that comes with the package.

    Args:
        kind: `columns`, `robots` or `controllers`.
        name: File name.
    """
    installed = Path(str(files("tau_dyn"))) / "identification"
    folder = installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "identification"
    return folder / kind / name


def _read_set(name: str, entry: dict[str, Any]) -> DataSet:
    held = tuple(
        DataFile(f["name"], f["bytes"], f.get("address", ""), f.get("sha256", ""), f.get("converted", ""))
        for f in entry["files"]
    )
    return DataSet(
        name, entry["about"], entry["question"], entry["licence"], entry["source"], held,
        tuple(entry.get("robot", "").split()), entry["columns"], entry.get("controller", ""), tuple(entry["next"]),
    )  # fmt: skip


FOLDER_VARIABLE = "TAU_DYN_DATA"
"""Environment variable that names a folder of measured data, with one folder for each set."""
MAX_FILE_BYTES = 64 * 2**20
"""[bytes] Largest file that is taken from the data folder; the largest published one has 3 MB."""


@dataclass(frozen=True)
class FetchedData:
    """A set in a folder.

    Attributes:
        set: Its entry in the catalogue.
        folder: The folder.
        files: Names of the files in it.
        next: Commands to run next.
        warnings: Files whose checksum could not be compared.
    """

    set: DataSet
    folder: Path
    files: tuple[str, ...]
    next: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return {"data": [self.set.to_dict()], "folder": str(self.folder), "files": self.files, "next": self.next}


def fetch_data(
    name: str, folder: str | Path | None = None, progress: Callable[[str], None] | None = None
) -> FetchedData:
    """Write a set of public measured logs into a folder, with the robot file and the column map that they need.

    Files in the folder that have the same content stay; the folder is written atomically.

    Args:
        name: Name of the set; `list_sets` has them.
        folder: Destination; by default a folder with the set's name.
        progress: Called with a line about each file that is downloaded.

    Raises:
        InputError: No set has this name; a file is neither in `$TAU_DYN_DATA` nor can be downloaded; a checksum differs; the
            folder holds another file of the same name.

    Example:
        >>> fetched = td.fetch_data("emps", "emps")  # doctest: +SKIP
        >>> fetched.next[0]  # doctest: +SKIP
        'tau-dyn identify emps/linear_axis.urdf emps/DATA_EMPS.mat --columns emps/columns.yaml'
    """
    chosen = find_set(name)
    target = Path(folder) if folder is not None else Path(name)
    _require_usable_folder(target)
    contents, renamed, warnings = _collect_logs(chosen, progress)
    contents |= _collect_companions(chosen)
    contents["SOURCE.txt"] = _describe_source(chosen, renamed).encode()
    _write_folder(target, contents)
    return FetchedData(chosen, target, tuple(contents), _build_commands(chosen, target, renamed), tuple(warnings))


def _collect_logs(
    chosen: DataSet, progress: Callable[[str], None] | None
) -> tuple[dict[str, bytes], dict[str, str], list[str]]:
    """Return the files by the names under which they are written, other names of converted copies, and warnings."""
    contents: dict[str, bytes] = {}
    renamed: dict[str, str] = {}
    missing: list[DataFile] = []
    for file in chosen.files:
        found = _find_in_data_folder(chosen, file)
        if found is None:
            missing.append(file)
            continue
        contents[found.name] = read_bytes(found, MAX_FILE_BYTES)
        if found.name != file.name:
            renamed[file.name] = found.name
        elif file.sha256:
            _require_checksum(file, contents[found.name], str(found))
    unchecked = [
        name for name in contents if name in {*renamed.values()} | {f.name for f in chosen.files if not f.sha256}
    ]
    unpublished = [file.name for file in missing if not file.address]
    if unpublished:
        raise InputError(
            "file_not_found",
            f"{chosen.name}: {unpublished[0]} is published only in a form that is not read, at {chosen.source}; "
            f"set {FOLDER_VARIABLE} to a folder that holds {chosen.name}/{unpublished[0]}",
        )
    if missing:
        contents |= _download(missing, progress)
    warnings = []
    if unchecked:
        more = f" and {len(unchecked) - 1} more" if len(unchecked) > 1 else ""
        warnings.append(f"{unchecked[0]}{more}: a copy converted from the published files, so no checksum was compared")
    return contents, renamed, warnings


def _find_in_data_folder(chosen: DataSet, file: DataFile) -> Path | None:
    """Return a file in `$TAU_DYN_DATA/NAME`: the published one, or its converted copy; None if both are missing."""
    root = os.environ.get(FOLDER_VARIABLE)
    if not root:
        return None
    candidates = (Path(root, chosen.name, name) for name in (file.name, file.converted) if name)
    return next((path for path in candidates if path.is_file()), None)


def _require_checksum(file: DataFile, content: bytes, where: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != file.sha256:
        raise InputError(
            "wrong_checksum",
            f"{where} is not the published file: its sha256 begins with {found[:12]}, the published one's with "
            f"{file.sha256[:12]}; no file was written",
        )


def _download(missing: list[DataFile], progress: Callable[[str], None] | None) -> dict[str, bytes]:
    """Return published files by name, each compared with its checksum."""
    contents = {}
    with tempfile.TemporaryDirectory(prefix="tau_dyn_data_") as folder:
        for file in missing:
            if progress is not None:
                progress(f"downloading {file.name}")
            contents[file.name] = read_bytes(download_file(file.address, Path(folder)), MAX_FILE_BYTES)
            _require_checksum(file, contents[file.name], file.address)
    return contents


def download_file(address: str, folder: Path) -> Path:
    """Download one file into a folder and return its path.

    Raises:
        InputError: pooch is not installed, or the address does not answer.
    """
    try:
        import pooch
    except ImportError:
        raise InputError(
            "missing_package",
            f"downloading needs pooch: pip install 'tau_dyn[data]', or set {FOLDER_VARIABLE} to a folder that holds the data",
        ) from None
    pooch.get_logger().setLevel("ERROR")
    try:
        return Path(
            pooch.retrieve(
                address, known_hash=None, fname="downloaded", path=folder / hashlib.sha256(address.encode()).hexdigest()
            )
        )
    except (OSError, ValueError) as fault:
        reason = type(fault).__name__ if len(str(fault)) > 120 else f"{type(fault).__name__}: {fault}"
        raise InputError(
            "download_failed",
            f"{address} could not be downloaded ({reason}); connect to the network, or set {FOLDER_VARIABLE} to a folder that "
            "holds the data",
        ) from fault


def _collect_companions(chosen: DataSet) -> dict[str, bytes]:
    """Return robot files, column map and servo law by the names under which they are written."""
    found: dict[str, bytes] = {}
    for robot in chosen.robots:
        if robot.endswith(".urdf"):
            found[robot] = find_shared_file("robots", robot).read_bytes()
        else:
            from tau_dyn.robot import load_robot

            found[f"{robot}.urdf"] = load_robot(robot).urdf.encode()
    found["columns.yaml"] = find_shared_file("columns", chosen.columns).read_bytes()
    if chosen.controller:
        found["controller.yaml"] = find_shared_file("controllers", chosen.controller).read_bytes()
    return found


def _describe_source(chosen: DataSet, renamed: Mapping[str, str]) -> str:
    lines = [chosen.about, f"Source: {chosen.source}", f"Licence: {chosen.licence}", ""]
    for file in chosen.files:
        if file.name in renamed or not file.sha256:
            lines.append(f"{renamed.get(file.name, file.name)}: converted from the published file; no checksum")
        else:
            lines.append(f"{file.name}: sha256 {file.sha256}, {file.address}")
    return "\n".join(lines) + "\n"


def _build_commands(chosen: DataSet, target: Path, renamed: Mapping[str, str]) -> tuple[str, ...]:
    """Return the next commands with the folder and the files that it holds."""
    prefix = f"{shlex.quote(target.as_posix())}/"
    commands = []
    for command in chosen.next:
        for published, written in renamed.items():
            command = command.replace(f"@{published}", f"@{written}")
        commands.append(" ".join(prefix + word[1:] if word.startswith("@") else word for word in command.split(" ")))
    return tuple(commands)


def _require_usable_folder(target: Path) -> None:
    if target.exists() and not target.is_dir():
        raise InputError("cannot_write", f"{target} is a file; name a folder")
    if not target.resolve().parent.is_dir():
        raise InputError("cannot_write", f"{target}: the folder {target.parent} does not exist")


def _write_folder(target: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into a new folder that appears whole, or into one that holds no other file of these names.

    Raises:
        InputError: A file would be overwritten, or the folder cannot be written.
    """
    for name, content in contents.items():
        path = target / name
        if os.path.lexists(path) and not (path.is_file() and path.read_bytes() == content):
            raise InputError("cannot_write", f"{path} exists with another content; name another folder with --out")
    if target.is_dir():
        with ExitStack() as staged:
            for name, content in contents.items():
                staged.enter_context(write_atomically(target / name)).write_bytes(content)
        return
    whole = target.resolve()
    start = f".{whole.name[:120]}."
    staging = whole.parent / f"{start}{get_owner_name()}.data.part"
    try:
        remove_stale_files(whole.parent, start)
        staging.mkdir()
        try:
            for name, content in contents.items():
                (staging / name).write_bytes(content)
            staging.rename(whole)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except OSError as fault:
        raise build_write_error(target, fault) from fault
