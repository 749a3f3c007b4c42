"""The long campaigns: done once for the code that ran, resumed where they can, started anew where the code is another."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
import campaigns

SCRIPT = """
import sys, pathlib
file = pathlib.Path(sys.argv[1]) / "rounds.txt"
rounds = (file.read_text() if file.exists() else "") + "x"
file.write_text(rounds)
sys.exit(0 if len(rounds) > 1 else 7)
"""


@pytest.fixture
def one(tmp_path, monkeypatch):
    """A campaign that ends with status 7 the first time it runs in a folder and with 0 the second."""
    (tmp_path / "script.py").write_text(SCRIPT)
    monkeypatch.setattr(campaigns, "HERE", tmp_path)
    monkeypatch.setattr(campaigns, "CAMPAIGNS", {"one": campaigns.Campaign("a study", "script.py {out}")})
    return tmp_path / "out"


def rounds(out: Path) -> int:
    return len((out / "one" / "rounds.txt").read_text())


def test_what_is_done_is_not_done_again_until_the_code_is_another(one, monkeypatch, capsys):
    """A second call passes over it and gives the same status; other code gets a fresh folder."""
    assert campaigns.main(["one"], 1, one) == 7 and rounds(one) == 1
    assert campaigns.main(["one"], 1, one) == 7 and rounds(one) == 1
    assert "one: done, status 7" in capsys.readouterr().out
    monkeypatch.setattr(campaigns, "compute_code_hash", lambda: "another")
    assert campaigns.main(["one"], 1, one) == 7 and rounds(one) == 1


def test_an_interrupted_campaign_goes_on_in_its_folder(one):
    """What was left without an entry in the book, as by a kill, is not thrown away."""
    campaigns.main(["one"], 1, one)
    (one / "campaigns.json").unlink()
    assert campaigns.main(["one"], 1, one) == 0 and rounds(one) == 2


def test_every_campaign_is_a_script_that_exists():
    """Each names a script of the folder."""
    folder = Path(campaigns.__file__).parent
    assert all((folder / one.command.split()[0]).is_file() for one in campaigns.CAMPAIGNS.values())
