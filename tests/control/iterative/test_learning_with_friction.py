"""Learning on the nonlinear plant: carts with their cascade, sharp friction, encoder noise; the model knows a lag and a delay."""

from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.control.iterative import (
    LearningLaw,
    MotorSide,
    Reference,
    TimeShift,
    design_low_pass,
    learn,
    stack_controlled_actuators,
)
from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.modes import Actuator
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Sensors, Trajectory, move, simulate

DT = 0.004
NOISE = 1e-7  # m, of the encoders; no trial can be better than about twice that
ROBOT = load_robot("gantry_tau")
FRICTION = {"coulomb_pos": 40.0, "coulomb_neg": 35.0, "viscous_pos": 60.0, "viscous_neg": 55.0}


class Carts:
    """The L1's carts under their controller, read every 4 ms."""

    dt = DT

    def __init__(self, friction: bool, seed: int) -> None:
        """Take a robot with friction or without."""
        effects = build_friction_model("asymmetric", ROBOT.actuated, ROBOT.force_units) if friction else ()
        model = Model.of(ROBOT, effects)
        self.model = model.with_values({n: FRICTION[n.split(".")[1]] for n in model.effect_parameters.names})
        self.seed = seed

    def run(self, reference: np.ndarray, trial: int) -> SimpleNamespace:
        """Move along references (N, 3)."""
        motion = Trajectory.through(ROBOT.actuated, np.arange(len(reference)) * DT, reference)
        sensors = Sensors(encoder_noise=NOISE)
        log = simulate(self.model, motion, sensors=sensors, seed=100 * self.seed + trial)
        nothing = np.zeros((len(reference), 3))
        q = log.joint("q", ROBOT.actuated)[::4][: len(reference)]
        return SimpleNamespace(q=q, kinematic=nothing, acceleration=nothing, tool=nothing)


@pytest.mark.parametrize(("friction", "left"), [(False, 0.05), (True, 0.3)])
@pytest.mark.parametrize("seed", range(5))
def test_every_trial_comes_closer(friction, left, seed) -> None:
    """(7.28) promises a monotone fall: it holds on five seeds, and friction, which the model does not know, slows it down."""
    way = move(ROBOT.actuated, ROBOT.home, ROBOT.home + np.array([0.03, -0.02, 0.01]), 0.8, rate_hz=250).q
    q = np.vstack([np.repeat(way[:1], 60, axis=0), way, np.repeat(way[-1:], 60, axis=0)])
    motion = Reference(DT, q, np.zeros((len(q), 3)), first=60, last=len(q) - 60, lead=50)
    side = MotorSide(stack_controlled_actuators([Actuator(1.0, 1e-4, 0.0)] * 3, DT))
    law = LearningLaw(side, (design_low_pass(10, DT),) * 3, TimeShift(0.9, 0, DT))
    done = learn(Carts(friction, seed), motion, law, 3)
    errors = done.rms("motor_errors")
    assert done.convergence.monotone
    assert np.all(np.diff(errors, axis=0) < 2 * NOISE)
    assert np.all(errors[-1] < left * errors[0] + 2 * NOISE)
