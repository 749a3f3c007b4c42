"""What effects feel of a mechanism: loads on guides, passive bearings, the tool's sensitivity; closed form, tree and paper."""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element, fromstring, tostring

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import GantryTauMechanism, TreeMechanism, build_mechanism
from tau_dyn.mechanism.tree import SamplewiseTree
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf


@pytest.mark.parametrize("kind", ["l1 simplified uniform", "d1 simplified uniform", "l2 simplified point"])
def test_closed_form_and_tree_put_the_same_load_on_the_guideways(robots, motion, kind: str) -> None:
    """Rods' equations of motion against the loops' constraint forces in Pinocchio's recursion, to 1e-9 N."""
    robot = robots(kind)
    closed, tree = GantryTauMechanism(robot), TreeMechanism(robot)
    q, v, a = motion(robot)
    assert_allclose(closed.guide_force(q, v, a), tree.guide_force(q, v, a), atol=1e-9)
    assert_allclose(closed.guide_load(q, v, a), tree.guide_load(q, v, a), atol=1e-9)
    assert closed.guide_load(q, v, a).min() > 0.1


def test_mass_that_only_gravity_feels_loads_the_guideways_too(motion) -> None:
    """The thesis' heavier plate under gravity: both ways of computing agree, and the load grows."""
    light, heavy = load_robot("gantry_tau"), load_robot("gantry_tau", gravity_mass="40")
    q, v, a = motion(heavy)
    closed = GantryTauMechanism(heavy).guide_force(q, v, a)
    assert_allclose(closed, TreeMechanism(heavy).guide_force(q, v, a), atol=1e-9)
    rest = np.zeros_like(q)
    loads = [np.linalg.norm(GantryTauMechanism(r).guide_load(q, rest, rest)) for r in (light, heavy)]
    assert loads[1] > 1.5 * loads[0]


def test_guideways_carry_the_moving_weight(robots, motion) -> None:
    """At rest the guideways along x hold up plate and rods: the forces across them sum to their weight."""
    robot = robots("l1 simplified uniform")
    q, v, _ = motion(robot)
    force = build_mechanism(robot).guide_force(q, 0 * v, 0 * v).sum(axis=1)
    hanging = sum(p.value for p in robot.parameters if p.name.startswith(("rod", "plate")))
    assert_allclose(force, np.tile([0.0, 0.0, -9.81 * hanging], (len(q), 1)), atol=1e-9)


def test_complete_arms_carry_the_same_weight(robots, motion) -> None:
    """Six rods share it, but what they put down on the three guideways is all of it."""
    robot = robots("l1 complete uniform")
    q, v, _ = motion(robot, 4)
    force = build_mechanism(robot).guide_force(q, 0 * v, 0 * v).sum(axis=1)
    hanging = sum(p.value for p in robot.parameters if p.name.startswith(("rod", "plate")))
    assert_allclose(force[:, 2], -9.81 * hanging, rtol=1e-9)


def test_a_loop_may_name_its_bodies_the_other_way(robots, motion) -> None:
    """Plate and rod exchanged in every ball constraint: the guideways bear the same, sample by sample and all at once."""
    robot = robots("l1 simplified uniform")
    other = {"body_A": "body_B", "body_B": "body_A", "p_AP": "p_BQ", "p_BQ": "p_AP"}
    text = re.sub(r"(?<=ball_constraint_)(body_A|body_B|p_AP|p_BQ)", lambda m: other[m[0]], robot.urdf)
    turned = load_robot_from_urdf(text, "turned", actuated=robot.actuated)
    ends = [
        [r.model.frames[f].parentJoint for loop in r.loops for f in (loop.frame_a, loop.frame_b)]
        for r in (turned, robot)
    ]
    assert ends[0][::2] == ends[1][1::2]
    q, v, a = motion(robot, 6)
    for tree in (SamplewiseTree, TreeMechanism):
        assert_allclose(tree(turned).guide_force(q, v, a), tree(robot).guide_force(q, v, a), atol=1e-9)


