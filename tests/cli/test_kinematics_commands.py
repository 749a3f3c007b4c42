"""`fk` and `ik` on the command line: what they write, and how bad input ends."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.robot import load_robot


def test_there_and_back_through_files(tmp_path, capsys):
    """A table written by `fk` is read by `ik`, whose table has the positions that went in; pages and results are written."""
    robot = load_robot("gantry_tau", arms="complete")
    q = robot.home + np.linspace(-0.2, 0.2, 5)[:, None] * np.array([1.0, -1.0, 0.5])
    positions, poses, back = (tmp_path / name for name in ("q.csv", "x.csv", "back.csv"))
    pd.DataFrame({f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}).to_csv(positions, index=False)
    common = ["--set", "arms=complete"]
    page, result = tmp_path / "p.html", tmp_path / "r.json"
    assert (
        main(["fk", "gantry_tau", *common, "--poses", str(positions), "--out", str(poses), "--report", str(page)]) == 0
    )
    assert main(["ik", "gantry_tau", *common, "--poses", str(poses), "--out", str(back), "--json", str(result)]) == 0
    table = pd.read_csv(back)
    assert list(table.columns[:4]) == ["q_cart1", "q_cart2", "q_cart3", "x_tool"]
    np.testing.assert_allclose(table[[f"q_{j}" for j in robot.actuated]].to_numpy(), q, atol=1e-11)
    written = json.loads(result.read_text())
    assert written["status"] == "ok" and written["answered"] == 5 and len(written["rows"]) == 5
    assert "Forward kinematics" in page.read_text(encoding="utf-8")
    assert "5 of 5 poses can be reached" in capsys.readouterr().out


def test_all_configurations(tmp_path, capsys):
    """Eight solutions of one pose, by their signs; those outside the limits say so."""
    out = tmp_path / "all.csv"
    assert main(["ik", "gantry_tau", "--position", "1.75", "-0.6", "0.75", "--all", "--out", str(out)]) == 0
    table = pd.read_csv(out)
    assert sorted(table["configuration"]) == ["+++", "++-", "+-+", "+--", "-++", "-+-", "--+", "---"]
    assert (table["reason"] == "joint limit").sum() == 7
    assert "8 solutions for 1 pose" in capsys.readouterr().out


def test_all_assembly_modes(tmp_path, capsys):
    """Of a row with two modes, one out of reach and a gap, each has its modes or its reason, in the table and in JSON."""
    positions, out, result = (tmp_path / name for name in ("q.csv", "x.csv", "r.json"))
    positions.write_text("q_cart1,q_cart2,q_cart3\n0,0,0.1\n-5,5,0\n,0,0\n")
    argv = ["fk", "gantry_tau", "--all", "--poses", str(positions), "--out", str(out), "--json", str(result)]
    page = tmp_path / "p.html"
    assert main([*argv, "--report", str(page)]) == 0
    table, written = pd.read_csv(out), json.loads(result.read_text())
    assert table["pose"].tolist() == [1, 1, 2, 3] and table["mode"].fillna("").tolist() == ["home", "2", "", ""]
    assert table["reason"].fillna("").tolist() == ["", "", "out of reach", "not a number"]
    assert [(c["count"], c["proved"]) for c in written["modes"]] == [(2, True), (0, True), (0, False)]
    assert [row["mode"] for row in written["rows"]] == ["home", "2", None, None]
    assert {row["configuration"] for row in written["rows"]} == {None}
    said = capsys.readouterr()
    assert "2 of 3 rows have no answer" in said.err and "2 assembly modes of 3 positions" in said.out
    assert "assembly mode" in page.read_text(encoding="utf-8")


def test_a_count_without_proof_is_called_found(capsys):
    """The Delta's parallel rods are special: no bound is known, so the terminal says found; three spheres are proved."""
    assert main(["fk", "delta", "--q", "0", "0", "0.1", "--all"]) == 0
    assert "16 assembly modes of 1 position: found, the count is not proved" in capsys.readouterr().out
    assert main(["fk", "gantry_tau", "--q", "0", "0", "0.1", "--all"]) == 0
    assert "2 assembly modes of 1 position: the count is proved" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["ik", "gantry_tau", "--position", "9", "9", "9"], "cannot be reached: out of reach of cart1"),
        (["ik", "gantry_tau", "--position", "3.75", "-0.6", "0.75"], "cart1 would be at 1.87522 m"),
        (["ik", "gantry_tau", "--position", "1", "nan", "0"], "write a finite number"),
        (["ik", "gantry_tau"], "give --position X Y Z or --poses"),
        (["ik", "gantry_tau", "--position", "1.7", "-0.6", "0.7", "--quaternion", "0", "0", "0", "0"], "zero"),
        (["fk", "gantry_tau", "--q", "0", "0"], "one value for each actuated joint"),
        (["fk", "gantry_tau", "--q", "-5", "5", "0"], "no pose at cart1 = -5 m"),
        (["fk", "gantry_tau", "--q", "-5", "5", "0", "--all"], "no pose at cart1 = -5 m"),
        (["fk", "gantry_tau", "--poses", "missing.csv"], "missing.csv"),
    ],
)
def test_bad_input_ends_with_one_sentence(argv, words, capsys):
    """Status 2 and one line that names what is wrong."""
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and "Traceback" not in error


def test_rows_that_cannot_be_reached_say_why(tmp_path, capsys):
    """Among reachable rows an unreachable one and a gap are told in the table and in a warning; the rest stands."""
    table = tmp_path / "x.csv"
    table.write_text("x_tool,y_tool,z_tool\n1.75,-0.6,0.75\n9,9,9\n,0,0\n")
    out = tmp_path / "q.csv"
    assert main(["ik", "gantry_tau", "--poses", str(table), "--out", str(out)]) == 0
    assert pd.read_csv(out)["reason"].fillna("").tolist() == ["", "out of reach", "not a number"]
    assert "2 of 3 rows have no answer" in capsys.readouterr().err


def test_columns_are_named(tmp_path, capsys):
    """A table without the joints' columns says which one is missing."""
    table = tmp_path / "x.csv"
    table.write_text("a,b\n1,2\n")
    assert main(["fk", "gantry_tau", "--poses", str(table)]) == 2
    assert "no column 'q_cart1'" in capsys.readouterr().err


def test_a_robot_whose_loops_cannot_close(tmp_path, capsys):
    """A rod too short for its plate at home ends in a sentence, not in numbers."""
    text = load_robot("gantry_tau").urdf.replace("2.05", "0.05")
    file = tmp_path / "short.urdf"
    file.write_text(text)
    assert main(["fk", str(file), "--q", "0", "0", "0"]) == 2
    assert "out of reach" in capsys.readouterr().err
