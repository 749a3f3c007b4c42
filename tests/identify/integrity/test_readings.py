"""Readings of a log: forces that lack a part, scales as numbers, motor-side columns, vetoes, and advice that was tried."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import pytest

from tau_dyn.evidence import ReadingFit, ReadingTest
from tau_dyn.identify import build_model, check_against_robot
from tau_dyn.identify.integrity.excerpt import Records, make_excerpt
from tau_dyn.identify.integrity.reading_fit import LogModel
from tau_dyn.identify.integrity.wiring import UNDETERMINED, Fault, Mend, Search, _describe
from tau_dyn.identify.integrity.wiring_alternatives import Rewiring
from tau_dyn.identify.integrity.wiring_numbers import try_units
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion

JOINTS = ("shoulder", "elbow")


@pytest.fixture
def arm_log(two_link, make) -> Log:
    """Twenty seconds of two rods in a vertical plane, with velocities from a tachometer."""
    truth = build_model(two_link, "symmetric")
    truth = truth.with_values(dict.fromkeys(truth.effect_parameters.names, 0.5))
    log = make.recorded(truth, build_named_motion("fourier", truth, 20.0, 1), force_noise=0.02, encoder_noise=1e-6)
    v = (
        np.gradient(log.joint("q", JOINTS), log.dt, axis=0)
        + np.random.default_rng(0).normal(size=(log.n_samples, 2)) * 1e-3
    )
    return log.with_channels(**{f"v_{j}": v[:, k] for k, j in enumerate(JOINTS)})


def none_fit() -> ReadingFit:
    """Return a fit without a residual."""
    return ReadingFit(0.0, 0.0, np.zeros(2), 0.0, np.zeros((1, 2)))


def less(log: Log, forces: np.ndarray, joints: tuple[str, ...] = JOINTS) -> Log:
    """Return a log with forces (n, na) subtracted."""
    return log.with_channels(**{f"tau_{j}": log.channels[f"tau_{j}"] - forces[:, k] for k, j in enumerate(joints)})


def compute_nominal(robot, log: Log, moving: float) -> np.ndarray:
    """Return the file's rigid-body force (n, na) at the logged positions, at rest or in motion."""
    q = log.joint("q", robot.actuated)
    v = moving * np.gradient(q, log.dt, axis=0)
    return build_mechanism(robot).inverse_dynamics(q, v, moving * np.gradient(v, log.dt, axis=0))


def read_map(warnings) -> dict[str, float]:
    """Return the scales of the advised column map."""
    lines = re.findall(r"`(\w+): \{column: \w+, scale: ([-\d.e]+)\}`", " ".join(warnings))
    assert len({name for name, _ in lines}) == len(lines)  # one line a column
    return {name: float(scale) for name, scale in lines}


def test_noise_of_a_residual_is_its_white_part(two_link, arm_log) -> None:
    """White noise counts whole, an error with eight samples a period hardly, and samples at a gap not at all."""
    excerpt = make_excerpt(two_link, [arm_log])
    assert excerpt is not None
    model = LogModel.of(two_link, excerpt, np.zeros(2))
    n = len(model.q)
    white, slow = np.random.default_rng(0).normal(size=n), np.sin(2 * np.pi * np.arange(n) / 8)
    fit = model.fit(Rewiring.none(2))
    assert fit is not None
    noise = model.estimate_noise(replace(fit, residual=np.stack([white, slow], axis=1)))
    assert noise[0] == pytest.approx(1.0, rel=0.15) and noise[1] < 0.02


def test_forces_without_gravity_are_named(two_link, arm_log) -> None:
    """Zero first moments explain them too, and the file's bodies say otherwise."""
    assert check_against_robot(two_link, [arm_log]) == []
    found = check_against_robot(two_link, [less(arm_log, compute_nominal(two_link, arm_log, 0.0))])
    assert {get_code(w) for w in found} <= {
        "gravity_subtracted",
        "gravity_direction",
    }  # a level plane has no gravity either
    assert "the forces of all joints lack gravity" in " ".join(found)


def test_forces_without_the_bodies_are_named(two_link, arm_log) -> None:
    """Only friction is left of forces from which a controller subtracted its model."""
    found = check_against_robot(two_link, [less(arm_log, compute_nominal(two_link, arm_log, 1.0))])
    assert "model_subtracted" in {get_code(w) for w in found}


