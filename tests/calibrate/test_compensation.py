"""Corrected inverse kinematics: where the calibrated robot then is, the linear method's error, files, refusals."""

from __future__ import annotations

from pathlib import Path

import newcomers
import numpy as np
import pytest
from raising import raises_code

from tau_dyn.calibrate import Geometry, build_compensation, constrain_parameters
from tau_dyn.calibrate.compensation import Compensation, choose_default_axes
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.saved import load_compensation, save_compensation
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, build_kinematics, build_rods
from tau_dyn.robot import load_robot

URDF = Path(__file__).resolve().parents[2] / "urdf"


@pytest.fixture(scope="module")
def delta() -> Compensation:
    """Return the compensation of a Delta with errors of a tenth of a millimetre everywhere."""
    robot = load_robot(URDF / "delta.urdf.xacro")
    geometry = build_tree_geometry(robot)
    rng = np.random.default_rng(2)
    free = np.array(geometry.parameters.free)
    return build_compensation(robot, geometry, geometry.parameters.values + rng.normal(0, 1e-4, len(free)) * free)


def asked(correct: Compensation, n: int = 15) -> np.ndarray:
    """Return nominal positions (n, na)."""
    return correct.robot.home + np.random.default_rng(3).uniform(-0.3, 0.3, (n, correct.robot.na))


def test_exact_puts_the_real_tool_where_the_nominal_one_was(delta: Compensation) -> None:
    """After compensation the real Delta is where it was asked to be; its plate stays tilted, which nothing can correct."""
    q = asked(delta)
    found = delta(q)
    assert found.ok.all() and delta.axes == ("x", "y", "z")
    left = delta.remaining(q, found.q)
    assert np.abs(left[:, :3]).max() < 1e-10
    assert np.abs(delta.remaining(q, q)[:, :3]).max() > 1e-4
    assert np.abs(left[:, 3:]).max() > 1e-5


def test_linear_error_is_of_second_order(delta: Compensation) -> None:
    """What the paper's linear approximation leaves grows as the square of the geometric errors."""
    q, size = asked(delta), []
    step = delta.theta - delta.nominal
    for scale in (1.0, 2.0, 4.0):
        linear = build_compensation(delta.robot, delta.geometry, delta.nominal + scale * step, method="linear")
        size.append(np.linalg.norm(linear.remaining(q, linear(q).q)[:, :3], axis=1).max())
    assert 1e-8 < size[0] < 1e-5
    assert 3.5 < size[1] / size[0] < 4.5 and 3.5 < size[2] / size[1] < 4.5


def test_poses_and_positions_agree(delta: Compensation) -> None:
    """Asking for the nominal robot's pose gives what asking for its positions gives."""
    q = asked(delta, 4)
    poses = delta.geometry.forward(delta.nominal, q).poses
    assert np.abs(delta(poses).q - delta(q).q).max() < 1e-9
    linear = delta.with_method("linear")
    assert np.abs(linear(poses).q - linear(q).q).max() < 1e-9


def test_two_geometries_of_one_robot_agree() -> None:
    """Points and distances give the same corrected positions as the tree, rod lengths being wrong."""
    robot = load_robot(URDF / "delta.urdf.xacro")
    tree, rods = build_tree_geometry(robot), RodGeometry(build_rods(robot))
    lengths = {f"rod{i}{j}.length": 1e-3 * (i - 2) + (5e-4 if j == "a" else 0.0) for i in (1, 2, 3) for j in "ab"}
    q = robot.home + np.array([[0.1, -0.2, 0.05], [0.0, 0.0, 0.3]])
    results = []
    both: tuple[Geometry, ...] = (tree, rods)
    for geometry in both:
        theta = geometry.parameters.values + np.array([lengths.get(n, 0.0) for n in geometry.parameters.names])
        results.append(build_compensation(robot, geometry, theta)(q).q)
    assert np.abs(results[0] - results[1]).max() < 1e-9


@pytest.mark.parametrize(("name", "axes"), [("h4", ("x", "y", "z", "rz")), ("parallelogram", ("x",))])
def test_commanded_axes(name: str, axes: tuple[str, ...]) -> None:
    """A robot commands those parts of the pose that its joints move independently."""
    robot = load_robot(URDF / f"{name}.urdf.xacro")
    geometry = build_tree_geometry(robot)
    assert build_compensation(robot, geometry, geometry.parameters.values).axes == axes


def test_axes_of_a_robot_that_tilts_and_of_an_arm_at_a_singular_home() -> None:
    """A 3-PRS commands its tilts, not the shifts that come with them; six joints command six coordinates at any home."""
    assert choose_default_axes(newcomers.three_prs()) == ("z", "rx", "ry")
    arm = load_robot(URDF.parent / "identification" / "robots" / "kr300.urdf")
    assert len(build_kinematics(arm).commanded.names) == 5
    assert choose_default_axes(arm) == ("x", "y", "z", "rx", "ry", "rz")


