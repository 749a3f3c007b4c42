"""A model extended by causes, refitted: every amplitude comes back with its settings kept; what a log lacks is named."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.effects import EFFECTS, build_friction_model, compute_travel
from tau_dyn.identify import build_regression, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.simulate import build_named_motion

ROBOTS = ("l1", "axis")
AMPLITUDES = {
    "stribeck": (30.0, {"speed": 0.05}), "load_friction": (0.1, {}), "position_friction": (20.0, {}),
    "thermal_drift": (-2.0, {"lag": 2.0}), "passive_joint_friction": (2.0, {}), "quadratic_drag": (60.0, {}),
    "drive_gain": (0.1, {}), "cyclic_ripple": (8.0, {"period": 0.05}), "delay": (5e-3, {"about": 5e-3}),
    "hysteresis": (25.0, {"distance": 0.01}), "transmission_error": (1e-4, {"period": 0.05}), "reducer_coupling": (15.0, {}),
    "joint_compliance": (1e-6, {}), "structural_compliance": (1e-6, {"frequency": 8.0}), "friction_change": (10.0, {"number": 1}),
    "drive_lag": (8e-3, {"about": 8e-3}), "viscous_curvature": (25.0, {"knee": 0.15}),
    "lugre": (25.0, {"distance": 0.01}), "static_friction": (25.0, {"speed": 0.05}), "cogging": (8.0, {"period": 0.05}),
}  # fmt: skip
UNSEEN = {
    "coulomb_asymmetry",
    "viscous_asymmetry",
    "torque_offset",  # the friction below has them already
    "backlash",
    "pinion_scale",
    "guideway_compliance",
    "cart_tilt",
    "guideway_nonparallel",  # forces do not show them
    "armature",
    "gravity_direction",  # masses have them already
    "directional_efficiency",  # of hinges with a gear
}
OF_A_RECORDING = {"joint_zero", "torque_saturation", "torque_crosstalk"}
"""Errors of the sensors, found with the fitted model's own force (`tests/diagnose/test_refitted_signals.py`)."""
ASKED = {"torque_speed_limit"}
"""What lies in a force that was asked for and not delivered; a model's own force does not have it."""
OF_A_VOLTAGE = {"back_emf", "inductance", "winding_heat", "supply_sag"}
"""What lies in a force made of a voltage (`test_motor_electrics.py`)."""
NOT_ON = {("axis", "reducer_coupling"), ("axis", "load_friction"), ("axis", "passive_joint_friction")}
CASES = [(r, c) for r in ROBOTS for c in AMPLITUDES if (r, c) not in NOT_ON]


def extended(robot, cause: str, size: float, **settings: float) -> Model:
    """Return a robot with friction and one cause on its first joint, or on as many as it takes."""
    count = {"reducer_coupling": 2, "passive_joint_friction": robot.na}.get(cause, 1)
    effect = EFFECTS[cause](robot.actuated[:count], robot.force_units[:count], **cast("Any", settings))
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), effect])
    values = dict.fromkeys(model.effects[0].parameters.names, 40.0)
    return model.with_values(values | dict.fromkeys(effect.parameters.names, size))


def made(model: Model, seed: int, seconds: float = 20.0, campaign: float = 0.0, name: str = "made.csv") -> Log:
    """Return the log of a robot that follows a motion, at 250 Hz, with 1 N of noise and a room that warms up."""
    path = build_named_motion("fourier", model.steady(), seconds, seed).every(4)
    room = 20 + 15 * (1 - np.exp(-path.t / 8))
    travelled = np.column_stack([compute_travel(q, v, 0.0) for q, v in zip(path.q.T, path.v.T, strict=True)])
    signals = {
        "temperature": np.repeat(room[:, None], model.robot.na, axis=1),
        "reversal": travelled,
        "campaign": np.full(len(path.t), campaign),
    }
    tau = model.torque(path.q, path.v, path.a, t=path.t, signals=signals)
    tau = tau + np.random.default_rng([63, seed]).normal(size=tau.shape)
    columns = {f"{key}_{j}": x[:, k] for key, x in (("q", path.q), ("tau", tau)) for k, j in enumerate(path.joints)}
    return Log(path.t, columns | {"temp_room": room}, name)


def test_every_cause_is_refitted_or_known_to_be_unseen() -> None:
    """Nobody adds a cause without saying what identification makes of it."""
    assert set(AMPLITUDES) | UNSEEN | ASKED | OF_A_VOLTAGE | OF_A_RECORDING == {
        name for name, cls in EFFECTS.items() if cls.cause
    }


