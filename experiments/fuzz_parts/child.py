"""A worker seen from outside: what it says line by line, and how it ended.

Workers are forked from a process that has loaded the package, which takes longer than a thousand cases.
"""

from __future__ import annotations

import json
import os
import select
import signal
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from types import TracebackType
from typing import Any

TO_BEGIN = 600.0
"""[s] What a child may take to read the valid files on a busy machine."""

_MODULES = (
    "calibrate",
    "calibrate.saved",
    "calibrate.poses.camera",
    "cli",
    "cli.run_folder",
    "compare",
    "control",
    "control.motion",
    "mechanism",
    "exchange",
    "identify",
    "log.lab_files.matlab",
    "log.mcap_log",
    "log.rosbag_log",
    "render",
    "kinematics.workspace.study",
    "scale.journal",
    "kinematics.accuracy.error_bounds",
    "modes.state_space",
    "modes.record",
    "simulate",
    "view.results",
    "vision.cameras",
)


def load() -> None:
    """Import what readers need; nothing is run, so that no thread is there to be forked."""
    for name in _MODULES:
        import_module(f"tau_dyn.{name}")
    for name in ("casadi", "mcap.writer", "mcap_ros2.decoder", "rosbags.highlevel", "scipy.io"):
        if find_spec(name.partition(".")[0]):
            import_module(name)


class Child:
    """A worker process; it is ended when the block ends."""

    def __init__(self, work: Callable[..., None], *arguments: object) -> None:
        """Start it; what it prints goes to `said`."""
        self._pipe, write = os.pipe()
        self._process, self._ended = os.fork(), False
        if self._process == 0:
            os.close(self._pipe)  # or a child outlives a parent that was killed, waiting for somebody to read
            os.dup2(write, 1)
            try:
                work(*arguments)
                os._exit(0)
            except BaseException:  # noqa: BLE001
                os._exit(70)
        os.close(write)
        self.death = ""
        """How it ended where it should not have: `hang`, a signal's name or a status."""

    def __enter__(self) -> Child:
        """Use it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it."""
        os.close(self._pipe)
        if not self._ended:
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)

    def said(self, patience: float) -> Iterator[dict[str, Any]]:
        """Yield what it says, until it is done, dies, or says nothing for longer than `patience` [s]."""
        held, wait = b"", TO_BEGIN
        while True:
            if not select.select([self._pipe], [], [], wait)[0]:
                self.death = "hang"
                return
            piece = os.read(self._pipe, 2**16)
            if not piece:
                self._ended = True
                self.death = _name(os.waitstatus_to_exitcode(os.waitpid(self._process, 0)[1]))
                return
            *lines, held = (held + piece).split(b"\n")
            wait = patience
            for line in lines:
                yield json.loads(line)


def _name(code: int) -> str:
    return "" if code == 0 else signal.Signals(-code).name if code < 0 else f"status {code}"
