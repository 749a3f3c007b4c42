"""The exported lead-through controller in a simulated contact: stiff, soft, lost, with a biased or a saturated sensor."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.control.lead_through import ForceLoop, ForceSensor, LeadThroughSettings
from tau_dyn.robot import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from lead_through_parts.contact import ContactRun, ContactSensors, Hand, ServoArm, run_contact
from lead_through_parts.contact_work import CompliantSurface
from lead_through_parts.exported import ExportedLaw
from lead_through_parts.scene import IRB140, START, UP

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
SERVO_HZ, SOFT, STIFF = 69.0, 2e3, 50e3


def settle(folder: Path, stiffness: float, *, bias: float = 0.0, hand: Hand | None = None) -> ContactRun:
    """Return 3 s of a tool that is led 2 mm down to a surface 1 mm below, with the exported controller."""
    loop = ForceLoop(servo_hz=SERVO_HZ)
    gain = 0.5 * loop.limit(STIFF).gain
    given = LeadThroughSettings(STIFF, force_gain=gain, loop=loop)
    arm = ServoArm(load_robot(IRB140), START, servo_hz=SERVO_HZ)
    surface = CompliantSurface(arm.pose.position - 0.001 * UP, UP, stiffness)
    down = Hand([0, 1.0], np.array([[0, 0, 0], [0, 0, -0.002]]), stiffness=1000.0)
    sensors = ContactSensors(0.05, 0.002, tool=build_sensor(bias, np.inf))
    return run_contact(arm, ExportedLaw(given, folder), surface, hand or down, 3.0, sensors=sensors, fine=1, seed=4)


def build_sensor(bias: float, largest: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a sensor that adds a bias along the tool's axis towards the work and clips each force axis."""
    plain = ForceSensor()

    def read(wrench: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        shown = plain.reading(wrench, rotation)
        shown[2] -= bias  # the tool's z axis points into the work, so a press reads below zero
        return np.r_[np.clip(shown[:3], -largest, largest), shown[3:]]

    return read


@pytest.mark.parametrize("stiffness", [SOFT, STIFF])
def test_two_newtons_are_held_on_soft_and_stiff_work(stiffness, tmp_path) -> None:
    """At half of the stiff work's limit, 2 N stay within 0.2 N on both; the peak of the landing stays below the force limit."""
    run = settle(tmp_path, stiffness)
    late = run.between(2.0, 3.0)
    assert np.abs(late.tool_force - 2.0).max() < 0.2 and late.contact.all()
    assert run.tool_force.max() < 10.0


def test_a_lost_contact_is_found_again(tmp_path) -> None:
    """A pull lifts the tool off, the force is zero in the air, and the next touch holds 2 N again."""
    points = np.array([[0, 0, 0], [0, 0, -0.002], [0, 0, -0.002], [0, 0, 0.02], [0, 0, -0.002]])
    hand = Hand([0, 0.6, 0.9, 1.4, 2.2], points, stiffness=1000.0)
    run = settle(tmp_path, STIFF, hand=hand)
    assert run.between(0.75, 0.9).contact.all()
    air = run.between(1.3, 1.5)
    assert not air.contact.any() and not air.tool_force.any()
    assert np.abs(run.between(2.7, 3.0).tool_force - 2.0).max() < 0.2


def test_a_biased_sensor_moves_the_held_force_by_its_bias(tmp_path) -> None:
    """A bias of 0.3 N is below the contact threshold: no false contact in the air, and 1.7 N are held instead of 2."""
    run = settle(tmp_path, STIFF, bias=0.3)
    assert not run.between(0.0, 0.2).contact.any()
    assert run.between(2.0, 3.0).tool_force.mean() == pytest.approx(1.7, abs=0.03)


def test_a_saturated_sensor_still_makes_the_tool_give_way(tmp_path) -> None:
    """Work that presses with 50 N saturates a sensor of 15 N; above 10 N the tool retreats, and 2 N return."""
    loop = ForceLoop(servo_hz=SERVO_HZ)
    given = LeadThroughSettings(
        STIFF, force_gain=0.5 * loop.limit(STIFF).gain, loop=loop, tool_sensor=ForceSensor(largest_force=15.0)
    )
    arm = ServoArm(load_robot(IRB140), START, servo_hz=SERVO_HZ)
    surface = CompliantSurface(arm.pose.position + 0.001 * UP, UP, STIFF)  # 50 N at the first sample
    idle = Hand([0.0], np.zeros((1, 3)), stiffness=0.0, damping=0.0)
    sensors = ContactSensors(tool=build_sensor(0.0, 15.0))
    driven = run_contact(arm, ExportedLaw(given, tmp_path), surface, idle, 1.5, sensors=sensors, fine=1)
    assert driven.tool_force[0] == pytest.approx(50.0)
    assert driven.command[0, 2] > 0
    assert driven.between(0.4, 1.5).tool_force.max() < 2.2 and driven.between(1.0, 1.5).tool_force.min() > 1.8


def test_measured_delays_of_the_loop_are_its_limit(tmp_path) -> None:
    """Commands two samples late: calm at half of that loop's limit, oscillating at 0.9 of the limit of a loop without delay."""
    late = ForceLoop(servo_hz=SERVO_HZ, delay=2)
    spread = {}
    for name, loop in (("stated", late), ("not stated", ForceLoop(servo_hz=SERVO_HZ))):
        given = LeadThroughSettings(
            STIFF, force_gain=0.9 * loop.limit(STIFF).gain if name != "stated" else 0.5 * loop.limit(STIFF).gain,
            loop=loop, watch=False, correction_range=0.0, normal_hz=None, force_limit=50.0,
        )  # fmt: skip
        arm = ServoArm(load_robot(IRB140), START, servo_hz=SERVO_HZ, delay=2)
        surface = CompliantSurface(arm.pose.position + 1.9 / STIFF * UP, UP, STIFF)
        idle = Hand([0.0], np.zeros((1, 3)), stiffness=0.0, damping=0.0)
        run = run_contact(arm, ExportedLaw(given, tmp_path), surface, idle, 1.5, fine=1)
        spread[name] = float(np.ptp(run.between(1.0, 1.5).tool_force))
    assert spread["stated"] < 1e-3, spread
    assert spread["not stated"] > 1.0, spread