@pytest.mark.parametrize(("name", "cause"), CASES)
def test_amplitudes_of_an_extended_model_are_refitted(request, tmp_path, name: str, cause: str) -> None:
    """From its file with amplitudes at zero, the model comes back with the true ones, settings as they were."""
    robot, (size, settings) = request.getfixturevalue(name), AMPLITUDES[cause]
    if cause == "drive_gain":  # a gain shows only beside a mass that is known
        robot = robot.with_parameters(robot.parameters.update({n: {"free": False} for n in robot.parameters.names}))
    truth = extended(robot, cause, size, **settings)
    logs = [made(truth, 1)] if cause != "friction_change" else [made(truth, 1), made(truth, 2, 10.0, 1.0, "later.csv")]
    fitted = truth.effects[1].parameters.names
    start = truth.with_values(dict.fromkeys(fitted, 0.0))
    start.save(tmp_path / "m.yaml")
    found = identify(robot, logs, model=start if cause == "drive_gain" else tmp_path / "m.yaml")
    assert found.model.effects[1].settings == truth.effects[1].settings
    for p in found.model.parameters.select(fitted):
        assert p.stderr is not None and p.stderr < 0.3 * abs(size)
        assert abs(p.value - size) < 4.5 * p.stderr + 0.05 * abs(size), str(p)
    assert not any("did not settle" in w for w in found.warnings)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("cause", sorted(UNSEEN))
def test_what_forces_cannot_show_keeps_its_value(request, name: str, cause: str) -> None:
    """An amplitude that the force log does not see, or that other parameters have in them, is not invented."""
    robot = request.getfixturevalue(name)
    model = extended(robot, cause, 0.0)
    found = identify(robot, made(model, 1, 10.0), model=model)
    for parameter in model.effects[1].parameters.names:
        assert not found.estimate.identifiable(parameter) or not found.estimate.determined(parameter)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_log_without_a_temperature_is_refused_by_column(request, name: str) -> None:
    """The sentence names the log, the column and the effect; a column with holes is refused as well."""
    model = extended(request.getfixturevalue(name), "thermal_drift", -2.0)
    log = made(model, 1, 10.0)
    cold = Log(log.t, {k: x for k, x in log.channels.items() if k != "temp_room"}, "cold.csv")
    with raises_code("missing_column", "cold.csv", "temp_room", "temp_", "thermal_drift") as fault:
        identify(model.robot, cold, model=model)
    assert fault.value.exit_status == 2
    holes = Log(log.t, dict(log.channels) | {"temp_room": np.where(log.t > 5, np.nan, 20.0)}, "holes.csv")
    with raises_code("bad_sample", "holes.csv", "temp_room"):
        identify(model.robot, holes, model=model)


@pytest.mark.parametrize("name", ROBOTS)
def test_one_log_cannot_refit_what_sets_the_second_apart(request, name: str) -> None:
    """Friction that changed between two logs needs both."""
    model = extended(request.getfixturevalue(name), "friction_change", 5.0)
    with raises_code("unsupported", "friction_change", "2", "1"):
        identify(model.robot, made(model, 1, 10.0), model=model)


def test_held_out_logs_are_campaigns_of_their_own(axis) -> None:
    """A log held out after two training logs is the third: the second one's friction is not charged to it."""
    model = extended(axis, "friction_change", 10.0, number=1)
    held = made(model, 3, 10.0, 2.0, "third.csv")
    regression = build_regression(model, [held], campaigns=["first.csv", "second.csv"])
    assert not regression.runs[0].W[:, :, -2:].any()
    assert build_regression(model, [held], campaigns=["first.csv"]).runs[0].W[:, :, -2:].any()
    two = [made(model, 1, 10.0, 0.0, "first.csv"), made(model, 2, 10.0, 1.0, "second.csv")]
    judged = identify(axis, two, holdout=held, model=model)
    assert judged.held is not None and not judged.held.runs[0].W[:, :, -2:].any()


def test_loads_are_those_of_the_masses_found(l1) -> None:
    """With rods and plate 30 % heavier than nominal, friction in proportion to the load is still found to 5 %."""
    truth = extended(l1, "load_friction", 0.2)
    heavy = {p.name: 1.3 * p.value for p in l1.parameters if p.name.endswith(".mass") and p.free}
    found = identify(l1, made(truth.with_values(heavy), 1), model=truth)
    name = truth.effects[1].parameters.names[0]
    assert abs(found.model.parameters[name].value / 0.2 - 1) < 0.05
