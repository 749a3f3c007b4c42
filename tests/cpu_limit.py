"""A limit of CPU time for each test: a test fails when it computes for too long, not when the machine is busy."""

from __future__ import annotations

import signal
from collections.abc import Generator
from types import FrameType

import pytest

CPU_LIMIT_S = 300.0
"""CPU time of one test [s]; the slowest one takes 60 s."""


def stop(number: int, frame: FrameType | None) -> None:
    """Fail the test that is running."""
    pytest.fail(f"the test used more than {CPU_LIMIT_S:g} s of CPU time")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, object, object]:
    """Run a test under the limit; processes that it starts do not count."""
    if not hasattr(signal, "setitimer"):  # Windows
        return (yield)
    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT_S)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)
