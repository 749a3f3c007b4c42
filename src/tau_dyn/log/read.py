"""Read a recorded file, ours or foreign, as a `Log` in SI units or as measured points; all units are converted here, once.

Text and Parquet are read by `table.py`; files with topics by readers that are imported when they are used, as they need extras.
Our own files name their columns as in the contract. A foreign file comes with a `ColumnMap`; its columns that the map does not
mention keep their names. Every cell that the library will use is checked, and a fault is one sentence with file, line and column.
Measured points are actuated positions with the position of a point measured by a device, without a clock: `q_J` for each actuated
joint, `x_tool y_tool z_tool` [m], `qx_tool qy_tool qz_tool qw_tool`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_joint_sha256
from tau_dyn.log.clocks import (
    SECONDS_A_DAY,
    Clock,
    Clocked,
    describe_coarse_text,
    find_day_numbers,
    find_split_clock,
    join_clocks,
    read_text_clock,
    unwrap_counter,
)
from tau_dyn.log.column_map import ColumnMap, Source
from tau_dyn.log.column_names import (
    describe_missing_clock,
    describe_missing_column,
    find_scale_of_unit,
    format_names,
    is_blank,
    list_used_columns,
    split_column_name,
    split_signal,
)
from tau_dyn.log.log import Log, Origin
from tau_dyn.log.rosbag_log import is_bag_folder, read_bag
from tau_dyn.log.table import Table, read_table
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

_LOGGER = logging.getLogger(__name__)
SUFFIXES = (".mcap", ".bag", ".db3", ".mat", ".unv", ".uff")


def has_topics(path: Path) -> bool:
    """Return whether a path is an MCAP file, a ROS bag, a MATLAB or universal file, by its name or a folder's content."""
    return is_bag_folder(path) or (path.suffix.lower() in SUFFIXES and not path.is_dir())


def read_any(path: str | Path, wanted: Mapping[str, str] | None = None) -> Table:
    """Read a log's file as a table.

    Args:
        path: CSV, Parquet, MCAP, a ROS bag (its folder, too), a MATLAB file or a universal file (UFF, UNV).
        wanted: The file's columns that a map asks for, by our names; None without a map. Text and Parquet give all columns.

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
        from tau_dyn.log.lab_files.matlab import read_mat

        return read_mat(path, wanted)
    if suffix in (".unv", ".uff"):
        from tau_dyn.log.lab_files.uff import read_uff

        return read_uff(path)
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
        warnings: Sentences about lines that were left out while reading.
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
"""A log with fewer samples is useless and is taken for a mistake."""


def read_log(path: str | Path, columns: ColumnMap | str | Path | None = None) -> Log:
    """Read a recording.

    Args:
        path: CSV with one header line (comma, semicolon or tab), Parquet, MCAP, a ROS bag or a MATLAB file
            (`read.py`). With a map that has `files`, their folder will do.
        columns: Map for a foreign log, or the path of one.

    Returns:
        The log in SI units. An incomplete last line is left out and reported in its `warnings`.

    Raises:
        InputError: The file cannot be used; the message names file, line and column.

    Example:
        >>> t = np.arange(0.0, 1.0, 0.01)
        >>> td.Log(t, {"q_axis": np.sin(t)}).to_csv("monday.csv")
        >>> td.read_log("monday.csv").joints("q")
        ('axis',)
    """
    if not isinstance(path, str | Path):
        raise InputError(
            "invalid_value",
            f"read_log takes the path of a file, not an object of type {type(path).__name__}; a table with t, q_J and tau_J goes "
            "to identify and diagnose as it is",
        )
    if columns is None:
        table = read_any(path)
        channels = _own_columns(table, tuple(c for c in table.cells if c != "t"))
        log = _build({None: table}, [_Part(table, channels, _read_clock(table, None))], table.warnings, None)
    else:
        log = _read_foreign(Path(path), columns if isinstance(columns, ColumnMap) else ColumnMap.load(columns))
    _LOGGER.info("read %s: %d samples in %.6g s", log.name, log.n_samples, log.duration)
    return log


def refuse_few(name: str, n_samples: int) -> None:
    """Refuse a log with fewer samples than any result needs."""
    if n_samples < MIN_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{name} has {count(n_samples, 'sample')}; a log needs at least {MIN_SAMPLES} for an answer.",
        )


def _read_foreign(path: Path, map_: ColumnMap) -> Log:
    """Read the log's files, and give their columns our names and units."""
    tables = _tables(path, map_)
    if map_.episode is not None:
        tables = {key: _take_episode(table, map_.episode) for key, table in tables.items()}
    clock = map_.sources.get("t", None if map_.rate_hz is not None else Source("t"))
    key = clock.file if clock is not None and clock.file in tables else next(iter(tables))
    apart = {} if clock is None else _find_other_clocks(tables, map_, key, clock)
    together, warnings = _same_length({k: table for k, table in tables.items() if k not in apart})
    scaled = _scale_columns({**tables, **together}, map_)
    mine = {c: x for c, x in scaled.items() if map_.sources[c].file not in apart}
    main = together.get(None) or together[key]
    if None in together:
        taken = {s.column for s in map_.sources.values() if s.file is None} | set(scaled)
        kept = tuple(column for column in main.cells if column not in taken and column != "t")
        mine = {**_own_columns(main, kept, beside=tuple(scaled)), **mine}
    times = (
        Clock(np.arange(main.n_rows) / (map_.rate_hz or 1.0)) if clock is None else _read_clock(together[key], clock)
    )
    others = [
        _Part(tables[k], {c: x for c, x in scaled.items() if map_.sources[c].file == k}, other)
        for k, other in apart.items()
    ]
    said = (*warnings, *(sentence for k in apart for sentence in tables[k].warnings))
    return _build(tables, [_Part(main, mine, times), *others], said, map_)


