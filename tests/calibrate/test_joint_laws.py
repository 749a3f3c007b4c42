"""What an arm's joints do beside turning as their encoders say: derivatives, statics, names, and what is kept in files."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseErrors, PoseSet, calibrate, load_calibration, save_calibration
from tau_dyn.calibrate.addition_tests import find_unit_coupling
from tau_dyn.calibrate.crossvalidation import compare_paired, split_folds
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.laws import (
    CouplingLaw,
    DisplacedGeometry,
    EccentricityLaw,
    EncoderLaws,
    JointLoading,
    StaticForces,
)
from tau_dyn.calibrate.models import TreeFamily
from tau_dyn.calibrate.simulated import TRACKER, format_csv, simulate_poses
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.cli import main
from tau_dyn.robot import ROUGH_FILE, Robot, load_robot_from_urdf

NOISE = (3e-5, 6e-5)
PLACES = ("0 0 0.4", "0.1 0 0", "0.6 0 0", "0.4 0 0.05")
TURNS = ("0 0 0", "1.5707963267948966 0 0", "0 0 0", "0 1.5707963267948966 0")


@pytest.fixture(scope="module")
def robot() -> Robot:
    """Return a 4R arm with links of 6, 5, 4 and 3 kg."""
    rows = ['<robot name="four"><link name="l0_link"/>']
    for k in range(4):
        rows.append(
            f'<link name="l{k + 1}_link"><inertial><origin xyz="0.2 0.03 0"/><mass value="{6 - k}"/>'
            '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="j{k + 1}" type="revolute"><origin xyz="{PLACES[k]}" rpy="{TURNS[k]}"/><parent link="l{k}_link"/>'
            f'<child link="l{k + 1}_link"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="90"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.1 0.02 0.05"/>')
    return load_robot_from_urdf("".join(rows) + '<parent link="l4_link"/><child link="tool"/></joint></robot>', "four")


def load_joints(robot: Robot) -> JointLoading:
    """Return what loads each joint within 1.5 rad of zero, without known loads at the tool."""
    statics = StaticForces(build_tree_geometry(robot))
    return JointLoading(statics, np.full(4, -1.5), np.full(4, 1.5), np.zeros((1, 7)))


def build_arm(robot: Robot, ratio: float = 1.0) -> DisplacedGeometry:
    """Return the arm with every kind of law."""
    drives = load_joints(robot).build(dict.fromkeys(("j2", "j3"), "gravity_compliance"), load_known=False)
    laws = EncoderLaws((CouplingLaw("j3", 2, "j2", 1, ratio), EccentricityLaw("j4", 3)))
    return DisplacedGeometry(DisplacedGeometry(build_tree_geometry(robot), drives), laws)


def spoil(arm: DisplacedGeometry, seed: int, **given: float) -> np.ndarray:
    """Return parameters 1 mm and 1 mrad off; compliances of 30 urad per N m, an eccentricity of 0.7 mrad."""
    rng = np.random.default_rng(seed)
    theta = arm.parameters.values + 1e-3 * rng.standard_normal(len(arm.parameters)) * arm.parameters.free
    laws = {
        "j2.gravity_compliance": 3e-5,
        "j3.gravity_compliance": 3e-5,
        "j2.load_deflection": 0.0,
        "j3.load_deflection": 0.0,
    }
    laws |= {"j4.eccentricity_sin": 5e-4, "j4.eccentricity_cos": -5e-4, "j3.coupling_j2": 1.0, **given}
    for name, value in laws.items():
        theta[arm.parameters.names.index(name)] = value
    return theta


def test_derivatives_are_those_of_the_poses(robot):
    """Twists per parameter and per encoder are the differences of the poses, with loads and couplings in between."""
    arm = build_arm(robot)
    theta, q = (
        spoil(arm, 1, **{"j2.mass_error": 0.2, "j4.mass_error": -0.3, "base.tilt_x": 0.01}),
        np.random.default_rng(2).uniform(-1, 1, (5, 4)),
    )

    def differ(a, b):
        turn = Rotation.from_matrix(b.rotation @ np.swapaxes(a.rotation, 1, 2)).as_rotvec()
        return np.concatenate([b.position - a.position, turn], axis=1)

    at, h = arm.forward(theta, q).poses, 1e-6
    by_parameter, by_joint = arm.tool_by_parameter(theta, q, at), arm.tool_by_joint(theta, q, at)
    for k in range(len(theta)):
        step = h * np.eye(len(theta))[k]
        found = differ(arm.forward(theta - step, q).poses, arm.forward(theta + step, q).poses) / (2 * h)
        assert by_parameter[:, :, k] == pytest.approx(found, abs=1e-6 * max(1.0, np.abs(found).max())), k
    for k in range(4):
        step = h * np.eye(4)[k]
        found = differ(arm.forward(theta, q - step).poses, arm.forward(theta, q + step).poses) / (2 * h)
        assert by_joint[:, :, k] == pytest.approx(found, abs=1e-7)


def test_a_horizontal_arm_yields_by_its_weight_times_its_lever(robot):
    """All of the arm beyond j2 stretched out weighs on j2 by the sum of mass times distance times gravity."""
    loading = load_joints(robot)
    drives = loading.build({"j2": "gravity_compliance"}, load_known=False)
    names, straight = drives.parameters.names, np.zeros((1, 4))
    masses, load = 9.81 * (5 * 0.2 + 4 * 0.8 + 3 * (1.0 + 0.0)), 9.81 * (1.0 + 0.05)

    def sink(**errors: float) -> list[float]:
        values = np.zeros(len(names))
        for name, value in errors.items():
            values[names.index(f"{name}.mass_error")] = value
        return drives.move(values, straight, None).by_parameter[0, 1, :2].tolist()

    assert names == ("j2.gravity_compliance", "j2.load_deflection", "j2.mass_error", "j3.mass_error", "j4.mass_error",
                     "base.tilt_x", "base.tilt_y")  # fmt: skip
    assert sink() == pytest.approx([-masses, -load], rel=1e-9)  # gravity pulls the way that the drive holds against
    assert [p.unit for p in drives.parameters][:2] == ["rad/(N m)", "rad kg/(N m)"]
    assert sink(j4=-0.5) == pytest.approx([-masses + 0.5 * 9.81 * 3 * 1.0, -load], rel=1e-9)
    assert "j1" not in loading.list_carrying()  # its axis is vertical


def measure(arm: DisplacedGeometry, theta: np.ndarray, n: int, seed: int) -> PoseSet:
    """Return measured poses of the arm."""
    rng = np.random.default_rng(seed)
    return simulate_poses(arm, theta, rng.uniform(-1.4, 1.4, (n, 4)), rng, noise=NOISE, turned=True, frames=TRACKER)


def test_couplings_loads_and_eccentricity_are_named_with_their_size(robot, tmp_path):
    """The default names the three causes that are there and no other, and the saved model predicts as the fitted one does."""
    arm = build_arm(robot, -1.0)
    theta = spoil(arm, 3, **{"j3.coupling_j2": -1.0})
    found = calibrate(robot, measure(arm, theta, 160, 4), accuracy=NOISE)
    said = {(f.cause, *f.joints) for f in found.findings if f.status == "confirmed"} - {("joint_placement",)}
    wanted = {("joint_coupling", "j3", "j2"), ("gravity_deflection", "j2"), ("gravity_deflection", "j3")}
    assert said == wanted | {("joint_eccentricity", "j4")}
    alike = {f.joints: f.indistinguishable_from for f in found.findings if f.cause == "joint_eccentricity"}
    assert alike == {("j4",): ("gravity_deflection",)}  # j4 leans, and its own link's weight goes round with it
    for name in ("j3.coupling_j2", "j4.eccentricity_sin"):
        p = found.fit.parameters[name]
        assert p.stderr is not None and abs(p.value - theta[arm.parameters.names.index(name)]) < 4 * p.stderr
    assert any("j3 seems to count the motion of j2 too (j3 - j2)" in w for w in found.warnings)
    assert found.errors(found.chosen).position_size.rms < 1.3 * np.sqrt(3) * NOISE[0]
    save_calibration(tmp_path / "arm.yaml", found)
    q = np.random.default_rng(5).uniform(-1, 1, (4, 4))
    kept = load_calibration(tmp_path / "arm.yaml").forward(q).poses
    assert kept.position == pytest.approx(found.fit.geometry.forward(found.fit.theta, q).poses.position, abs=1e-12)


def test_masses_off_the_file_and_a_tilted_base_are_within_the_intervals(robot):
    """Masses 20 % off and a base 10 mrad off level are covered as unknowns with a prior; taken as none they spoil the poses."""
    arm = build_arm(robot)
    masses = {
        "j2.mass_error": 0.2,
        "j3.mass_error": -0.2,
        "j4.mass_error": 0.2,
        "j2.gravity_compliance": 1e-4,
        "base.tilt_y": 0.01,
    }
    theta, rng = spoil(arm, 17, **masses), np.random.default_rng(18)
    poses, model = measure(arm, theta, 120, 19), "complete+gravity:j2,j3+eccentric:j4+coupling:j3=j2"
    q = rng.uniform(-1.4, 1.4, (60, 4))
    truth = TRACKER.measured(arm.forward(theta, q).poses, np.zeros((60, 2), int)).position
    missed, errors = [], []
    for fix in ((), ("*.mass_error", "base.tilt_*")):
        fitted = calibrate(robot, poses, model=model, fix=fix).fit
        seen = fitted.frames.measured(fitted.geometry.forward(fitted.theta, q).poses, np.zeros((60, 2), int)).position
        errors.append(np.sqrt(np.mean(np.sum((seen - truth) ** 2, axis=1))))
        missed.append(np.sqrt(np.mean(np.sum((seen - truth) ** 2, axis=1) / fitted.model_error(q) ** 2)))
        compliance = fitted.parameters["j2.gravity_compliance"]
        true = theta[arm.parameters.names.index(compliance.name)]
        assert compliance.stderr is not None
        if not fix:  # poses tell the torques' shape, no scale: that of a compliance is as sure as the masses
            assert 0.05 < compliance.stderr / true < ROUGH_FILE and abs(compliance.value - true) < 3 * compliance.stderr
    assert missed[0] < 1.4 and errors[1] > 2 * errors[0]


def test_a_plain_arm_has_no_laws(robot):
    """An arm with wrong dimensions alone gets no coupling, no deflection and no eccentricity."""
    arm = build_tree_geometry(robot)
    rng = np.random.default_rng(6)
    theta = arm.parameters.values + 1e-3 * rng.standard_normal(len(arm.parameters)) * arm.parameters.free
    q = rng.uniform(-1.4, 1.4, (120, 4))
    poses = simulate_poses(arm, theta, q, rng, noise=NOISE, turned=True)
    found = calibrate(robot, poses, accuracy=NOISE)
    assert {f.cause for f in found.findings} <= {"joint_placement"} and found.chosen.name == "complete"
    assert find_unit_coupling(TreeFamily(robot, poses), poses) is None


def test_a_coupling_is_offered_where_the_model_is_given(robot):
    """With a model of one's own choice the coupling is said, with the model that has it; it is not added."""
    arm = build_arm(robot)
    found = calibrate(robot, measure(arm, spoil(arm, 7), 60, 8), model="frames")
    assert any("frames+coupling:j3=j2" in w for w in found.warnings) and found.chosen.name == "frames"


