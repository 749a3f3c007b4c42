"""Where a camera should stand: by the predicted error, within its ranges, out of the robot's way."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import UP, camera, l1, six_axes

from tau_dyn.calibrate.poses import Camera, Safety, placement, plan_campaign, read_camera
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.calibrate.poses.camera import CameraPattern, build_camera_frame, build_target_frame
from tau_dyn.calibrate.poses.placement import CLEARANCE, CameraSite, build_camera_site, place_camera, predict_rms
from tau_dyn.calibrate.poses.reachable import find_reachable
from tau_dyn.kinematics import Surroundings
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine
from tau_dyn.robot import Robot, load_robot_from_urdf

FRONT = np.array([[2.5, 6.5], [-2.0, 1.0], [0.0, 2.0]])
FREE = PoseRequirements(collisions=False)


@pytest.fixture(autouse=True)
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer places and steps than a user waits for."""
    for name, value in (("_DRAWN_POWER", 5), ("_REFINED", 2), ("_STEPS", 20), ("_LOOKED_AT", 120)):
        monkeypatch.setattr(placement, name, value)


def site(robot: Robot, eye: Camera, demands: PoseRequirements = FREE, wanted: int = 200, **known) -> CameraSite:
    """Return what decides about a camera's place, with few candidates."""
    reach = find_reachable(build_machine(robot), demands, Safety(), wanted=wanted)
    return build_camera_site(eye, build_geometry(robot), reach, demands, workspace=reach.q, **known)


@lru_cache(maxsize=1)
def front() -> CameraSite:
    """Return L1 with a camera that may stand anywhere in front of it."""
    return site(l1(), camera(steady=True, places=FRONT))


def planar() -> Robot:
    """Return an arm of two turning joints in the plane z = 0."""
    rows = ['<robot name="planar"><link name="l0_link"/>']
    for k, x in ((1, 0.0), (2, 0.4)):
        rows.append(
            f'<link name="l{k}_link"/><joint name="j{k}" type="revolute"><origin xyz="{x} 0 0"/>'
            f'<parent link="l{k - 1}_link"/><child link="l{k}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.5" upper="2.5" velocity="2" effort="50"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.3 0 0"/>')
    return load_robot_from_urdf(
        "".join(rows) + '<parent link="l2_link"/><child link="tool"/></joint></robot>', "planar"
    )


def above(place: np.ndarray, places: np.ndarray | None = None) -> Camera:
    """Return a camera that looks at the planar arm's middle; its pattern lies in the plane, face up."""
    return Camera(
        pose=build_camera_frame(place, np.zeros(3), np.array([1.0, 0.0, 0.0])),
        on_tool=build_target_frame(np.zeros(3), UP, np.array([1.0, 0.0, 0.0])),
        pattern=CameraPattern(9, 6, 0.02),
        focal=(1000.0, 1000.0),
        image=(1600, 1600),
        centre=(799.5, 799.5),
        up=(1.0, 0.0, 0.0),
        places=places,
    )


IN_PLANE = {"device": False, "tool": False, "fix": ("*.origin_z", "*.rx", "*.ry")}
"""Places and angles in the plane alone are unknown."""


def test_a_plane_is_looked_at_head_on() -> None:
    """A camera measures across its sight better than along it, so a robot in a plane is measured best from its normal."""
    errors = []
    for angle in np.deg2rad([0, 15, 30, 40]):
        eye = above(2.0 * np.array([0.0, np.sin(angle), np.cos(angle)]))
        here = site(planar(), eye, **IN_PLANE)
        seen, _ = here.find_seen(eye)
        assert len(seen) == here.reach.n  # the same poses at every angle
        errors.append(predict_rms(here.build_design(eye, seen), np.arange(len(seen))))
    assert (np.diff(errors) > 0).all() and errors[-1] > 1.1 * errors[0]


def test_the_search_finds_the_normal_of_a_plane() -> None:
    """In a flat range parallel to the plane, the place that is found lies within 8 degrees of the normal of the middle."""
    places = np.array([[-1.5, 1.5], [-1.5, 1.5], [1.8, 1.8]])
    eye = above(np.array([1.3, 0.0, 1.8]), places)
    here = site(planar(), eye, **IN_PLANE)
    found = place_camera(here, 20)
    sight = found.camera.pose.translation - here.reach.tool.position.mean(axis=0)
    assert np.rad2deg(np.arctan2(np.linalg.norm(sight[:2]), sight[2])) < 8
    assert sight[2] == 1.8 and found.chosen.rms < 0.5 * found.given.rms


