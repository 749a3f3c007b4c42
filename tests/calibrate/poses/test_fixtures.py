"""Campaigns of distances and touches: what is planned touches, tells what a fit finds, and reads back as measurements."""

from __future__ import annotations

import csv
import io
import json
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))

from tau_dyn.calibrate import fit_geometry_to_poses, read_poses
from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames
from tau_dyn.calibrate.poses import CalibrationCampaign, FixtureSet, plan_campaign, read_fixtures
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.calibrate.poses.campaign_files import run_campaign
from tau_dyn.calibrate.poses.choice import predict
from tau_dyn.calibrate.poses.design import build_design
from tau_dyn.calibrate.poses.monte_carlo import compute_tool_error, draw_robot, simulate_calibrations
from tau_dyn.calibrate.poses.reachable import find_reachable
from tau_dyn.cli import main
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

FILE = """
target: [0.02, 0.01, 0.1]
fixtures:
  - {kind: distance, name: wire, position: [1.5, 0.2, 0.4], noise: 60e-6}
  - {kind: hole, name: A, position: [0.5, 0.2, 0.2], noise: 30e-6}
  - {kind: plane, name: plate, position: [0.4, -0.2, 0.1], normal: [0, 0, 1], noise: 20e-6}
  - {kind: sphere, name: ball, position: [0.3, 0.5, 0.3], radius: 0.05, noise: 20e-6}
"""
FREE = PoseRequirements(collisions=False)


def read(tmp: Path, text: str = FILE) -> FixtureSet:
    """Return what a file of this text holds."""
    (tmp / "fixtures.yaml").write_text(text)
    return read_fixtures(tmp / "fixtures.yaml")


@lru_cache(maxsize=1)
def skew_axes() -> Robot:
    """Return a six-axis arm of which no two axes are parallel or meet, so that noise does not decide what is told."""
    places = [("0 0 0.3", "0 0 0"), ("0.1 0.02 0.1", "1.4 0.1 0"), ("0.5 0.03 0.02", "0.2 0.3 0"),
              ("0.05 0.4 0.02", "-1.4 0.1 0"), ("0.02 0.03 0.1", "1.4 0 0.2"), ("0.03 0.08 0", "-1.4 0.2 0")]  # fmt: skip
    rows = ['<robot name="skew"><link name="l0_link"/>']
    for k, (xyz, rpy) in enumerate(places, start=1):
        rows.append(
            f'<link name="l{k}_link"/><joint name="j{k}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{k - 1}_link"/><child link="l{k}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.5" upper="2.5" velocity="2" effort="50"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0 0 0.12"/>')
    return load_robot_from_urdf("".join(rows) + '<parent link="l6_link"/><child link="tool"/></joint></robot>', "skew")


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> CalibrationCampaign:
    """A plan of sixty measurements for a UR5."""
    fixtures = read(tmp_path_factory.mktemp("plan"))
    return plan_campaign(load_robot("ur5"), fixtures, 60, demands=FREE, candidates=250, runs=1)


def test_the_nominal_target_touches_and_comes_from_outside(plan: CalibrationCampaign) -> None:
    """In a fixture's frame a pin is at 0, a probe at z = 0 or the ball's radius; each comes from 50 mm outwards."""
    poses, frames = plan.choice.poses, plan.choice.design.frames
    seen = frames.measured(plan.tool(poses.q), poses.setup).position
    kind = np.array(poses.kinds)[poses.device]
    assert {"distance", "hole"} < set(kind) and poses.touches.sum() > 10
    assert np.abs(seen[kind == "hole"]).max() < 1e-8
    assert np.abs(seen[kind == "plane", 2]).max(initial=0) < 1e-8
    assert np.abs(np.linalg.norm(seen[kind == "sphere"], axis=1) - 0.05).max(initial=0) < 1e-8
    for place in np.flatnonzero(plan.tour.pose >= 0):
        k = plan.tour.pose[place]
        if not poses.touches[k]:
            continue
        assert plan.tour.pose[place - 1] == plan.tour.pose[place + 1] == -1
        for way in (plan.tour.q[place - 1], plan.tour.q[place + 1]):
            at = frames.measured(plan.tool(way[None]), poses.setup[[k]]).position[0]
            away = np.linalg.norm(at) - 0.05 if kind[k] == "sphere" else at[2]
            assert away == pytest.approx(0.05, abs=1e-6)


