"""Inverse kinematics: all configurations, there and back with forward kinematics, and what cannot be reached."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics import build_inverse_table
from tau_dyn.mechanism import (
    Poses,
    RootChain,
    build_chains,
    build_kinematics,
    build_rods,
    forward_kinematics,
    inverse_kinematics,
    jacobian,
    solve_all_configurations,
)
from tau_dyn.mechanism.chain_inverse import NewtonChain
from tau_dyn.robot import load_robot, load_robot_from_urdf

ROBOTS = [
    ("gantry_tau", {}, 0.4),
    ("gantry_tau", {"arms": "complete", "prototype": "d1"}, 0.3),
    ("gantry_tau_5dof", {}, 0.05),
    ("gantry_tau_f1", {}, 0.1),
    ("gantry_tau_queensland", {}, 0.2),
    ("gantry_tau_t2", {}, 0.03),
    ("delta", {}, 0.3),
    ("hexa_321", {}, 0.03),
    ("hexaglide", {}, 0.03),
    ("hexarot", {}, 0.05),
    ("scara_tau", {}, 0.1),
    ("stewart", {}, 0.05),
    ("triglide", {}, 0.1),
]


SLOWER = ("gantry_tau_5dof", "gantry_tau_f1", "gantry_tau_t2")


@pytest.mark.parametrize(("name", "arguments", "reach"), ROBOTS, ids=[f"{n}{len(a)}" for n, a, _ in ROBOTS])
def test_there_and_back(name, arguments, reach, rng):
    """IK(FK(q)) finds q among its configurations, FK(IK(x)) is x, to 1e-11, at random positions."""
    robot = load_robot(name, **arguments)
    n = 15 if name in SLOWER else 100
    q = robot.home + reach * rng.uniform(-1, 1, (n, robot.na))
    forward = forward_kinematics(robot, q)
    ok = forward.ok
    assert ok.mean() > 0.8
    poses, q = forward.poses.take(ok), q[ok]
    m = 1 if name in SLOWER else 4
    solutions = solve_all_configurations(robot, poses.take(slice(m)))
    away = np.nan_to_num(np.abs(solutions - q[:m, None]).max(axis=2), nan=np.inf).min(axis=1)
    assert away.max() < 1e-10  # a chain near its dead centre loses a digit
    back = inverse_kinematics(robot, poses, limits=False)
    assert back.ok.all()
    again = forward_kinematics(robot, back.q, start=poses)
    assert again.ok.all()
    assert_allclose(again.poses.position, poses.position, atol=1e-11)
    assert_allclose(again.poses.rotation, poses.rotation, atol=1e-11)
    assert np.nanmax(back.orientation_error) < 1e-9


@pytest.mark.parametrize("arms", ["simplified", "complete"])
def test_eight_configurations(arms, rng):
    """Each of the three arms has its cart ahead of or behind its rod: 2^3 solutions, each closing every rod (thesis 4.2)."""
    robot = load_robot("gantry_tau", arms=arms)
    rods = build_rods(robot)
    poses = forward_kinematics(robot, robot.home + rng.uniform(-0.4, 0.4, (30, 3))).poses
    solutions, signs = solve_all_configurations(rods, poses), rods.configurations
    assert solutions.shape == (30, 8, 3) and len(signs) == 8
    for k in range(8):
        assert np.abs(rods.gap(solutions[:, k], rods.plate_poses(poses))).max() < 1e-11
        assert_allclose(
            inverse_kinematics(rods, poses, configuration=signs[k], limits=False).q, solutions[:, k], atol=1e-11
        )
    assert len(np.unique(np.round(solutions[0], 6), axis=0)) == 8
    home = int(np.flatnonzero((signs == build_kinematics(rods).home_configuration).all(axis=1))[0])
    assert_allclose(inverse_kinematics(rods, poses, limits=False).q, solutions[:, home], atol=1e-11)


@pytest.mark.parametrize("name", ["gantry_tau", "delta", "stewart", "hexarot"])
def test_closed_forms_equal_newton(name, rng):
    """Slide, turn and leg: the root of each chain satisfies its rod, and Newton started beside it comes back to it."""
    robot = load_robot(name)
    rods = build_rods(robot)
    plate = forward_kinematics(robot, robot.home + 0.03 * rng.standard_normal((50, robot.na))).plate
    B = rods.plate_points(plate).transpose(1, 2, 0)
    for chain in build_chains(rods):
        assert isinstance(chain, RootChain)
        newton = NewtonChain(rods, chain.rods[:1], chain.actuators)
        for sign in chain.signs:
            q = chain.solve(B[chain.rods[0]], sign)
            again = newton.wrapped(newton.newton(B[[chain.rods[0]]], q + 1e-4))
            assert_allclose(again, q, atol=1e-11)


def test_chains_of_several_actuators_have_all_their_solutions(rng):
    """F1's arms 2 and 3: many starts find the true positions and others, each closing all rods."""
    robot = load_robot("gantry_tau_f1")
    rods = build_rods(robot)
    q = robot.home + 0.1 * rng.uniform(-1, 1, (2, 6))
    plate = forward_kinematics(robot, q).plate
    solutions = solve_all_configurations(rods, rods.tool_poses(plate))
    assert np.isfinite(solutions[..., 0]).sum(axis=1).min() >= 8
    for k in range(solutions.shape[1]):
        there = np.isfinite(solutions[:, k, 0])
        if there.any():
            assert np.abs(rods.gap(solutions[there, k], plate.take(there))).max() < 1e-10


