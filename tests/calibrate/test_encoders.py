"""Encoders of passive joints: a robot with loops calibrates itself, by the angles that its loops must have."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import newcomers

from tau_dyn.calibrate import PassiveEncoders, PoseSet, calibrate, join_pose_sets, load_calibration, read_poses
from tau_dyn.calibrate.device_noise import weigh_devices
from tau_dyn.calibrate.fit_problem import Problem
from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import predict_measured, read_encoders_as_meant
from tau_dyn.calibrate.model_selection import Options
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.poses import plan_campaign, read_fixtures
from tau_dyn.calibrate.starting_frames import estimate_initial_frames
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.calibrate.unknowns import collect
from tau_dyn.cli import main
from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot

JOINTS = ("elbow1", "elbow2")
ZEROS = {"elbow1": 0.21, "elbow2": -0.13}
SIGMA_RAD = 1e-5
TARGET = Frame(np.eye(3), np.array([0.04, -0.03, 0.0]))
DEVICE = Frame(np.eye(3), np.array([0.4, -1.1, 0.3]))


@pytest.fixture(scope="module")
def five_bar() -> Robot:
    return newcomers.five_bar()


def draw_positions(robot: Robot, n: int, rng: np.random.Generator) -> np.ndarray:
    return robot.home + rng.uniform(-0.4, 0.4, (n, robot.na))


def measure(robot: Robot, theta: np.ndarray, q: np.ndarray, rng: np.random.Generator) -> PoseSet:
    """Return what both encoders of a five-bar with parameters `theta` read."""
    geometry, known = build_tree_geometry(robot), PassiveEncoders.of(robot, JOINTS)
    rows = PoseSet(q, np.zeros((len(q), 3)), names=tuple(f"row {k}" for k in range(len(q))))
    angles = geometry.passive(theta, q, JOINTS)
    read = [
        known.measure(joint, angles[:, k] + ZEROS[joint] + SIGMA_RAD * rng.standard_normal(len(q)), rows)
        for k, joint in enumerate(JOINTS)
    ]
    return join_pose_sets(read)


def build_truth(geometry: TreeGeometry, **off: float) -> np.ndarray:
    changes = {name.replace("__", "."): value for name, value in off.items()}
    nominal = {p.name: p.value for p in geometry.parameters}
    return geometry.parameters.with_values({name: nominal[name] + value for name, value in changes.items()}).values


def test_a_passive_angle_is_that_of_the_triangle_of_the_links(five_bar: Robot) -> None:
    """Distance between shoulder and tip and the two lengths of an arm give its elbow's angle by the law of cosines."""
    geometry, q = build_tree_geometry(five_bar), draw_positions(five_bar, 20, np.random.default_rng(0))
    theta = geometry.parameters.values
    tip = geometry.forward(theta, q).poses.position
    square = np.sum(tip**2, axis=1)
    inner = np.arccos((newcomers.UPPER**2 + newcomers.LOWER**2 - square) / (2 * newcomers.UPPER * newcomers.LOWER))
    assert np.allclose(np.abs(geometry.passive(theta, q, ["elbow1"])[:, 0]), np.pi - inner, atol=1e-9)


