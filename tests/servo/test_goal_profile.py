"""A servo that limits its goal's acceleration: the limit is estimated, named, and acts on streams alone if asked to."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import tau_dyn as td
from tau_dyn.robot import Robot
from tau_dyn.servo import diagnose_loop, identify_loop, simulate_loop_log
from tau_dyn.servo.unknowns import measure_change
from tau_dyn.servo.waves import find_command_steps
from tau_dyn.simulate import ServoLaw, Trajectory, build_servo_law, read_servo_law

from .arms import build_arm, build_law, build_truth

ARM = build_arm(1)
TRUTH = build_truth(ARM)
CONTROLLERS = Path(__file__).resolve().parents[2] / "identification" / "controllers"
KNOWN = {"load_friction": 0.0, "stiction": 0.0}
NOISE = 5e-4  # rad
LIMIT = 25.0  # rad/s^2


def build_motion(robot: Robot, seed: int, sweep: bool = True, steps: bool = True) -> Trajectory:
    """Return 20 s of commands at 50 Hz: a sweep to about 1.4 Hz, whose last 8 s are steps of 0.3 rad; or one of these alone."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 20, 0.02)
    phase = 2 * np.pi * (0.2 * t + rng.uniform(1.0, 1.4) * t**2 / 40)
    q = rng.uniform(0.15, 0.22) * np.sin(phase + rng.uniform(0, 6)) if sweep else np.zeros(len(t))
    level = np.repeat(rng.choice([-0.15, 0.15], 25), 40)
    q = np.where((t > 12) | (not sweep), level, q) if steps else q
    q = np.repeat(q[:, None], robot.na, axis=1)
    v = np.gradient(q, t, axis=0)
    return Trajectory(robot.actuated, t, q, v, np.gradient(v, t, axis=0))


def record(law: ServoLaw, seed: int, **parts: bool) -> td.Log:
    """Return a log of the arm."""
    return simulate_loop_log(
        TRUTH, law, build_motion(ARM, seed, **parts), encoder_noise=NOISE, seed=seed, name=f"log {seed}"
    )


@pytest.mark.parametrize("passes", [1.0, 0.0])
def test_a_limit_is_recovered_and_predicts_to_the_encoder(passes):
    """From a start that is twice as large the limit is within its interval, and a further log is predicted to the noise."""
    law = build_law(ARM, **KNOWN, acceleration_limit=LIMIT, steps_pass=passes)
    start = build_law(ARM, **KNOWN, acceleration_limit=2 * LIMIT, steps_pass=passes)
    asked = replace(start, estimated=frozenset({"acceleration_limit"}))
    found = identify_loop(ARM, [record(law, s) for s in (1, 2)], law=asked, holdout=record(law, 3))
    row = next(p for p in found.parameters if p.name == "j1.acceleration_limit")
    assert abs(row.value - LIMIT) < 3 * row.stderr < 0.04 * LIMIT
    assert found.holdout.rms[0, 0] < 1.05 * NOISE
    without = identify_loop(ARM, [record(law, s) for s in (1, 2)], law=build_law(ARM, **KNOWN), holdout=record(law, 3))
    assert without.holdout.rms[0, 0] > 5 * NOISE


@pytest.mark.parametrize("passes", [1.0, 0.0])
def test_a_profile_is_named_with_its_limit_and_its_form(passes):
    """A diagnosis of a law without a profile names it, and tells whether steps pass."""
    law = build_law(ARM, **KNOWN, acceleration_limit=LIMIT, steps_pass=passes)
    answer = diagnose_loop(ARM, [record(law, s) for s in (1, 2)], law=build_law(ARM, **KNOWN))
    (finding,) = [f for f in answer.findings if f.status == "confirmed"]
    assert (finding.cause, finding.joints) == ("goal_profile", ("j1",))
    limit, form = finding.parameters
    assert limit.value == pytest.approx(LIMIT, rel=0.05)
    assert (form.name, form.value) == ("j1.steps_pass", passes)
    assert answer.extended.rms[0] < 1.1 * NOISE < 0.3 * answer.baseline.rms[0]
    again = build_servo_law(answer.extended_model.controller, ARM, "law.yaml")
    assert_allclose(again.values["acceleration_limit"], limit.value)


