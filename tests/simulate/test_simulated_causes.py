"""Every cause hidden in a simulated robot: its force is the law's own, or what it does to the recording, or a refusal."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, STATE, Motion
from tau_dyn.model import Model
from tau_dyn.simulate import (
    SampledForces,
    Sensors,
    concatenate,
    measure,
    move,
    read_effects_file,
    simulate,
    simulate_drive,
)
from tau_dyn.simulate.forces import EffectSurroundings, compute_warm_up

IN_THE_ROBOT = {
    "coulomb_asymmetry": {"coulomb_asymmetry": 5},
    "viscous_asymmetry": {"viscous_asymmetry": 20},
    "stribeck": {"stribeck": 15},
    "load_friction": {"load_friction": 0.05},
    "position_friction": {"position_friction_1": 10, "position_friction_2": 5},
    "thermal_drift": {"thermal_coulomb": -2, "thermal_viscous": -10},
    "passive_joint_friction": {"passive.viscous": 1, "passive.coulomb": 1},
    "quadratic_drag": {"quadratic_drag": 40},
    "torque_offset": {"offset": 4},
    "drive_gain": {"gain_error": 0.05},
    "cyclic_ripple": {"ripple_sin": 3, "ripple_cos": 1},
    "hysteresis": {"hysteresis": 15},
    "lugre": {"lugre": 15},
    "static_friction": {"static_friction": 12},
    "cogging": {"cogging_sin": 3, "cogging_cos": 1},
    "reducer_coupling": {"inertia": 3, "coulomb": 4},
    "viscous_curvature": {"viscous_curvature": 25},
    "gravity_direction": {"base.tilt_y": 0.1},
    "armature": {"armature_error": 3},
}
IN_THE_LOG = {
    "delay", "backlash", "transmission_error", "pinion_scale", "joint_compliance", "structural_compliance",
    "guideway_compliance", "guideway_nonparallel", "cart_tilt", "drive_lag",
    "back_emf", "inductance", "winding_heat", "supply_sag", "joint_zero", "torque_saturation", "torque_crosstalk",
}  # fmt: skip
SETTINGS = {
    "stribeck": {"speed": 0.1},
    "static_friction": {"speed": 0.1},
    "position_friction": {"half": 0.3},
    "thermal_drift": {"lag": 0.5},
}


def hidden(make, tmp_path, name: str, values: dict[str, float], robot=None, **settings: float) -> Model:
    """Return a robot with friction and one cause, read from an effects file."""
    parallel = name in ("drive_gain", "load_friction", "passive_joint_friction", "reducer_coupling")
    robot = robot or (make.gantry() if parallel else make.block(effort=2000.0))
    friction = {"coulomb_pos": 22, "coulomb_neg": 18, "viscous_pos": 60, "viscous_neg": 50}
    row = {"effect": name, "settings": {**SETTINGS.get(name, {}), **settings}, "parameters": values}
    if name == "reducer_coupling":
        row["joints"] = list(robot.actuated[:2])
    content = {"effects": [{"effect": "asymmetric_friction", "parameters": friction}, row]}
    (tmp_path / "e.yaml").write_text(yaml.safe_dump(content))
    return read_effects_file(tmp_path / "e.yaml", robot)


def there_and_back(model: Model, length: float = 0.1, seconds: float = 0.4):
    """Return a motion that starts at rest and reverses three times."""
    joints, na = model.robot.actuated, model.robot.na
    far, home = length * np.array([1.0, -0.7, 0.4])[:na], np.zeros(na)
    ways = [(home, far), (far, -far), (-far, 0.5 * far), (0.5 * far, home)]
    return concatenate([move(joints, a, b, seconds) for a, b in ways], rest=0.02)


def truth(model: Model, run) -> Motion:
    """Return the true motion with what its effects feel."""
    travel = np.zeros_like(run.q)
    for k in range(1, len(run.q)):
        same = np.sign(run.v[k]) * np.sign(run.v[k - 1]) >= 0
        travel[k] = np.where(same, travel[k - 1], 0.0) + np.abs(run.q[k] - run.q[k - 1])
    warm = np.repeat(compute_warm_up(run.t - run.t[0])[:, None], run.q.shape[1], axis=1)
    signals = {"reversal": travel, "temperature": warm}
    if model.effects[1].name in ("hysteresis", "lugre"):
        signals[STATE] = bristle(np.diff(run.q, axis=0) / model.effects[1].settings["distance"])
    return model.motion(run.q, run.v, run.a, t=run.t, signals=signals)


def bristle(ways: np.ndarray) -> np.ndarray:
    """Return the state z (N + 1, na) of `dz/ds = 1 - z sign(ds)` along steps (N, na), by the implicit midpoint rule."""
    z = [np.zeros(ways.shape[1])]
    for way in ways:
        z.append((z[-1] * (1 - np.abs(way) / 2) + way) / (1 + np.abs(way) / 2))
    return np.array(z)


@pytest.mark.parametrize("name", IN_THE_ROBOT)
def test_the_plant_obeys_the_law(name: str, make, tmp_path) -> None:
    """The forces that move the robot are rigid body, friction and the cause's own law, to 2 % of the cause's share."""
    model = hidden(make, tmp_path, name, IN_THE_ROBOT[name])
    run = simulate_drive(model, there_and_back(model), None, Sensors(), np.random.default_rng(0), feedback="ideal")
    motion = truth(model, run)
    error = run.tau - model.mechanism.inverse_dynamics(run.q, run.v, run.a) - model.effect_force(motion)
    share = model.effects[1].force(motion, model.effect_parameters)
    sure = np.abs(run.v) > 0.03  # a reversal's sample mixes both directions
    sure[:440] = False  # a bristle starts in the middle, not at one end
    assert np.sqrt(np.mean(error[sure] ** 2)) < 0.02 * np.sqrt(np.mean(share[sure] ** 2))
    assert run.q_shown is None and run.tau_shown is None


def test_every_cause_is_simulated_or_refused() -> None:
    """No cause is silently left out: the plant has it, the log has it, or the simulator says why not."""
    causes = {name for name, cls in EFFECTS.items() if cls.cause}
    assert causes == set(IN_THE_ROBOT) | IN_THE_LOG | {
        "friction_change",
        "directional_efficiency",
        "torque_speed_limit",
    }


def test_a_change_between_campaigns_needs_a_campaign(make, tmp_path) -> None:
    """One recording cannot differ from others; told its number, the plant has the friction of that campaign."""
    model = hidden(make, tmp_path, "friction_change", {"coulomb_change": 7}, number=1)
    with raises_code("unsupported", "friction_change") as fault:
        simulate(model, there_and_back(model))
    assert "\n" not in str(fault.value)
    state = np.zeros(1), np.array([0.5])
    other, changed = (SampledForces(model, EffectSurroundings(campaign=k)).bounds(*state)[1] for k in (0.0, 1.0))
    assert_allclose(changed - other, 7)


@pytest.mark.parametrize(
    ("name", "values", "settings"),
    [
        ("back_emf", {"back_emf": 30}, {}),
        ("inductance", {"time_constant": 0.005}, {}),
        ("winding_heat", {"resistance_rise": 0.5}, {"lag": 0.3, "rated": 100.0}),
        ("supply_sag", {"supply_sag": 0.2}, {"peak": 500.0}),
    ],
)
def test_a_motors_circuit_is_logged_and_moves_nothing(name: str, values: dict, settings: dict, make, tmp_path) -> None:
    """The log holds what the law makes of the true force, beside the voltage or pulse width; the robot moves as without."""
    model = hidden(make, tmp_path, name, values, **settings)
    run = simulate_drive(model, there_and_back(model), None, Sensors(), np.random.default_rng(0), feedback="ideal")
    log = measure(run, Sensors(), np.random.default_rng(0))
    without = simulate_drive(
        model.only(model.effects[:1]),
        there_and_back(model),
        None,
        Sensors(),
        np.random.default_rng(0),
        feedback="ideal",
    )
    assert_allclose(run.tau, without.tau)
    motion = Motion.of(model.robot.actuated, run.q, run.v, run.a, t=run.t, signals={"force": run.tau})
    (joint,) = model.robot.actuated
    made = run.tau + model.effects[1].force(motion, model.effect_parameters)
    assert np.abs(made - run.tau).max() > 0.01 * np.abs(run.tau).max()
    assert_allclose(log[f"tau_{joint}"], made[:, 0])
    assert_allclose(log[f"{'pwm' if name == 'supply_sag' else 'voltage'}_{joint}"], log[f"tau_{joint}"])


def test_forces_are_logged_behind_a_low_pass(make, tmp_path) -> None:
    """20 ms: `T dy/dt = tau - y` between samples, and the robot moves as it did."""
    model = hidden(make, tmp_path, "drive_lag", {"axis.time_constant": 0.02})
    plain = model.with_values({"axis.time_constant": 0.0})
    slow, fast = (simulate(m, there_and_back(m)) for m in (model, plain))
    y, tau, dt = slow.channels["tau_axis"], fast.channels["tau_axis"], float(np.mean(np.diff(slow.t)))
    middle = (y[1:] + y[:-1]) / 2, (tau[1:] + tau[:-1]) / 2
    assert_allclose(0.02 * np.diff(y) / dt, middle[1] - middle[0], atol=0.005 * np.ptp(tau))
    assert_allclose(slow.channels["q_axis"], fast.channels["q_axis"], atol=0)


def test_forces_are_logged_late(make, tmp_path) -> None:
    """A delay of 3 ms moves tau by three samples and leaves the robot as it was."""
    model = hidden(make, tmp_path, "delay", {"axis.delay": 0.003})
    plain = model.with_values({"axis.delay": 0.0})
    late, on_time = (simulate(m, there_and_back(m)) for m in (model, plain))
    assert_allclose(late.channels["tau_axis"][3:], on_time.channels["tau_axis"][:-3], atol=1e-9)
    assert_allclose(late.channels["q_axis"], on_time.channels["q_axis"], atol=0)


@pytest.mark.parametrize("feedback", ["ideal", "encoder"])
@pytest.mark.parametrize(
    ("name", "values", "settings"),
    [
        ("transmission_error", {"error_sin": 1e-5, "error_cos": 5e-6}, {"period": 0.03}),
        ("pinion_scale", {"pinion_scale": 1e-3}, {}),
        ("backlash", {"backlash": 4e-5}, {"travel": 1e-4}),
        ("hysteresis", {"lost_motion": 2e-5}, {"displaced": 1, "distance": 5e-4}),
        ("joint_compliance", {"compliance": 2e-8}, {}),
    ],
)
def test_encoders_read_beside_their_load(make, tmp_path, feedback, name, values, settings) -> None:
    """Logged less true position is the displacement by the cause's law, whether or not the controller reads it too."""
    model = hidden(make, tmp_path, name, values, **settings)
    run = simulate_drive(model, there_and_back(model), None, Sensors(), np.random.default_rng(0), feedback=feedback)
    log = measure(run, Sensors(), np.random.default_rng(0))
    motion = truth(model, run)
    motion = Motion.of(
        motion.joints, motion.q, motion.v, motion.a, t=motion.t, signals={**motion.signals, "force": run.tau}
    )
    expected = (
        model.effects[1].displacement(motion) @ model.effect_parameters.select(model.effects[1].parameters.names).values
    )
    moving = np.abs(run.v[:, 0]) > 0.03
    moving[:440] = False  # a play or a loop starts in the middle
    found = log.joint("q", run.model.robot.actuated) - run.q
    assert_allclose(found[moving], expected[moving], atol=0.02 * np.max(np.abs(expected)))
    assert np.max(np.abs(expected)) > 1e-6


