"""Column maps from a foreign log to our columns: names, units, clocks, coupled transmissions, several files.

A map is YAML. Each key is one of our column names, each value a foreign column's name or a mapping with `column` and,
optionally, `scale`, `offset` and `file`; ours = scale * theirs + offset. Three keys are not columns: `files` names
further files of the same recording, relative to the folder of the log, sampled together or with a clock each
(`files: {f: {path: forces.csv, t: stamp}}`; a column with the name of the main clock is found without `t`); `episode: N` takes
the rows whose `episode_index` is N; a column's number, from 1, names it in a file without a header; `couplings` holds matrices
for coupled transmissions (scale and offset first, then ours = matrix @ theirs + offset, joints in the order of their keys
in the map); and `t: {rate_hz: F}` makes a clock. Numbers are numbers: no expression in a map is evaluated. The map is
applied in `read.py`.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tau_dyn.exceptions import InputError, require_kind
from tau_dyn.files import read_yaml
from tau_dyn.log.column_names import (
    SIGNALS,
    find_named_scale_of,
    format_names,
    is_contract_name,
    map_joints,
    split_signal,
)

SOURCE_KEYS = ("column", "scale", "offset", "file")

_IN_SI = "; units are a scale to SI ones, as scale: 0.001 of mm"
_HINTS: Mapping[Any, str] = {int: "; numbers have a decimal point, as 0.001", "unit": _IN_SI, "units": _IN_SI}
"""Remedies for invalid keys, by the key or its type."""


@dataclass(frozen=True)
class Source:
    """Source of one of our columns: ours = scale * theirs + offset."""

    column: str
    scale: float = 1.0
    offset: float = 0.0
    file: str | None = None
    """Key in the map's `files`; None for the log given on the command line."""
    is_si: bool = False
    """Whether the map gives a scale of 1, which overrides a unit in the column's name or below the header."""


