"""`tau-dyn plan-motion`: what it writes, that `simulate` follows it, and its sentences for faulty input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.log import read_log

pytest.importorskip("casadi")

FAST = ["plan-motion", "gantry_tau", "--set", "prototype=l1", "--nodes", "20", "--quiet"]
ENDS = ["--from", "1.5", "-0.7", "0.7", "--to", "2.0", "-0.5", "0.8"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run with all outputs."""
    folder = tmp_path_factory.mktemp("motion")
    outputs = [x for kind, name in (("out", "m.csv"), ("json", "m.json"), ("report", "m.html"))
               for x in (f"--{kind}", str(folder / name))]  # fmt: skip
    assert main([*FAST, *ENDS, "--force-limit", "400", "--margin", "0.1", *outputs]) == 0
    return folder


def test_the_result_says_what_holds_it_back(written: Path) -> None:
    """Duration, solver and the limits that bind are in the JSON, and forces keep limit and margin."""
    result = json.loads((written / "m.json").read_text())
    assert result["status"] == "ok" and result["solver"]["status"] == "Solve_Succeeded"
    assert any(b["quantity"] == "force" for b in result["binding"])
    assert all(row["force"] <= 0.9 * 400 * 1.005 for row in result["joints"])
    assert 0.2 < result["duration_s"] < 2.0


def test_simulate_follows_the_motion(written: Path) -> None:
    """The motion file is one that `simulate --motion` reads; the log lasts as long and ends at the goal."""
    command = ["simulate", "gantry_tau", "--set", "prototype=l1", "--motion", str(written / "m.csv"), "--quiet"]
    assert main([*command, "--out", str(written / "log.csv")]) == 0
    log, result = read_log(written / "log.csv"), json.loads((written / "m.json").read_text())
    assert abs(log.duration - result["duration_s"]) < 2e-3
    reached = np.array([log.channels[f"q_cart{k}"][-1] for k in (1, 2, 3)])
    assert np.abs(reached - result["to"]["q"]).max() < 5e-3


def test_the_page_draws_forces_and_the_way(written: Path) -> None:
    """The page shows each cart's force between its limits and the tool's way."""
    page = (written / "m.html").read_text()
    assert "Forces and their limits" in page and "The tool" in page and page.count('class="limit"') >= 6


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        (["--from", "9", "0", "0", "--to", "2", "-0.5", "0.8"], 2, "out of reach"),
        (["--from", "1.5", "-0.7", "0.7"], 2, "the start and the end"),
        ([*ENDS, "--from-joints", "0", "0", "0"], 2, "the start and the end"),
        ([*ENDS, "--force-limit", "1", "2"], 2, "one a joint"),
        ([*ENDS, "--path", "nowhere.csv"], 2, "nowhere.csv"),
        ([*ENDS, "--margin", "1.5"], 2, "margin"),
        ([*ENDS, "--condition", "2"], 2, "singularity"),
    ],
)
def test_faults_are_one_sentence(given: list[str], status: int, said: str, tmp_path: Path, capsys) -> None:
    """Faulty input ends with its status, one line, and no file."""
    assert main([*FAST, *given, "--out", str(tmp_path / "m.csv")]) == status
    fault = capsys.readouterr().err.strip()
    assert said in fault and "\n" not in fault and not list(tmp_path.iterdir())


def test_points_come_from_a_table(tmp_path: Path, capsys) -> None:
    """A path through points of a table; a table without the columns is refused by the missing one."""
    (tmp_path / "p.csv").write_text("x_tool,y_tool,z_tool\n1.75,-0.6,0.8\n")
    (tmp_path / "bad.csv").write_text("x_tool,y_tool\n1.75,-0.6\n")
    given = [*FAST, *ENDS, "--out", str(tmp_path / "m.csv"), "--path"]
    assert main([*given, str(tmp_path / "bad.csv")]) == 2
    assert "z_tool" in capsys.readouterr().err
    assert main([*given, str(tmp_path / "p.csv")]) == 0
    before = (tmp_path / "p.csv").read_text()
    assert main([*FAST, *ENDS, "--path", str(tmp_path / "p.csv"), "--out", str(tmp_path / "p.csv")]) == 2
    assert (tmp_path / "p.csv").read_text() == before