@pytest.mark.parametrize(("name", "joints"), [("five_bar", JOINTS), ("delta", ("rod1a_yaw", "rod2b_pitch"))])
def test_derivatives_of_encoders_are_those_of_their_residual(name: str, joints: tuple[str, ...]) -> None:
    """Central differences of the arcs by each unknown, zeros of encoders included, agree with the analytic derivative."""
    robot = newcomers.five_bar() if name == "five_bar" else load_robot(name)
    rng, known = np.random.default_rng(1), PassiveEncoders.of(robot, joints)
    q = robot.home + rng.uniform(-0.2, 0.2, (4, robot.na))
    rows = PoseSet(q, np.zeros((4, 3)), names=("a", "b", "c", "d"))
    poses = join_pose_sets([known.measure(joint, rng.normal(size=4), rows) for joint in joints])
    family = get_family(robot, poses)
    geometry = family.build(family.spec("complete+eccentric"))
    theta = geometry.parameters.values + 1e-3 * rng.normal(size=len(geometry.parameters))
    frames = DeviceFrames((IDENTITY,) * 2, (TARGET,), poses.kinds, (0.1, -0.2))
    unknowns = collect(geometry, frames, device=True, tool=True, turned=False)
    assert not any(may and name.startswith("tool") for name, may in zip(unknowns.names, unknowns.free, strict=True))
    problem = Problem(geometry, poses, unknowns, "forward", turned=False)
    state = problem.place(theta, frames, np.zeros(robot.na + 1), None)
    columns, step = problem.columns(state), 1e-6
    for k in np.flatnonzero(unknowns.free):
        change = step * (np.arange(len(unknowns.rows)) == k)
        low, high = (problem.residuals(problem.moved(state, sign * change)) for sign in (-1, 1))
        assert np.allclose(columns[:, :, k], (low - high) / (2 * step), atol=1e-7), unknowns.names[k]


def test_a_five_bar_calibrates_itself_by_its_elbows(five_bar: Robot) -> None:
    """Two encoders whose zeros nobody knows show ratios of lengths and drives' zeros, each within four standard errors."""
    geometry, rng = build_tree_geometry(five_bar), np.random.default_rng(2)
    theta = build_truth(geometry, motor1__offset=8e-4, elbow1__origin_x=6e-4)
    train, held = (measure(five_bar, theta, draw_positions(five_bar, n, rng), rng) for n in (60, 40))
    found = calibrate(five_bar, train, held, "complete")
    truth = dict(zip(geometry.parameters.names, theta, strict=True))
    estimate = {p.name: p for p in found.fit.parameters}
    lengths = [name for name in ("elbow1.origin_x", "elbow2.origin_x", "lower2.length") if estimate[name].stderr]
    assert len(lengths) >= 2
    size = truth["lower1.anchor_x"] / estimate["lower1.anchor_x"].value  # angles show lengths over the one that is kept
    for name in lengths:
        assert abs(estimate[name].value * size - truth[name]) < 4 * estimate[name].stderr, name
    assert abs(estimate["motor1.offset"].value - estimate["motor2.offset"].value - 8e-4) < 1e-4
    rows = found.to_dict()["devices"]
    assert [row["unit"] for row in rows] == ["rad", "rad"]
    assert all(0.7 * SIGMA_RAD < row["noise"] < 1.4 * SIGMA_RAD for row in rows)
    assert "size_undetermined" in [get_code(text) for text in found.warnings]


def test_a_reading_is_the_angle_and_the_zero(five_bar: Robot) -> None:
    """Of a robot as its file says, each zero is what its encoder reads beyond the joint's angle."""
    rng = np.random.default_rng(14)
    q = draw_positions(five_bar, 30, rng)
    found = calibrate(
        five_bar, measure(five_bar, build_tree_geometry(five_bar).parameters.values, q, rng), None, "frames"
    )
    rows = {row["device"]: row for row in found.to_dict()["frames"] if "zero" in row}
    for joint, zero in ZEROS.items():
        assert rows[joint]["zero"] == pytest.approx(zero, abs=4 * SIGMA_RAD)
        assert rows[joint]["unit"] == "rad"


def test_angles_do_not_show_how_large_a_robot_is(five_bar: Robot) -> None:
    """A five-bar 2 % larger all over has the same passive angles at the same positions of its motors."""
    geometry, q = build_tree_geometry(five_bar), draw_positions(five_bar, 10, np.random.default_rng(3))
    nominal = geometry.parameters
    scaled = [1.02 * p.value if p.unit == "m" else p.value for p in nominal]
    assert np.allclose(
        geometry.passive(nominal.values, q, JOINTS), geometry.passive(np.array(scaled), q, JOINTS), atol=1e-9
    )
    poses = measure(five_bar, nominal.values, q, np.random.default_rng(3))
    assert poses.hides_size(("rad", "rad"))
    assert not poses.hides_size(("m", "rad"))


