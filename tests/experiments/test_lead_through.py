"""An arm, a hand and a work in one loop with the lead-through law."""

import sys
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.control.lead_through import ForceLoop, ForceSensor, LeadThrough, LeadThroughSettings
from tau_dyn.robot import load_robot

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from lead_through_parts.contact import ContactSensors, Hand, ServoArm, run_contact
from lead_through_parts.contact_work import CompliantSurface, Hole

IRB140 = Path(__file__).parents[2] / "experiments" / "lead_through_parts" / "irb140.urdf"
UP = np.array([0.0, 0.0, 1.0])
IDLE = Hand([0.0], np.zeros((1, 3)), stiffness=0.0, damping=0.0)
STARTS = {
    "irb140": [0, 0.1, 0.2, 0, 1.2, 0],
    "ur5": [0.3, -1.2, 1.6, -1.97, -1.57, 0.4],
    "panda": [0, -0.4, 0, -2.0, 0.2, 1.8, 0.6],
}


@pytest.fixture(scope="module")
def robots():
    """The arm of the IRB 140's kind, and two others that nothing was adjusted to."""

    def make(name):
        if name == "irb140":
            return load_robot(IRB140)
        ends = {"ur5": "urdf/ur5_robot.urdf", "panda": "urdf/panda.urdf"}
        try:
            found = [f for f in files("example-robot-data") or () if str(f).endswith(ends[name])]
        except PackageNotFoundError:
            found = []
        if not found:
            pytest.skip("example-robot-data is not installed")
        joints = [f"panda_joint{k}" for k in range(1, 8)] if name == "panda" else None
        return load_robot(Path(str(found[0].locate())), actuated=joints)

    return make


def arm_of(robots, name="irb140", **options):
    frame = "panda_link8" if name == "panda" else None
    return ServoArm(robots(name), np.array(STARTS[name]), frame=frame, **options)


def settings(stiffness, gain, **changed):
    plain = {"correction_range": 0.0, "normal_hz": None, "watch": False, "force_limit": 50.0}
    return LeadThroughSettings(**{"contact_stiffness": stiffness, "force_gain": gain, **plain, **changed})


def test_a_hand_pulls_along_what_is_behind_and_slow():
    """A hand is a spring to where it wants the tool and a damper against another speed, of limited strength."""
    hand, zero = Hand([0.0], np.zeros((1, 3)), stiffness=300.0, damping=10.0, strength=15.0), np.zeros(3)
    np.testing.assert_allclose(hand.force(zero, 0.2 * UP, zero, 0.05 * UP), 1.5 * UP)
    np.testing.assert_allclose(hand.force(0.01 * UP, zero, zero, zero), 3.0 * UP)
    np.testing.assert_allclose(hand.force(UP, zero, zero, zero), 15.0 * UP)


@pytest.mark.parametrize("name", sorted(STARTS))
def test_the_arm_moves_as_it_is_told(robots, name):
    """A tool velocity held for 0.4 s moves and turns the tool by just that, and the joints' lag is the servo's."""
    arm = arm_of(robots, name, servo_hz=50.0)
    start, turned = arm.pose
    twist = np.array([0.03, -0.02, 0.01, 0.02, 0.03, -0.05])
    for _ in range(100):
        arm.command(twist)
        arm.advance(0.004)
    lag = 1 / (2 * np.pi * 50.0)
    assert np.allclose(arm.pose.position - start, twist[:3] * (0.4 - lag), atol=2e-4)
    spin = arm.pose.rotation @ turned.T
    assert np.allclose([spin[2, 1], spin[0, 2], spin[1, 0]], twist[3:] * (0.4 - lag), atol=3e-4)
    assert np.allclose(turned[:, 2], -UP)


