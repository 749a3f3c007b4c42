"""Commands as processes: started in a folder, killed after some processor time, or left alone; Linux only."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Ended:
    """How a process ended: its status (minus the signal that killed it), what it said, and its processor time [s]."""

    status: int
    err: str
    spent: float


def command(*words: str) -> list[str]:
    """Return the words of a tau-dyn command."""
    return [sys.executable, "-m", "tau_dyn.cli", *words]


def run(
    words: list[str],
    folder: Path,
    *,
    after: float | None = None,
    send: int = signal.SIGKILL,
    prepare: Callable[[], None] | None = None,
    limit_s: float = 600.0,
) -> Ended:
    """Run words in a folder, and send a signal once the process has spent so much processor time [s]."""

    def begin() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell lets what it starts in the background ignore Ctrl-C
        if prepare is not None:
            prepare()

    with subprocess.Popen(
        words, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=begin
    ) as process:
        begun, used = time.monotonic(), 0.0
        while process.poll() is None and time.monotonic() - begun < limit_s:
            used = max(used, spent(process.pid))
            if after is not None and used >= after:
                process.send_signal(send)
                after = None
            time.sleep(0.002)
        _, err = process.communicate(timeout=60)
    return Ended(process.returncode, err, used)


def spent(process: int) -> float:
    """Return the processor time [s] of a process; zero when it is gone."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / TICKS