def test_a_tight_prior_holds_what_poses_hardly_tell(robot):
    """With three times the noise-free minimum of poses a prior of 10 um keeps dimensions near the file's; 10 mm lets them go."""
    arm = build_tree_geometry(robot)
    rng = np.random.default_rng(11)
    poses = simulate_poses(arm, arm.parameters.values, rng.uniform(-1, 1, (20, 4)), rng, noise=(1e-3, 1e-3))
    off = []
    for prior in ((1e-5, 1e-5), ()):
        fitted = calibrate(robot, poses, model="complete", prior=prior).fit
        off.append(np.abs(fitted.theta - arm.parameters.values).max())
    assert off[0] < 3e-5 < 1e-4 < off[1]
    with raises_code("invalid_value", "above zero"):
        calibrate(robot, poses, prior=(0.0,))


def test_names_of_models_are_checked(robot):
    """A joint that the robot has not, or a coupling without its joints, ends with a sentence."""
    family = TreeFamily(robot, PoseSet(np.array([[-1.0] * 4, [1.0] * 4]), np.zeros((2, 3))))
    spec = family.spec("complete+gravity:j2+coupling:j3=-j2")
    assert spec.additions == {"gravity": ("j2",), "coupling": ("j3=-j2",)}
    with raises_code("unknown_name", "j9"):
        family.spec("complete+eccentric:j9")
    with raises_code("unknown_name", "j1"):
        family.spec("complete+gravity:j1")
    with raises_code("bad_option", "coupling"):
        family.spec("coupling")
    with raises_code("unknown_name", "periodic"):
        family.spec("complete+periodic")


