"""The whole room: a log that repeats, shows the friction hidden in it, and refuses what the robot cannot do."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import check_log, read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import (
    Sensors,
    Trajectory,
    build_fourier_motion,
    build_named_motion,
    build_stroke_motion,
    measure,
    move,
    simulate,
    simulate_drive,
)


def test_the_same_seed_gives_the_same_log(block):
    """Noise and feedback repeat bit by bit; another seed changes both the readings and the motion they feed back to."""
    motion, sensors = build_fourier_motion(block, 4.0), Sensors.typical(block.robot, log_rate_hz=500)
    one, same, other = (simulate(block, motion, sensors=sensors, seed=seed) for seed in (7, 7, 8))
    assert one.channels.keys() == same.channels.keys()
    assert all(np.array_equal(one.channels[k], same.channels[k]) for k in one.channels)
    assert not np.array_equal(one.channels["tau_axis"], other.channels["tau_axis"])


def test_encoder_noise_enters_the_feedback_unless_it_is_ideal(block, rng):
    """The drive answers to what its encoder reads; with ideal feedback the forces are the same for every seed."""
    motion, sensors = build_fourier_motion(block, 4.0), Sensors(encoder_noise=2e-6)
    noisy, ideal = (simulate(block, motion, sensors=sensors, feedback=f) for f in ("encoder", "ideal"))
    again = simulate(block, motion, sensors=sensors, feedback="ideal", seed=9)
    rough, smooth = (np.std(np.diff(log.channels["tau_axis"])) for log in (noisy, ideal))
    assert rough > 3 * smooth
    assert np.array_equal(ideal.channels["tau_axis"], again.channels["tau_axis"])
    assert not np.array_equal(ideal.channels["q_axis"], again.channels["q_axis"])


def test_log_holds_what_the_controller_read(block, rng):
    """With noisy feedback the logged positions are the controller's readings, not a second draw."""
    run = simulate_drive(block, build_fourier_motion(block, 4.0), None, Sensors(encoder_noise=1e-5), rng)
    log = measure(run, Sensors(encoder_noise=1e-5), rng)
    assert np.array_equal(log.channels["q_axis"], run.q_read[:, 0])
    assert_allclose(np.std(run.q_read - run.q), 1e-5, rtol=0.05)


def test_asymmetric_friction_shows_in_constant_strokes(make):
    """Mean force at constant speed is `Fc_pos + Fv_pos v` one way and `-Fc_neg + Fv_neg v` the other, within 0.05 N."""
    model = make.friction(make.block(95.0), 20.0, 200.0, 0.3)
    log = simulate(model, build_stroke_motion(model, 12.0, speeds=(0.1, 0.3)))
    v_ref = np.gradient(log.channels["q_ref_axis"], log.dt)
    for v in (0.1, 0.3, -0.1, -0.3):
        steady = np.abs(v_ref - v) < 1e-6
        steady &= np.convolve(steady, np.ones(200), "full")[: len(steady)] > 199.5  # the drive has settled
        expected = 26.0 + 260.0 * v if v > 0 else -14.0 + 140.0 * v
        assert_allclose(log.channels["tau_axis"][steady].mean(), expected, atol=0.05)


def test_log_passes_through_a_file_and_is_fit_for_use(gantry, tmp_path):
    """A simulated log is a log: written, read back, and judged fit by the same check as recordings."""
    log = simulate(gantry, build_fourier_motion(gantry, 12.0), sensors=Sensors.typical(gantry.robot, log_rate_hz=250))
    assert {"q_cart1", "tau_cart3", "q_ref_cart2", "x_tool"} <= set(log.channels)
    log.to_csv(tmp_path / "log.csv")
    back = read_log(tmp_path / "log.csv")
    assert_allclose(back.joint("tau", gantry.robot.actuated), log.joint("tau", gantry.robot.actuated), rtol=1e-11)
    assert check_log(back).fit_for_use


def test_a_motion_outside_the_limits_is_refused_by_name(gantry):
    """Joint, value and limit stand in the message: a range, a speed, a force."""
    joints = gantry.robot.actuated
    with raises_code("unreachable", "cart2", "1.2", "-0.9", "0.9"):
        simulate(gantry, move(joints, np.zeros(3), np.array([0.5, 1.2, 0.5]), 5.0))
    with raises_code("unreachable", "cart1", "m/s", "2"):
        simulate(gantry, move(joints, np.zeros(3), np.full(3, 0.8), 0.5))
    with raises_code("unreachable", "2000"):
        simulate(gantry, move(joints, np.zeros(3), np.full(3, 0.14), 0.135))


def test_a_refused_motion_says_how_much_slower_it_would_pass(gantry):
    """Slowed by the factor of the sentence the motion is taken; a range is not mended by time, so nothing is offered."""

    def shift(seconds: float):
        return move(gantry.robot.actuated, np.zeros(3), np.full(3, 0.14), seconds)

    with pytest.raises(InputError, match="times slower.*--speed .* --acceleration ") as fault:
        simulate(gantry, shift(0.135))
    factor = float(re.search("; ([0-9.]+) times slower", str(fault.value))[1])
    assert 1 < factor < 3 and simulate(gantry, shift(0.135 * factor)).n_samples > 100
    with pytest.raises(InputError) as fault:
        simulate(gantry, move(gantry.robot.actuated, np.zeros(3), np.array([0.5, 1.2, 0.5]), 5.0))
    assert "slower" not in str(fault.value)


def test_wrong_joints_and_feedback_are_refused(block, gantry):
    """A motion of other joints names both lists."""
    with raises_code("mismatch", "cart1", "cart2", "cart3"):
        simulate(gantry, build_fourier_motion(block, 4.0))
    with raises_code("invalid_value"):
        simulate(block, build_fourier_motion(block, 4.0), feedback="none")


def test_progress_is_told(block):
    """About a hundred shares, rising."""
    seen = []
    motion = Trajectory(("axis",), np.arange(1001) / 1000, *np.zeros((3, 1001, 1)))
    simulate(block, motion, progress=seen.append)
    assert 90 < len(seen) < 110 and seen == sorted(seen) and seen[-1] <= 1.0


def test_a_body_that_cannot_exist_is_not_simulated():
    """A first moment that puts the centre outside what the inertia allows is refused by the link's name."""
    robot = load_robot("gantry_tau").untied(["plate_link.mx"])
    model = Model.of(robot).with_values({"plate_link.mx": 50.0})
    with raises_code("unsupported", "plate_link"):
        simulate(model, build_named_motion("slow", Model.of(robot), 5.0))