def build_light_forearm() -> Robot:
    """Return two rods in a vertical plane, 0.4 and 0.3 m long, of 3 and 0.4 kg."""
    parts = ['<robot name="rods"><link name="base_link"/>']
    for name, joint, parent, at, mass, length in (
        ("upper_link", "shoulder", "base_link", 0.0, 3.0, 0.4),
        ("lower_link", "elbow", "upper_link", 0.4, 0.4, 0.3),
    ):
        across = mass * length**2 / 12
        parts.append(
            f'<link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/><inertia ixx="1e-4" ixy="0" '
            f'ixz="0" iyy="{across}" iyz="0" izz="{across}"/></inertial></link><joint name="{joint}" type="revolute"><origin '
            f'xyz="{at} 0 0"/><parent link="{parent}"/><child link="{name}"/><axis xyz="0 1 0"/>'
            '<limit lower="-3" upper="3" velocity="5" effort="90"/></joint>'
        )
    return load_robot_from_urdf("".join(parts) + "</robot>", "rods")


def test_a_subtracted_model_may_carry_a_payload_that_is_not_there(make) -> None:
    """The controller expects a gripper: what is left is a negative mass, which no spring imitates, and friction."""
    robot = build_light_forearm()
    truth = build_model(robot, "symmetric")
    truth = truth.with_values(dict.fromkeys(truth.effect_parameters.names, 0.5))
    log = make.recorded(truth, build_named_motion("fourier", truth, 20.0, 1), force_noise=0.02, encoder_noise=1e-6)
    loaded = robot.model.copy()
    gripper = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.0]))
    loaded.appendBodyToJoint(loaded.getJointId("elbow"), pin.Inertia(0.4, np.zeros(3), 1e-4 * np.eye(3)), gripper)
    data, q = loaded.createData(), log.joint("q", JOINTS)
    v = np.gradient(q, log.dt, axis=0)
    rows = zip(q, v, np.gradient(v, log.dt, axis=0), strict=True)
    expected = np.array([pin.rnea(loaded, data, *row) for row in rows])
    found = check_against_robot(robot, [less(log, expected)])
    assert "model_subtracted" in {get_code(w) for w in found}


@pytest.mark.parametrize("joints", [("shoulder", "elbow"), ("shoulder",)])
def test_a_removed_mean_is_named_at_its_joints(two_link, arm_log, joints: tuple[str, ...]) -> None:
    """A force of mean zero contradicts a mean of gravity, in all joints or in one."""
    means = np.array([arm_log.channels[f"tau_{j}"].mean() if j in joints else 0.0 for j in JOINTS])
    (warning,) = check_against_robot(two_link, [less(arm_log, np.broadcast_to(means, (arm_log.n_samples, 2)))])
    assert get_code(warning) == "mean_removed" and ("all joints" in warning) is (len(joints) == 2)


def test_an_offset_larger_than_friction_is_no_reversed_sign(two_link, arm_log) -> None:
    """A current sensor's offset adds to forward and takes from backward friction; their sum stays."""
    assert check_against_robot(two_link, [less(arm_log, np.full((arm_log.n_samples, 2), [2.0, -1.5]))]) == []


def test_a_half_balanced_arm_is_sound(two_link, arm_log) -> None:
    """A spring that carries 60 % of a joint's gravity is no controller that subtracts it."""
    gravity = compute_nominal(two_link, arm_log, 0.0) * [0.6, 0.0]
    assert "gravity_subtracted" not in {get_code(w) for w in check_against_robot(two_link, [less(arm_log, gravity)])}


def test_torque_constants_are_estimated_joint_by_joint(two_link, arm_log) -> None:
    """Currents of two motors have two factors, each with its standard error, and none is rounded to a power of ten."""
    factors = {"tau_shoulder": 12.6, "tau_elbow": 9.3}
    log = arm_log.with_channels(**{name: arm_log.channels[name] / x for name, x in factors.items()})
    found = read_map(check_against_robot(two_link, [log]))
    assert set(found) == set(factors)
    assert all(found[name] == pytest.approx(x, rel=0.1) for name, x in factors.items())


def test_motor_side_columns_are_one_number_a_joint(two_link, arm_log) -> None:
    """Position times N and force over N are one gear, of either sign."""
    ratios = {"shoulder": 101.0, "elbow": -51.0}
    changed = {f"q_{j}": n * arm_log.channels[f"q_{j}"] for j, n in ratios.items()}
    changed |= {f"tau_{j}": arm_log.channels[f"tau_{j}"] / n for j, n in ratios.items()}
    log = Log(arm_log.t, changed, "motor.csv")
    found = read_map(check_against_robot(two_link, [log]))
    for j, n in ratios.items():
        assert found[f"q_{j}"] == pytest.approx(1 / n, rel=0.1) and found[f"tau_{j}"] == pytest.approx(n, rel=0.1)


