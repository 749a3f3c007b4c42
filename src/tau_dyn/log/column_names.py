"""Column names of a log, read as a signal and a joint.

A column is `signal_joint`: `q_ref_cart1` is the signal `q_ref` of the joint `cart1`. `t` [s] is the clock, the tool's
columns stand alone, and `temp_room` [degC] belongs to no joint. All other names are foreign: they are kept, and nothing
here interprets them. The list is the contract's; how files are read lives in `table.py` and `read.py`.
"""

from collections.abc import Iterable

SIGNALS = ("q_ref", "q_link", "temp", "tau", "q", "v", "a")
"""Signals a joint may have; `q_ref` stands before `q`, so that `q_ref_J` is not read as `q` of `ref_J`, and so does `q_link`,
the position read behind the drive, on the load side."""

TOOL_COLUMNS = (
    "x_tool", "y_tool", "z_tool",
    "qx_tool", "qy_tool", "qz_tool", "qw_tool",
    "ax_tool", "ay_tool", "az_tool",
)  # fmt: skip
"""Tool position [m], orientation quaternion and acceleration [m/s^2]."""

ROOM_TEMPERATURE = "temp_room"


def split_column_name(column: str) -> tuple[str, str] | None:
    """Return the signal and the joint that a column name stands for, or None where it stands for no joint."""
    if column == ROOM_TEMPERATURE or column in TOOL_COLUMNS:
        return None
    for signal in SIGNALS:
        if column.startswith(f"{signal}_") and len(column) > len(signal) + 1:
            return signal, column[len(signal) + 1 :]
    return None


def is_contract_name(column: str) -> bool:
    """Tell whether a column map may define the name: `t`, a joint's signal, a tool column or `temp_room`."""
    return column in ("t", ROOM_TEMPERATURE, *TOOL_COLUMNS) or split_column_name(column) is not None


def list_used_columns(columns: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that the library uses, and whose every cell therefore has to be a number.

    `v_`, `a_`, `q_link_` and `temp_` count only beside a `q_` column of the same joint: a foreign log's `a_comment` is nobody's
    acceleration.
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


def count(n: int, noun: str) -> str:
    """Return `1 gap`, `3 gaps`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _is_used(column: str, joints: set[str]) -> bool:
    pair = split_column_name(column)
    if pair is None:
        return is_contract_name(column)
    return pair[0] in ("q", "q_ref", "tau") or pair[1] in joints
