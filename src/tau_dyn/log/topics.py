"""Recorded messages of many topics, each with a clock of its own, become one table on the main topic's clock.

Messages are read once. Without a map the joint states are decoded, or all messages if no type is a joint state; with a map, the
topics that it names are decoded, too. A file that breaks off (the computer lost power) is read up to there with a warning.

The main topic is the one that a column map takes positions from, else the only one with joint states, else the only one with
columns of ours. Its own fields get our names, and all of them are kept as `topic.field`; fields of other topics are added only if
a map names them, interpolated (`resample.py`) with a warning. The clock is the header's stamp if every topic in use has one: the
stamp is the time of measurement, the log time that of arrival (a map may choose the latter: `t: TOPIC.log_time`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_joint_sha256, compute_sha256
from tau_dyn.log.column_names import format_names
from tau_dyn.log.resample import resample_to_clock
from tau_dyn.log.table import Table
from tau_dyn.log.topic_columns import Budget, Topic, TopicRecorder
from tau_dyn.message_codes import CodedWarning

LOG_TIME = "log_time"
MIN_OVERLAP = 0.5
"""Share of the main topic's messages that another one has to cover."""


def build_topic_table(
    path: Path, sha256: str, topics: Sequence[Topic], wanted: Mapping[str, str] | None, warnings: Sequence[str] = ()
) -> Table:
    """Return the topics as one table.

    Args:
        path: The file.
        sha256: Hash of its bytes.
        topics: Its topics.
        wanted: The file's columns that a map asks for, by our names; None without a map.
        warnings: Doubts found while reading, one sentence each.

    Raises:
        InputError: It is not clear which topic is meant, a column asked for does not exist, or clocks do not match.
    """
    wanted = dict(wanted or {})
    main = _main(path.name, topics, wanted)
    others = _others(path.name, topics, main, wanted)
    clock = _Clock(path.name, (main, *(topic for topic, _ in others)), wanted)
    keep = clock.distinct(main)
    t = clock.seconds(main)[keep]
    covered = np.ones(t.size, bool)
    for topic, _ in others:
        covered &= clock.covers(topic, t)
    if covered.sum() < MIN_OVERLAP * t.size:
        names = format_names([topic.name for topic, _ in others])
        raise InputError(
            "mismatch",
            f"{path.name}: {names} and {main.name} were recorded together for {covered.mean():.0%} of the messages only; their "
            "clocks have to be one and the same.",
        )
    chosen = np.flatnonzero(keep)[covered]
    cells = {"t": t[covered], **_own(main, chosen)}
    said = [*warnings, *clock.said(main, int((~keep).sum()), int((~covered).sum()))]
    for topic, column in others:
        cells[column], how = clock.moved(topic, column, t[covered])
        said += [f"{path.name}: {column} was put on the clock of {main.name or 'the log'}: {how}."] if how else []
    return Table(path.name, path, sha256, cells, chosen + 1, _word(main), tuple(said))


def _main(name: str, topics: Sequence[Topic], wanted: Mapping[str, str]) -> Topic:
    if not topics:
        raise InputError("file_format", f"{name} has no topic with numbers in it; a log needs joint positions.")
    for key in (*(k for k in wanted if k.startswith("q_")), *wanted):
        for topic in topics:
            if _field(topic, wanted[key]) is not None:
                return topic
    for kind in ([t for t in topics if t.joints], [t for t in topics if t.ours], list(topics)):
        positions = [t for t in kind if any(c.startswith("q_") for c in t.ours)] or kind
        named = [t for t in positions if t.name.rpartition("/")[2] == "joint_states"]
        most = named or positions
        if len({t.name for t in most}) == 1:
            return most[0]  # of one name, the joints with the most messages come first
        if most:
            break
    raise InputError(
        "file_format",
        f"{name} has the topics {format_names(_names(topics))}, and it is not clear which is the log; a column map names it: "
        f"q_axis: {_example(topics)}.",
    )


def _others(name: str, topics: Sequence[Topic], main: Topic, wanted: Mapping[str, str]) -> list[tuple[Topic, str]]:
    """Return the topics and columns that a map takes from other topics than the main one."""
    found = []
    for ours, column in wanted.items():
        if _field(main, column) is not None or column in main.ours or column in ("t", main.full(LOG_TIME)):
            continue
        topic = next((t for t in topics if _field(t, column) is not None), None)
        if topic is None:
            known = [t.full(field) for t in topics for field in t.columns]
            start = column.rpartition(".")[0].split(".")[0]
            near = [c for c in known if start and c.startswith(start)] or known
            raise InputError(
                "missing_column",
                f"{name} has no column {column}, which the map takes for {ours}; it has {format_names(near)}.",
            )
        if (topic, column) not in found:
            found.append((topic, column))
    return found


