"""A recorded file, ours or foreign, becomes a `Log` in SI units, or measured points; everything is converted here, once.

Text and Parquet are read by `table.py`; files with topics of their own by readers that are imported when they are used, as
they need extras. Our own files name their columns as the contract says. A foreign file comes with a `ColumnMap`; its columns
that the map does not mention keep their names. Every cell that the library will use is checked, and a fault is one sentence
with file, line and column. Measured points are actuated positions and where a device saw a point, without a clock: `q_J` for
each actuated joint, `x_tool y_tool z_tool` [m], `qx_tool qy_tool qz_tool qw_tool`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_joint_sha256
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import describe_missing_clock, describe_missing_column, format_names, list_used_columns
from tau_dyn.log.log import Log
from tau_dyn.log.rosbag_log import is_bag_folder, read_bag
from tau_dyn.log.table import Table, read_table
from tau_dyn.results import count

_LOGGER = logging.getLogger(__name__)
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
        return read_table(path, foreign=wanted is not None)
    _check_there(path)
    suffix = "" if path.is_dir() else path.suffix.lower()  # a bag's folder may be called anything, `run.mcap` too
    if suffix == ".mcap":
        from tau_dyn.log.mcap_log import read_mcap

        return read_mcap(path, wanted)
    if suffix == ".mat":
        from tau_dyn.log.matlab import read_mat

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


POSITION = ("x_tool", "y_tool", "z_tool")
QUATERNION = ("qx_tool", "qy_tool", "qz_tool", "qw_tool")


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """A file of measured points.

    Attributes:
        name: File name.
        sha256: Hash of the file.
        joints: Joints whose positions it has, in the order asked for.
        q: Their positions (N, k) [m or rad].
        points: Measured positions (N, 3) [m]; None without all three columns.
        quaternions: Measured orientations (N, 4), x y z w; None without all four columns.
        warnings: What was left out while reading.
    """

    name: str
    sha256: str
    joints: tuple[str, ...]
    q: np.ndarray
    points: np.ndarray | None
    quaternions: np.ndarray | None
    warnings: tuple[str, ...]

    def column(self, joint: str) -> np.ndarray:
        """Return one joint's positions (N,).

        Raises:
            InputError: The file does not have them.
        """
        if joint not in self.joints:
            raise InputError(
                "missing_column", f"{self.name} has no column q_{joint}; it is needed to know where {joint} was"
            )
        return self.q[:, self.joints.index(joint)]


def read_measured(path: str | Path, actuated: Sequence[str]) -> MeasuredPoints:
    """Read a file of measured points.

    Args:
        path: CSV or Parquet.
        actuated: The robot's actuated joints.

    Raises:
        InputError: The file cannot be read, has no `q_J` column of this robot, or a cell is no number.
    """
    table = read_table(path)
    joints = tuple(j for j in actuated if f"q_{j}" in table.cells)
    if not joints:
        raise InputError(
            "missing_column",
            f"{table.name} has no column q_J of an actuated joint; it needs q_{', q_'.join(actuated)} or some of them",
        )
    points, quaternions = (
        np.column_stack([table.numbers(c) for c in wanted]) if all(c in table.cells for c in wanted) else None
        for wanted in (POSITION, QUATERNION)
    )
    if quaternions is not None:
        sizes = np.linalg.norm(quaternions, axis=1)
        wrong = np.flatnonzero(np.abs(sizes - 1) > 1e-3)
        if wrong.size:
            k = int(wrong[0])
            raise InputError(
                "bad_sample", f"{table.where(k)}: the quaternion qx_tool .. qw_tool has length {sizes[k]:.4g}, not 1"
            )
    q = np.column_stack([table.numbers(f"q_{j}") for j in joints])
    return MeasuredPoints(table.name, table.sha256, joints, q, points, quaternions, table.warnings)


MIN_SAMPLES = 10
"""A log with fewer samples answers nothing and is taken for a mistake."""


def read_log(path: str | Path, columns: ColumnMap | str | Path | None = None) -> Log:
    """Read a recording.

    Args:
        path: CSV with one header line (comma, semicolon or tab), Parquet, MCAP, a ROS bag or a MATLAB file
            (`read.py`). With a map that has `files`, their folder will do.
        columns: Map for a foreign log, or the path of one.

    Returns:
        The log in SI units. An incomplete last line is left out and stands in its `warnings`.

    Raises:
        InputError: The file cannot be used; the message names file, line and column.

    Example:
        >>> t = np.arange(0.0, 1.0, 0.01)
        >>> td.Log(t, {"q_axis": np.sin(t)}).to_csv("monday.csv")
        >>> td.read_log("monday.csv").joints("q")
        ('axis',)
    """
    if columns is None:
        table = read_any(path)
        log = _build({None: table}, table, _own_columns(table, tuple(table.cells)), warnings=table.warnings)
    else:
        log = _read_foreign(Path(path), columns if isinstance(columns, ColumnMap) else ColumnMap.load(columns))
    _LOGGER.info("read %s: %d samples in %.6g s", log.name, log.n_samples, log.duration)
    return log


def refuse_few(name: str, n_samples: int) -> None:
    """Refuse a log with fewer samples than any answer needs."""
    if n_samples < MIN_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{name} has {count(n_samples, 'sample')}; a log needs at least {MIN_SAMPLES} to say anything.",
        )


def _read_foreign(path: Path, map_: ColumnMap) -> Log:
    """Read the log's files, and give their columns our names and units."""
    tables = _tables(path, map_)
    if map_.episode is not None:
        tables = {key: _take_episode(table, map_.episode) for key, table in tables.items()}
    tables, warnings = _same_length(tables)
    main = tables.get(None) or next(iter(tables.values()))
    channels = compute_mapped_columns(tables, map_)
    if map_.rate_hz is not None:
        channels["t"] = np.arange(main.n_rows) / map_.rate_hz
    if None in tables:
        taken = {s.column for s in map_.sources.values() if s.file is None} | set(channels)
        kept = tuple(column for column in main.cells if column not in taken)
        channels = {**_own_columns(main, kept, beside=tuple(channels)), **channels}
    return _build(tables, main, channels, warnings)