def test_parallelogram_tied_parameters() -> None:
    """Tied parameters, here two equal rods, are compensated like their originals: rods 1 mm longer on both sides."""
    robot = load_robot(URDF / "parallelogram.urdf.xacro")
    tree = build_tree_geometry(robot)
    tied = constrain_parameters(tree, {"rods": ["rod2.length"]}, left_out=["crank.offset"])
    theta = tied.parameters.with_values({"rods": 0.951, "plate_turn.origin_z": -0.951}).values
    q = np.linspace(-0.6, 0.6, 5)[:, None]
    found = build_compensation(robot, tied, theta)(q)
    assert found.q[:, 0] == pytest.approx(np.arcsin(0.95 * np.sin(q[:, 0]) / 0.951), abs=1e-9)


def test_failures_have_reasons(delta: Compensation) -> None:
    """Poses out of reach and positions beyond a limit come back as nan with a reason, others unharmed."""
    poses = delta.geometry.forward(delta.nominal, delta.robot.home[None]).poses
    far = Poses(
        np.concatenate([poses.position, poses.position + [2.0, 0.0, 0.0]]), np.repeat(poses.rotation, 2, axis=0)
    )
    found = delta(far)
    assert found.ok.tolist() == [True, False] and found.reason[1] and np.isnan(found.q[1]).all()
    edge = delta(delta.robot.upper[None])
    if not edge.ok[0]:
        assert "beyond its limit" in edge.reason[0]
    free = build_compensation(delta.robot, delta.geometry, delta.theta, limits=False)
    assert free(delta.robot.upper[None]).ok[0]


def test_beyond_limit_is_named() -> None:
    """A correction that leaves the joint's range is refused and names the joint."""
    robot = load_robot(URDF / "parallelogram.urdf.xacro")
    geometry = build_tree_geometry(robot)
    theta = geometry.parameters.with_values({"crank.offset": -0.01}).values
    found = build_compensation(robot, geometry, theta)(np.array([robot.upper, robot.home]))
    assert found.reason[0] == "crank beyond its limit" and found.ok[1]


@pytest.mark.parametrize("method", ["exact", "linear"])
def test_file_round_trip(delta: Compensation, tmp_path: Path, method: str) -> None:
    """A saved compensation needs no other file and corrects alike; only changed parameters are listed."""
    path = tmp_path / "delta.yaml"
    save_compensation(delta.with_method(method), path)
    again = load_compensation(path)
    q = asked(delta, 3)
    assert np.abs(again(q).q - delta.with_method(method)(q).q).max() < 1e-12 and again.method == method
    listed = sum(line.startswith("- name:") for line in path.read_text().splitlines())
    assert listed == sum(p.free for p in delta.geometry.parameters)


def test_file_of_points_and_distances(tmp_path: Path) -> None:
    """A robot of rods is saved by its kind, too."""
    robot = load_robot(URDF / "delta.urdf.xacro")
    geometry = RodGeometry(build_rods(robot))
    theta = geometry.parameters.values + np.random.default_rng(5).normal(0, 2e-4, len(geometry.parameters))
    correct = build_compensation(robot, geometry, theta)
    save_compensation(correct, tmp_path / "rods.yaml")
    again, q = load_compensation(tmp_path / "rods.yaml"), asked(correct, 3)
    assert again(q).ok.all() and np.abs(again(q).q - correct(q).q).max() < 1e-9
    assert np.abs(correct.remaining(q, correct(q).q)[:, :3]).max() < 1e-9


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("tau_dyn_compensation: 1", "something: 1", "not a compensation"),
        ("kind: tree", "kind: cloud", "no geometry of kind 'cloud'"),
        ("name: rod1a.length", "name: rod9.length", "rod9.length"),
        ("method: exact", "method: magic", "magic"),
        ("- x\n", "- w\n", "'w'"),
        ("axes:", "axis:", "'axes' is missing"),
    ],
)
def test_broken_files_are_named(delta: Compensation, tmp_path: Path, old: str, new: str, said: str) -> None:
    """Whatever is wrong in a file is said in one sentence."""
    path = tmp_path / "delta.yaml"
    save_compensation(delta, path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=said):
        load_compensation(path)


def test_numbers_in_files_are_checked(delta: Compensation, tmp_path: Path) -> None:
    """A value that is no number is refused by name."""
    path = tmp_path / "delta.yaml"
    save_compensation(delta, path)
    lines = path.read_text().splitlines()
    k = next(i for i, line in enumerate(lines) if line.startswith("  value:"))
    lines[k] = "  value: .nan"
    path.write_text("\n".join(lines))
    with raises_code("file_format"):
        load_compensation(path)


def test_wrong_questions_are_refused(delta: Compensation) -> None:
    """Wrong array sizes, axes and methods are refused with what would be right."""
    with raises_code("wrong_shape", "3"):
        delta(np.zeros((2, 4)))
    with raises_code("wrong_shape", "parameters"):
        build_compensation(delta.robot, delta.geometry, np.zeros(3))
    with raises_code("invalid_value"):
        build_compensation(delta.robot, delta.geometry, delta.theta, axes=("x", "x"))
    with raises_code("unknown_name", "axis"):
        build_compensation(delta.robot, delta.geometry, delta.theta, axes=("up",))
    with raises_code("unknown_name"):
        delta.with_method("quadratic")
