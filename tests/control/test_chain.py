"""What one command writes the next accepts: plan -> reference -> RAPID -> C -> replay, with default options."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.control import read_reference
from tau_dyn.robot import Robot, list_robot_names, list_stock_robots, load_robot
from tau_dyn.simulate import Trajectory

pytest.importorskip("casadi")
MOVES = {
    "gantry_tau": ["--from", "1.3", "-0.75", "0.65", "--to", "2.2", "-0.45", "0.85"],
    "ur5": ["--from-joints", "0", "-1", "1", "0", "0.5", "0", "--to-joints", "0.8", "-0.7", "1.3", "0.4", "0.6", "1"],
    "delta": ["--from", "0", "0", "-0.79", "--to", "0.1", "0.05", "-0.74"],
}


@pytest.mark.parametrize("name", MOVES)
def test_each_command_takes_what_the_last_one_wrote(name, tmp_path, monkeypatch) -> None:
    """A shortest motion, its reference every 4 ms, RAPID, C kinematics and feedforward, and a log that follows it."""
    if name not in (*list_robot_names(), *list_stock_robots()):
        pytest.skip("example-robot-data is not installed")
    monkeypatch.chdir(tmp_path)
    steps = [
        ["plan-motion", name, *MOVES[name], "--out", "plan.csv", "--json", "plan.json"],
        ["export", name, "--to", "reference", "--motion", "plan.csv", "--out", "ref.csv"],
        ["export", name, "--to", "rapid", "--motion", "ref.csv", "--out", "move.mod"],
        ["export", name, "--to", "c", "--out", "kin.c"],
        ["feedforward", "export", name, "--to", "c", "--out", "ff.c"],
        ["simulate", name, "--motion", "ref.csv", "--out", "log.csv"],
    ]
    for step in steps:
        assert main([*step, "--quiet"]) == 0, step
    robot = load_robot(name)
    reference, log = read_reference("ref.csv", robot.actuated), pd.read_csv("log.csv")
    assert reference.duration == pytest.approx(
        json.loads((tmp_path / "plan.json").read_text())["duration_s"], abs=0.006
    )
    q = log[[f"q_{j}" for j in robot.actuated]].to_numpy()
    asked = np.column_stack([np.interp(log["t"], reference.t, x) for x in reference.q.T])
    # the shortest time leaves a drive at its limit nothing for the feedback
    assert np.abs(q - asked).max() < 0.1 * np.ptp(reference.q, axis=0).max()
    if shutil.which("cc"):
        subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "-c", "kin.c", "-o", "x.o"], check=True)
        shared = [
            "cc",
            "-std=c99",
            "-Wall",
            "-Werror",
            "-shared",
            "-fPIC",
            "-o",
            str(tmp_path / "ff.so"),
            "ff.c",
            "-lm",
        ]
        subprocess.run(shared, check=True)
        replay(
            ctypes.CDLL(str(tmp_path / "ff.so")), "tau_ff_start" in (tmp_path / "ff.h").read_text(), reference, robot
        )


def replay(code: ctypes.CDLL, follows: bool, reference: Trajectory, robot: Robot) -> None:
    """Ask the feedforward in C for the forces of a reference: no sample of it has an error status."""
    start, tau = np.zeros(200), np.zeros(robot.na)
    at = [x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in (start, tau)]
    if follows:
        code.tau_ff_start(at[0])
    for row in zip(reference.q, reference.v, reference.a, strict=True):
        state = [np.ascontiguousarray(x).ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in row]
        assert code.tau_ff(*at[: int(follows)], *state, at[1]) == 0
        assert np.all(np.abs(tau) <= robot.effort_limit)