def test_a_saved_calibration_is_a_robot(robot, tmp_path):
    """The file of a calibrated arm is a robot like any other, its tool where the fit has it; laws of joints are refused."""
    arm = build_tree_geometry(robot)
    rng = np.random.default_rng(12)
    theta = arm.parameters.values + 1e-3 * rng.standard_normal(len(arm.parameters)) * arm.parameters.free
    poses = simulate_poses(arm, theta, rng.uniform(-1.4, 1.4, (60, 4)), rng, noise=NOISE, turned=True)
    (tmp_path / "poses.csv").write_text(format_csv(poses, arm.actuated))
    (tmp_path / "arm.urdf").write_text(robot.urdf)
    calibrated, q = tmp_path / "arm.yaml", ["--q", "0.3", "-0.4", "0.5", "0.2"]
    call = ["calibrate", str(tmp_path / "arm.urdf"), str(tmp_path / "poses.csv"), "--out", str(calibrated), "--quiet"]
    assert main(call) == 0 and main(["fk", str(calibrated), *q, "--json", str(tmp_path / "fk.json"), "--quiet"]) == 0
    found = load_calibration(calibrated)
    there = found.forward(np.array([[0.3, -0.4, 0.5, 0.2]])).poses.position[0]
    assert json.loads((tmp_path / "fk.json").read_text())["rows"][0]["position"] == pytest.approx(list(there), abs=1e-9)
    with raises_code("unsupported", "laws of its joints"):
        replace(found, geometry=build_arm(robot), theta=build_arm(robot).parameters.values).build_robot()
    (tmp_path / "other.yaml").write_text("format: model\n")
    assert main(["fk", str(tmp_path / "other.yaml"), *q, "--quiet"]) == 2


