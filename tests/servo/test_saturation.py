"""Servos that saturate, without a law: a largest torque is estimated where the logs show it."""

from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.robot import Robot
from tau_dyn.servo import identify_loop, simulate_loop_log
from tau_dyn.servo.loads import InertialSpace
from tau_dyn.servo.prediction import simulate_coupled
from tau_dyn.servo.records import build_records
from tau_dyn.servo.simulation import read_values
from tau_dyn.simulate import ServoLaw, Trajectory

from .arms import build_arm, build_law, build_truth


def log_steps(robot, law, size: float, seed: int):
    """Return a log of 30 s of steps up to a size [rad] at every joint, with the noise of a 12 bit encoder."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 30, 0.02)
    q = np.repeat(rng.uniform(-size, size, (len(t) // 75, robot.na)), 75, axis=0)
    command = Trajectory(robot.actuated, t, q, 0 * q, 0 * q)
    return simulate_loop_log(
        build_truth(robot), law, command, seed=seed, encoder_resolution=2 * np.pi / 4096, encoder_noise=3e-4
    )


@pytest.mark.parametrize("n", [1, 2])
def test_a_servo_that_saturates_is_followed_without_its_law(n: int) -> None:
    """Steps of a radian at full output: the last joint's gain and limit are known up to one scale, and others keep none.

    The first of two joints is linear. Without a limit held-out steps are 88 and 43 mrad off.
    """
    robot = build_arm(n)
    limits = [*[1.0] * (n - 1), 0.12]
    law = build_law(robot, gain=[*[1.2] * (n - 1), 6.0], limit=limits, back_emf=0.02, load_friction=0.0)
    train, held = (log_steps(robot, law, 0.9 if n == 1 else 0.5, seed) for seed in (1, 2))
    found = identify_loop(robot, [train], holdout=[held])
    assert np.max(found.holdout.rms) < 0.02
    values = {p.name: p.value for p in found.parameters}
    last = robot.actuated[-1]
    assert values[f"{last}.limit"] / values[f"{last}.position_gain"] == pytest.approx(0.02, rel=0.3)
    assert sum(name.endswith(".limit") for name in values) == 1


def test_a_servo_that_never_saturates_has_no_limit() -> None:
    """A linear loop of one joint is followed by its gain alone."""
    robot = build_arm(1)
    log = log_steps(robot, build_law(robot, gain=1.2, back_emf=0.02, load_friction=0.0), 0.5, 3)
    found = identify_loop(robot, [log])
    assert not any(p.name.endswith(".limit") for p in found.parameters)


def test_a_limit_that_is_never_reached_has_no_standard_error() -> None:
    """Logs without information on a number do not give it an interval of no width."""
    robot = build_arm(1)
    law = build_law(robot, gain=1.2, back_emf=0.02, load_friction=0.0)
    asked = replace(law.with_values(limit=np.array([50.0])), estimated=frozenset({"limit"}))
    found = identify_loop(robot, [log_steps(robot, law, 0.5, 3)], law=asked)
    (limit,) = (p for p in found.parameters if p.name.endswith(".limit"))
    assert limit.value == pytest.approx(50.0) and limit.stderr is None


def test_logs_of_one_step_each_are_used() -> None:
    """Eight answers of 1 s to a command that holds from the first sample on: all 400 samples count, and the gain is known."""
    robot = build_arm(1)
    law = build_law(robot, gain=1.2, back_emf=0.02, load_friction=0.0, stiction=0.0)
    t = np.arange(0, 1, 0.02)
    logs = []
    for k, size in enumerate((-0.6, -0.4, -0.2, -0.1, 0.1, 0.2, 0.4, 0.6)):
        whole = np.where(np.arange(0, 3, 0.02) < 2, 0.0, size)[:, None]
        motion = Trajectory(robot.actuated, np.arange(len(whole)) * 0.02, whole, 0 * whole, 0 * whole)
        log = simulate_loop_log(build_truth(robot), law, motion, seed=k, encoder_noise=3e-4)
        step = {name: x[-len(t) :] for name, x in log.channels.items()}
        logs.append(Log(t, step, f"step{k}.csv"))
    found = identify_loop(robot, logs, holdout=[log_steps(robot, law, 0.5, 9)])
    assert found.n_samples == 8 * len(t)
    assert np.max(found.holdout.rms) < 0.02
    away = logs[0].with_channels(q_j1=2 * logs[0].channels["q_j1"][0] - logs[0].channels["q_j1"])
    with pytest.raises(InputError, match="the commands never change"):
        identify_loop(robot, [*logs[1:], away])


@pytest.mark.parametrize("start", [0.5, 18.0])
def test_the_gain_of_a_servo_that_saturates_is_found_from_its_law(start: float) -> None:
    """A known torque at full output, a gain of 3 per rad to be estimated: it is found from a start 6 times too low or high."""
    robot = build_arm(1)
    law = build_law(robot, gain=3.0, limit=0.3, back_emf=0.02, load_friction=0.0)
    train, held = (log_steps(robot, law, 0.9, seed) for seed in (1, 2))
    asked = replace(law.with_values(position_gain=np.array([start])), estimated=frozenset({"position_gain"}))
    found = identify_loop(robot, [train], law=asked, holdout=[held])
    (gain,) = (p.value for p in found.parameters if p.name.endswith(".position_gain"))
    assert gain == pytest.approx(3.0, rel=0.05)
    assert np.max(found.holdout.rms) < 0.005


def test_a_law_that_takes_off_a_share_of_the_speed_is_found() -> None:
    """At full output a derivative gain is no viscous friction; without it held-out steps are 17 mrad off or more."""
    robot = build_arm(1)
    law = build_law(robot, gain=6.0, limit=0.12, derivative_gain=0.6, back_emf=0.02, load_friction=0.0)
    train, held = (log_steps(robot, law, 0.9, seed) for seed in (1, 2))
    found = identify_loop(robot, [train], holdout=[held])
    values = {p.name: p.value for p in found.parameters}
    joint = robot.actuated[0]
    assert values[f"{joint}.derivative_gain"] / values[f"{joint}.position_gain"] == pytest.approx(0.1, rel=0.3)
    assert np.max(found.holdout.rms) < 0.015


def let_fall(robot: Robot, law: ServoLaw) -> Log:
    """Return the log of an arm under a constant command, whose motor is switched off after a second."""
    t = np.arange(0, 3, 0.02)
    still = {"cmd_j1": np.zeros(len(t)), "q_j1": np.zeros(len(t))}
    switched = Log(t, still | {"torque_enable": np.where(t < 1.0, 1.0, 0.0)}, "fall.csv")
    truth = build_truth(robot)
    (record,) = build_records(truth, replace(law, enabled="torque_enable"), [switched])
    (motion,) = simulate_coupled(InertialSpace.of(truth), np.zeros(0), read_values(truth, law), law, [record])
    return switched.with_channels(q_j1=np.interp(t, record.t, motion.q[:, 0]))


def test_a_log_of_a_motor_that_is_switched_off_needs_no_law() -> None:
    """An arm that falls with its motor off moves under a constant command; the column `torque_enable` is zero then."""
    robot = build_arm(1)
    law = build_law(robot, gain=1.2, back_emf=0.02, load_friction=0.0, stiction=0.0)
    fallen = let_fall(robot, law)
    assert np.ptp(fallen.channels["q_j1"]) > 0.3
    steps = log_steps(robot, law, 0.5, 3)
    steps = steps.with_channels(torque_enable=np.ones(steps.n_samples))
    found = identify_loop(robot, [steps, fallen])
    assert found.law.enabled == "torque_enable" and np.max(found.train.rms) < 0.02


def test_a_fall_with_the_motor_off_tells_friction_from_back_emf() -> None:
    """A motor that is off has no back EMF: 0.493 N m s/rad while it is on, next to 0.02 of viscous friction."""
    robot = build_arm(1)
    law = build_law(robot, load_friction=0.0, stiction=0.0)
    steps = log_steps(robot, law, 0.5, 3)
    steps = steps.with_channels(torque_enable=np.ones(steps.n_samples))
    found = identify_loop(robot, [steps, let_fall(robot, law)])
    values = {p.name: p.value for p in found.parameters}
    assert values["j1.back_emf"] / values["j1.position_gain"] == pytest.approx(0.17 / 2.65, rel=0.1)
    assert values.get("j1.viscous", 0.0) < 0.2 * values["j1.back_emf"]
    assert "back_emf" not in identify_loop(robot, [steps], holdout=[let_fall(robot, law)]).law.estimated
