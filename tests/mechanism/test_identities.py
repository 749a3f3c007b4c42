"""Identities any mechanism obeys: `tau = Y theta = M a + h`, power balance, energy, superposition."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import TreeMechanism, build_mechanism
from tau_dyn.robot import load_robot, load_robot_from_urdf

SERIAL = ["two_link", "turning", "block", "tx40", "ur5", "panda"]
LOOPED = ["four_bar", "l1 simplified uniform", "d1 simplified point", "l1 complete uniform", "l1 complete point"]


def with_drive_inertia(robot, rng):
    """Return the robot with some drive inertia at every joint."""
    values = {f"{j}.armature": float(rng.uniform(0.1, 2)) for j in robot.actuated}
    return robot.with_parameters(robot.parameters.with_values(values))


@pytest.mark.parametrize("kind", SERIAL + LOOPED)
def test_weight_arms_times_gravity_are_the_forces_at_rest(robots, motion, kind: str) -> None:
    """Forces at rest are what gravity does on all bodies' partial velocities; the bodies' places sum to the centre of mass."""
    robot = robots(kind)
    mechanism, (q, _, _) = TreeMechanism(robot), motion(robot)
    rest = np.zeros_like(q)
    arms = mechanism.weight_arms(q)
    tau = mechanism.inverse_dynamics(q, rest, rest)
    gravity = mechanism.model.gravity.linear
    assert_allclose(-(arms.rates @ gravity).sum(axis=2), tau, atol=1e-9 * max(np.abs(tau).max(), 1.0))
    full, data = mechanism.solver.close(q[0]), mechanism.model.createData()
    centre = pin.centerOfMass(mechanism.model, data, full)
    held = data.mass[0] * centre
    assert_allclose(arms.places[0].sum(axis=0), held, atol=1e-9 * max(np.abs(held).max(), 1.0))


@pytest.mark.parametrize("kind", SERIAL + LOOPED)
def test_recursive_newton_euler_equals_regressor_times_parameters(robots, motion, rng, kind: str) -> None:
    """`rnea = Y theta` on random states, drive inertia included; a serial arm's is Pinocchio's own, coupled joints projected."""
    robot = with_drive_inertia(robots(kind), rng)
    mechanism = TreeMechanism(robot)
    q, v, a = motion(robot)
    tau = mechanism.inverse_dynamics(q, v, a)
    scale = np.abs(tau).max()
    assert_allclose(mechanism.regressor(q, v, a) @ robot.parameters.values, tau, atol=1e-9 * scale)
    assert_allclose(build_mechanism(robot).inverse_dynamics(q, v, a), tau, atol=1e-9 * scale)
    if not robot.loops and kind != "turning":
        model, (share, offset) = robot.model_with(robot.parameters), robot.coupling
        whole = zip(q @ share.T + offset, v @ share.T, a @ share.T, strict=True)
        assert_allclose([share.T @ pin.rnea(model, model.createData(), *x) for x in whole], tau, atol=1e-9)


@pytest.mark.parametrize("kind", SERIAL + LOOPED)
def test_mass_matrix_and_bias_make_up_the_force(robots, motion, rng, kind: str) -> None:
    """`tau = M a + h`, `M` symmetric and positive definite, and forward dynamics inverts inverse dynamics."""
    mechanism = build_mechanism(with_drive_inertia(robots(kind), rng))
    q, v, a = motion(mechanism.robot, 4)
    tau = mechanism.inverse_dynamics(q, v, a)
    for k in range(4):
        M, h = mechanism.mass_and_bias(q[k], v[k])
        assert_allclose(M, M.T, atol=1e-9 * np.abs(M).max())
        assert np.linalg.eigvalsh(M).min() > 0
        assert_allclose(M @ a[k] + h, tau[k], atol=1e-9 * np.abs(tau).max())
        assert_allclose(mechanism.forward_dynamics(q[k], v[k], tau[k]), a[k], atol=1e-9)


@pytest.mark.parametrize("kind", ["two_link", "tx40", *LOOPED])
def test_inertial_forces_do_no_work_beyond_kinetic_energy(robots, motion, kind: str) -> None:
    """Passivity: `v . (h(q, v) - h(q, 0)) = 1/2 v . dM/dt v`, with `dM/dt` by central differences along `v`."""
    mechanism = build_mechanism(robots(kind))
    q, v, _ = motion(mechanism.robot, 3)
    step = 1e-5
    for x, u in zip(q, v, strict=True):
        ahead, behind = (mechanism.mass_and_bias(x + s * step * u, u)[0] for s in (1, -1))
        coriolis = mechanism.mass_and_bias(x, u)[1] - mechanism.mass_and_bias(x, 0 * u)[1]
        change = u @ (ahead - behind) @ u / (4 * step)
        assert u @ coriolis == pytest.approx(change, abs=1e-6 * max(1, np.abs(coriolis).max()))


@pytest.mark.parametrize("kind", ["two_link", "tx40", *LOOPED])
def test_holding_force_is_the_slope_of_potential_energy(robots, motion, kind: str) -> None:
    """At rest `tau = dV/dq_a`, where `V` is the whole tree's weight times height, by central differences."""
    robot = robots(kind)
    mechanism, solver = build_mechanism(robot), TreeMechanism(robot).solver
    data = robot.model.createData()
    step = 1e-5
    for x in motion(robot, 3)[0]:
        slope = [
            (pin.computePotentialEnergy(robot.model, data, solver.close(x + d))
             - pin.computePotentialEnergy(robot.model, data, solver.close(x - d))) / (2 * step)
            for d in step * np.eye(robot.na)
        ]  # fmt: skip
        assert_allclose(mechanism.mass_and_bias(x, 0 * x)[1], slope, atol=1e-6 * max(1, np.abs(slope).max()))
        held = [[mechanism.mass_and_bias(x + s * d, 0 * x)[1] for s in (1, -1)] for d in 1e-4 * np.eye(robot.na)]
        bend = np.array([(ahead - behind) / 2e-4 for ahead, behind in held]).T
        assert_allclose(mechanism.weight_gradient(x[None])[0], bend, atol=1e-4 * max(1, np.abs(bend).max()))


