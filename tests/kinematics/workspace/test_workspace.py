"""Workspaces against what is known on paper: their size, their reasons, their symmetry."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from scipy.optimize import root
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.accuracy import ActuatorError, ErrorBounds, sample_default_motion, study_accuracy
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine, find_workspace, measure_tilt, study_workspace
from tau_dyn.mechanism import Poses, forward_kinematics
from tau_dyn.robot import list_stock_robots, load_robot


def _robots():
    spec = importlib.util.spec_from_file_location("workspace_robots", Path(__file__).with_name("robots.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


robots = _robots()
FREE = PoseRequirements(ball_angle=np.pi, condition=1e9)
"""Nothing asked but actuator limits and the side of singularities."""
ANNULUS = np.pi * (0.7**2 - 0.1**2)


def obstacle(**more: object) -> PoseRequirements:
    entry = {"name": "block", **more}
    return PoseRequirements(
        ball_angle=np.pi, condition=1e9, surroundings=build_surroundings({"obstacles": [entry]}, "test")
    )


def reasons(found) -> dict[str, int]:
    return {row["reason"]: row["points"] for row in found.counts()}


@pytest.fixture(scope="module")
def gantry():
    return robots.gantry()


def test_three_slides_reach_the_box_of_their_limits() -> None:
    """A Cartesian robot's workspace is the box of its travel: 0.5 x 0.4 x 0.3 m."""
    found = find_workspace(robots.cartesian(), resolution=0.04, demands=FREE)
    assert found.size.low < 0.06 < found.size.high
    np.testing.assert_allclose(found.size.value, 0.06, rtol=0.05)
    np.testing.assert_allclose([found.lower, found.upper], [[0, -0.2, 0], [0.5, 0.2, 0.3]], atol=0.021)
    assert found.dimension == 3


def test_planar_arm_fills_an_annulus() -> None:
    """Two links of 0.4 and 0.3 m reach radii from 0.1 to 0.7 m; the workspace is an area, not a volume."""
    found = find_workspace(robots.planar(), resolution=0.04, demands=FREE)
    assert found.dimension == 2
    assert found.size.low < ANNULUS < found.size.high
    np.testing.assert_allclose(found.size.value, ANNULUS, rtol=0.02)
    assert found.to_dict()["volume_m3"] is None


def test_gantry_volume_is_between_its_bounds_and_they_close_in(gantry) -> None:
    """The volume that trigonometry gives lies within the bound, which shrinks with the step."""
    truth = robots.gantry_volume(0.8)
    widths = []
    for step in (0.08, 0.04):
        found = find_workspace(gantry, resolution=step, demands=FREE)
        assert found.size.low < truth < found.size.high
        widths.append(found.size.high - found.size.low)
    assert widths[1] < 0.62 * widths[0]
    np.testing.assert_allclose(found.size.value, truth, rtol=0.01)


def test_workspace_of_a_symmetric_robot_is_symmetric(gantry) -> None:
    """Carts at +y and -y: what is reached at y is reached at -y."""
    found = find_workspace(gantry, resolution=0.04, demands=FREE)
    places = found.lattice.points(np.argwhere(found.inside))
    mirrored = np.rint((places * [1, -1, 1] - found.lattice.low) / found.lattice.step).astype(int)
    assert (
        np.mean(found.inside[tuple(mirrored.T)]) > 0.998
    )  # a tip thinner than a coarse cell may be missed on one side
    assert abs(found.lower[1] + found.upper[1]) < 1e-9


def test_every_excluded_point_has_a_reason(gantry) -> None:
    """All points are either inside or counted under one reason."""
    found = find_workspace(gantry, resolution=0.08, demands=FREE)
    assert sum(reasons(found).values()) + int(found.inside.sum()) == found.code.size
    assert set(next(r for r in found.counts() if r["reason"] == "actuator limit")["culprits"]) == {
        "cart1",
        "cart2",
        "cart3",
    }


def test_tighter_ball_joints_only_take_away(gantry) -> None:
    """Every point within 25 degrees is within 40 degrees; a rod at 25 degrees and no more is the border."""
    narrow, wide = (
        find_workspace(gantry, resolution=0.08, demands=PoseRequirements(ball_angle=np.deg2rad(a), condition=1e9))
        for a in (25, 40)
    )
    assert not (narrow.inside & ~wide.inside).any()
    assert narrow.size.value < 0.8 * wide.size.value
    balls, rods = narrow.judge.balls, narrow.machine.rods
    inside = narrow.place_codes == 0
    angles = balls.angles(narrow.q[inside], rods.plate_poses(narrow.poses(narrow.places[inside])))
    assert 0.85 * np.deg2rad(25) < angles.max() <= np.deg2rad(25) + 1e-9


