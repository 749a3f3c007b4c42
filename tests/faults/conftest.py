"""Children that are killed, starved of disk space or of rights at a chosen place, while this process looks on."""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

NOBODY = 65534
KILLED = -signal.SIGKILL
TOO_LARGE = -signal.SIGXFSZ


def in_child(
    work: Callable[[], int],
    *,
    kill_at: int | None = None,
    most_bytes: int | None = None,
    deadly: bool = False,
    nobody: bool = False,
) -> int:
    """Run `work` in a copy of this process and return its status, or minus the signal that ended it.

    Args:
        work: Returns the exit status; an exception is status 99 and is shown.
        kill_at: SIGKILL before this opening, renaming or removing of a file, counted from 1.
        most_bytes: No file may become larger.
        deadly: A larger file kills the child in the middle of its write; else the write fails, as on a full disk.
        nobody: Without root's rights.
    """
    child = os.fork()
    if child == 0:
        status = 99
        try:
            signal.alarm(60)
            _prepare(kill_at, most_bytes, deadly, nobody)
            status = work()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _prepare(kill_at: int | None, most_bytes: int | None, deadly: bool, nobody: bool) -> None:
    if nobody and os.geteuid() == 0:
        os.setresuid(NOBODY, NOBODY, NOBODY)
    if most_bytes is not None:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if deadly else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    if kill_at is not None:
        sys.addaudithook(_Killer(kill_at))


class _Killer:
    """Counts what is done to files, and kills this process at one of them."""

    def __init__(self, at: int) -> None:
        self.left = at

    def __call__(self, event: str, args: tuple[Any, ...]) -> None:
        if event in ("os.rename", "os.remove", "os.chmod") or event == "open" and _writes(args):
            self.left -= 1
            if self.left == 0:
                os.kill(os.getpid(), signal.SIGKILL)


def _writes(args: tuple[Any, ...]) -> bool:
    return isinstance(args[1], str) and any(c in args[1] for c in "wxa+")


@pytest.fixture(scope="session")
def child() -> Callable[..., int]:
    """The function above."""
    return in_child


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that everybody may enter and write to, unlike pytest's own."""
    with tempfile.TemporaryDirectory(prefix="faults_") as name:
        path = Path(name)
        path.chmod(0o777)
        yield path


def whole_or_old(folder: Path, old: dict[str, bytes], new: dict[str, bytes]) -> None:
    """Check that every file of a folder is one of its two versions, and that no other file shows."""
    for name, before in old.items():
        path = folder / name
        now = path.read_bytes() if path.exists() else None
        assert now in (before, new[name]), f"{name} is neither what it was nor what it should be"
    visible = {p.name for p in folder.iterdir() if not p.name.endswith(".part")}
    assert visible <= set(old)


@pytest.fixture(scope="session")
def check_whole() -> Callable[..., None]:
    """The function above."""
    return whole_or_old
