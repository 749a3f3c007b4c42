"""A page executed in an empty folder, step by step; and the page with what appeared put in.

    python tests/docs/page_replay.py docs/tutorials/identify.md [...] [--write]

says what differs from the page and what each step took; with `--write` it puts what appeared into the page where it differs.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

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


def replay(page: Path) -> list[Played]:
    """Execute a page's steps in an empty folder and return what appeared."""
    found = steps(page.read_text(encoding="utf-8"))
    given = [
        {
            "language": s.block.language,
            "title": s.block.title,
            "text": s.block.text,
            "commands": commands(s.block.text),
            "where": f"{page.name}:{s.block.line}",
        }
        for s in found
    ]
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as aside:
        asked, said = Path(aside, "steps.json"), Path(aside, "said.json")
        asked.write_text(json.dumps(given), encoding="utf-8")
        play = Path(__file__).with_name("page_play.py")
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        measured = {"TAU_DYN_DATA": os.environ.get("TAU_DYN_DATA", str(ROOT.parent / "shared" / "data"))}
        subprocess.run(
            [sys.executable, play, asked, said], cwd=folder, env=os.environ | one_thread | measured, check=True
        )
        answers = json.loads(said.read_text(encoding="utf-8"))
    return [Played(s, a["status"], a["text"], a["seconds"]) for s, a in zip(found, answers, strict=True)]


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
