"""Messages of one topic become columns: a joint state's by joint, every other message's numbers by the path to them.

A joint state is any message with a list `name` of texts and lists `position`, `velocity`, `effort`
(sensor_msgs/JointState of ROS 1 and 2, or JSON of that shape). Its columns are `position.axis`, .. and become ours: `q_axis`,
`v_axis`, `tau_axis`. In other messages every number is a column: `pose.position.x`, `data[2]`; if its name is one of ours
(`q_axis`), it is ours. Lists longer than `LONGEST_LIST` are pictures or clouds, not signals, and are skipped.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import islice
from numbers import Real
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log.column_names import is_contract_name

OURS = {"position": "q", "velocity": "v", "effort": "tau"}
"""A joint state's lists, and our signals for them."""

LONGEST_LIST, MOST_COLUMNS, DEEPEST = 64, 500, 8

MAX_CELLS = 50_000_000
"""Largest count of numbers from one file (0.4 GB); more should be in Parquet, which is read in windows."""


@dataclass(frozen=True, eq=False)
class Topic:
    """The messages of a file under one name and one clock.

    Attributes:
        name: Name without its leading slash; empty for a file's own level, whose columns have no prefix.
        kind: The messages' type, for error messages.
        log: Time of recording of each message (N,): whole nanoseconds, or seconds as floats.
        stamp: Time of measurement of each message, from its own header (N,), in the same unit; None without headers.
        columns: Numbers by field (N,); NaN where a message lacks it.
        ours: Our column names, and the field of each.
        truths: Fields that are true or false.
        joints: Whether it holds joint states.
    """

    name: str
    kind: str
    log: np.ndarray
    stamp: np.ndarray | None
    columns: dict[str, np.ndarray]
    ours: dict[str, str]
    truths: frozenset[str] = frozenset()
    joints: bool = False

    def full(self, field: str) -> str:
        """Return a field's name in the file: `joint_states.position.axis`."""
        return f"{self.name}.{field}" if self.name else field


class Budget:
    """Counts the numbers taken from a file."""

    def __init__(self, name: str) -> None:
        """Count for a file of this name."""
        self.name, self.left = name, MAX_CELLS

    def take(self, n: int) -> None:
        """Take `n` numbers, or refuse the file."""
        self.left -= n
        if self.left < 0:
            raise InputError(
                "file_too_large",
                f"{self.name} holds more than {MAX_CELLS} numbers in the topics asked for; cut it, or convert it to Parquet, "
                "which is read in windows.",
            )


class TopicRecorder:
    """Collects one topic's messages."""

    def __init__(self, topic: str, kind: str, budget: Budget) -> None:
        """Start empty."""
        self.name, self.kind, self.budget = topic.lstrip("/"), kind, budget
        self._joints: dict[tuple[str, ...], _Joints] = {}
        self._plain: _Plain | None = None
        self.n = 0

    def add(self, log: int, message: Any) -> None:
        """Take one message, recorded at `log` [ns]."""
        self.n += 1
        names = _item(message, "name")
        stamp = _stamp(message)
        if _are_texts(names) and _item(message, "position") is not None:
            key = tuple(sorted(names))
            if key not in self._joints:
                self._joints[key] = _Joints(tuple(names))
            where = f"{self.budget.name}, message {self.n} of {self.name}"
            self.budget.take(self._joints[key].add(log, stamp, tuple(names), message, where))
        else:
            if self._plain is None:
                self._plain = _Plain(message)
            self.budget.take(self._plain.add(log, stamp, message))

    def topics(self) -> Iterator[Topic]:
        """Yield the collected messages: one topic, or one for each set of joints that sends messages of its own."""
        groups = sorted(self._joints.values(), key=lambda group: -len(group.log))
        for group in groups:
            yield group.topic(self.name, self.kind)
        if self._plain is not None and self._plain.paths:
            yield self._plain.topic(self.name, self.kind)