def _find_other_clocks(
    tables: Mapping[str | None, Table], map_: ColumnMap, main: str | None, source: Source
) -> dict[str | None, Clock]:
    """Return the clocks of files that are not sampled together with the main one, by the files' keys.

    A file has a clock if the map gives one, or if a column has the name of the main clock. Equal clocks count as one.
    """
    if len(tables) == 1:
        return {}
    reference = _read_clock(tables[main], source)
    found = {}
    for key, table in tables.items():
        own = map_.clocks.get(key or "", source)
        if key == main or own.column not in table.cells and own is source:
            continue
        clock = _read_clock(table, own)
        if clock.t.size != reference.t.size or not _are_equal(clock, reference):
            found[key] = clock
    return found


MAX_CLOCK_DIFFERENCE = 0.01
"""Share of a step by which stamps of files that were sampled together may differ: rounding."""


def _are_equal(one: Clock, other: Clock) -> bool:
    step = float(np.median(np.abs(np.diff(other.t))))
    difference = np.abs(one.t - other.t + (one.epoch - other.epoch) / 1e9)
    return bool(np.all(difference <= MAX_CLOCK_DIFFERENCE * step))


def _read_clock(table: Table, source: Source | None) -> Clock:
    """Return the clock of a table: numbers, or dates and times of day, or a number of days.

    Args:
        table: The table.
        source: Its clock in a map; None for a log under our own names.

    Raises:
        InputError: There is no clock, or a cell is neither a number nor a time.
    """
    column = "t" if source is None else source.column
    split = find_split_clock(tuple(table.cells))
    if split and column not in table.cells and source is None or split and column == split[0]:
        return _read_split_clock(table, *split)
    if column not in table.cells:
        raise InputError(
            "missing_column",
            describe_missing_clock(table.name, tuple(table.cells))
            if column == "t"
            else describe_missing_column(table.name, column, tuple(table.cells), ", which the map takes for t"),
        )
    clock = read_text_clock(table.cells[column])
    if clock is not None:
        if source is not None and source.scale != 1.0:
            raise InputError(
                "file_format",
                f"{table.name}, column {column} holds dates or times of day, which take no scale; leave it out.",
            )
        if coarse := describe_coarse_text(table.cells[column]):
            raise InputError("time_stamps", f"{table.name}, column {column}: {coarse}.")
        return clock._replace(remark=f"{table.name}: column {column} {clock.remark}.")
    scale, offset = (1.0, 0.0) if source is None else (source.scale, source.offset)
    if scale == 1.0 and not (source is not None and source.is_si):
        _refuse_unit(table, column, "t")
    numbers = table.numbers(column, scale, gaps=True)
    if scale == 1.0 and find_day_numbers(numbers):
        step = np.nanmedian(np.diff(numbers)) * SECONDS_A_DAY
        why = f"its step is that of {1 / step:.4g} Hz in days"
        remark = (
            f"{table.name}: column {column} counts days, as spreadsheets do ({why}); t is in seconds from the first."
        )
        first = numbers[np.isfinite(numbers)][0]
        return Clock((numbers - first) * SECONDS_A_DAY, round(first * SECONDS_A_DAY * 1e9), remark)
    numbers, size = unwrap_counter(numbers)
    remark = (
        f"{table.name}: the counter of column {column} restarts at {size:.0f}, which is added there." if size else ""
    )
    return Clock(scale * numbers + offset, remark=remark)


