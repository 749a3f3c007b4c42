"""Bad input ends with status 2, one line that helps, and no file; dull data with status 3."""

import json
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main

T = np.arange(0, 12, 0.004)


def axis_log(path: Path, *, t=T, q=None, header="t,q_axis,tau_axis", rows=None) -> Path:
    """Write a log of the linear axis: 95 kg with some friction, moved by two sines."""
    if rows is None:
        q = 0.1 * np.sin(2 * np.pi * 0.5 * t) + 0.03 * np.sin(2 * np.pi * 1.3 * t) if q is None else q
        v, a = np.gradient(q, t), np.gradient(np.gradient(q, t), t)
        tau = 95 * a + 20 * np.sign(v) + 200 * v + np.random.default_rng(0).normal(0, 1, len(t))
        rows = [f"{x:.6f},{y:.9f},{z:.6f}" for x, y, z in zip(t, q, tau, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def fails(capsys, argv: list, status: int = 2) -> str:
    """Run a command that must fail without a traceback; return its one line."""
    assert main([str(a) for a in argv]) == status
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(lines) == 1, lines
    assert "Traceback" not in lines[0]
    return lines[0]


def spoiled(path: Path, line: int, text: str) -> Path:
    """Replace one line (counted from 1) of a good log."""
    axis_log(path)
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("line", "text", "words"),
    [
        (100, "0.392,inf,1.0", ["line 100", "q_axis"]),
        (100, "0.392,0.1,hello", ["line 100", "tau_axis", "hello"]),
        (100, "0.1,0.1,1.0", ["line 100", "forward in time"]),
        (100, "0.388000,0.1,1.0", ["line 100", "0.388"]),
        (100, "0.392,0.1", ["line 100"]),
        (1, "t,q_axis,current", ["tau_axis"]),
        (1, "q_axis,tau_axis,t_s", ["t"]),
        (1, "t,q_other,tau_axis", ["q_axis"]),
    ],
)
def test_faulty_cells_and_columns_are_named(tmp_path, capsys, line, text, words):
    """A fault in a log is named by file, line and column, and nothing is written."""
    log = spoiled(tmp_path / "monday.csv", line, text)
    out = tmp_path / "r.json"
    said = fails(capsys, ["identify", "linear_axis", log, "--json", out])
    assert "monday.csv" in said
    for word in words:
        assert word in said
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "word"),
    [(b"", "empty"), (b"t,q_axis,tau_axis\n0,0,0\n0.1,0,0\n", "2"), (b"t,q_axis\xff\xfe,tau\n1,2,3\n", "UTF-8")],
)
def test_files_that_are_no_logs(tmp_path, capsys, content, word):
    """Empty, far too short and undecodable files are refused by name."""
    path = tmp_path / "odd.csv"
    path.write_bytes(content)
    assert word in fails(capsys, ["identify", "linear_axis", path])


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["identify", "no_robot", "LOG"], ["no_robot", "gantry_tau"]),
        (["identify", "linear_axis", "LOG", "--set", "colour=red"], ["colour"]),
        (["identify", "linear_axis", "LOG", "--set", "colour"], ["NAME=VALUE"]),
        (["identify", "linear_axis", "LOG", "--model", "stribock"], ["stribock", "asymmetric"]),
        (["identify", "linear_axis", "LOG", "--fix", "cart9.mass"], ["cart9.mass", "carriage_link.mass"]),
        (["identify", "linear_axis", "LOG", "--fix", "carriage_link.mass=heavy"], ["heavy"]),
        (["identify", "linear_axis", "LOG", "--bound", "carriage_link.mass=3"], ["LO:HI"]),
        (["identify", "linear_axis", "LOG", "--columns", "none.yaml"], ["none.yaml"]),
        (["identify", "linear_axis", "LOG", "--exclude", "flag"], ["flag"]),
        (["identify", "linear_axis", "LOG", "--actuated", "cart7"], ["cart7", "axis"]),
        (["identify", "linear_axis", "missing.csv"], ["missing.csv"]),
        (["identify", "linear_axis"], ["LOG"]),
        (["identfy"], ["identfy"]),
        (["identify", "gantry_tau", "LOG"], ["q_cart1"]),
        (["identify", "linear_axis", "LOG", "--json", "nowhere/r.json"], ["nowhere"]),
        (["simulate", "linear_axis", "--motion", "jig", "--out", "x.csv"], ["jig", "fourier"]),
        (["simulate", "linear_axis", "--out", "x.parquet"], [".csv"]),
        (["simulate", "linear_axis", "--rate", "0", "--out", "x.csv"], ["--rate"]),
        (["identify", "linear_axis", "LOG", "--seed", "-1"], ["--seed"]),
        (["identify", "linear_axis", "LOG", "--json", "LOG"], ["input", "overwritten"]),
        (["identify", "linear_axis", "LOG", "--json", "r", "--report", "r"], ["two outputs"]),
        (["identify", "linear_axis", "LOG", "--json", "."], ["folder"]),
    ],
)
def test_faulty_requests_say_what_exists(tmp_path, capsys, monkeypatch, argv, words):
    """A request that cannot be met names what was asked for and what exists."""
    monkeypatch.chdir(tmp_path)
    axis_log(tmp_path / "LOG")
    before = sorted(p.name for p in tmp_path.iterdir())
    said = fails(capsys, argv)
    for word in words:
        assert word in said
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_a_still_log_cannot_answer(tmp_path, capsys):
    """Data without motion are sound but cannot answer: status 3, the experiment that would, and a JSON that says so."""
    log = axis_log(tmp_path / "still.csv", q=np.zeros_like(T))
    out = tmp_path / "r.json"
    assert "move axis" in fails(capsys, ["identify", "linear_axis", log, "--json", out], status=3)
    said = json.loads(out.read_text())
    assert said["status"] == "cannot_answer"
    assert [Path(row["path"]).name for row in said["inputs"]] == ["linear_axis.urdf.xacro", "still.csv"]


