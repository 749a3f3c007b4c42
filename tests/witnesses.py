"""In CI (`CI=true`) every independent witness is there and every test runs; elsewhere what is missing skips its tests.

Results are compared with other programs: Drake, MuJoCo, CasADi, readers of recordings, a C compiler, a browser. Were one absent,
its tests would skip and the run be green. So a run in CI stops at once and says how to install what is missing, and any test that
skips fails, unless it stands in `MAY_SKIP` with its reason.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, distribution
from typing import Any

import pytest

PACKAGES = (
    "drake", "mujoco", "yourdfpy", "example-robot-data", "casadi", "fmpy", "opencv-python-headless", "rosbags", "mcap",
    "mcap-ros2-support", "viser", "distributed", "hypothesis", "jsonschema", "hatchling", "pooch",
)  # fmt: skip
"""Python packages, all of the extra `test`."""
PROGRAMS = {
    ("cc",): "apt-get install gcc libc6-dev",
    ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"): "apt-get install chromium",
}
"""Programs of which one of these names has to be on the path, and how they are installed."""
MAY_SKIP: dict[str, str] = {}
"""Tests that may skip in CI, by the beginning of their node id, each with the reason."""


WITHOUT = tuple(os.environ.get("TAU_DYN_WITHOUT", "").split())
"""Programs that the machine of this run does not let be installed; whoever starts it says so, and their tests may skip."""


def is_ci() -> bool:
    """Return whether this run has to have all witnesses."""
    return os.environ.get("CI") == "true"


def has_package(name: str) -> bool:
    """Return whether a Python package is installed."""
    try:
        return bool(distribution(name))
    except PackageNotFoundError:
        return False


def list_missing(
    has_package: Callable[[str], Any] = has_package,
    has_program: Callable[[str], Any] = shutil.which,
    without: tuple[str, ...] = (),
) -> list[str]:
    """Return a sentence with the install command for each witness that is not there."""
    missing = [
        f'{name} is missing: pip install {name}, or pip install ".[test]"' for name in PACKAGES if not has_package(name)
    ]
    return missing + [
        f"{names[0]} is missing: {command}"
        for names, command in PROGRAMS.items()
        if names[0] not in without and not any(map(has_program, names))
    ]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Stop a run in CI that lacks witnesses."""
    if is_ci() and not hasattr(session.config, "workerinput"):
        missing = list_missing(without=WITHOUT)
        if missing:
            raise pytest.UsageError("\n".join(missing))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Iterator[Any]:
    """Fail a test that skips in CI."""
    return _forbid((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[Any]:
    """Fail a module that skips as a whole in CI."""
    return _forbid((yield))


def _forbid(report: Any) -> Any:
    """Return a report, as a failure where it is a skip that CI does not allow."""
    if is_ci() and report.skipped and not hasattr(report, "wasxfail") and not report.nodeid.startswith(tuple(MAY_SKIP)):
        why = report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr
        if any(name in str(why) for name in WITHOUT):
            return report
        report.outcome, report.longrepr = "failed", f"no test may skip in CI (tests/witnesses.py): {why}"
    return report