def measure_tool(geometry: Geometry, theta: np.ndarray, q: np.ndarray, sigma: float, seed: int) -> PoseSet:
    """Return positions of a target as a tracker sees them."""
    frames = DeviceFrames((DEVICE,), (TARGET,))
    seen = frames.measured(geometry.forward(theta, q).poses, np.zeros(len(q), int)).position
    return PoseSet(q, seen + sigma * np.random.default_rng(seed).standard_normal(seen.shape), devices=("tracker",))


@pytest.mark.long
def test_a_tracker_and_encoders_are_weighed_by_what_each_leaves(five_bar: Robot) -> None:
    """The noise of the tracker and of the encoders is that which was drawn, though the planar arm leaves much undetermined.

    What is not determined goes to nominal at the poses' weights; weights that follow would give up all poses on the way.
    """
    geometry, rng = build_tree_geometry(five_bar), np.random.default_rng(4)
    theta = build_truth(geometry, motor1__offset=8e-4)
    q = draw_positions(five_bar, 60, rng)
    encoders = measure(five_bar, theta, q, rng)
    both = join_pose_sets([measure_tool(geometry, theta, q, 2e-5, 5), encoders])
    weighed = weigh_devices(get_family(five_bar, both), both, Options())
    expected = SIGMA_RAD * both.arc_radius / 2e-5
    assert weighed.device_errors[1:] == pytest.approx([expected] * 2, rel=0.25)
    found = calibrate(five_bar, both, None, "complete")
    tool = np.linalg.norm(found.errors(found.chosen).position, axis=1)[~found.at().of_encoders]
    assert found.errors(found.chosen).position_size.rms == pytest.approx(np.sqrt(np.mean(tool**2)))


@pytest.mark.long
def test_orientations_stay_beside_encoders(five_bar: Robot) -> None:
    """Rows of encoders have no orientation: the orientation's noise is that of the other rows alone."""
    geometry, rng = build_tree_geometry(five_bar), np.random.default_rng(6)
    theta, q = geometry.parameters.values, draw_positions(five_bar, 50, rng)
    tool = measure_tool(geometry, theta, q, 2e-5, 7)
    turn = 1e-4 * rng.standard_normal((50, 3))
    small = np.eye(3) - np.cross(np.eye(3), turn[:, None, :])
    tool = replace(tool, rotation=np.linalg.qr(small @ geometry.forward(theta, q).poses.rotation)[0])
    sign = np.sign(np.einsum("nij,nij->nj", tool.rotation, geometry.forward(theta, q).poses.rotation))
    tool = replace(tool, rotation=tool.rotation * sign[:, None])
    encoders = measure(five_bar, theta, q, rng)
    both = join_pose_sets([tool, replace(encoders, rotation=np.repeat(np.eye(3)[None], encoders.n, axis=0))])
    assert np.array_equal(both.count_numbers(6), [6] * 50 + [1] * 100)
    found = calibrate(five_bar, both, None, "complete")
    assert found.fit.noise[1] == pytest.approx(1e-4, rel=0.2)
    assert found.errors(found.chosen).orientation_size.rms < 4e-4


def write(path: Path, robot: Robot, q: np.ndarray, **columns: np.ndarray) -> Path:
    motors = {f"q_{joint}": q[:, k] for k, joint in enumerate(robot.actuated)}
    pd.DataFrame(motors | columns).to_csv(path, index=False)
    return path


def test_a_file_gives_encoders_beside_or_instead_of_the_tool(five_bar: Robot, tmp_path: Path) -> None:
    """An empty cell was not read: each row gives as many measurements as it has, under its own name and joints."""
    q, known = draw_positions(five_bar, 4, np.random.default_rng(8)), PassiveEncoders.of(five_bar, JOINTS)
    gap = np.nan
    path = write(
        tmp_path / "mixed.csv", five_bar, q,
        q_elbow1=np.array([0.1, 0.2, gap, 0.4]), q_elbow2=np.array([gap, 1.2, 1.3, gap]),
        x_tool=np.array([0.5, gap, 0.7, gap]), y_tool=np.array([0.1, gap, 0.2, gap]), z_tool=np.array([0.0, gap, 0.1, gap]),
    )  # fmt: skip
    poses = read_poses(path, five_bar.actuated, encoders=known)
    assert [poses.devices[k] for k in poses.device] == ["1", "1", *["elbow1"] * 3, *["elbow2"] * 2]
    assert [name.rpartition(" ")[2] for name in poses.names] == ["2", "4", "2", "3", "5", "3", "4"]
    assert np.allclose(poses.position[2:5, 0], known.arc_radius * np.array([0.1, 0.2, 0.4]))
    assert np.allclose(poses.q[4], q[3])


