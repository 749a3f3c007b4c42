"""Drives that yield to weights and known loads: statics against potential energy, what files hold, what is named."""

from __future__ import annotations

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from raising import raises_code
from rich.console import Console

from tau_dyn.calibrate import PoseSet, calibrate, load_calibration, propose_pose_columns, read_poses, save_calibration
from tau_dyn.calibrate.addition_tests import _ProjectedResidual, screen_additions
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.laws import RodLoads
from tau_dyn.calibrate.measured import estimate_measurement_noise
from tau_dyn.calibrate.model_family import Spec
from tau_dyn.calibrate.model_selection import Options, fit_spec
from tau_dyn.calibrate.models import Family, get_family
from tau_dyn.calibrate.simulated import format_csv, simulate_poses
from tau_dyn.cli import main
from tau_dyn.mechanism import build_kinematics, build_rods
from tau_dyn.render import build_page, print_result
from tau_dyn.render.kinds.calibration_words import list_stiffness
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

NOISE = (2e-5, 4e-5)
COMPLIANCE = {"delta": 1e-3, "ur5": 4e-5, "gantry_tau": 5e-7, "parallelogram": 1e-3}
REACH = {"delta": 0.4, "ur5": 1.0, "gantry_tau": 0.3, "parallelogram": 0.2}


def draw_positions(name: str, n: int, seed: int) -> tuple[Robot, np.ndarray]:
    """Return a robot and positions about its home (n, na)."""
    robot = load_robot(name)
    return robot, robot.home + REACH[name] * np.random.default_rng(seed).uniform(-1, 1, (n, robot.na))


