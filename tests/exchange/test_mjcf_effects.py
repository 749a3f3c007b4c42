"""Effects in MuJoCo, in the file's elements or in the callback beside it, move the robot as our own simulator does."""

from __future__ import annotations

from xml.etree.ElementTree import fromstring

import numpy as np
import pytest

from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.exchange import build_mjcf
from tau_dyn.model import Model
from tau_dyn.robot import list_stock_robots, load_robot
from tau_dyn.simulate import free_motion

ROBOTS = {
    "l1": lambda: load_robot("gantry_tau", gravity_mass=22.38),
    "delta": lambda: load_robot("delta"),
    "ur5": lambda: load_robot("ur5"),
}
SPEED = 0.2  # m/s or rad/s, at the start
SETTINGS = {
    "cyclic_ripple": {"period": 0.02, "harmonics": 2},
    "position_friction": {"half": 0.5, "degree": 3},
    "viscous_curvature": {"knee": 0.05},
    "hysteresis": {"distance": 1e-3},
    "lugre": {"distance": 1e-3},
}
SIZES = {
    "quadratic_drag": 7.5,
    "viscous_pos": 1.5,
    "viscous_neg": 0.5,
    "viscous_asymmetry": 0.5,
    "viscous": 1.0,
    "coulomb": 0.0,
}
"""Of a parameter, in units of the force that stops a joint within a second, at its speed where it multiplies one."""
FIXED = {
    "tilt_x": 0.02,
    "tilt_y": -0.03,
    "gain_error": 0.05,
    "load_friction": 0.01,
    "loss_driving": 0.015,
    "loss_driven": 0.005,
}


def build_model(name: str, causes: tuple[str, ...]) -> Model:
    """Return a robot with friction that differs by direction, and effects of a tenth to a third of its inertial forces."""
    if name == "ur5" and name not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    robot = ROBOTS[name]()
    effects = [*build_friction_model("asymmetric", robot.actuated, robot.force_units)]
    for cause in causes:
        n = slice(-2, None) if cause == "reducer_coupling" else slice(None)
        effects.append(EFFECTS[cause](robot.actuated[n], robot.force_units[n], **SETTINGS.get(cause, {})))
    model = Model.of(robot, effects)
    mass = np.diag(model.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[0])
    stops = dict(zip(robot.actuated, SPEED * mass, strict=True))
    values = {}
    for parameter in model.effect_parameters.names:
        joint, quantity = parameter.split(".")
        stop = min(stops[j] for j in joint.split("+")) if set(joint.split("+")) <= set(stops) else min(stops.values())
        values[parameter] = FIXED.get(quantity, SIZES.get(quantity, 0.1) * stop)
    return model.with_values(values)


@pytest.fixture
def compare(in_mujoco):
    """Return a function that compares motions, see `compare_motions`."""
    return lambda model: compare_motions(in_mujoco, model)


def compare_motions(in_mujoco, model: Model) -> tuple[float, float]:
    """Return how far MuJoCo's half second is from ours, in shares of the longest stroke: with the callback, and without."""
    robot = model.robot
    rng = np.random.default_rng(4)
    v0 = SPEED * rng.standard_normal(robot.na)
    weight = model.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[1]
    ours = free_motion(model, robot.home, v0, 0.5, dt=5e-4, tau=weight).q[::2]
    made = build_mjcf(model)
    assert not [sentence for sentence in made.left_out if "effect" in sentence]
    found = []
    for callback in (True, False):
        with in_mujoco.open_in_mujoco(made, callback=callback) as theirs:
            found.append(in_mujoco.move_in_mujoco(robot, theirs, v0, weight, 0.5))
    with_it, alone = found
    stroke = np.ptp(ours, axis=0).max()
    return np.abs(with_it - ours).max() / stroke, np.abs(alone - ours).max() / stroke


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("l1", "stribeck"),
        ("l1", "position_friction"),
        ("l1", "viscous_curvature"),
        ("l1", "viscous_asymmetry"),
        ("ur5", "stribeck"),
        ("ur5", "load_friction"),
        ("ur5", "directional_efficiency"),
    ],
)
def test_the_callback_moves_as_we_do(name, cause, compare):
    """Friction that MuJoCo has no word for: within 0.1 % of our motion with the callback, at least 1 % off without."""
    with_it, alone = compare(build_model(name, (cause,)))
    assert with_it < 1e-3 < 1e-2 < alone


