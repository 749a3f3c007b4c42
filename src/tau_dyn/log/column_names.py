"""Column names of a log, read as a signal and a joint, and faults of a cell, a header or a whole file.

A column is `signal_joint`: `q_ref_cart1` is the signal `q_ref` of the joint `cart1`. `t` [s] is the clock, the tool's columns
and `temp_room` [degC] belong to no joint. All other names are foreign: they are kept, and this module does not interpret
them. The list is the contract's; `table.py` and `read.py` read the files. The likeliest mistakes have messages of their own:
dates, decimal commas, a line of units, other names, other programs' files.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence

DEGREE = math.pi / 180  # rad

CONTACTS = ("contact_", "force_")
"""Prefixes of columns that hold the contact of a foot with the ground, 0 or 1, or its force [N]."""
SIGNALS = ("q_ref", "q_link", "voltage", "current", "temp", "tau", "cmd", "pwm", "q", "v", "a")
"""Signals a joint may have. `q_ref` comes before `q`, so that `q_ref_J` is not read as `q` of `ref_J`, and so does `q_link`,
the position measured behind the drive, on the load side. `cmd` is the command to a servo. `voltage` [V]
and `current` [A] are a motor's, `pwm` its share of the supply."""

TOOL_COLUMNS = (
    "x_tool", "y_tool", "z_tool",
    "qx_tool", "qy_tool", "qz_tool", "qw_tool",
    "rx_tool", "ry_tool", "rz_tool",
    "ax_tool", "ay_tool", "az_tool",
)  # fmt: skip
"""Tool position [m], orientation quaternion and acceleration [m/s^2]."""

ROOM_TEMPERATURE = "temp_room"


def split_column_name(column: str) -> tuple[str, str] | None:
    """Return the signal and the joint that a column name denotes, or None if it denotes no joint."""
    if column == ROOM_TEMPERATURE or column in TOOL_COLUMNS:
        return None
    for signal in SIGNALS:
        if column.startswith(f"{signal}_") and len(column) > len(signal) + 1:
            return signal, column[len(signal) + 1 :]
    return None


def is_contract_name(column: str) -> bool:
    """Return whether a column map may define the name: `t`, a joint's signal, a tool column, `temp_room` or a foot's contact."""
    alone = column in ("t", ROOM_TEMPERATURE, *TOOL_COLUMNS) or column.startswith(CONTACTS)
    return alone or split_column_name(column) is not None