def test_carts_off_their_guideways_move_the_tool_alone(make, tmp_path) -> None:
    """A yielding guideway shows in the tool's position, by the same columns that find it, and nowhere else."""
    model = hidden(make, tmp_path, "guideway_compliance", {"guideway_compliance": 1e-6}, make.gantry())
    run = simulate_drive(
        model, there_and_back(model, 0.05), None, Sensors(), np.random.default_rng(0), feedback="ideal"
    )
    log = measure(run, Sensors(), np.random.default_rng(0))
    shift = np.column_stack([log.channels[f"{x}_tool"] for x in "xyz"]) - run.tool
    assert 1e-5 < np.max(np.abs(shift)) < 1e-3
    carried = model.mechanism.guide_force(run.q, run.v, run.a)
    assert_allclose(
        shift, np.einsum("nxik,nik->nx", model.mechanism.cart_sensitivity(run.q), 1e-6 * carried), atol=1e-12
    )
    assert_allclose(log.joint("q", model.robot.actuated), run.q, atol=0)


def test_the_log_has_the_temperature_that_friction_follows(make, tmp_path) -> None:
    """`temp_room` warms from 20 degC towards 40 with a time constant of a minute, and only where an effect feels it."""
    model = hidden(make, tmp_path, "thermal_drift", {"thermal_coulomb": -0.2})
    log = simulate(model, there_and_back(model), sensors=Sensors(log_rate_hz=500))
    assert_allclose(log.channels["temp_room"], 40 - 20 * np.exp(-log.t / 60), atol=1e-9)
    assert "temp_room" not in simulate(Model.of(make.block(effort=2000.0)), there_and_back(model)).channels


def test_two_of_a_kind_are_told_apart_by_their_label(make, tmp_path) -> None:
    """A joint with two periods needs a label on one; short names reach the labelled one too; without it the file is refused."""
    ripple = {"effect": "cyclic_ripple", "parameters": {"ripple_sin": 2}}
    path = tmp_path / "two.yaml"
    path.write_text(yaml.safe_dump({"effects": [ripple, {**ripple, "label": "_motor", "settings": {"period": 0.005}}]}))
    model = read_effects_file(path, make.block())
    assert (
        model.effect_parameters["axis.ripple_sin_motor"].value == 2 == model.effect_parameters["axis.ripple_sin"].value
    )
    assert [e.settings["period"] for e in model.effects] == [0.02, 0.005]
    path.write_text(yaml.safe_dump({"effects": [ripple, ripple]}))
    with raises_code("file_format", "two.yaml", "axis.ripple_sin", "cyclic_ripple"):
        read_effects_file(path, make.block())
    path.write_text("effects: [{effect: cyclic_ripple, settings: {period: 0}}]")
    with raises_code("invalid_value", "cyclic_ripple"):
        read_effects_file(path, make.block())
