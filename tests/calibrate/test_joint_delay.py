"""Joints of a moving robot that were read before or after the tool was measured: named with the time, and corrected."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent / "poses"))
from pose_rigs import l1, six_axes

from tau_dyn.calibrate import Calibration, PoseSet, calibrate, read_poses
from tau_dyn.calibrate.conventions.readings import apply_reading, list_readings
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.robot import Robot

NOISE_M = 3e-5
DELAY_S = 0.004


def move(robot: Robot, delay: float, *, seed: int = 3, n: int = 160) -> tuple[PoseSet, PoseSet]:
    """Return poses of a moving robot whose dimensions are 1 mm and 1 mrad off, for the fit and held out.

    The joints stand in the file as they were `delay` before the tool was measured.
    """
    rng, geometry = np.random.default_rng(seed), build_geometry(robot)
    width = np.where(np.array(robot.position_units) == "rad", 0.8, 0.3)
    swing = rng.uniform(0.3, 1.0, (3, robot.na)), rng.uniform(0.1, 0.4, (3, robot.na)), rng.uniform(0, 6, (3, robot.na))

    def joints(t: np.ndarray) -> np.ndarray:
        a, f, phase = swing
        return robot.home + width / 3 * np.sum(a * np.sin(2 * np.pi * f * t[:, None, None] + phase), axis=1)

    theta = geometry.parameters.values + 1e-3 * geometry.parameters.free * rng.standard_normal(len(geometry.parameters))
    t = np.sort(rng.uniform(0, 60, n))
    tool = geometry.forward(theta, joints(t)).poses
    early, v = t - delay, (joints(t - delay + 1e-4) - joints(t - delay - 1e-4)) / 2e-4
    turn, place = Rotation.random(rng=rng).as_matrix(), np.array([1.0, 2.0, 0.5])
    position = (
        place + (tool.position + tool.rotation @ [0.01, 0.02, 0.03]) @ turn.T + NOISE_M * rng.standard_normal((n, 3))
    )
    poses = PoseSet(joints(early), position, approach=np.sign(v), speed=v, source="moving")
    return poses.take(np.arange(n) % 4 > 0), poses.take(np.arange(n) % 4 == 0)


def fit(robot: Robot, delay: float, **settings: int) -> Calibration:
    """Return what default options find."""
    return calibrate(robot, *move(robot, delay, **settings))


@pytest.mark.parametrize("robot", [six_axes(), l1()], ids=["six", "l1"])
@pytest.mark.parametrize("delay", [DELAY_S, -DELAY_S])
def test_the_delay_is_named_with_its_time(robot: Robot, delay: float) -> None:
    """Joints read 4 ms too early or too late are the one cause beside dimensions; its interval holds the time."""
    found = fit(robot, delay)
    named = {one.cause: one for one in found.findings if one.status == "confirmed"}
    assert set(named) - {"joint_placement", "rod_length", "guideway_nonparallel", "pinion_scale"} == {"joint_delay"}
    (number,) = named["joint_delay"].parameters
    assert number.unit == "s" and number.stderr is not None
    assert f"{'before' if delay > 0 else 'after'} the tool was measured" in named["joint_delay"].sentence
    assert abs(number.value - delay) < 4 * number.stderr < 1e-3
    assert found.errors(found.chosen).position_size.rms < 1.3 * np.sqrt(3) * NOISE_M


def test_a_robot_read_in_time_has_no_delay() -> None:
    """Without a delay none is found, although the speeds would show one."""
    found = fit(six_axes(), 0.0)
    assert "delay" not in found.chosen.spec.additions
    assert not [one for one in found.findings if one.cause in ("joint_delay", "backlash")]


@pytest.mark.parametrize("delay", [0.0, DELAY_S])
def test_backlash_is_told_from_a_delay(delay: float) -> None:
    """Half a joint's play by its direction is no delay of all joints by their speed, and each is named beside the other."""

    def spoil(poses: PoseSet) -> PoseSet:
        return replace(poses, q=poses.q + 5e-4 * poses.approach * (np.arange(6) == 1))

    poses, held = move(six_axes(), delay, seed=4)
    found = calibrate(six_axes(), spoil(poses), spoil(held))
    named = {one.cause for one in found.findings if one.status == "confirmed"} - {"joint_placement"}
    assert named == ({"backlash", "joint_delay"} if delay else {"backlash"})
    assert ("delay" in found.chosen.spec.additions) == bool(delay)
    assert found.fit.parameters["j2.backlash"].value == pytest.approx(1e-3, abs=1e-4)


def test_the_model_can_be_asked_for_and_needs_speeds() -> None:
    """`complete+delay` has the one number more; poses without speeds refuse it."""
    poses, held = move(six_axes(), DELAY_S)
    found = calibrate(six_axes(), poses, held, "complete+delay")
    assert found.fit.parameters["joints.delay"].value == pytest.approx(DELAY_S, abs=3e-4)
    still = PoseSet(poses.q, poses.position)
    with pytest.raises(ValueError, match="speed of the joints is unknown"):
        calibrate(six_axes(), still, None, "complete+delay")