def test_poses_that_cannot_answer_name_their_files_too(tmp_path, capsys):
    """What went in stands in every result, also where calibrated poses were too few to say anything."""
    poses, held, out = (tmp_path / n for n in ("p.csv", "h.csv", "r.json"))
    for path in (poses, held):
        path.write_text("q_cart1,q_cart2,q_cart3,x_tool,y_tool,z_tool\n0,0,0,1,0,1\n")
    fails(capsys, ["calibrate", "gantry_tau", poses, "--holdout", held, "--json", out], status=3)
    names = [Path(row["path"]).name for row in json.loads(out.read_text())["inputs"]]
    assert names == ["gantry_tau.urdf.xacro", "p.csv", "h.csv"]


def test_positions_in_millimetres_are_noticed(tmp_path, capsys):
    """A prismatic axis that moves by a hundred 'metres' is warned about as millimetres."""
    q = 0.1 * np.sin(2 * np.pi * 0.5 * T)
    v, a = np.gradient(q, T), np.gradient(np.gradient(q, T), T)
    rows = [f"{t:.6f},{1000 * x:.6f},{y:.6f}" for t, x, y in zip(T, q, 95 * a + 20 * np.sign(v), strict=True)]
    log = axis_log(tmp_path / "mm.csv", rows=rows)
    main(["identify", "linear_axis", str(log)])
    assert "mm" in capsys.readouterr().err


def test_a_log_trained_on_is_not_held_out(tmp_path, capsys):
    """A log on both sides is a warning, and no held-out error is reported from it."""
    log, out = axis_log(tmp_path / "a.csv"), tmp_path / "r.json"
    assert main(["identify", "linear_axis", str(log), "--holdout", str(log), "--json", str(out), "--quiet"]) == 0
    assert "both trained on and held out" in capsys.readouterr().err
    assert json.loads(out.read_text())["holdout"] is None


def test_an_incomplete_last_line_is_dropped(tmp_path, capsys):
    """A log cut off in the middle of its last line is used without it, with a warning."""
    log = axis_log(tmp_path / "a.csv")
    log.write_text(log.read_text()[:-8])
    assert main(["identify", "linear_axis", str(log), "--quiet"]) == 0
    assert "last line" in capsys.readouterr().err


def test_a_looped_robot_needs_its_actuated_joints_named(tmp_path, capsys):
    """Loops without transmissions are refused with the option that would help."""
    urdf = (
        '<robot name="r" xmlns:drake="http://drake.mit.edu"><link name="base_link"/><link name="a_link"/><link name="b_link"/>'
        '<joint name="a" type="revolute"><parent link="base_link"/><child link="a_link"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        '<joint name="b" type="revolute"><parent link="base_link"/><child link="b_link"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        '<drake:ball_constraint><drake:ball_constraint_body_A name="a_link"/><drake:ball_constraint_body_B name="b_link"/>'
        '<drake:ball_constraint_p_AP value="1 0 0"/><drake:ball_constraint_p_BQ value="1 0 0"/></drake:ball_constraint></robot>'
    )
    robot = tmp_path / "r.urdf"
    robot.write_text(urdf)
    log = axis_log(tmp_path / "a.csv")
    assert "--actuated" in fails(capsys, ["identify", robot, log])


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("<robot", "line 1"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><robot name="r"/>', "entities"),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><link name="${undefined_thing}"/></robot>',
            "undefined_thing",
        ),
        ('<robot name="r"/>', "r.urdf.xacro"),
    ],
)
def test_broken_robot_files(tmp_path, capsys, content, word):
    """A robot file that cannot be read, expanded or built is refused by name."""
    robot = tmp_path / "r.urdf.xacro"
    robot.write_text(content)
    assert word in fails(capsys, ["identify", robot, axis_log(tmp_path / "a.csv")])