def slide_text(write) -> str:
    """Return a slide along x that carries a pendulum bar turning about y, both driven."""
    slide = write.link("slide_link", 5) + write.joint("slide", "prismatic", "base_link", "slide_link", "1 0 0")
    bar = write.rod("bar_link", 2, 0.4) + write.joint("bar", "revolute", "slide_link", "bar_link", "0 1 0")
    return write.text("slide", slide, bar, write.drive("slide"), write.drive("bar"))


def test_load_of_a_pendulum_on_a_slide_is_newtons(write, rng) -> None:
    """A bar on a slide pulls across it with `m (g + z'')`; the hinge's load is the size of its torque."""
    robot = load_robot_from_urdf(slide_text(write), "slide")
    mechanism = build_mechanism(robot)
    q, v, a = rng.standard_normal((3, 6, 2))
    turn, speed, change = q[:, 1], v[:, 1], a[:, 1]
    lift = -0.2 * (
        np.cos(turn) * change - np.sin(turn) * speed**2
    )  # centre 0.2 m along x, turned about y: z = -0.2 sin
    assert_allclose(mechanism.guide_force(q, v, a)[:, 0, 2], -2 * (9.81 + lift), rtol=1e-9)
    assert_allclose(mechanism.guide_force(q, v, a)[:, 0, 0], 0, atol=1e-12)
    assert_allclose(mechanism.guide_load(q, v, a)[:, 1], np.abs(mechanism.inverse_dynamics(q, v, a)[:, 1]), rtol=1e-9)


def test_serial_arms_have_no_passive_bearings(two_link, rng) -> None:
    """All joints are driven: an empty list, and loads that are torques."""
    mechanism = build_mechanism(two_link)
    q, v, a = rng.standard_normal((3, 5, 2))
    names, rates = mechanism.passive_rates(q)
    assert names == () and rates.shape == (5, 0, 3, 2)
    assert_allclose(mechanism.guide_load(q, v, a), np.abs(mechanism.inverse_dynamics(q, v, a)))
    assert not mechanism.guide_force(q, v, a).any()


def test_a_drives_own_inertia_does_not_load_its_reducer(write, rng) -> None:
    """A rotor of 3 kg m^2 at the joint changes the motor's torque, not the load."""
    rotor = '<drake:rotor_inertia value="3"/><drake:gear_ratio value="1"/>'
    plain, heavy = (
        load_robot_from_urdf(write.pendulum(2.0, 0.5, write.drive("pivot", r)), "pendulum") for r in ("", rotor)
    )
    q, v, a = rng.standard_normal((3, 5, 1))
    loads = [build_mechanism(r).guide_load(q, v, a) for r in (plain, heavy)]
    torques = [build_mechanism(r).inverse_dynamics(q, v, a) for r in (plain, heavy)]
    assert_allclose(loads[1], loads[0])
    assert_allclose(torques[1] - torques[0], 3 * a)


def test_closed_form_and_tree_turn_the_rods_alike(robots, motion) -> None:
    """Both of the tree's ends of a rod (universal joint, cut ball) turn as the closed form's one pair, spin about it aside."""
    robot = robots("d1 simplified uniform")
    closed, tree = GantryTauMechanism(robot), TreeMechanism(robot)
    q, _, _ = motion(robot)
    names, ours = closed.passive_rates(q)
    assert names == ("rod1", "rod2", "rod3")
    tree_names, theirs = tree.passive_rates(q)
    assert tree_names[:2] == ("rod1_yaw+rod1_pitch", "rod2_yaw+rod2_pitch") and tree_names[3:] == tuple(
        f"rod{i}-plate" for i in (1, 2, 3)
    )
    carts = closed.origin + q[:, :, None] * closed.direction
    along = (closed.tool_position(q)[:, None] - carts) / closed.length[:, None]
    for k, name in enumerate(tree_names):
        i = int(name[3]) - 1
        u = along[:, i, :, None]
        across = theirs[:, k] - u * np.sum(u * theirs[:, k], axis=1, keepdims=True)
        assert_allclose(np.abs(across), np.abs(ours[:, i]), atol=1e-10)
        assert_allclose(np.sum(u * ours[:, i], axis=1), 0, atol=1e-12)


