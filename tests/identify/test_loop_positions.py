"""Encoders at other joints of a loop than the drives."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import complete_positions, identify
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.message_codes import get_code

CRANK_HOME = np.pi / 3
BASE, CRANK, COUPLER, ROCKER = 0.8, 0.3, 0.9, 0.6  # [m], those of the fixture `four_bar`


def rocker_angle(crank: np.ndarray) -> np.ndarray:
    """Return the rocker's angle to the ground (N,) by the cosine rule, crank and ground in the same plane."""
    d, a, b, c = BASE, CRANK, COUPLER, ROCKER
    x, y = a * np.cos(crank) - d, a * np.sin(crank)
    diagonal = np.hypot(x, y)
    return np.arctan2(y, x) - np.arccos((c**2 + diagonal**2 - b**2) / (2 * c * diagonal))


@pytest.fixture
def crank() -> np.ndarray:
    """Crank angles from home (N,) [rad]."""
    t = np.arange(0, 20, 0.005)
    return 0.3 * np.sin(2 * np.pi * 0.21 * t) + 0.2 * np.sin(2 * np.pi * 0.83 * t)


def read_rocker(crank: np.ndarray) -> Log:
    """Return a log of the rocker's encoder alone."""
    q = rocker_angle(crank + CRANK_HOME) - rocker_angle(np.array([CRANK_HOME]))
    return Log(np.arange(len(crank)) * 0.005, {"q_rocker": q}, "rocker.csv")


def test_the_rockers_angle_gives_the_cranks(four_bar, crank) -> None:
    """The loop of a four-bar is closed at the measured angle of the other side, to rounding, and the log says so."""
    (log,) = complete_positions(four_bar, [read_rocker(crank)])
    assert_allclose(log["q_crank"], crank, atol=1e-9)
    assert [get_code(w) for w in log.warnings] == ["positions_from_loop"]


def test_masses_follow_from_a_force_at_the_crank_and_an_encoder_at_the_rocker(four_bar, crank) -> None:
    """Forces of the robot file's masses give them back: the model of the force is exact."""
    t = np.arange(len(crank)) * 0.005
    v, a = np.gradient(crank, t, edge_order=2), np.gradient(np.gradient(crank, t, edge_order=2), t, edge_order=2)
    tau = build_mechanism(four_bar).inverse_dynamics(crank[:, None], v[:, None], a[:, None])[:, 0]
    tau += 0.1 * np.sign(v) + 1e-3 * np.random.default_rng(0).standard_normal(len(t))
    log = read_rocker(crank)
    found = identify(four_bar, Log(t, {**log.channels, "tau_crank": tau}, "rocker.csv"))
    assert found.holdout is not None and found.holdout.relative_error_percent < 1.0
    assert any("follow over the loops" in w for w in found.warnings)


def test_a_log_with_too_few_joints_stays_as_it_is(four_bar) -> None:
    """Without any position there is nothing to close the loop with; the missing column is named later."""
    log = Log(np.arange(100) / 100, {"tau_crank": np.zeros(100)}, "blind.csv")
    assert complete_positions(four_bar, [log]) == [log]
    with raises_code("missing_column", "q_crank"):
        identify(four_bar, log)


def test_a_joint_at_the_end_of_its_swing_does_not_place_the_robot(four_bar, crank) -> None:
    """With crank and coupler in line the rocker turns back: its speed is zero while the crank goes on."""
    d, reach, c = BASE, CRANK + COUPLER, ROCKER
    in_line = np.arccos((d**2 + reach**2 - c**2) / (2 * d * reach))
    at_end = replace(four_bar, home=np.array([in_line - CRANK_HOME]))
    with raises_code("poor_excitation", "rocker"):
        complete_positions(at_end, [read_rocker(crank)])
