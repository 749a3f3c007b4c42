"""A motor behind a spring or a play in front of its link, in a servo's loop: frequencies, momentum, static twist, dead travel."""

from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.servo.loads import InertialSpace, compute_load_waves
from tau_dyn.servo.loop import _simulate_in_numpy, simulate_loops, simulate_motion, solve_spring
from tau_dyn.servo.prediction import simulate_coupled
from tau_dyn.servo.records import build_records, build_waves
from tau_dyn.servo.simulation import read_values
from tau_dyn.servo.waves import Trials, Waves
from tau_dyn.simulate import ServoLaw, build_servo_law

from .arms import build_arm, build_law, build_truth, record

MOTOR, LINK, COMPLIANCE = 0.02, 0.06, 1 / 70


def simulate_pair(step: float, seconds: float, load: np.ndarray, side: str = "link", shown: str = "", **entries):
    """Return positions (N,) of one joint under a load on its link (N,) [N m], told to stay at zero."""
    known = {"position_gain": 1e-9, "force_per_unit": 1.0, "limit": np.inf, "joint_compliance": COMPLIANCE}
    law = ServoLaw.of(("a",), encoder=side, **(known | {k: v for k, v in entries.items() if k != "coulomb"}))
    n = round(seconds / step)
    zero, none, one = np.zeros((n, 1, 1)), np.zeros((n, 1, 0, 1)), np.ones((n, 1))
    load = np.broadcast_to(load, n)[:, None, None]
    waves = Waves(
        np.array([step]), np.zeros((1, 1)), np.zeros((1, 1)), zero, zero, load, none, zero + LINK, none, zero, one, one, {},
        side == "motor", (shown or side) == "motor", 1.0,
    )  # fmt: skip
    joint = {"armature": MOTOR, "coulomb": entries.get("coulomb", 0.0), "viscous": 0.0, "offset": 0.0}
    values = {key: np.array(x, float).reshape(1, 1) for key, x in {**law.values, **joint}.items()}
    return simulate_loops(waves, Trials(values, np.zeros((0, 1))))[:, 0, 0, 0]


