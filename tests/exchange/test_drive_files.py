"""Drives for BAM, mjlab and Isaac Lab hold the model's friction, armature, limits and delays, and say what they lack."""

from __future__ import annotations

import json
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS, Motion, Stribeck, build_friction_model
from tau_dyn.exceptions import InputError
from tau_dyn.exchange import build_drive_files
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf


class Given:
    """What a configuration class was called with."""

    def __init__(self, **values: Any) -> None:
        """Keep it."""
        self.values = values


@pytest.fixture
def arm(write) -> Model:
    """Two turning joints with asymmetric friction, a Stribeck peak and drive inertia."""
    robot = load_robot_from_urdf(write.two_link(), "arm")
    peak = Stribeck(robot.actuated, robot.force_units, speed=0.05, power=2.0)
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), peak])
    sizes = {
        "coulomb_pos": 3.0,
        "coulomb_neg": 2.0,
        "viscous_pos": 1.5,
        "viscous_neg": 1.5,
        "stribeck": 0.7,
        "armature": 0.2,
    }
    return model.with_values(
        {n: x for n in model.parameters.names for key, x in sizes.items() if n.endswith(f".{key}")}
    )


def execute(text: str, module: str, monkeypatch) -> dict[str, Any]:
    """Return what a configuration file leaves behind; its program's classes only keep what they are given."""
    stand_in: Any = ModuleType(module)
    for name in ("BuiltinMotorActuatorCfg", "ImplicitActuatorCfg", "DelayedPDActuatorCfg"):
        setattr(stand_in, name, type(name, (Given,), {}))
    monkeypatch.setitem(sys.modules, module.split(".")[0], ModuleType(module.split(".")[0]))
    monkeypatch.setitem(sys.modules, module, stand_in)
    left: dict[str, Any] = {}
    exec(text, left)
    return left


def test_bams_friction_budget_is_ours(arm):
    """Friction by BAM's m2, `K_v |w| + K_c + K_cs exp(-|w / w_s|^alpha)`, is the mean of our two directions' forces."""
    joint = arm.robot.actuated[0]
    made = build_drive_files(arm, "bam")
    assert set(made) == set(arm.robot.actuated)
    given = json.loads(made[joint].text)
    assert given["model"] == "m2" and given["armature"] == 0.2
    w = np.geomspace(1e-3, 2.0, 20)
    peak = given["friction_stribeck"] * np.exp(-(np.abs(w / given["dtheta_stribeck"]) ** given["alpha"]))
    budget = given["friction_viscous"] * w + given["friction_base"] + peak
    v = np.tile(w[:, None], (1, arm.robot.na))
    forward, backward = (arm.effect_force(Motion.of(arm.robot.actuated, 0 * v, s * v, 0 * v)) for s in (1, -1))
    assert_allclose(budget, (forward - backward)[:, 0] / 2, rtol=1e-12)


def test_bam_says_what_it_lacks(arm):
    """The motor's constants are not the model's, and a constant force has no place."""
    said = next(iter(build_drive_files(arm, "bam").values())).left_out
    assert any("kt and R" in sentence for sentence in said)
    assert any("coulomb friction 3 and 2" in sentence for sentence in said)
    with pytest.raises(InputError, match="turning"):
        build_drive_files(Model.of(load_robot("gantry_tau")), "bam")


def test_mjlab_takes_each_drive(arm, monkeypatch):
    """A motor a joint with limits, armature, friction and the delay in steps of the simulation."""
    delays = dict.fromkeys(arm.robot.actuated, 0.011)
    left = execute(build_drive_files(arm, "mjlab", delays)[""].text, "mjlab.actuator", monkeypatch)
    first = left["ACTUATORS"][0].values
    assert len(left["ACTUATORS"]) == 2 and first["target_names_expr"] == (arm.robot.actuated[0],)
    assert (first["armature"], first["frictionloss"], first["viscous_damping"]) == (0.2, 2.5, 1.5)
    assert first["delay_min_lag"] == first["delay_max_lag"] == round(0.011 / left["TIMESTEP"]) == 2
    said = build_drive_files(arm, "mjlab")[""].left_out
    assert any("delays are unknown" in s for s in said) and any("stribeck" in s for s in said)


def test_isaac_lab_groups_drives_by_delay(arm, monkeypatch):
    """Breakaway friction is Coulomb and Stribeck together; drives with other delays are another group."""
    one, other = arm.robot.actuated
    left = execute(
        build_drive_files(arm, "isaaclab", {one: 0.01, other: 0.02})[""].text, "isaaclab.actuators", monkeypatch
    )
    first, second = (group.values for group in left["ACTUATORS"].values())
    assert first["joint_names_expr"] == [one] and second["min_delay"] == second["max_delay"] == 4
    assert_allclose([first["friction"][one], first["dynamic_friction"][one]], [3.2, 2.5])
    assert first["viscous_friction"] == {one: 1.5} and first["armature"] == {one: 0.2}
    plain = execute(build_drive_files(arm, "isaaclab")[""].text, "isaaclab.actuators", monkeypatch)
    assert type(plain["ACTUATORS"]["drives_1"]).__name__ == "ImplicitActuatorCfg"


def test_what_is_unknown_is_not_written(write):
    """A robot without an identified model has limits alone; zero friction would be a claim."""
    made = build_drive_files(Model.of(load_robot_from_urdf(write.two_link(), "arm")), "mjlab")[""]
    assert "frictionloss" not in made.text and any(
        "friction of all drives is unknown" in sentence for sentence in made.left_out
    )


def test_effects_without_a_place_are_named(arm):
    """A ripple fits in none of the three."""
    robot = arm.robot
    ripple = Model.of(robot, [EFFECTS["cyclic_ripple"](robot.actuated, robot.force_units)])
    for target in ("bam", "mjlab", "isaaclab"):
        one = next(iter(build_drive_files(ripple, target).values()))
        assert any("cyclic_ripple" in sentence for sentence in one.left_out)