@pytest.mark.parametrize(
    ("name", "servo", "delay"), [("irb140", 69.0, 0), ("irb140", 15.0, 2), ("ur5", 69.0, 1), ("panda", 30.0, 0)]
)
def test_the_predicted_stability_limit_is_the_simulated_one(robots, name, servo, delay):
    """A contact 3 % within the predicted limit calms down on the whole arm, 3 % beyond it grows."""
    loop = ForceLoop(servo_hz=servo, delay=delay)
    limit = loop.limit(20e3)
    for share, grows in ((0.97, False), (1.03, True)):
        arm = arm_of(robots, name, servo_hz=servo, delay=delay)
        law = LeadThrough(settings(1e3, share * limit.gain, loop=loop))
        surface = CompliantSurface(arm.pose.position + [0, 0, 1.95 / 20e3], UP, 20e3)
        force = run_contact(arm, law, surface, IDLE, 1.6, fine=1).tool_wrench[:, 2] - 2
        assert (np.ptp(force[300:]) > np.ptp(force[100:200])) == grows
        if grows:
            spectrum = np.abs(np.fft.rfft(force[:350] * np.hanning(350)))
            assert np.fft.rfftfreq(350, 0.004)[np.argmax(spectrum)] == pytest.approx(limit.hz, rel=0.03, abs=0.8)


def test_force_is_held_along_an_uneven_surface_only_with_the_second_sensor(robots):
    """With tool force control 2 N stay within half a newton over 1 mm waves; with the handle alone it wanders."""
    forces = {}
    for tool_force in (True, False):
        arm = arm_of(robots)
        law = LeadThrough(settings(2e3, 0.01, tool_force=tool_force, normal_hz=2.0, correction_range=np.radians(10)))
        surface = CompliantSurface(arm.pose.position - [0, 0, 0.005], UP, 2e3, friction=0.05, wave=0.001)
        path = np.array([[0, 0, 0], [0, 0, -0.006], [0, 0, -0.006], [0.08, 0, -0.006]])
        hand = Hand([0, 1.0, 1.5, 4.0], path, wander=0.0015)
        run = run_contact(arm, law, surface, hand, 4.0, sensors=ContactSensors(0.05), fine=1, seed=3)
        forces[tool_force] = run.between(1.6, 4.0).tool_force
    assert np.all(np.abs(forces[True] - 2) < 0.5)
    assert np.ptp(forces[False]) > 4 * np.ptp(forces[True])
    assert forces[False].max() > 4


def test_a_metal_plate_shakes_a_gain_made_for_cardboard_and_the_watch_calms_it(robots):
    """A gain above the plate's limit ends in a limit cycle; the stiffness found at the touch ends it."""
    calm = {}
    for watch in (False, True):
        arm = arm_of(robots, servo_hz=69.0)
        law = LeadThrough(settings(2e3, 0.015, watch=watch, loop=ForceLoop(servo_hz=69.0)))
        surface = CompliantSurface(arm.pose.position - [0, 0, 0.002], UP, 50e3)
        hand = Hand([0, 0.5], np.array([[0, 0, 0], [0, 0, -0.003]]))
        calm[watch] = np.std(run_contact(arm, law, surface, hand, 2.5, fine=1).between(1.5, 2.5).tool_force)
    assert calm[False] > 1.0
    assert calm[True] < 0.05


def test_a_peg_finds_a_misaligned_hole_within_the_force_limit(robots):
    """1 mm of clearance, the hole 4 degrees off: the peg turns, reaches the bottom, and never feels 8 N."""
    arm = arm_of(robots)
    axis = np.array([np.sin(np.radians(4)), 0, np.cos(np.radians(4))])
    hole = Hole(arm.pose.position - [0.0003, 0.0002, 0.1], axis, depth=0.02, side_stiffness=3e3)
    peg = {"task": "peg", "press": 0.0, "turning_stiffness": 50.0, "force_limit": 8.0, "speed_limit": 0.02}
    contact = {"contact_on": 0.4, "torque_on": 0.015, "contact_wait": 0.02, "locked_axis": UP}
    gain = np.array([0.01, 0.01, 0.01, 3.0, 3.0, 3.0])
    law = LeadThrough(settings(20e3, gain, loop=ForceLoop(filter_hz=15.0), **peg, **contact))
    points = np.array([[0, 0, 0], [-0.0003, -0.0002, -0.004], [-0.0003, -0.0002, -0.035]])
    run = run_contact(arm, law, hole, Hand([0, 1, 8], points), 9.0, sensors=ContactSensors(0.03, 0.002), fine=1)
    assert hole.inserted(run.position[-1], run.rotation[-1]) > 0.019
    assert run.tool_force.max() < 8
    assert hole.tilt(run.rotation[-1]) < hole.tilt(run.rotation[0]) - np.radians(0.3)


