"""A reader who types what the tutorials say, in their order, in an empty folder, sees what the tutorials show."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, blocks
from page_replay import replay

QUICK = (
    "experiments/first_hour.md",
    "docs/tutorials/stock_arms.md",
    "docs/tutorials/calibrate.md",
    "docs/tutorials/resonances.md",
    "docs/tutorials/controller.md",
    "docs/tutorials/add_a_robot.md",
)
MEASURED = {"docs/tutorials/first_real_machine.md": "emps/DATA_EMPS.csv"}
"""Pages of measured logs, and the file of the data folder that each needs."""
SLOW = ("docs/tutorials/identify.md", "docs/tutorials/diagnose.md", "docs/tutorials/add_a_cause.md")
OUTSIDE = ROOT / "tests" / "outside"


@pytest.mark.timeout(900)  # a page is a sequence of commands, one of them a whole diagnosis of a six-axis arm
@pytest.mark.parametrize("name", [*QUICK, *MEASURED, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_what_a_page_shows_is_what_appears(name, measured):
    """Every step ends well, or is refused as shown, and what appears agrees to the digits shown."""
    if name in MEASURED:
        measured(MEASURED[name])
    played = replay(ROOT / name)
    faults = [f"{name}, line {p.step.block.line}:\n{p.fault}" for p in played if p.fault]
    assert played and not faults, "\n\n".join(faults)


def test_every_tutorial_is_played():
    """No tutorial is left out, and each holds steps."""
    there = {str(p.relative_to(ROOT)) for p in (ROOT / "docs" / "tutorials").glob("*.md")} - {"docs/tutorials/index.md"}
    assert there | {"experiments/first_hour.md"} == {*QUICK, *MEASURED, *SLOW}


@pytest.mark.parametrize("page, name", [("add_a_robot", "toggle.urdf.xacro"), ("add_a_cause", "bellows.py")])
def test_the_files_shown_are_those_tested_from_outside(page, name):
    """What a page gives to copy is, letter by letter, what `test_from_outside.py` uses."""
    text = (ROOT / "docs" / "tutorials" / f"{page}.md").read_text(encoding="utf-8")
    (shown,) = [block.text for block in blocks(text) if block.title == name]
    assert shown == (OUTSIDE / name).read_text(encoding="utf-8")
