"""What goes to stdout and what to stderr: the result for a program, log messages, progress with the time left."""

from __future__ import annotations

import inspect
import json
import logging
import os
import pty
import re
import shutil
import subprocess
import sys
from typing import get_type_hints

import numpy as np
import pytest

from tau_dyn.cli import COMMANDS, main
from tau_dyn.cli.arguments import Output
from tau_dyn.cli.progress import StepClock
from tau_dyn.log import Log


@pytest.fixture(scope="module")
def stroke(tmp_path_factory):
    """A log of the linear axis that moves for two seconds."""
    t = np.arange(0, 2, 0.002)
    q, tau = 0.2 * np.sin(5 * t), 20 * np.sign(np.cos(5 * t)) - 450 * np.sin(5 * t)
    path = tmp_path_factory.mktemp("stroke") / "stroke.csv"
    Log(t, {"q_axis": q, "tau_axis": tau}, "stroke.csv").to_csv(path)
    return str(path)


CALLS = {
    "fk": ["fk", "linear_axis", "--q", "0.1"],
    "ik": ["ik", "linear_axis", "--position", "0.1", "0", "0"],
    "robots": ["robots", "linear_axis"],
    "causes": ["causes", "stribeck"],
    "check": ["check", "LOG", "linear_axis"],
    "columns": ["columns", "LOG", "linear_axis"],
    "identify": ["identify", "linear_axis", "LOG"],
    "lead-through": ["lead-through", "--stiffness", "1e5"],
}


@pytest.mark.parametrize("command", CALLS)
def test_a_hyphen_writes_the_result_to_stdout_and_nothing_else(command, stroke, capsys):
    """All of stdout is one JSON document; what a person reads does not stand beside it, warnings go to stderr."""
    call = [stroke if word == "LOG" else word for word in CALLS[command]]
    assert main([*call, "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["command"] == command and told["status"] == "ok"
    assert main([*call, "--json=-", "--quiet"]) == 0
    assert json.loads(capsys.readouterr().out).keys() == told.keys()


def test_the_result_on_stdout_is_that_of_the_file(stroke, tmp_path, capsys):
    """A run folder gets its files, too, and stdout the same text as its result."""
    folder = tmp_path / "run"
    assert main(["identify", "linear_axis", stroke, "--json", "-", "--out", f"{folder}/"]) == 0
    assert capsys.readouterr().out == (folder / "result.json").read_text()
    assert (folder / "model.yaml").is_file() and (folder / "report.html").is_file()


def test_exit_statuses_stay(stroke, tmp_path, capsys):
    """Wrong input ends with 2 and an empty stdout; data that cannot answer with 3 and a result that says so."""
    assert main(["fk", "linear_axis", "--q", "1", "2", "--json", "-"]) == 2
    assert capsys.readouterr().out == ""
    still = tmp_path / "still.csv"
    t = np.arange(0, 2, 0.002)
    Log(t, {"q_axis": 0 * t, "tau_axis": 0 * t + 1.0}, "still.csv").to_csv(still)
    assert main(["identify", "linear_axis", str(still), "--json", "-"]) == 3
    assert json.loads(capsys.readouterr().out)["status"] == "cannot_answer"


def test_every_command_takes_json_and_verbose():
    """What is promised of all holds for each: its signature has the shared options."""
    for words, function in COMMANDS.items():
        hints = get_type_hints(function)
        assert any(inspect.isclass(hint) and issubclass(hint, Output) for hint in hints.values()), words


def test_verbose_logs_what_is_done(stroke, capsys):
    """`--verbose` says on stderr what was read and which steps were taken, and leaves stdout and the logger as they were."""
    assert main(["check", stroke, "linear_axis", "--verbose", "--json", "-"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["command"] == "check"
    assert re.search(r"ms  tau_dyn\.log\.read: read stroke\.csv: 1000 samples in 1\.998 s", printed.err)
    assert "tau_dyn: reading" in printed.err and "tau_dyn.robot.load: loaded" in printed.err
    assert not logging.getLogger("tau_dyn").handlers
    assert main(["check", stroke, "linear_axis"]) == 0
    assert capsys.readouterr().err == ""


def test_the_time_left_follows_the_pace():
    """Three of ten parts in six seconds leave fourteen; as time passes without news, less; another step starts anew."""
    now = [0.0]
    clock = StepClock(lambda: now[0])
    clock.tell("block 0 of 10: a")
    now[0] = 6.0
    assert not clock.tell("block 3 of 10: b")
    assert clock.seconds_left() == pytest.approx(14.0)
    now[0] = 8.0
    assert clock.format() == "block 3 of 10: b  (8 s, 12 s left)"
    now[0] = 40.0
    assert clock.seconds_left() == 0.0
    assert clock.tell("loading [b]") and clock.seconds_left() is None and clock.format() == "loading [b]"
    assert clock.tell("simulating 0 %") and not clock.tell("simulating 50 %")


@pytest.mark.skipif(sys.platform == "win32", reason="a pseudo-terminal is a matter of Unix")
def test_a_watched_terminal_shows_the_steps(stroke):
    """Where stderr is a terminal the steps stand there, and stdout holds the result alone."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "tau_dyn", "identify", "linear_axis", stroke, "--json", "-"]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=theirs, env={**os.environ, "TERM": "xterm"}, check=True
    )
    os.close(theirs)
    shown = b""
    while chunk := _read(ours):
        shown += chunk
    os.close(ours)
    assert b"loading" in shown and b"{" not in shown
    assert json.loads(done.stdout)["command"] == "identify"


def _read(terminal: int) -> bytes:
    """Return what the terminal still holds; nothing once its other end is closed."""
    try:
        return os.read(terminal, 4096)
    except OSError:
        return b""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_names_every_command(shell, capsys):
    """The script of each shell knows the commands and the options of one."""
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(words.split(" ")[0] in script for words in COMMANDS) and "holdout" in script


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_and_options(tmp_path, capsys):
    """What a press of the tabulator gives: the command that begins so, and the option of that command."""
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.bash"
    script.write_text(capsys.readouterr().out)
    ask = 'complete_line() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _tau_dyn; echo "${COMPREPLY[*]}"; }'
    lines = f"source {script}; {ask}; complete_line tau-dyn ide; complete_line tau-dyn identify --hol"
    done = subprocess.run(["bash", "-c", lines], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["identify", "--holdout", "--hold"]
