"""Plays pages: reads `[FOLDER, STEPS.json, RESULT.json]` line by line, plays the steps in the folder, and answers with a line.

It runs as a program of its own, so that nothing that a page does (an effect registered, a style set) stays in pytest's process.
It loads the package once; each page is played in a copy of this process (`fork`).
A line that is a plain `tau-dyn` command calls the command line's `main` in this process, which spares loading the libraries
again; any other line goes to bash, where `python` is this interpreter and `tau-dyn` is this package.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shlex
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

_FOR_THE_SHELL = set("|<>&;*?$`")


def tau_dyn(arguments: list[str]) -> int:
    """Run one command as the shell would, in this process."""
    from tau_dyn.cli import main

    sys.argv = ["tau-dyn", *arguments]
    try:
        return main(arguments)
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)


def in_shell(line: str) -> int:
    """Run a line in bash, its output among ours."""
    ours = f'python() {{ "{sys.executable}" "$@"; }}; tau-dyn() {{ python -m tau_dyn.cli "$@"; }}; '
    done = subprocess.run(
        ["bash", "-c", ours + line], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    print(done.stdout, end="")
    return done.returncode


def play(step: dict[str, Any], session: dict[str, Any]) -> int:
    """Do one step and return the largest exit status of its lines."""
    if step["title"]:
        Path(step["title"]).parent.mkdir(parents=True, exist_ok=True)
        Path(step["title"]).write_text(step["text"], encoding="utf-8")
        return 0
    if step["language"] == "python":
        exec(compile(step["text"], step["where"], "exec"), session)  # a page of ours, which readers run as well
        return 0
    status = 0
    for line in step["commands"]:
        plain = line.startswith("tau-dyn ") and not _FOR_THE_SHELL & set(line)
        status = max(status, tau_dyn(shlex.split(line)[1:]) if plain else in_shell(line))
    return status


def play_page(given: str, result: str) -> None:
    """Play all steps in the current folder."""
    os.environ |= {"COLUMNS": "80", "TERM": "dumb", "NO_COLOR": "1"}
    sys.path.insert(0, os.getcwd())
    session: dict[str, Any] = {"__name__": "__main__"}
    said = []
    for step in json.loads(Path(given).read_text(encoding="utf-8")):
        began, text = time.process_time() + sum(os.times()[2:4]), io.StringIO()
        with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            try:
                status = play(step, session)
            except Exception:
                traceback.print_exc()
                status = 1
        seconds = time.process_time() + sum(os.times()[2:4]) - began
        said.append({"status": status, "text": text.getvalue(), "seconds": seconds})
    Path(result).write_text(json.dumps(said), encoding="utf-8")


def serve() -> None:
    """Play the pages that stdin names, one after the other."""
    import tau_dyn

    for name in tau_dyn.__all__:
        getattr(tau_dyn, name)
    for line in sys.stdin:
        folder, given, result = json.loads(line)
        if (page := os.fork()) == 0:
            os.dup2(2, 1)  # the pipe is for answers alone
            os.chdir(folder)
            try:
                play_page(given, result)
                os._exit(0)
            finally:
                os._exit(1)
        print(os.waitstatus_to_exitcode(os.waitpid(page, 0)[1]), flush=True)


if __name__ == "__main__":
    serve()
