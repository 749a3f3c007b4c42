"""What the pages on control give to copy runs."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
from page_blocks import ROOT
from page_replay import replay

if not (ROOT / "docs" / "index.md").is_file():
    pytest.skip("the documentation is not here", allow_module_level=True)


def test_the_page_on_learning_runs():
    """From made steps to actuators, from a trial to the next correction."""
    played = replay(ROOT / "docs" / "how_to" / "learning.md")
    faults = [f"line {p.step.block.line}:\n{p.fault}" for p in played if p.fault]
    assert played and not faults, "\n\n".join(faults)
