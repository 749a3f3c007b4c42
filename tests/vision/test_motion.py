"""A moving plate: the offset between the clocks of images and joints, its standard error, speeds, and what cannot be told."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from scipy.interpolate import CubicSpline

from tau_dyn.calibrate import read_poses
from tau_dyn.cli import main
from tau_dyn.vision import Cameras, parse_pattern, read_positions, read_times, write_cameras
from tau_dyn.vision.motion import JointLog, compute_velocity, estimate_clock_offset

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from camera_parts.photographs import Photography, draw_facing_rotation, render

STEP = 1 / 200  # [s] of the log


def wander(rng, seconds=20.0, joints=3):
    """Return times and joint positions that go to and fro without repeating."""
    t = np.arange(0, seconds, STEP)
    rate, phase = rng.uniform(0.3, 3, (2, 6, joints)) * [[[1.0]], [[2.0]]]
    return t, 0.06 * np.sin(rate[:, None] * t[None, :, None] + phase[:, None]).sum(axis=0)


def place(q):
    """Return where an arm with three turning joints has its plate (n, 3)."""
    angle = np.cumsum(2 * q + [0.3, 0.8, 0.5], axis=1)
    return np.column_stack(
        [np.cos(angle) @ [0.5, 0.4, 0.2], np.sin(angle) @ [0.5, 0.4, 0.2], 0.3 * np.sin(2 * q[:, 2])]
    )


def record(seed, n=80, noise=3e-4):
    rng = np.random.default_rng(seed)
    t, q = wander(rng)
    taken = np.sort(rng.uniform(0.5, 19.5, n))
    curve = CubicSpline(t, q)
    seen = place(curve(taken)) + noise * rng.standard_normal((n, 3)) * [1, 1, 3]
    offset = rng.uniform(-50, 50)
    return taken, seen, JointLog(t + offset, q, "log.csv"), offset, curve


def test_the_offset_between_clocks_is_found_within_its_error():
    """Of 20 arms by clocks up to 50 s apart, 85 to 100 % of 95 % intervals hold the offset, which is told to 0.3 ms."""
    z = []
    for seed in range(20):
        taken, seen, log, offset, _ = record(seed, 60)
        found = estimate_clock_offset(taken, seen, np.ones(len(taken)), log)
        assert found.stderr < 3e-4
        z.append((found.value - offset) / found.stderr)
    assert 0.85 <= np.mean(np.abs(z) < 1.96)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_the_speed_of_the_plate_is_that_of_its_path():
    """The derivative of the fitted path is the plate's velocity; it beats differences of images, which are too far apart."""
    taken, seen, log, offset, curve = record(1)
    found = estimate_clock_offset(taken, seen, np.ones(len(taken)), log)
    true = (place(curve(taken + 1e-4)) - place(curve(taken - 1e-4))) / 2e-4
    error = np.linalg.norm(found.velocity - true, axis=1)
    assert np.median(error) < 0.02 * np.median(np.linalg.norm(true, axis=1))
    assert np.median(np.linalg.norm(compute_velocity(taken, seen) - true, axis=1)) > 2 * np.median(error)


def test_a_motion_that_repeats_does_not_tell_the_offset():
    """With a period of 2 s an offset fits as well as the one 2 s later: both are named, none is taken."""
    rng = np.random.default_rng(0)
    t = np.arange(0, 30, STEP)
    q = 0.2 * np.column_stack([np.sin(np.pi * t), np.cos(np.pi * t), np.sin(2 * np.pi * t)])
    taken = np.sort(rng.uniform(8, 22, 60))
    seen = place(CubicSpline(t, q)(taken)) + 3e-4 * rng.standard_normal((60, 3))
    with raises_code("not_identifiable", "fit equally well"):
        estimate_clock_offset(taken, seen, np.ones(60), JointLog(t, q, "log.csv"))


def test_another_motion_is_refused():
    """The log of another motion explains the plate at no offset, however many are tried."""
    for k in range(4):
        taken, seen, _, _, _ = record(k)
        _, _, other, _, _ = record(k + 50)
        with raises_code("poor_excitation", "does not follow"):
            estimate_clock_offset(taken, seen, np.ones(len(taken)), other)


def test_a_still_robot_a_short_log_and_few_images_are_refused():
    """Without motion, without overlap and with eleven images the offset is unknown."""
    taken, seen, log, _, _ = record(1)
    ones = np.ones(len(taken))
    with raises_code("poor_excitation", "no joint"):
        estimate_clock_offset(taken, seen, ones, JointLog(log.t, 0 * log.q, "log.csv"))
    with raises_code("too_little_data", "outside the log"):
        estimate_clock_offset(taken, seen, ones, JointLog(log.t[:400], log.q[:400], "log.csv"))
    with raises_code("too_little_data", "11 images"):
        estimate_clock_offset(taken[:11], seen[:11], ones[:11], log)


def test_a_gap_of_the_log_tells_no_positions():
    """Between samples 0.5 s apart nothing says where the joints were."""
    log = JointLog(np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 2, 0.01)]), np.zeros((150, 1)), "log.csv")
    assert log.is_covered(np.array([-0.1, 0.5, 1.2, 1.7, 2.5])).tolist() == [False, True, False, True, False]


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        ("image,t\na.png,1\nb.png,0.5\n", "time_stamps", "must increase"),
        ("image,t\na.png,1\nb.png,1\n", "time_stamps", "line 3"),
        ("image,time\na.png,1\n", "missing_column", "t"),
        ("image,t\na.png,soon\n", "bad_sample", "soon"),
        ("image,t\na.png,1\na.png,2\n", "duplicate_name", "a.png"),
    ],
)
def test_wrong_times_are_one_sentence(tmp_path, text, code, says):
    """Times that do not increase, are no numbers or name an image twice: file, line and the fault."""
    (tmp_path / "times.csv").write_text(text)
    with raises_code(code, says):
        read_times(tmp_path / "times.csv")