def _read_split_clock(table: Table, seconds: str, nanoseconds: str) -> Clock:
    """Return the clock of a column of whole seconds and one of nanoseconds."""
    whole, part = table.numbers(seconds), table.numbers(nanoseconds)
    remark = f"{table.name}: {seconds} and {nanoseconds} are the clock; t is in seconds from the first whole second."
    return Clock(whole - whole[0] + 1e-9 * part, round(whole[0]) * 10**9, remark)


EPISODE = "episode_index"
"""Column of a LeRobot data set with the number of the recording that a row belongs to."""


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
    return _undo_couplings(channels, map_)


def _undo_couplings(channels: dict[str, NDArray[np.float64]], map_: ColumnMap) -> dict[str, NDArray[np.float64]]:
    for signal, coupling in map_.couplings.items():
        names = [f"{signal}_{joint}" for joint in coupling.joints]
        mixed = coupling.apply(np.column_stack([channels[name] for name in names]))
        channels.update(zip(names, mixed.T, strict=True))
    return channels


def _scale_columns(tables: Mapping[str | None, Table], map_: ColumnMap) -> dict[str, NDArray[np.float64]]:
    """Return the map's columns except the clock in our units, each (N,) of its own table, with NaN for missing numbers."""
    return {
        ours: source.scale * _theirs(tables, map_, ours, gaps=True) + source.offset
        for ours, source in map_.sources.items()
        if ours != "t"
    }


def _tables(path: Path, map_: ColumnMap) -> dict[str | None, Table]:
    """Read every file that the map takes a column from: its `files` by their keys, the log given by None."""
    if has_topics(path) and not map_.files:
        return {None: read_any(path, {ours: source.column for ours, source in map_.sources.items()})}
    folder = path if path.is_dir() else path.parent
    wanted = dict.fromkeys(source.file for source in map_.sources.values()) or {None: None}
    if path.is_dir() and None in wanted:
        raise InputError(
            "file_format",
            f"{path} is a folder, and {map_.name} does not name the file of every column; give the log's file.",
        )
    paths = {key: path if key is None else folder / map_.files[key] for key in wanted}
    if not path.is_dir() and not any(_same_file(path, other) for other in paths.values()):
        raise InputError(
            "mismatch",
            f"{path.name} is not one of the files that {map_.name} reads ({format_names(map_.files.values())}); give one.",
        )
    asked = {key: {o: s.column for o, s in map_.sources.items() if s.file == key} for key in wanted}
    return {key: read_any(file, asked[key]) for key, file in paths.items()}


