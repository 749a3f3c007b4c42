"""Arms with grippers: which joints move, what a log without the gripper means, and the demo on such an arm."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from tau_dyn.cli import demo as demo_module, main
from tau_dyn.cli.arguments import RobotOptions
from tau_dyn.cli.demo import hash_log, load_arm, make_arm
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, read_log
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot


@pytest.fixture
def arm(write, tmp_path):
    """Two rods that turn about y, and two fingers on the second, of which one follows the other."""

    def finger(side: str, more: str = "") -> str:
        slide = write.joint(side, "prismatic", "lower_link", f"{side}_link", "0 1 0", "0.3 0 0")
        return write.link(f"{side}_link", 0.1, "0 0 0.02", "1e-5 1e-5 1e-5") + slide.replace(
            "</joint>", f"{more}</joint>"
        )

    path = tmp_path / "gripping.urdf"
    parts = (
        write.rod("upper_link", 3, 0.4),
        write.joint("shoulder", "revolute", "base_link", "upper_link", "0 1 0"),
        write.rod("lower_link", 2, 0.3),
        write.joint("elbow", "revolute", "upper_link", "lower_link", "0 1 0", "0.4 0 0"),
        finger("left"),
        finger("right", '<mimic joint="left"/>'),
    )
    path.write_text(write.text("gripping", *parts))
    return path


def test_the_joints_that_carry_the_tool_are_told_from_the_gripper(arm):
    """Without a tool it is the joints before the tree forks; with a finger as tool, those up to the finger."""
    robot = load_robot(arm)
    assert robot.actuated == ("shoulder", "elbow", "left") and robot.mimics["right"].joint == "left"
    assert robot.carrying_joints == ("shoulder", "elbow")
    assert load_robot(arm, tool="left_link").carrying_joints == robot.actuated


def test_fk_takes_the_joints_that_carry_the_tool(arm, capsys):
    """Fingers do not move the lower link: two values put it where three do, and one is still too few."""
    places = []
    for q in (["0.3", "0.5"], ["0.3", "0.5", "0.01"]):
        assert main(["fk", str(arm), "--tool", "lower_link", "--q", *q, "--json", "-", "--quiet"]) == 0
        places.append(json.loads(capsys.readouterr().out)["rows"][0]["position"])
    assert places[0] == pytest.approx(places[1])
    assert main(["fk", str(arm), "--tool", "lower_link", "--q", "0.3", "--quiet"]) == 2
    assert "one value for each actuated joint" in capsys.readouterr().err


def test_a_log_without_the_gripper_holds_it_still(arm, tmp_path, capsys):
    """`identify` takes a log of the arm's joints alone and says that the finger is held; an arm's joint is still asked for."""
    log, result = tmp_path / "log.csv", tmp_path / "result.json"
    quiet = ["--quiet", "--force-noise", "0.01", "--encoder-noise", "1e-5", "--duration", "12"]
    assert main(["simulate", str(arm), "--actuated", "shoulder", "elbow", "--out", str(log), *quiet]) == 0
    capsys.readouterr()
    for words in (["check", str(log), str(arm)], ["identify", str(arm), str(log)]):
        assert main([*words, "--json", str(result), "--quiet"]) == 0
        assert "held still at zero" in capsys.readouterr().err
    found = json.loads(result.read_text())
    assert list(found["train"]["per_joint"]) == ["shoulder", "elbow"]
    assert found["train"]["relative_error_percent"] < 1.0
    lines = [line.split(",") for line in log.read_text().splitlines()]
    lacking = [k for k, name in enumerate(lines[0]) if name.endswith("_elbow")]
    log.write_text("\n".join(",".join(x for k, x in enumerate(row) if k not in lacking) for row in lines) + "\n")
    assert main(["identify", str(arm), str(log), "--quiet"]) == 2
    assert "q_elbow" in capsys.readouterr().err


def test_numbered_columns_of_a_log_without_the_gripper_are_the_arms(arm, tmp_path, capsys):
    """`columns` maps q1 and q2 onto the joints that carry the tool: a finger has no column, and the numbers are two."""
    log, map_ = tmp_path / "log.csv", tmp_path / "map.yaml"
    log.write_text(
        "time,q1,q2,tau_J1,tau_J2\n" + "".join(f"{k / 100},{k / 40},{k * k / 2000},1,{k}\n" for k in range(40))
    )
    assert main(["columns", str(log), str(arm), "--out", str(map_), "--quiet"]) == 0
    capsys.readouterr()
    assert yaml.safe_load(map_.read_text()) == {
        "t": "time", "q_shoulder": "q1", "q_elbow": "q2", "tau_shoulder": "tau_J1", "tau_elbow": "tau_J2"
    }  # fmt: skip


def test_poses_without_the_gripper_hold_it_still(arm, tmp_path, capsys):
    """`calibrate` takes poses of the arm's joints alone; a finger on the tool, which moves it, is still asked for."""
    q = np.random.default_rng(3).uniform(-1.2, 1.2, (40, 2))
    robot = load_robot(arm, actuated=("shoulder", "elbow"), tool="lower_link")
    rows = np.hstack([q, forward_kinematics(robot, q).poses.position])
    head = "q_shoulder,q_elbow,x_tool,y_tool,z_tool"
    poses, result = tmp_path / "poses.csv", tmp_path / "result.json"
    np.savetxt(poses, rows, delimiter=",", header=head, comments="")
    words = ["calibrate", str(arm), str(poses), "--known", "device", "tool", "--quiet"]
    assert main([*words, "--tool", "lower_link", "--json", str(result)]) == 0
    assert "held still at zero" in capsys.readouterr().err
    assert main([*words, "--tool", "left_link"]) == 2
    assert "q_left" in capsys.readouterr().err


