"""A camera tracks the tool of a moving Gantry-Tau: its place is found from the motion, and the sway between drives and tool."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.cli import main
from tau_dyn.control.observers import CameraTrack, ToolObservation, observe_by_camera
from tau_dyn.mechanism import Poses, forward_kinematics, inverse_kinematics
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot

ROBOT = load_robot("gantry_tau")
DT, N, IMAGE_HZ, NOISE = 0.004, 1000, 60.0, 2e-5
CAMERA = Rotation.from_euler("xyz", [1.4, 0.3, -2.0])
AXES = ("x_tool", "y_tool", "z_tool")


def run(seed: int, sway_hz: float = 6.0, straight: bool = False) -> tuple[np.ndarray, Poses, np.ndarray, CameraTrack]:
    """Return times, poses from the drives, true positions (N, 3), and images by a camera that stands somewhere."""
    t, rng = 3.0 + np.arange(N) * DT, np.random.default_rng(seed)
    home = forward_kinematics(ROBOT, ROBOT.home).poses.position[0]
    away = np.sin(1.5 * (t - 3))[:, None] * [0.1, 0.0, 0.0]
    if not straight:
        away = away + np.sin(2.3 * (t - 3))[:, None] * [0.0, 0.06, 0.02]
    poses = forward_kinematics(ROBOT, inverse_kinematics(ROBOT, home + away).q).poses
    sway = 2e-4 * np.sin(2 * np.pi * sway_hz * t)[:, None] * [1.0, -0.5, 0.2]
    true = poses.position + sway
    moments = np.sort(3.0 + rng.uniform(-0.2, 0.2, 240) / IMAGE_HZ + np.arange(240) / IMAGE_HZ)
    at = np.column_stack([np.interp(moments, t, x) for x in true.T])
    seen = CAMERA.inv().apply(at - [4.0, -1.0, 0.7]) + NOISE * rng.standard_normal((240, 3))
    return t, poses, true, CameraTrack.of(moments, seen, np.full((240, 3), NOISE), "poses.csv")


def cover(found: ToolObservation, true: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of true positions within their intervals, and RMS errors (3,)."""
    off = found.position - true
    return float(np.mean(np.abs(off) < 1.96 * found.stderr)), np.sqrt(np.mean(off**2, axis=0))


def test_the_sway_is_tracked_within_its_intervals() -> None:
    """Drives alone miss a sway of 200 um; the camera finds it to its noise, and 90 to 99 % of the tool is in the intervals."""
    shares = []
    for seed in range(4):
        t, poses, true, track = run(seed)
        found = observe_by_camera(AXES, t, poses, track)
        share, rms = cover(found, true)
        shares.append(share)
        assert rms.max() < 1.3 * NOISE < np.std(true[:, 0] - poses.position[:, 0]) and not found.warnings
    assert 0.9 < np.mean(shares) < 0.99


def test_a_sway_faster_than_the_images_is_named_and_widens_the_intervals() -> None:
    """At 25 Hz and 60 images a second neighbours no longer predict an image: a code, and intervals that hold the error."""
    t, poses, true, track = run(0, sway_hz=25.0)
    found = observe_by_camera(AXES, t, poses, track)
    assert {get_code(w) for w in found.warnings} == {"track_undersampled"}
    assert cover(found, true)[0] > 0.9


def test_the_depth_of_a_camera_is_the_direction_it_is_known_worst() -> None:
    """A camera that looks along the base's y, after a quarter turn about x, knows y ten times worse than x and z."""
    t, poses, true, _ = run(2, sway_hz=0.0)
    rng, moments = np.random.default_rng(5), 3.0 + np.arange(240) / IMAGE_HZ
    at = np.column_stack([np.interp(moments, t, x) for x in true.T])
    stderr = np.tile([NOISE, 0.1 * NOISE, NOISE], (240, 1))
    stderr[:, 2] *= 10
    looking = Rotation.from_euler("zx", [0.4, -np.pi / 2])
    seen = looking.inv().apply(at) + stderr * rng.standard_normal((240, 3))
    found = observe_by_camera(AXES, t, poses, CameraTrack.of(moments, seen, stderr, "poses.csv"))
    expected = np.sqrt((looking.as_matrix() ** 2) @ stderr[0] ** 2)
    assert np.all(np.abs(found.stderr / expected - 1) < 0.15)


