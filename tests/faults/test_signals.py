"""Told to end, a command says one line, leaves with the status that shells expect, and has written nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tau_dyn.cli import Ended, describe_machine_fault, unwind_on_signal
from tau_dyn.cli.ending import ASKED, Interrupted

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def heeded() -> None:
    """Let this process hear Ctrl-C, which a shell's background jobs are born deaf to."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def spent(process: int) -> float:
    """Return the processor time [s] of a process."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_long_command_ends_in_one_line(tmp_path: Path, number: int, status: int) -> None:
    """Ctrl-C, and what batch systems send at the end of the time: one line, no traceback, no file, no temporary one."""
    command = [sys.executable, "-m", "tau_dyn.cli", "demo", "--out", "made", "--quiet", "--json", "r.json"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          preexec_fn=heeded) as running:  # fmt: skip
        begun = time.monotonic()
        while spent(running.pid) < 2.0 and time.monotonic() - begun < 60:
            time.sleep(0.05)
        running.send_signal(number)
        out, err = running.communicate(timeout=60)
    assert running.returncode == status and out == ""
    assert err.count("\n") == 1 and "every output file is as it was, or complete" in err, err
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_what_others_do_with_signals_stays_theirs() -> None:
    """Under nohup a closing terminal still ends nothing, and a program that calls the command line keeps its handlers."""
    before = {s: signal.getsignal(s) for s in (signal.SIGINT, *ASKED)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with unwind_on_signal():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert signal.getsignal(signal.SIGTERM) is not before[signal.SIGTERM]
        assert signal.getsignal(signal.SIGTERM) is before[signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert {s: signal.getsignal(s) for s in before} == before


SPOILS = """
import os, signal
class Wraps:
    def __set_name__(self, owner, name):
        os.kill(os.getpid(), signal.SIGTERM)
class Owner:
    part = Wraps()
try:
    os.kill(os.getpid(), signal.SIGTERM)
except BaseException:
    pass
WHOLE = True
"""


def test_a_request_waits_for_an_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An import that would wrap the request in another error, or swallow it, ends first; then the request is heard."""
    (tmp_path / "spoils_requests.py").write_text(SPOILS)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Ended) as told, unwind_on_signal():
        import spoils_requests  # pyright: ignore[reportMissingImports]

        assert spoils_requests.WHOLE
        time.sleep(10)
    assert told.value.code == 143


def test_a_request_comes_again_where_a_destructor_swallowed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python can only report what a destructor raises; Ctrl-C at that moment still ends the command, and nothing is reported."""

    class Swallows:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    before, gone = signal.getsignal(signal.SIGINT), Swallows()
    heeded()
    try:
        with pytest.raises(Interrupted), unwind_on_signal():
            del gone
            time.sleep(10)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sys.unraisablehook is sys.__unraisablehook__


def test_an_interruption_in_executed_text_leaves_with_its_status(tmp_path: Path) -> None:
    """Ctrl-C within an `exec` of text (a dataclass being made): `python -m` still leaves with the status, not by the signal."""
    (tmp_path / "executes.py").write_text(
        "import sys\n"
        "from tau_dyn.cli.ending import unwind_on_signal\n"
        "try:\n"
        "    with unwind_on_signal():\n"
        "        exec('import os; os.kill(os.getpid(), 2); import time; time.sleep(10)')\n"
        "except KeyboardInterrupt:\n"
        "    sys.exit(130)\n"
    )
    ended = subprocess.run([sys.executable, "-m", "executes"], cwd=tmp_path, timeout=60, preexec_fn=heeded, check=False)
    assert ended.returncode == 130


def test_what_a_machine_lacks_is_no_defect() -> None:
    """Too many open files and no memory are sentences; an OSError that nobody foresaw stays a defect, with its traceback."""
    assert "raise ulimit -n" in str(describe_machine_fault(OSError(24, "Too many open files", "a.csv")))
    assert "out of memory" in str(describe_machine_fault(MemoryError()))
    assert describe_machine_fault(FileNotFoundError(2, "No such file or directory")) is None
