"""The measures of the vocabulary: they find what they are made to find, and the names stay as the glossary has them."""

import importlib.util
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_spec = importlib.util.spec_from_file_location("vocabulary", ROOT / "experiments" / "vocabulary.py")
vocabulary = importlib.util.module_from_spec(_spec)
sys.modules["vocabulary"] = vocabulary
_spec.loader.exec_module(vocabulary)


MEASURES = (
    "old names of the glossary in src",
    "public functions that are no verb phrase",
    "class names in several rooms",
    "numeric constants without explanation",
    "constants named MOST, FEWEST, SURE, ...",
    "words in docs",
    "sentences over 30 words",
    "mentions of history in README and docs",
    "private English in docstrings and docs",
    "private English in messages",
)


@pytest.fixture(scope="module")
def measures():
    """Return the measures of this source tree by name."""
    return {m.name: m for m in vocabulary.measure_vocabulary(ROOT)}


def test_all_measures_are_looked_at(measures):
    """No measure is left out below."""
    assert sorted(measures) == sorted(MEASURES)


@pytest.mark.parametrize("name", MEASURES)
def test_names_and_pages_keep_to_the_goals(name, measures):
    """Names follow the glossary and its rules, constants say what they are, pages stay short and in the present."""
    assert measures[name].met, measures[name].items[:20]


def test_measures_find_what_falls_short(tmp_path):
    """A made-up package with one fault of each kind."""
    package = tmp_path / "src" / "tau_dyn"
    for room, text in {
        "diagnose": 'MOST = 3\n\n\nclass Ground:\n    """A."""\n\n\ndef weighed():\n    """B."""\n',
        "modes": 'class Ground:\n    """C."""\n\n\nLIMIT = 2.0  # [s] of a reason\n',
    }.items():
        (package / room).mkdir(parents=True)
        (package / room / "null_model.py").write_text(text)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "a.md").write_text("This page said so. " + "word " * 31 + "end.\n")
    (tmp_path / "README.md").write_text("Short.\n")
    found = {m.name: m for m in vocabulary.measure_vocabulary(tmp_path)}
    assert found["old names of the glossary in src"].items == ["diagnose/null_model.py: Ground"]
    assert found["public functions that are no verb phrase"].items == ["diagnose/null_model.py: weighed"]
    assert found["class names in several rooms"].items == ["Ground: diagnose, modes"]
    assert found["numeric constants without explanation"].items == ["diagnose/null_model.py:1: MOST"]
    assert found["constants named MOST, FEWEST, SURE, ..."].items == ["diagnose/null_model.py:1: MOST"]
    assert len(found["sentences over 30 words"].items) == 1
    assert len(found["mentions of history in README and docs"].items) == 1


@pytest.mark.parametrize(("text", "n"), [("A b. C d.", 2), ("- one\n- two", 2), ("See `a.b. C` there.", 1)])
def test_sentences_end_at_full_stops_and_items(text, n):
    """Code does not end a sentence."""
    assert len(list(vocabulary.split_sentences(text))) == n