def test_the_design_at_another_place_is_the_design_of_that_camera() -> None:
    """What all poses tell a camera elsewhere, turned from the given camera's axes, predicts what its own design predicts."""
    given, other = camera(steady=True), camera((4.5, 0.8, 1.4), steady=True)
    moved, own = site(l1(), given), site(l1(), other)
    seen, _ = own.find_seen(other)
    index = np.arange(0, len(seen), 3)
    there = moved.build_design(other, seen)
    here = own.build_design(other, seen)
    assert predict_rms(there, index) == pytest.approx(predict_rms(here, index), rel=0.01)
    assert abs(predict_rms(moved.build_design(given, seen), index) / predict_rms(here, index) - 1) > 0.1


def test_the_chosen_place_is_better_than_the_given_one_and_the_heuristics() -> None:
    """The predicted error falls below that of the camera as given and of both rules of thumb, each of which does its own best."""
    error, view, plate = (place_camera(front(), 20, goal=goal) for goal in ("error", "view", "plate"))
    assert error.chosen.rms < 0.7 * error.given.rms
    assert error.chosen.rms < min(view.chosen.rms, plate.chosen.rms)
    assert view.chosen.share == max(p.chosen.share for p in (error, view, plate)) and view.chosen.share > 0.99
    assert plate.chosen.share > 0.97 and plate.chosen.plate > view.chosen.plate
    for found in (error, view, plate):
        place = found.camera.pose.translation
        assert (place >= FRONT[:, 0]).all() and (place <= FRONT[:, 1]).all() and found.camera.places is None


def test_a_place_that_is_good_already_is_kept_or_bettered() -> None:
    """From the place found with one seed, a short search with another never ends at a larger error."""
    first = place_camera(front(), 20)
    again = place_camera(replace(front(), camera=replace(first.camera, places=FRONT)), 20, seed=7)
    assert again.chosen.rms <= again.given.rms and again.given.rms == pytest.approx(first.chosen.rms, rel=0.02)


def test_the_direction_alone_leaves_the_place() -> None:
    """A camera that stands and looks past the robot is turned to it; its place stays to the last digit."""
    place = np.array([5.5, -0.6, 0.7])
    away = build_camera_frame(place, np.array([5.5, 3.0, 0.7]), UP)
    eye = camera(steady=True, pose=away, places=np.column_stack([place, place]))
    found = place_camera(site(l1(), eye), 20)
    assert (found.camera.pose.translation == place).all() and found.turned_only and found.stays
    assert found.given.seen == 0 and np.isnan(found.given.rms) and found.chosen.seen > 20
    assert found.camera.pose.rotation[0, 2] < -0.8


def test_a_place_without_sight_is_refused_with_the_reason() -> None:
    """Behind the plate no place sees the pattern, in an obstacle or in the robot none can stand: each cannot be answered."""
    behind = camera(steady=True, places=np.array([[-6.0, -4.0], [-2.0, 1.0], [0.0, 2.0]]))
    with raises_code("not_visible", "from behind"):
        place_camera(site(l1(), behind), 20)
    inside = camera(steady=True, places=np.array([[1.6, 1.9], [-0.7, -0.5], [0.6, 0.8]]))
    with raises_code("not_visible", "in the robot's way"):
        place_camera(replace(site(l1(), inside), machine=build_machine(l1())), 20, goal="view")
    wall = {"obstacles": [{"name": "wall", "box": {"centre": [4.5, -0.5, 1.0], "size": [5.0, 4.0, 3.0]}}]}
    around: Surroundings = build_surroundings(wall, "test")
    with raises_code("not_visible"):
        place_camera(replace(front(), around=around), 20)
    with raises_code("missing_input", "choose"):
        place_camera(site(l1(), camera(steady=True)), 20)


def test_the_robot_keeps_away_from_the_camera() -> None:
    """No solid of the robot comes nearer than the clearance to a place that is free, and one on a rod's way is not free."""
    machine = build_machine(l1())
    here = replace(front(), machine=machine)
    tool = here.reach.tool.position
    assert not here.is_free(tool[0]) and not here.is_free(tool[0] + [0, 0, 0.9 * CLEARANCE])
    start, end = machine.rods.base_points(here.reach.q)[:, 0], tool
    assert not here.is_free((0.5 * (start + end))[3])
    front_of_it = np.array([5.5, -0.6, 0.7])
    assert here.is_free(front_of_it)
    rack = {"obstacles": [{"name": "rack", "sphere": {"centre": front_of_it.tolist(), "radius": 0.2}}]}
    assert not replace(here, around=build_surroundings(rack, "test")).is_free(front_of_it)


