"""Distances, pins in holes, planes, balls and several devices are parts of one fit: each tells along what it measures."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import scara_text

from tau_dyn.calibrate import PoseSet, calibrate, fit_geometry_to_poses, read_poses
from tau_dyn.calibrate.device_noise import _measure_scatter, weigh_devices
from tau_dyn.calibrate.fit_problem import Problem
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.measured import ENCODERS, KINDS, number_alike
from tau_dyn.calibrate.measured.kinds import project_columns
from tau_dyn.calibrate.model_selection import Options
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.new_places import find_new_places
from tau_dyn.calibrate.starting_frames import place_alone
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.calibrate.unknowns import collect
from tau_dyn.exceptions import InputError
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

TARGET = Frame(np.eye(3), np.array([0.03, -0.05, 0.08]))
TURN = Rotation.from_rotvec([0.3, -0.7, 1.1]).as_matrix()
LOW, HIGH = [0.2, -2.2, 0.05, -2.2], [1.4, -0.3, 0.25, 2.2]
SIGMA = 2e-5


def build_scara() -> tuple[Robot, TreeGeometry]:
    robot = load_robot_from_urdf(scara_text(), "scara")
    return robot, build_tree_geometry(robot)


def measure(
    geometry: TreeGeometry,
    theta: np.ndarray,
    frames: DeviceFrames,
    sigma: tuple[float, ...],
    rng: np.random.Generator,
    n: int,
) -> PoseSet:
    """Return positions and distances that devices measure of random poses, `n` each."""
    q = rng.uniform(LOW, HIGH, (n * len(sigma), 4))
    device = np.arange(len(q)) % len(sigma)
    seen = frames.measured(geometry.forward(theta, q).poses, device).position
    scatter = np.array(sigma)[device]
    position = seen + scatter[:, None] * rng.standard_normal(seen.shape)
    for k, kind in enumerate(frames.kinds):
        if kind == "distance":
            own = device == k
            reading = (
                np.linalg.norm(seen[own], axis=1) + frames.lengths[k] + scatter[own] * rng.standard_normal(own.sum())
            )
            position[own] = np.column_stack([reading, np.zeros((own.sum(), 2))])
    return PoseSet(q, position, device=device, devices=tuple(map(str, range(len(sigma)))), kinds=frames.kinds)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ENCODERS])
def test_derivatives_of_every_kind_are_those_of_its_residual(kind: str) -> None:
    """Central differences of a residual by each unknown agree with the analytic derivative, along what is measured.

    Across, the residual of one number turns with its direction, which matters nothing to its length.
    """
    _, geometry = build_scara()
    rng = np.random.default_rng(2)
    frames = DeviceFrames((Frame(TURN, np.array([1.2, -0.4, 0.7])),), (TARGET,), (kind,), (0.2,))
    q = rng.uniform(LOW, HIGH, (6, 4))
    setup = np.zeros(6, int)
    seen = frames.measured(geometry.forward(geometry.parameters.values, q).poses, setup)
    poses = PoseSet(q, rng.normal(size=(6, 3)) * (KINDS[kind].numbers == 3), kinds=(kind,))
    turned = kind == "hand_eye"
    poses = replace(poses, rotation=poses.expect(seen).rotation if turned else None)
    unknowns = collect(geometry, frames, device=True, tool=True, turned=turned)
    problem = Problem(geometry, poses, unknowns, "forward", turned)
    state = problem.place(geometry.parameters.values, frames, np.zeros(5), None)
    columns, step = problem.columns(state), 1e-6
    for k in np.flatnonzero(unknowns.free):
        change = step * (np.arange(len(unknowns.rows)) == k)
        low, high = (problem.residuals(problem.moved(state, sign * change)) for sign in (-1, 1))
        slope = project_columns((kind,), setup, seen.position, (low - high)[:, :, None] / (2 * step))[:, :, 0]
        assert np.allclose(columns[:, :, k], slope, atol=2e-8), unknowns.names[k]
    assert np.all(np.linalg.matrix_rank(columns[0][:3, unknowns.free]) == KINDS[kind].numbers)


def test_a_wire_of_unknown_zero_calibrates_a_robot() -> None:
    """Three wires whose ends and zeros nobody knows tell an arm's lengths within their intervals."""
    robot, geometry = build_scara()
    theta = geometry.parameters.with_values({"s2.origin_x": 0.4012, "z3.origin_x": 0.2991, "s2.offset": 0.002}).values
    places = ([1.5, 0.2, 0.4], [-0.6, 1.3, 0.9], [0.1, -1.4, 1.2])
    frames = DeviceFrames(
        tuple(Frame(np.eye(3), np.array(p)) for p in places), (TARGET,), ("distance",) * 3, (0.31, 0.02, -0.1)
    )
    poses = measure(geometry, theta, frames, (SIGMA,) * 3, np.random.default_rng(5), 60)
    found = fit_geometry_to_poses(geometry, poses)
    for name, value in zip(geometry.parameters.names, theta, strict=True):
        p = found.parameters[name]
        if p.stderr is not None:
            assert abs(p.value - value) < 4 * p.stderr, name
    assert found.parameters["s2.origin_x"].stderr < 1e-4
    assert abs(found.noise[0] / SIGMA - 1) < 0.2
    offset = found.parameters["device_2.offset"]
    assert abs(offset.value - 0.02) < 4 * offset.stderr
    assert robot.na == 4


