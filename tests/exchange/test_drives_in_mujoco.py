"""Drives in MuJoCo's file: the force that a log would show makes the acceleration that it would show; what is lost is said."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS
from tau_dyn.exchange import build_mjcf
from tau_dyn.exchange.content import compute_lost_force
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf


def build_model(write, cause: str, values: dict[str, float], **settings: float) -> Model:
    """Return a block of 5 kg on a level guideway with one effect in its drive."""
    robot = load_robot_from_urdf(write.block(), "block")
    model = Model.of(robot, [EFFECTS[cause](robot.actuated, robot.force_units, **settings)])
    return model.with_values({f"axis.{name}": value for name, value in values.items()})


@pytest.mark.parametrize(
    ("cause", "values", "settings"),
    [
        ("torque_offset", {"offset": 3.0}, {}),
        ("drive_gain", {"gain_error": 0.25}, {}),
        ("cyclic_ripple", {"ripple_sin": 0.7, "ripple_cos": -0.4, "ripple_sin_2": 0.2, "ripple_cos_2": 0.5},
         {"period": 0.05, "harmonics": 2}),
    ],
)  # fmt: skip
def test_the_force_that_the_model_asks_for_gives_its_acceleration(write, cause, values, settings) -> None:
    """At rest anywhere: control by the model's own force at 2 m/s^2, and MuJoCo accelerates the block so."""
    mujoco = pytest.importorskip("mujoco")
    model = build_model(write, cause, values, **settings)
    simulated = mujoco.MjModel.from_xml_string(build_mjcf(model).text)
    data = mujoco.MjData(simulated)
    for q in (0.0, 0.007, 0.019, 0.043):
        for a in (0.0, 2.0, -1.0):
            force = model.torque(np.array([[q]]), np.zeros((1, 1)), np.array([[a]]))[0]
            mujoco.mj_resetData(simulated, data)
            data.qpos[:], data.ctrl[: len(force)] = q, force
            mujoco.mj_forward(simulated, data)
            assert_allclose(data.qacc, a, atol=1e-6)


def test_what_an_export_loses_is_the_rms_of_its_force(write) -> None:
    """A constant 3 N that a file leaves out costs 3 N, and a ripple of 2 N its rms, 2 / sqrt(2)."""
    t = np.arange(0, 20, 0.004)
    q = 0.3 * np.sin(1.3 * t) + 0.1 * np.sin(5.1 * t)
    log = Log(t, {"q_axis": q, "tau_axis": 5 * np.gradient(np.gradient(q, t), t)}, "log.csv")
    whole = build_model(write, "torque_offset", {"offset": 3.0})
    assert_allclose(compute_lost_force(whole, whole.with_values({"axis.offset": 0.0}), [log]), 3.0, rtol=1e-6)
    ripple = build_model(write, "cyclic_ripple", {"ripple_sin": 2.0}, period=0.2, harmonics=1)
    lost = compute_lost_force(ripple, ripple.with_values({"axis.ripple_sin": 0.0}), [log])
    assert_allclose(lost, np.sqrt(2), rtol=0.15)