@dataclass(frozen=True, eq=False)
class Coupling:
    """A coupled transmission: ours = matrix @ theirs + offset, after each column's own scale and offset."""

    joints: tuple[str, ...]
    matrix: NDArray[np.float64]
    """(n, n), rows and columns in the order of `joints`."""
    offset: NDArray[np.float64]
    """(n,) in our unit."""

    def apply(self, theirs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return our samples (N, n) from theirs (N, n)."""
        return theirs @ self.matrix.T + self.offset


@dataclass(frozen=True, eq=False)
class ColumnMap:
    """A map of columns, checked on loading.

    Attributes:
        sources: Foreign column of each of ours, in the map's order.
        rate_hz: Sampling rate [Hz] of a log without a clock, else None.
        couplings: Coupled transmissions by signal.
        files: Names of further files, relative to the log's folder.
        name: The map's file name, for messages.
        episode: The `episode_index` whose rows are the log; None for all rows.
        clocks: Clock of each further file that has one of its own, by the file's key.
    """

    sources: Mapping[str, Source]
    rate_hz: float | None = None
    couplings: Mapping[str, Coupling] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    name: str = "column map"
    episode: int | None = None
    clocks: Mapping[str, Source] = field(default_factory=dict)

    @property
    def is_numbered(self) -> bool:
        """Whether columns are given by number."""
        return any(source.column.isdigit() for source in self.sources.values())

    @classmethod
    def load(cls, path: str | Path) -> "ColumnMap":
        """Read a map from a YAML file.

        Raises:
            InputError: The file is missing, is not YAML, or holds a key, a type or a matrix that is not valid in a map.
        """
        require_kind(path, str | Path, "column map", "a ColumnMap, or the path of its file")
        return cls.from_dict(_read_entries(Path(path)), name=Path(path).name)

    @classmethod
    def from_dict(cls, entries: Mapping[Any, Any], name: str = "column map") -> "ColumnMap":
        """Check a map's entries, as YAML gives them, and return the map."""
        entries = dict(entries)
        files, clocks = _files(name, entries.pop("files", {}))
        couplings = entries.pop("couplings", {})
        episode = entries.pop("episode", None)
        if episode is not None and (type(episode) is not int or episode < 0):
            raise _build_error(name, f"episode is {episode!r}, and has to be a whole number from 0 up.")
        rate_hz = _rate(name, entries)
        sources = {_our_name(name, key, value): _source(name, key, value, files) for key, value in entries.items()}
        if not sources and rate_hz is None:
            raise InputError(
                "file_format", f"{name} maps no column; give at least one line such as 'q_axis: position'."
            )
        unused = set(files) - {source.file for source in sources.values()}
        if unused:
            raise _build_error(name, f"no column is taken from file '{min(unused)}'; use it or leave it out of files.")
        coupled = _couplings(name, couplings, tuple(sources))
        _refuse_named_units(name, {ours: s for ours, s in sources.items() if split_signal(ours) not in coupled})
        return cls(sources, rate_hz, coupled, files, name, episode, clocks)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries, as YAML gives them."""
        files = {
            key: {"path": path, "t": _to_entry(self.clocks[key])} if key in self.clocks else path
            for key, path in self.files.items()
        }
        couplings = {
            key: value
            for signal, coupling in self.couplings.items()
            for key, value in ((signal, coupling.matrix.tolist()), (f"{signal}_offset", coupling.offset.tolist()))
        }
        special = {"files": files, "episode": self.episode, "couplings": couplings}
        clock = {} if self.rate_hz is None else {"t": {"rate_hz": self.rate_hz}}
        columns = {ours: _to_entry(source) for ours, source in self.sources.items()}
        return {**{k: v for k, v in special.items() if v not in (None, {})}, **clock, **columns}


def _to_entry(source: Source) -> Any:
    """Return the entry of a map for a source."""
    more = {"scale": (source.scale, 1.0), "offset": (source.offset, 0.0), "file": (source.file, None)}
    given = {key: value for key, (value, default) in more.items() if value != default}
    given |= {"scale": 1.0} if source.is_si else {}
    return {"column": source.column, **given} if given else source.column


def _read_entries(path: Path) -> dict[Any, Any]:
    entries = read_yaml(path)
    if not isinstance(entries, dict):
        example = "such as 'q_axis: position'"
        raise InputError(
            "file_format",
            f"{path.name} has to hold one 'our_column: their_column' a line, {example}, not {_kind(entries)}.",
        )
    return entries


def _our_name(name: str, key: Any, value: Any = None) -> str:
    if not isinstance(key, str) or not is_contract_name(key):
        if isinstance(value, str) and is_contract_name(value):
            raise _build_error(
                name, f"'{key}: {value}' is the wrong way round; write '{value}: {key}', our name first."
            )
        known = "t, files, couplings, episode, temp_room, x_tool.. and " + ", ".join(
            f"{signal}_JOINT" for signal in SIGNALS
        )
        raise _build_error(name, f"key {key} is not one of our column names, which are {known}.")
    return key


def _source(name: str, key: str, value: Any, files: Mapping[str, str]) -> Source:
    if isinstance(value, str) or _is_column_number(value):
        return Source(str(value))
    if not isinstance(value, dict):
        raise _build_error(
            name, f"{key} has to be a column's name or {{column: .., scale: .., offset: ..}}, not {_kind(value)}."
        )
    unknown = [k for k in value if k not in SOURCE_KEYS]
    if unknown:
        hint = _HINTS.get(type(unknown[0]), _HINTS.get(unknown[0], ""))
        raise _build_error(name, f"{key} has a key {unknown[0]}; it may have {format_names(SOURCE_KEYS)}{hint}.")
    column = value.get("column")
    if not isinstance(column, str) and not _is_column_number(column):
        raise _build_error(name, f"{key} needs a 'column', the foreign column's name as text (in quotes if need be).")
    file = value.get("file")
    if file is not None and (not isinstance(file, str) or file not in files):
        raise _build_error(name, f"{key} names file {file}, and 'files' has {format_names(files)}.")
    scale, offset = (_number(f"{name}: {key}.{k}", value.get(k, d)) for k, d in (("scale", 1.0), ("offset", 0.0)))
    if scale == 0.0:
        raise _build_error(name, f"{key}.scale is 0, which would erase the column; give a number other than 0.")
    return Source(str(column), scale, offset, file, is_si=scale == 1.0 and "scale" in value)


def _refuse_named_units(name: str, sources: Mapping[str, Source]) -> None:
    """Refuse a column without a scale whose name gives another unit than an SI one; a coupling's matrix may hold a scale."""
    for ours, source in sources.items():
        scale = find_named_scale_of(ours, source.column)
        if scale not in (None, 1.0) and source.scale == 1.0 and not source.is_si:
            file = f"file: {source.file}, " if source.file else ""
            column = source.column if re.fullmatch(r"\w+", source.column) else f'"{source.column}"'
            raise _build_error(
                name,
                f"{ours} takes {source.column}, whose name gives another unit than SI; write "
                f"`{ours}: {{{file}column: {column}, scale: {scale:.9g}}}`, or `scale: 1` if its numbers are in SI.",
            )


def _is_column_number(value: Any) -> bool:
    """Return whether a value gives a column by its number, from 1."""
    return type(value) is int and value > 0


def _rate(name: str, entries: dict[Any, Any]) -> float | None:
    """Take `t: {rate_hz: F}` out of the entries and return F, or None if `t` is a column."""
    clock = entries.get("t")
    if not isinstance(clock, dict) or "rate_hz" not in clock:
        return None
    if len(clock) > 1:
        raise InputError(
            "time_stamps",
            f"{name}: t has rate_hz and {format_names(set(clock) - {'rate_hz'})}; a log without a clock has rate_hz only.",
        )
    rate = _number(f"{name}: t.rate_hz", entries.pop("t")["rate_hz"])
    if rate <= 0.0:
        raise _build_error(name, f"t.rate_hz is {rate:g}; it has to be a positive number of samples a second.")
    return rate


def _files(name: str, value: Any) -> tuple[dict[str, str], dict[str, Source]]:
    """Return the paths of further files and the clocks that are given for them, by their keys."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise _build_error(name, "files has to be a mapping such as {pos: positions.csv, cur: currents.csv}.")
    paths, clocks = {}, {}
    for key, given in value.items():
        path, clock = (given.get("path"), given.get("t")) if isinstance(given, dict) else (given, None)
        if not isinstance(path, str) or isinstance(given, dict) and set(given) - {"path", "t"}:
            raise _build_error(
                name,
                f"files.{key} has to be a path, or {{path: forces.csv, t: CLOCK}} for a file with a clock of its own.",
            )
        _check_path(name, key, path)
        paths[key] = path
        if clock is not None:
            clocks[key] = _source(name, f"files.{key}.t", clock, {})
    return paths, clocks


def _check_path(name: str, key: str, path: str) -> None:
    windows = PureWindowsPath(path)  # understands both kinds of separators
    if (
        not path.strip()
        or windows.drive
        or windows.root
        or ".." in windows.parts
        or path.startswith("~")
        or "\0" in path
    ):
        raise _build_error(name, f"files.{key} is '{path}'; name a file in the log's own folder or below it.")


def _couplings(name: str, value: Any, columns: tuple[str, ...]) -> dict[str, Coupling]:
    """Check the matrices against the joints that the map gives to each signal."""
    allowed = [key for signal in SIGNALS for key in (signal, f"{signal}_offset")]
    if not isinstance(value, dict) or any(key not in allowed for key in value):
        wrong = format_names(k for k in value if k not in allowed) if isinstance(value, dict) else _kind(value)
        raise _build_error(
            name, f"couplings holds {wrong}; it may hold matrices q, tau, v, a, q_ref and lists such as q_offset."
        )
    couplings = {}
    for signal in dict.fromkeys(key.removesuffix("_offset") for key in value):
        joints = tuple(joint for kind, joint in map_joints(columns) if kind == signal)
        n = len(joints)
        matrix = _array(f"{name}: couplings.{signal}", value.get(signal, np.eye(n).tolist()), (n, n), signal)
        offset = _array(f"{name}: couplings.{signal}_offset", value.get(f"{signal}_offset", [0.0] * n), (n,), signal)
        couplings[signal] = Coupling(joints, matrix, offset)
    return couplings


def _array(where: str, value: Any, shape: tuple[int, ...], signal: str) -> NDArray[np.float64]:
    rows = value if isinstance(value, list) else [value]
    cells = [cell for row in rows for cell in (row if isinstance(row, list) else [row])]
    numbers = [_number(where, cell) for cell in cells]
    flat = len(shape) == 1
    fits = len(rows) == shape[0] and all(
        isinstance(row, list) != flat and (flat or len(row) == shape[1]) for row in rows
    )
    if not fits or not cells:
        wanted = " by ".join(map(str, shape))
        raise InputError(
            "wrong_shape", f"{where} has to hold {wanted} numbers, for the {shape[0]} joints with a key {signal}_JOINT."
        )
    return np.asarray(numbers, dtype=np.float64).reshape(shape)


def _number(where: str, value: Any) -> float:
    """Return a number; YAML reads `1e-3` as text, which is accepted, but expressions are not evaluated."""
    try:
        number = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else np.nan
    except (ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise InputError(
            "file_format", f"{where} is {value!r}, and has to be a finite number written out, such as 0.0174532925."
        )
    return number


def _build_error(name: str, sentence: str) -> InputError:
    """Return the error for an invalid map."""
    return InputError("file_format", f"{name}: {sentence}")


def _kind(value: Any) -> str:
    words = {dict: "a mapping", list: "a list", bool: "yes or no", type(None): "nothing", str: "one text"}
    return words.get(type(value), "a number")
