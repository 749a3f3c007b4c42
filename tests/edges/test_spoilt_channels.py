"""Channels that lie: jumping encoders are refused before filters make motion of them; held and clipped ones are told."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.identify import build_model, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.render.kinds.identification import describe_verdict
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion

SLIDES = """<robot name="slides"><link name="base_link"/>
<link name="axis_link"><inertial><mass value="95"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="axis" type="prismatic"><parent link="base_link"/><child link="axis_link"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="5" effort="1e4"/></joint>
<link name="slow_link"><inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="slow" type="prismatic"><parent link="base_link"/><child link="slow_link"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="5" effort="1e4"/></joint></robot>"""
"""Two slides that have nothing to do with each other."""

FRICTION = {"coulomb_pos": 20.0, "coulomb_neg": 16.0, "viscous_pos": 120.0, "viscous_neg": 100.0}


@pytest.fixture(scope="module")
def truth() -> Model:
    model = build_model(load_robot("linear_axis"), "asymmetric")
    return model.with_values({f"axis.{key}": value for key, value in FRICTION.items()})


@pytest.fixture(scope="module")
def log(truth) -> Log:
    """Twelve seconds at 200 Hz, 5 um and 2 N of noise."""
    path, rng = build_named_motion("fourier", truth, 12.0, 0).every(5), np.random.default_rng(3)
    tau = truth.torque(path.q, path.v, path.a)[:, 0] + 2 * rng.standard_normal(len(path.t))
    return Log(path.t, {"q_axis": path.q[:, 0] + 5e-6 * rng.standard_normal(len(path.t)), "tau_axis": tau}, "lies.csv")


def lost(q: np.ndarray) -> np.ndarray:
    return np.where(np.isin(np.arange(len(q)), (300, 1100, 1900)), 0.0, q)


def anew(q: np.ndarray) -> np.ndarray:
    return q + np.where(np.arange(len(q)) > 1200, 0.2, 0.0)


@pytest.mark.parametrize("spoilt", [lost, anew])
def test_an_encoder_that_jumps_is_refused(log, truth, spoilt: Callable[[np.ndarray], np.ndarray]) -> None:
    """Three lost readings made friction wrong by twenty standard errors, each marked as determined."""
    with raises_code("bad_sample", "lies.csv", "q_axis", "="):
        identify(truth.robot, log.with_channels(q_axis=spoilt(log.channels["q_axis"])), model="asymmetric")


def test_lost_readings_that_a_column_flags_are_left_out(log, truth) -> None:
    """Flagged by the logger, they are let pass, and friction and mass are those of the robot."""
    q = lost(log.channels["q_axis"])
    flag = np.convolve(q == 0.0, np.ones(3), "same")
    found = identify(truth.robot, log.with_channels(q_axis=q, lost=flag), model="asymmetric", exclude=("lost",))
    base = found.estimate.base
    off = (found.estimate.beta - base.combine(truth.parameters.select(base.names).values)) / found.estimate.stderr
    assert np.abs(off).max() < 4


def test_a_channel_renewed_seldom_is_told(log, truth) -> None:
    """Positions or forces held over two samples are late by half of one on average, which moves masses and friction."""
    for column in ("q_axis", "tau_axis"):
        held = np.repeat(log.channels[column][::2], 2)[: log.n_samples]
        found = identify(truth.robot, log.with_channels(**{column: held}), model="asymmetric")
        assert any(f"{column} is updated every 2 samples" in sentence for sentence in found.warnings)


def test_a_force_cut_off_below_the_drives_limit_is_told(log, truth) -> None:
    """What a logger cuts off no gate knows of; what the drive cuts off, at its limit, is gated out without a word."""
    tau = log.channels["tau_axis"]
    most = float(np.quantile(np.abs(tau), 0.9))
    clipped = log.with_channels(tau_axis=np.clip(tau, -most, most))
    assert any("plateau" in sentence for sentence in identify(truth.robot, clipped, model="asymmetric").warnings)
    assert not any("plateau" in s for s in identify(truth.robot, log, model="asymmetric").warnings)


def test_a_joint_without_usable_samples_is_not_called_perfect(log, truth) -> None:
    """A joint that rests in all that is held out leaves nothing to judge it by: that is said instead of an error of zero."""
    rng = np.random.default_rng(1)
    robot = load_robot_from_urdf(SLIDES, "slides")
    slow = {
        "q_slow": 0.3 * np.sin(0.4 * log.t) + 5e-6 * rng.standard_normal(log.n_samples),
        "tau_slow": log.channels["tau_axis"],
    }
    both = log.with_channels(**slow)
    still = both.channels["q_slow"].copy()
    cut = int(0.68 * log.n_samples)
    still[cut:] = still[cut] + 5e-6 * rng.standard_normal(log.n_samples - cut)
    found = identify(robot, both.with_channels(q_slow=still), model="symmetric")
    assert found.holdout is not None and found.holdout.unjudged == ("slow",) and found.train.unjudged == ()
    assert any("no held-out sample of slow can be used" in sentence for sentence in found.warnings)
    assert "slow" in describe_verdict(found).sentence


def test_a_joint_that_is_missed_is_not_hidden_behind_a_heavy_one(log, truth) -> None:
    """All joints together are told to 2 %, one of them to 90 %: a force of noise is called noise, another one unexplained."""
    rng = np.random.default_rng(2)
    robot = load_robot_from_urdf(SLIDES, "slides")
    noise = {"q_slow": 0.1 * np.sin(3 * log.t) + 5e-6 * rng.standard_normal(log.n_samples),
             "tau_slow": 3 * rng.standard_normal(log.n_samples)}  # fmt: skip
    found = identify(robot, log.with_channels(**noise), model="asymmetric")
    assert found.train.relative_error_percent < 20
    assert "is noise of the measured force" in describe_verdict(found).sentence
    noise["tau_slow"] = 3 * np.sin(11 * log.t) + 0.1 * rng.standard_normal(log.n_samples)
    found = identify(robot, log.with_channels(**noise), model="asymmetric")
    assert "Too much of the force is unexplained at slow" in describe_verdict(found).sentence


def test_a_force_that_only_the_held_out_log_has_is_not_called_noise(log, truth) -> None:
    """A joint is fitted to its noise, and a force acts on it in the held-out log alone: that force is unexplained."""
    rng = np.random.default_rng(4)
    robot = load_robot_from_urdf(SLIDES, "slides")
    q = 0.1 * np.sin(3 * log.t) + 5e-6 * rng.standard_normal(log.n_samples)
    noise = rng.standard_normal(log.n_samples)
    weak = log.with_channels(q_slow=q, tau_slow=-4.5 * np.sin(3 * log.t) + 0.3 * noise)
    pushed = log.with_channels(q_slow=q, tau_slow=-4.5 * np.sin(3 * log.t) + 0.3 * noise + 8 * np.sin(11 * log.t))
    found = identify(robot, weak, holdout=pushed, model="asymmetric")
    assert found.train.per_joint_percent[1] < 15
    assert "Too much of the force is unexplained at slow" in describe_verdict(found).sentence