def test_a_camera_on_the_tool_is_weighed_where_it_measures() -> None:
    """A camera at arm's length is off by 0.1 mm and 0.5 mrad in its own frame: inverted, its lever would make 0.4 mm of that."""
    robot = load_robot("ur5")
    geometry = build_tree_geometry(robot)
    theta = geometry.parameters.with_values({"elbow_joint.offset": 0.002}).values
    rng = np.random.default_rng(8)
    q = robot.home + rng.uniform(-0.8, 0.8, (60, 6))
    frames = DeviceFrames((Frame(TURN, np.array([0.9, -0.2, 0.1])),), (TARGET,))
    board = frames.measured(geometry.forward(theta, q).poses, np.zeros(60, int))
    seen = PoseSet(q, board.position, board.rotation).as_seen_from_tool()
    assert seen.rotation is not None
    turn = Rotation.from_rotvec(5e-4 * rng.standard_normal((60, 3))).as_matrix() @ seen.rotation
    file = PoseSet(q, seen.position + 1e-4 * rng.standard_normal((60, 3)), turn)
    found = calibrate(robot, file)
    assert found.poses.kinds == ("hand_eye",)
    assert "inverse_poses" in {f.cause for f in found.findings}
    assert abs(found.fit.noise[0] / 1e-4 - 1) < 0.2 and abs(found.fit.noise[1] / 5e-4 - 1) < 0.2
    p = found.fit.parameters["elbow_joint.offset"]
    assert p.stderr is not None and abs(p.value - 0.002) < 4 * p.stderr


def test_each_device_is_weighed_by_what_it_leaves() -> None:
    """A tracker of 20 um beside one of 80 um: their standard errors differ by four, and equal ones count as equal."""
    robot, geometry = build_scara()
    devices = (Frame(TURN, np.array([1.0, 2.0, 0.0])), Frame(TURN.T, np.array([-2.0, 0.5, 1.0])))
    frames = DeviceFrames(devices, (TARGET,), ("pose", "pose"), (0.0, 0.0))
    for sigma, ratio in (((SIGMA, 4 * SIGMA), 4.0), ((SIGMA, SIGMA), 1.0)):
        poses = measure(geometry, geometry.parameters.values, frames, sigma, np.random.default_rng(6), 60)
        weighed = weigh_devices(get_family(robot, poses), poses, Options())
        assert abs(weighed.device_errors[1] / ratio - 1) < (0.25 if ratio > 1 else 1e-12)
    fitted = fit_geometry_to_poses(geometry, poses)
    assert abs(_measure_scatter(fitted).left.sum() - fitted.dof) < 1e-6  # what the parameters leave of both