def _same_file(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve()


def _same_length(tables: dict[str | None, Table]) -> tuple[dict[str | None, Table], tuple[str, ...]]:
    """Cut files to the shortest if they differ only by an incomplete last line, else refuse."""
    shortest = min(tables.values(), key=lambda table: table.n_rows)
    for key, table in tables.items():
        extra = table.n_rows - shortest.n_rows
        if extra > 1 or extra == 1 and not shortest.warnings:
            raise InputError(
                "mismatch",
                f"{table.name} has {table.n_rows} samples and {shortest.name} has {shortest.n_rows}; "
                "files of one log have to be sampled together and be of equal length, or have a clock each, as "
                "files: {f: {path: forces.csv, t: COLUMN}}.",
            )
        if extra:
            tables[key] = table.first_rows(
                shortest.n_rows, f"{table.name}: its last sample was left out, as in {shortest.name}."
            )
    return tables, tuple(sentence for table in tables.values() for sentence in table.warnings)


def _theirs(tables: Mapping[str | None, Table], map_: ColumnMap, ours: str, gaps: bool = False) -> NDArray[np.float64]:
    source = map_.sources[ours]
    table = tables[source.file]
    is_coupled = split_signal(ours) in map_.couplings
    if source.scale == 1.0 and not source.is_si and not is_coupled:  # a coupling's matrix may hold the scale
        _refuse_unit(table, source.column, ours)
    if source.column not in table.cells:
        raise InputError(
            "missing_column",
            describe_missing_column(
                table.name, source.column, tuple(table.cells), f", which {map_.name} takes for {ours}"
            ),
        )
    return table.numbers(source.column, source.scale, gaps=gaps)


def _own_columns(
    table: Table, columns: tuple[str, ...], beside: tuple[str, ...] = ()
) -> dict[str, NDArray[np.float64]]:
    """Return columns under their own names: ours checked cell by cell, foreign ones if they are numbers at all."""
    used = set(list_used_columns((*beside, *columns)))
    for column in used.intersection(columns):
        _refuse_unit(table, column, column)
    channels = {
        column: table.numbers(column, gaps=True) if column in used else table.numbers_or_none(column)
        for column in columns
    }
    return {column: values for column, values in channels.items() if values is not None}


def _refuse_unit(table: Table, column: str, ours: str) -> None:
    """Refuse a column that is read as our column `ours` in SI, and that the units below the header give in another unit."""
    unit = table.units.get(column, "")
    scale = find_scale_of_unit(unit, ours)
    if scale not in (None, 1.0):
        raise InputError(
            "file_format",
            f"{table.name}: the units below its header give {unit} for {column}; write "
            f"`{ours}: {{column: {column}, scale: {scale:.9g}}}` into a column map (--columns MAP.yaml).",
        )


class _Part(NamedTuple):
    """Columns of one file or of files sampled together, under our names (N,), and their clock."""

    table: Table
    channels: dict[str, NDArray[np.float64]]
    clock: Clock


MIN_COMPLETE_SHARE = 0.5
"""Share of complete rows above which the others are gaps; below it, columns have clocks of their own."""


def _build(
    tables: Mapping[str | None, Table], parts: Sequence[_Part], warnings: tuple[str, ...], map_: ColumnMap | None
) -> Log:
    """Check the clocks and the length, fill or leave out gaps, and freeze everything into a log."""
    main = parts[0].table
    refuse_few(main.name, main.n_rows)
    _check_episodes(main)
    if not any(split_column_name(c) for part in parts for c in part.channels):
        refuse_signals_in_rows(main)
    remarks = (part.clock.remark for part in parts if part.clock.remark)
    said = [*warnings, *(CodedWarning("clock_converted", remark) for remark in remarks)]
    used = frozenset(list_used_columns([c for part in parts for c in part.channels]))
    lost = [c for part in parts for c in part.channels if c in used and np.isnan(part.channels[c]).all()]
    said += [
        CodedWarning(
            "column_without_numbers", f"{main.name}: column {column} has no number in it and counts as missing."
        )
        for column in lost
    ]
    parts, markers = _clear_markers(parts, used)
    said += markers
    channels = {c: x for c, x in parts[0].channels.items() if c not in lost}
    t, channels, more = _join(parts, channels, used.difference(lost))
    if map_ is not None:
        channels = _undo_couplings(channels, map_)
    digest = compute_joint_sha256(table.sha256 for table in tables.values())
    origin = Origin(map_, tuple(lost))
    return Log(t, channels, main.name, digest, tuple(dict.fromkeys((*said, *more))), origin)


MARKER_RATIO = 10.0
"""Size of a marker of missing readings over the largest other value of its column."""

MIN_MARKER = 99.0
"""Smallest marker: 99, -999, 9999 and the ends of whole numbers of 16 or 32 bits are common."""


def _clear_markers(parts: Sequence[_Part], used: frozenset[str]) -> tuple[list[_Part], list[CodedWarning]]:
    """Return parts in which markers of missing readings are NaN, and a remark for each column that has one."""
    cleared, remarks = [], []
    for part in parts:
        found = {c: v for c, x in part.channels.items() if c in used and (v := _find_marker(x)) is not None}
        remarks += [
            CodedWarning(
                "samples_left_out",
                f"{part.table.name}: {c} is {v:.0f} in {count(int(np.sum(part.channels[c] == v)), 'sample')}, "
                f"more than {MARKER_RATIO:g} times as large as all others: a marker of missing readings, which count as missing.",
            )
            for c, v in found.items()
        ]
        blank = {c: np.where(part.channels[c] == v, np.nan, part.channels[c]) for c, v in found.items()}
        cleared.append(part._replace(channels=part.channels | blank))
    return cleared, remarks


def _find_marker(x: NDArray[np.float64]) -> float | None:
    """Return the whole number that stands for missing readings in a column (N,), None if there is none."""
    known = x[np.isfinite(x)]
    for value in (known.min(), known.max()) if known.size else ():
        rest = known[known != value]
        is_rare = known.size - rest.size < rest.size
        if is_rare and value == round(value) and abs(value) >= max(MIN_MARKER, MARKER_RATIO * np.abs(rest).max()):
            return float(value)
    return None


def _join(
    parts: Sequence[_Part], channels: dict[str, NDArray[np.float64]], wanted: frozenset[str]
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]], list[str]]:
    """Return the clock, the channels on it and remarks."""
    main = parts[0]
    used = [c for c in channels if c in wanted]
    holes = np.isnan(main.clock.t)
    for column in used:
        holes |= np.isnan(channels[column])
    if len(parts) == 1 and not holes.any():
        _check_clock(main.table, main.clock.t)
        return main.clock.t, channels, []
    if len(parts) == 1 and np.mean(~holes) >= MIN_COMPLETE_SHARE:
        return _leave_out(main, channels, holes, used)
    groups = [group for part in parts for group in _group_by_rows(part, main.clock.epoch, wanted)]
    joined = join_clocks(main.table.name, groups)
    refuse_few(main.table.name, joined.rows.size)
    return groups[joined.main].t[joined.rows], joined.channels, list(joined.warnings)


