"""Causes in actuators, told from logs: a torque-speed line, a gear that loses more one way, a motor that cogs."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.diagnose import diagnose
from tau_dyn.identify import Choices
from tau_dyn.log import Log
from tau_dyn.robot import Robot, load_robot_from_urdf

RATE_HZ, MASS, COULOMB, VISCOUS = 500.0, 12.0, 8.0, 15.0
STALL, NO_LOAD = 110.0, 1.6  # N, m/s

SLIDE = f"""<robot name="slide"><link name="base_link"/><link name="cart"><inertial><mass value="{MASS}"/>
 <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="x" type="prismatic">
 <parent link="base_link"/><child link="cart"/><axis xyz="1 0 0"/>
 <limit lower="-2" upper="2" velocity="{NO_LOAD}" effort="{STALL}"/></joint>
 <transmission name="d"><joint name="x"/><actuator name="m"/></transmission></robot>"""


def drive(seed: int, seconds: float = 60.0) -> tuple[Robot, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a slide, time, position, and force asked of and given by a motor that a controller drives into its line."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / RATE_HZ)
    f, phase = np.array([0.37, 0.61, 0.93]), rng.uniform(0, 6, 3)
    size = np.array([0.25, 0.12, 0.07])
    wave = 2 * np.pi * f * t[:, None] + phase
    q_ref, v_ref = np.sum(size * np.sin(wave), axis=1), np.sum(size * 2 * np.pi * f * np.cos(wave), axis=1)
    q, v, rows = q_ref[0], v_ref[0], []
    for goal, speed in zip(q_ref, v_ref, strict=True):
        asked = 1200.0 * (goal - q) + 120.0 * (speed - v) + COULOMB * np.sign(v)
        limit = max(0.0, STALL * (1 - abs(v) / NO_LOAD))
        given = min(asked, limit) if v > 0 else max(asked, -limit)
        a, dt = (given - COULOMB * np.sign(v) - VISCOUS * v) / MASS, 1 / RATE_HZ
        rows.append((q + v * dt / 2, asked, given))  # a force is held, so the middle of the step shows it
        q, v = q + dt * v + dt**2 / 2 * a, v + dt * a
    q_all, asked_all, given_all = np.array(rows).T
    noise = rng.normal(size=(3, len(t))) * np.array([[5e-6], [1.0], [1.0]])
    return load_robot_from_urdf(SLIDE, "slide"), t, q_all + noise[0], asked_all + noise[1], given_all + noise[2]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_log_of_asked_forces_names_the_torque_speed_line(seed: int):
    """Beyond the line of the robot file's limits all is lost; a log of the delivered force says nothing of it."""
    robot, t, q, asked, given = drive(seed)
    beyond = np.abs(asked - given) > 5
    assert 0.02 < beyond.mean() < 0.5
    found = diagnose(robot, Log(t, {"q_x": q, "tau_x": asked}, "asked.csv"))
    limit = next(f for f in found.findings if f.cause == "torque_speed_limit")
    assert limit.status == "confirmed"
    lost = next(p for p in limit.parameters if p.name == "x.lost")
    assert lost.value == pytest.approx(1, abs=0.1)
    plain = diagnose(robot, Log(t, {"q_x": q, "tau_x": given}, "given.csv"))
    assert not [f for f in plain.findings if f.status == "confirmed"]


def build_pendulum(ratio: float = 20.0) -> Robot:
    """Return an arm of 4 kg whose weight a geared motor lifts."""
    return load_robot_from_urdf(
        f"""<robot name="pendulum"><link name="base_link"/><link name="arm"><inertial><origin xyz="0.3 0 0"/><mass value="4"/>
 <inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="x" type="revolute">
 <parent link="base_link"/><child link="arm"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" velocity="6" effort="90"/></joint>
 <transmission name="d"><joint name="x"/><actuator name="m"><mechanicalReduction>{ratio}</mechanicalReduction></actuator>
 </transmission></robot>""",
        "pendulum",
    )


def swing(driving: float = 0.0, driven: float = 0.0, cogging: float = 0.0, seed: int = 0) -> Log:
    """Return 60 s of the arm, with what its gear loses each way and a motor that cogs three times a turn behind 20 : 1."""
    rng, t = np.random.default_rng(seed), np.arange(0, 60, 1 / 250)
    w, size = 2 * np.pi * np.array([0.21, 0.47, 0.83]), np.array([0.9, 0.4, 0.15])
    wave = w * t[:, None] + rng.uniform(0, 6, 3)
    q, v = np.sum(size * np.sin(wave), axis=1) - 1, np.sum(size * w * np.cos(wave), axis=1)
    load = -0.41 * np.sum(size * w**2 * np.sin(wave), axis=1) - 4 * 9.81 * 0.3 * np.cos(q)
    tau = load + 1.2 * np.sign(v) + 0.4 * v + np.where(load * v > 0, driving, -driven) * load
    tau += cogging * np.sin(3 * 20 * q + 1)
    noise = rng.normal(size=(2, len(t)))
    return Log(t, {"q_x": q + 2e-5 * noise[0], "tau_x": tau + 0.1 * noise[1]}, "swing.csv")


def test_the_refit_of_a_mass_makes_a_lossy_gear_the_twin_of_load_friction():
    """What a gear loses more when driving looks like a heavier arm; with the arm weighed both losses are read off."""
    robot, log = build_pendulum(), swing(driving=0.3, driven=0.1)
    free = next(f for f in diagnose(robot, log).findings if f.status == "confirmed")
    assert free.cause == "load_friction" and "directional_efficiency" in free.indistinguishable_from
    weighed = diagnose(robot, log, choices=Choices(fix=("arm.*",))).findings[0]
    assert (weighed.cause, weighed.status) == ("directional_efficiency", "confirmed")
    values = {p.name: p.value for p in weighed.parameters}
    assert values == pytest.approx({"x.loss_driving": 0.3, "x.loss_driven": 0.1}, abs=0.02)


def test_equal_losses_are_not_called_directional():
    """20 % each way, on a weighed arm, are load friction."""
    first = diagnose(build_pendulum(), swing(driving=0.2, driven=0.2), choices=Choices(fix=("arm.*",))).findings[0]
    assert (first.cause, first.status) == ("load_friction", "confirmed")


@pytest.mark.parametrize(("ratio", "cause"), [(20.0, "cogging"), (1.0, "cyclic_ripple")])
def test_a_known_gear_ratio_tells_cogging_from_a_ripple(ratio: float, cause: str):
    """Three periods a motor turn behind 20 : 1; where the file gives no ratio, it is a ripple of the joint."""
    first = diagnose(build_pendulum(ratio), swing(cogging=0.4)).findings[0]
    assert (first.cause, first.status) == (cause, "confirmed")