@pytest.mark.parametrize("step", [1e-3, 4e-3, 1e-2])
def test_a_free_pair_swings_at_its_eigenvalue(step):
    """The free pair's frequency is sqrt(K (1/B + 1/I)), exactly, also where a step is a tenth of the period."""
    true = np.sqrt((1 / MOTOR + 1 / LINK) / COMPLIANCE)
    n = round(20 / step)
    q = simulate_pair(step, 20, np.where(np.arange(n) == 0, 1.0, 0.0))
    t = np.arange(n) * step
    basis = np.stack([np.sin(true * t), np.cos(true * t), t, np.ones(n)], axis=1)
    left = q - basis @ np.linalg.lstsq(basis, q, rcond=None)[0]
    drift = np.stack([t, np.ones(n)], axis=1)
    swing = q - drift @ np.linalg.lstsq(drift, q, rcond=None)[0]
    assert np.sum(left**2) < 1e-4 * np.sum(swing**2)
    assert np.ptp(swing[-n // 20 :]) > 0.9 * np.ptp(swing[n // 20 : n // 10])  # nothing is lost


def test_a_damped_pair_decays_as_its_eigenvalue():
    """The amplitude falls with exp(-D t / (2 mu)), mu the reduced inertia."""
    mu, damping = MOTOR * LINK / (MOTOR + LINK), 0.03
    step, n = 2e-3, 2000
    q = simulate_pair(step, n * step, np.where(np.arange(n) == 0, 1.0, 0.0), joint_damping=damping)
    t, rate = np.arange(n) * step, damping / (2 * mu)
    turn = np.sqrt(1 / (COMPLIANCE * mu) - rate**2)
    fade = np.exp(-rate * t)
    basis = np.stack([fade * np.sin(turn * t), fade * np.cos(turn * t), t, np.ones(n)], axis=1)[1:]  # the load is gone
    parts = np.linalg.lstsq(basis, q[1:], rcond=None)[0]
    assert np.abs(q[1:] - basis @ parts).max() < 1e-3 * np.abs(parts[:2]).max()


def test_the_closed_loop_rings_at_its_eigenvalue():
    """A servo on the motor with the link behind a spring rings at an eigenvalue of the linear loop."""
    gain, back = 60.0, 0.02
    A = np.array([
        [0, 1, 0, 0], [(-gain - 1 / COMPLIANCE) / MOTOR, -gain * back / MOTOR, 1 / COMPLIANCE / MOTOR, 0],
        [0, 0, 0, 1], [1 / COMPLIANCE / LINK, 0, -1 / COMPLIANCE / LINK, 0],
    ])  # fmt: skip
    poles = np.linalg.eigvals(A)
    slow = poles[np.argmin(np.abs(poles.imag) + 1e3 * (np.abs(poles.imag) < 1))]
    step, n = 5e-4, 6000
    q = simulate_pair(
        step, n * step, np.where(np.arange(n) == 0, 1.0, 0.0), "motor", position_gain=gain, derivative_gain=gain * back
    )
    t = np.arange(n) * step
    basis = np.concatenate([[np.exp(p * t).real, np.exp(p * t).imag] for p in poles if p.imag > 0]).T
    left = q - basis @ np.linalg.lstsq(basis, q, rcond=None)[0]
    assert 2 < abs(slow.imag) / (2 * np.pi) < 10
    assert np.abs(left[20:]).max() < 0.02 * np.ptp(q)


def test_a_load_twists_a_joint_by_its_compliance():
    """At rest the motor stands where the servo holds it, and the link a compliance times the load below."""
    entries = {"position_gain": 200.0, "derivative_gain": 4.0, "joint_damping": 0.1}
    motor, link = (
        simulate_pair(1e-3, 4.0, np.full(4000, -1.0), "motor", shown, **entries) for shown in ("motor", "link")
    )
    assert motor[-1] == pytest.approx(1 / 200, rel=1e-3)
    assert link[-1] == pytest.approx(1 / 200 + COMPLIANCE, rel=1e-3)


def test_weight_twists_a_spring_from_the_first_sample():
    """An arm that stands level at first has its springs twisted by what hangs on them, as if it had stood there."""
    arm, compliance = build_arm(2), np.array([0.02, 0.05])
    truth, law = build_truth(arm), build_law(arm, encoder="motor", joint_compliance=compliance)
    records = build_records(truth, law, [record(arm, truth, law, 3, 0.2, clean=True)])
    level = [replace(r, start=np.zeros(2)) for r in records]
    (moved,) = simulate_coupled(InertialSpace.of(truth), np.zeros(0), read_values(truth, law), law, level, 1e-3)
    weight = 0.15 * 9.81 * np.array([0.07 + 0.12 + 0.07, 0.07])  # of both links, and of the second
    np.testing.assert_allclose(np.abs(moved.q - moved.link)[0], compliance * weight, rtol=0.02)


def test_a_stiff_spring_is_stable_and_as_good_as_none():
    """A resonance far above what a step shows fades, and the joint moves as a rigid one."""
    n, step = 1500, 2e-3
    load = np.sin(2 * np.pi * np.arange(n) * step)
    stiff, rigid = (
        simulate_pair(step, n * step, load, position_gain=20.0, derivative_gain=1.0, joint_compliance=c)
        for c in (1e-7, 0)
    )
    assert np.abs(stiff - rigid).max() < 1e-3 * np.ptp(rigid)


def test_a_motor_within_its_play_does_not_move_the_link():
    """A link that friction does not hold stays until the motor has crossed the play, and then lags it by half of it."""
    n, step, play = 3000, 1e-3, 0.05
    load = np.where(np.arange(n) * step < 1.0, 0.5, -0.5)  # the link changes sides
    q = simulate_pair(step, n * step, load, "link", position_gain=100.0, derivative_gain=4.0, joint_compliance=0.0,
                      backlash=play, coulomb=50.0)  # fmt: skip
    assert q[990] - q[-1] == pytest.approx(-play, abs=2e-3)  # the motor is held, the link falls to its other stop


def test_elastic_teeth_in_a_play_return_at_half_speed():
    """Of the relative speed with which teeth meet, exp(-pi D / sqrt(1 - D^2)) is left after the impact, D = 0.2."""
    step, play = 2e-4, 0.05
    t = np.arange(3000) * step
    kick = np.where((t > 0) & (t < 0.01), 3.0, 0.0)
    motor, link = (simulate_pair(step, 0.6, kick, "link", shown, backlash=play) for shown in ("motor", "link"))
    rate = np.diff(motor - link) / step
    free = np.flatnonzero((np.abs(motor - link)[1:] < 0.4 * play) & (t[1:] > 0.02))
    flights = [rate[part].mean() for part in np.split(free, np.flatnonzero(np.diff(free) > 1) + 1)]
    assert len(flights) >= 3
    ratios = np.array(flights[1:]) / flights[:-1]
    np.testing.assert_allclose(ratios, -np.exp(-np.pi * 0.2 / np.sqrt(1 - 0.2**2)), rtol=0.03)


@pytest.mark.parametrize("stiffness", [60, 300, 1500])
def test_coupled_joints_with_elastic_teeth_converge(stiffness):
    """Three joints with plays and undamped springs move alike by short and by long steps, to less than a 12 bit encoder's step.

    A link is lighter while the other joints give way; springs on its own inertia alone ended in infinite numbers.
    """
    arm = build_arm(3)
    truth, law = build_truth(arm), build_law(arm, encoder="motor", backlash=0.03, joint_compliance=1 / stiffness)
    records = build_records(truth, law, [record(arm, truth, law, 3, 3.0, clean=True)])
    known = InertialSpace.of(truth), np.zeros(0), read_values(truth, law), law, records
    (short,), (long,) = (simulate_coupled(*known, step) for step in (2.5e-4, 2e-3))
    assert short.unsettled is long.unsettled is None
    assert np.sqrt(np.mean((short.q - long.q) ** 2, axis=0)).max() < 2 * np.pi / 4096


def test_a_sampled_spring_keeps_both_poles():
    """The step's two eigenvalues are those of the damped spring over the step."""
    K, D, mu, h = 70.0, 0.05, 0.015, 2e-3
    a, S = solve_spring(*map(np.array, (K, D, mu, h)))
    step = np.array([[a, -K / S], [h / 2 * (1 + a), 1 - h / 2 * K / S]])
    true = np.exp(h * np.roots([mu, D, K]))
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(step)), np.sort_complex(true), rtol=1e-10)


