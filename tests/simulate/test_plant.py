"""The plant: energy, periods, friction that stops and holds, forces that a log explains, loops that stay closed."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.special import ellipk

from tau_dyn.effects import Effect, Motion, ReducerCoupling
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.simulate import CascadeController, CascadeLaw, SampledForces, build_named_motion, free_motion, run_plant
from tau_dyn.simulate.plant import solve_slip

G = 9.81  # [m/s^2], Pinocchio's


def misfit(run):
    """Return applied minus inverse-dynamics forces from central differences, and the samples without a reversal near."""
    dt = run.t[1] - run.t[0]
    v, a = (run.q[2:] - run.q[:-2]) / (2 * dt), (run.q[2:] - 2 * run.q[1:-1] + run.q[:-2]) / dt**2
    clear = np.all((np.sign(v[1:-1]) == np.sign(v[:-2])) & (np.sign(v[1:-1]) == np.sign(v[2:])), axis=1)
    moving = np.all(np.abs(v) > 2e-3, axis=1)[1:-1]
    residual = run.tau[1:-1] - run.model.torque(run.q[1:-1], v, a)
    return residual[1:-1][clear & moving], np.mean(clear & moving)


def follow(model, name, duration=8.0, seed=1):
    """Run a named motion under the default controller with ideal feedback."""
    reference = build_named_motion(name, model, duration, seed).resampled(1000)
    return run_plant(model, reference, CascadeController(CascadeLaw.for_model(model), start=model))


@pytest.mark.parametrize("amplitude", [0.05, 1.0, 2.5])
def test_pendulum_swings_with_the_period_of_the_elliptic_integral(make, amplitude):
    """`T = 4 sqrt(l/g) K(sin^2(A/2))`; leapfrog at 1 ms errs by (w dt)^2 / 24 = 1e-6."""
    model = Model.of(make.pendulum(2.0, 0.5))
    run = free_motion(model, np.array([amplitude]), np.zeros(1), 12.0)
    q = run.q[:, 0]
    k = np.flatnonzero((q[:-1] > 0) & (q[1:] <= 0))
    crossing = run.t[k] + 1e-3 * q[k] / (q[k] - q[k + 1])
    expected = 4 * np.sqrt(0.5 / G) * ellipk(np.sin(amplitude / 2) ** 2)
    assert_allclose(np.diff(crossing), expected, rtol=2e-5)


def test_pendulum_keeps_its_energy(make):
    """Leapfrog is symplectic: no drift of energy in 30 s, beyond an oscillation of order dt^2."""
    model = Model.of(make.pendulum(2.0, 0.5))
    run = free_motion(model, np.array([2.0]), np.zeros(1), 30.0)
    energy = 0.5 * 2.0 * 0.25 * run.v[:, 0] ** 2 - 2.0 * G * 0.5 * np.cos(run.q[:, 0])
    assert_allclose(energy, energy[0], atol=2e-4)
    assert abs(energy[-2000:].mean() - energy[:2000].mean()) < 2e-5


def test_gantry_without_friction_exchanges_potential_and_kinetic_energy(make):
    """Carts pushed by nothing: half v'Mv plus the rods' and plate's height is constant to second order in the step."""
    model = Model.of(make.gantry())
    run = free_motion(model, np.zeros(3), np.array([0.8, 0.3, -0.2]), 0.4)
    kinetic = [0.5 * v @ model.mechanism.mass_and_bias(q, v)[0] @ v for q, v in zip(run.q, run.v, strict=True)]
    carts = np.array([1.44, 1.46, 0.0])
    height = 9.13 * run.tool[:, 2] + (np.array([0.8, 1.6, 2.4]) * (carts + run.tool[:, 2:]) / 2).sum(axis=1)
    energy = np.array(kinetic) + G * height
    assert np.ptp(G * height) > 1.0
    assert_allclose(energy, energy[0], atol=1e-3)