EPISODE = "episode_index"
"""Column of a LeRobot data set that says which recording a row belongs to."""


def _take_episode(table: Table, episode: int) -> Table:
    """Return one episode's rows."""
    numbers = table.numbers(EPISODE)
    rows = np.flatnonzero(numbers == episode)
    if not rows.size:
        known = format_names(f"{x:g}" for x in np.unique(numbers))
        raise InputError("unknown_name", f"{table.name} has no episode {episode}; there are {known}.")
    return table.take_rows(rows)


def compute_mapped_columns(tables: Mapping[str | None, Table], map_: ColumnMap) -> dict[str, NDArray[np.float64]]:
    """Return the map's columns (N,) in our names and units, couplings undone.

    Raises:
        InputError: A column is missing, or a cell is no number.
    """
    channels = {
        ours: source.scale * _theirs(tables, map_, ours) + source.offset for ours, source in map_.sources.items()
    }
    for signal, coupling in map_.couplings.items():
        names = [f"{signal}_{joint}" for joint in coupling.joints]
        mixed = coupling.apply(np.column_stack([channels[name] for name in names]))
        channels.update(zip(names, mixed.T, strict=True))
    return channels


def _tables(path: Path, map_: ColumnMap) -> dict[str | None, Table]:
    """Read every file that the map takes a column from: its `files` by their keys, the log given by None."""
    if has_topics(path) and not map_.files:
        return {None: read_any(path, {ours: source.column for ours, source in map_.sources.items()})}
    folder = path if path.is_dir() else path.parent
    wanted = dict.fromkeys(source.file for source in map_.sources.values())
    if path.is_dir() and None in wanted:
        raise InputError(
            "file_format",
            f"{path} is a folder, and {map_.name} does not say which file every column is from; give the log's file.",
        )
    paths = {key: path if key is None else folder / map_.files[key] for key in wanted}
    if not path.is_dir() and not any(_same_file(path, other) for other in paths.values()):
        raise InputError(
            "mismatch",
            f"{path.name} is none of the files that {map_.name} reads ({format_names(map_.files.values())}); give one.",
        )
    asked = {key: {o: s.column for o, s in map_.sources.items() if s.file == key} for key in wanted}
    return {key: read_any(file, asked[key]) for key, file in paths.items()}


