"""Whatever a caller has of a recording, as a `Log`: the log, the path of its file, or a table of pandas."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, TypeAlias, overload, runtime_checkable

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log.log import Log
from tau_dyn.log.read import read_log
from tau_dyn.log.recording import Recording


@runtime_checkable
class DataTable(Protocol):
    """What is used of a table of pandas."""

    columns: Any
    index: Any

    def reset_index(self) -> Any:
        """Return the table with its index as a column."""
        ...

    def __getitem__(self, name: Any) -> Any:
        """Return a column."""
        ...


LogSource: TypeAlias = Log | str | Path | DataTable
"""A log, the path of its file, or a table with a column for each channel."""


@overload
def as_log(source: Recording) -> Recording: ...
@overload
def as_log(source: LogSource) -> Log: ...
@overload
def as_log(source: LogSource | Recording) -> Log | Recording: ...
def as_log(source: LogSource | Recording) -> Log | Recording:
    """Return a log as it is, a path's file read, or a table's columns as a log.

    Args:
        source: A log or a recording on disk; a path, read by `read_log`; or a table with `t` [s], as a column or as the name of
            its index, and channels by name, such as `q_J` and `tau_J`.

    Raises:
        InputError: It is something else, the file cannot be read, or a column of the table holds no numbers.
    """
    if isinstance(source, Log | Recording):
        return source
    if isinstance(source, str | Path):
        return read_log(source)
    if not isinstance(source, DataTable):
        raise InputError(
            "invalid_value",
            f"an object of type {type(source).__name__} is no log; give a Log, the path of its file, or a pandas table with t, "
            "q_J and tau_J",
        )
    table = source.reset_index() if source.index.name == "t" and "t" not in source.columns else source
    if "t" not in table.columns:
        listed = ", ".join(map(str, list(table.columns)[:12]))
        raise InputError(
            "missing_column",
            f"the table has no column t [s]; it has {listed}. Name its columns t, q_J and tau_J, in SI units",
        )
    channels = {str(name): _read_column(table, name) for name in table.columns}
    return Log(channels.pop("t"), channels, "table")


def _read_column(table: DataTable, name: Any) -> np.ndarray:
    """Return a column as numbers (N,).

    Raises:
        InputError: A cell is no number.
    """
    try:
        return np.array(table[name], dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("bad_sample", f"column {name} of the table holds cells that are no numbers") from None
