"""Mass that only gravity feels, for many samples at once and one by one: on paper, and wherever a mechanism speaks of forces."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import TreeMechanism
from tau_dyn.mechanism.tree import SamplewiseTree
from tau_dyn.robot import load_robot, load_robot_from_urdf

EXTRA = {"simplified": 22.38, "complete": 15.0}
N = 20


def hanging(write, kilograms: float):
    """Return two rods of 0.4 and 0.3 m whose second link weighs so much more at its joint, to gravity alone."""
    note = f'<tau_dyn:gravity_mass link="lower_link" value="{kilograms}"/></robot>'
    return load_robot_from_urdf(write.two_link().replace("</robot>", note), "arm")


@pytest.mark.parametrize("n", [3, N])
def test_a_weight_at_the_elbow_is_held_by_the_shoulder(write, rng, n: int) -> None:
    """`m g l cos(q)` at the shoulder, nothing at the elbow that it hangs on, whatever the motion."""
    plain, heavy = (TreeMechanism(hanging(write, m)) for m in (0.0, 2.5))
    q, v, a = rng.standard_normal((3, n, 2))
    more = heavy.inverse_dynamics(q, v, a) - plain.inverse_dynamics(q, v, a)
    assert_allclose(more, np.column_stack([-2.5 * 9.81 * 0.4 * np.cos(q[:, 0]), np.zeros(n)]), atol=1e-10)
    arms, gravity = heavy.weight_arms(q).rates - plain.weight_arms(q).rates, heavy.model.gravity.linear
    assert_allclose(-(arms @ gravity).sum(axis=2), more, atol=1e-10)
    column = heavy.regressor(q, v, a)[:, :, -1]
    assert heavy.robot.parameters.names[-1] == "lower_link.gravity_mass"
    assert_allclose(2.5 * column, more, atol=1e-10)
    assert_allclose(heavy.inertia(q), plain.inertia(q), rtol=1e-12)
    assert_allclose(heavy.guide_load(q, v, a), np.abs(heavy.inverse_dynamics(q, v, a)), rtol=1e-12)


def test_weight_arms_have_the_lever_of_such_a_mass(write, rng) -> None:
    """A weight 0.1 m off its joint is held as gravity on its lever says."""
    fixed = '<link name="hook"/><joint name="bolt" type="fixed"><origin xyz="0.1 0.02 0"/><parent link="lower_link"/>'
    note = f'{fixed}<child link="hook"/></joint><tau_dyn:gravity_mass link="hook" value="2.5"/></robot>'
    heavy = TreeMechanism(load_robot_from_urdf(write.two_link().replace("</robot>", note), "arm"))
    q = rng.standard_normal((N, 2))
    tau = -(heavy.weight_arms(q).rates @ heavy.model.gravity.linear).sum(axis=2)
    assert_allclose(tau, heavy.inverse_dynamics(q, 0 * q, 0 * q), atol=1e-10)


@pytest.mark.parametrize("arms", EXTRA)
def test_many_at_once_are_as_one_by_one(motion, arms: str) -> None:
    """Forces, columns, guide forces and their sizes of a Gantry-Tau whose plate gravity feels as heavier."""
    robot = load_robot("gantry_tau", arms=arms, gravity_mass=EXTRA[arms])
    each, many = SamplewiseTree(robot), TreeMechanism(robot)
    q, v, a = motion(robot, N)
    for name in ("regressor", "inverse_dynamics", "guide_force", "guide_load"):
        one, other = getattr(each, name)(q, v, a), getattr(many, name)(q, v, a)
        assert_allclose(other, one, rtol=0, atol=1e-10 * np.abs(one).max(), err_msg=name)


@pytest.mark.parametrize("arms", EXTRA)
def test_guideways_hold_it_up(motion, arms: str) -> None:
    """At rest what the guideways carry grows by its weight, all of it and straight down."""
    light, heavy = (load_robot("gantry_tau", arms=arms, gravity_mass=m) for m in (0.0, EXTRA[arms]))
    q, v, _ = motion(heavy, N)
    down = [TreeMechanism(r).guide_force(q, 0 * v, 0 * v).sum(axis=1) for r in (light, heavy)]
    assert_allclose(down[1] - down[0], np.tile([0, 0, -9.81 * EXTRA[arms]], (N, 1)), atol=1e-8)