def test_the_demo_holds_the_gripper_and_loads_the_arm(arm):
    """Only the arm's joints have friction; the payload is on the last link that they carry, and weighs what it says."""
    robot, call = load_arm(str(arm), RobotOptions())
    assert robot.actuated == ("shoulder", "elbow") and robot.tool == "lower_link"
    assert call == f"{arm} --tool lower_link"
    made = make_arm(robot, call, seed=0)
    values = {p.name: p.value for p in made.truth.parameters}
    heavier = values["lower_link.mass"] - robot.parameters["lower_link.mass"].value
    payload = demo_module.PAYLOAD_SHARE * 5.2  # kg, two rods and two fingers
    assert (
        f"{payload:.3g} kg" in made.said and abs(heavier - payload) <= 0.011 * robot.parameters["lower_link.mass"].value
    )
    assert "left.coulomb_pos" not in values and values["elbow.stribeck"] > 0
    hanging = made.truth.mechanism.inverse_dynamics(*np.zeros((3, 1, 2)))[0, 0]
    nominal = load_robot(arm, actuated=robot.actuated)
    bare = make_arm(nominal, call, seed=0).truth.with_values(
        {n: nominal.parameters[n].value for n in nominal.parameters.names}
    )
    weighed = bare.mechanism.inverse_dynamics(*np.zeros((3, 1, 2)))[0, 0]
    reach = 0.4 + demo_module.PAYLOAD_CENTRE[0]
    assert hanging - weighed == pytest.approx(-9.81 * payload * reach, rel=0.05)


def test_the_demo_hashes_logs_as_their_files_are_written(tmp_path):
    """The models' provenance names a log by the hash of the file that the demo writes."""
    log = hash_log(Log(np.arange(20) / 3, {"q_axis": np.arange(20) / 7}, "monday.csv"))
    log.to_csv(tmp_path / log.name)
    assert read_log(tmp_path / log.name).sha256 == log.sha256 != ""


def test_several_arms_need_a_tool(write, tmp_path, capsys):
    """Where two arms begin at the base, the sentences say how to choose; chosen, the other arm stands still."""
    path = tmp_path / "two_arms.urdf"
    parts = (
        write.link(f"{side}_link", 1.0, "0 0 -0.2", "1e-3 1e-3 1e-3")
        + write.joint(side, "revolute", "base_link", f"{side}_link", "0 1 0")
        for side in ("left", "right")
    )
    path.write_text(write.text("two_arms", *parts))
    with pytest.raises(InputError, match="--tool"):
        load_arm(str(path), RobotOptions())
    robot, call = load_arm(str(path), RobotOptions(tool="right_link"))
    assert robot.actuated == ("right",) and "--tool right_link" in call
    poses = tmp_path / "poses.csv"
    poses.write_text("q_right,x_tool,y_tool,z_tool\n" + "".join(f"{k},0,0,1\n" for k in range(9)))
    assert main(["calibrate", str(path), str(poses), "--quiet"]) == 2
    assert "--tool" in capsys.readouterr().err
