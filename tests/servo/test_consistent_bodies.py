"""A fit in few directions keeps bodies that may exist."""

import numpy as np
import pytest
from tests.servo.arms import build_arm, build_law, build_truth, record

from tau_dyn.estimate import pseudo_inertia
from tau_dyn.identify import Choices
from tau_dyn.servo import identify_loop
from tau_dyn.servo.consistent_bodies import ConsistentBodies
from tau_dyn.servo.fit import LoopPrior
from tau_dyn.simulate import ServoLaw


def build_bodies(count: int | None) -> ConsistentBodies:
    """Return two links of an arm and some directions at random, or every number for itself."""
    robot = build_arm(2)
    free = np.array([not p.name.endswith(".armature") for p in robot.parameters])
    nominal = robot.parameters.values * free
    prior = np.where(nominal > 0, 0.25 * nominal, 1e-5) * free
    turns = np.linalg.qr(np.random.default_rng(0).normal(size=(free.sum(), count or free.sum())))[0]
    directions = np.zeros((len(nominal), turns.shape[1]))
    directions[free] = prior[free, None] * (turns if count else np.eye(free.sum()))
    return ConsistentBodies(robot.links, robot.parameters.names, nominal, prior, directions)


@pytest.fixture(scope="module")
def bodies() -> ConsistentBodies:
    """Return two links and five directions."""
    return build_bodies(5)


def test_the_files_bodies_cost_nothing(bodies):
    """At the robot file, the divergence and its slope are zero, and nothing gives way."""
    found = bodies.find(np.zeros(5))
    assert found is not None
    assert abs(found.value) < 1e-12
    assert np.abs(found.gradient).max() < 1e-9
    assert np.abs(found.w).max() < 1e-9


def test_slope_and_curvature_are_those_of_the_value(bodies):
    """Gradient and curvature by the fit's unknowns agree with differences, what gives way included."""
    z, h = np.array([0.6, -0.4, 0.3, 0.5, -0.7]), 1e-4
    found = bodies.find(z)
    either = [[bodies.find(z + way * h * unit) for way in (1, -1)] for unit in np.eye(5)]
    slope = [(a.value - b.value) / (2 * h) for a, b in either]
    bend = [(a.gradient - b.gradient) / (2 * h) for a, b in either]
    assert np.allclose(found.gradient, slope, rtol=1e-4, atol=1e-6)
    assert np.allclose(found.curvature, bend, rtol=1e-3, atol=1e-4)


def test_no_step_leads_out_of_what_may_exist():
    """Where no number gives way, a mass of less than nothing cannot be found, and a step ends before it is reached."""
    bodies = build_bodies(None)
    lighter = np.zeros(20)
    lighter[0] = -1.0  # a quarter of the first link's mass, whose moments stay
    part = bodies.limit(np.zeros(20), 10 * lighter)
    assert 0 < 10 * part < 4
    assert bodies.find(10 * part * lighter) is not None
    assert bodies.find(4.1 * lighter) is None


def assert_slope_is_that_of_the_cost(prior: LoopPrior, x: np.ndarray) -> None:
    """Half the slope and half the curvature of what a fit pays agree with differences."""
    H, g = prior.differentiate(x)
    for k, unit in enumerate(np.eye(len(x))):
        either = [x + way * 1e-4 * unit for way in (1, -1)]
        cost, slope = ([f(at) for at in either] for f in (prior.compute_cost, lambda at: prior.differentiate(at)[1]))
        assert (cost[0] - cost[1]) / 2e-4 == pytest.approx(-2 * g[k], rel=1e-4, abs=1e-5)
        assert (slope[0] - slope[1])[k] / 2e-4 == pytest.approx(-H[k, k], rel=1e-2, abs=1e-4)


@pytest.mark.parametrize("fixed", [(), ("j1_link.mass=0.125",)])
def test_identified_bodies_may_exist(fixed):
    """Bodies far off the file come back such as some distribution of mass has, even beside a mass that is weighed too small."""
    robot = build_arm(2)
    model = build_truth(robot).with_values({"j1_link.iyy": 1.06e-3, "j1_link.mx": 0.0125, "j2_link.iyy": 1.3e-3})
    log = record(robot, model, build_law(robot), 5, 20.0)
    law = ServoLaw.of(robot.actuated, position_gain=2.65, force_per_unit=2.9, back_emf=0.17)
    found = identify_loop(robot, log, law=law, choices=Choices(fix=fixed))
    assert_slope_is_that_of_the_cost(LoopPrior(found.start[0].unknowns), found.start[1].x)
    parameters = found.model.robot.parameters
    for link in found.model.robot.links:
        J = pseudo_inertia(link.map @ parameters.select(link.names).values)
        assert np.linalg.eigvalsh(J)[0] > 0
