"""Cameras and trackers: what they see, how well they measure, what hides the target, and how their files are read."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from sampling import assert_scatter

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import MIDDLE, at, camera, candidates, l1, tracker

from tau_dyn.calibrate.poses import PathCheck, read_camera, read_tracker
from tau_dyn.calibrate.poses.camera import CameraPattern, build_camera_frame
from tau_dyn.calibrate.poses.devices import transform_to_device
from tau_dyn.calibrate.poses.reachable import Reachable, find_occlusions, find_visible
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import Surroundings
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine

SPREAD = at((1.7, -0.6, 0.7), (1.4, -0.2, 1.0), (2.1, -0.9, 0.4), (1.8, -0.3, 0.3))


def around(**shape) -> Surroundings:
    """Return surroundings with one obstacle."""
    return build_surroundings({"obstacles": [{"name": "post", **shape}]}, "test")


def test_a_camera_looks_along_z_with_the_picture_upright() -> None:
    """What it looks at lies in the picture's middle; what is higher has a smaller v, what is to the right a larger u."""
    eye = camera()
    middle, higher, right = (eye.frames.measured(at(p), np.zeros(1, int)).position for p in
                             ((1.65, -0.6, 0.7), (1.65, -0.6, 0.9), (1.65, -0.4, 0.7)))  # fmt: skip
    pixels = [eye.project(p[None])[0, 0] for p in (middle, higher, right)]
    assert pixels[0] == pytest.approx([639.5, 479.5], abs=1e-6)
    assert pixels[1][1] < pixels[0][1] - 10 and pixels[2][0] > pixels[0][0] + 10


def test_slope_of_the_picture_is_its_derivative() -> None:
    """Moving and turning the pattern a little moves its corners as the slope says."""
    eye, step = camera(), 1e-7
    start = transform_to_device(eye.frames, SPREAD)
    slope = eye.compute_slope(start)
    for k in range(6):
        twist = np.zeros((len(start.position), 6))
        twist[:, k] = step
        moved = _moved(start, twist)
        change = (_pixels(eye, moved) - _pixels(eye, start)) / step
        assert np.allclose(change.reshape(len(slope), -1), slope[:, :, k], atol=2e-3 * np.abs(slope).max())


def _pixels(eye, at_camera):  # noqa: ANN001, ANN202
    corners = at_camera.position[:, None] + np.einsum("nij,kj->nki", at_camera.rotation, eye.pattern.corners)
    return eye.project(corners)


def _moved(poses, twist):  # noqa: ANN001, ANN202
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(twist[:, 3:]).as_matrix()
    return type(poses)(poses.position + twist[:, :3], turn @ poses.rotation)


@pytest.mark.parametrize("steady", [False, True])
def test_measured_poses_scatter_as_the_covariance_says(steady: bool) -> None:
    """Poses located in noisy pictures scatter with the predicted standard deviations, depth most of all."""
    eye = camera(steady=steady, pixel_noise=0.05)
    many = SPREAD.take(np.tile(np.arange(4), 8))
    truth = transform_to_device(eye.frames, many)
    off = np.array([eye.measure(many, rng).position - truth.position for rng in np.random.default_rng(3).spawn(40)])
    predicted = np.sqrt(np.diagonal(eye.covariance(SPREAD), axis1=1, axis2=2))[:, :3]
    assert predicted[:, 2].min() > 3 * predicted[:, :2].max()
    scatter = off.reshape(-1, 4, 3).std(axis=0)
    assert np.allclose(scatter / predicted, 1, atol=0.2)


def test_one_orientation_for_all_pictures_takes_the_bias_out_of_depth() -> None:
    """A frontal pattern whose tilt is free looks foreshortened by noise, so it is found too near or far; a shared one is not."""
    turning, steady = camera(pixel_noise=0.3), camera(pixel_noise=0.3, steady=True)
    many = at(*[(1.7 + 0.05 * k, -0.6, 0.7) for k in range(8)] * 5)
    bias = []
    for eye in (turning, steady):
        truth = transform_to_device(eye.frames, many).position
        off = np.array([eye.measure(many, rng).position - truth for rng in np.random.default_rng(1).spawn(20)])
        bias.append(abs(off[..., 2].mean()))
    assert bias[1] < 0.4 * bias[0]


