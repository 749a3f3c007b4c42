"""The public measured logs that are known: source, licence, checksums, and the question that each answers (`catalogue.yaml`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import UnknownName
from tau_dyn.files import read_yaml


@dataclass(frozen=True)
class DataFile:
    """A file of a set.

    Attributes:
        name: Name under which it is written.
        n_bytes: Size [bytes]; without an address that of the converted file.
        address: Where it is published; empty where its published form is not read.
        sha256: Checksum of the published file; empty without an address.
        converted: Name of a copy in another format, as the data folder may hold it; empty if there is none.
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
        question: What its logs answer.
        licence: Licence of the published files.
        source: Page where they are published.
        files: The files.
        robots: Robot files that are written next to the logs: file names, or short names of built-in robots.
        columns: File name of the column map.
        controller: File name of the servo law; empty if there is none.
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
    if name not in known:
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
