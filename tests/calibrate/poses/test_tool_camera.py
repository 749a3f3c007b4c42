"""A camera on the tool: which poses show it a pattern that stands still, and what they bring."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import l1, six_axes

from tau_dyn.calibrate import calibrate, read_poses
from tau_dyn.calibrate.poses import CalibrationCampaign, ToolCamera, plan_campaign, read_camera
from tau_dyn.calibrate.poses.monte_carlo import draw_robot, simulate_measurement
from tau_dyn.cli import main
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements
from tau_dyn.mechanism import convert_to_quaternions

FILE = """
camera: {mount: tool, position: [0, 0.08, 0], look_at: [0, 0.08, 1], up: [0, 1, 0], image: [1280, 960], focal: 1100}
pattern: {columns: 8, rows: 6, square: 0.02, position: [0.6, 0.1, 0], normal: [0, 0, 1], up: [1, 0, 0]}
limits: {distance: [0.25, 1.5]}
"""


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> CalibrationCampaign:
    """Forty poses of a six-axis arm with a camera on its flange."""
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    path.write_text(FILE)
    return plan_campaign(six_axes(), read_camera(path), 40, candidates=400, runs=3)


def test_every_planned_pose_shows_the_whole_pattern(plan: CalibrationCampaign) -> None:
    """Corners in the base frame, seen through a pinhole that the joints carry, lie in the picture at every pose."""
    tool = plan.tool(plan.choice.q)
    x, y = np.meshgrid(0.02 * (np.arange(8) - 3.5), 0.02 * (np.arange(6) - 2.5))
    corners = np.array([0.6, 0.1, 0]) + np.stack([-y.ravel(), x.ravel(), np.zeros(48)], axis=1)
    for p, turn in zip(tool.position, tool.rotation, strict=True):
        eye = p + turn @ [0, 0.08, 0]
        right, down, ahead = ((corners - eye) @ turn).T * np.array([[-1], [-1], [1]])  # `up` is y of the tool
        u, v = 639.5 + 1100 * right / ahead, 479.5 + 1100 * down / ahead
        assert (ahead > 0.2).all()
        assert u.min() > 4 and u.max() < 1276 and v.min() > 4 and v.max() < 956


def test_the_camera_is_turned_to_the_pattern(plan: CalibrationCampaign) -> None:
    """Positions drawn from the joints' travel look at the pattern by chance alone; turned to it, ten times as many do."""
    by_chance = int((plan.device.reasons(plan.reachable.tool) == "").sum())
    assert len(plan.visible.index) > 10 * by_chance


def test_simulated_calibrations_are_as_accurate_as_predicted(plan: CalibrationCampaign) -> None:
    """Calibrations of simulated robots reach what the derivatives predict, far below the nominal robot's errors."""
    assert plan.rehearsal.achieved < 2 * plan.choice.predicted.rms
    assert plan.rehearsal.achieved < 0.05 * np.sqrt(np.mean(plan.rehearsal.before**2))


def test_poses_of_the_pattern_in_the_camera_calibrate(plan: CalibrationCampaign, tmp_path: Path) -> None:
    """The planned poses, measured as a camera writes them, calibrate a robot whose dimensions are off."""
    rng, geometry = np.random.default_rng(4), plan.choice.design.geometry
    theta = draw_robot(geometry, plan.choice.q, 1e-3 * np.ones(len(geometry.parameters)), rng)
    device = plan.device
    assert isinstance(device, ToolCamera)
    seen = simulate_measurement(device, geometry, theta, plan.choice.q, rng)
    table = pd.DataFrame(plan.choice.q, columns=[f"q_{joint}" for joint in plan.robot.actuated])
    table[["x_tool", "y_tool", "z_tool"]] = seen.position
    table[["qx_tool", "qy_tool", "qz_tool", "qw_tool"]] = convert_to_quaternions(seen.poses)
    table.to_csv(tmp_path / "seen.csv", index=False)
    found = calibrate(six_axes(), read_poses(tmp_path / "seen.csv", plan.robot.actuated))
    assert found.fit.poses.kinds == ("hand_eye",)
    truth = geometry.forward(theta, plan.choice.design.workspace).poses
    model = found.fit.geometry.forward(found.fit.theta, plan.choice.design.workspace).poses
    turn, _ = Rotation.align_vectors(
        truth.position - truth.position.mean(axis=0), model.position - model.position.mean(axis=0)
    )
    left = truth.position - truth.position.mean(axis=0) - turn.apply(model.position - model.position.mean(axis=0))
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) < 3 * plan.choice.predicted.rms


def test_the_camera_stays_out_of_obstacles_and_looks_past_them(plan: CalibrationCampaign) -> None:
    """No planned camera stands in a box that many did before, and no line of sight to the pattern's middle crosses it."""
    box = {"name": "shelf", "box": {"centre": [0.45, 0.1, 0.5], "size": [0.2, 0.6, 0.3]}}
    around = build_surroundings({"obstacles": [box]}, "lab")
    beside = plan_campaign(
        six_axes(), plan.device, 40, demands=PoseRequirements(surroundings=around), candidates=400, runs=1
    )

    def cross(found: CalibrationCampaign) -> np.ndarray:
        tool = found.tool(found.choice.q)
        eye = tool.position + tool.rotation @ [0, 0.08, 0]
        along = eye[:, None] + np.linspace(0, 1, 200)[:, None] * (np.array([0.6, 0.1, 0]) - eye)[:, None]
        return (np.abs(along - [0.45, 0.1, 0.5]) < [0.1, 0.3, 0.15]).all(axis=2).any(axis=1)

    assert cross(plan).sum() > 3
    assert not cross(beside).any()
    assert any("shelf" in why for why in beside.visible.reasons)


def test_a_tool_that_does_not_turn_is_refused(tmp_path: Path) -> None:
    """A camera on a plate that keeps its orientation shows a point reflection of its motion, which no frame explains."""
    (tmp_path / "camera.yaml").write_text(FILE)
    with raises_code("unsupported"):
        plan_campaign(l1(), read_camera(tmp_path / "camera.yaml"), 40)


def test_a_pattern_behind_the_robot_is_refused_with_the_reason(tmp_path: Path) -> None:
    """From out of reach no pose stands in front of the pattern; the sentence says so."""
    (tmp_path / "camera.yaml").write_text(FILE.replace("position: [0.6, 0.1, 0]", "position: [0.6, 0.1, 9]"))
    with raises_code("not_visible") as fault:
        plan_campaign(six_axes(), read_camera(tmp_path / "camera.yaml"), 40, candidates=100)
    assert "in front of the pattern" in str(fault.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mount: tool", "mount: wall", "mount must be base or tool"),
        ("limits:", "choose: direction\nlimits:", "leave it out for a camera on the tool"),
    ],
)
def test_faulty_files_are_a_sentence(tmp_path: Path, old: str, new: str, message: str) -> None:
    """A mount that is none and a choice that does not exist are named."""
    (tmp_path / "camera.yaml").write_text(FILE.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_camera(tmp_path / "camera.yaml")


def test_pictures_of_the_robot_need_a_camera_that_stands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What a camera beside the robot should see is not offered for a camera on the tool."""
    (tmp_path / "camera.yaml").write_text(FILE)
    wanted = ["--camera", str(tmp_path / "camera.yaml"), "--picture", str(tmp_path / "wanted.png")]
    assert main(["plan-poses", "ur5", *wanted]) == 2
    assert "on the tool" in capsys.readouterr().err
