"""Impedance, projections, normal, contact state, stiffness and sensors of lead-through, one by one."""

import numpy as np
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.control.lead_through import ForceSensor
from tau_dyn.control.lead_through.lead_through import HandleImpedance, compute_tool_part, handle_part, limit_twist
from tau_dyn.control.lead_through.sensing import ContactState, NormalEstimator, StiffnessWatch

T = 0.004
UP = np.array([0.0, 0.0, 1.0])


def handle(mass=3.0, damping=40.0):
    return HandleImpedance(mass * np.eye(6), damping * np.eye(6), T)


def test_the_handle_is_a_mass_and_a_damper():
    """Under a constant force the velocity rises as (F / D) (1 - exp(-D t / M)), at 4 ms within a few percent of F / D."""
    part, v, n = handle(), np.zeros(6), 60
    for _ in range(n):
        v = part.step(np.array([8.0, 0, 0, 0, 0, 0]), v)
        part.hold(v)
    assert v[0] == pytest.approx(8 / 40 * (1 - np.exp(-40 * n * T / 3)), rel=0.02)
    assert not v[1:].any()


@pytest.mark.parametrize("ratio", [0.02, 0.5, 0.99])
def test_no_motion_of_the_hand_draws_energy_from_the_handle(ratio, rng):
    """Passivity: the work sum F(k) V(k + 1) T from rest is never below zero, whatever the force."""
    for k in range(20):
        part, v, work, least = handle(3.0, ratio * 3.0 / T), np.zeros(6), 0.0, 0.0
        force = rng.standard_normal(400) if k % 2 else np.sin(rng.uniform(0.01, np.pi) * np.arange(400) + k)
        for f in force:
            v = part.step(np.r_[f, np.zeros(5)], v)
            part.hold(v)
            work += f * v[0] * T
            least = min(least, work)
        assert least >= -1e-15


def test_the_sample_more_of_the_printed_index_would_not_be_passive():
    """With V a sample later, as (8.5) is printed, a fast motion of the hand draws energy: the index matters."""
    part, v, work = handle(), np.zeros(6), 0.0
    for k in range(400):
        f = np.sin(2.0 * k)
        work += f * v[0] * T  # what was applied before this force was known
        v = part.step(np.r_[f, np.zeros(5)], v)
        part.hold(v)
    assert work < 0


def test_what_a_limit_takes_away_is_not_stored():
    """Anti-windup (8.7): after 4 s of pushing against a velocity limit the handle turns back as fast as after 0.4 s."""

    def back(seconds):
        part, v = handle(), np.zeros(6)
        for k in range(round(seconds / T) + 200):
            push = 100.0 if k < seconds / T else -100.0
            v = part.step(np.r_[push, np.zeros(5)], v)
            v = v * limit_twist(v, 0.1, 1.0)
            part.hold(v)
            if k >= seconds / T and v[0] < 0:
                return k - round(seconds / T)
        return None

    assert back(4.0) == back(0.4) <= 1


def test_a_projected_direction_is_worth_one_sample_when_contact_ends():
    """(8.7) multiplied out: a push of 10 N into the surface for 2 s leaves T F / M of velocity, not the integral."""
    part, v = handle(), np.zeros(6)
    for _ in range(500):
        wish = part.step(np.array([0, 0, -10.0, 0, 0, 0]), v)
        v = handle_part(wish, UP, True)
        part.hold(v)
    free = handle_part(part.step(np.array([0, 0, -10.0, 0, 0, 0]), v), UP, False)
    assert free[2] == pytest.approx(-10 / 3 * T)


def test_the_projections_share_the_space_without_overlap_or_gap(rng):
    """P_h removes exactly the normal part, P_t keeps exactly that: together the linear velocity is whole, and no longer."""
    for _ in range(20):
        n = rng.standard_normal(3)
        n, twist = n / np.linalg.norm(n), rng.standard_normal(6)
        by_hand, by_force = handle_part(twist, n, True), compute_tool_part(twist, n, True, False)
        assert abs(n @ by_hand[:3]) < 1e-15
        assert np.allclose(np.cross(n, by_force[:3]), 0, atol=1e-15)
        assert np.allclose(by_hand[:3] + by_force[:3], twist[:3])
        assert not by_hand[3:].any() and not by_force[3:].any()
        assert np.allclose(handle_part(by_hand, n, True), by_hand)
        assert np.linalg.norm(by_hand) <= np.linalg.norm(twist)