def test_a_log_that_runs_backwards_is_refused(tmp_path):
    """A joint log with a column t and no column image is a log, and its clock must run."""
    (tmp_path / "log.csv").write_text("t,q_a\n0,1\n1,2\n0.5,3\n2,4\n")
    with raises_code("time_stamps", "0.5"):
        read_positions(tmp_path / "log.csv")


NUMBERS = np.array([620, 620, 319.5, 239.5, -0.1, 0.0, 0, 0, 0.0])


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Twenty images of a plate that three joints move along the camera's axes, exposed for 10 ms; times and a log of joints."""
    cv2 = pytest.importorskip("cv2")
    folder, rng = tmp_path_factory.mktemp("moving"), np.random.default_rng(3)
    t, q = wander(rng, 8.0)
    curve, taken = CubicSpline(t, 0.7 * q), np.sort(rng.uniform(0.3, 7.7, 20))
    rotation, middle = draw_facing_rotation(0.4, 1.0, 0.2), np.array([0, 0, 0.9])
    (folder / "images").mkdir()
    for k, when in enumerate(taken):
        motion = np.concatenate([0.01 * curve(when, 1), np.zeros(3)])
        image = render(
            parse_pattern("five-squares", 0.06),
            rotation,
            middle + curve(when),
            NUMBERS,
            (640, 480),
            rng,
            photography=Photography(),
            motion=motion,
        )
        cv2.imwrite(str(folder / "images" / f"im{k:02d}.png"), image)
    rows = [f"im{k:02d}.png,{when + 1000:.6f}" for k, when in enumerate(taken)]
    (folder / "times.csv").write_text("\n".join(["image,t", *rows, ""]))
    rows = [f"{a:.4f},{x:.6f},{y:.6f},{z:.6f}" for a, (x, y, z) in zip(t, curve(t), strict=True)]
    (folder / "log.csv").write_text("\n".join(["t,q_x,q_y,q_z", *rows, ""]))
    size, covariance = np.array([[640, 480]]), np.diag([0.01, 0.01, 0, 0, 0, 0, 0, 0, 0])
    write_cameras(
        folder / "cameras.yaml", Cameras(NUMBERS[None], np.eye(3)[None], np.zeros((1, 3)), size, "brown", covariance)
    )
    return folder, middle, curve, taken


def see(folder, *more):
    names = [str(folder / name) for name in ("images", "cameras.yaml", "log.csv")]
    pattern = ["--pattern", "five-squares", "--square", "0.06", "--quiet"]
    return main(["see", names[0], *pattern, "--cameras", names[1], "--positions", names[2], *map(str, more)])


def test_images_of_a_moving_robot_become_poses(campaign, tmp_path):
    """Joints come from the log at each image, poses are those of the middle of the exposure, calibrate reads both."""
    folder, middle, curve, taken = campaign
    out, result = tmp_path / "poses.csv", tmp_path / "r.json"
    assert see(folder, "--times", folder / "times.csv", "--out", out, "--json", result) == 0
    held = json.loads(result.read_text())
    clock = held["clock_offset"]
    assert abs(clock["value"] + 1000) < 4 * clock["stderr"] < 0.01
    assert "quarter_turn" in held["warning_codes"]
    names = [row["image"] for row in held["poses"]]
    k = np.array([int(name[2:4]) for name in names])
    assert len(k) >= 18
    poses = read_poses(out, ("x", "y", "z"))
    assert np.abs(poses.q - curve(taken[k])).max() < 4 * clock["stderr"] * np.abs(curve(taken, 1)).max() + 1e-5
    error = poses.position - middle - curve(taken[k])
    assert np.abs(error[:, :2]).max() < 1e-3
    stated = np.array([row["stderr"] for row in held["poses"]])[:, :3]
    assert np.mean(np.abs(error) < 1.96 * stated) > 0.8
    speed = np.array([row["speed"] for row in held["poses"]])
    assert np.abs(speed - np.linalg.norm(curve(taken[k], 1), axis=1)).max() < 0.02
    assert np.allclose([row["time"] for row in held["poses"]], taken[k], atol=5e-3)


def test_bad_times_at_the_command_line(campaign, tmp_path, capsys):
    """Images that do not exist, a log without times of images, and an unknown pattern: status 2, one sentence, no file."""
    folder = campaign[0]
    out = tmp_path / "poses.csv"
    (tmp_path / "t.csv").write_text("image,t\nnowhere.png,1\n")
    assert see(folder, "--times", tmp_path / "t.csv", "--out", out) == 2
    assert "nowhere.png" in capsys.readouterr().err
    assert see(folder, "--out", out) == 2
    assert "--times" in capsys.readouterr().err
    assert see(folder, "--times", tmp_path / "none.csv", "--out", out) == 2
    assert see(folder, "--pattern", "six-squares") == 2
    assert "five-squares" in capsys.readouterr().err
    assert not out.exists()
