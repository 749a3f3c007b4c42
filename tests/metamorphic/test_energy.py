"""Energy and momentum of what the simulator makes: bodies' speeds and heights are found beside its equations of motion.

Kinetic and potential energy and momentum are summed body by body over the closed tree, whose speeds are central differences
of its positions; nothing of the simulator's mass matrix, bias or regressor is used (for L1 not even its closed form). Leapfrog
with a fixed step errs by the square of the step (Hairer, Lubich & Wanner 2003): a quarter of the error at half the step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from tau_dyn.identify import build_model
from tau_dyn.mechanism import LoopSolver
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import CascadeController, CascadeLaw, PlantRun, build_named_motion, free_motion, run_plant

SPEEDS = {"elbow": (0.8, -1.1, 1.5), "l1": (0.35, -0.3, 0.25), "complete": (0.35, -0.3, 0.25)}
NEAR = 1e-5  # [s] before and after a sample


class Bodies:
    """All bodies of a robot, wherever its actuated joints take them."""

    def __init__(self, robot: Robot) -> None:
        """Close the loops of this robot."""
        self.model, self.data = robot.model, robot.model.createData()
        self.close: Callable[[np.ndarray], np.ndarray] = LoopSolver(robot).close if robot.loops else np.array

    def at(self, q: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
        """Return kinetic energy [J], potential energy [J] and momentum along x [kg m/s] at a state (na,), (na,)."""
        ahead, behind = self.close(q + NEAR * v), self.close(q - NEAR * v)
        here, speed = self.close(q), pin.difference(self.model, behind, ahead) / (2 * NEAR)
        pin.computeKineticEnergy(self.model, self.data, here, speed)
        pin.computePotentialEnergy(self.model, self.data, here)
        pin.computeCentroidalMomentum(self.model, self.data, here, speed)
        return self.data.kinetic_energy, self.data.potential_energy, float(self.data.hg.linear[0])

    def along(self, run: PlantRun, index: np.ndarray) -> np.ndarray:
        """Return the three (n, 3) at some samples of a run."""
        return np.array([self.at(run.q[k], run.v[k]) for k in index])


@pytest.fixture(params=list(SPEEDS))
def robot(request) -> Robot:
    """A serial arm, L1 as it is simplified, L1 with all its rods."""
    return request.getfixturevalue(request.param)


def flight(robot: Robot, model: Model, dt: float, seconds: float = 0.24) -> np.ndarray:
    """Return energies and momentum (n, 3) of a free flight, every 20 ms."""
    speed = np.array(next(s for name, s in SPEEDS.items() if len(s) == robot.na and _is(robot, name)))
    run = free_motion(model, robot.home, speed, seconds, dt)
    step = round(0.02 / dt)
    return Bodies(robot).along(run, np.arange(step, len(run.t) - 1, step))


def _is(robot: Robot, name: str) -> bool:
    complete = robot.arguments.get("arms") == "complete"
    return (robot.name == "elbow") == (name == "elbow") and complete == (name == "complete")


def test_free_flight_keeps_its_energy(robot) -> None:
    """No friction, no drive: what is lost in height is won in speed; what the step adds shrinks with its square."""
    model = build_model(robot, "rigid")
    coarse, fine = (flight(robot, model, dt) for dt in (1e-3, 5e-4))
    exchanged = np.ptp(fine[:, 0])
    error, less = (np.abs(x[:, 0] + x[:, 1] - (x[0, 0] + x[0, 1])).max() for x in (coarse, fine))
    assert exchanged > 0.5 and error < 2e-3 * exchanged
    assert less < error / 3 or error < 1e-6 * exchanged


@pytest.mark.parametrize("name", ["l1", "complete"])
def test_nothing_pushes_a_free_gantry_along_its_guideways(request, name: str) -> None:
    """Guideways carry no force along x, and gravity has none there: the momentum along x stays."""
    robot = request.getfixturevalue(name)
    found = flight(robot, build_model(robot, "rigid"), 1e-3)
    assert np.ptp(found[:, 0]) > 0.5, "energy went from body to body"
    assert np.ptp(found[:, 2]) < 1e-3 * np.abs(found[:, 2]).max()


def test_friction_takes_what_is_lost(robot, make) -> None:
    """Without drives energy falls from sample to sample, by the work of friction, until the robot may stick."""
    sizes = (2.0, 1.5, 0.5) if robot.name == "elbow" else (30.0, 30.0, 30.0)
    model = make.friction(robot, sizes)
    speed = np.array(SPEEDS["elbow" if robot.name == "elbow" else "l1"])
    run = free_motion(model, robot.home, speed, 0.12, 5e-4)
    index = np.arange(20, 220, 20)
    energy = Bodies(robot).along(run, index)[:, :2].sum(axis=1)
    power = np.sum(model.effect_force(model.motion(run.q, run.v, run.a)) * run.v, axis=1)
    assert np.all(np.diff(energy) < 0) and np.all(power >= 0)
    lost = _integral(run, power, index)
    np.testing.assert_allclose(energy[0] - energy, lost, rtol=0, atol=2e-3 * lost[-1])


def test_drives_pay_for_energy_and_friction(robot, make) -> None:
    """Followed by a controller: work of the drives = change of kinetic and potential energy + what friction took.

    2e-3 of the work: the simulator's force acts from half a step before a sample to half a step after it, and the sum takes it at
    the sample; in the few samples in which friction changes its sign it mixes both directions.
    """
    sizes = (4.0, 3.0, 1.0) if robot.name == "elbow" else (150.0, 150.0, 150.0)
    model = make.friction(robot, sizes)
    path = build_named_motion("fourier", model, 8.0, 1)
    few = slice(1200, 1700)
    path = type(path)(path.joints, path.t[few] - path.t[few][0], path.q[few], path.v[few], path.a[few])
    run = run_plant(model, path, CascadeController(CascadeLaw.for_model(model)))
    index = np.arange(50, 470, 60)
    energy = Bodies(robot).along(run, index)[:, :2].sum(axis=1)
    work = _integral(run, np.sum(run.tau * run.v, axis=1), index)
    friction = model.effect_force(model.motion(run.q, run.v, run.a))
    held = np.where(run.stuck, 0.0, friction)
    lost = _integral(run, np.sum(held * run.v, axis=1), index)
    much = _integral(run, np.abs(np.sum(run.tau * run.v, axis=1)), index)[-1]
    assert lost[-1] > 0.05 * much, "friction counts"
    assert np.ptp(energy) > 0.05 * much, "so does the motion"
    np.testing.assert_allclose(work, energy - energy[0] + lost, rtol=0, atol=2e-3 * much)


def _integral(run: PlantRun, power: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the work (n,) [J] from the first of some samples to each of them, by trapezoids."""
    dt = run.t[1] - run.t[0]
    total = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1])) * dt])
    return total[index] - total[index[0]]
