"""What is taken from messages: a joint's number by its name, every other by the path to it, and who stamped it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log.topic_columns import DEEPEST, LONGEST_LIST, MOST_COLUMNS, Budget, Topic, TopicRecorder


def recorded(*messages: Any, times: list[int] | None = None) -> list[Topic]:
    """Return what becomes of messages of one topic."""
    recorder = TopicRecorder("/arm", "kind", Budget("run.mcap"))
    for k, message in enumerate(messages):
        recorder.add(times[k] if times else 100 + k, message)
    return list(recorder.topics())


def state(names: list[str], **lists: Any) -> dict[str, Any]:
    return {"name": names, "position": [], "velocity": [], "effort": [], **lists}


def test_a_joints_numbers_follow_its_name() -> None:
    """In whatever order a message lists them; what it does not send is no column."""
    (topic,) = recorded(
        state(["a", "b"], position=[1.0, 2.0], effort=[5.0, 6.0]),
        state(["b", "a"], position=[4.0, 3.0], effort=[8.0, 7.0]),
    )
    assert topic.name == "arm" and topic.joints and topic.ours == {
        "q_a": "position.a", "q_b": "position.b", "tau_a": "effort.a", "tau_b": "effort.b",
    }  # fmt: skip
    for field, values in (("position.a", [1, 3]), ("position.b", [2, 4]), ("effort.a", [5, 7]), ("effort.b", [6, 8])):
        assert_array_equal(topic.columns[field], values)
    assert topic.full("position.a") == "arm.position.a"
    assert_array_equal(topic.log, [100, 101])


def test_the_joints_that_send_most_come_first() -> None:
    """Another set of joints on the same topic is a topic of its own."""
    arm, grip = state(["a", "b"], position=[1.0, 2.0]), state(["grip"], position=[0.5])
    first, second = recorded(grip, arm, arm)
    assert (list(first.columns), list(second.columns)) == (["position.a", "position.b"], ["position.grip"])


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (state(["a", "a"], position=[1.0, 2.0]), "message 2 of arm names a joint twice"),
        (state([f"j{k}" for k in range(MOST_COLUMNS + 1)]), f"has {MOST_COLUMNS + 1} joints; a robot has {MOST_COLUMNS} at most"),
        (state(["a", "b"], position=1.0), "position is no list of numbers"),
        (state(["a", "b"], position=[1.0]), "has 2 names and 1 in position"),
        (state(["a", "b"], position=[1.0, 2.0], effort=[1.0, 2.0, 3.0]), "has 2 names and 3 in effort"),
        (state(["a", "b"], position=[1.0, "high"]), "position holds something else than numbers"),
        (state(["b", "a"], position=[None, 1.0]), "position holds something else than numbers"),
        (state(["a", "b"], position=[1.0, 10**400]), "position holds something else than numbers"),
    ],
)  # fmt: skip
def test_a_joint_state_that_cannot_be_is_named_by_its_number(message: dict[str, Any], said: str) -> None:
    """The file, the message and the topic."""
    with pytest.raises(InputError, match="^run.mcap, message 2 of arm.*" + said.removeprefix("message 2 of arm")):
        recorded(state(["a", "b"], position=[1.0, 2.0]), message)


def test_a_list_is_in_every_message_or_in_none() -> None:
    """Efforts that come and go are nobody's column; joints up to a number that no robot has are read."""
    with raises_code("file_format"):
        recorded(state(["a"], position=[1.0], effort=[2.0]), state(["a"], position=[1.0]))
    many = [f"j{k}" for k in range(MOST_COLUMNS)]
    (topic,) = recorded(state(many, position=[0.0] * MOST_COLUMNS))
    assert len(topic.columns) == MOST_COLUMNS


@dataclass
class Wrench:
    """A message as one library hands it out."""

    force: Any
    on: bool
    header: Any = None


class Slots:
    """As another one does."""

    __slots__ = ("force", "on")

    def __init__(self, force: Any, on: bool) -> None:
        """Keep both."""
        self.force, self.on = force, on