@pytest.mark.parametrize(("owner", "size"), [("device", 1e-3), ("target", 1e-3), ("device", 0.0), ("device", 0.4)])
def test_a_move_before_the_held_out_poses_is_named(robot, owner: str, size: float):
    """A device or a target moved by a millimetre, or by far, is told apart by the poses; frames at rest are not accused."""
    arm = build_tree_geometry(robot)
    rng = np.random.default_rng(9)
    theta = arm.parameters.values + 1e-3 * rng.standard_normal(len(arm.parameters)) * arm.parameters.free
    shift = size * np.array([0.0, 0.6, 0.8])

    def shifted(frame: Frame) -> Frame:
        turn = Rotation.from_rotvec([0, 2 * size, 0]).as_matrix()
        return Frame(turn @ frame.rotation, frame.translation + shift)

    device, tool = TRACKER.device[0], TRACKER.tool[0]
    later = (
        DeviceFrames((shifted(device),), (tool,)) if owner == "device" else DeviceFrames((device,), (shifted(tool),))
    )
    train, held = (
        simulate_poses(arm, theta, rng.uniform(-1.4, 1.4, (n, 4)), rng, noise=NOISE, turned=True, frames=frames)
        for n, frames in ((80, TRACKER), (30, later))
    )
    found = calibrate(robot, train, held, accuracy=NOISE)
    moved = [f for f in found.findings if f.cause in ("device_moved", "target_moved")]
    if not size:
        assert not moved
        return
    (finding,) = moved
    assert (finding.cause, finding.status) == (f"{owner}_moved", "confirmed")
    values = [p.value for p in finding.parameters[:3]]
    assert values == pytest.approx(
        list(shift), abs=1e-4 + 5e-3 * size
    )  # a turn moves the 1 mm by which frames are free
    others = {f.status for f in found.findings if f.cause == "joint_placement"}
    assert others == {"confirmed"}  # judged with the move undone, as it would hide them
    rows = finding.to_dict()["parameters"]
    assert isinstance(rows, list) and rows[0]["name"] == f"{owner}_moved.x"


