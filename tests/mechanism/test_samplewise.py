"""A link that stands off its place moves the tool: against a robot file that puts it there."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import TreeMechanism
from tau_dyn.robot import Robot, load_robot_from_urdf

STEP = 1e-5


def shifted(robot: Robot, joint: str, by: np.ndarray) -> TreeMechanism:
    """Return the mechanism whose joint stands elsewhere by this (3,) [m], in base axes: its parent is the base."""
    pattern = rf'(<joint name="{joint}"[^>]*>.*?<origin[^>]*?xyz=")([^"]*)(")'
    place = re.search(pattern, robot.urdf, re.DOTALL)
    assert place is not None and "</joint>" not in place[0]
    there = " ".join(f"{x:.15g}" for x in np.array(place[2].split(), float) + by)
    return TreeMechanism(
        load_robot_from_urdf(re.sub(pattern, rf"\g<1>{there}\g<3>", robot.urdf, count=1, flags=re.DOTALL), "shifted")
    )


@pytest.mark.parametrize("kind", ["l1 simplified uniform", "l1 complete uniform"])
def test_the_tool_follows_a_cart_off_its_line_as_the_file_says(robots, motion, kind: str) -> None:
    """Central differences over robot files with one guideway moved by 10 um, for every cart and direction."""
    robot = robots(kind)
    q, _, _ = motion(robot, 2)
    expected = np.empty((2, 3, robot.na, 3))
    for i, joint in enumerate(robot.actuated):
        for k, unit in enumerate(np.eye(3)):
            ahead, behind = (shifted(robot, joint, s * STEP * unit).tool_position(q) for s in (1, -1))
            expected[:, :, i, k] = (ahead - behind) / (2 * STEP)
    assert_allclose(TreeMechanism(robot).cart_sensitivity(q), expected, atol=1e-5)


def test_an_arm_carries_its_tool_along(two_link, write) -> None:
    """Without loops the tool moves as the shifted link does, whichever it is: by one for one."""
    tool = '<link name="tool"/><joint name="t" type="fixed"><parent link="lower_link"/><child link="tool"/></joint>'
    robot = load_robot_from_urdf(write.two_link().replace("</robot>", tool + "</robot>"), "arm")
    found = TreeMechanism(robot).cart_sensitivity(np.array([[0.3, -0.4]]))
    assert_allclose(found[0].transpose(1, 0, 2), [np.eye(3)] * 2)


@pytest.mark.parametrize("mx", [0.0, 0.3])
def test_a_link_whose_mass_comes_out_as_nothing_still_moves(two_link, rng, mx: float) -> None:
    """A bound may leave no mass, and free first moments: `tau = M a + h` is the parameters' sum; with none, one rod is left."""
    robot = two_link.untied(["lower_link.mx"])
    gone = dict.fromkeys((n for n in robot.parameters.names if n.startswith("lower_link")), 0.0)
    values = robot.parameters.with_values({**gone, "lower_link.mx": mx, "elbow.armature": 0.7})
    mechanism = TreeMechanism(robot.with_parameters(values))
    q, v, a = rng.standard_normal((3, 3, 2))
    tau = mechanism.regressor(q, v, a) @ values.values
    assert_allclose(mechanism.inverse_dynamics(q, v, a), tau, rtol=1e-12)
    for k in range(3):
        M, h = mechanism.mass_and_bias(q[k], v[k])
        assert_allclose(M @ a[k] + h, tau[k], rtol=1e-11, atol=1e-12)
        if not mx:
            assert_allclose(M, np.diag([3 * 0.4**2 / 3, 0.7]), atol=1e-12)
            assert_allclose(h, [-3 * 9.81 * 0.2 * np.cos(q[k, 0]), 0], atol=1e-12)