def list_used_columns(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that the library uses; each of their cells has to be a number.

    All but `q_`, `q_ref_` and `tau_` count only if there is a `q_` column of the same joint: a foreign log's
    `a_comment` is no joint's acceleration.
    """
    columns = tuple(columns)
    joints = {joint for signal, joint in map_joints(columns) if signal == "q"}
    return tuple(c for c in columns if _is_used(c, joints))


def map_joints(columns: Iterable[str]) -> tuple[tuple[str, str], ...]:
    """Return the (signal, joint) pairs among the columns, in their order."""
    return tuple(pair for pair in map(split_column_name, columns) if pair is not None)


def format_names(names: Iterable[str], limit: int = 12) -> str:
    """Return names as one comma-separated phrase, cut after `limit` of them, for a message."""
    names = list(names)
    phrase = ", ".join(map(str, names[:limit])) or "nothing"
    return phrase if len(names) <= limit else f"{phrase} and {len(names) - limit} more"


def _is_used(column: str, joints: set[str]) -> bool:
    pair = split_column_name(column)
    if pair is None:
        return is_contract_name(column)
    return pair[0] in ("q", "q_ref", "tau") or pair[1] in joints


_DATE = re.compile(r"\d{4}[-/.]\d{1,2}[-/.]\d{1,2}|\d{1,2}[/.]\d{1,2}[/.]\d{2,4}|\d{1,2}:\d{2}")
_A_LOG = "A log is CSV with the columns t, q_JOINT, tau_JOINT, or Parquet, MCAP, a ROS bag or .mat"
_OTHER_FILES = {
    b"PK\x03\x04": "an Excel workbook or another zip archive; save its sheet as CSV in UTF-8",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook; save its sheet as CSV in UTF-8",
    b"\x1f\x8b": "compressed by gzip; unpack it first",
    b"<": f"XML, such as a robot file; were robot and log exchanged? {_A_LOG}",
    b"%PDF": "a PDF; give the recording itself, as CSV",
    b"PAR1": "a Parquet file; let its name end in .parquet",
    b"\x89HDF": "an HDF5 file (MATLAB 7.3 is one); export it as CSV or Parquet, from MATLAB with save(.., '-v7')",
}
"""First bytes of a file that is no table -> its format, and a remedy."""


MAX_READING = 1e25
"""Largest number that any unit explains: a time in ns since 1970 is 2e18."""


def describe_bad_cell(cell: object, largest: float) -> str:
    """Return why a cell is not a usable number, and a correct form."""
    text = "" if cell is None else str(cell).strip()
    if not text:
        return "the cell is empty; every sample needs a number here"
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity", "na", "null", "<na>"):
        return (
            f"{text} is not a finite number; every sample needs one here (leave out the line of a sample that was lost)"
        )
    if text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit():
        return f"{text!r} has a decimal comma; write numbers with a decimal point"
    if _DATE.match(text):
        return f"{text[:40]!r} is a date or a time of day; write seconds, such as 0.004, from any start"
    if _is_number(text) and abs(float(text)) > MAX_READING:
        return f"{text[:40]} is no reading in any unit: the file is damaged there; remove the damaged rows"
    if _is_number(text):
        return f"{text[:40]} is beyond {largest:.0e}, larger than anything in SI units; a scale in a column map brings it to them"
    return f"{text[:40]!r} is not a number; write it as 0.125 or 1.25e-1"


def is_blank(cell: object) -> bool:
    """Return whether a cell denotes a missing number: empty, or a program's word for it."""
    return cell is None or str(cell).strip().lower() in _MISSING


_MISSING = frozenset(
    ("", "nan", "-nan", "+nan", "na", "n/a", "#n/a", "#na", "null", "<na>", "none", "nat", "-", "--", "---")
)


def is_time_text(cell: object) -> bool:
    """Return whether a cell begins like a date or a time of day."""
    return bool(_DATE.match(str(cell).strip()))


def is_unit_row(first: object, second: object) -> bool:
    """Return whether a column's first cell is a unit above numbers, such as `[s]`."""
    text = str(first).strip()
    return (
        not is_blank(text)
        and not any(c.isdigit() for c in text)
        and len(text) <= 12
        and _is_number(str(second).strip())
    )


def describe_foreign_file(data: bytes) -> str:
    """Return the format of a file that is clearly no table, with a remedy; empty if it may be a table."""
    known = next((words for start, words in _OTHER_FILES.items() if data.startswith(start)), "")
    if known:
        return known
    if _is_json(data):
        return f"JSON. {_A_LOG}"
    return f"YAML, such as a model file or a column map. {_A_LOG}" if _YAML.match(data[:400]) else ""


_YAML = re.compile(rb"(?:#[^\n]*\n)*(?:- |---\s*\n|\w+: *[^\s,;\t]*\r?\n)")
"""A file's first line that is not a comment: an item, a document's start, or a key with one word at most."""


def _is_json(data: bytes) -> bool:
    """Return whether a file begins like JSON; a header may begin with a bracket as well, such as `[s]`."""
    text = data[:400].removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:1] == b"{":
        return True
    if text[:1] != b"[":
        return False
    try:
        json.JSONDecoder().raw_decode(text[1:].lstrip().decode("utf-8", "replace"))
    except ValueError:
        return text[1:].lstrip()[:1] in (b"{", b"[")
    return True


def find_nearest_column(name: str, columns: Iterable[str]) -> str:
    """Return the column with this name except for capitals, blanks and punctuation; empty without a match."""
    return next((c for c in columns if _bare(c) == _bare(name)), "")


