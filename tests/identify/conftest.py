"""Logs for identification: of L1 and of a block, computed along a motion or simulated with feedback."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.cli.demo import build_true_model
from tau_dyn.effects import build_friction_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.simulate import PlantRun, Sensors, Trajectory, build_named_motion, simulate_drive


def recorded(
    truth: Model,
    motion: Trajectory,
    *,
    force_noise: float = 5.0,
    encoder_noise: float = 5e-6,
    seed: int = 0,
    rate_hz: float = 250.0,
    name: str = "made.csv",
) -> Log:
    """Return the log of a robot that follows a motion exactly; noise in N and m."""
    rng = np.random.default_rng([63, seed])
    path = motion.every(round(1000 / rate_hz))
    tau = truth.torque(path.q, path.v, path.a) + force_noise * rng.normal(size=path.q.shape)
    q = path.q + encoder_noise * rng.normal(size=path.q.shape)
    columns = (("q", q), ("tau", tau))
    return Log(path.t, {f"{key}_{j}": x[:, k] for key, x in columns for k, j in enumerate(motion.joints)}, name)


def changed(log: Log, **channels: np.ndarray) -> Log:
    """Return a log with some channels replaced or added."""
    return Log(log.t, dict(log.channels) | channels, log.name, log.sha256)


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """The makers above."""
    return SimpleNamespace(recorded=recorded, changed=changed)


@pytest.fixture(scope="session")
def l1() -> Robot:
    """The L1 Gantry-Tau with its nominal masses."""
    return load_robot("gantry_tau", prototype="l1")


@pytest.fixture(scope="session")
def truth(l1) -> Model:
    """L1 as it really is: masses up to 10 % off, Table 6.1's friction."""
    return build_true_model(l1, 3)


@pytest.fixture(scope="session")
def monday(truth) -> Log:
    """Half a minute of L1 at 250 Hz."""
    return recorded(truth, build_named_motion("fourier", truth, 30.0, 1), name="monday.csv")


@pytest.fixture(scope="session")
def tuesday(truth) -> Log:
    """Ten seconds of another motion."""
    return recorded(truth, build_named_motion("prbs", truth, 10.0, 2), seed=1, name="tuesday.csv")


@pytest.fixture(scope="session")
def found(l1, monday, tuesday):
    """What identification makes of monday, judged on tuesday."""
    from tau_dyn.identify import identify

    return identify(l1, monday, holdout=tuesday)


@pytest.fixture(scope="session")
def axis() -> Robot:
    """One prismatic drive."""
    return load_robot("linear_axis")


@pytest.fixture(scope="session")
def true_axis(axis) -> Model:
    """A drive of 93 kg with the friction of EMPS."""
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units))
    friction = {"coulomb_pos": 20.1, "coulomb_neg": 20.6, "viscous_pos": 167.0, "viscous_neg": 240.0}
    return model.with_values({f"axis.{k}": x for k, x in friction.items()} | {"carriage_link.mass": 93.0})


@pytest.fixture(scope="session")
def axis_log(true_axis) -> Log:
    """Twenty seconds of the drive."""
    return recorded(true_axis, build_named_motion("fourier", true_axis, 20.0, 0), force_noise=2.0, name="axis.csv")


@pytest.fixture(scope="session")
def driven(truth) -> tuple[PlantRun, PlantRun]:
    """What happened in 40 s and in 10 s of simulated L1, to be measured with many seeds of noise."""
    rng = np.random.default_rng(0)
    paths = (build_named_motion("fourier", truth, 40.0, 4), build_named_motion("prbs", truth, 10.0, 5))
    fit, held = (simulate_drive(truth, path, None, Sensors(), rng, feedback="ideal") for path in paths)
    return fit, held