def test_positions_beyond_the_limits_do_not_show_that_forces_lack_a_part(two_link, arm_log) -> None:
    """Forces of the bodies follow from positions; the reading that a controller subtracted them needs possible positions."""
    log = less(arm_log, compute_nominal(two_link, arm_log, 1.0))
    for factor in (1.0, 80.0):
        moved = Log(log.t, dict(log.channels) | {"q_elbow": factor * log.channels["q_elbow"]}, "friction.csv")
        excerpt = make_excerpt(two_link, [moved])
        assert excerpt is not None
        search = Search(LogModel.of(two_link, excerpt, np.zeros(2)), Records.of(two_link, excerpt))
        plain = Rewiring.none(2)
        found = search.find_best(plain, search.model.fit(plain))
        assert any(fault.reading.lacks for fault in found) is (factor == 1.0)


def test_a_force_scale_is_found_next_to_positions_in_another_unit(two_link, arm_log) -> None:
    """One joint in degrees and the other's force a tenth: neither reading alone fits, both together do."""
    plain = {name: arm_log.channels[name] for name in ("q_shoulder", "tau_elbow")}
    changed = {
        "q_elbow": np.degrees(arm_log.channels["q_elbow"]),
        "tau_shoulder": arm_log.channels["tau_shoulder"] / 10,
    }
    scales = read_map(check_against_robot(two_link, [Log(arm_log.t, plain | changed, "two.csv")]))
    assert scales["q_elbow"] == pytest.approx(np.pi / 180, rel=0.01) and scales["tau_shoulder"] == pytest.approx(
        10, rel=0.15
    )


def test_a_reading_that_does_not_mend_the_log_is_not_a_fact(two_link) -> None:
    """The log read in the nearest way fails the test again: the sentence says that no reading agrees."""
    none = Rewiring.none(2)
    fault = Fault(replace(none, code="sign_reversed", words="the force of elbow has the wrong sign"), None, none_fit())
    told = {
        why: _describe(two_link, "a.csv", [fault], Mend(none, {}, why))[0] for why in ("", UNDETERMINED, "it fails")
    }
    assert "no reading of them agrees. The nearest is that the force of elbow" in told["it fails"]
    assert all("no reading" not in told[why] for why in ("", UNDETERMINED))


def test_an_estimate_consistent_with_degrees_is_rounded_to_them(two_link, arm_log) -> None:
    """57.3 within its standard error is a unit."""
    turned = {f"q_{j}": np.degrees(arm_log.channels[f"q_{j}"]) for j in JOINTS}
    log = Log(arm_log.t, turned | {f"tau_{j}": arm_log.channels[f"tau_{j}"] for j in JOINTS}, "degrees.csv")
    found = read_map(check_against_robot(two_link, [log]))
    assert all(found[f"q_{j}"] == pytest.approx(np.pi / 180, rel=1e-4) for j in JOINTS)


@dataclass(frozen=True)
class KnownPowers:
    """Fits of a robot with forces of 10 N m whose residual power is known for each reading's words."""

    test: ReadingTest
    power: dict[str, float]

    def fit(self, reading: Rewiring) -> ReadingFit:
        """Return the fit with the likelihood of 200 samples."""
        power = np.full(2, self.power[reading.words])
        log_p = -200.0 * np.log(np.maximum(power, self.test.floor)).sum() / 2 - (reading.words == "true") * 10.0
        return ReadingFit(log_p, log_p, power, 0.0, np.zeros((1, 2)))


def test_the_least_residual_decides_between_readings_below_the_usual_model_error() -> None:
    """Two readings fit to 4 and to 0.5 % of a force; the second is true although its number costs some likelihood."""
    model = KnownPowers(ReadingTest(np.full(2, 10.0), 0.05), {"wrong": 0.16, "true": 0.0025})
    readings = [replace(Rewiring.none(2), code=words, words=words) for words in model.power]
    faults = [Fault(reading, None, model.fit(reading)) for reading in readings]
    assert faults[0].after.log_p > faults[1].after.log_p
    search = Search(model, None)  # type: ignore[arg-type]
    assert [fault.reading.words for fault in search._list_equivalent(faults)] == ["true"]