def test_a_straight_line_does_not_show_the_camera() -> None:
    """Turning the camera about the line of motion changes nothing that it sees: status 3; so do gaps and few images."""
    t, poses, _, track = run(0, sway_hz=0.0, straight=True)
    with raises_code("poor_excitation"):
        observe_by_camera(AXES, t, poses, track)
    t, poses, _, track = run(0)
    gap = (track.t < 4.0) | (track.t > 4.5)
    with raises_code("too_little_data", "4"):
        observe_by_camera(AXES, t, poses, CameraTrack.of(track.t[gap], track.position[gap], track.stderr[gap], "p.csv"))
    with raises_code("too_little_data"):
        observe_by_camera(AXES, t, poses, CameraTrack.of(track.t[:5], track.position[:5], track.stderr[:5], "p.csv"))
    with raises_code("time_stamps"):
        CameraTrack.of(np.zeros(3), np.zeros((3, 3)), np.ones((3, 3)), "p.csv")


def test_a_tracked_tool_is_what_learn_takes(tmp_path, capsys) -> None:
    """`observe --camera` writes positions that `learn --robot --observed` reads; wrong options end in one sentence."""
    t, poses, true, track = run(0)
    q = inverse_kinematics(ROBOT, poses).q
    reference, joints = tmp_path / "ref.csv", ROBOT.actuated
    pd.DataFrame({"t": t - t[0]} | {f"q_ref_{j}": q[:, k] for k, j in enumerate(joints)}).to_csv(reference, index=False)
    log = {"t": t} | {f"q_ref_{j}": q[:, k] for k, j in enumerate(joints)}
    pd.DataFrame(log | {f"q_{j}": q[:, k] for k, j in enumerate(joints)}).to_csv(tmp_path / "t1.csv", index=False)
    rows = np.column_stack([track.t, track.position, track.stderr])
    table = pd.DataFrame(rows, columns=["t", *AXES, *(f"{a}_stderr" for a in AXES)])
    table.to_csv(tmp_path / "poses.csv", index=False)
    observe = ["observe", str(tmp_path / "t1.csv"), "gantry_tau", "--camera", str(tmp_path / "poses.csv")]
    out, result = tmp_path / "o1.csv", tmp_path / "r.json"
    assert main([*observe, "--out", str(out), "--json", str(result), "--report", str(tmp_path / "o.html")]) == 0
    assert "240 images" in json.loads(result.read_text())["filter"] or "camera" in capsys.readouterr().out
    assert np.abs(pd.read_csv(out)["x_tool"].to_numpy() - true[:, 0]).max() < 5 * NOISE
    learn = [
        "learn",
        str(reference),
        "--robot",
        "gantry_tau",
        "--history",
        str(tmp_path / "t1.csv"),
        "--observed",
        str(out),
    ]
    assert main([*learn, "--out", str(tmp_path / "c.csv"), "--quiet"]) == 0
    assert main([*observe, "--acceleration", "ax"]) == 2 and main([*observe, "--cutoff", "3"]) == 2
    assert main(["observe", str(tmp_path / "t1.csv"), "gantry_tau", "--cutoff", "3"]) == 2


@pytest.mark.parametrize("offset", [0.0, 0.15])
def test_a_target_off_the_centre_of_a_tool_that_turns_is_found(offset) -> None:
    """A target 150 mm off the centre of a turning tool moves in a circle, which is no deflection."""
    t, poses, true, track = run(1)
    angle = 0.3 * np.sin(1.1 * t)
    turned = Poses(poses.position, Rotation.from_rotvec(angle[:, None] * [0, 0, 1]).as_matrix())
    arm = np.column_stack([np.interp(track.t, t, offset * x) for x in (np.cos(angle), np.sin(angle), 0 * t)])
    moved = CameraTrack.of(track.t, track.position + CAMERA.inv().apply(arm), track.stderr, "p.csv")
    assert cover(observe_by_camera(AXES, t, turned, moved), true)[1].max() < 1.5 * NOISE
