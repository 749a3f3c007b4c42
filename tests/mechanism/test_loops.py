"""Loops closed: gaps, velocities and accelerations against finite differences, assembly modes, singularities, refusals."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism import SINGULAR, LoopSolver, TreeMechanism, build_mechanism
from tau_dyn.mechanism.loops import Constraints
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

KINDS = ["four_bar", "turning_four_bar", "simplified", "complete", "d1"]


@pytest.fixture
def robots(write):
    """Return a maker of the looped robots above."""

    def make(kind: str) -> Robot:
        if "four_bar" in kind:
            return load_robot_from_urdf(write.four_bar(kind="continuous" if kind != "four_bar" else "revolute"), "bars")
        prototype = "d1" if kind == "d1" else "l1"
        return load_robot("gantry_tau", arms="complete" if kind == "d1" else kind, prototype=prototype)

    return make


@pytest.mark.parametrize("kind", KINDS)
def test_loops_stay_closed_on_a_random_walk(robots, rng, kind: str) -> None:
    """Small steps (warm start) and jumps (from home) both close every loop to 1e-10 m."""
    robot = robots(kind)
    solver = LoopSolver(robot)
    q = robot.home.copy()
    for k in range(120):
        reach = 0.3 if k % 20 == 0 else 0.02
        q = robot.home + np.clip(q + rng.uniform(-reach, reach, robot.na) - robot.home, -0.3, 0.3)
        tree = solver.close(q)
        assert solver.closure_error(tree) < 1e-10
        assert_allclose(
            tree[robot.active_q] if kind != "turning_four_bar" else np.arctan2(tree[1], tree[0]), q, atol=1e-15
        )


@pytest.mark.parametrize("kind", KINDS)
def test_velocity_and_acceleration_are_derivatives_of_the_closure(robots, rng, kind: str) -> None:
    """`v = G v_a` and `a = G a_a + g0` against central differences along a parabola in actuated space."""
    robot = robots(kind)
    solver = LoopSolver(robot)
    h = 2e-4  # second differences: truncation 4e-8, closures to 1e-14 m: 1e-14 / h^2 = 2.5e-7
    for _ in range(5):
        q0 = robot.home + rng.uniform(-0.2, 0.2, robot.na)
        v, a = rng.standard_normal((2, robot.na))
        before, middle, after = (solver.close(q0 + v * t + a * t**2 / 2) for t in (-h, 0.0, h))
        state = solver.state(q0, v, a)
        forward, backward = (pin.difference(robot.model, middle, x) for x in (after, before))
        assert_allclose(state.v, (forward - backward) / (2 * h), atol=1e-6)
        assert_allclose(state.a, (forward + backward) / h**2, atol=1e-6 * max(1, np.abs(state.a).max()))
        assert_allclose(state.G @ v, state.v)


@pytest.mark.parametrize("kind", KINDS)
def test_constraint_jacobian_and_acceleration_agree_with_pinocchios_frames(robots, rng, kind: str) -> None:
    """Our columns `v_o + w x p` against Pinocchio's own frame Jacobians, at open loops as well."""
    robot = robots(kind)
    data, world = robot.model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    constraints = Constraints(robot.model, robot.model.createData(), robot.loops)
    q = pin.integrate(robot.model, pin.neutral(robot.model), rng.uniform(-0.5, 0.5, robot.model.nv))
    J = constraints.jacobian(q)
    frame = [pin.computeFrameJacobian(robot.model, data, q, k, world)[:3].copy()
             for loop in robot.loops for k in (loop.frame_a, loop.frame_b)]  # fmt: skip
    assert_allclose(J, np.concatenate([a - b for a, b in zip(frame[::2], frame[1::2], strict=True)]), atol=1e-13)
    v = rng.standard_normal(robot.model.nv)
    h = 1e-5
    ahead, behind = (constraints.jacobian(pin.integrate(robot.model, q, s * h * v)).copy() for s in (1, -1))
    assert_allclose(constraints.acceleration_at_rest(q, v), (ahead - behind) @ v / (2 * h), atol=1e-6)