def test_the_tool_stands_outside_of_what_it_touches(plan: CalibrationCampaign) -> None:
    """The frame from which the probe sticks out is above every plane and hole, and outside of every ball."""
    every, frames = plan.choice.design.poses, plan.choice.design.frames
    bare = DeviceFrames(frames.device, (IDENTITY,), frames.kinds, frames.lengths)
    at = bare.measured(plan.tool(every.q), np.column_stack([every.device, np.zeros(every.n, int)])).position
    kind = np.array(every.kinds)[every.device]
    assert at[(kind == "hole") | (kind == "plane"), 2].min() > -1e-6
    assert np.linalg.norm(at[kind == "sphere"], axis=1).min() > 0.05 - 1e-6


def test_too_few_measurements_are_uncertain_not_exact(plan: CalibrationCampaign) -> None:
    """Ten touches cannot fix thirty dimensions: what they leave open counts as unknown, not as known without error."""
    assert (
        predict(plan.choice.design, plan.choice.index[:10]).rms
        > 1e-3
        > predict(plan.choice.design, plan.choice.index).rms
    )


def test_predicted_standard_errors_are_those_of_the_fit(tmp_path: Path) -> None:
    """A fit to distances and touches of unequal noise has the standard errors that the information predicts."""
    robot, fixtures = skew_axes(), read(tmp_path)
    plan = plan_campaign(robot, fixtures, 90, demands=FREE, candidates=300, runs=1)
    chosen, noise = plan.choice.poses, plan.choice.design.noise[plan.choice.index]
    design = build_design(build_geometry(robot), chosen, noise, frames=fixtures.frames)
    predicted = dict(zip(design.names, predict(design, np.arange(90)).stderr, strict=True))
    geometry = design.geometry
    poses = fixtures.simulate(geometry, geometry.parameters.values, chosen, np.random.default_rng(4))
    fitted = fit_geometry_to_poses(geometry, poses, noise=(fixtures.fixtures[0].noise,), frames=fixtures.frames)
    own = {p.name: p.stderr for p in fitted.parameters if p.stderr is not None}
    scale = dict(zip(design.names, design.scales, strict=True))
    lengths = ("device.offset", "device_4.radius")  # places turn with the base, which is known to the prior alone
    names = [name for name in predicted if name in lengths or not name.startswith("device")]
    known = [name for name in names if predicted[name] < 0.1 * scale[name]]
    assert len(known) > 20 and set(lengths) < set(known)
    assert np.allclose([own[name] / predicted[name] for name in known], 1.0, atol=0.1)


def test_simulated_calibrations_are_as_accurate_as_predicted(plan: CalibrationCampaign) -> None:
    """Over twelve robots off by millimetres, the tool's rms error is that predicted, within what twelve draws scatter."""
    geometry, design, rng = plan.choice.design.geometry, plan.choice.design, np.random.default_rng(3)
    scales, errors = 0.2 * design.unknowns.scales[: len(geometry.parameters)], []
    assert isinstance(plan.device, FixtureSet)
    for _ in range(12):
        theta = draw_robot(geometry, np.vstack([plan.choice.q, design.workspace]), scales, rng)
        fitted = fit_geometry_to_poses(geometry, plan.device.simulate(geometry, theta, plan.choice.poses, rng))
        errors.append(compute_tool_error(fitted, design, design.frames, theta))
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) / plan.choice.predicted.rms < 1.25


def test_chosen_measurements_are_worth_more_than_random_ones(plan: CalibrationCampaign) -> None:
    """Sixty chosen measurements predict a quarter less error than sixty random ones, and the simulated fit agrees."""
    assert plan.choice.predicted.rms < 0.75 * plan.choice.at_random
    assert plan.rehearsal.achieved < 2 * plan.choice.predicted.rms < 0.01 * np.mean(plan.rehearsal.before)


def test_touches_alone_leave_the_size_open(tmp_path: Path) -> None:
    """A robot and fixtures of any size touch at the same joints: that is told, and the shape is judged without size."""
    text = "\n".join(row for row in FILE.splitlines() if "distance" not in row)
    touches = plan_campaign(load_robot("ur5"), read(tmp_path, text), 60, demands=FREE, candidates=250, runs=1)
    assert [get_code(w) for w in touches.warnings].count("size_undetermined") == 1
    design = touches.choice.design
    lengths = [p.value if p.unit == "m" else 0.0 for p in design.geometry.parameters]
    larger = design.geometry.parameters.values + 1e-3 * np.array(lengths)
    fitted = replace_theta(touches, larger)
    assert compute_tool_error(fitted, design, design.frames, design.geometry.parameters.values) < 1e-6
    assert touches.rehearsal.achieved < 2 * touches.choice.predicted.rms and design.untold == ()