def test_fewer_actuators_take_the_position(rng):
    """Three carts, six rods of unequal length (D1): the position asked for is met, the orientation follows and is told."""
    robot = load_robot("gantry_tau", prototype="d1", arms="complete")
    home = forward_kinematics(robot, robot.home).poses
    n = 30
    asked = Poses(home.position + rng.uniform(-0.2, 0.2, (n, 3)), np.repeat(home.rotation, n, axis=0))
    found = inverse_kinematics(robot, asked)
    assert found.ok.all() and 1e-6 < found.orientation_error.max() < 0.05
    reached = forward_kinematics(robot, found.q).poses
    assert_allclose(reached.position, asked.position, atol=1e-11)


def test_five_actuators_take_the_nearest_orientation(rng):
    """The orientation left is the nearest: any small motion that keeps the position turns the tool further away."""
    robot = load_robot("gantry_tau_5dof")
    home = forward_kinematics(robot, robot.home).poses
    turn = np.array([[np.cos(0.03), -np.sin(0.03), 0], [np.sin(0.03), np.cos(0.03), 0], [0, 0, 1.0]])
    asked = Poses(home.position, turn @ home.rotation)
    found = inverse_kinematics(robot, asked)
    assert found.ok[0]
    reached = forward_kinematics(robot, found.q).poses
    assert_allclose(reached.position, asked.position, atol=1e-11)
    J = jacobian(robot, found.q)[0]
    left = np.linalg.svd(J[:3])[2][3:].T  # motions that keep the position
    away = Rotation.from_matrix(asked.rotation[0] @ reached.rotation[0].T).as_rotvec()
    assert np.abs(away @ J[3:] @ left).max() < 1e-8


def test_reasons_and_culprits():
    """Out of reach, beyond a limit, not a number: each with the joints to blame."""
    robot = load_robot("gantry_tau")
    home = forward_kinematics(robot, robot.home).poses
    away = np.array([[0, 0, 0], [2.0, 0, 0], [0, 0, 9.0], [np.nan, 0, 0]])
    found = inverse_kinematics(robot, Poses(home.position + away, np.repeat(home.rotation, 4, axis=0)))
    assert found.reason.tolist() == ["", "joint limit", "out of reach", "not a number"]
    assert found.culprit[1] == "cart1 cart2 cart3" and found.culprit[2] == "cart1"
    assert np.isnan(found.q[1:]).all() and np.isfinite(found.unlimited[1]).all()


