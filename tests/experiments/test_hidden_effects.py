"""The logs of `experiments/hidden_effects.py`: what hides in them, how strong it is, and that nothing else hides there."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from hidden_effects_parts.body_forms import Payload
from hidden_effects_parts.drive_forms import Compliance, Delay, TransmissionError
from hidden_effects_parts.forms import Form, Places
from hidden_effects_parts.friction_forms import LoadFriction, PassiveFriction, StribeckPower
from hidden_effects_parts.gantry import load_across, rods_of
from hidden_effects_parts.judge import judgement
from hidden_effects_parts.recording import Recording, Sensing, draw_motion, draw_sensing
from hidden_effects_parts.robots import draw_rig, nominal_robot
from hidden_effects_parts.sets import KNOWN_FORMS, draw_set, hidden_force
from hidden_effects_parts.slip_forms import Lugre, MaxwellSlip
from hidden_effects_parts.strength import Ruler, Whitener, base_columns
from hidden_effects_parts.unknown_forms import UNKNOWN_FORMS

SENSING = Sensing(5e-6, 0.0, 5.0, 0.0, 250.0)


def blank(name: str = "l1", base: str = "asymmetric", kind: str = "fourier", seconds: float = 20.0) -> Recording:
    """Return a run in which nothing hides."""
    rng = np.random.default_rng(5)
    rig = draw_rig(name, base, rng)
    return Recording.of(rig, draw_motion(rig, seconds, rng, kind), 250.0)


@pytest.fixture(scope="module")
def run() -> Recording:
    return blank()


def ruler(run: Recording, sensing: Sensing = SENSING, *, encoder: bool = True) -> Ruler:
    return Ruler.of([run], [base_columns(run)], sensing, 1.0, encoder=encoder)


@pytest.mark.parametrize("name", ["l1", "axis", "arm", "ur5", "tree7"])
@pytest.mark.parametrize("base", ["asymmetric", "symmetric", "plain"])
def test_nothing_hides_in_a_clean_run(name: str, base: str) -> None:
    """The person's model fits the true force without noise exactly, with bodies up to 10 % off, sharp sign and all."""
    run = blank(name, base)
    W, y = base_columns(run), run.tau
    moving = np.all(np.abs(run.v) > 1e-6, axis=1)
    W, y = W[moving].reshape(-1, W.shape[2]), y[moving].ravel()
    residual = y - W @ np.linalg.lstsq(W, y, rcond=1e-12)[0]
    assert np.max(np.abs(residual)) < 1e-8 * np.max(np.abs(y))
    assert ruler(run).strength([run.tau]) < 1e-6


def test_friction_jumps_within_one_sample() -> None:
    """Base friction takes its full size at a millionth of the top speed; a smooth sign would itself be a hidden effect."""
    friction = draw_rig("l1", "asymmetric", np.random.default_rng(1)).friction
    tiny = np.full((1, 3), 1e-6)
    assert_allclose(friction.force(tiny)[0], friction.coulomb_pos, rtol=1e-5)
    assert_allclose(friction.force(-tiny)[0], -friction.coulomb_neg, rtol=1e-5)
    assert_array_equal(friction.force(np.zeros((1, 3))), 0.0)


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_lambda_is_the_noncentrality_of_the_oracles_test(run: Recording, colour: float) -> None:
    """Over noise alone the true shape's statistic has mean one; the effect moves it to one plus lambda."""
    sensing, rng = replace(SENSING, colour=colour), np.random.default_rng(3)
    form = StribeckPower.draw(run.rig, Places.of([run]), rng)
    (j,), measure = form.joints, ruler(run, sensing, encoder=False)
    amplitude = 0.05 * run.rig.friction.coulomb[j]
    force = hidden_force(run, form.act(run, amplitude))
    shape = measure.rows([force])
    lam = measure.strength([force])
    shape = shape / np.linalg.norm(shape)
    noise = [shape @ measure.rows([sensing.force_noise(run.tau.shape, rng)]) for _ in range(400)]
    assert_allclose(np.std(noise), 1.0, atol=4 / np.sqrt(800))
    found = [(shape @ measure.rows([run.tau + force]) + x) ** 2 for x in noise]
    assert_allclose(np.mean(found), 1 + lam, atol=4 * np.sqrt((2 + 4 * lam) / 400))