class _Joints:
    """Joint states of one set of joints, in the order of the first of them."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names, self.log, self.stamp = names, array("q"), array("q")
        self.values = {field: array("d") for field in OURS}

    def add(self, log: int, stamp: int, names: tuple[str, ...], message: Any, where: str) -> int:
        place = {n: k for k, n in enumerate(names)}
        if len(place) < len(names):
            raise InputError(
                "duplicate_name", f"{where} names a joint twice; every joint of a joint state needs a name of its own."
            )
        if len(names) > MOST_COLUMNS:
            raise InputError("file_too_large", f"{where} has {len(names)} joints; a robot has {MOST_COLUMNS} at most.")
        order = None if names == self.names else [place[n] for n in self.names]
        taken = 0
        for field, values in self.values.items():
            given = _item(message, field)
            try:
                numbers = [] if given is None else list(given)
            except TypeError:
                raise InputError("bad_sample", f"{where}: {field} is no list of numbers.") from None
            if len(numbers) not in (0, len(names)):
                raise InputError(
                    "bad_sample",
                    f"{where} has {len(names)} names and {len(numbers)} in {field}; all joints need one, or no joint does.",
                )
            try:
                values.extend(map(float, numbers if order is None or not numbers else [numbers[k] for k in order]))
            except (TypeError, ValueError, OverflowError):
                raise InputError("bad_sample", f"{where}: {field} holds something else than numbers.") from None
            taken += len(numbers)
        self.log.append(log)
        self.stamp.append(stamp)
        return taken + 2

    def topic(self, name: str, kind: str) -> Topic:
        n, k = len(self.log), len(self.names)
        columns: dict[str, np.ndarray] = {}
        ours: dict[str, str] = {}
        for field, values in self.values.items():
            if not k or len(values) == 0:
                continue
            if len(values) != n * k:
                raise InputError(
                    "file_format",
                    f"{name}: only some of its messages have {field}; either all of them need it, or no joint does.",
                )
            for joint, column in zip(self.names, np.frombuffer(values).reshape(n, k).T, strict=True):
                if not np.isnan(column).all():  # a driver without torque sensing sends NaN
                    columns[f"{field}.{joint}"] = column.copy()
                    ours[f"{OURS[field]}_{joint}"] = f"{field}.{joint}"
        return Topic(name, kind, *_clocks(self.log, self.stamp), columns, ours, joints=True)


class _Plain:
    """Messages of any other shape; the first one determines which numbers there are."""

    def __init__(self, message: Any) -> None:
        found = list(islice(_numbers(message, (), 0), MOST_COLUMNS))
        self.paths = [path for path, _ in found]
        self.truths = frozenset(_label(path) for path, value in found if isinstance(value, bool | np.bool_))
        self.log, self.stamp, self.values = array("q"), array("q"), array("d")

    def add(self, log: int, stamp: int, message: Any) -> int:
        self.log.append(log)
        self.stamp.append(stamp)
        self.values.extend(_follow(message, path) for path in self.paths)
        return len(self.paths) + 2

    def topic(self, name: str, kind: str) -> Topic:
        n = len(self.log)
        table = np.frombuffer(self.values).reshape(n, len(self.paths))
        columns = {_label(path): column.copy() for path, column in zip(self.paths, table.T, strict=True)}
        ours = {label: label for label in columns if is_contract_name(label)}
        log, stamp = _clocks(self.log, self.stamp)
        if "t" in columns and stamp is None:
            ours.pop("t")
            stamp = _nanoseconds(columns["t"])
        return Topic(name, kind, log, stamp, columns, ours, self.truths)


def _clocks(log: array, stamp: array) -> tuple[np.ndarray, np.ndarray | None]:
    """Return both clocks; a header that was never filled in has 0, and does not count."""
    stamps = np.frombuffer(stamp, dtype=np.int64).copy()
    return np.frombuffer(log, dtype=np.int64).copy(), stamps if stamps.size and np.all(stamps > 0) else None


def _nanoseconds(seconds: np.ndarray) -> np.ndarray | None:
    return np.round(seconds * 1e9).astype(np.int64) if np.all(np.abs(seconds) < 9e9) else None


def _stamp(message: Any) -> int:
    """Return a message's own time [ns], or 0 without one."""
    header = _item(message, "header")
    stamp = _item(header, "stamp") if header is not None else None
    for at in (stamp, _item(message, "stamp"), _item(message, "timestamp")):
        seconds = _item(at, "sec") if _item(at, "sec") is not None else _item(at, "secs")
        if isinstance(seconds, int) and 0 <= seconds < 9e9:
            rest = (_item(at, name) for name in ("nanosec", "nsec", "nsecs"))
            nanoseconds = next((x for x in rest if isinstance(x, int) and 0 <= x < 10**9), 0)
            return seconds * 10**9 + nanoseconds
    return 0


def _item(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _are_texts(names: Any) -> bool:
    return isinstance(names, list | tuple) and bool(names) and all(isinstance(n, str) for n in names)


def _parts(message: Any) -> list[tuple[str, Any]]:
    """Return a message's fields by name; an empty list for other objects."""
    if isinstance(message, dict):
        return [(key, value) for key, value in message.items() if isinstance(key, str)]
    if is_dataclass(message) and not isinstance(message, type):
        return [(f.name, getattr(message, f.name)) for f in fields(message)]
    return [(name, getattr(message, name, None)) for name in getattr(type(message), "__slots__", ()) or ()]


def _numbers(value: Any, path: tuple[str | int, ...], depth: int) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Yield every number in a message with the path to it; headers and long lists are skipped."""
    if isinstance(value, Real | np.bool_):
        yield path, value
    elif isinstance(value, str | bytes | bytearray) or depth > DEEPEST:
        return
    elif isinstance(value, list | tuple | np.ndarray):
        if len(value) <= LONGEST_LIST:
            for k, item in enumerate(value):
                yield from _numbers(item, (*path, k), depth + 1)
    else:
        for name, item in _parts(value):
            if name not in ("header", "stamp", "timestamp"):
                yield from _numbers(item, (*path, name), depth + 1)


def _follow(message: Any, path: tuple[str | int, ...]) -> float:
    """Return the number at a path, NaN if this message has no number there."""
    try:
        for step in path:
            message = message[step] if isinstance(step, int) or isinstance(message, dict) else getattr(message, step)
        return float(message) if isinstance(message, Real | np.bool_) else np.nan
    except (KeyError, IndexError, AttributeError, TypeError, OverflowError):
        return np.nan


def _label(path: tuple[str | int, ...]) -> str:
    """Return a path as text: `data[2]`, `pose.position.x`."""
    return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in path).lstrip(".")