def test_ball_joint_angle_is_that_between_rod_and_its_direction_at_home(gantry) -> None:
    """A rod leaning from direction a to b has turned by arccos(a . b)."""
    found = find_workspace(gantry, resolution=0.1, demands=FREE)
    rods, q, place = found.machine.rods, found.q[found.place_codes == 0][7], found.places[found.place_codes == 0][7]
    poses = found.poses(place[None])
    a = place - rods.base_points(q[None])[0]
    b = found.machine.home.position[0] - rods.base_points(rods.robot.home[None])[0]
    expected = np.arccos(np.sum(a * b, axis=1) / robots.ROD**2)
    np.testing.assert_allclose(found.judge.balls.angles(q[None], poses)[0], [expected, expected], atol=1e-9)


def test_zone_in_the_middle_takes_exactly_its_volume(gantry) -> None:
    """A box of 0.2 x 0.2 x 0.16 m inside the workspace, beside home, for the tool's point alone."""
    free = find_workspace(gantry, resolution=0.04, demands=FREE)
    box = {"centre": [0.24, 0.0, 0.2], "size": [0.2, 0.2, 0.16]}
    cut = find_workspace(gantry, resolution=0.04, demands=obstacle(box=box, blocks="tool"))
    gone = float((free.inside & ~cut.inside).sum()) * 0.04**3
    np.testing.assert_allclose(gone, 0.2 * 0.2 * 0.16, rtol=0.3)  # 5 points a side: half a step at each face
    centre = cut.lattice.nearest(np.array([0.24, 0.0, 0.2]))
    assert cut.reasons.words(int(cut.code[centre])) == "safety zone: block"


def test_zone_aligned_with_the_lattice_takes_exactly_its_volume() -> None:
    """Faces half-way between points: the count of points times the cell is the box's volume to rounding."""
    robot = robots.cartesian()
    free = find_workspace(robot, resolution=0.02, demands=FREE)
    low = free.lattice.points(np.array(free.lattice.nearest(np.array([0.30, -0.1, 0.05])))) - 0.01
    box = {"centre": (low + [0.06, 0.04, 0.05]).tolist(), "size": [0.12, 0.08, 0.10]}
    cut = find_workspace(robot, resolution=0.02, demands=obstacle(box=box, blocks="tool"))
    np.testing.assert_allclose(free.size.value - cut.size.value, 0.12 * 0.08 * 0.10, rtol=1e-9)


def test_behind_a_wall_is_not_connected_to_home() -> None:
    """A thin slab across a Cartesian robot leaves the far side free but out of the way from home."""
    robot = robots.cartesian(x=(-0.3, 0.3), y=(-0.3, 0.3), z=(-0.3, 0.3))
    box = {"centre": [0.15, 0.0, 0.0], "size": [0.1, 1.0, 1.0]}  # faces between points
    found = find_workspace(robot, resolution=0.05, demands=obstacle(box=box, blocks="tool"))
    np.testing.assert_allclose(found.size.value, 0.4 * 0.6 * 0.6, rtol=1e-9)
    assert reasons(found)["not connected to home"] == 2 * 12 * 12


def test_rod_hits_an_obstacle_that_the_tool_does_not(gantry) -> None:
    """A post that stands beside the plate's way but in a rod's excludes poses whose tool is 0.3 m away from it."""
    post = {"centre": [-0.45, 0.36, 0.1], "radius": 0.03, "height": 0.1}
    found = find_workspace(gantry, resolution=0.05, demands=obstacle(cylinder=post))
    hit = [c for c, kind, _ in found.reasons.items() if kind == "obstacle"]
    places = found.places[np.isin(found.place_codes, hit)]
    assert len(places) > 20
    assert np.linalg.norm(places[:, :2] - [-0.45, 0.36], axis=1).max() > 0.3


def test_margin_to_the_border_erodes(gantry) -> None:
    """A pose kept 0.1 m from the border has only poses of the workspace within 0.1 m."""
    whole = find_workspace(gantry, resolution=0.05, demands=FREE)
    kept = find_workspace(
        gantry, resolution=0.05, demands=PoseRequirements(ball_angle=np.pi, condition=1e9, border=0.1)
    )
    assert not (kept.inside & ~whole.inside).any()
    index = np.argwhere(kept.inside)
    assert len(index) > 50
    for shift in ([1, 0, 0], [0, -1, 0], [0, 0, 1]):
        assert whole.inside[tuple((index + shift).T)].all()
    assert reasons(kept)["too close to the border"] == int(whole.inside.sum() - kept.inside.sum())