def test_four_bar_obeys_freudensteins_equation(write, rng) -> None:
    """Pencil and paper (Freudenstein 1955): d/a cos(phi) - d/c cos(theta) + (a2-b2+c2+d2)/2ac = cos(theta - phi), and rates."""
    robot, s = load_robot_from_urdf(write.four_bar(kind="continuous"), "bars"), write.sizes
    start, solver = load_robot_from_urdf(write.four_bar(), "bars").model, LoopSolver(robot)
    yaw = {n: np.arctan2(*start.jointPlacements[start.getJointId(n)].rotation[[1, 0], 0]) for n in ("crank", "rocker")}
    rocker = robot.model.joints[robot.model.getJointId("rocker")]
    k1, k2 = s.base / s.crank, s.base / s.rocker
    k3 = (s.crank**2 - s.coupler**2 + s.rocker**2 + s.base**2) / (2 * s.crank * s.rocker)
    for angle in np.linspace(0, 4 * np.pi, 60):  # two full turns
        state = solver.state(np.array([angle]), np.array([1.0]), np.zeros(1))
        theta, phi = yaw["crank"] + angle, yaw["rocker"] + state.q[rocker.idx_q]
        assert k1 * np.cos(phi) - k2 * np.cos(theta) + k3 == pytest.approx(np.cos(theta - phi), abs=1e-12)
        rate = (np.sin(theta - phi) + k2 * np.sin(theta)) / (np.sin(theta - phi) + k1 * np.sin(phi))
        assert state.v[rocker.idx_v] == pytest.approx(rate, abs=1e-9)


@pytest.mark.parametrize("kind", ["four_bar", "complete"])
def test_the_assembly_mode_is_homes_whatever_way_was_taken(robots, rng, kind: str) -> None:
    """A solver that has wandered and one that comes fresh from home find the same configuration."""
    robot = robots(kind)
    wandering = LoopSolver(robot)
    for _ in range(15):
        q = robot.home + rng.uniform(-0.3, 0.3, robot.na)
        assert_allclose(wandering.close(q), LoopSolver(robot).close(q), atol=1e-10)


def test_the_tool_stays_ahead_of_the_carts(rng) -> None:
    """L1's assembly mode: all three rods reach from the cart towards +x (contract 2), in both arms' models."""
    for arms in ("simplified", "complete"):
        mechanism = build_mechanism(load_robot("gantry_tau", arms=arms))
        q = mechanism.robot.home + rng.uniform(-0.3, 0.3, (20, 3))
        tool = mechanism.tool_position(q)
        carts = q + np.array([0.04, 0.25, 0.0])
        assert np.all(tool[:, [0]] > carts)
        assert_allclose(
            np.linalg.norm(tool - np.stack([carts[:, 2], 0 * q[:, 0], 0 * q[:, 0]], 1), axis=1), 1.81, atol=1e-9
        )


@pytest.mark.parametrize("arms", ["simplified", "complete"])
def test_out_of_reach_is_said_with_the_positions(arms: str) -> None:
    """Carts 2 m apart cannot hold one plate."""
    mechanism = build_mechanism(load_robot("gantry_tau", arms=arms))
    with raises_code("loop_not_closed", "gantry_tau", "cart1", "=", "3.875"):
        mechanism.inverse_dynamics(
            *(np.array([x]) for x in (mechanism.robot.home + [4, 0, 0], np.zeros(3), np.zeros(3)))
        )
    with raises_code("loop_not_closed"):
        mechanism.mass_and_bias(mechanism.robot.home + [4, 0, 0], np.zeros(3))


@pytest.mark.parametrize("arms", ["simplified", "complete"])
def test_positions_in_mm_are_refused_with_a_hint(arms: str) -> None:
    """A log in mm reads as a robot of kilometres; the sentence asks for m."""
    mechanism = build_mechanism(load_robot("gantry_tau", arms=arms))
    with raises_code("loop_not_closed", "cart1", "=", "-124.8"):
        mechanism.tool_position(1000 * mechanism.robot.home)