def test_beyond_a_singularity_is_another_branch(rng):
    """Stewart turned far: legs of the right length exist, but from home they lead to another pose; it is refused."""
    robot = load_robot("stewart")
    rods = build_rods(robot)
    home = forward_kinematics(robot, robot.home).poses
    turn = Rotation.from_rotvec(rng.uniform(-1.6, 1.6, (12, 3))).as_matrix()
    asked = Poses(np.repeat(home.position, 12, axis=0), turn @ home.rotation)
    named = inverse_kinematics(rods, asked, configuration=build_kinematics(rods).home_configuration, limits=False)
    found = inverse_kinematics(rods, asked, limits=False)
    assert named.ok.all() and set(found.reason) == {"", "branch change"}
    back = forward_kinematics(rods, named.q).poses.rotation
    same = np.abs(back - asked.rotation).max(axis=(1, 2)) < 1e-9
    assert same.any() and not same[~found.ok].any()


def test_inverted_limits_are_named():
    """A lower limit above the upper one is the file's fault."""
    robot = load_robot("gantry_tau")
    poses = forward_kinematics(robot, robot.home).poses
    wrong = replace(robot, model=robot.model.copy())
    wrong.model.lowerPositionLimit[wrong.active_q[1]] = 5.0
    with raises_code("robot_structure", "cart2"):
        inverse_kinematics(wrong, poses)


def test_unknown_configurations_are_refused():
    """A configuration holds one sign for each chain."""
    robot = load_robot("gantry_tau")
    poses = forward_kinematics(robot, robot.home).poses
    with raises_code("invalid_value", "configuration"):
        inverse_kinematics(robot, poses, configuration=(1, 1))


def test_a_tree_is_solved_as_well(rng):
    """H4: four actuators, three translations and a turn, through the tree's loops."""
    robot = load_robot("h4")
    q = robot.home + 0.05 * rng.uniform(-1, 1, (4, 4))
    poses = forward_kinematics(robot, q).poses
    back = inverse_kinematics(robot, poses, limits=False)
    assert back.ok.all()
    assert_allclose(back.q, q, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "arguments", "signs"),
    [
        ("gantry_tau", {}, [-1, -1, -1]),
        ("delta", {}, [1, 1, 1]),
        ("stewart", {}, [1] * 6),
        ("gantry_tau_f1", {}, [1, 0, 0]),
    ],
)
def test_which_configuration_is_homes(name, arguments, signs):
    """A chain with two roots has a sign, -1 the smaller one; a leg has one root, a chain of several actuators none."""
    robot = load_robot(name, **arguments)
    assert build_kinematics(robot).home_configuration.tolist() == signs


def test_redundant_actuators_stay_nearest_to_the_start(rng):
    """A telescopic arm on a cart can idle: of all positions with the same pose those nearest to the start are given."""
    robot = load_robot("gantry_tau_queensland", telescopic="true")
    rods = build_rods(robot)
    q = robot.home + 0.3 * rng.uniform(-1, 1, (40, 4))
    poses = forward_kinematics(robot, q).poses
    for start in (None, robot.home + 0.1, q):
        near = robot.home if start is None else start
        found = inverse_kinematics(robot, poses, start=start, limits=False)
        assert found.ok.all() and found.orientation_error.max() < 1e-9
        assert np.abs(rods.gap(found.q, rods.plate_poses(poses))).max() < 1e-11
        idle = np.linalg.svd(rods.gap_by_q(found.q, rods.plate_poses(poses)))[2][:, -1]
        assert np.abs(np.einsum("ni,ni->n", idle, found.q - near)).max() < 1e-9
    assert_allclose(found.q, q, atol=1e-9)  # the last start is the answer itself