@pytest.mark.parametrize(
    ("change", "place", "reason"),
    [
        ({}, (1.75, -0.6, 0.7), ""),
        ({"distance": (0.5, 2.0)}, (1.75, -0.6, 0.7), "farther"),
        ({"distance": (5.0, 9.0)}, (1.75, -0.6, 0.7), "nearer"),
        ({}, (1.75, 3.0, 0.7), "picture"),
        ({}, (9.0, -0.6, 0.7), "behind the camera"),
        (
            {"pose": build_camera_frame(np.array([-2.0, -0.6, 0.7]), MIDDLE, np.array([0.0, 0.0, 1.0]))},
            (1.75, -0.6, 0.7),
            "from behind",
        ),
        ({"incidence": 0.02}, (1.75, -0.9, 0.7), "degrees"),
        ({"pattern": CameraPattern(8, 6, 0.6)}, (1.75, -0.6, 0.7), "picture"),
    ],
)
def test_why_a_camera_does_not_see(change: dict, place: tuple[float, float, float], reason: str) -> None:
    """Distance, side, angle and the picture's edge each hide the pattern, and each is named."""
    found = camera(**change).reasons(at(place))[0]
    assert reason in found if reason else found == ""


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({}, ""),
        ({"distance": (0.5, 2.0)}, "farther"),
        ({"pose": tracker((-3.0, -0.6, 0.7)).pose}, "turned away"),
        ({"pose": tracker((3.0, 1.4, 0.7)).pose}, "30 degrees"),
        ({"elevation": (-0.01, 0.7)}, "below"),
    ],
)
def test_why_a_tracker_loses_its_beam(change: dict, reason: str) -> None:
    """The beam comes back within the reflector's cone, the range and the elevation only."""
    found = tracker(**change).reasons(at((1.75, -0.6, 0.5)))[0]
    assert reason in found if reason else found == ""


def test_a_tracker_measures_along_better_than_across_from_afar() -> None:
    """Angles cost more the farther the target is, the distance does not."""
    far = np.sqrt(np.linalg.eigvalsh(tracker().covariance(at((-4.0, -0.6, 0.7)))[0]))
    assert far == pytest.approx([10e-6, 50e-6, 50e-6], rel=1e-6)
    full = tracker(turn=5e-5)
    assert full.turned and full.covariance(SPREAD).shape == (4, 6, 6)
    rng = np.random.default_rng(0)
    off = np.array(
        [full.measure(SPREAD, rng).position - transform_to_device(full.frames, SPREAD).position for _ in range(200)]
    )
    assert_scatter(off, np.sqrt(np.diagonal(full.covariance(SPREAD), axis1=1, axis2=2)[:, :3]))


def test_an_obstacle_between_hides_the_target_one_behind_does_not() -> None:
    """A post on the line of sight hides the pattern behind it and is named; behind the pattern, or beside, it does not."""
    q = np.tile(l1().home, (1, 1))
    place = at((1.75, -0.6, 0.75))
    post = {"cylinder": {"centre": [3.5, -0.6, 0.7], "radius": 0.05, "height": 3}}
    behind = {"cylinder": {"centre": [0.9, -0.6, 0.7], "radius": 0.05, "height": 3}}
    beside = {"cylinder": {"centre": [3.5, 0.3, 0.7], "radius": 0.05, "height": 3}}
    assert find_occlusions(camera(), place, q, around(**post), None)[0] == "hidden by post"
    assert find_occlusions(camera(), place, q, around(**behind), None)[0] == ""
    assert find_occlusions(camera(), place, q, around(**beside), None)[0] == ""
    assert find_occlusions(tracker(), place, q, around(**post), None)[0] == "hidden by post"


