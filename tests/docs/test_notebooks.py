"""A tutorial's notebook holds the steps that the tests of the page execute, and what appears."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, Step, steps

sys.path.insert(0, str(ROOT / "docs" / "hooks"))
from notebook import build_notebook

TUTORIALS = [p for p in sorted((ROOT / "docs" / "tutorials").glob("*.md")) if p.stem != "index"]
PAGES = [ROOT / "experiments" / "first_hour.md", *TUTORIALS]


def cell_of(step: Step) -> tuple[str, str]:
    """Return source and output of the cell that a step has to be."""
    text = step.block.text
    magic = f"%%writefile {step.block.title}\n" if step.block.title else "%%bash\n" * (step.block.language == "bash")
    return (magic + text).rstrip("\n"), step.shown.text if step.shown else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_notebook_has_the_steps_of_its_page(page):
    """Cell by cell: the same source, the same output."""
    text = page.read_text(encoding="utf-8")
    cells = [c for c in json.loads(build_notebook(text))["cells"] if c["cell_type"] == "code"]
    made = [(c["source"], "".join(o["text"] for o in c["outputs"])) for c in cells]
    assert made == [cell_of(step) for step in steps(text)]


def test_a_notebook_is_one():
    """It agrees with the format's own schema."""
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.reads(build_notebook(PAGES[0].read_text(encoding="utf-8")), as_version=4)
    assert nbformat.validator.isvalid(notebook)


def test_a_fence_for_reading_stays_text():
    """`sh` is not run, and links within the site become words."""
    (cell,) = json.loads(build_notebook("# A\n\n[b](c.md) [d](https://e.f)\n\n```sh\ng\n```\n"))["cells"]
    assert cell["cell_type"] == "markdown"
    assert cell["source"] == "# A\n\nb [d](https://e.f)\n\n```sh\ng\n```"