def _bare(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum())


def describe_missing_column(file: str, name: str, columns: Sequence[str], why: str = "", more: str = "") -> str:
    """Return the sentence about a missing column, with the existing columns and the probably intended one.

    Args:
        file: The log's name.
        name: The missing column.
        columns: The existing columns.
        why: A clause on who needs it.
        more: A clause on further remedies.
    """
    if len(columns) == 1 and columns[0].count(" ") > 1:
        return f"{file} has one column, '{columns[0][:60]}'; separate names and cells by commas, semicolons or tabs."
    near = find_nearest_column(name, columns)
    hint = f" (did you mean {near}?)" if near else ""
    return f"{file} has no column {name}{why}{hint}; it has {format_names(columns)}{more}."


def split_words(name: str) -> tuple[str, ...]:
    """Return a name's words in lower case, numbers among them."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))


def find_named_scale(column: str, kind: str) -> float | None:
    """Return the size in SI of the unit in a column's name; None if the name has no unit."""
    words = split_words(re.sub("([mk])Nm", r"\1nm", column))[1:]  # else m and Nm are two words
    return next((scale for unit, scale in _SCALES[kind].items() if unit in words), None)


def split_signal(column: str) -> str:
    """Return the signal of one of our columns: `q` of `q_axis`; a name without a joint as it is."""
    pair = split_column_name(column)
    return pair[0] if pair else column


def _find_kind(column: str) -> str:
    """Return the kind of quantity of one of our columns, by which its units are known."""
    signal = split_signal(column)
    return {"q_ref": "q", "q_link": "q"}.get(signal, signal)


def find_named_scale_of(ours: str, column: str) -> float | None:
    """Return the size in SI of the unit in a foreign column's name for one of our columns; None if the name has no unit."""
    kind = _find_kind(ours)
    return find_named_scale(column.replace("°", "deg"), kind) if kind in _SCALES else None


def find_scale_of_unit(unit: str, column: str) -> float | None:
    """Return the size in SI of a unit that is given for one of our columns; None if the unit is unknown."""
    kind = _find_kind(column)
    text = unit.strip("[]() ").lower().replace("°", "deg")
    words = split_words(text.partition("/")[0])
    return next((_SCALES[kind][word] for word in words if word in _SCALES.get(kind, {})), None)


def describe_missing_clock(file: str, columns: Sequence[str]) -> str:
    """Return the sentence about a log without `t`."""
    clock = next((c for c in columns if c.strip("[]() ").lower() in _CLOCKS or c.lower().startswith("time")), "")
    scale = find_named_scale(clock, "t")
    entry = clock or "NAME" if scale in (None, 1.0) else f"{{column: {clock}, scale: {scale:g}}}"
    line = f"`t: {entry}`, or `t: {{rate_hz: F}}` without a clock,"
    more = (
        f"; name the clock t [s], or write {line} into a column map (--columns MAP.yaml); tau-dyn columns LOG ROBOT proposes "
        "the whole map"
    )
    return describe_missing_column(file, "t", columns, more=more)


_SCALES: Mapping[str, Mapping[str, float]] = {
    "t": {"ns": 1e-9, "nanoseconds": 1e-9, "us": 1e-6, "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3, "s": 1.0, "sec": 1.0},
    "q": {"deg": DEGREE, "degrees": DEGREE, "mrad": 1e-3, "rad": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "m": 1.0},
    "v": {"deg": DEGREE, "degrees": DEGREE, "rad": 1.0, "rpm": math.pi / 30, "mm": 1e-3},
    "tau": {"mnm": 1e-3, "knm": 1e3, "ncm": 1e-2, "nmm": 1e-3, "nm": 1.0},
}  # fmt: skip
"""Units that a name may contain, and their size in SI."""

_CLOCKS = ("t", "time", "zeit", "temps", "timestamp", "stamp", "clock", "sec", "seconds")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # which Python takes, and no logger writes
