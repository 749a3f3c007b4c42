"""In CI a missing witness stops the run with the install command, and a skipped test is a failure."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from witnesses import PACKAGES, PROGRAMS, list_missing

TESTS = Path(__file__).resolve().parents[1]
SKIPS = """
import pytest
def test_that_runs(): pass
def test_that_skips(): pytest.skip("nothing to compare with")
@pytest.mark.xfail(strict=True)
def test_that_is_known_to_fail(): raise AssertionError
"""
WHOLE = 'import pytest\npytest.importorskip("no_such_witness")\ndef test_compared(): pass\n'


def run(folder: Path, ci: str, path: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run the tests of a folder with the plugin."""
    env = {**os.environ, "CI": ci, "PYTHONPATH": str(TESTS), "PATH": os.environ["PATH"] if path is None else path}
    env.pop("TAU_DYN_WITHOUT", None)
    command = [sys.executable, "-m", "pytest", "-p", "witnesses", "-q", "-rA", "--rootdir", str(folder), str(folder)]
    return subprocess.run(command, env=env, cwd=folder, capture_output=True, text=True)


def needs_all_witnesses() -> None:
    missing = list_missing()
    if missing:
        pytest.skip("; ".join(missing))


def test_each_missing_witness_is_named_with_its_command() -> None:
    """One at a time: a package of the extra by pip, a program by the system's packages; any name of a program will do."""
    for hidden in PACKAGES:
        (said,) = list_missing(lambda name, hidden=hidden: name != hidden, lambda name: True)
        assert f"pip install {hidden}" in said
    for names, command in PROGRAMS.items():
        (said,) = list_missing(lambda name: True, lambda name, names=names: name not in names)
        assert command in said
        assert not list_missing(lambda name: True, lambda name, names=names: name not in names[:-1] or len(names) == 1)


def test_a_run_in_ci_without_a_compiler_does_not_begin(tmp_path) -> None:
    """With nothing on the path, no test runs and the commands stand in the message."""
    (tmp_path / "test_small.py").write_text("def test_that_runs(): pass\n")
    done = run(tmp_path, "true", path=str(tmp_path))
    assert done.returncode == pytest.ExitCode.USAGE_ERROR and "1 passed" not in done.stdout
    assert all(command in done.stderr for command in PROGRAMS.values())
    assert run(tmp_path, "", path=str(tmp_path)).returncode == 0


def test_a_program_that_cannot_be_installed_is_named_by_hand() -> None:
    """Only what is named may be absent."""
    said = list_missing(lambda name: True, lambda name: False, ("chromium",))
    assert len(said) == len(PROGRAMS) - 1 and "chromium" not in said[0]


def test_a_skip_is_a_failure_in_ci_alone(tmp_path) -> None:
    """The run is green elsewhere; in CI the skipped test and its reason are a failure, what is known to fail is none."""
    needs_all_witnesses()
    (tmp_path / "test_skips.py").write_text(SKIPS)
    green, red = run(tmp_path, ""), run(tmp_path, "true")
    assert green.returncode == 0 and "1 passed, 1 skipped, 1 xfailed" in green.stdout
    assert (
        red.returncode == 1
        and "1 failed, 1 passed, 1 xfailed" in red.stdout
        and "nothing to compare with" in red.stdout
    )


def test_a_module_that_skips_is_a_failure_in_ci(tmp_path) -> None:
    """An absent witness hides a whole module: the run does not stay green."""
    needs_all_witnesses()
    (tmp_path / "test_whole.py").write_text(WHOLE)
    assert run(tmp_path, "").returncode == pytest.ExitCode.NO_TESTS_COLLECTED
    red = run(tmp_path, "true")
    assert red.returncode not in (0, pytest.ExitCode.NO_TESTS_COLLECTED) and "no_such_witness" in red.stdout


def test_a_listed_test_may_skip_in_ci(tmp_path) -> None:
    """What stands in the list with a reason skips as elsewhere."""
    needs_all_witnesses()
    (tmp_path / "test_skips.py").write_text(SKIPS)
    (tmp_path / "conftest.py").write_text(
        'import witnesses\nwitnesses.MAY_SKIP["test_skips.py::test_that_skips"] = "no"\n'
    )
    done = run(tmp_path, "true")
    assert done.returncode == 0 and "1 skipped" in done.stdout
