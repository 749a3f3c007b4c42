"""Friction in proportion to load: on paper, on a Gantry-Tau's guideways, where nothing gives a load."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import LoadFriction, Motion
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

JOINTS = ("cart1", "cart2", "cart3")


def test_a_kilogram_more_on_the_plate_adds_friction(rng) -> None:
    """The force is `mu |load| sign(v)`: against the motion, and larger under a heavier plate on every guideway it loads more."""
    robot = load_robot("gantry_tau")
    plate = robot.parameters["plate_link.mass"].value
    q = robot.home + rng.uniform(-0.2, 0.2, (20, 3))
    v, a = rng.standard_normal((20, 3)), np.zeros((20, 3))
    forces = []
    for mass in (plate, plate + 1.0):
        loaded = robot.with_parameters(robot.parameters.with_values({"plate_link.mass": mass}))
        model = Model.of(loaded, [LoadFriction(JOINTS, ["N"] * 3)])
        model = model.with_values({f"{j}.load_friction": 0.05 for j in JOINTS})
        motion = model.motion(q, v, a)
        load = model.mechanism.guide_load(q, v, a)
        forces.append(model.effect_force(motion))
        assert_allclose(forces[-1], 0.05 * load * np.sign(v))
        assert np.all(np.sign(forces[-1]) == np.sign(v))
    assert np.abs(forces[1]).sum() > np.abs(forces[0]).sum()


def test_the_loads_sign_does_not_matter(rng) -> None:
    """A guide rubs whichever way it is pressed: friction grows with the load's size, monotonically."""
    v = rng.standard_normal((30, 1))
    load = np.sort(rng.uniform(-50, 50, (30, 1)), axis=0)
    effect = LoadFriction(("axis",), ["N"])
    column = effect.columns(Motion.of(("axis",), v, v, v, signals={"load": load}))[:, 0, 0]
    assert_allclose(column, np.abs(load[:, 0]) * np.sign(v[:, 0]))
    order = np.argsort(np.abs(load[:, 0]))
    assert np.all(np.diff(np.abs(column[order])) >= 0)
    (parameter,) = effect.parameters
    assert parameter.lower == 0 and parameter.unit == "1"


def test_it_says_so_where_no_load_is_given(rng) -> None:
    """Without the mechanism's load there is nothing to be proportional to."""
    v = rng.standard_normal((3, 1))
    with raises_code("unsupported"):
        LoadFriction(("axis",), ["N"]).columns(Motion.of(("axis",), v, v, v))


def test_words_give_the_share_of_the_load() -> None:
    """A person reads a percentage."""
    effect = LoadFriction(("axis",), ["N"])
    said = effect.describe(effect.parameters.with_values({"axis.load_friction": 0.05}))
    assert said == "friction of 5 % of the load that its guide or reducer carries"