@pytest.mark.parametrize("side", ["link", "motor"])
@pytest.mark.parametrize(
    "entries",
    [
        {},
        {"joint_compliance": np.array([0.02, 0.0]), "joint_damping": 0.01},
        {"joint_compliance": 0.01, "backlash": 0.01, "torque_delay": 0.013},
        {"backlash": 0.02, "torque_delay": np.array([0.0, 0.004]), "integral_gain": 2.0, "derivative_gain": 0.02},
        {"drive_exponent": 0.8, "braking": 0.3, "supply_sag": 0.2, "dead_band": 0.004, "command_step": 0.002},
        {"speed_limit": 3.0, "acceleration_limit": 20.0},
        {"speed_limit": 3.0, "acceleration_limit": np.array([20.0, np.inf]), "steps_pass": 1.0},
        {"acceleration_limit": 20.0, "steps_pass": np.array([0.0, 1.0]), "command_step": 0.002},
        {"position_gain": 9.0, "speed_gain": 0.3, "speed_integral_gain": 2.0, "supply_sag": 0.2},
        {"command": "speed", "speed_gain": np.array([0.3, 0.6]), "speed_integral_gain": 2.0, "speed_limit": 0.5},
        {"command": "pwm", "torque_delay": 0.013},
    ],
)
def test_compiled_and_array_loops_agree(entries, side):
    """Both ways to step the loops give the same positions, trial by trial."""
    arm, rng = build_arm(2), np.random.default_rng(0)
    truth, law = build_truth(arm), build_law(arm, encoder=side, **entries)
    records = build_records(truth, law, [record(arm, truth, law, 3, 6.0)])
    space = InertialSpace.of(truth)
    wide = replace(space, directions=0.3 * rng.standard_normal((len(space.nominal), 3)) * space.prior[:, None])
    loads = [compute_load_waves(wide, *r.motion, r.dt) for r in records]
    waves = build_waves(records, loads, law)
    factors = np.append(1.0, np.linspace(0.9, 1.1, 9))  # more than are stepped in turn
    trials = Trials(
        {key: value[:, None] * factors for key, value in read_values(truth, law).items()},
        rng.standard_normal((3, 10)) * (np.arange(10) > 0),
    )
    trials.values["steps_pass"][:, ::2] *= 0  # trials differ in the goals that they share
    often = int(np.ceil(waves.dt[0] / waves.step))
    np.testing.assert_allclose(simulate_motion(waves, trials), _simulate_in_numpy(waves, trials, often), atol=1e-9)


