"""The L1's carts under their own controller: a nonlinear plant that learns, with friction or without."""

from types import SimpleNamespace

import numpy as np

from tau_dyn.control.iterative import Reference
from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Sensors, Trajectory, move, simulate

DT = 0.004
NOISE = 1e-7  # m, of the encoders; no trial can be better than about twice that
ROBOT = load_robot("gantry_tau")
FRICTION = {"coulomb_pos": 40.0, "coulomb_neg": 35.0, "viscous_pos": 60.0, "viscous_neg": 55.0}
REST = 60  # samples before and after the way


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


def build_way() -> Reference:
    """Return a move of the carts by 30, -20 and 10 mm in 0.8 s, from rest to rest."""
    way = move(ROBOT.actuated, ROBOT.home, ROBOT.home + np.array([0.03, -0.02, 0.01]), 0.8, rate_hz=250).q
    q = np.vstack([np.repeat(way[:1], REST, axis=0), way, np.repeat(way[-1:], REST, axis=0)])
    return Reference(DT, q, np.zeros((len(q), 3)), first=REST, last=len(q) - REST, lead=50)