def _same_file(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()


def _same_length(tables: dict[str | None, Table]) -> tuple[dict[str | None, Table], tuple[str, ...]]:
    """Cut files to the shortest where only an incomplete last line made the difference, else refuse."""
    shortest = min(tables.values(), key=lambda table: table.n_rows)
    for key, table in tables.items():
        extra = table.n_rows - shortest.n_rows
        if extra > 1 or extra == 1 and not shortest.warnings:
            raise InputError(
                "mismatch",
                f"{table.name} has {table.n_rows} samples and {shortest.name} has {shortest.n_rows}; "
                "files of one log have to be sampled together and be of equal length.",
            )
        if extra:
            tables[key] = table.first_rows(
                shortest.n_rows, f"{table.name}: its last sample was left out, as in {shortest.name}."
            )
    return tables, tuple(sentence for table in tables.values() for sentence in table.warnings)


def _theirs(tables: Mapping[str | None, Table], map_: ColumnMap, ours: str) -> NDArray[np.float64]:
    source = map_.sources[ours]
    table = tables[source.file]
    if source.column not in table.cells:
        raise InputError(
            "missing_column",
            describe_missing_column(
                table.name, source.column, tuple(table.cells), f", which {map_.name} takes for {ours}"
            ),
        )
    return table.numbers(source.column, source.scale)


def _own_columns(
    table: Table, columns: tuple[str, ...], beside: tuple[str, ...] = ()
) -> dict[str, NDArray[np.float64]]:
    """Return columns under their own names: ours checked cell by cell, foreign ones if they are numbers at all."""
    used = set(list_used_columns((*beside, *columns)))
    channels = {
        column: table.numbers(column) if column in used else table.numbers_or_none(column) for column in columns
    }
    return {column: values for column, values in channels.items() if values is not None}


def _build(
    tables: Mapping[str | None, Table], main: Table, channels: dict[str, NDArray[np.float64]], warnings: tuple[str, ...]
) -> Log:
    """Check the clock and the length, and freeze everything into a log."""
    refuse_few(main.name, main.n_rows)
    if "t" not in channels:
        raise InputError("missing_column", describe_missing_clock(main.name, tuple(main.cells)))
    t = channels.pop("t")
    _check_episodes(main)
    _check_clock(main, t)
    digest = compute_joint_sha256(table.sha256 for table in tables.values())
    return Log(t, channels, name=main.name, sha256=digest, warnings=tuple(dict.fromkeys(warnings)))


def _check_episodes(table: Table) -> None:
    """Refuse several episodes as one log."""
    numbers = table.numbers_or_none(EPISODE) if EPISODE in table.cells else None
    if numbers is not None and np.any(numbers != numbers[0]):
        raise InputError(
            "time_stamps",
            f"{table.name} holds {np.unique(numbers).size} episodes, which are logs of their own; choose one in the column "
            f"map, as `episode: {numbers[0]:g}`.",
        )


def _check_clock(table: Table, t: NDArray[np.float64]) -> None:
    backwards = np.flatnonzero(np.diff(t) <= 0.0)
    if not backwards.size:
        return
    row = int(backwards[0]) + 1
    if t[row] == t[row - 1]:
        what = f"t = {_seconds(t[row])} s stands twice; every sample needs a later time. Rounded? Write more digits."
    else:
        what = (
            f"t = {_seconds(t[row])} s comes after {_seconds(t[row - 1])} s; logs must run forward in time. "
            "Two recordings joined? Pass them as two files."
        )
    raise InputError("bad_sample", f"{table.where(row)}: {what}")


def _seconds(t: float) -> str:
    """Return a time with at least three decimals and no more than it needs."""
    whole, _, decimals = f"{t:.9f}".rstrip("0").partition(".")
    return f"{whole}.{decimals:0<3}"