def test_probe_finds_a_hole_between_coarse_points() -> None:
    """A block of 5 cm within a coarse cell of 8 cm is found by the random points and then followed."""
    from tau_dyn.kinematics.workspace.lattice import build_lattice, classify_lattice

    lattice = build_lattice(np.zeros(3), np.full(3, 0.64), np.zeros(3), 0.01, 8)

    def classify(points: np.ndarray) -> np.ndarray:
        return np.where(np.abs(points - 0.44).max(axis=1) < 0.0251, 1, 0)

    found = classify_lattice(lattice, classify, probes=4000)
    assert int((~found.inside).sum()) == 5**3
    assert int(found.asked.sum()) < 0.2 * found.code.size


def test_stewart_platform_leans_as_far_to_both_sides() -> None:
    """The hexapod is symmetric about the plane x-z: it leans as far towards +y as towards -y, until a demand stops it."""
    found = find_workspace(load_robot("stewart"), resolution=0.1)
    lean = measure_tilt(found, found.machine.home.position[0])
    np.testing.assert_allclose(lean.angle, np.roll(lean.angle[::-1], 1), atol=np.deg2rad(1.01))
    assert 0 < lean.angle.min() <= lean.angle.max() < np.pi / 2
    assert all(lean.reason)


def test_unreached_orientation_is_refused(gantry) -> None:
    """A plate that only translates has no range of tilt; the sentence says so."""
    found = find_workspace(gantry, resolution=0.1, demands=FREE)
    with raises_code("unsupported"):
        measure_tilt(found, found.machine.home.position[0])


@pytest.mark.parametrize("travel", [(0.5, 0.0), (0.2, 0.2)])
def test_inverted_limits_are_refused(travel: tuple[float, float]) -> None:
    """A slide whose upper limit is below its lower, or that cannot move, has no workspace."""
    with raises_code("robot_structure", "'x'"):
        find_workspace(robots.cartesian(x=travel))


@pytest.mark.parametrize("resolution", [0.0, -0.1, np.nan, 5.0, 1e-5])
def test_senseless_resolution_is_refused(resolution: float) -> None:
    """Zero, negative, not a number, coarser than the robot, finer than memory: one sentence."""
    with raises_code("invalid_value", "resolution"):
        find_workspace(robots.cartesian(), resolution=resolution, demands=FREE)


def test_home_that_does_not_belong_is_refused(gantry) -> None:
    """An obstacle over home leaves nothing to be connected to; the sentence names it."""
    with raises_code("unreachable"):
        find_workspace(gantry, demands=obstacle(sphere={"centre": [0, 0, 0.2], "radius": 0.1}, blocks="tool"))


def test_workspace_that_runs_on_beyond_the_box_searched_says_so() -> None:
    """A reach estimated far too small is enlarged a few times; what still touches the box is a warning, not a failure."""
    machine = build_machine(robots.planar())
    home = machine.home.position[0]
    machine.reach = lambda: (home - [0.01, 0.01, 0.0], home + [0.01, 0.01, 0.0])
    found = find_workspace(machine, resolution=0.004, demands=FREE)
    assert any("touches the box" in said for said in found.warnings)
    assert found.inside.any() and found.inside[found.lattice.nearest(home)]


def test_place_of_the_tilt_may_be_an_array() -> None:
    """A place given as an array is asked for as one given as a list: a planar arm says that its tool does not turn freely."""
    for place in (np.array([0.4, 0.2, 0.0]), [0.4, 0.2, 0.0]):
        with raises_code("unsupported"):
            study_workspace(robots.planar(), resolution=0.1, demands=FREE, tilt_at=place)


def test_judged_positions_reach_their_places(gantry) -> None:
    """Forward kinematics of the positions kept is the place that was asked for."""
    from tau_dyn.mechanism import forward_kinematics

    found = find_workspace(gantry, resolution=0.1, demands=FREE)
    inside = found.place_codes == 0
    reached = forward_kinematics(gantry, found.q[inside])
    assert reached.ok.all()
    np.testing.assert_allclose(reached.poses.position, found.places[inside], atol=1e-9)
    assert isinstance(found.poses(found.places), Poses)