def test_a_pin_in_holes_shows_angles_but_no_size() -> None:
    """A tip at one point for many attitudes tells joint zeros; twice the robot would fit as well, and that is said."""
    robot = load_robot("ur5")
    geometry = build_tree_geometry(robot)
    theta = geometry.parameters.with_values({"elbow_joint.offset": 0.002, "wrist_2_joint.offset": -0.0015}).values
    rng, holes = np.random.default_rng(7), 3
    rows, device = [], []
    for k in range(holes):
        q = robot.home + rng.uniform(-0.6, 0.6, (1, 6))
        at = TARGET.translation
        here = DeviceFrames((Frame(np.eye(3), np.zeros(3)),), (Frame(np.eye(3), at),))
        hole = here.measured(geometry.forward(theta, q).poses, np.zeros(1, int)).position[0]
        q = robot.home + rng.uniform(-0.9, 0.9, (200, 6))
        off = SIGMA * rng.standard_normal((200, 3))
        for _ in range(40):
            base = geometry.forward(theta, q).poses
            zero = np.zeros(len(q), int)
            gap = here.measured(base, zero).position - hole - off
            slope = here.carried(base, geometry.tool_by_joint(theta, q, base), zero)[:, :3]
            step = (np.linalg.pinv(slope, rcond=1e-3) @ gap[:, :, None])[:, :, 0]
            q = q - step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        good = np.abs(gap).max(axis=1) < 1e-11
        rows.append(q[good][:40])
        device.append(np.full(len(rows[-1]), k))
    q = np.vstack(rows)
    names = tuple(f"hole {k}" for k in range(holes))
    poses = PoseSet(q, np.zeros((len(q), 3)), device=np.concatenate(device), devices=names, kinds=("hole",) * holes)
    found = calibrate(robot, poses)
    assert any(get_code(w) == "size_undetermined" for w in found.warnings)
    assert found.chosen.name == "complete"
    for name in ("elbow_joint.offset", "wrist_2_joint.offset"):
        p = found.fit.parameters[name]
        assert (
            p.stderr is not None and abs(p.value - theta[geometry.parameters.names.index(name)]) < 4 * p.stderr < 2e-3
        )
    assert abs(found.fit.noise[0] / SIGMA - 1) < 0.2
    size = found.fit.parameters["elbow_joint.origin_z"]
    assert abs(size.value / geometry.parameters["elbow_joint.origin_z"].value - 1) < 0.05


def test_a_file_mixes_positions_distances_and_touches(tmp_path: Path) -> None:
    """Each row gives one measurement; the column that holds it says which, and `device` names who measured."""
    path = tmp_path / "mixed.csv"
    path.write_text(
        "q_a,device,x_tool,y_tool,z_tool,distance_tool,hole\n"
        "0.1,tracker,1,2,3,,\n0.2,wire,,,,0.75,\n0.3,,,,,,A\n0.4,,,,,,B\n0.5,tracker,4,5,6,,\n"
    )
    poses = read_poses(path, ["a"])
    assert poses.devices == ("tracker", "wire", "hole A", "hole B")
    assert poses.kinds == ("pose", "distance", "hole", "hole")
    assert poses.device.tolist() == [0, 1, 2, 3, 0]
    assert poses.position[:2].tolist() == [[1, 2, 3], [0.75, 0, 0]] and not poses.position[2:4].any()
    assert poses.numbers.tolist() == [3, 1, 3, 3, 3] and poses.touches.tolist() == [False, False, True, True, False]


