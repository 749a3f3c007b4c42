"""Feedforward: the model's force away from standstill, no jump through it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control import Feedforward
from tau_dyn.effects import EFFECTS, ReducerCoupling, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def model() -> Model:
    """The L1 with asymmetric friction."""
    robot = load_robot("gantry_tau")
    plain = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    sizes = {"coulomb_pos": 90.0, "coulomb_neg": 70.0, "viscous_pos": 130.0, "viscous_neg": 110.0}
    return plain.with_values({f"{j}.{k}": x for j in robot.actuated for k, x in sizes.items()})


def at(model: Model, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.tile(model.robot.home, (len(v), 1)), v, np.zeros_like(v)


def test_ramp_is_the_identified_law_outside_the_width(model, rng) -> None:
    """Beyond the width feedforward equals the model's force exactly; tanh comes within 4 % of Coulomb at one width."""
    v = rng.choice([-1, 1], (30, 3)) * rng.uniform(0.011, 0.5, (30, 3))
    q, v, a = at(model, v)
    assert_allclose(Feedforward(model, width=0.01)(q, v, a), model.torque(q, v, a), rtol=1e-14)
    tanh = Feedforward(model, width=0.01, shape="tanh")
    assert_allclose(tanh.smooth_sign(np.array([[0.01, -0.005, 0.0]])), [[np.tanh(2), -np.tanh(1), 0]])
    assert np.abs(tanh(q, v, a) - model.torque(q, v, a)).max() < 0.04 * 90
    far = np.full((1, 3), 0.2)
    assert_allclose(tanh(*at(model, far)), model.torque(*at(model, far)), rtol=1e-12)


def test_ramp_is_piecewise_linear(model) -> None:
    """Within the width, one a joint, friction is a straight line from law to law (Dressler 2012, Figure 3.6)."""
    feedforward = Feedforward(model, width=np.array([0.01, 0.02, 0.04]))
    sign = feedforward.smooth_sign(np.array([[0.005, 0.005, 0.005], [-0.02, -0.02, -0.02], [0.0, 0.1, -0.1]]))
    assert_allclose(sign, [[0.5, 0.25, 0.125], [-1, -1, -0.5], [0, 1, -1]])
    share = np.linspace(-1, 1, 21)[:, None]
    q, v, a = at(model, share * feedforward.width)
    friction = feedforward(q, v, a) - model.mechanism.inverse_dynamics(q, v, a)
    assert_allclose(friction, friction[0] + (1 + share) / 2 * (friction[-1] - friction[0]), atol=1e-9)


@pytest.mark.parametrize("shape", ["ramp", "tanh"])
def test_force_is_continuous_through_standstill_and_friction_never_overdone(model, shape: str) -> None:
    """No jump for a drive to chatter on; inside the width the friction lies between the two directions' laws."""
    speeds = np.linspace(-0.03, 0.03, 601)
    q, v, a = at(model, np.repeat(speeds[:, None], 3, axis=1))
    force = Feedforward(model, width=0.01, shape=shape)(q, v, a)
    # tanh is steepest: 2 / w, times half of the 160 N from law to law; twice that, for the viscous share
    steepest = 2 * 160 / 0.01 * (speeds[1] - speeds[0])
    assert np.abs(np.diff(force, axis=0)).max() < steepest
    friction = force - model.mechanism.inverse_dynamics(q, v, a)
    assert np.all(friction <= 90 + 130 * np.abs(v) + 1e-9) and np.all(friction >= -70 - 110 * np.abs(v) - 1e-9)
    at_rest = (90 - 70) / 2 + ((130 - 110) * 0.01 / 2 if shape == "ramp" else 0.0)  # the mean of both directions
    assert_allclose(friction[300], at_rest, atol=1e-9)


