"""A held-out log that the exported file and its callback repeat in MuJoCo under the log's own controller."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.exchange import build_mjcf
from tau_dyn.model import Model
from tau_dyn.robot import list_stock_robots, load_robot
from tau_dyn.simulate import CascadeController, CascadeLaw, Sensors, move, replay, simulate

ROBOTS = {
    "l1": lambda: load_robot("gantry_tau", gravity_mass=22.38),
    "ur5": lambda: load_robot("ur5"),
}


def build_models(name: str) -> tuple[Model, Model]:
    """Return the truth, with a periodic error between encoder and load, and a model of it that has all but that."""
    if name == "ur5" and name not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    robot = ROBOTS[name]()
    causes = ("stribeck", "cyclic_ripple", "position_friction", "transmission_error")
    effects = [*build_friction_model("asymmetric", robot.actuated, robot.force_units)]
    effects += [EFFECTS[cause](robot.actuated, robot.force_units) for cause in causes]
    truth = Model.of(robot, effects)
    stops = 0.2 * np.diag(truth.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))[0])
    sizes = dict(zip(robot.actuated, stops, strict=True))
    shares = {"coulomb_pos": 0.4, "coulomb_neg": 0.3, "viscous_pos": 5.0, "viscous_neg": 3.5}
    values = {
        n: shares.get(n.rsplit(".", 1)[1], 0.1) * sizes[n.rsplit(".", 1)[0]] for n in truth.effect_parameters.names
    }
    values |= {n: 2e-5 for n in values if ".error_" in n}
    truth = truth.with_values(values)
    return truth, truth.only(e for e in truth.effects if e.name != "transmission_error")


@pytest.mark.parametrize("name", ROBOTS)
def test_mujoco_repeats_a_log_as_we_do(name, in_mujoco):
    """Positions' following error and forces miss the log by what our own replay misses it by, to a hundredth of that."""
    truth, model = build_models(name)
    law = CascadeLaw.for_model(truth)
    home = np.array(truth.robot.home)
    motion = move(truth.robot.actuated, home, home + 0.1 * (-1.0) ** np.arange(truth.robot.na), 0.8)
    controller = CascadeController(law, start=truth.steady())
    log = simulate(truth, motion, controller, Sensors(force_noise_relative=0.01), seed=1)
    log = log.window(100, log.n_samples)
    made = build_mjcf(model)
    assert made.callback
    with in_mujoco.open_in_mujoco(made) as theirs:
        found = replay(model, log, law, substeps=2, start_plant=partial(in_mujoco.MujocoPlant, theirs))
    ours = replay(model, log, law, substeps=2)
    for signal in ("force", "following"):
        sizes = [np.linalg.norm(x.residual(signal)) for x in (found, ours)]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.01)
    assert (
        np.abs(found.simulated["position"] - ours.simulated["position"]).max()
        < 1e-3 * np.ptp(ours.simulated["position"], axis=0).max()
    )
