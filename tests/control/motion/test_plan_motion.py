"""The shortest motions are those that closed forms and another method find, and they keep every limit."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.control import Feedforward
from tau_dyn.control.motion import MotionLimits, MotionPlan, plan_motion
from tau_dyn.control.motion.coordinates import Free, Nodes, build_joint_line
from tau_dyn.control.motion.plan import tighten_limits
from tau_dyn.render.kinds.motion_plan import describe_verdict
from tau_dyn.simulate import Trajectory

sys.path.insert(0, str(Path(__file__).parent))
from planned_robots import END, START, bang_bang, block, l1

pytest.importorskip("casadi")

FORCE = 500.0  # [N]


@pytest.fixture(scope="module")
def gantry():
    """L1 with friction."""
    return l1(coulomb=60.0, viscous=80.0)


@pytest.fixture(scope="module")
def free(gantry) -> MotionPlan:
    """Its shortest motion on any path."""
    return plan_motion(gantry, START, END, limits=MotionLimits.of(gantry, force=FORCE, speed=10.0), nodes=30)


@pytest.fixture(scope="module")
def straight(gantry) -> MotionPlan:
    """And on the straight line."""
    limits = MotionLimits.of(gantry, force=FORCE, speed=10.0)
    return plan_motion(gantry, START, END, limits=limits, path="line", nodes=40)


def test_double_integrator_takes_its_closed_time():
    """A block of mass m under |F| <= F0 needs 2 sqrt(m d / F0) over d; ramps of one interval cost a share of order 1/N."""
    exact = 2 * np.sqrt(95.0 * 0.8 / 400.0)
    found = [plan_motion(block(), [-0.4], [0.4], joints=True, nodes=n).duration for n in (40, 80)]
    assert exact < found[1] < found[0] < 1.03 * exact
    assert_allclose(2 * found[1] - found[0], exact, rtol=1e-3)  # what order 1/N leaves when it is extrapolated


def test_double_integrator_switches_once():
    """It accelerates at the limit for half the time and decelerates at it for the other half."""
    plan = plan_motion(block(), [-0.4], [0.4], joints=True)
    first, second = np.array_split(plan.tau[:, 0], 2)
    assert np.mean(first >= 0.99 * 400) > 0.9 and np.mean(second <= -0.99 * 400) > 0.9
    assert plan.binding[0].quantity == "force" and plan.binding[0].share > 0.9


def test_effort_is_weighed_as_the_closed_form_says():
    """Without limits in reach, T + w int F^2 dt is least at T^4 = 36 w m^2 d^2, with int F^2 dt = 12 m^2 d^2 / T^3."""
    w = 1e-5
    plan = plan_motion(block(effort=1e4), [-0.4], [0.4], joints=True, energy_weight=w, nodes=200)
    T = (36 * w * 95.0**2 * 0.8**2) ** 0.25
    assert_allclose(plan.duration, T, rtol=5e-3)
    assert_allclose(plan.energy, 12 * 95.0**2 * 0.8**2 / T**3, rtol=2e-2)


def test_speed_acceleration_and_jerk_limits_hold():
    """With |v| <= V and |a| <= A the time is d/V + V/A; a jerk limit keeps the acceleration's slope."""
    model = block(effort=1e4)
    limits = MotionLimits.of(model, speed=0.8, acceleration=4.0)
    plan = plan_motion(model, [-0.4], [0.4], joints=True, limits=limits, nodes=120)
    assert_allclose(plan.duration, 0.8 / 0.8 + 0.8 / 4.0, rtol=1e-2)
    smooth = plan_motion(model, [-0.4], [0.4], joints=True, limits=MotionLimits.of(model, acceleration=4.0, jerk=40.0))
    assert np.abs(np.diff(smooth.a[:, 0])).max() / 1e-3 <= 40.0 * 1.001
    assert np.abs(smooth.a).max() <= 4.0 * 1.001


def test_path_time_is_the_phase_planes():
    """On a line the shortest time is that of a bang-bang motion integrated in the phase plane, another method altogether."""
    model = l1()
    limits = MotionLimits.of(model, force=FORCE, speed=10.0)
    coarse, fine = (plan_motion(model, START, END, limits=limits, path="line", nodes=n).duration for n in (25, 50))
    exact = bang_bang(model, START, END, FORCE)
    assert exact < fine < coarse
    assert_allclose(2 * fine - coarse, exact, rtol=2e-3)


def test_free_motion_beats_the_line_at_more_effort(free: MotionPlan, straight: MotionPlan):
    """Table 3.1: a free path saves several percent of the time, for about twice the squared forces."""
    assert 0.02 < 1 - free.duration / straight.duration < 0.15
    assert 1.5 < free.energy / straight.energy < 3.0


def test_all_drives_work_at_their_limits(free: MotionPlan, straight: MotionPlan):
    """Figure 3.10: free, all three forces are at their limits most of the time; on the line, that of one cart."""
    at_limit = np.mean(np.abs(free.tau) >= 0.98 * FORCE, axis=0)
    assert np.all(at_limit > 0.7)
    on_line = np.mean(np.abs(straight.tau) >= 0.98 * FORCE, axis=0)
    assert np.argmax(on_line) == 2 and on_line[2] > 0.9 and np.max(on_line[:2]) < 0.1


