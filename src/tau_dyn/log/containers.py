"""Which reader a log's file goes to: text and Parquet to `table.py`, files with topics of their own to theirs.

Those readers are imported when they are used, as they need extras.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tau_dyn.exceptions import InputError
from tau_dyn.log.rosbag_log import is_bag_folder, read_bag
from tau_dyn.log.table import Table, read_table

SUFFIXES = (".mcap", ".bag", ".db3", ".mat")


def has_topics(path: Path) -> bool:
    """Tell whether a path is an MCAP file, a ROS bag or a MATLAB file, by its name or, for a folder, by what is in it."""
    return is_bag_folder(path) or (path.suffix.lower() in SUFFIXES and not path.is_dir())


def read_any(path: str | Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a log's file as a table.

    Args:
        path: CSV, Parquet, MCAP, a ROS bag (its folder, too) or a MATLAB file.
        wanted: The file's columns that a map asks for, by our names; None without a map. Text and Parquet give all they have.

    Raises:
        InputError: It cannot be read.
    """
    path = Path(path)
    if not has_topics(path):
        return read_table(path)
    _check_there(path)
    suffix = "" if path.is_dir() else path.suffix.lower()  # a bag's folder may be called anything, `run.mcap` too
    if suffix == ".mcap":
        from tau_dyn.log.mcap_log import read_mcap

        return read_mcap(path, wanted)
    if suffix == ".mat":
        from tau_dyn.log.matlab_log import read_mat

        return read_mat(path, wanted)
    return read_bag(path, wanted)


def _check_there(path: Path) -> None:
    if path.is_dir():
        return
    if path.exists() and not path.is_file():
        raise InputError("cannot_read", f"{path.name} is a pipe or a device; a recording is read from a file.")
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise InputError(
                    "damaged_file", f"{path.name} is empty; a log needs a message or a row for each sample."
                )
    except FileNotFoundError:
        raise InputError("file_not_found", f"{path}: there is no such file; give the path of a log.") from None
    except OSError as fault:
        raise InputError(
            "cannot_read", f"{path} cannot be read: {fault.strerror or fault}; give a readable log."
        ) from None
