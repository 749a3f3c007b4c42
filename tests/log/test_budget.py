"""How many numbers a recording of messages may hold: every message's own and its two times."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from raising import raises_code

from tau_dyn.log import topic_columns
from tau_dyn.log.topic_columns import Budget, TopicRecorder


def plain(k: int) -> dict:
    return {"force": {"x": 1.0 + k, "y": 2.0}, "on": True, "frame": "tool", "picture": [0] * 65}


def states(k: int) -> dict:
    return {"name": ["a", "b"], "position": [0.1 * k, 0.2], "velocity": [], "effort": [1.0, 2.0]}


@pytest.mark.parametrize(("message", "numbers"), [(plain, 3), (states, 4)])
def test_a_message_costs_its_numbers_and_two_times(monkeypatch, message: Callable[[int], dict], numbers: int) -> None:
    """Ten messages fit into ten times that exactly; with one number less the tenth is refused, in one sentence."""
    for room, fits in ((10 * (numbers + 2), True), (10 * (numbers + 2) - 1, False)):
        monkeypatch.setattr(topic_columns, "MAX_CELLS", room)
        budget = Budget("run.mcap")
        recorder = TopicRecorder("/topic", "kind", budget)
        for k in range(9):
            recorder.add(k, message(k))
        assert budget.left == room - 9 * (numbers + 2)
        if fits:
            recorder.add(9, message(9))
            (topic,) = recorder.topics()
            assert topic.name == "topic" and len(topic.columns) == numbers and len(topic.log) == 10
        else:
            with raises_code("file_too_large", "run.mcap", f"{room}"):
                recorder.add(9, message(9))


def test_topics_share_their_files_budget(monkeypatch) -> None:
    """Two topics of five numbers a message, one after the other, use up ten."""
    monkeypatch.setattr(topic_columns, "MAX_CELLS", 14)
    budget = Budget("run.mcap")
    TopicRecorder("/one", "kind", budget).add(0, plain(0))
    TopicRecorder("/two", "kind", budget).add(0, plain(0))
    with raises_code("file_too_large", "14"):
        TopicRecorder("/three", "kind", budget).add(0, plain(0))