def test_the_verdict_names_a_limit_that_is_left(free: MotionPlan):
    """A plan 1 % over a limit between its nodes is not "within limits"; the share of time at a force limit is the union."""
    assert describe_verdict(free).level == "good" and not free.exceeds
    over = describe_verdict(replace(free, excess=0.01))
    assert over.level == "care" and "1 %" in over.sentence
    alone = np.mean(np.abs(free.tau) >= 0.99 * FORCE, axis=0)
    assert alone.max() < free.share_at_force_limit < alone.sum()


@pytest.mark.parametrize("name", ["free", "straight"])
def test_forces_stay_within_limits_between_the_nodes(name: str, request, gantry):
    """On a fine clock the model's own inverse dynamics with unsmoothed friction, where that acts, stays within the limits."""
    plan = request.getfixturevalue(name)
    moving = np.abs(plan.v) > 2 * plan.width
    tau = gantry.torque(plan.q, plan.v, plan.a)
    assert np.max(np.abs(tau)[moving]) <= FORCE * 1.02
    assert plan.excess <= 1e-3 and np.max(np.abs(plan.tau)) <= FORCE * 1.001


def test_the_clock_carries_one_motion(free: MotionPlan, straight: MotionPlan):
    """Speeds and accelerations are the derivatives of the positions, and both ends are states of rest."""
    for plan in (free, straight):
        again = Trajectory.through(plan.joints, plan.t, plan.q)
        assert_allclose(again.v, plan.v, atol=2e-4 * np.abs(plan.v).max())
        assert_allclose(plan.v[[0, -1]], 0, atol=1e-9)
        assert_allclose(plan.a[[0, -1]], 0, atol=1e-6)
        assert_allclose(plan.tool[[0, -1]], [START, END], atol=1e-9)
        assert plan.t[-1] - 1e-3 < plan.duration <= plan.t[-1] + 1e-12


def test_the_tool_stays_on_its_line(straight: MotionPlan):
    """Along a path the tool leaves it by less than a micrometre."""
    along = (END - START) / np.linalg.norm(END - START)
    off = (straight.tool - START) - np.outer((straight.tool - START) @ along, along)
    assert np.abs(off).max() < 1e-6


def test_the_tool_goes_through_points(gantry):
    """A spline through points passes each of them."""
    via = np.array([1.75, -0.6, 0.9])
    plan = plan_motion(
        gantry, START, END, limits=MotionLimits.of(gantry, force=FORCE), path=via[None], nodes=20, dt=2e-4
    )
    assert np.linalg.norm(plan.tool - via, axis=1).min() < 5e-4


def test_a_larger_weight_means_more_time_and_less_effort(gantry, free: MotionPlan):
    """Along the weight, duration grows and squared forces fall."""
    limits = MotionLimits.of(gantry, force=FORCE, speed=10.0)
    more = plan_motion(gantry, START, END, limits=limits, energy_weight=1e-6, nodes=30)
    assert more.duration > free.duration and more.energy < 0.6 * free.energy


def test_what_a_limit_is_left_by_between_the_nodes_is_tightened():
    """A force 5 % beyond its limit at one look of the fine clock lowers the limit of the places beside it by as much."""
    model = block()
    limits = MotionLimits.of(model)
    coordinates = Free(build_joint_line(np.array([-0.4]), np.array([0.4])), np.array([-0.5]), np.array([0.5]))
    ddx = np.zeros((11, 1))
    ddx[4] = 1.05 * 400.0 / 95.0
    none = np.zeros((21, 0))
    nodes, ones = Nodes(np.zeros((11, 1)), np.zeros((11, 1)), ddx, none, none, T=1.0), np.ones((21, 1))
    law = Feedforward(model, width=0.02)
    share = tighten_limits(ones, nodes, coordinates, law, limits, [("force", 0)])
    assert share is not None and share[8, 0] == pytest.approx(1 / 1.05) and np.sum(share < 1) <= 3
    ddx[4] = 0.99 * 400.0 / 95.0
    assert tighten_limits(ones, nodes, coordinates, law, limits, [("force", 0)]) is None


def test_no_plan_leaves_the_conditionings_limit(gantry):
    """Where the shortest motion would close its loops worse than allowed, there is no plan, and the reason has both numbers."""
    limits = MotionLimits.of(gantry, force=FORCE, condition=4.2)  # 4.13 and 4.15 at the ends, 4.39 between
    with raises_code("no_solution", "4", "4.2"):
        plan_motion(gantry, [1.75, -1.2, 0.15], [1.75, -0.25, 0.15], limits=limits, nodes=15)


def test_the_verdict_names_no_cause_that_was_not_computed() -> None:
    """Without a limit reached, the effort weight is named where there is one; at weight zero the missing limit is a question."""
    plan = plan_motion(block(effort=1e4), [-0.4], [0.4], joints=True, nodes=20)
    assert "force of" in describe_verdict(plan).sentence
    loose = replace(plan, binding=())
    assert describe_verdict(loose).level == "care" and "effort" not in describe_verdict(loose).sentence
    assert "effort weight 0.5" in describe_verdict(replace(loose, energy_weight=0.5)).sentence