@pytest.mark.parametrize(
    "make", [lambda **x: x, lambda **x: Wrench(**x), lambda **x: Slots(**x)], ids=["json", "class", "slots"]
)
def test_every_number_of_another_message_is_a_column(make) -> None:
    """By the path to it; what a later message lacks is NaN; true and false are told apart from numbers."""
    first = make(force={"x": 1.0, "list": [2, np.float32(3.5)], "word": "7", "none": None}, on=True)
    second = make(force={"x": 4, "list": [5]}, on=False)
    (topic,) = recorded(first, second)
    assert list(topic.columns) == ["force.x", "force.list[0]", "force.list[1]", "on"]
    assert_array_equal(topic.columns["force.x"], [1, 4])
    assert_array_equal(topic.columns["force.list[0]"], [2, 5])
    assert_array_equal(topic.columns["force.list[1]"], [3.5, np.nan])
    assert_array_equal(topic.columns["on"], [1, 0])
    assert topic.truths == {"on"} and topic.ours == {} and not topic.joints and topic.stamp is None


def test_pictures_headers_and_bottomless_messages_are_passed_over() -> None:
    """Lists as long as a signal's are signals; what stands eight levels deep still is."""
    deep: Any = 1.0
    for k in range(DEEPEST + 1):
        deep = {f"d{k}": deep}
    message = {
        "short": [0] * LONGEST_LIST, "long": [0] * (LONGEST_LIST + 1), "header": {"seq": 3}, "stamp": {"sec": 0}, "timestamp": 3,
        "deep": deep, "less": deep[f"d{DEEPEST}"], "data": b"12",
    }  # fmt: skip
    (topic,) = recorded(message)
    groups = [name.partition("[")[0].partition(".")[0] for name in topic.columns]
    assert groups.count("short") == LONGEST_LIST and set(groups) == {"short", "less"}
    wide = {f"c{k}": k for k in range(MOST_COLUMNS + 3)}
    assert len(recorded(wide)[0].columns) == MOST_COLUMNS


def test_our_names_are_ours_and_t_is_a_clock() -> None:
    """`t` [s] stands for the stamp where messages have none; a number that no time is stays a column."""
    (topic,) = recorded({"t": 0.5, "q_a": 1.0, "x": 2.0}, {"t": 0.502, "q_a": 2.0, "x": 2.0})
    assert topic.ours == {"q_a": "q_a"} and topic.stamp is not None
    assert_array_equal(topic.stamp, [500_000_000, 502_000_000])
    (late,) = recorded({"t": 1e10, "q_a": 1.0})
    assert late.stamp is None and late.ours == {"q_a": "q_a"}


@pytest.mark.parametrize(
    ("where", "ns"),
    [
        ({"header": {"stamp": {"sec": 5, "nanosec": 7}}}, 5_000_000_007),
        ({"header": {"stamp": {"secs": 5, "nsecs": 8}}}, 5_000_000_008),
        ({"stamp": {"sec": 5, "nsec": 9}}, 5_000_000_009), ({"timestamp": {"sec": 5, "nsec": 999_999_999}}, 5_999_999_999),
        ({"stamp": {"sec": 5, "nanosec": 10**9}}, 5_000_000_000), ({"stamp": {"sec": 5, "nanosec": -1}}, 5_000_000_000),
        ({"stamp": {"sec": 5}}, 5_000_000_000), ({"stamp": {"sec": 0, "nanosec": 1}}, 1),
    ],
)  # fmt: skip
def test_a_messages_own_time_is_its_stamp(where: dict[str, Any], ns: int) -> None:
    """Of its header, or of its own field, as ROS 1, ROS 2 and JSON write it; a part of a second that is none is left out."""
    (topic,) = recorded({**where, "x": 1.0}, {**where, "x": 2.0})
    assert topic.stamp is not None
    assert_array_equal(topic.stamp, [ns, ns])


@pytest.mark.parametrize(
    "where",
    [{}, {"header": {"stamp": {"sec": 0, "nanosec": 0}}}, {"stamp": {"sec": -1}}, {"stamp": {"sec": 9 * 10**9}},
     {"stamp": 5.0}, {"stamp": {"sec": 5.5}}],
)  # fmt: skip
def test_a_time_that_is_none_leaves_the_recorders(where: dict[str, Any]) -> None:
    """Never filled in, negative, beyond all calendars, or a number without units: one such message is enough."""
    good = {"stamp": {"sec": 5}, "x": 1.0}
    (topic,) = recorded(good, {**where, "x": 2.0}, times=[70, 80])
    assert topic.stamp is None
    assert_array_equal(topic.log, [70, 80])