@pytest.mark.parametrize("name", ["gantry_tau_queensland", "gantry_tau_5dof", "scara_tau", "h4"])
def test_poses_out_of_reach_do_not_change_their_neighbours(name, rng):
    """Alone, among others or backwards: the same answer; what is far away is out of reach, at a modest price."""
    robot = load_robot(name)
    home = forward_kinematics(robot, robot.home).poses
    n, wide = (5, 0.05) if name == "h4" else (24, 0.6)
    asked = Poses(home.position + wide * rng.uniform(-1, 1, (n, 3)), np.repeat(home.rotation, n, axis=0))
    asked.position[::4] += 50.0
    together = inverse_kinematics(robot, asked, limits=False)
    backwards = inverse_kinematics(robot, asked.take(slice(None, None, -1)), limits=False)
    assert backwards.reason[::-1].tolist() == together.reason.tolist()
    assert_allclose(backwards.q[::-1], together.q, atol=1e-9)
    assert set(together.reason[::4]) == {"out of reach"} and together.ok.any()
    for k in range(0, n, 5):
        assert_allclose(
            inverse_kinematics(robot, asked.take(slice(k, k + 1)), limits=False).q[0], together.q[k], atol=1e-9
        )


@pytest.mark.parametrize(
    ("name", "arguments"), [("gantry_tau", {"arms": "complete"}), ("triglide", {"arms": "complete"})]
)
def test_what_forward_kinematics_reaches_is_never_given_up(name, arguments, rng):
    """Over the whole travel of the actuators, every pose that exists in home's configuration is found again."""
    robot = load_robot(name, **arguments)
    rods = build_rods(robot)
    q = rng.uniform(robot.lower, robot.upper, (150, robot.na))
    forward = forward_kinematics(robot, q)
    homes = np.flatnonzero(forward.ok)
    signs = [rods.nearest_configuration(forward.poses.take(slice(k, k + 1)), q[k]) for k in homes.tolist()]
    homes = homes[(np.array(signs) == build_kinematics(rods).home_configuration).all(axis=1)]
    assert len(homes) > 20
    found = inverse_kinematics(robot, forward.poses.take(homes), limits=False)
    assert found.ok.all()
    assert_allclose(found.q, q[homes], atol=1e-9)


def test_a_planar_arm_closes_whatever_orientation_is_asked(write, rng):
    """Two hinges place the tool and cannot turn it as asked: the position is met to 1e-10 m all the same."""
    urdf = write.two_link()
    last = load_robot_from_urdf(urdf, "arm").links[-1].link
    tool = f'<joint name="tool" type="fixed"><origin xyz="0.3 0 0"/><parent link="{last}"/><child link="tool_link"/></joint>'
    arm = load_robot_from_urdf(urdf.replace("</robot>", f'<link name="tool_link"/>{tool}</robot>'), "arm")
    q = arm.home + rng.uniform(0.3, 1.0, (40, arm.na))
    there = forward_kinematics(arm, q).poses
    turned = Poses(there.position, Rotation.from_rotvec([0.4, 1.0, 2.0]).as_matrix() @ there.rotation)
    found = inverse_kinematics(arm, turned, start=q + 0.02, limits=False)
    assert found.ok.all()
    assert_allclose(forward_kinematics(arm, found.q).poses.position, there.position, atol=1e-10)


def test_an_arm_with_a_straight_wrist_at_home_keeps_the_orientation_asked_for():
    """At a singular home (arm and wrist straight) an axis idles that idles nowhere else: away from it all six freedoms answer."""
    robot = load_robot(Path(__file__).parents[2] / "experiments" / "lead_through_parts" / "irb140.urdf")
    q = robot.home + [0, 0, 0.8, 0, 0.8, 0] + np.random.default_rng(3).uniform(-0.4, 0.4, (20, 6))
    asked = forward_kinematics(robot, q).poses
    found = inverse_kinematics(robot, asked, start=q + 0.05)
    assert found.ok.all()
    assert found.orientation_error.max() < 1e-9


QUARTER = 0.5 * np.pi
ARM = [("0 0 0.3", "0 0 0"), ("0 0 0.1", f"{QUARTER} 0 0"), ("0.5 0 0", "0 0 0"), ("0.4 0 0", f"0 {QUARTER} 0")]
WRIST = [("0 0 0.1", f"{QUARTER} 0 0"), ("0 0.08 0", f"{-QUARTER} 0 0")]
BENT = [0.3, 0.5, 0.8, 0.2, 0.4, 0.6]