@pytest.mark.parametrize("cause", ["position_friction"])
def test_the_callback_of_solved_loops(cause, compare):
    """On the Delta, whose loops both programs solve numerically."""
    assert compare(build_model("delta", (cause,)))[0] < 1e-3


def test_bearings_of_a_closed_form(compare):
    """Friction of the L1's passive bearings acts on its drives through the loops."""
    with_it, alone = compare(build_model("l1", ("passive_joint_friction",)))
    assert with_it < 1e-3 < 1e-2 < alone


NATIVE = {
    "cyclic_ripple": "actuator/dcmotor[@cogging]",
    "cogging": "actuator/dcmotor[@cogging]",
    "hysteresis": "actuator/dcmotor[@lugre]",
    "lugre": "actuator/dcmotor[@lugre]",
    "quadratic_drag": "worldbody//joint[@damping]",
    "gravity_direction": "option[@gravity]",
}


@pytest.mark.parametrize(
    ("name", "cause"), list(zip(("ur5", "ur5", "delta", "delta", "ur5", "l1"), NATIVE, strict=True))
)
def test_what_mujoco_has_elements_for(name, cause, compare):
    """Ripples, bristles, drag and gravity's direction stand in the file; half a second is ours within 0.1 %."""
    model = build_model(name, (cause,))
    made = build_mjcf(model)
    assert fromstring(made.text).find(NATIVE[cause]) is not None
    assert not [sentence for sentence in made.by_callback if cause in sentence]
    assert compare(model)[0] < 1e-3


@pytest.mark.parametrize("cause", ["cyclic_ripple", "quadratic_drag"])
def test_an_old_mujoco_gets_the_callback(cause, monkeypatch, compare):
    """What MuJoCo 3.3 cannot read is in the callback, which moves the robot as the element does."""
    monkeypatch.setattr("tau_dyn.exchange.mjcf_effects.get_mujoco_version", lambda: (3, 3))
    model = build_model("l1", (cause,))
    assert "dcmotor" not in build_mjcf(model).text
    assert compare(model)[0] < 1e-3


def test_a_shared_motor_of_one_chain(compare):
    """A motor that turns with two wrist joints is a tendon of both, its inertia and viscous friction as ours within 0.1 %."""
    model = build_model("ur5", ("reducer_coupling",))
    assert fromstring(build_mjcf(model).text).find("tendon/fixed[@armature]") is not None
    assert compare(model)[0] < 1e-3


def test_a_shared_motor_of_two_branches_is_left_out():
    """MuJoCo's mass matrix couples no two branches of a tree, so what adds to it there is said to be lost."""
    model = build_model("l1", ("reducer_coupling",))
    assert any("adds to the mass matrix" in sentence for sentence in build_mjcf(model).left_out)


def test_a_late_force_is_a_late_sensor(in_mujoco):
    """Contents of the log 2.3 ms late, MuJoCo's sensor shows so: a sine of 6 Hz to 1e-4 of its size."""
    mujoco = pytest.importorskip("mujoco")
    robot = load_robot("linear_axis")
    model = Model.of(robot, [EFFECTS["delay"](robot.actuated, robot.force_units)]).with_values({"axis.delay": 2.3e-3})
    made = build_mjcf(model)
    assert not [sentence for sentence in made.left_out if "effect" in sentence]
    with in_mujoco.open_in_mujoco(made) as theirs:
        data, found = mujoco.MjData(theirs), []
        for _ in range(300):
            data.ctrl[:], t = np.sin(40 * data.time), data.time
            mujoco.mj_step(theirs, data)
            found.append((t, data.sensordata[0]))
    t, shown = np.array(found)[20:].T
    assert np.abs(shown - np.sin(40 * (t - 2.3e-3))).max() < 1e-4


def test_what_neither_can_hold_is_said():
    """A low-pass distorts the log, and a temperature is no state."""
    robot = load_robot("gantry_tau_f1")
    effects = [EFFECTS[c](robot.actuated, robot.force_units) for c in ("drive_lag", "thermal_drift")]
    model = Model.of(robot, effects)
    left_out = build_mjcf(model.with_values(dict.fromkeys(model.effect_parameters.names, 1e-3))).left_out
    for name, why in (("drive_lag", "distorts the recording"), ("thermal_drift", "temperature")):
        assert any(name in sentence and why in sentence for sentence in left_out)
