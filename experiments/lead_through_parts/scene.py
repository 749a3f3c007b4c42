"""The arm, the works and the operator of the lead-through study."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from lead_through_parts.contact import ContactRun, ContactSensors, Hand, LeadThroughLaw, ServoArm, run_contact
from lead_through_parts.contact_work import CompliantSurface, Hole
from tau_dyn.control.lead_through import ForceLoop, LeadThrough, LeadThroughSettings
from tau_dyn.robot import Robot, load_robot

IRB140 = Path(__file__).with_name("irb140.urdf")
START = np.array([0, 0.1, 0.2, 0, 1.2, 0])
CARDBOARD, PLATE = 2e3, 50e3  # [N/m] assumed; the thesis gives none
SERVO_HZ = 69.1  # the bandwidth at which an undelayed loop at 4 ms oscillates at the thesis' 68 Hz
NOISE = ContactSensors(force_noise=0.05, torque_noise=0.002)
FRICTION = 0.05  # a rolling tool
UP = np.array([0.0, 0.0, 1.0])


def robot() -> Robot:
    return load_robot(IRB140)


def settings(gain: float | np.ndarray, stated: float, **changed) -> LeadThroughSettings:
    """Return the thesis' controller, (8.10) as printed and without the stiffness watch, unless changed."""
    plain = {"normal_hz": None, "watch": False, "force_limit": 40.0, "loop": ForceLoop(servo_hz=SERVO_HZ)}
    return LeadThroughSettings(contact_stiffness=stated, force_gain=gain, **{**plain, **changed})


BuildLaw = Callable[[LeadThroughSettings], LeadThroughLaw]
"""A controller of settings: `LeadThrough`, or its exported C."""


def track(
    given: LeadThroughSettings,
    stiffness: float,
    seed: int,
    *,
    moves: bool = True,
    noise=NOISE,
    law: BuildLaw = LeadThrough,
) -> ContactRun:
    """Return 7 s on a level surface: approach in 1.5 s, rest to 2 s, then 100 mm along x and 50 mm along y."""
    arm = ServoArm(robot(), START, servo_hz=SERVO_HZ)
    surface = CompliantSurface(arm.pose.position - 0.02 * UP, UP, stiffness, friction=FRICTION)
    end = np.array([0.1, 0.05, 0.0]) if moves else np.zeros(3)
    down = -0.021 * UP  # the operator sees 1 mm of cardboard give way: 2 N
    hand = Hand([0, 1.5, 2, 7], np.array([0 * UP, down, down, down + end]), wander=0.0015, tremor=1e-4)
    return run_contact(arm, law(given), surface, hand, 7.0, sensors=noise, seed=seed)


def insert(
    side_stiffness: float,
    tilt_deg: float,
    seed: int,
    *,
    tool_force: bool = True,
    clearance: float = 0.001,
    law: BuildLaw = LeadThrough,
) -> tuple[ContactRun, np.ndarray, np.ndarray]:
    """Return a run with a peg, how deep it was and how far off the hole's axis [rad], both (N,).

    The hole leans towards a direction of the seed and its mouth is 0.4 mm beside where the operator aims.
    """
    toward = 2 * np.pi * np.random.default_rng(seed).random(2)
    lean, miss = (np.array([np.cos(a), np.sin(a), 0]) for a in toward)
    arm = ServoArm(robot(), START, servo_hz=SERVO_HZ)
    tilt = np.radians(tilt_deg)
    axis = np.sin(tilt) * lean + np.cos(tilt) * UP
    hole = Hole(arm.pose.position - 0.105 * UP, axis, clearance=clearance, side_stiffness=side_stiffness)
    aim = 0.0004 * miss
    points = np.array([0 * UP, aim - 0.008 * UP, aim - 0.045 * UP])
    hand = Hand([0, 1.5, 8], points, wander=0.0002, tremor=1e-4)
    run = run_contact(
        arm, law(peg_settings(tool_force)), hole, hand, 10.0, sensors=ContactSensors(0.03, 0.002), seed=seed
    )
    deep = np.array([hole.inserted(*at) for at in zip(run.position, run.rotation, strict=True)])
    return run, deep, np.array([hole.tilt(turn) for turn in run.rotation])


def peg_settings(tool_force: bool = True) -> LeadThroughSettings:
    return settings(
        np.array([0.01, 0.01, 0.01, 3.0, 3.0, 3.0]),
        20e3,
        task="peg",
        tool_force=tool_force,
        press=0.0,
        turning_stiffness=50.0,
        contact_on=0.4,
        torque_on=0.015,
        contact_wait=0.02,
        force_limit=8.0,
        speed_limit=0.02,
        locked_axis=UP,
        loop=ForceLoop(servo_hz=SERVO_HZ, filter_hz=15.0),
    )
