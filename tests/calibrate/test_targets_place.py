"""A SCARA whose second axis leans: along the axes nobody sees the target's place, and no dimension may go astray with it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import scara_text

from tau_dyn.calibrate import build_frame_rows, fit_geometry_to_poses, read_poses
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.simulated import TRACKER, format_csv, simulate_poses
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.robot import load_robot_from_urdf

NOISE = 2e-5  # m, each axis


def test_a_blind_target_stays_where_the_file_has_it_and_takes_no_dimension_along() -> None:
    """Shifted along leaning axes the target would make an elbow's offset of 4 mrad up: 0.8 m for 54 standard errors."""
    geometry = build_tree_geometry(load_robot_from_urdf(scara_text(), "scara"))
    truth = {"s2.offset": 0.004, "s2.rx": 0.002, "s2.origin_x": 0.4012, "z3.origin_x": 0.2991}
    theta = geometry.parameters.with_values(truth).values
    rng = np.random.default_rng(3)
    q = rng.uniform([0.2, -2.2, 0.05, -2.2], [1.4, -0.3, 0.25, 2.2], (60, 4))
    seat = Frame(TRACKER.tool[0].rotation, np.array([0.02, -0.01, 0.0]))  # beside the file's tool, but no higher
    frames = DeviceFrames(TRACKER.device, (seat,))
    found = fit_geometry_to_poses(geometry, simulate_poses(geometry, theta, q, rng, frames=frames, noise=(NOISE, 1e-4)))
    blind = {found.identifiability.names[k] for k in found.identifiability.dropped}
    assert "tool.z" in blind and abs(found.parameters["tool.z"].value) < 1e-12
    for name in set(truth) - blind:
        p = found.parameters[name]
        assert abs(p.value - truth[name]) < 4 * p.stderr < 1e-3, name
    assert "s2.offset" not in blind


def test_each_of_several_targets_has_a_place_of_its_own(tmp_path) -> None:
    """Three targets on one tool, one of them seen in a single pose: each is where it sits, and none spoils the robot."""
    geometry = build_tree_geometry(load_robot_from_urdf(scara_text(), "scara"))
    rng = np.random.default_rng(4)
    seats = tuple(
        Frame(Rotation.from_rotvec([0, 0, 0.8 * k]).as_matrix(), np.array([0.05 * k, -0.03 * k, 0.0])) for k in range(3)
    )
    q = rng.uniform([0.2, -2.2, 0.05, -2.2], [1.4, -0.3, 0.25, 2.2], (61, 4))
    target = np.append(np.arange(60) % 2, 2)
    theta = geometry.parameters.with_values({"s2.origin_x": 0.4012, "s2.rx": 0.002}).values
    frames = DeviceFrames(TRACKER.device, seats)
    poses = simulate_poses(geometry, theta, q, rng, frames=frames, noise=(NOISE, 1e-4), target=target)
    path = tmp_path / "poses.csv"
    path.write_text(format_csv(poses, geometry.actuated))
    poses = read_poses(path, geometry.actuated)
    assert poses.targets == ("1", "2", "3")
    found = fit_geometry_to_poses(geometry, poses)
    assert len(found.frames.tool) == 3
    between = found.frames.tool[1].translation - found.frames.tool[0].translation
    assert np.allclose(between, [0.05, -0.03, 0.0], atol=1e-4)  # what both share is not told from the wrist's placement
    some = poses.take(np.arange(60))
    alone = fit_geometry_to_poses(geometry, some)
    assert (
        np.abs(found.seen(some).position - alone.seen(some).position).max() < 2e-6
    )  # a target's only pose tells no more
    assert np.sqrt(np.mean(found.errors(poses).distance[:60] ** 2)) < 1.2 * np.sqrt(3) * NOISE
    rows = build_frame_rows(found)
    assert [row["target"] for row in rows] == [None, "1", "2", "3"]
