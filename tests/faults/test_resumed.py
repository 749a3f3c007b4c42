"""Interrupted anywhere and started again, a long run loses nothing, writes nothing by halves and gives the same answer."""

from __future__ import annotations

import json
import os
import signal
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from raising import raises_code

from tau_dyn.calibrate.poses.campaign_files import build_new_progress, run_campaign
from tau_dyn.scale import run_journaled

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
linux = pytest.mark.skipif(sys.platform != "linux", reason="forks")


def draw(seed: int) -> dict:
    """Return numbers that text could spoil: thirds, not a number, infinity, an array."""
    rng = np.random.default_rng(seed)
    return {"third": seed / 3, "nan": float("nan"), "inf": np.inf, "many": rng.normal(size=3), "name": f"é{seed}"}


def study(folder: Path, die_at: int | None = None, runs: int = 7) -> int:
    """Draw some numbers into a table, dying in the middle of one."""

    def work(seed: int) -> dict:
        if seed == die_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return draw(seed)

    rows = list(run_journaled(work, range(runs), folder / "study.jsonl", about={"seed": 3}))
    (folder / "table.csv").write_text(pd.DataFrame(rows).to_csv())
    return 0


@pytest.fixture
def undisturbed(tmp_path) -> bytes:
    """The table of a study that nobody interrupts."""
    folder = tmp_path / "undisturbed"
    folder.mkdir()
    study(folder)
    return (folder / "table.csv").read_bytes()


@linux
def test_killed_twice_a_study_gives_the_same_bytes(tmp_path, undisturbed, child) -> None:
    """SIGKILL while item 2, then item 5, is computed; the third call does only the rest."""
    assert child(partial(study, tmp_path, 2)) == -signal.SIGKILL
    assert child(partial(study, tmp_path, 5)) == -signal.SIGKILL
    assert not (tmp_path / "table.csv").exists()
    done = [json.loads(line).get("item") for line in (tmp_path / "study.jsonl").read_text().splitlines()]
    assert done[1:] == ["0", "1", "2", "3", "4"]
    assert study(tmp_path) == 0
    assert (tmp_path / "table.csv").read_bytes() == undisturbed


def test_cut_at_every_byte_a_journal_goes_on(tmp_path, undisturbed) -> None:
    """Wherever a kill or a full disk cut the journal, its whole lines count and the rest is done again."""
    whole = Path(tmp_path / "undisturbed" / "study.jsonl").read_bytes()
    folder = tmp_path / "cut"
    folder.mkdir()
    for cut in range(0, len(whole), 23):
        (folder / "study.jsonl").write_bytes(whole[:cut])
        study(folder)
        assert (folder / "table.csv").read_bytes() == undisturbed
        assert (folder / "study.jsonl").read_bytes() == whole


def test_more_runs_keep_those_that_are_done(tmp_path) -> None:
    """A longer study begins with what the shorter one left."""
    path, asked = tmp_path / "j.jsonl", []

    def work(seed: int) -> float:
        asked.append(seed)
        return seed / 3

    assert list(run_journaled(work, range(3), path)) == [0, 1 / 3, 2 / 3]
    assert list(run_journaled(work, [4, 1, 0, 2, 3], path)) == [4 / 3, 1 / 3, 0, 2 / 3, 1]
    assert asked == [0, 1, 2, 4, 3]


def test_a_journal_of_something_else_is_refused(tmp_path, monkeypatch) -> None:
    """Of another seed, of other code, of no journal at all: results of two things never meet in one table."""
    path = tmp_path / "j.jsonl"
    list(run_journaled(float, [1], path, about={"seed": 1}))
    with raises_code("mismatch", "1}", "2}"):
        list(run_journaled(float, [1], path, about={"seed": 2}))
    monkeypatch.setattr("tau_dyn.scale.journal.compute_code_hash", lambda: "other")
    with raises_code("mismatch"):
        list(run_journaled(float, [1], path, about={"seed": 1}))
    monkeypatch.undo()
    path.write_text('{"about": {}}\n[1, 2]\n')
    with raises_code("file_format", "2"):
        list(run_journaled(float, [1], path))
    with raises_code("cannot_write"):
        list(run_journaled(float, [1], tmp_path / "no" / "j.jsonl"))