@pytest.mark.parametrize(
    ("kind", "dt"), [("l1 simplified uniform", 2.5e-3), ("l1 complete uniform", 5e-3), ("two_link", 2e-3)]
)
def test_ten_seconds_of_motion_keep_energy_and_close_the_loops(robots, kind: str, dt: float) -> None:
    """Under springs and no friction energy stays to 1e-5 (RK4), and no loop opens by 1e-9 m: closures cannot drift."""
    robot = robots(kind)
    mechanism, tree = build_mechanism(robot), TreeMechanism(robot)
    data, stiffness = robot.model.createData(), 2000.0 if robot.loops else 10.0
    hold = mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[1]

    def slope(x: np.ndarray) -> np.ndarray:
        q, v = np.split(x, 2)
        return np.concatenate([v, mechanism.forward_dynamics(q, v, hold - stiffness * (q - robot.home))])

    def energy(x: np.ndarray) -> float:
        q, v = np.split(x, 2)
        height = pin.computePotentialEnergy(robot.model, data, tree.solver.close(q))
        spring = 0.5 * stiffness * np.sum((q - robot.home) ** 2) - hold @ (q - robot.home)
        return 0.5 * v @ mechanism.mass_and_bias(q, v)[0] @ v + height + spring

    x = np.concatenate([robot.home + 0.1, np.zeros(robot.na)])
    start, moving = energy(x), 0.5 * stiffness * robot.na * 0.1**2
    for k in range(round(10 / dt)):
        k1 = slope(x)
        k2 = slope(x + dt / 2 * k1)
        k3 = slope(x + dt / 2 * k2)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + dt * k3))
        if k % 100 == 99:
            assert tree.solver.closure_error(tree.solver.close(x[: robot.na])) < 1e-9
            assert abs(energy(x) - start) < 1e-5 * moving
    assert np.abs(x[: robot.na] - robot.home).max() < 0.5  # it still swings around home


def test_every_parameter_acts_alone(robots, motion) -> None:
    """A column is the force of one parameter at one and all others at zero (superposition), looked up by its name."""
    robot = robots("l1 simplified uniform")
    q, v, a = motion(robot, 3)
    Y, names = build_mechanism(robot).regressor(q, v, a), robot.parameters.names
    base = build_mechanism(robot).inverse_dynamics(q, v, a)
    for k, name in enumerate(names):
        more = robot.with_parameters(robot.parameters.with_values({name: robot.parameters[name].value + 1.0}))
        assert_allclose(build_mechanism(more).inverse_dynamics(q, v, a) - base, Y[:, :, k], atol=1e-9, err_msg=name)
        assert_allclose(TreeMechanism(more).inverse_dynamics(q, v, a) - base, Y[:, :, k], atol=1e-9, err_msg=name)