def _field(topic: Topic, column: str) -> str | None:
    """Return the topic's field of a column of the file, or None."""
    start = topic.full("")
    field = column.removeprefix(start)
    return field if column.startswith(start) and field in topic.columns else None


def _own(main: Topic, chosen: np.ndarray) -> dict[str, np.ndarray]:
    """Return the main topic's columns, under our names and under its own, and the times at which its messages were recorded."""
    cells = {ours: main.columns[field][chosen] for ours, field in main.ours.items() if ours != "t"}
    if main.name:
        cells |= {main.full(field): column[chosen] for field, column in main.columns.items()}
    else:
        cells |= {field: column[chosen] for field, column in main.columns.items() if field not in ("t", *cells)}
    if main.log.dtype.kind == "i" and main.log.size:
        cells[main.full(LOG_TIME)] = (main.log - main.log[0])[chosen] / 1e9
    return cells


class _Clock:
    """The times of all topics in use, from one kind of clock."""

    def __init__(self, name: str, used: Sequence[Topic], wanted: Mapping[str, str]) -> None:
        self.name, self.used = name, used
        asked = wanted.get("t", "").endswith(f".{LOG_TIME}")
        self.lacking = [topic.name for topic in used if topic.stamp is None]
        self.stamped = not asked and not self.lacking
        self.asked = asked
        first = self._times(used[0])
        self._epoch = first[0] if first.dtype.kind == "i" and first.size else 0

    def _times(self, topic: Topic) -> np.ndarray:
        return topic.stamp if self.stamped and topic.stamp is not None else topic.log

    def seconds(self, topic: Topic) -> np.ndarray:
        """Return times (N,) [s]; of messages, from the main topic's first."""
        times = self._times(topic)
        return (times - self._epoch) / 1e9 if times.dtype.kind == "i" else times

    def distinct(self, topic: Topic) -> np.ndarray:
        """Return which messages (N,) are no repetition of the one before.

        Raises:
            InputError: The clock goes back, or does not advance while the numbers change.
        """
        times = self._times(topic)
        keep = np.ones(times.size, bool)
        wrong = np.flatnonzero(np.diff(times) <= 0) + 1
        for k in wrong:
            same = times[k] == times[k - 1] and all(_equal(c[k], c[k - 1]) for c in topic.columns.values())
            if not same:
                self._refuse(topic, int(k))
        keep[wrong] = False
        return keep

    def covers(self, topic: Topic, t: np.ndarray) -> np.ndarray:
        own = self.seconds(topic)
        return (t >= own.min()) & (t <= own.max()) if own.size else np.zeros(t.size, bool)

    def moved(self, topic: Topic, column: str, wanted: np.ndarray) -> tuple[np.ndarray, str]:
        """Return a column of another topic at the main one's times (M,) [s], and how."""
        field = _field(topic, column) or ""
        if field in topic.truths:
            raise InputError(
                "file_format", f"{self.name}: {column} is true or false, which cannot be put on another topic's clock."
            )
        keep = self.distinct(topic)
        t, x = self.seconds(topic)[keep], topic.columns[field][keep]
        if not np.isfinite(x).all():
            row = int(np.flatnonzero(keep)[int(np.argmin(np.isfinite(x)))]) + 1
            raise InputError(
                "bad_sample",
                f"{self.name}, {_word(topic)} {row} of {topic.name}: {column} is not a finite number; each needs one.",
            )
        return resample_to_clock(f"{self.name}: {column}", t, x, wanted)

    def said(self, main: Topic, repeated: int, cut: int) -> list[str]:
        """Return sentences about the clock and the messages that were left out."""
        said: list[str] = []
        if main.log.dtype.kind == "f":
            pass
        elif self.stamped:
            said = [
                CodedWarning(
                    "stamps_chosen",
                    f"{self.name}: t is the stamp in the messages of {main.name} from the first on, not the time of "
                    "recording.",
                )
            ]
        elif not self.asked:
            said = [
                f"{self.name}: t is when messages of {main.name} were recorded, from the first on, since "
                f"{format_names(self.lacking)} "
                "has no stamps; the delay on the way is in it."
            ]
        samples, topic = f"{_word(main)}(s)", main.name or "the log"
        if repeated:
            said.append(f"{self.name}: {repeated} {samples} of {topic} repeat the one before, and were left out.")
        if cut:
            said.append(
                f"{self.name}: {cut} {samples} of {topic} at its ends were left out; other topics have no samples there."
            )
        return said

    def _refuse(self, topic: Topic, k: int) -> None:
        times = self.seconds(topic)
        what = "stands still" if times[k] == times[k - 1] else "goes back"
        remedy = (
            f"a map with 't: {topic.full(LOG_TIME)}' takes the times of recording"
            if self.stamped
            else "cut the log there"
        )
        raise InputError(
            "time_stamps",
            f"{self.name}, {_word(topic)} {k + 1} of {topic.name or 'the log'}: its clock {what} (t = {times[k]:.9g} s after "
            f"{times[k - 1]:.9g} s); was something restarted? {remedy}.",
        )