def test_an_arm_drawn_in_meshes_keeps_away_too() -> None:
    """Where a robot file has no solids, lines from joint to joint stand for the arm."""
    here = site(six_axes(), camera(), wanted=50)
    start, end = here.bones
    elbow = 0.5 * (start + end)[np.argmax(np.linalg.norm(end - start, axis=1))]
    arm = elbow[None] + 0.8 * CLEARANCE * np.eye(3)
    far = np.linalg.norm(here.reach.tool.position - elbow, axis=1) > 0.5
    seldom = here.take(np.flatnonzero(far))  # the tool stays away
    assert not any(seldom.is_free(place) for place in arm) and seldom.is_free(elbow + [0, 0, 3.0])


def test_too_few_poses_are_uncertain() -> None:
    """Two poses leave directions open, so their error is large, for a fit that weights by covariance as well."""
    for weighted in (False, True):
        here = site(l1(), camera(steady=True), weighted=weighted)
        design = here.build_design(here.camera, np.arange(here.reach.n))
        few, many = predict_rms(design, np.array([3, 90])), predict_rms(design, np.arange(0, 200, 8))
        assert few > 10 * many


def test_a_plan_chooses_the_place_and_drives_around_the_camera() -> None:
    """The plan's prediction is that of the chosen place, simulations confirm it, and moves keep clear of the camera."""
    eye = camera(pixel_noise=0.2, places=FRONT)
    plan = plan_campaign(l1(), eye, 20, demands=FREE, candidates=200, runs=4)
    found = plan.placement
    assert found is not None and (plan.device.pose.translation == found.camera.pose.translation).all()
    assert plan.choice.predicted.rms == pytest.approx(found.chosen.rms, rel=0.03)
    assert plan.rehearsal.achieved < 1.6 * plan.choice.predicted.rms < found.given.rms
    fixed = plan_campaign(l1(), replace(eye, places=None), 20, demands=FREE, candidates=200, runs=4)
    assert fixed.placement is None and plan.rehearsal.achieved < fixed.rehearsal.achieved
    kept = [o for o in plan.check._judge.demands.surroundings.obstacles if o.name == "camera"]
    assert len(kept) == 1 and kept[0].distance(found.camera.pose.translation[None])[0] < -0.04


CAMERA = """
camera: {position: [5.5, -0.6, 0.7], look_at: [1.75, -0.6, 0.7], image: [1280, 960], focal: 1400}
pattern: {position: [0.1, 0, 0], normal: [1, 0, 0]}
"""


def test_the_file_says_what_may_be_chosen(tmp_path: Path) -> None:
    """Ranges of the place are read as they stand; `direction` is a range without width; nothing is chosen unless stated."""
    path = tmp_path / "c.yaml"
    for text, expected in (
        ("", None),
        ("choose: direction", [[5.5, 5.5], [-0.6, -0.6], [0.7, 0.7]]),
        ("choose: {position: [[3, 7], [-2, 1], [1.2, 1.2]]}", [[3, 7], [-2, 1], [1.2, 1.2]]),
    ):
        path.write_text(CAMERA + text)
        places = read_camera(path).places
        assert places is None if expected is None else (places == np.array(expected)).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("choose: {position: [[7, 3], [-2, 1], [0, 2]]}", "empty range: 7 is above 3"),
        ("choose: {position: [[3, .nan], [-2, 1], [0, 2]]}", "finite"),
        ("choose: {position: [[3, 7], [-2, 1]]}", "3 ranges"),
        ("choose: {position: [3, 7, 2]}", "2 finite numbers"),
        ("choose: {place: [[3, 7], [-2, 1], [0, 2]]}", "'place' is not known"),
        ("choose: {}", "3 ranges"),
        ("choose: anything", "direction"),
        ("choose:", "direction"),
    ],
)
def test_faulty_ranges_are_a_sentence(tmp_path: Path, text: str, message: str) -> None:
    """Unknown keys, empty ranges and what is no number are refused with the place in the file."""
    path = tmp_path / "c.yaml"
    path.write_text(CAMERA + text)
    with raises_code("file_format", message):
        read_camera(path)


def test_the_new_file_gives_the_chosen_camera(tmp_path: Path) -> None:
    """The camera's file with the chosen place reads back as the camera that was chosen, and keeps everything else."""
    path = tmp_path / "c.yaml"
    path.write_text(CAMERA + "limits: {incidence: 50}\nchoose: {position: [[3, 7], [-2, 1], [0, 2]]}\n")
    given = read_camera(path)
    found = place_camera(site(l1(), replace(given, steady=True)), 20)
    (tmp_path / "new.yaml").write_text(found.format_file(path))
    back = read_camera(tmp_path / "new.yaml")
    assert np.allclose(back.pose.rotation, found.camera.pose.rotation, atol=1e-12)
    assert (back.pose.translation == found.camera.pose.translation).all() and back.places is None
    assert back.incidence == given.incidence and back.pattern == given.pattern