def test_an_array_is_its_samples(model, rng) -> None:
    """Many samples at once equal one by one, in the shape given."""
    q, v, a = at(model, rng.standard_normal((5, 3)))
    feedforward = Feedforward(model)
    one_by_one = [feedforward(*x) for x in zip(q, v, a, strict=True)]
    assert one_by_one[0].shape == (3,)
    assert_allclose(feedforward(q, v, a), one_by_one, rtol=1e-14)


@pytest.mark.parametrize(
    "shapes", [((2,), (2,), (2,)), ((3,), (1, 3), (3,)), ((4, 3), (4, 3), (1, 3)), ((1, 4, 3),) * 3, ((),) * 3]
)
def test_wrong_shapes_are_refused(model, shapes) -> None:
    """Broadcasting in silence would send one joint's force to another."""
    with raises_code("wrong_shape", "3", "cart1", "cart2", "cart3"):
        Feedforward(model)(*(np.zeros(s) for s in shapes))


@pytest.mark.parametrize("width", [0.0, -0.01, np.nan, np.inf])
def test_widths_must_be_speeds(model, width: float) -> None:
    """A width of zero is the jump we avoid."""
    with raises_code("invalid_value"):
        Feedforward(model, width=width)


def test_unknown_shapes_and_wrong_numbers_of_widths_are_refused(model) -> None:
    """The shapes there are are listed; two widths do not fit three joints."""
    with raises_code("unknown_name"):
        Feedforward(model, shape="step")
    with raises_code("wrong_shape", "width"):
        Feedforward(model, width=np.array([0.01, 0.02]))


def test_it_loads_what_identify_wrote(model, rng, tmp_path) -> None:
    """A model file on disk gives the same forces, without the xacro it came from."""
    model.save(tmp_path / "l1.yaml")
    q, v, a = at(model, rng.standard_normal((5, 3)))
    loaded = Feedforward.load(tmp_path / "l1.yaml", width=0.02)
    assert_allclose(loaded(q, v, a), Feedforward(model, width=0.02)(q, v, a), rtol=1e-13)


def test_joints_that_share_a_motor_keep_their_law_outside_the_width(two_link) -> None:
    """A coupling's force follows the summed speed; clamping each joint's speed would change it far from standstill."""
    coupling = ReducerCoupling(two_link.actuated, two_link.force_units)
    model = Model.of(two_link, [coupling])
    values = dict(zip(coupling.parameters.names, (0.1, 5.0, 7.0), strict=True))
    model = model.with_values(values)
    q, v, a = np.zeros((1, 2)), np.array([[1.0, -0.6]]), np.zeros((1, 2))
    assert_allclose(Feedforward(model, width=0.01)(q, v, a), model.torque(q, v, a), rtol=1e-12)


SIZES = {
    "coulomb_asymmetry": 20.0, "viscous_asymmetry": 40.0, "stribeck": 30.0, "load_friction": 0.05, "position_friction": 10.0,
    "passive_joint_friction": 2.0, "quadratic_drag": 40.0, "torque_offset": 4.0, "drive_gain": 0.05, "cyclic_ripple": 5.0,
    "reducer_coupling": 6.0, "viscous_curvature": 20.0, "armature": 3.0, "gravity_direction": 0.01,
    "static_friction": 20.0, "cogging": 5.0,
}  # fmt: skip
NOT_BY_A_STATE = {
    "joint_zero",
    "torque_saturation",  # of the recording, not of the robot
    "delay",
    "thermal_drift",
    "hysteresis",
    "friction_change",
    "backlash",
    "transmission_error",
    "pinion_scale",
    "joint_compliance",
    "structural_compliance",
    "guideway_compliance",
    "cart_tilt",
    "drive_lag",
    "guideway_nonparallel",
    "lugre",
    "torque_speed_limit",
    "back_emf",
    "inductance",
    "winding_heat",
    "supply_sag",
}
OF_HINGES = {"directional_efficiency"}
OF_PAIRS = {"torque_crosstalk"}  # of the recording of two joints
ROBOTS = ("gantry_tau", "linear_axis")