def test_targets_seen_from_one_configuration_are_held_out_together(robot):
    """Three targets a pose: a coupling stands out in spite of their places; held-out poses share no joints with the others."""
    arm = build_arm(robot)
    rng = np.random.default_rng(13)
    seats = tuple(Frame(np.eye(3), at) for at in np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.25, 0.1]]))
    q, target = np.repeat(rng.uniform(-1.4, 1.4, (40, 4)), 3, axis=0), np.arange(120) % 3
    frames = DeviceFrames(TRACKER.device, seats)
    poses = simulate_poses(arm, spoil(arm, 14), q, rng, noise=NOISE, turned=False, frames=frames, target=target)
    assert list(np.diff(poses.configuration[:7]) == 0) == [True, True, False, True, True, False]
    found = calibrate(robot, poses, accuracy=NOISE[:1])
    assert found.holdout is not None and found.holdout.n == 30
    assert not {tuple(row) for row in found.poses.q} & {tuple(row) for row in found.holdout.q}
    assert all(len(np.intersect1d(*pair)) == 0 for pair in combinations(split_folds(poses.configuration, 0), 2))
    assert ("joint_coupling", ("j3", "j2"), "confirmed") in {(f.cause, f.joints, f.status) for f in found.findings}
    assert found.errors(found.chosen).position_size.rms < 1.5 * np.sqrt(3) * NOISE[0]


def test_a_robot_that_misses_its_poses_confirms_nothing(robot):
    """Poses of an arm with a forearm 0.2 m longer: whatever lowers the error a little is not the cause."""
    longer = load_robot_from_urdf(robot.urdf.replace('xyz="0.6 0 0"', 'xyz="0.8 0 0"'), "longer")
    arm = build_tree_geometry(longer)
    rng = np.random.default_rng(15)
    poses = simulate_poses(arm, arm.parameters.values, rng.uniform(-1.4, 1.4, (60, 4)), rng, noise=NOISE, turned=False)
    found = calibrate(robot, poses, fix=["*.origin_*"])
    assert found.misses_poses and not any(f.status == "confirmed" for f in found.findings)


def test_targets_of_one_configuration_are_no_independent_evidence():
    """A gain seen at eight configurations is as sure with five targets at each as with one."""
    rng = np.random.default_rng(16)
    small, large = 1 + 0.3 * rng.random((8, 3)), 1 + 0.3 * rng.random((8, 3)) - 0.2
    one = compare_paired(*(PoseErrors(x, None) for x in (small, large)))
    many = [PoseErrors(np.repeat(x, 5, axis=0), None, None, np.repeat(np.arange(8), 5)) for x in (small, large)]
    assert compare_paired(*many).p_value == pytest.approx(one.p_value) and one.p_value > 1e-3
    assert compare_paired(*many).ci95 == pytest.approx(one.ci95)
    apart = [replace(x, configuration=None) for x in many]
    assert compare_paired(*apart).p_value < 0.01 * one.p_value