def draw_loads(n: int, weight: float, seed: int) -> np.ndarray:
    """Return a weight at every other pose (n, 7)."""
    loads = np.zeros((n, 7))
    loads[1::2, 0] = weight * np.random.default_rng(seed).uniform(0.5, 1.0, n // 2)
    return loads


def build_elastic(
    robot: Robot, q: np.ndarray, loads: np.ndarray, structure: str = "complete"
) -> tuple[Family, Geometry]:
    """Return the models of a robot under loads, and that whose drives all yield."""
    family = get_family(robot, PoseSet(q, np.zeros((len(q), 3)), loads=loads))
    return family, family.build(Spec(structure, {"elastic": family.can_have("elastic")}))


def set_compliances(geometry: Geometry, c: float) -> np.ndarray:
    """Return the nominal parameters with all drives of one compliance."""
    return np.array([c if p.name.endswith("drive_compliance") else p.value for p in geometry.parameters])


def settle(family: Family, c: float, q: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Return where joints stand (N, na): springs balance the gradient of Pinocchio's potential energy and of the load's work."""
    robot, nominal = family.nominal.robot, family.nominal
    model, kinematics = robot.model, build_kinematics(robot)
    data = model.createData()

    def compute_energy(x: np.ndarray) -> np.ndarray:
        own = [pin.computePotentialEnergy(model, data, full) for full in kinematics.full_positions(x)]
        pull = loads[:, :1] * model.gravity.linear + loads[:, 1:4]
        return np.array(own) - np.sum(nominal.forward(nominal.parameters.values, x).poses.position * pull, axis=1)

    real, h = q.copy(), 1e-4
    for _ in range(12):
        slopes = [(compute_energy(real + d) - compute_energy(real - d)) / (2 * h) for d in h * np.eye(q.shape[1])]
        real = q - c * np.column_stack(slopes)
    return real


@pytest.mark.parametrize("name", ["delta", "ur5", "gantry_tau", "parallelogram"])
def test_joints_stand_where_springs_balance_the_gradient_of_the_potential_energy(name: str):
    """By weights, a weight at the tool and a force on it, with loops and without, to a hundredth of the deflection's square."""
    robot, q = draw_positions(name, 6, 1)
    loads = np.zeros((6, 7))
    loads[1::2, 0], loads[2:4, 1:4] = 2.0, (5.0, -3.0, 4.0)
    family, geometry = build_elastic(robot, q, loads)
    if name == "parallelogram":  # a horizontal mechanism carries forces alone
        loads[:, 1:3] = 20.0
    theta = set_compliances(geometry, COMPLIANCE[name])
    real, nominal = settle(family, COMPLIANCE[name], q, loads), family.nominal
    wanted = nominal.forward(nominal.parameters.values, real).poses
    found = geometry.under(loads).forward(theta, q).poses
    moved = np.abs(nominal.forward(nominal.parameters.values, q).poses.position - wanted.position).max()
    assert moved > 1e-5
    assert np.abs(found.position - wanted.position).max() < 1e-3 * moved


@pytest.mark.parametrize("name", ["delta", "gantry_tau"])
def test_derivatives_under_loads_are_those_of_the_poses(name: str):
    """Compliances, masses and tilt move the tool of a robot with loops as the differences of its poses say."""
    robot, q = draw_positions(name, 4, 2)
    loads = np.tile([1.5, 3.0, -2.0, 1.0, 0.3, 0.2, -0.1], (4, 1))
    _, geometry = build_elastic(robot, q, loads)
    geometry, theta = geometry.under(loads), set_compliances(geometry, COMPLIANCE[name])
    names = geometry.parameters.names
    theta[names.index("base.tilt_x")] = 0.01
    theta[[k for k, n in enumerate(names) if n.endswith("mass_error")][0]] = 0.2
    at = geometry.forward(theta, q).poses
    by_parameter, by_joint = geometry.tool_by_parameter(theta, q, at), geometry.tool_by_joint(theta, q, at)
    for k, n in enumerate(names):
        if any(word in n for word in ("compliance", "mass_error", "tilt")):
            h = 1e-3 * COMPLIANCE[name] if "compliance" in n else 1e-3
            step = h * np.eye(len(theta))[k]
            pair = [geometry.forward(theta + sign * step, q).poses.position for sign in (1, -1)]
            found = (pair[0] - pair[1]) / (2 * h)
            assert by_parameter[:, :3, k] == pytest.approx(found, abs=1e-5 * np.abs(found).max() + 1e-9), n
    for k in range(robot.na):
        step = 1e-5 * np.eye(robot.na)[k]
        pair = [geometry.forward(theta, q + sign * step).poses.position for sign in (1, -1)]
        assert by_joint[:, :3, k] == pytest.approx((pair[0] - pair[1]) / 2e-5, abs=1e-5)


def test_a_moment_at_the_tool_does_the_work_of_a_force_beside_it():
    """A force 0.2 m beside the tool's origin is the same force at it with the moment of the lever."""
    robot, q = draw_positions("ur5", 5, 3)
    arm, force = np.array([0.2, -0.1, 0.05]), np.array([30.0, 20.0, -40.0])
    loads = np.tile([0.0, *force, *np.zeros(3)], (5, 1))
    family, geometry = build_elastic(robot, q, loads)
    nominal = family.nominal
    rotation = nominal.forward(nominal.parameters.values, q).poses.rotation
    loads[:, 4:] = np.cross(rotation @ arm, force)
    statics = family.loading.statics
    place = " ".join(str(x) for x in arm)
    more = (
        f'<link name="tool"/><joint name="beside" type="fixed"><origin xyz="{place}"/><parent link="tool0"/>'
        '<child link="tool"/></joint></robot>'
    )
    urdf = robot.urdf.replace("</robot>", more)
    beside = load_robot_from_urdf(urdf, "beside", actuated=robot.actuated, tool="tool")
    other = get_family(beside, PoseSet(q, np.zeros((5, 3)))).loading.statics
    wanted = np.einsum("nka,k->na", other.at(q).jacobian[:, :3], force)
    assert np.einsum("nka,nk->na", statics.at(q).jacobian, loads[:, 1:]) == pytest.approx(wanted, abs=1e-9)


def test_rods_carry_a_weight_at_the_tool_too():
    """On all carts together a weight of 10 kg adds its weight, and a force its opposite."""
    rods = build_rods(load_robot("gantry_tau"))
    q, loads = rods.robot.home[None], RodLoads(rods)
    weight = np.zeros((1, 7))
    weight[0, 0] = 10.0
    force = np.zeros((1, 7))
    force[0, 1:4] = -10.0 * rods.robot.model.gravity.linear
    plain = loads(q).sum(axis=1)
    assert loads(q, weight).sum(axis=1) - plain == pytest.approx(10.0 * rods.robot.model.gravity.linear[None], abs=1e-6)
    assert loads(q, force).sum(axis=1) - plain == pytest.approx(force[:, 1:4], abs=1e-6)


def test_known_loads_tell_stiffness_from_masses():
    """An arm whose masses are 20 % light: with weights at half of 40 poses springs are known ten times better than by gravity."""
    robot, q = draw_positions("ur5", 40, 4)
    loads, stderr = draw_loads(40, 10.0, 5), []
    for known in (loads, np.zeros((40, 7))):
        family, geometry = build_elastic(robot, q, known)
        theta = set_compliances(geometry, 5e-5)
        for k, p in enumerate(geometry.parameters):
            theta[k] = -0.2 if p.name.endswith("mass_error") else theta[k]
        poses = simulate_poses(geometry, theta, q, np.random.default_rng(6), noise=NOISE, loads=known)
        fitted = fit_spec(
            family, Spec("complete", {"elastic": ("shoulder_lift_joint", "elbow_joint")}), poses, Options()
        )
        p = fitted.parameters["shoulder_lift_joint.drive_compliance"]
        assert p.stderr is not None and abs(p.value - 5e-5) < 3 * p.stderr
        stderr.append(p.stderr / 5e-5)
    assert stderr[0] < 0.02 and stderr[1] > 0.1


def test_the_same_joints_under_another_load_are_no_repeats(tmp_path: Path):
    """Loaded and unloaded poses at the same joints differ by the deflection, which is no measurement noise."""
    robot, q = draw_positions("ur5", 12, 7)
    q, loads = np.repeat(q, 2, axis=0), draw_loads(24, 5.0, 8)
    _, geometry = build_elastic(robot, q, loads)
    theta = set_compliances(geometry, 5e-5)
    poses = simulate_poses(geometry, theta, q, np.random.default_rng(9), noise=NOISE, loads=loads)
    assert estimate_measurement_noise(poses).source == "unknown"
    (tmp_path / "poses.csv").write_text(format_csv(poses, robot.actuated))
    read = read_poses(tmp_path / "poses.csv", robot.actuated)
    assert read.loads == pytest.approx(loads, rel=1e-8)
    proposed = propose_pose_columns(tmp_path / "poses.csv", robot)
    assert proposed is not None and {"load", "fx_tool", "mz_tool"} <= set(proposed.entries)


@pytest.mark.parametrize(
    ("columns", "row", "code", "words"),
    [
        ("load", "-1", "bad_sample", "-1 kg"),
        ("load", "5e5", "bad_sample", "20000 kg"),
        ("load", "inf", "bad_sample", "load"),
        ("load", "two", "bad_sample", "load"),
        ("fx_tool,fy_tool", "1,1", "missing_column", "fz_tool"),
        ("mx_tool,my_tool,mz_tool", "1,1,1e9", "bad_sample", "mz_tool"),
    ],
)
def test_loads_that_no_tool_bears_are_refused(tmp_path: Path, columns: str, row: str, code: str, words: str):
    """A weight below zero, grams, words, a component that is missing: a sentence with row and column; empty cells are no load."""
    head = f"q_a,x_tool,y_tool,z_tool,{columns}\n"
    blank = "," * columns.count(",")
    (tmp_path / "p.csv").write_text(head + f"0.1,0,0,0,{blank}\n0.2,0,0,0,{row}\n")
    with raises_code(code, words):
        read_poses(tmp_path / "p.csv", ["a"])
    (tmp_path / "p.csv").write_text("q_a,x_tool,y_tool,z_tool,load\n0.1,0,0,0,\n0.2,0,0,0,3\n")
    assert read_poses(tmp_path / "p.csv", ["a"]).loads[:, 0].tolist() == [0.0, 3.0]


def test_loads_need_a_place_of_the_tool():
    """A robot file without a tool frame has no point where a weight could hang."""
    robot, q = draw_positions("delta", 20, 10)
    bare = load_robot_from_urdf(robot.urdf.replace('"tool"', '"probe"'), "bare", actuated=robot.actuated)
    with raises_code("unsupported", "bare", "no frame named tool"):
        calibrate(bare, PoseSet(q, np.zeros((20, 3)), loads=draw_loads(20, 1.0, 11)))


def test_the_written_robot_has_the_springs_of_its_drives(tmp_path: Path):
    """Stiffness 1 / c with its standard error in the file; its maps of stiffness are known."""
    robot, q = draw_positions("delta", 40, 12)
    loads = draw_loads(40, 2.0, 13)
    _, geometry = build_elastic(robot, q, loads)
    theta = set_compliances(geometry, 1e-3)
    poses = simulate_poses(geometry, theta, q, np.random.default_rng(14), noise=NOISE, loads=loads, turned=False)
    found = calibrate(robot, poses, model="frames+elastic", accuracy=NOISE[:1])
    save_calibration(tmp_path / "delta.yaml", found)
    calibrated = load_calibration(tmp_path / "delta.yaml")
    written = calibrated.build_robot()
    assert [s.joint for s in written.drive_springs] == list(robot.actuated)
    for spring in written.drive_springs:
        p = found.fit.parameters[f"{spring.joint}.drive_compliance"]
        assert p.stderr is not None and abs(p.value - 1e-3) < 4 * p.stderr
        assert spring.stiffness == pytest.approx(1 / p.value)
        assert spring.stiffness_stderr == pytest.approx(p.stderr / p.value**2)
    call = [
        "workspace",
        str(tmp_path / "delta.yaml"),
        "--what",
        "stiffness",
        "sag",
        "--rod-stiffness",
        "rigid",
        "--resolution",
        "0.2",
        "--quiet",
    ]
    assert main([*call, "--json", str(tmp_path / "map.json")]) == 0
    assert "stiffness_unknown" not in json.loads((tmp_path / "map.json").read_text())["warning_codes"]
    console = Console(file=StringIO(), width=100)
    print_result(console, found, {})
    printed, page = console.file.getvalue(), build_page(found)  # type: ignore[attr-defined]
    assert "drive" in printed and "stiffness" in printed and printed.count("N m/rad") == 3
    assert "Stiffness of the drives" in page and page.count("N m/rad") >= 3
    softer = calibrated.theta.copy()
    softer[calibrated.geometry.parameters.names.index("arm1.drive_compliance")] *= -1
    with raises_code("unsupported", "arm1.drive_compliance"):
        replace(calibrated, theta=softer).build_robot()


@pytest.mark.parametrize("c", [1.5e-3, 0.0])
def test_a_delta_whose_drives_yield_is_named_by_default(c: float):
    """Under gravity alone the default names drives that yield, and of a stiff Delta none; held-out poses are missed by noise."""
    robot, q = draw_positions("delta", 140, 15)
    _, geometry = build_elastic(robot, q, np.zeros((140, 7)))
    theta, rng = set_compliances(geometry, c), np.random.default_rng(16)
    theta[geometry.parameters.names.index("rod1a.length")] += 5e-4
    poses = simulate_poses(geometry, theta, q, rng, noise=NOISE)
    found = calibrate(robot, poses.take(np.arange(80)), poses.take(np.arange(80, 140)), accuracy=NOISE)
    named = [f for f in found.findings if f.cause == "drive_compliance" and f.status == "confirmed"]
    assert bool(named) == (c > 0)
    assert found.errors(found.chosen).position_size.rms < 1.2 * np.sqrt(3) * NOISE[0]


def test_dimensions_do_not_take_up_further_than_the_file_is_trusted():
    """The test of an addition predicts what its fit gains, where dimensions could take it up 10 mm off the robot file alone."""
    robot, q = draw_positions("delta", 80, 17)
    family, geometry = build_elastic(robot, q, np.zeros((80, 7)))
    theta = set_compliances(geometry, 1.5e-3)
    poses = simulate_poses(geometry, theta, q, np.random.default_rng(18), noise=NOISE)
    plain = fit_spec(family, Spec("complete"), poses, Options())
    hint = screen_additions(plain, family, Spec("complete"))[0]
    with_it = fit_spec(family, Spec("complete", {hint.addition: hint.joints}), poses, Options(), plain)
    before, after = (float(np.sum((f.residuals / plain.sigma) ** 2)) for f in (plain, with_it))
    assert hint.addition == "elastic"
    assert hint.share == pytest.approx(1 - after / before, rel=0.3)


def test_a_stiffness_is_the_inverse_of_its_compliance():
    """`k = 1 / c` with the first-order error `s / c^2` and the inverted interval, in the inverse unit; none of a rigid drive."""
    row = {
        "name": "arm1.drive_compliance",
        "value": 5e-4,
        "stderr": 1e-5,
        "ci95": [4.8e-4, 5.2e-4],
        "unit": "rad/(N m)",
    }
    slide = row | {"name": "cart1.drive_compliance", "unit": "m/N", "ci95": [-1e-5, 1e-3]}
    rigid, other = row | {"value": 0.0}, row | {"name": "arm1.length"}
    turning, sliding = list_stiffness([row, slide, rigid, other])
    assert turning[:3] == ("arm1", pytest.approx(2000.0), pytest.approx(40.0))
    assert turning.ci95 == pytest.approx((1 / 5.2e-4, 1 / 4.8e-4)) and turning.unit == "N m/rad"
    assert sliding.unit == "N/m" and sliding.ci95 == (pytest.approx(1000.0), np.inf)


def test_screens_weigh_what_masses_lean_on_the_file():
    """At a fit's minimum poses pull masses off the file as hard as the file pulls back: no fitted unknown lowers their sum."""
    robot, q = draw_positions("delta", 30, 21)
    loads = draw_loads(30, 2.0, 22)
    family, geometry = build_elastic(robot, q, loads, "frames")
    theta = set_compliances(geometry, 1e-3)
    theta = np.array(
        [0.4 if p.name.endswith("mass_error") else v for p, v in zip(geometry.parameters, theta, strict=True)]
    )
    poses = simulate_poses(geometry, theta, q, np.random.default_rng(23), noise=NOISE, loads=loads, turned=False)
    fitted = fit_spec(family, family.spec("frames+elastic"), poses, Options())
    rest = _ProjectedResidual(fitted)
    left = np.where(fitted.state.ok[:, None], fitted.residuals / fitted.sigma, 0.0)
    assert np.abs(fitted.prior_pulls).max() > 0.3
    assert rest.total == pytest.approx(np.sum(left**2) + np.sum(fitted.prior_pulls**2), rel=1e-4)
    turned = rest.free(np.concatenate([left.ravel(), fitted.prior_pulls]))
    assert np.sum(turned**2) < (1 - 1e-3) * rest.total