@pytest.mark.parametrize("compiled", ["1", "0"])
def test_positions_are_those_at_the_stamps_of_chosen_samples(compiled, monkeypatch):
    """Of two logs every third sample was measured, up to 0.4 steps beside the clock: its position is the parabola's there."""
    monkeypatch.setenv("TAU_DYN_COMPILE", compiled)
    arm, rng = build_arm(2), np.random.default_rng(0)
    truth, law = build_truth(arm), build_law(arm)
    records = build_records(truth, law, [record(arm, truth, law, k, 3.0) for k in range(2)])
    loads = [compute_load_waves(InertialSpace.of(truth), *r.motion, r.dt) for r in records]
    waves = build_waves(records, loads, law)
    trials = Trials({key: value[:, None] for key, value in read_values(truth, law).items()}, np.zeros((0, 1)))
    q = simulate_loops(waves, trials)
    shown = np.stack([np.arange(3, 120, 3), np.arange(1, 118, 3)], axis=1)
    apart = rng.uniform(-0.4, 0.4, waves.command[:, 0].shape)
    found = simulate_loops(replace(waves, apart=apart, shown=shown), trials)
    for log, at in enumerate(shown.T):
        early, now, late = (q[at + step, :, 0, log] for step in (-1, 0, 1))
        way = apart[at, log][:, None]
        there = now + way * (late - early) / 2 + way**2 * (late - 2 * now + early) / 2
        np.testing.assert_allclose(found[:, :, 0, log], there, rtol=0, atol=1e-12)


@pytest.mark.parametrize("entries", [{}, {"joint_compliance": np.array([0.02, 0.0, 0.01]), "torque_delay": 0.013}])
def test_compiled_and_array_steps_of_coupled_joints_agree(entries, monkeypatch):
    """All joints of two logs stepped at once, with a spring and a delay or without, move alike in compiled code and in numpy."""
    arm = build_arm(3)
    truth, law = build_truth(arm), build_law(arm, **entries)
    records = build_records(truth, law, [record(arm, truth, law, seed, 0.6 + 0.2 * seed) for seed in range(2)])
    space, values = InertialSpace.of(truth), read_values(truth, law)
    both = []
    for allowed in ("1", "0"):
        monkeypatch.setenv("TAU_DYN_COMPILE", allowed)
        both.append(simulate_coupled(space, np.zeros(0), values, law, records, 1e-2))
    for one, other in zip(*both, strict=True):
        np.testing.assert_allclose(one.q, other.q, atol=1e-7)
        np.testing.assert_allclose(one.v, other.v, atol=1e-5)


@pytest.mark.parametrize("compiled", ["1", "0"])
@pytest.mark.parametrize(
    ("entry", "late"), [("torque_delay", 1e300), ("command_delay", -1e300), ("command_delay", 1e300)]
)
def test_a_delay_beyond_a_log_is_as_long_as_it(entry, late, compiled, monkeypatch):
    """What comes after a log's end is not in it, however much later; no step looks beyond the commands that there are."""
    monkeypatch.setenv("TAU_DYN_COMPILE", compiled)
    one, other = (
        simulate_pair(0.01, 0.5, np.ones(50), joint_compliance=0.0, position_gain=50.0, **{entry: x})
        for x in (late, np.sign(late) * 0.6)
    )
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_a_law_file_says_where_the_encoder_sits():
    """`encoder` names the side that the servo sees, `measured` that of the logs, which is the encoder's unless said."""
    arm = build_arm(1)
    content = {"law": "servo", "position_gain": 1.0, "force_per_unit": 1.0}
    law = build_servo_law(content | {"encoder": "motor"}, arm, "law.yaml")
    assert (law.encoder, law.measured) == ("motor", "motor")
    assert build_servo_law(law.to_dict(), arm, "law.yaml").encoder == "motor"
    assert build_servo_law(content, arm, "law.yaml").encoder == "link"
    with pytest.raises(Exception, match="link or motor"):
        build_servo_law(content | {"measured": "both"}, arm, "law.yaml")