def test_the_robot_hides_its_own_target() -> None:
    """Seen from behind the guideways the rods and carts stand between; from the front nothing does."""
    machine, q = build_machine(l1()), l1().home[None]
    front = find_occlusions(tracker(), machine.home, q, Surroundings(), machine)
    arm = machine.rods.base_points(q)[0, 0]
    direction = arm - machine.home.position[0]
    back = tracker(tuple(machine.home.position[0] + 1.2 * direction))
    assert front[0] == ""
    assert "robot's own" in find_occlusions(back, machine.home, q, Surroundings(), machine)[0]


def test_a_camera_inside_an_obstacle_is_refused_and_none_in_sight_says_why() -> None:
    """A camera in a box is a fault of the input; one that looks away cannot answer, and says what would help."""
    machine = build_machine(l1())
    check = PathCheck(machine, PoseRequirements(collisions=False))
    q = candidates()[::20]
    reach = Reachable(q, check.poses(q)[0], check, ())
    box = around(box={"centre": [5.5, -0.6, 0.7], "size": [0.3, 0.3, 0.3]})
    with raises_code("invalid_value"):
        find_visible(camera(), reach, box, None)
    away = camera(
        pose=build_camera_frame(np.array([5.5, -0.6, 0.7]), np.array([9.0, -0.6, 0.7]), np.array([0.0, 0.0, 1.0]))
    )
    with raises_code("not_visible") as fault:
        find_visible(away, reach, Surroundings(), None)
    assert "looks at the robot" in fault.value.experiment
    assert len(find_visible(camera(), reach, Surroundings(), None).index) == len(q)


CAMERA = """
camera: {position: [5.5, -0.6, 0.7], look_at: [1.75, -0.6, 0.7], image: [1280, 960], focal: 1400}
pattern: {position: [0.1, 0, 0], normal: [1, 0, 0]}
"""
TRACKER = """
tracker: {position: [6, -0.6, 1], noise: 10e-6}
reflector: {position: [0, 0, 0], normal: [1, 0, 0], orientation_noise: 5e-5}
limits: {incidence: 45, elevation: [-30, 30]}
"""


def test_files_give_what_they_say(tmp_path: Path) -> None:
    """A camera's file gives the same camera as the numbers; a tracker's with orientation noise measures orientation."""
    (tmp_path / "c.yaml").write_text(CAMERA)
    (tmp_path / "t.yaml").write_text(TRACKER)
    eye, beam = read_camera(tmp_path / "c.yaml"), read_tracker(tmp_path / "t.yaml")
    assert np.allclose(
        transform_to_device(eye.frames, SPREAD).position, transform_to_device(camera().frames, SPREAD).position
    )
    assert eye.centre == (639.5, 479.5) and beam.turned and beam.along == pytest.approx(1e-5)
    assert beam.elevation[1] == pytest.approx(np.pi / 6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("look_at: [1.75, -0.6, 0.7], ", "", "'look_at' is missing"),
        ("look_at: [1.75, -0.6, 0.7]", "look_at: [5.5, -0.6, 0.7]", "gives no direction"),
        ("focal: 1400", "focal: .nan", "focal must hold"),
        ("normal: [1, 0, 0]", "normal: [0, 0, 1]", "along up"),
        ("image: [1280, 960]", "image: [1280]", "2 finite numbers"),
        ("focal: 1400", "focal: 1400, zoom: 2", "'zoom' is not known"),
        ("pattern: {", "pattern: {columns: 2.5, ", "whole number"),
        ("pattern: {position: [0.1, 0, 0], normal: [1, 0, 0]}", "", "'pattern' is missing"),
    ],
)
def test_faulty_files_are_a_sentence(tmp_path: Path, old: str, new: str, message: str) -> None:
    """What is missing, unknown or no number in a device's file is named with its place."""
    path = tmp_path / "c.yaml"
    assert old in CAMERA
    path.write_text(CAMERA.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_camera(path)