def test_a_servo_without_a_profile_has_none():
    """Sweeps and steps of a plain servo name no profile; its absence down to some limit is reported."""
    law = build_law(ARM, **KNOWN)
    logs = [record(law, s) for s in (1, 2)]
    answer = diagnose_loop(ARM, logs, law=law)
    assert not answer.findings
    limits = answer.to_dict()["detection_limits"]["goal_profile"]
    assert limits["amplitude"] > LIMIT
    assert answer.verdict == "nothing_found"


def test_steps_pass_a_profile_of_streamed_goals():
    """Of a servo whose profile lets steps pass, steps are those of a servo without; sweeps are not."""
    plain, streamed, every = (
        build_law(ARM, **KNOWN, **more)
        for more in ({}, {"acceleration_limit": 10.0, "steps_pass": 1.0}, {"acceleration_limit": 10.0})
    )

    def run(law: ServoLaw, **parts: bool) -> np.ndarray:
        return simulate_loop_log(TRUTH, law, build_motion(ARM, 4, **parts)).channels["q_j1"]

    assert_allclose(run(streamed, sweep=False), run(plain, sweep=False), atol=1e-12)
    assert np.abs(run(every, sweep=False) - run(plain, sweep=False)).max() > 0.05
    assert_allclose(run(streamed, steps=False), run(every, steps=False), atol=5e-3)
    assert np.abs(run(streamed, steps=False) - run(plain, steps=False)).max() > 0.05


@pytest.mark.parametrize("rate", [50.0, 500.0])
def test_a_step_is_told_from_a_stream_whatever_the_rate(rate):
    """Commands at 50 Hz that a log holds at its own rate: a step is a change after a rest or a jump within a stream."""
    held = round(rate / 50)
    ramp = 0.02 * np.arange(20)
    rest = np.full(20, ramp[-1])
    told = np.concatenate([np.zeros(20), ramp[1:], rest, rest + 0.3, ramp + 0.7, np.full(5, 0.7)])
    command = np.repeat(told, held)[:, None, None]
    found = np.flatnonzero(find_command_steps(command, np.arange(len(command))[:, None, None] / rate)[:, 0, 0]) / held
    assert_allclose(found, [20, 59, 79, 99])


def test_the_shipped_law_has_the_limit_of_the_register():
    """254 units of 100 steps/s^2, 4096 steps a turn; everything else is as in the law without a profile."""
    plain, streamed = (read_servo_law(CONTROLLERS / name, ARM) for name in ("sts3215.yaml", "sts3215_streamed.yaml"))
    differ = {key for key, x in streamed.values.items() if not np.array_equal(x, plain.values[key])}
    assert differ == {"acceleration_limit", "steps_pass"}
    assert_allclose(streamed.values["acceleration_limit"], 254 * 100 * 2 * np.pi / 4096, rtol=1e-3)


def test_limits_are_compared_by_their_inverse():
    """No limit is an infinite one: 25 +- 0.5 is 0.04 +- 0.0008 from it, and a gain of 2 +- 0.1 is 0.5 from 1.5."""
    value, stderr = np.array([25.0]), np.array([0.5])
    away, error = measure_change("acceleration_limit", value, np.array([np.inf]), stderr)
    assert_allclose([away[0], error[0]], [0.04, 1 / 24.5 - 1 / 25], rtol=0.03)
    away, error = measure_change("position_gain", np.array([2.0]), np.array([1.5]), np.array([0.1]))
    assert_allclose([away[0], error[0]], [0.5, 0.1])


def test_a_profile_law_is_written_and_read():
    """A limit at one joint of two is written without the other; a form is 0 or 1."""
    arm = build_arm(2)
    law = build_law(arm, acceleration_limit=np.array([LIMIT, np.inf]), steps_pass=1.0)
    content = law.to_dict()
    assert content["acceleration_limit"] == {"j1": LIMIT}
    again = build_servo_law(content, arm, "law.yaml")
    assert all(np.array_equal(again.values[key], x) for key, x in law.values.items())
    with pytest.raises(td.InputError, match="steps_pass is 0 or 1"):
        build_servo_law(content | {"steps_pass": 0.5}, arm, "law.yaml")
