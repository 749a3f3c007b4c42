"""A calibrated robot of rods written back as a robot file: kinematics, dynamics and every command then have it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import family_at, measured, rods_of, spoiled

from tau_dyn.calibrate.frames import DeviceFrames
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.saved import CalibratedRobot
from tau_dyn.calibrate.simulated import format_csv
from tau_dyn.cli import main
from tau_dyn.mechanism import build_mechanism, build_rods, forward_kinematics, inverse_kinematics

ROBOTS = {
    "delta": {},
    "gantry_tau": {},
    "complete": {"name": "gantry_tau", "prototype": "d1", "arms": "complete"},
    "gantry_tau_f1": {},
    "stewart": {},
    "hexaglide": {},
    "hexarot": {},
    "triglide": {},
}


def _calibrated(rods, model: str = "", size: float = 2e-3) -> CalibratedRobot:
    """Return a robot with errors in all its dimensions."""
    family = family_at(rods)
    geometry = family.build(family.spec(model)) if model else RodGeometry(rods)
    theta = spoiled(geometry, np.random.default_rng(1), size)
    return CalibratedRobot(rods.robot, geometry, theta, DeviceFrames(), np.zeros(rods.na), model)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_file_is_the_calibrated_robot(name: str) -> None:
    """The tool of the file is the calibrated one; its inverse and its tree with loops closed agree, also written twice."""
    rods = rods_of(**({"name": name} | ROBOTS[name]))
    found = _calibrated(rods)
    robot = found.build_robot("calibrated.yaml")
    q = robot.home + 0.03 * np.random.default_rng(2).standard_normal((5, robot.na))
    wanted, nominal = found.forward(q).poses, forward_kinematics(rods, q).poses
    poses = forward_kinematics(robot, q).poses
    assert np.abs(poses.position - wanted.position).max() < 1e-9 > np.abs(poses.rotation - wanted.rotation).max()
    assert np.abs(poses.position - nominal.position).max() > 1e-4
    assert np.abs(inverse_kinematics(robot, poses, limits=False).q - q).max() < 1e-9
    assert np.abs(build_mechanism(robot).tool_position(q) - wanted.position).max() < 1e-9


def test_a_second_calibration_begins_at_the_first() -> None:
    """A file with a drive's scale is a robot to calibrate again; its nominal values are the calibrated ones."""
    first = _calibrated(rods_of())
    second = RodGeometry(build_rods(first.build_robot("calibrated.yaml")))
    assert np.abs(second.parameters.values - first.theta).max() < 1e-12


def test_what_a_file_cannot_hold_is_refused() -> None:
    """Laws of drives, and the two lengths that stand for a triangle's turn about one axis."""
    with raises_code("unsupported", "laws"):
        _calibrated(rods_of(), "nonparallel+periodic").build_robot()
    with raises_code("unsupported", "triangle3_1"):
        _calibrated(rods_of(name="gantry_tau_queensland")).build_robot()


@pytest.mark.parametrize("name", ["delta", "gantry_tau"])
def test_commands_take_a_calibration_for_a_robot(name: str, tmp_path: Path, monkeypatch) -> None:
    """`fk`, `ik`, and `simulate` and `identify` with the drives' scales, run on what `calibrate --out` wrote."""
    monkeypatch.chdir(tmp_path)
    rods = rods_of(name=name)
    model = "nonparallel" if name == "gantry_tau" else "complete"
    poses, _ = measured(rods, model, 40, 5, reach=0.2)
    Path("poses.csv").write_text(format_csv(poses, rods.robot.actuated))
    call = ["calibrate", name, "poses.csv", "--model", model, "--out", "robot.yaml", "--quiet"]
    assert main(call) == 0
    q = [f"{x + 0.05:.3f}" for x in rods.robot.home]
    assert main(["fk", "robot.yaml", "--q", *q, "--json", "fk.json", "--quiet"]) == 0
    position = json.loads(Path("fk.json").read_text())["rows"][0]["position"]
    assert main(["fk", name, "--q", *q, "--json", "nominal.json", "--quiet"]) == 0
    assert np.abs(np.array(position) - json.loads(Path("nominal.json").read_text())["rows"][0]["position"]).max() > 1e-5
    assert main(["ik", "robot.yaml", "--position", *[repr(x) for x in position], "--json", "ik.json", "--quiet"]) == 0
    assert json.loads(Path("ik.json").read_text())["rows"][0]["q"] == pytest.approx([float(x) for x in q], abs=1e-9)
    if name == "gantry_tau":
        assert (
            main(["excite", "robot.yaml", "--out", "motion.csv", "--method", "random", "--duration", "5", "--quiet"])
            == 0
        )
        assert main(["simulate", "robot.yaml", "--motion", "motion.csv", "--out", "log.csv", "--quiet"]) == 0
        assert main(["identify", "robot.yaml", "log.csv", "--quiet"]) == 0
