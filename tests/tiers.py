"""The fast tier of the tests: tests recorded as longer than a second are marked `long`, except one of each room.

`pytest` leaves the marked ones out, `nox -s tests_all` runs everything. `long_tests.txt` lists the test functions of which a case
takes more than a second, slowest first, with their seconds; `python experiments/test_durations.py` writes it.
"""

from __future__ import annotations

from pathlib import Path

import pytest

RECORD = Path(__file__).with_name("long_tests.txt")


def read_long_tests(text: str) -> dict[str, float]:
    """Return seconds by test, such as `tests/log/test_read.py::test_a_row`, from the lines of the record."""
    rows = (line.split() for line in text.splitlines() if line and not line.startswith("#"))
    return {name: float(seconds) for seconds, name in rows}


def select_witnesses(seconds: dict[str, float]) -> set[str]:
    """Return the shortest long test of each room: the fast tier keeps one test of a room that goes the whole way."""
    shortest: dict[str, str] = {}
    for name in sorted(seconds, key=lambda name: seconds[name]):
        shortest.setdefault(name.split("/")[1], name)
    return set(shortest.values())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the long tests before `-m` selects."""
    seconds = read_long_tests(RECORD.read_text(encoding="utf-8"))
    long = set(seconds) - select_witnesses(seconds)
    for item in items:
        if item.nodeid.partition("[")[0] in long:
            item.add_marker("long")