def arm_of(*places: tuple[str, str]):
    """Return an arm of hinges about the z axes of frames at these places, a tool at its end, bent at home."""
    rows = ['<robot name="arm" xmlns:tau_dyn="urn:tau_dyn"><link name="l0_link"/>']
    for k, (xyz, rpy) in enumerate(places, start=1):
        ends = f'<parent link="l{k - 1}_link"/><child link="l{k}_link"/><origin xyz="{xyz}" rpy="{rpy}"/>'
        limit = '<axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="50"/>'
        rows.append(f'<link name="l{k}_link"/><joint name="j{k}" type="revolute">{ends}{limit}</joint>')
    ends = f'<parent link="l{len(places)}_link"/><child link="tool_link"/><origin xyz="0 0 0.12"/>'
    rows.append(f'<link name="tool_link"/><joint name="tool" type="fixed">{ends}</joint>')
    rows += [f'<tau_dyn:home joint="j{k}" value="{x}"/>' for k, x in enumerate(BENT, start=1)]
    return load_robot_from_urdf("".join(rows) + "</robot>", "arm")


def test_an_elbow_as_good_as_straight_is_solved_like_any_other(rng):
    """Near the edge of reach the elbow hardly moves the tool: all poses are found, to rounding, from home and from nearby."""
    arm = arm_of(*ARM, *WRIST)
    q = arm.home + 0.3 * rng.uniform(-1, 1, (40, 6))
    q[:, 2] = rng.choice([-1, 1], 40) * 10.0 ** rng.uniform(-5, -1, 40)
    asked = forward_kinematics(arm, q).poses
    for start in (None, q + 1e-3 * rng.standard_normal(q.shape)):
        found = inverse_kinematics(arm, asked, start=start, limits=False)
        assert found.ok.all()
        assert found.orientation_error.max() < 1e-12 and found.position_error.max() < 1e-10


def test_an_arm_with_a_joint_to_spare_reaches_what_it_can_reach(rng):
    """Idling towards a home that is far from all solutions must not keep seven joints from a pose that they can take."""
    arm = arm_of(*ARM[:3], ("0 0 0", f"{QUARTER} 0 0"), ARM[3], *WRIST)
    q = arm.home + rng.uniform(-0.8, 0.8, (40, 7))
    q[:, 2] = 0.05 * rng.uniform(-1, 1, 40)
    asked = forward_kinematics(arm, q).poses
    found = inverse_kinematics(arm, asked, limits=False)
    assert found.ok.all() and found.orientation_error.max() < 1e-9
    again = forward_kinematics(arm, found.q).poses
    assert_allclose(again.position, asked.position, atol=1e-9)


def test_a_stock_arm_has_both_elbows_of_every_solution():
    """A UR5's solutions come in pairs with the elbow the other way, by its three parallel axes; twelve poses, none is missing."""
    robot = load_robot("ur5")
    q = np.random.default_rng(3).uniform(-2.8, 2.8, (12, 6))
    every = solve_all_configurations(robot, forward_kinematics(robot, q).poses)
    for true, rows in zip(q, every, strict=True):
        found = rows[np.isfinite(rows).all(axis=1)]
        away = (found[:, None] - found[None] + np.pi) % (2 * np.pi) - np.pi
        pairs = (np.abs(away[:, :, [0, 4]]).max(axis=2) < 1e-6) & (np.abs(found[:, None, 2] + found[None, :, 2]) < 1e-6)
        assert (pairs.sum(axis=1) == 1).all()
        assert np.abs((found - true + np.pi) % (2 * np.pi) - np.pi).max(axis=1).min() < 1e-6


def test_only_closed_forms_list_all_configurations():
    """The table of the simplified Gantry-Tau is complete; what many starts find is not proved to be."""
    for robot, complete in ((load_robot("gantry_tau"), True), (load_robot("gantry_tau_f1"), False)):
        poses = forward_kinematics(robot, robot.home[None]).poses
        assert build_inverse_table(robot, poses, all_configurations=True).complete is complete