def slides_of_three_prs(z: float, rx: float, ry: float) -> np.ndarray:
    """Return the slides (3,) [m] on paper: plate joints in their legs' planes give x, y and the turn about z."""
    turn = np.array([0.0, 2 * np.pi / 3, -2 * np.pi / 3])
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros(3)], axis=1)
    across = np.stack([-np.sin(turn), np.cos(turn), np.zeros(3)], axis=1)

    def joints(free: np.ndarray) -> np.ndarray:
        x, y, rz = free
        return [x, y, z] + robots.PRS_PLATE * out @ Rotation.from_rotvec([rx, ry, rz]).as_matrix().T

    free = root(lambda free: np.sum(across * joints(free), axis=1), np.zeros(3), method="lm", tol=1e-12).x
    away = robots.PRS_BASE - np.sum(out * joints(free), axis=1)
    return joints(free)[:, 2] - np.sqrt(robots.PRS_ROD**2 - away**2)


def test_a_3_prs_is_asked_for_height_and_two_tilts() -> None:
    """Its workspace is over z, rx and ry; what belongs, and the slides there, are those on paper."""
    robot = robots.three_prs()
    found = find_workspace(robot, demands=FREE, resolution=0.03)
    machine = found.machine
    assert machine.axes == ("z", "rx", "ry") and found.measure == ("volume", "m rad2")
    index = np.flatnonzero(found.place_codes == 0)
    values = found.places[index] / machine.scale
    np.testing.assert_allclose(found.q[index], [slides_of_three_prs(*x) for x in values], atol=1e-7)
    near = np.abs(found.places[:, 1:]).max(axis=1) < 0.5 * machine.scale[1]
    expected = [np.abs(slides_of_three_prs(*(x / machine.scale))).max() < 0.12 for x in found.places[near]]
    np.testing.assert_array_equal(found.place_codes[near] == 0, expected)
    written = found.to_dict()
    assert written["coordinates"] == ["z", "rx", "ry"] and written["volume_m3"] is None
    with raises_code("unsupported", "z, rx, ry"):
        find_workspace(machine, demands=FREE, rotation=np.eye(3))


def test_a_scara_is_asked_for_three_positions_and_one_angle() -> None:
    """Its Jacobian is square, and it fills a sector of an annulus as high as its lift."""
    machine = build_machine(robots.scara())
    rates = machine.rates(machine.robot.home[None], machine.home)
    assert rates.tool.shape == rates.actuators.shape == (1, 4, 4)
    found = find_workspace(machine, demands=FREE, resolution=0.02)
    area = 4.0 * 0.4 * 0.3 * (np.cos(0.2) - np.cos(2.5))  # shoulder's travel times half the difference of squared radii
    assert found.size.low < 0.2 * area < found.size.high
    np.testing.assert_allclose(found.size.value, 0.2 * area, rtol=0.02)


def test_errors_of_a_3_prs_are_looked_for_over_its_motion() -> None:
    """A section of positions means nothing to it; three slides that err alike lift the plate by as much."""
    robot = robots.three_prs()
    sampled = sample_default_motion(robot, 8)
    assert sampled is not None and len(sampled[0]) == 8
    home = forward_kinematics(robot, robot.home[None]).poses
    errors = ErrorBounds({joint: ActuatorError(1e-4) for joint in robot.actuated})
    found = study_accuracy(robot, errors, robot.home[None], home, methods=["linear", "exact"]).accuracy
    assert found is not None and set(found.turned) == {"linear", "exact"}
    np.testing.assert_allclose([found.largest["linear"][0], found.largest["exact"][0]], 1e-4, rtol=1e-6)


def test_an_arm_whose_home_is_singular_starts_from_a_bent_one():
    """A stock UR5's home is stretched: alone it is refused; bent by quarter turns its workspace is nearly its sphere."""
    if "ur5" not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    robot = load_robot("ur5")
    with raises_code("unreachable"):
        find_workspace(build_machine(robot), resolution=0.1)
    found = study_workspace(robot, resolution=0.1)
    assert any("home is singular" in sentence for sentence in found.warnings)
    turns = found.workspace.machine.robot.home - robot.home
    assert np.count_nonzero(turns) == 2 and np.allclose(np.abs(turns[turns != 0]), np.pi / 2)
    assert 0.8 < found.workspace.size.value / (4 / 3 * np.pi * 0.91**3) < 1.05  # upper arm, forearm and wrist: 0.91 m


def test_a_missing_range_of_tilt_is_said() -> None:
    """Five drives lean a tool in some directions only: no range of tilt is computed, and a warning says so; three need none."""
    for robot, said in ((load_robot("gantry_tau_5dof"), True), (robots.planar(), False)):
        found = study_workspace(robot, resolution=0.2, demands=FREE)
        assert found.tilt is None
        assert any("no range of tilt" in sentence for sentence in found.warnings) is said