@pytest.mark.parametrize("arms", ["simplified", "complete"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_motion_with_no_numbers_is_refused_by_its_sample(arms: str, bad: float) -> None:
    """NaN would otherwise come out of every sum; the sample is named, and the single-sample path refuses too."""
    mechanism = build_mechanism(load_robot("gantry_tau", arms=arms))
    q = np.tile(mechanism.robot.home, (3, 1))
    v = np.zeros((3, 3))
    v[1, 2] = bad
    with raises_code("bad_sample", "2"):
        mechanism.inverse_dynamics(q, v, q)
    with raises_code("loop_not_closed"):
        mechanism.mass_and_bias(q[0] + np.array([0, np.nan, 0]), np.zeros(3))


def test_a_fault_leaves_the_solver_as_it_was(rng) -> None:
    """After a position out of reach the next good one is solved as if nothing had happened."""
    robot = load_robot("gantry_tau", arms="complete")
    solver = LoopSolver(robot)
    expected = solver.close(robot.home + 0.01)
    with raises_code("loop_not_closed"):
        solver.close(robot.home + [4.0, 0, 0])
    assert_allclose(solver.close(robot.home + 0.01), expected, atol=1e-12)


def test_conditioning_grows_towards_a_dead_point_and_the_place_is_named(write) -> None:
    """A rocker cannot push a crank that lies in line with the coupler: |end - origin| = crank + coupler."""
    s = write.sizes
    robot = load_robot_from_urdf(write.four_bar(driven="rocker"), "bars")
    start = robot.model.jointPlacements[robot.model.getJointId("rocker")].rotation
    inside = ((s.crank + s.coupler) ** 2 - s.base**2 - s.rocker**2) / (2 * s.base * s.rocker)
    dead = np.arccos(inside) - np.arctan2(start[1, 0], start[0, 0])
    mechanism = build_mechanism(robot)
    distance = np.array([0.3, 1e-2, 1e-4, 1e-6, 1e-9])
    condition = mechanism.condition((dead + distance)[:, None])
    assert np.all(np.diff(condition) > 0) and condition[-1] > SINGULAR > condition[0]
    # the crank turns by the root of the rocker's distance, so the Jacobian loses rank with its root
    assert_allclose(condition[2:4] * np.sqrt(distance[2:4]), condition[2] * 1e-2, rtol=0.05)
    assert mechanism.singularity_warnings((dead + distance[:2])[:, None]) == ()
    (warning,) = mechanism.singularity_warnings((dead + distance[[0, 1, 4]])[:, None])
    assert f"rocker = {dead:.4g}" in warning and "near a singularity" in warning and "33 %" in warning


@pytest.mark.parametrize("closed", [True, False])
def test_gantry_conditioning_grows_where_the_rods_come_into_one_plane(closed: bool) -> None:
    """Spreading cart 1 until its reach ends brings the three rods into one plane, in both ways of computing."""
    robot = load_robot("gantry_tau")
    mechanism = build_mechanism(robot) if closed else TreeMechanism(robot)
    low, high = 0.0, 4.0
    for _ in range(45):  # bisect the end of reach
        middle = (low + high) / 2
        try:
            build_mechanism(robot).tool_position(robot.home + [middle, 0, 0])
            low = middle
        except LoopClosureError:
            high = middle
    path = robot.home + np.outer([0.9 * low, low - 1e-3, low - 1e-5, low - 1e-9], [1, 0, 0])
    condition = mechanism.condition(path)
    assert np.all(np.diff(condition) > 0)
    (warning,) = mechanism.singularity_warnings(path)
    assert f"cart1 = {path[-1, 0]:.4g}" in warning


def test_a_tree_without_loops_is_always_well_conditioned(two_link) -> None:
    """Nothing to close: conditioning 1, no warning."""
    mechanism = build_mechanism(two_link)
    assert_allclose(mechanism.condition(np.zeros((3, 2))), 1.0)
    assert mechanism.singularity_warnings(np.zeros((3, 2))) == ()


def test_a_rods_free_spin_moves_nothing_we_report(write, rng) -> None:
    """With a ball at both ends a rod may spin about itself; forces equal those of the same robot with universal joints."""
    spin = write.joint("spin", "revolute", "coupler_link", "spun_link", "1 0 0") + write.link("spun_link")
    urdf = write.four_bar().replace("</robot>", spin + "</robot>")
    urdf = urdf.replace('body_A name="coupler_link"', 'body_A name="spun_link"')
    tilt = '<link name="tilted_link"/><joint name="tilt" type="fixed"><parent link="base_link"/><child link="tilted_link"/>'
    tilt += '<origin rpy="0.3 0.4 0"/></joint></robot>'  # so that what is zero on paper is only nearly zero in numbers
    texts = [x.replace('<parent link="base_link"/>', '<parent link="tilted_link"/>').replace("</robot>", tilt)
             for x in (write.four_bar(), urdf)]  # fmt: skip
    plain, spun = (build_mechanism(load_robot_from_urdf(x, "bars")) for x in texts)
    q, v, a = rng.uniform(-0.3, 0.3, (3, 10, 1))
    assert_allclose(spun.inverse_dynamics(q, v, a), plain.inverse_dynamics(q, v, a), rtol=1e-9)
    G = LoopSolver(spun.robot).state(q[0], v[0], a[0]).G
    assert (
        abs(G[spun.robot.model.joints[spun.robot.model.getJointId("spin")].idx_v, 0]) < 1e-9
    )  # the least motion that does


@pytest.mark.parametrize("depth", [1e-1, 1e-2, 1e-3, 1e-4, 1e-6])
def test_beside_a_dead_centre_the_assembly_mode_is_homes_whatever_came_before(write, depth: float) -> None:
    """A four-bar driven at its rocker, `depth` before crank and coupler are in line: a step back keeps its branch."""
    robot = load_robot_from_urdf(write.four_bar(driven="rocker"), "four_bar")
    d, a, b, c = write.sizes.base, write.sizes.crank, write.sizes.coupler, write.sizes.rocker
    joint = a * np.exp(1j * np.pi / 3) - d  # of crank and coupler at home, from the rocker's pivot
    home = np.angle(joint) - np.arccos((c**2 + abs(joint) ** 2 - b**2) / (2 * c * abs(joint)))
    in_line = np.arccos(((b - a) ** 2 - d**2 - c**2) / (2 * d * c))
    solver, near = LoopSolver(robot), robot.home + in_line - home - depth
    for back in (0.05, 0.03, 0.01, 1e-3):
        solver.close(near)
        assert_allclose(solver.close(near - back), LoopSolver(robot).close(near - back), atol=1e-7)


def test_beyond_a_dead_centre_many_samples_are_refused_as_one_is(write) -> None:
    """Forty positions of the four-bar at once, one 10 mrad beyond the rocker's dead centre: no other mode answers."""
    robot = load_robot_from_urdf(write.four_bar(driven="rocker"), "four_bar")
    mechanism = build_mechanism(robot)
    within = robot.home + np.linspace(0.0, 1.06, 40)[:, None]
    assert np.isfinite(mechanism.inertia(within)).all()
    with raises_code("loop_not_closed", "rocker"):
        mechanism.inertia(np.vstack([within, robot.home + 1.0724]))


def test_two_drives_of_one_freedom_move_as_one(write) -> None:
    """A crank-rocker driven at both ends: the second drive's rate is the loop's, and its work is part of one force."""
    robot = load_robot_from_urdf(write.four_bar(), "four_bar", actuated=("crank", "rocker"))
    assert robot.actuated == ("crank",) and robot.redundant_joints == ("rocker",)
    mechanism = build_mechanism(robot)
    q = robot.home + np.linspace(-0.2, 0.2, 41)[:, None]
    v, a = np.full_like(q, 0.7), np.full_like(q, 0.3)
    rate, speed, change = mechanism.redundant_motion(q, v, a)[:, 0].T
    one_by_one = np.concatenate([mechanism.redundant_motion(*(x[k : k + 1] for x in (q, v, a))) for k in range(len(q))])
    assert_allclose(mechanism.redundant_motion(q, v, a), one_by_one, atol=1e-9)
    assert_allclose(speed, 0.7 * rate, rtol=1e-12)
    slope = np.gradient(rate, q[:, 0], edge_order=2)
    assert_allclose((0.3 * rate + 0.49 * slope)[2:-2], change[2:-2], rtol=1e-2, atol=1e-3)
