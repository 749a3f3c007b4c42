"""Settings of the machine under which libraries fail: a limit of memory, warnings as errors, a terminal without columns."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tau_dyn.cli import describe_machine_fault

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="sets limits of Linux")
FK = [sys.executable, "-m", "tau_dyn", "fk", "linear_axis", "--q", "0.1"]


@pytest.mark.parametrize("kilobytes", [400_000, 150_000, 100_000, 40_000])
def test_a_limit_of_memory_is_a_sentence(kilobytes):
    """Below the size of its libraries the program ends with status 2 and one line, while it loads or at a command's work."""
    import resource

    limit = 1024 * kilobytes
    done = subprocess.run(
        FK, capture_output=True, text=True, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("error: out of memory"), done.stderr


def test_words_of_the_loader_are_recognised():
    """The loader, NumPy's wrapper of it and threads state a lack of memory in words; other import errors are no such lack."""
    told = "libeigenpy.so: failed to map segment from shared object"
    assert "ulimit -v" in str(describe_machine_fault(ImportError(told)))
    assert "ulimit -v" in str(describe_machine_fault(RuntimeError("can't start new thread")))
    assert describe_machine_fault(ImportError("No module named 'viser'")) is None
    assert describe_machine_fault(RuntimeError("something else")) is None


def test_a_terminal_without_columns_is_one_of_unknown_width():
    """A calling program may set COLUMNS=0, at which no text can be wrapped."""
    done = subprocess.run(FK, capture_output=True, text=True, env=os.environ | {"COLUMNS": "0"})
    assert done.returncode == 0 and done.stderr == "" and "tool x" in done.stdout


def import_slowly(name: str, action: str, then: str) -> list[str]:
    """Return a program that does something when a module of this name is imported, and then something else."""
    code = (
        "import importlib.abc, pathlib, sys, time, warnings\n"
        "class Finder(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name == {name!r}:\n"
        f"            {action}\n"
        f"sys.meta_path.insert(0, Finder())\n{then}\n"
    )
    return [sys.executable, "-c", code]


@pytest.mark.parametrize("name", ["tau_dyn.cli.app", "pinocchio"])
def test_a_warning_of_a_library_is_no_fault(name):
    """With PYTHONWARNINGS=error a library that warns while it is loaded, at the start or by a command, is loaded all the same."""
    warn, run = "warnings.warn('old', DeprecationWarning)", "from tau_dyn.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [*import_slowly(name, warn, run), *FK[3:]]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONWARNINGS": "error"})
    assert done.returncode == 0 and done.stderr == "" and "tool x" in done.stdout


def test_an_interrupt_while_it_loads_is_a_sentence(tmp_path: Path):
    """Ctrl-C within the imports ends with status 130 and one line."""
    mark = tmp_path / "loads"
    wait = f"pathlib.Path({str(mark)!r}).touch(); time.sleep(60)"
    command = import_slowly("tau_dyn.cli.app", wait, "import tau_dyn.cli")
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None,
    ) as running:  # fmt: skip
        begun = time.monotonic()
        while not mark.exists() and time.monotonic() - begun < 60:
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=60)
    assert (running.returncode, out, err) == (130, "", "interrupted; every output file is as it was, or complete\n")


@pytest.mark.parametrize(("program", "status"), [("tau-dyn", 130), ("mine.py", 7)])
def test_an_interrupt_of_the_first_import_is_a_sentence(program: str, status: int):
    """Ctrl-C while the package's own first modules load ends `tau-dyn` in one line, and stays an exception in other programs."""
    code = (
        f"import importlib.abc, os, signal, sys\nsys.argv = ['/usr/bin/{program}', 'robots']\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Finder(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'lazy_loader':\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "try:\n    from tau_dyn.cli import main\nexcept KeyboardInterrupt:\n    os._exit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    sentence = "interrupted; every output file is as it was, or complete\n" if program == "tau-dyn" else ""
    assert (done.returncode, done.stderr) == (status, sentence)