def extended(name: str, cause: str, size: float = 1e-3) -> Model:
    """Return a robot with asymmetric friction and one cause."""
    robot, cls = load_robot(name), EFFECTS[cause]
    joints = robot.actuated[:2] if cause == "reducer_coupling" else robot.actuated
    effect = cls(joints, robot.force_units[: len(joints)])
    plain = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), effect])
    values = dict.fromkeys(plain.effects[0].parameters.names, 80.0)
    return plain.with_values(values | dict.fromkeys(effect.parameters.names, SIZES.get(cause, size)))


def test_every_cause_enters_the_feedforward_or_is_left_out() -> None:
    """Nobody adds a cause without deciding whether a controller can compensate it."""
    assert set(SIZES) | NOT_BY_A_STATE | OF_HINGES | OF_PAIRS == {name for name, cls in EFFECTS.items() if cls.cause}


@pytest.mark.parametrize(
    ("robot", "cause"),
    [(r, c) for r in ROBOTS for c in SIZES if (r, c) != ("linear_axis", "reducer_coupling")],  # it takes two joints
)
def test_what_a_state_determines_is_compensated_without_a_jump(robot: str, cause: str, rng) -> None:
    """Outside the width the extended model's own force; through standstill no step, in any direction of motion."""
    model = extended(robot, cause)
    na = model.robot.na
    v = rng.choice([-1, 1], (20, na)) * rng.uniform(0.02, 0.5, (20, na)) * rng.uniform(1, 2, na)
    v[0, 0] = 0.02  # where a peak at low speed stands
    q, a = model.robot.home + rng.uniform(-0.05, 0.05, v.shape), rng.uniform(-1, 1, v.shape)
    feedforward = Feedforward(model, width=1e-4)
    assert not feedforward.left_out and not feedforward.warnings
    force = model.torque(q, v, a)
    assert_allclose(feedforward(q, v, a), force, rtol=1e-9, atol=1e-9)
    unfelt = robot == "linear_axis" and cause in (
        "passive_joint_friction",
        "load_friction",
    )  # no bearings, no load across
    assert (np.abs(force - model.only(model.effects[:1]).torque(q, v, a)).max() > 0.1) != unfelt
    for shape in ("ramp", "tanh"):
        share = np.linspace(-1, 1, 801)[:, None]
        for way in (np.ones(na), np.resize([1.0, -1.0], na), np.resize([0.0, 1.0, 1.0], na)):
            path = 0.04 * share * way + (0.3 if not way.all() else 0.0) * (way == 0)
            tau = Feedforward(model, width=0.01, shape=shape)(*at(model, path))
            assert np.abs(np.diff(tau, axis=0)).max() < 10.0  # a jump would be 80 N or more, or the cause's own


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("cause", sorted(NOT_BY_A_STATE))
def test_what_a_state_does_not_tell_is_left_out_and_named_once(robot: str, cause: str) -> None:
    """The force is that of the model without the cause, and one sentence says so."""
    model = extended(robot, cause)
    feedforward = Feedforward(model)
    assert [e.name for e in feedforward.left_out] == [cause]
    assert len(feedforward.warnings) == 1 and f"leaves out {cause}: it " in feedforward.warnings[0]
    states = at(model, np.full((2, model.robot.na), 0.2))
    assert_allclose(feedforward(*states), model.only(model.effects[:1]).torque(*states), rtol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_given_temperature_brings_thermal_drift_in(robot: str) -> None:
    """At 10 K above the reference, friction is larger by ten times its change a kelvin; without it the drift stays out."""
    model = extended(robot, "thermal_drift", size=2.0)
    states = at(model, np.full((3, model.robot.na), 0.2))
    feedforward = Feedforward(model)
    warm = feedforward(*states, signals={"temperature": 30.0}) - feedforward(*states)
    assert_allclose(warm, 10 * (2.0 + 2.0 * 0.2), rtol=1e-9)
    one = feedforward(*(x[0] for x in states), signals={"temperature": np.full(model.robot.na, 30.0)})
    assert_allclose(one - feedforward(*(x[0] for x in states)), warm[0], rtol=1e-9)
    with raises_code("wrong_shape"):
        feedforward(*states, signals={"temperature": np.zeros(7)})


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_drive_that_reports_too_much_is_asked_for_as_much(robot: str, rng) -> None:
    """With a gain error of 5 % the drive's scale is 1.05 times the force, smoothed friction included."""
    model = extended(robot, "drive_gain")
    v = rng.uniform(-0.02, 0.02, (20, model.robot.na))
    plain = Feedforward(model.only(model.effects[:1]))(*at(model, v))
    assert_allclose(Feedforward(model)(*at(model, v)), 1.05 * plain, rtol=1e-12)


@pytest.mark.parametrize("shape", ["ramp", "tanh"])
def test_rods_that_do_not_turn_take_no_passive_friction(shape: str) -> None:
    """All carts alike at 0.2 m/s: the bearings stand still, and their direction, a rounding error, must not reach the drives."""
    model = extended("gantry_tau", "passive_joint_friction")
    straight = at(model, np.full((3, 3), 0.2))
    plain = Feedforward(model.only(model.effects[:1]), shape=shape)(*straight)
    assert_allclose(Feedforward(model, shape=shape)(*straight), plain, atol=1e-6)


@pytest.mark.parametrize("shape", ["ramp", "tanh"])
def test_compiled_code_is_the_law_for_single_states(model, shape: str, rng) -> None:
    """One state a call is computed by compiled code, arrays and states that it refuses by Python; all are one law."""
    fast, plain = (
        Feedforward(model, width=0.02, shape=shape, compiled=True),
        Feedforward(model, width=0.02, shape=shape),
    )
    if fast.compiled is None:
        pytest.skip("there is no C compiler here")
    q = model.robot.home + rng.uniform(-0.05, 0.05, (20, 3))
    v, a = rng.uniform(-0.05, 0.05, (20, 3)), rng.uniform(-2, 2, (20, 3))
    expected = plain(q, v, a)
    for k in range(20):
        found = fast.compiled(q[k], v[k], a[k])
        assert found is not None
        assert_allclose(found, expected[k], rtol=1e-11)
        assert_allclose(fast(q[k], v[k], a[k]), found, rtol=0, atol=0)
    assert_allclose(fast(q, v, a), expected, rtol=0, atol=0)
    hard = np.full(3, 1e4)  # beyond every drive's force, which a model still has
    assert np.abs(fast(q[0], v[0], hard)).max() > model.robot.effort_limit.max()
    assert_allclose(fast(q[0], v[0], hard), plain(q[0], v[0], hard), rtol=1e-11)
    apart = model.robot.home + np.array([0.0, 3.0, -3.0])
    assert fast.compiled(apart, v[0], a[0]) is None
    with raises_code("loop_not_closed"):
        fast(apart, v[0], a[0])
    with raises_code("wrong_shape"):
        fast(q[0][:1], v[0][:1], a[0][:1])


def test_a_law_that_is_not_compiled_tells_why_and_answers(model, monkeypatch) -> None:
    """Without a compiler the same forces come from Python, with a warning; a pickled law is compiled again."""
    state = (model.robot.home, np.full(3, 0.01), np.ones(3))
    fast = pickle.loads(pickle.dumps(Feedforward(model, compiled=True)))
    assert_allclose(fast(*state), Feedforward(model)(*state), rtol=1e-11)
    monkeypatch.setenv("TAU_DYN_COMPILE", "0")
    slow = Feedforward(model, compiled=True)
    assert slow.compiled is None and "not compiled" in slow.warnings[-1]
    assert_allclose(slow(*state), Feedforward(model)(*state), rtol=0, atol=0)