def _leave_out(
    part: _Part, channels: dict[str, NDArray[np.float64]], holes: NDArray[np.bool_], used: Sequence[str]
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]], list[str]]:
    """Return the rows without holes, and a remark on the others."""
    kept = np.flatnonzero(~holes)
    table = part.table.take_rows(kept)
    refuse_few(table.name, table.n_rows)
    _check_clock(table, part.clock.t[kept])
    first = int(np.argmax(holes))
    names = [c for c in used if np.isnan(channels[c]).any()] or ["t"]
    sentence = (
        f"{part.table.where(first)}: {count(int(holes.sum()), 'sample')} without a number (empty or nan) in "
        f"{format_names(names, 3)}, from this line on, {'was' if holes.sum() == 1 else 'were'} left out."
    )
    rows = {column: values[kept] for column, values in channels.items()}
    return part.clock.t[kept], rows, [CodedWarning("samples_left_out", sentence)]


def _group_by_rows(part: _Part, epoch: int, wanted: frozenset[str]) -> list[Clocked]:
    """Return the used channels of a part, grouped by the rows in which they are filled."""
    t = part.clock.t + (part.clock.epoch - epoch) / 1e9
    groups: dict[bytes, list[str]] = {}
    for column in (c for c in part.channels if c in wanted):
        filled = np.isfinite(t) & np.isfinite(part.channels[column])
        groups.setdefault(np.packbits(filled).tobytes(), []).append(column)
    several = len(groups) > 1
    return [
        Clocked(
            f"{part.table.name}, column {columns[0]}" if several else part.table.name,
            t[filled := np.isfinite(t) & np.isfinite(part.channels[columns[0]])],
            {column: part.channels[column][filled] for column in columns},
        )
        for columns in groups.values()
    ]


def _check_episodes(table: Table) -> None:
    """Refuse several episodes as one log."""
    numbers = table.numbers_or_none(EPISODE) if EPISODE in table.cells else None
    if numbers is not None and np.any(numbers != numbers[0]):
        raise InputError(
            "time_stamps",
            f"{table.name} holds {np.unique(numbers).size} episodes, which are logs of their own; choose one in the column "
            f"map, as `episode: {numbers[0]:g}`.",
        )


MAX_SIGNALS = 200
"""Largest number of names in a column if signals come in rows; a robot's log has fewer."""

MIN_ROWS_A_SIGNAL = 5
"""Least rows of each name for samples of a signal; a column of comments repeats less."""


def refuse_signals_in_rows(table: Table) -> None:
    """Refuse a table with the name of a signal in each row and one column of values."""
    for column, cells in table.cells.items():
        if cells.dtype.kind != "O" or read_text_clock(cells[:1]) is not None:
            continue
        names, counts = np.unique(cells.astype(str), return_counts=True)
        if 2 <= names.size <= MAX_SIGNALS and counts.min() >= MIN_ROWS_A_SIGNAL and not any(map(is_blank, names)):
            raise InputError(
                "file_format",
                f"{table.name} holds its signals in rows: column {column} names them ({format_names(names, 4)}); a log has a "
                f"column for each, as pandas' df.pivot(index=CLOCK, columns='{column}', values=VALUE) gives.",
            )


AN_HOUR_S = 3600.0
"""Step back of local time when summer time ends [s]."""


def _check_clock(table: Table, t: NDArray[np.float64]) -> None:
    backwards = np.flatnonzero(np.diff(t) <= 0.0)
    if not backwards.size:
        return
    row = int(backwards[0]) + 1
    back = t[row - 1] - t[row]
    if abs(back - AN_HOUR_S) < 3 * abs(np.median(np.diff(t))):
        what = "the clock goes back by one hour, as local time does when summer time ends; log in UTC, or add 3600 s from there."
    elif t[row] == t[row - 1]:
        what = f"t = {_seconds(t[row])} s occurs twice; every sample needs a later time. Rounded? Write more digits."
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