@pytest.mark.parametrize(
    ("row", "code"), [("0.1,1,2,3,0.5,", "bad_sample"), ("0.1,,,,,", "bad_sample"), ("0.1,1,,3,,", "bad_sample")]
)
def test_a_row_with_two_measurements_or_none_is_refused(tmp_path: Path, row: str, code: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(f"q_a,x_tool,y_tool,z_tool,distance_tool,plane\n0.2,1,2,3,,\n{row}\n")
    with pytest.raises(InputError, match=r"bad.csv, line 3") as fault:
        read_poses(path, ["a"])
    assert fault.value.code == code


def test_distances_need_the_forward_residual() -> None:
    """The closure of a loop asks for a whole pose, which no distance gives."""
    _, geometry = build_scara()
    poses = PoseSet(np.zeros((5, 4)), np.ones((5, 3)), kinds=("distance",))
    unknowns = collect(geometry, DeviceFrames(), device=True, tool=True, turned=False)
    with pytest.raises(InputError, match="forward residual"):
        Problem(geometry, poses, unknowns, "inverse", False)


def measure_elsewhere(n: int) -> tuple[Robot, PoseSet, PoseSet]:
    """Return an arm's distances from three wires, and `n` held-out ones from a fourth; a link is 3 mm longer than its file."""
    robot, geometry = build_scara()
    theta = geometry.parameters.with_values({"s2.origin_x": geometry.parameters["s2.origin_x"].value + 3e-3}).values
    places = ([1.5, 0.2, 0.4], [-0.6, 1.3, 0.9], [0.1, -1.4, 1.2], [-0.9, -0.7, 0.6])
    ends = [Frame(np.eye(3), np.array(p)) for p in places]
    rng, some = np.random.default_rng(9), ("distance",) * 3
    train = measure(
        geometry, theta, DeviceFrames((*ends[:3],), (TARGET,), some, (0.31, 0.02, -0.1)), (SIGMA,) * 3, rng, 60
    )
    held = measure(geometry, theta, DeviceFrames((ends[3],), (TARGET,), some[:1], (0.17,)), (SIGMA,), rng, n)
    return robot, train, replace(held, devices=("other wire",), source="held.csv")


def test_held_out_distances_from_another_place_judge_the_dimensions() -> None:
    """A wire whose end the training poses do not show is placed by its own rows, each judged by the others."""
    robot, train, held = measure_elsewhere(20)
    found = calibrate(robot, train, held)
    assert any(get_code(w) == "new_place" for w in found.warnings)
    before, after = (found.errors(m).position_size.rms for m in (found.models[0], found.chosen))
    assert before > 5 * SIGMA and 0.6 * SIGMA < after < 1.6 * SIGMA
    at, error = found.locate_errors(found.chosen)
    assert np.allclose(np.linalg.norm(error, axis=1), found.errors(found.chosen).distance)
    base = found.fit.geometry.forward(found.fit.theta, held.q).poses
    assert np.allclose(at, base.position + base.rotation @ found.fit.frames.tool[0].translation)
    spoiled = held.position.copy()
    spoiled[4, 0] += 5e-3
    found = calibrate(robot, train, replace(held, position=spoiled))
    assert found.holdout is not None and found.holdout.n == 19
    assert any("pose 5 (off by 5" in w for w in found.warnings)
    assert found.errors(found.chosen).position_size.rms < 1.6 * SIGMA


def test_a_new_place_needs_more_rows_than_it_has_numbers() -> None:
    """Four distances give the end of a wire and its zero, and leave nothing to judge by."""
    robot, train, held = measure_elsewhere(4)
    with pytest.raises(InputError, match="other wire is not among the training poses.*at least 5"):
        calibrate(robot, train, held)


def test_a_tracker_at_a_new_place_is_refused() -> None:
    """Positions in an unknown frame would hide the robot's own errors in that frame."""
    _, train, held = measure_elsewhere(9)
    trackers = replace(held, kinds=("pose",), devices=("tracker",))
    with pytest.raises(InputError, match="device tracker is not among"):
        number_alike(train, trackers)


def test_each_row_of_a_new_place_is_judged_by_the_others() -> None:
    """The leverage formula gives what a place fitted without the row predicts there, of six distances with four unknowns."""
    robot, train, held = measure_elsewhere(6)
    fitted = calibrate(robot, train, held).fit
    poses = number_alike(fitted.poses, held)
    base, target = fitted.predict(poses).base, fitted.frames.tool
    [place] = find_new_places(poses, base, 3, fitted.frames, SIGMA)
    assert place.kept.all()
    for k in range(poses.n):
        others = np.arange(poses.n) != k
        known = Predicted(base.take(others), np.ones(5, bool), np.full(5, ""))
        without = place_alone(place.poses.take(others), known, target)
        seen, lengths = without.measured(base, place.poses.setup), without.lengths_of(place.poses.setup)
        left = place.poses.compute_position_residuals(seen, lengths)[k]
        assert np.allclose(place.residuals[k], left, atol=0.02 * np.linalg.norm(left))
