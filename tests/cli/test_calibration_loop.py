"""Plan, measure, calibrate, write to the controller, verify: by commands, on a robot built otherwise than its file."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot

ROBOT = load_robot("gantry_tau")
BUILT = load_robot("gantry_tau", **{"simplified.arms.1.rods.1.length": 2.053})
"""The robot as it stands: a rod 3 mm longer than in the file."""
JOINTS = [f"q_{joint}" for joint in ROBOT.actuated]
NOISE = 2e-5  # [m] of the tracker
START, END = (1.6, -0.65, 0.7), (1.8, -0.6, 0.75)  # [m]


def measure(plan: str, out: str, seed: int) -> None:
    """Write what a tracker measures of the built robot at planned positions."""
    q = pd.read_csv(plan, comment="#")[JOINTS].to_numpy()
    place = forward_kinematics(BUILT, q).poses.position + NOISE * np.random.default_rng(seed).standard_normal(
        (len(q), 3)
    )
    pd.DataFrame(np.hstack([q, place]), columns=[*JOINTS, "x_tool", "y_tool", "z_tool"]).to_csv(out, index=False)


def run(*words: str) -> None:
    assert main([*words, "--quiet"]) == 0, words


def test_a_program_planned_with_the_calibrated_robot_reaches_its_places(tmp_path, monkeypatch, capsys) -> None:
    """A rod of 3 mm puts the tool 2 mm off its places; calibrated, program and check are off by the tracker's noise."""
    pytest.importorskip("casadi")
    monkeypatch.chdir(tmp_path)
    run("plan-poses", "gantry_tau", "--n", "30", "--out", "plan.csv", "--rapid", "measure.mod", "--seed", "1")
    measure("plan.csv", "poses.csv", 1)
    run("calibrate", "gantry_tau", "poses.csv", "--out", "calibrated.yaml")
    ends = ["--from", *map(str, START), "--to", *map(str, END)]
    off = {}
    for name in ("gantry_tau", "calibrated.yaml"):
        run("plan-motion", name, *ends, "--out", "motion.csv")
        q = pd.read_csv("motion.csv")[[f"q_ref_{joint}" for joint in ROBOT.actuated]].to_numpy()[[0, -1]]
        off[name] = np.linalg.norm(forward_kinematics(BUILT, q).poses.position - [START, END], axis=1)
    assert off["gantry_tau"].min() > 1.5e-3 and off["calibrated.yaml"].max() < 5 * NOISE
    run("export", "calibrated.yaml", "--to", "rapid", "--motion", "motion.csv", "--out", "program.mod")
    assert "MoveAbsJ" in (tmp_path / "program.mod").read_text()
    run("plan-poses", "calibrated.yaml", "--n", "12", "--out", "check.csv", "--seed", "7")
    measure("check.csv", "verify.csv", 2)
    left = {}
    for name in ("gantry_tau", "calibrated.yaml"):
        command = ["calibrate", name, "verify.csv", "--model", "frames", "--json", "r.json"]
        assert main(command) == 0
        left[name] = json.loads((tmp_path / "r.json").read_text())["models"][0]["train"]["position"]["rms"]
    assert left["gantry_tau"] > 1e-3 and left["calibrated.yaml"] < 3 * NOISE
    assert "No larger model" not in capsys.readouterr().out  # none was fitted
