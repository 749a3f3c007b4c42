"""The glossary: every term once, with a source, and with a module that exists."""

import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROWS = [
    [cell.strip() for cell in line.strip("|\n").split("|")]
    for line in (ROOT / "docs/reference/glossary.md").read_text(encoding="utf-8").splitlines()
    if line.startswith("|") and not re.match(r"\|(-|\s*term)", line)
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_a_term_names_its_meaning_its_source_and_a_module_that_exists(row):
    """Whoever looks a term up finds the file that holds it."""
    _, meaning, source, module = row
    assert meaning and source
    assert (ROOT / "src" / "tau_dyn" / module.strip("`")).is_file()


def test_a_term_stands_once():
    """One concept, one word, one line."""
    assert not [term for term, n in Counter(row[0] for row in ROWS).items() if n > 1]