def test_gravity_mass_has_a_column_in_both_ways_of_computing(motion) -> None:
    """Mass that only gravity feels: its column does not depend on velocity or acceleration."""
    robot = load_robot("gantry_tau", gravity_mass=22.38)
    q, v, a = motion(robot)
    closed, tree = build_mechanism(robot), TreeMechanism(robot)
    assert_allclose(closed.regressor(q, v, a), tree.regressor(q, v, a), atol=1e-9)
    k = robot.parameters.names.index("plate_link.gravity_mass")
    assert_allclose(tree.regressor(q, v, a)[:, :, k], tree.regressor(q, 0 * v, 0 * a)[:, :, k], atol=1e-9)
    assert_allclose(closed.inverse_dynamics(q, v, a), tree.inverse_dynamics(q, v, a), atol=1e-9)
    for x, u in zip(q, v, strict=True):
        for ours, theirs in zip(closed.mass_and_bias(x, u), tree.mass_and_bias(x, u), strict=True):
            assert_allclose(ours, theirs, atol=1e-9)


def test_a_pendulum_on_paper(pendulum, rng) -> None:
    """`tau = m l^2 a + m g l sin(q)` of a point mass that hangs at zero."""
    q, v, a = rng.standard_normal((3, 20, 1))
    expected = 2 * 0.5**2 * a + 2 * 9.81 * 0.5 * np.sin(q)
    assert_allclose(build_mechanism(pendulum).inverse_dynamics(q, v, a), expected, atol=1e-12)


def test_a_continuous_joint_turns_round_and_round(robots, motion) -> None:
    """The same arm with continuous joints feels the same forces, also a full turn later."""
    limited, turning = (build_mechanism(robots(k)) for k in ("two_link", "turning"))
    q, v, a = motion(limited.robot)
    expected = limited.inverse_dynamics(q, v, a)
    assert_allclose(turning.inverse_dynamics(q, v, a), expected, atol=1e-12)
    assert_allclose(turning.inverse_dynamics(q + 2 * np.pi, v, a), expected, atol=1e-11)


def test_wrong_shapes_are_refused_with_the_joints_names(two_link) -> None:
    """Three columns for two joints."""
    mechanism = build_mechanism(two_link)
    with raises_code("wrong_shape", "2", "4", "3"):
        mechanism.inverse_dynamics(*np.zeros((3, 4, 3)))
    with raises_code("wrong_shape", "5", "2"):
        mechanism.regressor(np.zeros((4, 2)), np.zeros((5, 2)), np.zeros((4, 2)))


def test_too_few_drives_are_refused_and_one_too_many_follows() -> None:
    """Two carts leave the plate a free motion, which is refused; a fourth drive on the plate follows the three carts."""
    with raises_code("unsupported"):
        build_mechanism(load_robot("gantry_tau", arms="complete", actuated=["cart1", "cart2"]))
    robot = load_robot("gantry_tau", actuated=["cart1", "cart2", "cart3", "plate_x"])
    assert robot.redundant_joints == ("plate_x",)
    rates = build_mechanism(robot).redundant_motion(robot.home, np.zeros(3), np.zeros(3))[0, :, :3]
    assert_allclose(
        rates[0], build_mechanism(load_robot("gantry_tau")).tool_jacobian(robot.home[None])[0, 0], atol=1e-9
    )


def test_a_robot_without_a_tool_has_no_tool_position(write) -> None:
    """Where no frame is named as the tool and the tree has two ends, asking for its position is an error."""
    ends = [write.rod(f"{name}_link", 1, 0.2) for name in "ab"]
    joints = [write.joint(name, "revolute", "base_link", f"{name}_link", "0 1 0") for name in "ab"]
    fork = load_robot_from_urdf(write.text("fork", *ends, *joints, write.drive("a"), write.drive("b")), "fork")
    with raises_code("unsupported", "tool"):
        build_mechanism(fork).tool_position(np.zeros((1, 2)))
