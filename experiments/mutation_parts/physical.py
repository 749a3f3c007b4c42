"""Faults that a physicist makes: read from `physical_faults.txt`, put in one at a time, and shown to the tests of their room."""

from __future__ import annotations

import ast
import os
import re
import signal
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import cache_from_source
from pathlib import Path
from typing import Any

from mutation_parts.trial import PYTEST, ROOT, copy_project

FAULTS = Path(__file__).with_name("physical_faults.txt")
_NO_TESTS = (4, 5)
"""pytest's status where a test that was asked for is not there any more."""
_LIKELY = 5
"""Files of tests that are collected first."""
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        room: Folder of `src/tau_dyn`, and of `tests`.
        file: Within the room.
        why: What is wrong with it, as physics.
        old: Text that stands in the file once.
        new: What it becomes.
    """

    room: str
    file: str
    why: str
    old: str
    new: str

    @property
    def is_equivalent(self) -> bool:
        """Whether the list says that it changes no result."""
        return self.why.startswith("without consequence, ")

    def path(self, root: Path) -> Path:
        """Return the file in a copy of the project."""
        return root / "src" / "tau_dyn" / self.room / self.file

    def apply(self, text: str) -> str:
        """Return the file's text with the fault in it.

        Raises:
            SystemExit: The old text is not there exactly once.
        """
        if text.count(self.old) != 1:
            raise SystemExit(f"{self.room}/{self.file}: {text.count(self.old)} times, not once: {self.old}")
        return text.replace(self.old, self.new)


def read_faults(path: Path = FAULTS) -> list[Fault]:
    """Return all faults of the list."""
    found, room = [], ""
    lines = [x for x in path.read_text(encoding="utf-8").splitlines() if x.strip() and not x.startswith("# ")]
    while lines:
        head = lines.pop(0)
        if head.startswith("## "):
            room = head[3:]
            continue
        file, why = head.split(": ", 1)
        found.append(Fault(room, file, why, lines.pop(0).removeprefix("- "), lines.pop(0).removeprefix("+ ")))
    return found


def order_tests(fault: Fault, root: Path = ROOT) -> list[str]:
    """Return the test files of the fault's room: first, short ones first, those that name most of what it is in."""
    text = fault.path(root).read_text(encoding="utf-8")
    line = text[: text.index(fault.old)].count("\n") + 1
    own, around, stem = set(), set(), Path(fault.file).stem
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
            if node.lineno <= line <= (node.end_lineno or line):
                around.add(node.name)

    def likely(path: Path) -> float:
        words = set(re.findall(r"\w+", path.read_text(encoding="utf-8")))
        named = 10.0 * (stem in path.stem or path.stem.removeprefix("test_") in fault.file)
        return -(named + 5 * len(around & words) + len(own & words))

    files = sorted((root / "tests" / fault.room).rglob("test_*.py"), key=likely)
    files = [*sorted(files[:_LIKELY], key=lambda path: path.stat().st_size), *files[_LIKELY:]]
    return [str(path.relative_to(root)) for path in files]


def judge(fault: Fault, folder: Path, limit: float, known: str = "") -> dict[str, Any]:
    """Return whether the room's tests notice a fault: `noticed`, `unnoticed` or `undecided` in time; by which test; seconds.

    The test that noticed it in an earlier campaign runs first. What changes no result is `equivalent`, untried.
    """
    if fault.is_equivalent:
        return {"outcome": "equivalent", "by": "", "seconds": 0.0}
    root = copy_project(folder)
    path, begun = fault.path(root), time.monotonic()
    whole = path.read_text(encoding="utf-8")
    tests = order_tests(fault, root)
    _write(path, fault.apply(whole))
    status: int | None = 0
    said = ""
    try:
        for part in ([known] if known else [], tests[:_LIKELY], tests[_LIKELY:]):  # collecting all takes long
            if part and status in (0, *_NO_TESTS):
                status, said = run_forked(root, ["--timeout=120", *part], limit - (time.monotonic() - begun))
    finally:
        _write(path, whole)
    by = next(iter(_FAILED.findall(said)), "")
    outcome = {None: "undecided", 0: "unnoticed", 5: "unnoticed"}.get(status, "noticed")
    if outcome == "noticed" and not by:
        raise SystemExit(f"{fault.room}: the tests do not run\n{said}")
    return {"outcome": outcome, "by": by, "seconds": round(time.monotonic() - begun, 1)}


def _write(path: Path, text: str) -> None:
    """Write a source and forget its bytecode, which Python takes for that of any text as long of the same second."""
    path.write_text(text, encoding="utf-8")
    Path(cache_from_source(str(path))).unlink(missing_ok=True)


def fail_unbroken(tests: list[str], folder: Path) -> set[str]:
    """Return those of the tests that fail without any fault too, and so say nothing."""
    if not tests:
        return set()
    _, said = run_forked(copy_project(folder), ["--maxfail=100", *dict.fromkeys(tests)])
    return set(_FAILED.findall(said))


def run_forked(root: Path, arguments: list[str], limit: float = 3600.0) -> tuple[int | None, str]:
    """Run tests in a child that has all libraries but ours, until one fails; status (None after `limit` [s]), words."""
    import pandas, pinocchio, pytest, rich, scipy.optimize, scipy.signal, scipy.stats  # noqa: E401, F401, I001

    said = root / "said.txt"
    child = os.fork()
    if child == 0:
        os.setsid()
        os.chdir(root)
        with said.open("w") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
        for name in [n for n in sys.modules if n.partition(".")[0] == "tau_dyn"]:
            del sys.modules[name]
        # workers that tests start import the program that runs here
        sys.path[:] = [
            str(root / "src"),
            str(root / "experiments"),
            *(x for x in sys.path if not x.startswith(str(ROOT))),
        ]
        sys.dont_write_bytecode = False
        os.environ["PYTHONPATH"] = str(root / "src")
        os.environ.pop("CI", None)
        status = 1
        try:
            status = int(pytest.main([*PYTEST, *arguments]))
        finally:
            sys.stdout.flush()
            os._exit(status)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), said.read_text(errors="replace")
        time.sleep(0.1)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None, said.read_text(errors="replace")