def _word(topic: Topic) -> str:
    return "message" if topic.log.dtype.kind == "i" else "row"


def _equal(a: float, b: float) -> bool:
    return a == b or (a != a and b != b)


def _names(topics: Sequence[Topic]) -> list[str]:
    return list(dict.fromkeys(topic.name for topic in topics))


def _example(topics: Sequence[Topic]) -> str:
    return next((topic.full(field) for topic in topics for field in topic.columns), "topic.position.axis")


MAX_MESSAGE_BYTES = 2**22
"""A message larger than this [bytes] is a picture or a cloud, and is skipped."""


class Recorded(NamedTuple):
    """One message: its topic, time of recording [ns], size [bytes], and decoder."""

    topic: str
    kind: str
    log: int
    size: int
    decode: Callable[[], Any]


def build_message_table(
    path: Path,
    files: Sequence[Path],
    messages: Iterator[Recorded | str],
    kinds: Mapping[str, str],
    wanted: Mapping[str, str] | None,
) -> Table:
    """Return recorded messages as a table; see `build_topic_table`.

    Args:
        path: The file or folder, for error messages.
        files: Its files, for the hash.
        messages: All messages, which are decoded only if needed, and sentences about doubts.
        kinds: Type by topic, as far as it is known beforehand.
        wanted: The columns that a map asks for, by our names; None without a map.
    """
    budget = Budget(path.name)
    recorders: dict[str, TopicRecorder] = {}
    need = _needed(kinds, wanted)
    others: set[str] = set()
    warnings: list[str] = []
    for message in messages:
        if isinstance(message, str):
            warnings.append(message)
        elif message.size > MAX_MESSAGE_BYTES or not need(message.topic, message.kind):
            others.add(message.topic.lstrip("/"))
        else:
            if message.topic not in recorders:
                recorders[message.topic] = TopicRecorder(message.topic, message.kind, budget)
            recorders[message.topic].add(message.log, message.decode())
    topics = [topic for recorder in recorders.values() for topic in recorder.topics()]
    if not topics:
        seen = others | {topic.lstrip("/") for topic in recorders}
        named = {topic.lstrip("/"): f" ({kind})" for topic, kind in kinds.items()}
        listed = format_names([f"{topic}{named.get(topic, '')}" for topic in sorted(seen)])
        about = f"it has {listed}" if seen else "it has no messages"
        raise InputError(
            "file_format",
            f"{path.name} has no joint states, and no topic that a map names: {about}; name one in a column map.",
        )
    digest = compute_joint_sha256(map(compute_sha256, files))
    return build_topic_table(path, digest, _in_order(topics), wanted, warnings)


def _needed(kinds: Mapping[str, str], wanted: Mapping[str, str] | None) -> Callable[[str, str], bool]:
    """Return the function that decides whether a topic of some type is decoded."""
    joints = any(_is_joint_state(kind) for kind in kinds.values())
    columns = tuple((wanted or {}).values())

    def need(topic: str, kind: str) -> bool:
        start = f"{topic.lstrip('/')}."
        return not joints or _is_joint_state(kind) or any(column.startswith(start) for column in columns)

    return need


def _is_joint_state(kind: str) -> bool:
    return kind.replace(".", "/").rpartition("/")[2] == "JointState"


def _in_order(topics: Sequence[Topic]) -> list[Topic]:
    """Sort each topic's messages by the time of recording, which files need not be."""
    out = []
    for topic in topics:
        order = np.argsort(topic.log, kind="stable")
        if np.array_equal(order, np.arange(order.size)):
            out.append(topic)
            continue
        columns = {field: column[order] for field, column in topic.columns.items()}
        stamp = None if topic.stamp is None else topic.stamp[order]
        out.append(replace(topic, log=topic.log[order], stamp=stamp, columns=columns))
    return out


def describe_fault(fault: BaseException) -> str:
    """Return a library's error message as one line that fits into ours."""
    text = " ".join(str(fault).split()).rstrip(".")
    return text[:120] or type(fault).__name__