def test_an_encoder_that_counts_in_degrees_the_other_way_is_read_so(five_bar: Robot) -> None:
    """Sign, unit and whole turns are those at which an encoder follows the robot file; a warning names each."""
    geometry, rng = build_tree_geometry(five_bar), np.random.default_rng(9)
    meant = measure(five_bar, geometry.parameters.values, draw_positions(five_bar, 30, rng), rng)
    factor = np.where(meant.device == 0, -180 / np.pi, 1.0)
    turns = 2 * np.pi * meant.arc_radius * np.where(meant.device == 1, np.arange(meant.n) % 3, 0)
    written = replace(meant, position=meant.position * factor[:, None] + np.outer(turns, [1.0, 0.0, 0.0]))
    read, said = read_encoders_as_meant(five_bar, written)
    expected = predict_measured(geometry, geometry.parameters.values, meant, meant.q).poses.position[:, 0]
    for number in (0, 1):
        off = (read.position[:, 0] - expected)[read.device == number]
        assert np.ptp(off) < 10 * SIGMA_RAD * meant.arc_radius
    assert [get_code(text) for text in said] == ["poses_reread"]
    assert "elbow1 is in degrees and counts the other way" in said[0]


@pytest.mark.parametrize(
    ("robot", "joint", "code", "words"),
    [
        ("five_bar", "motor1", "bad_option", "is driven"),
        ("five_bar", "wrist", "unknown_name", "elbow1, elbow2"),
        ("ur5", "elbow", "unsupported", "no loops"),
    ],
)
def test_joints_without_an_encoder_of_their_own_are_refused(robot: str, joint: str, code: str, words: str) -> None:
    """A driven joint, an unknown one, and any joint of a robot without loops are told apart."""
    with pytest.raises(TauDynError, match=words) as fault:
        PassiveEncoders.of(newcomers.five_bar() if robot == "five_bar" else load_robot(robot), [joint])
    assert fault.value.code == code


def test_other_residuals_and_rods_have_no_encoders(five_bar: Robot) -> None:
    """The closure residual has no row for an encoder, and a robot of rods has no passive joints; both say so."""
    poses = measure(
        five_bar, build_tree_geometry(five_bar).parameters.values, five_bar.home[None], np.random.default_rng(0)
    )
    geometry = build_tree_geometry(five_bar)
    unknowns = collect(
        geometry,
        DeviceFrames((IDENTITY,) * 2, kinds=poses.kinds, lengths=(0.0, 0.0)),
        device=True,
        tool=True,
        turned=False,
    )
    with pytest.raises(InputError, match="encoders need the forward residual"):
        Problem(geometry, poses, unknowns, "closure", turned=False)
    family = get_family(five_bar, PoseSet(five_bar.home[None], np.zeros((1, 3))))
    rods = family.build(family.spec("complete"))
    with pytest.raises(InputError, match="tree with loops"):
        rods.passive(rods.parameters.values, five_bar.home[None], ["elbow1"])


