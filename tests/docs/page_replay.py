"""A page executed in a folder, step by step; and the page with what appeared put in.

    python tests/docs/page_replay.py docs/tutorials/identify.md [...] [--write]

says what differs from the page and what each step took; with `--write` it puts what appeared into the page where it differs.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, Step, commands, steps
from page_shown import differences

_REFUSALS = ("error:", "cannot answer:")


@dataclass(frozen=True)
class Played:
    """A step and what appeared."""

    step: Step
    status: int
    came: str
    seconds: float

    @property
    def fault(self) -> str:
        """What differs from the page, or nothing."""
        shown = "" if self.step.shown is None else self.step.shown.text
        if self.status and not any(line.startswith(_REFUSALS) for line in shown.splitlines()):
            return f"ended with status {self.status}:\n{self.came}"
        return differences(shown, self.came) if self.step.shown is not None else ""


def replay(
    page: Path,
    languages: tuple[str, ...] = ("bash", "python"),
    prepare: Callable[[Path], str] = lambda folder: "",
    adapt: Callable[[list[str]], list[str]] = list,
) -> list[Played]:
    """Execute a page's steps in a folder of their own and return what appeared.

    Args:
        page: The page.
        languages: Languages of the blocks that are executed.
        prepare: Writes the files that the page takes for given into the folder; returns Python that comes first.
        adapt: Returns a block's commands in the form in which they are executed.
    """
    found = steps(page.read_text(encoding="utf-8"), languages)
    given = [
        {
            "language": s.block.language,
            "title": s.block.title,
            "text": s.block.text,
            "commands": adapt(commands(s.block.text)),
            "where": f"{page.name}:{s.block.line}",
        }
        for s in found
    ]
    with tempfile.TemporaryDirectory() as folder:
        first = prepare(Path(folder))
        for step in given if first else ():  # a guide shows some files after the commands that read them
            if step["title"]:
                Path(folder, step["title"]).write_text(step["text"], encoding="utf-8")
        answers = play([_python(first), *given], Path(folder))[1:]
    idle = [not (g["title"] or g["language"] == "python" or g["commands"]) for g in given]
    found = [
        Step(s.block, None) if left else s for s, left in zip(found, idle, strict=True)
    ]  # not executed: nothing came
    return [Played(s, a["status"], a["text"], a["seconds"]) for s, a in zip(found, answers, strict=True)]


def _python(text: str) -> dict[str, Any]:
    return {"language": "python", "title": "", "text": text, "commands": [], "where": "given"}


def play(steps: list[dict[str, Any]], folder: Path) -> list[dict[str, Any]]:
    """Play steps in a folder and return status, text and CPU seconds of each."""
    with tempfile.TemporaryDirectory() as aside:
        asked, said = Path(aside, "steps.json"), Path(aside, "said.json")
        asked.write_text(json.dumps(steps), encoding="utf-8")
        player = _player()
        assert player.stdin and player.stdout
        player.stdin.write(json.dumps([str(folder), str(asked), str(said)]) + "\n")
        player.stdin.flush()
        assert player.stdout.readline() == "0\n", "the page ended its process"
        return json.loads(said.read_text(encoding="utf-8"))


@cache
def _player() -> subprocess.Popen[str]:
    """Return the program that plays pages; it ends with this process, which holds its stdin."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    measured = {"TAU_DYN_DATA": os.environ.get("TAU_DYN_DATA", str(ROOT.parent / "shared" / "data"))}
    command = [sys.executable, str(Path(__file__).with_name("page_play.py"))]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | one_thread | measured
    )


def renewed(page: str, played: list[Played]) -> str:
    """Return the page's text with what appeared in place of what is shown, where the two differ."""
    for p in reversed(played):
        if p.step.shown is not None and p.fault:
            came = "".join(f"{line.rstrip()}\n" for line in p.came.strip("\n").splitlines())
            page = page[: p.step.shown.start] + came + page[p.step.shown.end :]
    return page


def main(arguments: list[str]) -> None:
    """Print what differs, page by page."""
    for name in (a for a in arguments if not a.startswith("--")):
        page = Path(name)
        played = replay(page)
        print(f"{page}: {sum(p.seconds for p in played):.1f} s")
        for p in played:
            print(f"  line {p.step.block.line}: {p.seconds:.1f} s {p.fault}")
        if "--write" in arguments:
            text = page.read_text(encoding="utf-8")
            page.write_text(renewed(text, played), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
