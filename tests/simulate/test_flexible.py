"""Vibration logs: what their columns hold, and that they show the robot's resonances."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import L1_DRIVES, FlexibleModel, Linearised, PositionDrives
from tau_dyn.robot import load_robot
from tau_dyn.simulate import VibrationSensors, push_log, simulate_binary_log, simulate_vibration_log


@lru_cache(maxsize=2)
def l1(wrist: str = "serial2") -> Linearised:
    robot = load_robot("gantry_tau", arms="complete", flexible="true", wrist=wrist)
    return FlexibleModel(robot).at(tool="gauge_block_link" if wrist == "serial2" else "tool", pushed="tool")


def strongest(y: np.ndarray, dt: float, low: float, high: float) -> float:
    """Return the frequency [Hz] at which a free decay answers most."""
    f = np.fft.rfftfreq(16 * len(y), dt)
    power = np.abs(np.fft.rfft(y - y.mean(), 16 * len(y)))
    inside = (f > low) & (f < high)
    return float(f[inside][np.argmax(power[inside])])


def test_a_binary_log_has_the_contracts_columns() -> None:
    """References jump between two levels around the pose, drives lag, the tool is where it rests, on average."""
    near = l1()
    log = simulate_binary_log(near, duration=20, drives=L1_DRIVES, sensors=VibrationSensors.length_gauges(), seed=3)
    carts = ("cart1", "cart2", "cart3")
    assert log.rate_hz == pytest.approx(250) and log.n_samples == 5000
    assert set(log.channels) == {f"{s}_{j}" for s in ("q_ref", "q") for j in carts} | {
        f"{a}{x}_tool" for a in ("", "a") for x in "xyz"
    }
    reference = log.joint("q_ref", carts) - near.q
    np.testing.assert_allclose(np.abs(reference), 1e-3, rtol=1e-9)
    assert np.abs(np.corrcoef(reference.T) - np.eye(3)).max() < 0.1  # joints can be told apart
    assert np.abs(log.joint("q", carts) - near.q).max() < 1.2e-3
    assert log.channels["x_tool"].mean() == pytest.approx(near.tool_position[0], abs=2e-3)


@pytest.mark.parametrize(("axis", "resonance"), [("x", 7.4), ("y", 11.45)])
def test_pushes_show_table_6_4(axis: str, resonance: float) -> None:
    """Pushed along x the tool rings at 7.4 Hz along x, pushed along y at 11.4 to 11.5 Hz along y."""
    log = push_log(l1(), axis, drives=L1_DRIVES, duration=6)
    assert strongest(log.channels[f"{axis}_tool"][300:], log.dt, 3, 30) == pytest.approx(resonance, abs=0.15)


def test_a_push_carries_its_impulse() -> None:
    log = push_log(l1(), "y", duration=4, impulse=2.0, repeat=2)
    assert log.channels["fy_tool"].sum() * log.dt == pytest.approx(4.0)
    assert not log.channels["fx_tool"].any() and np.ptp(log.channels["q_ref_cart1"]) == 0
    turns = push_log(l1(), "xyz", duration=6, impulse=2.0)
    when = [np.flatnonzero(turns.channels[f"f{x}_tool"])[0] * turns.dt for x in "xyz"]
    np.testing.assert_allclose(np.diff(when), 2.0)


def test_one_moving_joint_leaves_the_others_still() -> None:
    log = simulate_binary_log(l1("none"), duration=4, joints=["cart3"])
    assert np.ptp(log.channels["q_cart1"]) == 0 and np.ptp(log.channels["q_cart3"]) > 1e-3


def test_a_seed_fixes_the_log_and_noise_has_its_size() -> None:
    """The same seed gives the same numbers; against a perfect log the noise has the standard deviation asked for."""
    sensors = VibrationSensors(1e-6, 2e-6, 0.05)
    noisy, again, other = (simulate_binary_log(l1(), duration=20, sensors=sensors, seed=s) for s in (1, 1, 2))
    clean = simulate_binary_log(l1(), duration=20, seed=1)
    assert np.array_equal(noisy.channels["x_tool"], again.channels["x_tool"])
    assert not np.array_equal(noisy.channels["q_ref_cart1"], other.channels["q_ref_cart1"])
    for column, size in (("q_cart2", 1e-6), ("y_tool", 2e-6), ("az_tool", 0.05)):
        assert np.std(noisy.channels[column] - clean.channels[column]) == pytest.approx(size, rel=0.05)


def test_what_makes_no_log_is_refused() -> None:
    near, none = l1(), np.zeros((10, 3))
    for call, complaint in (
        (lambda: simulate_vibration_log(near, np.zeros((10, 2)), none, 0.004), "expected references"),
        (
            lambda: simulate_vibration_log(near, none, none, 0.004, drives=PositionDrives((0.1,) * 3, 0.003)),
            "whole number",
        ),
        (lambda: simulate_binary_log(near, duration=0.001), "no log"),
        (lambda: simulate_binary_log(near, amplitude=0.0), "positive amplitude"),
        (lambda: simulate_binary_log(near, joints=[]), "at least one joint"),
        (lambda: push_log(near, "x", width=9.0), "do not fit"),
        (lambda: VibrationSensors(tool_noise=-1.0), "below zero"),
    ):
        with pytest.raises(InputError, match=complaint):
            call()
    with raises_code("unknown_name", "cart9"):
        simulate_binary_log(near, joints=["cart9"])
    with raises_code("unknown_name", "direction"):
        push_log(near, "xw")
