"""Causes in actuators, told from logs: a motor's torque-speed line, a gear that loses more one way, a motor's cogging."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.diagnose import diagnose
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