def test_sliding_block_stops_at_the_analytic_distance_and_stays(make):
    """`d = m v^2 / (2 Fc)`; the last, partial step costs less than the way of half a step; then exactly no motion."""
    model = make.friction(make.block(95.0), 200.0, 0.0)
    run = free_motion(model, np.zeros(1), np.array([0.4]), 1.0)
    assert_allclose(run.q[-1, 0], 95.0 * 0.4**2 / (2 * 200.0), atol=2e-6)
    stopped = run.t > 95.0 * 0.4 / 200.0 + 0.002
    assert np.all(run.v[stopped] == 0.0) and np.ptp(run.q[stopped]) == 0.0
    assert run.stuck[stopped].all() and not run.stuck[~stopped][:-4].any()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_block_stays_below_breakaway_and_leaves_above_it(make, direction):
    """One newton below Coulomb friction nothing moves; one newton above it the block accelerates with 1/m."""
    model = make.friction(make.block(95.0), 20.0, 0.0)
    below = free_motion(model, np.zeros(1), np.zeros(1), 0.5, tau=np.array([19.0 * direction]))
    assert np.all(below.q == 0.0) and below.sticking_share[0] == 1.0
    above = free_motion(model, np.zeros(1), np.zeros(1), 0.5, tau=np.array([21.0 * direction]))
    assert_allclose(above.q[-1, 0], direction * 0.5 * 0.5**2 / 95.0, rtol=1e-6)


def test_coupled_friction_obeys_coulomb_on_every_joint(rng):
    """Each joint slips at its full friction or stands still within it; found by trying all 27 cases instead."""
    for _ in range(300):
        L = rng.normal(size=(3, 3))
        A = 1e-3 * (L @ L.T + 0.1 * np.eye(3))
        lower, upper = -rng.uniform(1, 5, 3), rng.uniform(1, 5, 3)
        free = 5e-3 * rng.normal(size=3)
        slip = solve_slip(A, free, lower, upper, np.zeros(3))
        assert_allclose(slip.u, brute_force(A, free, lower, upper), atol=1e-12)
        assert_allclose(slip.u, free - A @ slip.force, atol=1e-12)
        assert np.array_equal(slip.stuck, slip.u == 0.0)


def brute_force(A, free, lower, upper):
    for case in itertools.product((-1, 0, 1), repeat=3):
        case = np.array(case)
        force, s = np.where(case > 0, upper, lower), case == 0
        if s.any():
            force[s] = np.linalg.solve(A[np.ix_(s, s)], free[s] - A[np.ix_(s, ~s)] @ force[~s])
        u = free - A @ force
        if np.all((lower - 1e-9 <= force) & (force <= upper + 1e-9)) and np.all(np.sign(u[~s]) == case[~s]):
            return np.where(s, 0.0, u)
    raise AssertionError("no case fits")


def test_block_log_gives_back_its_forces(block):
    """Central differences of positions and the sharp friction law explain the applied force within 0.005 N of 380 N."""
    residual, share = misfit(follow(block, "fourier"))
    assert share > 0.9 and np.max(np.abs(residual)) < 0.005


def test_gantry_log_gives_back_its_forces(gantry):
    """The same for three coupled carts, within 0.15 N of 600 N, with an rms below 0.01 N."""
    residual, share = misfit(follow(gantry, "fourier"))
    assert share > 0.85 and np.max(np.abs(residual)) < 0.15 and np.std(residual) < 0.01


def test_forces_act_around_their_sample(block):
    """No half sample of delay: forces taken half a sample early or late explain the motion at least ten times worse."""
    run = follow(block, "fourier")
    later = replace(run, tau=(run.tau + np.vstack([run.tau[1:], run.tau[-1:]])) / 2)
    earlier = replace(run, tau=(run.tau + np.vstack([run.tau[:1], run.tau[:-1]])) / 2)
    right = np.std(misfit(run)[0])
    assert min(np.std(misfit(later)[0]), np.std(misfit(earlier)[0])) > 10 * right