def test_a_recorded_velocity_decides_about_the_clock(two_link, arm_log) -> None:
    """A clock at half speed contradicts velocities from a tachometer; velocities in the clock's own time veto the clock."""
    slow = Log(2 * arm_log.t, arm_log.channels, "slow.csv")
    (warning,) = check_against_robot(two_link, [slow])
    assert get_code(warning) == "scale_wrong" and "the clock runs" in warning
    agreeing = slow.with_channels(**{f"v_{j}": arm_log.channels[f"v_{j}"] / 2 for j in JOINTS})
    assert not any("the clock runs" in w for w in check_against_robot(two_link, [agreeing]))


def test_placeholder_bodies_accuse_no_force(make) -> None:
    """A file with one invented sphere for all links says nothing about the size of a wrist's torque, or about gravity."""
    body = '<inertial><mass value="{m}"/><inertia ixx="{i}" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial>'
    arm = """<robot name="arm"><link name="base"/>{links}
    <joint name="yaw" type="revolute"><parent link="base"/><child link="column"/><axis xyz="0 0 1"/>{limit}</joint>
    <joint name="lift" type="revolute"><parent link="column"/><child link="boom"/><axis xyz="0 1 0"/>{limit}</joint>
    <joint name="roll" type="revolute"><parent link="boom"/><child link="hand"/><origin xyz="0.4 0 0"/><axis xyz="1 0 0"/>
    {limit}</joint></robot>"""
    limit = '<limit lower="-2" upper="2" velocity="3" effort="50"/>'

    def build(*bodies: tuple[float, float]) -> Robot:
        names = ("column", "boom", "hand")
        links = [f'<link name="{n}">{body.format(m=m, i=i)}</link>' for n, (m, i) in zip(names, bodies, strict=True)]
        return load_robot_from_urdf(arm.format(links="".join(links), limit=limit), "arm")

    truth = build_model(build((2.0, 0.02), (1.5, 0.03), (0.3, 2e-5)), "symmetric")
    friction = {"yaw": 0.2, "lift": 0.3, "roll": 0.002}
    truth = truth.with_values({n: friction[n.partition(".")[0]] for n in truth.effect_parameters.names})
    log = make.recorded(truth, build_named_motion("fourier", truth, 20.0, 1), force_noise=1e-4, encoder_noise=1e-6)
    spring = 4e-3 * np.sin(log.joint("q", ("roll",))[:, 0])
    log = log.with_channels(tau_roll=log.channels["tau_roll"] + spring)
    assert check_against_robot(build(*[(0.5, 1e-3)] * 3), [log]) == []
    assert {get_code(w) for w in check_against_robot(build((0.5, 1e-3), (0.5, 1.1e-3), (0.5, 1.2e-3)), [log])}


def test_a_unit_is_preferred_to_a_factor_next_to_it(two_link, arm_log) -> None:
    """Degrees leave less of the forces than 45 and 70 counts a radian, at which a search for two factors may end."""
    log = arm_log.with_channels(**{f"q_{j}": np.degrees(arm_log.channels[f"q_{j}"]) for j in JOINTS})
    excerpt = make_excerpt(two_link, [log])
    assert excerpt is not None
    model = LogModel.of(two_link, excerpt, np.zeros(2))
    reading = (
        replace(Rewiring.none(2), numbers=(("q", (0,)), ("q", (1,)))).times(("q", (0,)), 45.0).times(("q", (1,)), 70.0)
    )
    found = try_units(model.bare(model.test), reading)
    assert [found.get(number) for number in found.numbers] == pytest.approx([180 / np.pi] * 2)
    assert try_units(model.bare(model.test), found) == found


def test_a_zero_of_a_joint_is_no_subtracted_model(make) -> None:
    """A cart's encoder 18 mm off makes bodies far from the file's; a subtracted model explains it less than the zero."""
    robot = load_robot("gantry_tau", prototype="l1")
    truth = build_model(robot, "symmetric")
    values = {"coulomb": 20.0, "viscous": 30.0, "offset": 0.0}
    truth = truth.with_values({name: values[name.split(".")[1]] for name in truth.effect_parameters.names})
    log = make.recorded(truth, build_named_motion("fourier", truth, 30.0, 1), force_noise=5.0, encoder_noise=2e-6)
    shifted = log.with_channels(q_cart2=log.channels["q_cart2"] - 0.018)
    assert "model_subtracted" not in {get_code(w) for w in check_against_robot(robot, [shifted])}
    subtracted = less(log, compute_nominal(robot, log, 1.0), robot.actuated)
    assert "model_subtracted" in {get_code(w) for w in check_against_robot(robot, [subtracted])}
