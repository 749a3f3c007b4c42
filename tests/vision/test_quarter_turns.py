"""The quarter turn of a plate that has four: alike for both cameras, continuous from pose to pose, never guessed."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.vision import parse_pattern, solve
from tau_dyn.vision.bundle import Plates, Views
from tau_dyn.vision.cameras import project
from tau_dyn.vision.quarter_turns import TURNS, choose_view_turns, follow_turns, turn_views
from tau_dyn.vision.solution import estimate_view_poses

FIVE = parse_pattern("five-squares", 0.05)


def test_two_cameras_agree_on_the_turn(rig):
    """Each camera names corners by its own image, here at random; stereo finds poses and the second camera all the same."""
    rng = np.random.default_rng(0)
    truth, cameras = rig.plates(rng, 14, 2), rig.cameras(2)
    corners = [
        project((FIVE.points @ r.T + t) @ cameras.rotation[c].T + cameras.position[c], cameras.intrinsics[c])
        for r, t in zip(*truth, strict=True)
        for c in range(2)
    ]
    noisy = np.array(corners) + 0.02 * rng.standard_normal((28, 16, 2))
    views = Views(noisy, np.tile([0, 1], 14), np.repeat(np.arange(14), 2))
    mixed = turn_views(views, rng.integers(0, 4, 28), FIVE)
    exact = replace(cameras, covariance=np.zeros((len(cameras.names),) * 2))
    for known in (None, exact):
        found = solve(mixed, FIVE, rig.size, known=known)
        assert not found.left_out
        relative = found.bundle.cameras.rotation[1] @ cameras.rotation[1].T
        assert np.linalg.norm(Rotation.from_matrix(relative).as_rotvec()) < 0.01
        assert np.linalg.norm(found.bundle.plates.position - truth.position, axis=1).max() < 5e-3
        assert found.bundle.noise.max() < 0.03


def test_a_plate_that_only_translates_tells_the_second_camera_by_its_places(rig):
    """With one orientation in all images any turn gives one rotation of the cameras; only the right one gives one place."""
    rng = np.random.default_rng(1)
    one = rig.plates(rng, 1, 2).rotation[0]
    truth = Plates(np.tile(one, (12, 1, 1)), rng.uniform([-0.12, -0.1, 0.8], [0.12, 0.1, 1.1], (12, 3)))
    cameras = rig.cameras(2)
    corners = [
        project((FIVE.points @ r.T + t) @ cameras.rotation[c].T + cameras.position[c], cameras.intrinsics[c])
        for r, t in zip(*truth, strict=True)
        for c in range(2)
    ]
    views = Views(np.array(corners), np.tile([0, 1], 12), np.repeat(np.arange(12), 2))
    mixed = turn_views(views, np.tile([0, 3], 12), FIVE)
    each, _ = estimate_view_poses(mixed, FIVE, cameras)
    assert np.all(choose_view_turns(mixed, each, cameras, known=False)[1::2] == 1)


def spin(angles):
    """Return orientations of a plate that turns about its normal, tilted to the camera."""
    tilt = Rotation.from_rotvec([0.4, 0.1, 0])
    return np.array([(tilt * Rotation.from_rotvec([0, 0, a])).as_matrix() for a in angles])


def test_orientation_is_continuous_through_a_whole_turn():
    """A plate that turns by 20 degrees an image through a whole turn ends where it began, whatever turn each image shows."""
    angles = np.radians(20) * np.arange(19)
    shown = spin(angles) @ TURNS[np.random.default_rng(0).integers(0, 4, 19)]
    found, clear = follow_turns(shown, np.zeros((19, 0)))
    assert clear.all()
    relative = Rotation.from_matrix(found[0].T @ found).as_rotvec()[:, 2]
    assert np.allclose(np.exp(1j * relative), np.exp(1j * angles), atol=1e-9)


def test_robot_positions_say_who_is_the_neighbour():
    """In any order of the images the nearest robot positions give the turn, which the order of the images would get wrong."""
    rng = np.random.default_rng(2)
    angles = rng.permutation(np.radians(15) * np.arange(24))
    shown = spin(angles) @ TURNS[rng.integers(0, 4, 24)]
    found, clear = follow_turns(shown, angles[:, None])
    relative = Rotation.from_matrix(found[0].T @ found).as_rotvec()[:, 2]
    assert clear.all()
    assert np.allclose(np.exp(1j * relative), np.exp(1j * (angles - angles[0])), atol=1e-9)


def test_an_unclear_step_is_left_out():
    """After a step of 45 degrees both turns are alike: the shorter part is left out, the longer one stays continuous."""
    angles = np.concatenate([np.radians(5) * np.arange(8), np.radians(80 + 5 * np.arange(4))])
    _, clear = follow_turns(spin(angles), np.zeros((12, 0)))
    assert clear.tolist() == [True] * 8 + [False] * 4
    _, clear = follow_turns(spin(angles[:8] * 3), 2.0 * angles[:8, None] / np.radians(5))
    assert not clear.all()
