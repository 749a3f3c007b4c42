"""A motor on a pendulum, integrated by SciPy from its voltage: what identify and diagnose make of the circuit."""

from __future__ import annotations

from functools import cache
from math import cos, sin
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import odeint

from tau_dyn.diagnose import diagnose
from tau_dyn.effects import EFFECTS, Motion, Scene
from tau_dyn.identify import identify
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot_from_urdf

ARM = """<robot name="arm"><link name="base_link"/><link name="arm_link"><inertial><origin xyz="0.2 0 0"/><mass value="1.2"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="x" type="revolute">
<parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" velocity="20" effort="60"/>
</joint><transmission name="d"><joint name="x"/><actuator name="m"/></transmission></robot>"""
INERTIA, MOMENT, GRAVITY, VISCOUS = 0.02 + 1.2 * 0.2**2, 1.2 * 0.2, 9.81, 0.05
R, K, SUPPLY = 2.0, 0.8, 12.0  # ohm, N m/A and V s/rad, V
RATED, LAG_S = 3.0, 12.0


@pytest.fixture(scope="module")
def arm() -> Robot:
    return load_robot_from_urdf(ARM, "arm")


@cache
def swing(seed: int = 3, L: float = 1e-4, rise: float = 0.0, supply_ohm: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return time, positions, applied voltages or pulse widths times the supply, and currents (N,) of 80 s of motion."""
    rng = np.random.default_rng(seed)
    waves = list(zip((2 * np.pi * rng.uniform(0.2, 2.5, 7)).tolist(), rng.uniform(0, 6, 7).tolist(), strict=True))

    def drive(t: float) -> float:
        return (1.0 if t % 40 < 20 else 0.35) * 1.6 * sum(sin(w * t + p) for w, p in waves)

    def rate(x: np.ndarray, t: float) -> tuple[float, ...]:
        q, v, i, h = x
        u = drive(t)
        u -= supply_ohm * (u / SUPPLY) ** 2 * i
        a = (K * i + MOMENT * GRAVITY * cos(q) - VISCOUS * v) / INERTIA
        return v, a, (u - R * (1 + rise * h) * i - K * v) / L, ((K * i / RATED) ** 2 - h) / LAG_S

    t = np.arange(0, 80, 4e-3)
    x = odeint(rate, [np.pi / 2, 0, 0, 0], t, rtol=1e-6, atol=1e-8, hmax=5e-3, mxstep=5000)
    return t, x[:, 0] + 2e-5 * rng.standard_normal(len(t)), np.array([drive(s) for s in t]), x[:, 2]


def log_voltage(signal: str = "voltage", seed: int = 3, **motor: float) -> Log:
    """Return a log whose force is the voltage: the torque of the cold motor at rest."""
    t, q, u, _ = swing(seed, **motor)
    u = u + 0.025 * np.random.default_rng(seed).standard_normal(len(u))
    return Log(t, {"q_x": q, "tau_x": u * K / R, f"{signal}_x": u / (SUPPLY if signal == "pwm" else 1)}, "volts.csv")


def test_voltage_beside_current_gives_the_circuit(arm: Robot):
    """Within three standard errors, of below 1 % (inductance 10 %), with a measured current and with the force in its place.

    A current's noise of a sixth of the current pulls none of them.
    """
    t, q, u, i = swing(L=6e-3)
    rng = np.random.default_rng(0)
    i, u = i + 0.1 * rng.standard_normal(len(i)), u + 0.02 * rng.standard_normal(len(u))
    channels = {"q_x": q, "tau_x": K * i, "voltage_x": u}
    for more, unit, per in (({"current_x": i}, "ohm", 1.0), ({}, "V/(N m)", K)):
        found = identify(arm, Log(t, channels | more, "motor.csv"), model="symmetric")
        motor = {p.name: p for p in found.motors}
        assert motor["x.resistance"].unit == unit
        for name, true in (("resistance", R / per), ("back_emf", K), ("inductance", 6e-3 / per)):
            p = motor[f"x.{name}"]
            assert p.stderr is not None and abs(p.value - true) < 3 * p.stderr
            assert p.stderr < (0.1 if name == "inductance" else 0.01) * true
        assert {row["name"] for row in found.to_dict()["motors"]} == set(motor)


def test_too_short_a_log_of_voltages_is_reported(arm: Robot):
    """20 s of motion give masses and friction; the circuit needs 40 s, and the warning states both lengths."""
    t, q, u, i = (x[:5000] for x in swing(L=6e-3))
    found = identify(arm, Log(t, {"q_x": q, "tau_x": K * i, "voltage_x": u, "current_x": i}, "motor.csv"))
    (said,) = (w for w in found.warnings if w.startswith("resistance, back-EMF and inductance of x are left out"))
    assert not len(found.motors) and "20 s of motion" in said and "40 s or more" in said


def test_of_a_voltage_alone_back_emf_is_viscous_friction(arm: Robot):
    """The arm's first moment is right, viscous friction is `b + k_t k_e / R`, and both answers say what would divide it."""
    log = log_voltage()
    found = identify(arm, log, model="symmetric")
    assert "force_is_voltage" in [get_code(w) for w in found.warnings] and not len(found.motors)
    assert_allclose(found.parameters["x.viscous"].value, VISCOUS + K**2 / R, rtol=0.01)
    assert_allclose(found.parameters["arm_link.mx"].value, MOMENT, rtol=0.005)
    why = EFFECTS["back_emf"].untestable(offer({"voltage"}))
    assert why is not None and "viscous friction" in why[0] and "current" in why[1]
    assert EFFECTS["back_emf"].untestable(offer(set())) == ("the logs give no voltage", why[1])


def test_windings_that_warm_are_named(arm: Robot):
    """A resistance that rises by half under 3 N m, with 12 s: named, with time constant and back-EMF within 15 %."""
    found = diagnose(arm, log_voltage(seed=4, rise=0.5), model="symmetric")
    (one,) = [f for f in found.findings if f.status == "confirmed"]
    values = {p.name: p.value for p in one.parameters}
    rated = one.effects[0].settings["rated"]
    assert one.cause == "winding_heat" and found.verdict == "named"
    assert_allclose([values["x.lag"], values["x.back_emf"]], [LAG_S, K**2 / R], rtol=0.15)
    assert_allclose(values["x.resistance_rise"] * (RATED / rated) ** 2, 0.5, rtol=0.15)


def test_a_supply_that_sags_is_named(arm: Robot):
    """A supply of 0.6 ohm loses 0.3 pwm^2 of the torque: named from pulse widths, within 15 %."""
    found = diagnose(arm, log_voltage("pwm", supply_ohm=0.6), model="symmetric")
    one = found.findings[0]
    peak = one.effects[0].settings["peak"] / (SUPPLY * K / R)
    assert (one.cause, one.status) == ("supply_sag", "confirmed")
    assert_allclose(one.parameters[0].value / peak**2, 0.6 / R, rtol=0.15)


def test_inductance_is_a_force_logged_early(arm: Robot):
    """3 ms of L / R: whichever of the two is named, the other stands beside it."""
    log = log_voltage(L=6e-3)
    (one,) = [f for f in diagnose(arm, log, model="symmetric").findings if f.status == "confirmed"]
    assert {"inductance", "delay"} <= {one.cause, *one.indistinguishable_from}
    assert_allclose(abs(one.parameters[0].value), 3e-3, rtol=0.1)


def moving(t: np.ndarray, v: np.ndarray, **signals: np.ndarray) -> Motion:
    column = v[:, None]
    found = {key: x[:, None] for key, x in signals.items()}
    return Motion.of(("x",), 0 * column, column, 0 * column, t=t, signals=found)


def offer(signals: set[str]) -> Scene:
    """Return what a minute's motion of a hinge with these signals offers."""
    one, scales = np.ones(1), {"x": {"force": 9.0, "viscous": 2.0}}
    return Scene(
        ("x",), ("N m",), -one, one, 0.01 * one, 2 * one, 20.0, 60.0, signals=frozenset(signals), scales=scales
    )


def build(name: str, **settings: float) -> Any:
    return EFFECTS[name](["x"], ["N m"], **settings)


def test_each_law_is_its_equation():
    """2 N m at 3 rad/s with 0.5 N m s/rad of back-EMF: 0.5 N m are the current's part, and heat to 1 - exp(-t / lag) of it."""
    t = np.arange(0, 100, 0.01)
    v, force, warm = 3.0 + 0 * t, 2.0 + 0 * t, 50.0 + 0 * t
    motion = moving(t, v, force=force, temperature=warm)
    heat = build("winding_heat", back_emf=0.5, lag=10.0, rated=0.25).columns(motion)[:, 0, 0]
    assert_allclose(heat, 0.5 * 4 * (1 - np.exp(-t / 10.0)), rtol=2e-3, atol=5e-3)
    assert_allclose(build("winding_heat", back_emf=0.5, sensed=1).columns(motion)[:, 0, 0], 30 * 0.5)
    assert_allclose(build("supply_sag", back_emf=0.5, peak=4.0).columns(motion)[:, 0, 0], 0.25 * 0.5)
    assert_allclose(build("back_emf").columns(motion)[:, 0, 0], 3.0)
    ramp = build("inductance").columns(moving(t, v, force=7.0 * t))[:, 0, 0]
    assert_allclose(ramp, 7.0, rtol=1e-9)


def test_a_measured_temperature_takes_the_place_of_the_lag():
    """With a column of temperatures the grid has no time constant, without one none longer than half the recording."""
    known = {"voltage", "force"}
    rows = [EFFECTS["winding_heat"].grid(offer(signals), ("x",)) for signals in (known, known | {"temperature"})]
    assert {row["lag"] for row in rows[0]} == {2.5, 5.0, 10.0, 20.0}
    assert {row["back_emf"] for row in rows[0]} == {0.0, 1.0, 2.0}
    assert all(row["sensed"] and "lag" not in row for row in rows[1])