def replace_theta(plan: CalibrationCampaign, theta: np.ndarray):  # noqa: ANN201
    """Return a fit that ended at other parameters, the target as much farther out."""
    design, geometry = plan.choice.design, plan.choice.design.geometry
    assert isinstance(plan.device, FixtureSet)
    poses = plan.device.simulate(geometry, geometry.parameters.values, plan.choice.poses, np.random.default_rng(0))
    fitted = fit_geometry_to_poses(geometry, poses, frames=design.frames)
    tool = tuple(f._replace(translation=1.001 * f.translation) for f in design.frames.tool)
    frames = DeviceFrames(design.frames.device, tool, design.frames.kinds, design.frames.lengths)
    return replace(fitted, state=fitted.state._replace(theta=theta, frames=frames))


def test_with_a_distance_nothing_is_said_of_the_size(plan: CalibrationCampaign) -> None:
    """One wire shows how large the robot is; what moves the robot as a whole, base and fixtures, is no error of the tool."""
    assert "size_undetermined" not in [get_code(w) for w in plan.warnings]
    assert plan.choice.not_identifiable and plan.choice.design.untold == ()


def test_what_cannot_be_touched_is_refused_by_name(tmp_path: Path) -> None:
    """A hole five metres away, or one whose obstacle is another's, cannot be touched: a sentence names it and the reason."""
    far = FILE.replace("[0.5, 0.2, 0.2]", "[5, 0.2, 0.2]")
    with raises_code("no_solution", "hole A"):
        plan_campaign(load_robot("ur5"), read(tmp_path, far), 60, demands=FREE, candidates=100, runs=1)
    seat = {"box": {"centre": [1.75, -0.6, 0.3], "size": [0.3, 0.3, 0.4]}}
    text = "target: [0, 0, -0.15]\nfixtures:\n  - {kind: distance, name: w, position: [4, -0.6, 0.2], noise: 50e-6}\n"
    only = read(tmp_path, text + "  - {kind: hole, name: A, position: [1.75, -0.6, 0.5], noise: 30e-6}\n")
    for name, works in (("A", True), ("bench", False)):
        around = build_surroundings({"obstacles": [seat | {"name": name}]}, "lab")
        demands = PoseRequirements(surroundings=around)
        if works:
            made = plan_campaign(load_robot("gantry_tau"), only, 60, demands=demands, candidates=80, runs=1)
            assert made.choice.design.poses.touches.sum() == 1  # three axes reach a point in one way
            assert (made.check.reasons(made.tour.q[~_touching(made)]) == "").all()
        else:
            with raises_code("no_solution", "obstacle: bench"):
                plan_campaign(load_robot("gantry_tau"), only, 60, demands=demands, candidates=80, runs=1)


def _touching(plan: CalibrationCampaign) -> np.ndarray:
    return np.array([k >= 0 and plan.choice.poses.touches[k] for k in plan.tour.pose])


def test_a_filled_in_plan_is_a_file_of_measurements(plan: CalibrationCampaign, tmp_path: Path) -> None:
    """With distances and the joints at each touch filled in, the CSV file reads as the planned devices and fits."""
    assert isinstance(plan.device, FixtureSet)
    geometry = plan.choice.design.geometry
    measured = plan.device.simulate(geometry, geometry.parameters.values, plan.choice.poses, np.random.default_rng(1))
    rows = list(csv.DictReader(io.StringIO(plan.csv())))
    for row in rows:
        k = int(row["pose"]) - 1
        if k >= 0:
            row |= {f"q_{joint}": repr(float(x)) for joint, x in zip(plan.robot.actuated, measured.q[k], strict=True)}
            if row["device"]:
                row["distance_tool"] = repr(float(measured.position[k, 0]))
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    (tmp_path / "measured.csv").write_text(out.getvalue())
    poses = read_poses(tmp_path / "measured.csv", plan.robot.actuated)
    assert poses.n == 60 and len(rows) > 60
    kinds = dict(zip(measured.devices, measured.kinds, strict=True))
    assert {name: kinds[name] for name in poses.devices} == dict(zip(poses.devices, poses.kinds, strict=True))
    for name, kind in zip(poses.devices, poses.kinds, strict=True):
        count = (measured.device == measured.devices.index(name)).sum()
        assert (poses.device == poses.devices.index(name)).sum() == count, kind
    assert fit_geometry_to_poses(geometry, poses).noise[0] < 1e-4