def test_loops_do_not_drift(make):
    """Ten seconds through the loop solver: rods keep their lengths and the tool stands where the closed form has it."""
    robot = make.gantry(closed_form=False)
    run = follow(make.friction(robot, 80.0, 120.0), "prbs", duration=10.0)
    exact = Model.of(make.gantry()).mechanism
    assert np.max(np.abs(run.tool - exact.tool_position(run.q))) < 1e-9
    carts = exact.origin + run.q[:, :, None] * exact.direction
    assert np.max(np.abs(np.linalg.norm(run.tool[:, None] - carts, axis=2) - [2.05, 1.82, 1.81])) < 1e-9


def test_closed_form_and_pinocchio_move_the_same_gantry(make, gantry):
    """Two independent dynamics, one motion: positions agree to a nanometre after a second of falling."""
    tree = make.friction(make.gantry(closed_form=False), 80.0, 120.0, 0.15)
    start, speed = np.array([0.1, 0.0, -0.1]), np.array([0.4, 0.2, -0.3])
    one, two = (free_motion(m, start, speed, 0.5) for m in (gantry, tree))
    assert_allclose(one.q, two.q, atol=1e-9)
    assert np.array_equal(one.stuck, two.stuck)


def test_fast_forces_equal_the_models(gantry, rng):
    """The simulator's shortcut for effects gives what the model's own path gives, at both signs."""
    forces = SampledForces(gantry)
    for q, v in rng.normal(size=(20, 2, 3)):
        for bound, sign in zip(forces.bounds(q, v), (-1.0, 1.0), strict=True):
            motion = Motion.of(gantry.robot.actuated, q[None], v[None], np.zeros((1, 3)), np.full((1, 3), sign))
            assert_allclose(bound, gantry.effect_force(motion)[0], atol=1e-9)


def test_shared_motor_moves_with_both_joints(make):
    """A coupling's inertia enters the mass matrix, off the diagonal too, and its friction opposes the summed speed."""
    robot = make.gantry()
    coupling = ReducerCoupling(("cart1", "cart2"), ("N", "N"))
    model = Model.of(robot, [coupling]).with_values({"cart1+cart2.inertia": 7.0, "cart1+cart2.coulomb": 3.0})
    q, v, tau = np.zeros(3), np.array([0.2, 0.1, 0.0]), np.array([300.0, 200.0, 300.0])
    M, h = model.mechanism.mass_and_bias(q, v)
    M[:2, :2] += 7.0
    expected = np.linalg.solve(M, tau - h - [3.0, 3.0, 0.0])
    assert_allclose(free_motion(model, q, v, 0.001, tau=tau).a[0], expected, rtol=1e-3)


def test_inertia_that_vanishes_at_zero_is_still_found(make):
    """An effect of `sin(q) a` has no columns at q = 0, where home is, and enters the mass matrix elsewhere all the same."""

    class SwingingInertia(Effect):
        """Force `sin(q) a` on the axis."""

        name, equation = "swinging_inertia", "tau = J sin(q) a"
        parameters = Parameters([Parameter("axis.swing", 0.0, "kg")])

        def columns(self, motion):
            return (np.sin(motion.q) * motion.a)[:, :, None]

    model = Model.of(make.block(95.0), [SwingingInertia(("axis",), ("N",))]).with_values({"axis.swing": 30.0})
    run = free_motion(model, np.array([0.4]), np.zeros(1), 0.001, tau=np.array([100.0]))
    assert_allclose(run.a[0], 100.0 / (95.0 + 30.0 * np.sin(0.4)), rtol=1e-9)


def test_gains_that_are_too_high_are_said(make, block):
    """A velocity loop far above the control rate runs away, and the message says why instead of printing NaN."""
    law = CascadeLaw.of(50.0, 95.0 * 2 * np.pi * 2000, na=1)
    reference = build_named_motion("fourier", block, 5.0)
    with raises_code("unstable"):
        run_plant(Model.of(make.block()), reference, CascadeController(law))


def test_massless_robot_is_refused(make):
    """A joint without any inertia would accelerate without force; the message asks for a mass."""
    model = Model.of(make.block()).with_values({"carriage_link.mass": 0.0})
    with raises_code("robot_structure"):
        free_motion(model, np.zeros(1), np.zeros(1), 0.1)
