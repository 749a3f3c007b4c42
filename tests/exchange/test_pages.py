"""What the pages on files and exchange give to copy runs, and shows what they show."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
from page_blocks import ROOT
from page_replay import replay

if not (ROOT / "docs" / "index.md").is_file():
    pytest.skip("the documentation is not here", allow_module_level=True)

pytest.importorskip("mcap")
pytest.importorskip("fmpy")
NEEDS = {"docs/reference/files.md": "bash", "docs/how_to/exchange.md": "cc"}


@pytest.mark.parametrize("name", NEEDS)
def test_a_page_shows_what_appears(name):
    """A reader who types the page's examples sees its answers."""
    if shutil.which(NEEDS[name]) is None:
        pytest.skip(f"there is no {NEEDS[name]} here")
    played = replay(ROOT / name)
    faults = [f"{name}, line {p.step.block.line}:\n{p.fault}" for p in played if p.fault]
    assert played and not faults, "\n\n".join(faults)