def test_files_state_what_is_touched(plan: CalibrationCampaign, tmp_path: Path) -> None:
    """The RAPID module stops before each touch; progress file and JSON name the fixtures."""
    module = plan.rapid()
    assert module.count('"hole A"') == sum("hole" in row for row in plan.cells) > 0
    assert module.index("Stop;") < module.index("MoveAbsJ")
    plan.progress().save(tmp_path / "p.json")
    kept = [row.get("cells", {}) for row in json.loads((tmp_path / "p.json").read_text())["places"]]
    assert kept == list(plan.cells)
    rows = plan.to_dict()
    assert {row["name"]: row["chosen"] for row in rows["devices"]} == {
        name: int((plan.choice.poses.device == k).sum()) for k, name in enumerate(plan.choice.poses.devices)
    }
    assert sum("hole" in row or "device" in row for row in rows["poses"]) > 10
    with raises_code("unsupported", "by hand"):
        run_campaign(plan.progress(), lambda k, q: None, tmp_path / "p.json")


def test_a_campaign_with_two_targets_states_the_target(tmp_path: Path) -> None:
    """A pin and a wire's hook at different places of the tool are two targets, each with a place of its own in the fit."""
    two = read(tmp_path, FILE.replace("noise: 60e-6", "noise: 60e-6, target: [0, 0, 0.05]"))
    assert [f.translation.tolist() for f in two.frames.tool] == [[0, 0, 0.05], [0.02, 0.01, 0.1]]
    poses = two.build_pose_set(np.zeros((4, 6)), np.arange(4))
    assert poses.target.tolist() == [0, 1, 1, 1]
    assert two.get_cells(poses)[:2] == [{"device": "wire", "target": "1"}, {"hole": "A", "target": "2"}]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: hole", "kind: whole", "fixture 2: kind must be one of distance, hole, plane, sphere"),
        ("name: A, ", "", "fixture 2: name"),
        ("name: A,", "name: 'A, B',", "without commas"),
        ("noise: 30e-6", "noise: 0", "fixture 2: noise must be a number"),
        (", noise: 30e-6", "", "fixture 2: 'noise' is missing"),
        (", radius: 0.05", "", "fixture 4: 'radius' is missing"),
        (", normal: [0, 0, 1]", "", "fixture 3: 'normal' is missing"),
        ("normal: [0, 0, 1]", "normal: [0, 0, 0]", "must have a direction"),
        ("name: plate", "name: A, radius: 1", "'radius' is not known here"),
        ("position: [0.5, 0.2, 0.2]", "position: [0.5, 0.2]", "position must hold 3"),
        ("kind: hole, name: A", "kind: distance, name: wire", "two fixtures are called 'wire'"),
        (FILE, "fixtures: []", "'fixtures' must be a list"),
    ],
)
def test_faulty_files_are_a_sentence(tmp_path: Path, old: str, new: str, message: str) -> None:
    """What is missing, unknown or no number is named with its fixture."""
    with raises_code("file_format", message):
        read(tmp_path, FILE.replace(old, new))


def test_the_command_plans_and_resumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three wires calibrate a Gantry-Tau; a progress file gives the same columns; `--tracker` does not go with it."""
    wires = "\n".join(
        f"  - {{kind: distance, name: w{k}, position: {place}, noise: 50e-6}}"
        for k, place in enumerate(([4.0, -0.6, 0.2], [1.7, -3.5, 0.5], [1.5, -0.5, 3.0]))
    )
    (tmp_path / "f.yaml").write_text(f"fixtures:\n{wires}\n")
    small = ["plan-poses", "gantry_tau", "--candidates", "120", "--no-collisions", "--n", "60"]
    given = ["--fixtures", str(tmp_path / "f.yaml"), "--resume", str(tmp_path / "p.json")]
    assert main([*small, *given, "--out", str(tmp_path / "a.csv")]) == 0
    assert "w0" in capsys.readouterr().out
    assert main([*small, *given, "--out", str(tmp_path / "b.csv")]) == 0
    head, *rows = (tmp_path / "b.csv").read_text().splitlines()
    assert head.endswith("distance_tool,device") and len(rows) >= 60
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    assert main([*small, *given[:2], "--tracker", str(tmp_path / "f.yaml")]) == 2


def test_candidates_of_a_distance_are_those_in_reach(tmp_path: Path) -> None:
    """Each reachable pose is a candidate of each wire that nothing hides."""
    robot = load_robot("gantry_tau")
    wires = "fixtures:\n" + "".join(
        f"  - {{kind: distance, name: w{k}, position: [4, {k}, 0.2], noise: 50e-6}}\n" for k in range(2)
    )
    plan = plan_campaign(robot, read(tmp_path, wires), 60, demands=FREE, candidates=120, runs=1)
    reach = find_reachable(build_machine(robot), FREE, wanted=120)
    assert plan.choice.design.n == 2 * reach.n and np.allclose(plan.choice.design.q[: reach.n], reach.q)
    assert simulate_calibrations(plan.choice, plan.device, runs=1).failures == ()