def test_without_contact_the_hand_has_all_directions_and_the_tool_force_none(rng):
    """(8.8), (8.9), free space."""
    twist = rng.standard_normal(6)
    assert np.array_equal(handle_part(twist, UP, False), np.r_[twist[:3], np.zeros(3)])
    assert not compute_tool_part(twist, UP, False, True).any()


def test_torques_turn_a_peg_but_not_about_a_locked_axis(rng):
    """(8.11); the peg's own axis, which the hole does not determine, can be locked."""
    twist = rng.standard_normal(6)
    assert np.array_equal(compute_tool_part(twist, UP, True, True)[3:], twist[3:])
    locked = compute_tool_part(twist, UP, True, True, UP)[3:]
    assert locked[2] == 0 and np.array_equal(locked[:2], twist[3:5])


def test_the_printed_normal_is_the_forces_direction_within_its_range():
    """(8.10): 5 degrees off is followed, 15 degrees off falls back to the nominal normal, and so does no force at all."""
    part = NormalEstimator(UP, np.radians(10), 1.0, False, 0.5)
    near, far = (Rotation.from_euler("y", a, degrees=True).apply(UP) for a in (5, 15))
    assert np.allclose(part.update(2 * near, np.zeros(3)), near)
    assert np.array_equal(part.update(2 * far, np.zeros(3)), UP)
    assert np.array_equal(part.update(np.zeros(3), np.zeros(3)), UP)


def test_the_calm_normal_sees_through_friction_and_stops_at_its_range():
    """Friction lies along the command, so it is taken out; a force beyond the range leaves the normal at the edge."""
    part = NormalEstimator(UP, np.radians(10), 0.05, True, 0.5)
    for _ in range(300):
        part.update(np.array([-0.3, 0, 2.0]), np.array([0.05, 0, 0]))
    assert np.degrees(np.arccos(part.normal[2])) < 0.01
    for _ in range(300):
        part.update(np.array([0, 2.0, 2.0]), np.array([0.05, 0, 0]))
    assert np.degrees(np.arccos(part.normal[2])) == pytest.approx(10)


def test_contact_does_not_flicker_and_a_released_tool_stays_free():
    """Two thresholds and a wait; a pull ends contact until the tool is clear."""
    part = ContactState(1.0, 0.4, 6.0, 5)
    assert not part.update(0.9, 0)
    assert part.update(1.1, 0)
    assert all(part.update(load, 0) for load in (0.5, 0.1, 0.1, 0.9, 0.1, 0.1, 0.1, 0.1))
    assert not part.update(0.1, 0)
    assert part.update(1.5, 0) and not part.update(1.5, 7.0)
    assert not part.update(1.5, 0)  # still pressed, but let go
    for _ in range(5):
        part.update(0.0, 0)
    assert part.update(1.5, 0)


@pytest.mark.parametrize("stiffness", [2e3, 50e3])
def test_a_touch_tells_its_stiffness_and_noise_does_not(stiffness, rng):
    """Force by way, within 15 % under 0.05 N of noise; noise on a resting tool tells nothing."""
    part = StiffnessWatch(0.5, T)
    for k in range(30):
        into = min(k, 15) * 2.0 / 15 / stiffness * 3
        part.update(stiffness * into + 0.05 * rng.standard_normal(), into)
    assert part.stiffness == pytest.approx(stiffness, rel=0.15)
    idle = StiffnessWatch(0.5, T)
    for _ in range(500):
        idle.update(2 + 0.05 * rng.standard_normal(), 1e-6 * rng.standard_normal())
    assert idle.stiffness == 0


def test_a_sensors_reading_is_brought_to_the_tool_point_without_its_weight(rng):
    """Lever, axes, weight and offset go in and out again; a heavy tool held still carries no force."""
    sensor = ForceSensor(
        position=np.array([0.1, 0, -0.2]),
        rotation=Rotation.random(random_state=1).as_matrix(),
        mass=1.5,
        centre=np.array([0, 0.05, 0.1]),
        offset=rng.standard_normal(6),
    )
    turn, wrench = Rotation.random(random_state=2).as_matrix(), rng.standard_normal(6)
    assert np.allclose(sensor.at_tool(sensor.reading(wrench, turn), turn), wrench)
    bare = ForceSensor(position=np.array([0, 0, -0.2]))
    shown = bare.at_tool(np.array([0, 1.0, 0, 0, 0, 0]), np.eye(3))
    assert np.allclose(shown, [0, 1, 0, 0.2, 0, 0])  # the sensor is 0.2 m behind: torque r x f about the tool point
    with raises_code("mismatch", "rotation"):
        ForceSensor(rotation=2 * np.eye(3))
