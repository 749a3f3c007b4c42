"""What a model computes for its effects, and what it takes over from another: against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf


def with_effects(robot: Robot, *names: str, **values: float) -> Model:
    """Return a model of these effects on all joints, with symmetric friction; values by quantity."""
    effects = [*build_friction_model("symmetric", robot.actuated, robot.force_units)]
    effects += [EFFECTS[name](robot.actuated, robot.force_units) for name in names]
    model = Model.of(robot, effects)
    return model.with_values({n: values.get(n.rsplit(".", 1)[-1], 0.0) for n in model.effect_parameters.names})


def test_damping_is_the_slope_of_friction(two_link) -> None:
    """Viscous 3 and drag 0.5 grow with speed by `3 + 2 0.5 |v|`, also at 1 and 10 m/s; Coulomb friction and forces do not."""
    model = with_effects(
        two_link, "quadratic_drag", "drive_gain", viscous=3.0, coulomb=7.0, quadratic_drag=0.5, gain_error=0.1
    )
    v = np.array([[0.5, -2.0], [10.0, 1.0]])
    motion = model.motion(np.zeros((2, 2)), v, np.zeros((2, 2)))
    assert_allclose(model.damping(motion), 3.0 + 2 * 0.5 * np.abs(v), rtol=1e-6)


def test_a_gain_scales_all_other_forces(two_link, rng) -> None:
    """`(1 + 0.1)` times rigid body and friction; without the effect nobody asks for the force."""
    plain = with_effects(two_link, viscous=3.0, coulomb=7.0)
    scaled = with_effects(two_link, "drive_gain", viscous=3.0, coulomb=7.0, gain_error=0.1)
    q, v, a = rng.standard_normal((3, 5, 2))
    assert_allclose(scaled.torque(q, v, a), 1.1 * plain.torque(q, v, a), rtol=1e-12)
    assert plain.motion(q, v, a).signals == {}
    assert set(plain.motion(q, v, a, needs=["inertia", "damping"]).signals) == {"inertia", "damping"}


def test_what_is_measured_is_not_computed_over(two_link, rng) -> None:
    """A force and a load that somebody gives are taken as they are."""
    model = with_effects(two_link, "drive_gain", "load_friction", gain_error=0.1)
    q, v, a = rng.standard_normal((3, 4, 2))
    given = {"force": np.full((4, 2), 5.0), "load": np.full((4, 2), 2.0)}
    motion = model.motion(q, v, a, signals=given)
    assert all(motion.signal(name) is given[name] for name in given)


def test_a_motions_options_are_told_by_name(two_link, rng) -> None:
    """A time mistaken for a sign of the speed would be friction out of nowhere; positions may be named."""
    model = with_effects(two_link, viscous=3.0, coulomb=7.0)
    q, v, a = rng.standard_normal((3, 4, 2))
    for ask in (model.torque, model.regressor, model.motion):
        with pytest.raises(TypeError):
            ask(q, v, a, None, 0.01 * np.arange(4))
        ask(q=q, v=v, a=a, sign=np.sign(v), t=0.01 * np.arange(4))


def test_values_go_over_to_another_robots_geometry(write, rng) -> None:
    """The same masses and friction on longer links, untied as they were: forces are those of the longer robot."""
    short = load_robot_from_urdf(write.block(), "short").untied(["block_link.mx"])
    urdf = write.block().replace('<origin xyz="0 0 0" rpy', '<origin xyz="0 0 1" rpy')
    model = with_effects(short, viscous=3.0).with_values({"block_link.mass": 8.0, "block_link.mx": 0.7})
    moved = model.on(load_robot_from_urdf(urdf, "long"))
    assert moved.robot.source == "long" and moved.parameters.names == model.parameters.names
    assert_allclose(moved.parameters.values, model.parameters.values)
    q, v, a = rng.standard_normal((3, 4, 1))
    assert_allclose(moved.torque(q, v, a), 8.0 * a + 3.0 * v, rtol=1e-12)


def test_values_of_another_robot_are_refused(two_link, block) -> None:
    """A robot with other links is not this one at another size, nor one with a parameter more that is no inertia."""
    with raises_code("unknown_name"):
        with_effects(two_link).on(block)
    heavy = load_robot("gantry_tau", gravity_mass=22.38)
    with raises_code("mismatch", "plate_link.gravity_mass"):
        with_effects(heavy).on(load_robot("gantry_tau"))


def test_parameters_of_other_effects_are_refused(two_link) -> None:
    """Values are exchanged one for one."""
    one, other = with_effects(two_link), with_effects(two_link, "quadratic_drag")
    with raises_code("unknown_name", "drag"):
        one.with_parameters(other.parameters)
    assert one.with_parameters(one.parameters).parameters.names == one.parameters.names


def test_a_part_of_the_effects_keeps_its_values(two_link, rng) -> None:
    """Drag alone is `0.5 v |v|`; what a delay distorts is left out of what a state determines."""
    model = with_effects(two_link, "quadratic_drag", "delay", viscous=3.0, quadratic_drag=0.5, delay=0.01)
    q, v, a = rng.standard_normal((3, 4, 2))
    drag = model.only(e for e in model.effects if e.name == "quadratic_drag")
    rigid = model.mechanism.inverse_dynamics(q, v, a)
    assert_allclose(drag.torque(q, v, a) - rigid, 0.5 * v * np.abs(v), atol=1e-12)
    assert "delay" not in {e.name for e in model.steady().effects}
    assert_allclose(model.steady().torque(q, v, a) - rigid, 3.0 * v + 0.5 * v * np.abs(v), atol=1e-12)
    with raises_code("unsupported"):
        model.torque(q, v, a)


def test_files_of_today_stay_readable(two_link, tmp_path) -> None:
    """A model file calls itself format 1, which is what every one out there does."""
    with_effects(two_link).save(tmp_path / "m.yaml")
    text = (tmp_path / "m.yaml").read_text()
    assert text.startswith("tau_dyn_model: 1\n")
    assert Model.load(tmp_path / "m.yaml").parameters.names == with_effects(two_link).parameters.names


def test_damping_at_rest_is_viscous_friction_alone(two_link) -> None:
    """Standing still friction grows with speed by its viscous coefficient; drag has no slope there."""
    model = with_effects(two_link, "quadratic_drag", viscous=3.0, coulomb=7.0, quadratic_drag=0.5)
    zero = np.zeros((3, 2))
    assert_allclose(model.damping(model.motion(zero, zero, zero)), 3.0, rtol=1e-5)