@linux
def test_two_runs_do_not_share_a_journal(tmp_path) -> None:
    """The second is told so; a lock ends with its process."""
    path = tmp_path / "j.jsonl"
    first = run_journaled(float, [1, 2], path)
    next(first)
    with raises_code("not_available"):
        next(run_journaled(float, [1], path))
    first.close()
    assert list(run_journaled(float, [1, 2], path)) == [1.0, 2.0]


@linux
def test_a_campaign_survives_sigkill(tmp_path, child) -> None:
    """Killed while it drives to each place in turn, the campaign measures every pose once and ends with the same set."""
    rng = np.random.default_rng(4)
    pose = np.array([0, 1, -1, 2, 3])
    plan = build_new_progress(("a", "b"), rng.normal(size=(5, 2)), pose)
    seen = tmp_path / "measured.txt"

    def measure(die: bool, number: int, q: np.ndarray):
        if die and not seen.with_suffix(f".{number}").exists():
            seen.with_suffix(f".{number}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        with seen.open("a") as file:
            file.write(f"{number}\n")
        return None if number < 0 else (np.array([*q, 1 / 3]), None)

    def go(path: Path, die: bool) -> int:
        run_campaign(plan, partial(measure, die), path)
        return 0

    for _ in range(5):
        assert child(partial(go, tmp_path / "c.json", True)) == -signal.SIGKILL
    assert child(partial(go, tmp_path / "c.json", True)) == 0
    assert sorted(seen.read_text().split()) == ["-1", "0", "1", "2", "3"]
    go(tmp_path / "undisturbed.json", False)
    assert (tmp_path / "c.json").read_bytes() == (tmp_path / "undisturbed.json").read_bytes()


ROW = {"what": "clean", "position_sd": 1e-6, "nominal": True, "false_parameter": False, "first": "", "unexplained": "",
       "names": "", "lambda": "", "all": "", "claims": 0, "seconds": 1 / 3, "fault": "", "motions": "fourier; prbs",
       "robot": "axis", "known_model": False}  # fmt: skip


@pytest.mark.parametrize("stop", [0, 1, 4])
def test_the_hidden_effect_study_goes_on(tmp_path, monkeypatch, stop: int) -> None:
    """Interrupted before any set, its table, text and confusion are those of an undisturbed study, to the byte."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    import hidden_effects

    asked: list[int] = []

    def one(what: str, number: int, seed: int) -> dict:
        if len(asked) == stop and "interrupted" in str(folder) and number == stop:
            raise KeyboardInterrupt
        asked.append(number)
        return ROW | {"what": what, "number": number, "position_sd": 1e-6 * (number + 1) / 3, "claims": number % 2}

    monkeypatch.setattr(hidden_effects, "one_row", one)
    folder = tmp_path / "interrupted"
    with pytest.raises(KeyboardInterrupt):
        hidden_effects.main(["clean"], 6, 3, 1, None, folder)
    assert len(asked) == stop and not (folder / "hidden_effects.txt").exists()
    asked.append(-1)
    hidden_effects.main(["clean"], 6, 3, 1, None, folder)
    assert asked == [*range(stop), -1, *range(stop, 6)]
    with pytest.raises(SystemExit, match="sets of seed 3"):
        hidden_effects.main(["clean"], 6, 4, 1, None, folder)
    folder = tmp_path / "undisturbed"
    hidden_effects.main(["clean"], 6, 3, 1, None, folder)
    for name in ("hidden_effects.csv", "hidden_effects.txt", "confusion.csv"):
        assert (folder / name).read_bytes() == (tmp_path / "interrupted" / name).read_bytes(), name