def test_friction_takes_energy_and_stays_under_its_bound(rng):
    """Coulomb's law behind a bristle: |f_t| <= mu f_n, and a closed rub along the surface costs work."""
    surface = CompliantSurface(np.zeros(3), UP, 2e3, friction=0.3)
    work, place, dt = 0.0, np.array([0, 0, -0.001]), 1e-3
    for k in range(2000):
        speed = np.array([0.05 * np.cos(2 * np.pi * k / 1000), 0, 0])
        place = place + dt * speed
        force = surface.wrench(place, np.eye(3), np.r_[speed, np.zeros(3)], dt)
        assert np.hypot(force[0], force[1]) <= 0.3 * force[2] * (1 + 1e-9)
        work += force[:3] @ speed * dt
    assert work < -0.3 * 2.0 * 4 * 0.05 / np.pi * 0.9  # -mu f_n times the way, 2 turns of 2 x 0.05 / pi


def test_a_work_never_pulls_and_its_force_is_that_of_a_spring_on_the_true_normal():
    """Out of contact there is no force, and on a wave the force follows the slope."""
    surface = CompliantSurface(np.zeros(3), UP, 1e4, damping=50.0, wave=0.002, wavelength=0.1)
    still, away = np.zeros(6), np.array([0, 0, 10.0, 0, 0, 0])
    assert not surface.wrench(np.array([0, 0, 1e-6]), np.eye(3), still, 0.0).any()
    assert not surface.wrench(np.array([0, 0, -1e-4]), np.eye(3), away, 0.0).any()
    force = surface.wrench(np.array([0, 0, -1e-4]), np.eye(3), still, 0.0)[:3]
    slope = 0.002 * 2 * np.pi / 0.1
    assert np.linalg.norm(force) == pytest.approx(1.0 / np.hypot(1, slope))
    assert -force[0] / force[2] == pytest.approx(slope)


def test_a_wrong_setup_is_refused(robots):
    """Another sample time, a singular start, joints' ends, a mechanism without six joints, and impossible contacts."""
    arm = arm_of(robots)
    surface = CompliantSurface(arm.pose.position - UP, UP, 1e3)
    with raises_code("mismatch", "4", "2"):
        run_contact(arm, LeadThrough(settings(1e3, 0.001)), surface, IDLE, 0.1, dt=0.002)
    with raises_code("unreachable", "singularity"):
        ServoArm(robots("irb140"), np.zeros(6)).command(np.ones(6) * 0.01)
    with raises_code("unreachable"):
        runaway = arm_of(robots)
        for _ in range(2000):
            runaway.command(np.array([0, 0, 0, 0, 0, 0.5]))
            runaway.advance(0.02)
    with raises_code("invalid_value"):
        CompliantSurface(np.zeros(3), UP, -1.0)
    with raises_code("wrong_shape"):
        Hand([0, 0], np.zeros((2, 3)))


def test_two_runs_with_one_seed_are_one_run(robots):
    """Noise and stray come from the seed alone, and the sensors' places change nothing that the law can know."""
    sensor = ForceSensor(position=np.array([0, 0, -0.1]), mass=1.0, centre=np.array([0, 0, 0.05]))
    out = []
    for placed in (None, None, sensor):
        arm = arm_of(robots)
        given = {} if placed is None else {"tool_sensor": placed}
        law = LeadThrough(settings(2e3, 0.005, **given))
        surface = CompliantSurface(arm.pose.position - [0, 0, 0.001], UP, 2e3)
        hand = Hand([0, 0.3], np.array([[0, 0, 0], [0, 0, -0.003]]), wander=0.001)
        sensors = ContactSensors(tool=None if placed is None else placed.reading)
        out.append(run_contact(arm, law, surface, hand, 0.6, sensors=sensors, fine=1, seed=5).tool_force)
    assert np.array_equal(out[0], out[1])
    assert np.allclose(out[0], out[2], atol=1e-9)
