"""Recorded messages of many topics, read once, of which the needed topics are kept: what MCAP files and bags share.

Without a map those are the joint states, or all where no type says so; with one, those that the map names as well. Only these are
decoded. A file that breaks off, as a recording does whose computer lost power, is read up to there with a warning.
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
from tau_dyn.log.table import Table
from tau_dyn.log.topic_columns import Budget, Topic, TopicRecorder
from tau_dyn.log.topics import build_topic_table

MAX_MESSAGE_BYTES = 2**22
"""A message larger than this [bytes] is a picture or a cloud, and is passed over."""


class Recorded(NamedTuple):
    """One message: its topic, when it was recorded [ns], its size [bytes], and what decodes it."""

    topic: str
    kind: str
    log: int
    size: int
    decode: Callable[[], Any]


def build_message_table(
    path: Path,
    files: Sequence[Path],
    messages: Iterator[Recorded],
    kinds: Mapping[str, str],
    wanted: Mapping[str, str] | None,
    warnings: list[str],
) -> Table:
    """Return recorded messages as a table; see `topics.table_of`.

    Args:
        path: What was asked for, for messages.
        files: The files behind it, for the hash.
        messages: All messages; they are decoded only where needed.
        kinds: Type by topic, as far as it is known beforehand.
        wanted: The columns that a map asks for, by our names; None without a map.
        warnings: What reading has to say; filled while `messages` runs.
    """
    budget = Budget(path.name)
    recorders: dict[str, TopicRecorder] = {}
    need = _needed(kinds, wanted)
    others: set[str] = set()
    for message in messages:
        if message.size > MAX_MESSAGE_BYTES or not need(message.topic, message.kind):
            others.add(message.topic.lstrip("/"))
            continue
        if message.topic not in recorders:
            recorders[message.topic] = TopicRecorder(message.topic, message.kind, budget)
        recorders[message.topic].add(message.log, message.decode())
    topics = [topic for recorder in recorders.values() for topic in recorder.topics()]
    if not topics:
        about = f"it has {format_names(sorted(others))}" if others else "it has no messages"
        raise InputError(
            "file_format",
            f"{path.name} has no joint states, and no topic that a map names: {about}; name one in a column map.",
        )
    digest = compute_joint_sha256(map(compute_sha256, files))
    return build_topic_table(path, digest, _in_order(topics), wanted, warnings)


def _needed(kinds: Mapping[str, str], wanted: Mapping[str, str] | None) -> Callable[[str, str], bool]:
    """Return what tells whether a topic of some type is decoded."""
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
    """Return what a library says of a fault, in a line that fits into ours."""
    text = " ".join(str(fault).split()).rstrip(".")
    return text[:120] or type(fault).__name__