def test_the_command_calibrates_by_encoders_and_its_model_is_read_back(
    five_bar: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--encoders` names the joints; the model file holds the tree, and the robot built of it has the calibrated angles."""
    geometry, rng = build_tree_geometry(five_bar), np.random.default_rng(10)
    theta = build_truth(geometry, elbow1__origin_x=2e-3)
    file = tmp_path / "five_bar.urdf"
    file.write_text(five_bar.urdf, encoding="utf-8")
    for name in ("train", "held"):
        q = draw_positions(five_bar, 60, rng)
        angles = geometry.passive(theta, q, JOINTS) + SIGMA_RAD * rng.standard_normal((60, 2))
        write(tmp_path / f"{name}.csv", five_bar, q, q_elbow1=angles[:, 0] + 0.3, q_elbow2=angles[:, 1])
    train, held, out = (str(tmp_path / name) for name in ("train.csv", "held.csv", "model.yaml"))
    status = main(
        ["calibrate", str(file), train, "--holdout", held, "--encoders", *JOINTS, "--out", out, "--report",
         str(tmp_path / "page.html")]
    )  # fmt: skip
    assert status == 0
    shown = capsys.readouterr().out
    assert "misses the encoders of its passive joints by arcs" in shown
    assert "angle of a passive joint" in shown
    model = load_calibration(out)
    assert isinstance(model.geometry, TreeGeometry)
    q = draw_positions(five_bar, 5, rng)
    built = build_tree_geometry(model.build_robot())
    assert np.allclose(
        built.passive(built.parameters.values, q, JOINTS), model.geometry.passive(model.theta, q, JOINTS), atol=1e-6
    )


@pytest.mark.long
def test_a_plan_lists_encoders_to_be_read(five_bar: Robot, tmp_path: Path) -> None:
    """A plan takes poses for encoders, keeps their columns empty, and its prediction holds in simulated calibrations."""
    path = tmp_path / "cell.yaml"
    wires = "\n".join(
        f"  - {{kind: distance, name: wire{k}, position: {place}, noise: 50e-6}}"
        for k, place in enumerate(([0.5, 1.2, 0.4], [-0.5, 1.2, 0.9], [-0.5, -1.2, 0.05]))
    )
    encoders = "\n".join(f"  - {{kind: encoder, name: {joint}, noise: 50e-6}}" for joint in JOINTS)
    path.write_text(f"target: [0.05, 0.02, 0.03]\nfixtures:\n{wires}\n{encoders}\n", encoding="utf-8")
    plan = plan_campaign(five_bar, read_fixtures(path), 60, candidates=100, runs=2)
    assert {row["kind"] for row in plan.count_by_device()} == {"distance", "angle"}
    assert plan.rehearsal.achieved < 3 * plan.rehearsal.predicted
    head = plan.csv().splitlines()[0]
    assert head == "pose,q_motor1,q_motor2,distance_tool,device,q_elbow1,q_elbow2"
    path.write_text(
        "fixtures:\n  - {kind: encoder, name: elbow1, noise: 1e-5, position: [0, 0, 0]}\n", encoding="utf-8"
    )
    with pytest.raises(InputError, match="position"):
        read_fixtures(path)


def test_a_target_that_hardly_shows_starts_near_the_tool() -> None:
    """A Delta's plate hardly turns, so positions leave the target open: its start is near the tool, whatever the rows' order."""
    robot, rng = load_robot("delta"), np.random.default_rng(11)
    geometry, known = build_tree_geometry(robot), PassiveEncoders.of(robot, ["rod1a_yaw"])
    theta = geometry.parameters.values
    theta = theta + 3e-4 * rng.standard_normal(len(theta)) * np.array([p.free for p in geometry.parameters])
    q = robot.home + rng.uniform(-0.3, 0.3, (40, 3))
    rows = PoseSet(q, np.zeros((40, 3)), names=tuple(f"row {k}" for k in range(40)))
    encoder = known.measure("rod1a_yaw", geometry.passive(theta, q, ["rod1a_yaw"])[:, 0], rows)
    poses = join_pose_sets([measure_tool(geometry, theta, q, 2e-5, 12), encoder])
    places = []
    for order in (np.arange(poses.n), rng.permutation(poses.n)):
        some = poses.take(order)
        nominal = predict_measured(geometry, geometry.parameters.values, some, some.q)
        places.append(estimate_initial_frames(some, nominal).tool[0].translation)
    assert np.linalg.norm(places[0]) < 0.2
    assert np.allclose(places[0], places[1], atol=1e-3)