def test_encoder_noise_counts_as_it_passes_into_forces(run: Recording) -> None:
    """Noise of 20 um, twice differentiated and times the mass matrix, is white after the whitener at every joint."""
    sensing, rng, n = replace(SENSING, encoder=20e-6, force=0.1), np.random.default_rng(4), 5000
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / 250)
    q, v = run.q[:n], np.ones((n, 3))  # at this speed no sample is masked
    whiten = Whitener.of(replace(run, q=q, v=v, tau=run.tau[:n]), sensing)
    inertia = np.sqrt(np.mean(run.rig.inertia(q[:: n // 60]) ** 2, axis=0))
    total = []
    for _ in range(40):
        spectrum = np.fft.rfft(sensing.encoder * rng.standard_normal((n, 3)), axis=0)
        force = np.fft.irfft(-(w[:, None] ** 2) * spectrum @ inertia.T, n, axis=0)
        rows = whiten((force + sensing.force_noise((n, 3), rng))[:, :, None])[:, 0].reshape(2, 3, -1)
        total.append(np.mean(rows**2, axis=(0, 2)))
    assert_allclose(np.mean(total, axis=0), 1.0, rtol=0.1)


def test_lambda_grows_with_the_square_of_the_amplitude_and_with_time() -> None:
    """Twice the force is four times as strong, half as much data half as strong."""
    run = blank()
    form = StribeckPower.draw(run.rig, Places.of([run]), np.random.default_rng(3))
    one, two = (ruler(run).strength([hidden_force(run, form.act(run, A))]) for A in (1.0, 2.0))
    assert_allclose(two, 4 * one, rtol=1e-6)


@pytest.mark.parametrize("kind", KNOWN_FORMS + UNKNOWN_FORMS, ids=lambda kind: kind.__name__)
def test_every_form_is_as_strong_as_asked_and_stays_hidden(kind: type[Form]) -> None:
    """Lambda is what was drawn (where a refit leaves anything), the amplitude is below the form's cap, forces are finite."""
    found = draw_set(
        "unknown" if kind in UNKNOWN_FORMS else "single", 3, forms=[kind], seconds=64.0, strength=(100, 101)
    )
    (hidden,) = found.hidden
    assert 0 < hidden.amplitude <= hidden.form.cap
    if kind.refit:
        assert_allclose(hidden.strength, 100.5, rtol=0.03)
    else:
        assert hidden.strength < 1e-3
    assert all(np.isfinite(run.tau).all() for run in found.runs)
    assert all(log.has("q", found.rig.joints) and log.has("tau", found.rig.joints) for log in found.logs)


def test_a_set_is_settled_by_its_number() -> None:
    """The same number gives the same log; another one gives another."""
    one, same, other = (draw_set("clean", n, seconds=64.0).logs[0].to_frame().to_numpy() for n in (1, 1, 2))
    assert_array_equal(one, same)
    assert one.shape != other.shape or np.any(one != other)


def test_a_model_identified_before_has_the_true_bodies_and_rotors() -> None:
    """It predicts the forces without noise of another log; the robot file, without rotors and friction, does not."""
    one = draw_set("clean", 13, seed=310, seconds=64.0, robots="wide")
    assert one.known is not None and one.model is one.known
    run = one.runs[0]
    misses = {}
    for name, model in (("model", one.known), ("file", one.rig.model)):
        tau = model.torque(run.q, run.v, run.a)
        misses[name] = np.linalg.norm(tau - run.tau) / np.linalg.norm(run.tau)
    assert misses["model"] < 0.02 and misses["file"] > 0.1


def test_trees_are_settled_by_their_number_and_name_no_rotor() -> None:
    """The same number gives the same masses and axes, another one others; the true rotors are not in the file."""
    rigs = []
    for name in ("tree7", "tree7", "tree8"):
        nominal_robot.cache_clear()  # so that the file is written again
        rigs.append(draw_rig(name, "asymmetric", np.random.default_rng(2)))
    rig, same, other = rigs
    true, again = ([p.value for p in x.robot.parameters] for x in (rig, same))
    assert_array_equal(true, again)
    assert true != [p.value for p in other.robot.parameters]
    nominal = {p.name: p.value for p in rig.nominal.parameters}
    assert all(nominal.get(f"{j}.armature", 0.0) == 0.0 for j in rig.joints)
    assert all(rig.robot.parameters[f"{j}.armature"].value >= 0.05 for j in rig.joints)


def test_a_body_that_differs_from_a_true_model_is_a_false_parameter() -> None:
    """Findings refer to the person's model: bodies 10 % off the robot file are no excuse where the model was identified."""
    one = draw_set("clean", 1, seconds=64.0)
    found = SimpleNamespace(
        findings=[SimpleNamespace(status="parameter", cause="link_mass", joints=())], unexplained=[]
    )
    file_off = replace(one, nominal=False)
    assert not judgement(file_off, found)["false_parameter"]
    assert judgement(replace(one, nominal=True), found)["false_parameter"]
    assert judgement(replace(file_off, known=one.rig.model), found)["false_parameter"]


def test_rod_forces_hold_the_plate(run: Recording) -> None:
    """A cart's drive holds the rod's force along its guideway, up to the rods' own inertia."""
    rods, robot = rods_of(run), run.rig
    masses = {p.name: p.value for p in robot.robot.parameters}
    light = robot.mechanism.robot.with_parameters(
        robot.robot.parameters.with_values({f"{arm.rod_link}.mass": 1e-6 for arm in robot.robot.arms})
    )
    assert rods.d.shape == (len(run.t), 3, 3) and masses
    assert_allclose(np.linalg.norm(rods.d, axis=2), np.broadcast_to(rods.length, (len(run.t), 3)), rtol=1e-9)
    plain = replace(run, rig=replace(robot, robot=light))
    across = load_across(plain)
    weight = masses["plate_link.mass"] * 9.81
    assert np.all(across.max(axis=0) < 20 * weight) and across.max() > 0.3 * weight


def test_passive_friction_takes_the_power_of_turning_rods(run: Recording) -> None:
    """Force times cart speed is the moment times the turning speed of the rods' ends, summed (virtual work)."""
    form = PassiveFriction((0, 1, 2), {"arm": 3.0, "viscous": 0.0}, 1.0)
    rods = rods_of(run)
    power = np.sum(form.unit(run) * run.v, axis=1)
    turning = np.linalg.norm(rods.u, axis=2) / rods.length
    assert_allclose(power, 2 * turning.sum(axis=1), rtol=1e-9, atol=1e-12)


def test_bristles_slip_into_the_stribeck_curve() -> None:
    """Where a joint has moved on, LuGre's force is Coulomb friction plus the peak with power two."""
    run = blank(kind="strokes")
    form = Lugre((0,), {"speed": 0.1, "bend": 1e-7}, 1e9)
    hidden = hidden_force(run, form.act(run, 20.0))[:, 0]
    v = run.v[:, 0]
    sure = np.abs(v) > 0.02
    assert_allclose(hidden[sure], (20.0 * np.sign(v) * np.exp(-((v / 0.1) ** 2)))[sure], atol=0.3)


def test_springs_that_slip_reach_coulomb_friction_after_their_way() -> None:
    """Just after a reversal force still pushes the old way; two ways' length on, nothing of it is left."""
    run = blank(kind="strokes")
    form = MaxwellSlip((0,), {"way": 2e-3}, 1e9)
    force, v = form.unit(run)[:, 0], run.v[:, 0]
    fast = np.abs(v) > 0.5 * np.max(np.abs(v))
    assert_allclose(force[fast], 0.0, atol=1e-9)
    assert np.max(-force * np.sign(v)) > 1.5


def test_a_delay_shows_forces_of_the_past(run: Recording) -> None:
    """Two log samples of delay are the forces two samples ago."""
    late = Delay((0, 1, 2), {}, 1.0).act(run, 2 / 250)
    assert_allclose(late.tau[10:], run.tau[8:-2], atol=0.05)


def test_a_transmission_error_leaves_the_force_and_moves_the_encoder(run: Recording) -> None:
    """Shown speeds and accelerations are the derivatives of shown positions."""
    form = TransmissionError((1,), {"period": 0.1, "second": 0.2, "phase": 1.0}, 1.0)
    shown = form.act(run, 1e-3)
    assert_array_equal(shown.tau, run.tau)
    assert_allclose(np.gradient(shown.q[:, 1], run.t)[5:-5], shown.v[5:-5, 1], atol=0.02)
    assert_allclose(np.gradient(shown.v[:, 1], run.t)[5:-5], shown.a[5:-5, 1], atol=0.4)


def test_a_spring_swings_at_its_frequency() -> None:
    """A load behind a spring doubles nothing far below its resonance: the force is `-m w^-2 a''` there."""
    run = blank("axis")
    form = Compliance((0,), {"inertia": 50.0, "damping": 0.05}, 1.0)
    soft = 1 / (50.0 * (2 * np.pi * 30.0) ** 2)
    hidden = hidden_force(run, form.act(run, soft))[:, 0]
    snap = np.gradient(np.gradient(run.a[:, 0], run.t), run.t)
    inner = slice(500, -500)  # what the motion's ends excite has died down by then
    wanted = -50.0 / (2 * np.pi * 30.0) ** 2 * snap[inner]
    assert np.std(hidden[inner] - wanted) < 0.2 * np.std(wanted)


def test_payload_is_absorbed_by_the_refit(run: Recording) -> None:
    """Two kilograms more on the plate leave nothing once the plate's mass is free."""
    form = Payload.draw(run.rig, Places.of([run]), np.random.default_rng(0))
    assert ruler(run).strength([hidden_force(run, form.act(run, 2.0))]) < 1e-6


def test_load_friction_follows_the_speeds_sign(run: Recording) -> None:
    """It takes power, whichever way the cart moves."""
    form = LoadFriction((2,), {}, 0.5)
    force = form.unit(run)
    assert np.all(force[:, 2] * run.v[:, 2] >= 0) and not force[:, :2].any()


def test_sensors_are_as_noisy_as_they_say() -> None:
    """Noise has its standard deviation, white or coloured, and rounding lands on the encoder's grid."""
    rng = np.random.default_rng(8)
    for colour in (0.0, 0.9):
        noise = Sensing(0, 0, 5.0, colour, 250.0).force_noise((20000, 2), rng)
        assert_allclose(np.std(noise, axis=0), 5.0, rtol=0.08)
        assert_allclose(np.mean(noise[1:] * noise[:-1]), 25 * colour, atol=1.5)
    read = Sensing(1e-6, 1e-5, 5.0, 0.0, 250.0).positions(np.linspace(0, 1, 1000)[:, None], rng)
    assert_allclose(read / 1e-5, np.round(read / 1e-5), atol=1e-6)
    rig = draw_rig("l1", "asymmetric", rng)
    assert_allclose([draw_sensing(rig, rng, coarse=True).position_sd for _ in range(8)], 2e-5, rtol=0.02)