def test_a_four_bars_hinges_turn_as_finite_differences_say(four_bar) -> None:
    """Coupler and rocker are hinges, the cut is a ball: its rate is what is left of the sum around the loop."""
    mechanism = TreeMechanism(four_bar)
    q = np.linspace(-0.5, 0.5, 5)[:, None]
    names, rates = mechanism.passive_rates(q)
    assert names == ("coupler", "rocker", "coupler-rocker")
    step = 1e-6
    for k, x in enumerate(q):
        ends = [mechanism.solver.close(x + s) for s in (step, -step)]
        expected = ((ends[0] - ends[1]) / (2 * step))[1:]
        assert_allclose(rates[k, :2, 0, 0], expected, atol=1e-7)
        assert_allclose(rates[k, 2, :, 0], [0, 0, 1 + expected[0] - expected[1]], atol=1e-7)


@pytest.mark.parametrize("kind", ["l1 simplified uniform", "l1 complete uniform", "slide"])
def test_tool_jacobian_is_the_positions_derivative(robots, motion, write, kind: str) -> None:
    """Against central differences of the tool's position, to 1e-7."""
    end = '<parent link="bar_link"/><child link="tool"/><origin xyz="0.4 0 0"/>'
    tool = f'<link name="tool"/><joint name="end" type="fixed">{end}</joint></robot>'
    slide = slide_text(write).replace("</robot>", tool)
    robot = load_robot_from_urdf(slide, kind) if kind == "slide" else robots(kind)
    mechanism = build_mechanism(robot)
    q, _, _ = motion(robot, 4, 0.15)
    J = mechanism.tool_jacobian(q)
    for k in range(robot.na):
        step = 1e-5 * np.eye(robot.na)[k]
        expected = (mechanism.tool_position(q + step) - mechanism.tool_position(q - step)) / 2e-5
        assert_allclose(J[:, :, k], expected, atol=1e-7)


@pytest.mark.parametrize("kind", ["l1 simplified uniform", "d1 simplified uniform", "l1 complete uniform"])
def test_a_shifted_cart_shifts_the_tool_as_a_shifted_guideway_does(robots, motion, kind: str) -> None:
    """Along its axis a cart's shift is its motion; in every direction it is what moving the guideway's origin does."""
    robot = robots(kind)
    mechanism = build_mechanism(robot)
    q, _, _ = motion(robot, 3, 0.15)
    S = mechanism.cart_sensitivity(q)
    axis = np.array([float(x) for x in str(part(fromstring(robot.urdf), "axis").get("xyz")).split()])
    along = S[:, :, 1] @ (axis / np.linalg.norm(axis))
    assert_allclose(along, mechanism.tool_jacobian(q)[:, :, 1], atol=1e-9)
    for k in range(3):
        ends = [build_mechanism(shifted(robot, k, step)).tool_position(q) for step in (1e-5, -1e-5)]
        assert_allclose(S[:, :, 1, k], (ends[0] - ends[1]) / 2e-5, atol=1e-6)


def part(root: Element, tag: str) -> Element:
    """Return an element of the second cart's joint."""
    found = root.find(f"joint[@name='cart2'][@type='prismatic']/{tag}")
    assert found is not None
    return found


def shifted(robot: Robot, k: int, step: float) -> Robot:
    """Return the robot with its second guideway shifted along one axis."""
    root = fromstring(robot.urdf)
    origin = part(root, "origin")
    place = [float(x) for x in str(origin.get("xyz")).split()]
    place[k] += step
    origin.set("xyz", " ".join(repr(x) for x in place))
    return load_robot_from_urdf(tostring(root, encoding="unicode"), "shifted", actuated=robot.actuated)


def test_a_tool_is_needed_to_say_how_it_moves(four_bar) -> None:
    """A robot file without a frame named tool is told so."""
    with raises_code("unsupported"):
        TreeMechanism(four_bar).tool_jacobian(np.zeros((1, 1)))