def test_speeds_follow_the_joints_through_every_reading() -> None:
    """A joint that counts the other way moves the other way, too: speeds stay the derivative of the positions."""
    robot = l1()
    t = np.linspace(0, 2, 40)
    q, v = np.sin(t[:, None] + [0, 1, 2]), np.cos(t[:, None] + [0, 1, 2])
    poses = PoseSet(q, np.zeros((40, 3)), approach=np.sign(v), speed=v)
    later = PoseSet(q + 1e-6 * v, np.zeros((40, 3)), approach=np.sign(v), speed=v)
    tried = 0
    for reading in list_readings(poses, robot.actuated, robot.position_units, turns=False):
        if all(change.acts_on == "joints" or change.cause == "row_shift" for change in reading):
            now, then = apply_reading(reading, poses), apply_reading(reading, later)
            assert np.allclose((then.q - now.q) / 1e-6, now.speed, atol=1e-6 * max(1.0, np.abs(now.q).max()))
            tried += 1
    assert tried > 5


def test_a_recording_is_corrected_to_the_noise(tmp_path: Path) -> None:
    """With a delay of 30 ms the joints' acceleration moves the tool by about the noise; the column t tells it."""
    robot, rng = six_axes(), np.random.default_rng(5)
    geometry = build_geometry(robot)
    theta = geometry.parameters.values + 1e-3 * geometry.parameters.free * rng.standard_normal(len(geometry.parameters))
    t, rate, phase = np.arange(400)[:, None] / 20, 2 * np.pi * rng.uniform(0.05, 0.25, 6), rng.uniform(0, 6, 6)

    def joints(t: np.ndarray) -> np.ndarray:
        return robot.home + 0.7 * np.sin(rate * t + phase)

    tool = geometry.forward(theta, joints(t)).poses
    table = pd.DataFrame(joints(t - 0.03), columns=[f"q_{joint}" for joint in robot.actuated]).assign(t=t[:, 0])
    table[["x_tool", "y_tool", "z_tool"]] = tool.position + NOISE_M * rng.standard_normal((400, 3))
    for name, rows in (("train", slice(0, 300)), ("held", slice(300, 400))):
        table.iloc[rows].to_csv(tmp_path / f"{name}.csv", index=False)
    poses, held = (read_poses(tmp_path / f"{name}.csv", robot.actuated) for name in ("train", "held"))
    found = calibrate(robot, poses, held)
    assert {one.cause for one in found.findings if one.status == "confirmed"} == {"joint_placement", "joint_delay"}
    assert found.fit.parameters["joints.delay"].value == pytest.approx(0.03, abs=1e-4)
    assert found.fit.noise[0] == pytest.approx(NOISE_M, rel=0.06)
    assert found.errors(found.chosen).position_size.rms < 1.15 * np.sqrt(3) * NOISE_M
    still = [replace(some, acceleration=0 * some.q) for some in (poses, held)]
    assert calibrate(robot, *still, "complete+delay").fit.noise[0] > 1.15 * found.fit.noise[0]


def test_a_recording_tells_speeds_by_its_time_and_single_poses_do_not(tmp_path: Path) -> None:
    """With a column t, close samples are a motion whatever the order of the rows; poses one after the other are none."""
    t = np.linspace(0, 4, 200)
    q, v = 0.3 * np.sin(t[:, None] + [0.0, 1.0, 2.0]), 0.3 * np.cos(t[:, None] + [0.0, 1.0, 2.0])
    mixed = np.random.default_rng(0).permutation(200)
    for positions, order, speed in ((q, np.arange(200), v), (q, mixed, v), (q[mixed], np.arange(200), 0 * v)):
        table = pd.DataFrame(positions, columns=[f"q_{joint}" for joint in l1().actuated])
        table.assign(t=t, x_tool=0.0, y_tool=0.0, z_tool=1.0).iloc[order].to_csv(tmp_path / "poses.csv", index=False)
        assert np.allclose(read_poses(tmp_path / "poses.csv", l1().actuated).speed, speed[order], atol=5e-3)


def test_a_pause_in_a_recording_is_no_motion(tmp_path: Path) -> None:
    """Speeds next to a pause of a minute are those of their own part; four rows by themselves tell none."""
    t = np.concatenate([np.linspace(0, 2, 100), 62 + np.linspace(0, 2, 100), 130 + np.linspace(0, 0.06, 4)])
    q, v = 0.3 * np.sin(t[:, None] + [0.0, 1.0, 2.0]), 0.3 * np.cos(t[:, None] + [0.0, 1.0, 2.0])
    table = pd.DataFrame(q, columns=[f"q_{joint}" for joint in l1().actuated])
    table.assign(t=t, x_tool=0.0, y_tool=0.0, z_tool=1.0).to_csv(tmp_path / "poses.csv", index=False)
    read = read_poses(tmp_path / "poses.csv", l1().actuated)
    assert np.allclose(read.speed[:200], v[:200], atol=1e-4) and not read.speed[200:].any()
    assert np.allclose(read.acceleration[:200], -q[:200], atol=1e-2)


def test_speeds_are_read_from_the_file_and_sides_are_none(tmp_path: Path) -> None:
    """Columns v_J are speeds; 1 and -1 alone tell from which side a joint came."""
    poses, _ = move(l1(), 0.0, n=40)
    table = pd.DataFrame(poses.q, columns=[f"q_{joint}" for joint in l1().actuated])
    table[["x_tool", "y_tool", "z_tool"]] = poses.position
    for values, expected in ((poses.speed, poses.speed), (np.sign(poses.speed), 0 * poses.speed)):
        table[[f"v_{joint}" for joint in l1().actuated]] = values
        table.to_csv(tmp_path / "poses.csv", index=False)
        read = read_poses(tmp_path / "poses.csv", l1().actuated)
        assert np.allclose(read.speed, expected) and np.allclose(read.approach, np.sign(poses.speed))
