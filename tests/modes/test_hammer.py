"""A hammer's force is zero out of contact and noisy in it; accelerometers name themselves; masses follow from either hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim

from tau_dyn.log import Log
from tau_dyn.modes import StateSpace, find_modes, order as order_choice
from tau_dyn.modes.contact import (
    compute_noise_responses,
    find_contact,
    find_least_force,
    remove_input_noise,
    window_forces,
)
from tau_dyn.modes.mechanical import SecondOrder, fit_mechanical
from tau_dyn.modes.modal import find_resonances
from tau_dyn.modes.order import OrderTrial
from tau_dyn.modes.record import Record, prepare_records, split_pulses
from tau_dyn.modes.refinement import refine
from tau_dyn.modes.sensors import STANDARD_GRAVITY, find_sensor_kind
from tau_dyn.render import present

RATE = 1000.0
M, K = np.diag([6.0, 3.0]), np.array([[9e5, -3e5], [-3e5, 4e5]])
D = 2e-4 * K + 2.0 * M
INPUTS, OUTPUTS = ["f1", "f2"], ["acc1_g", "acc2_g"]


def sampled(method: str) -> StateSpace:
    """The structure from forces to accelerations, sampled by SciPy for a force that is held (zoh) or linear (foh)."""
    A = SecondOrder(M, D, K).system_matrix()
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    a, b, c, d, _ = cont2discrete((A, B, A[2:], B[2:]), 1 / RATE, method=method)
    return StateSpace(a, b, c, d, np.zeros((4, 2)), 1 / RATE)


def blows(seed: int, *, method: str = "foh", noise: float = 0.5, hits: int = 4) -> Log:
    """A session of blows at two places, with noise of the force's channel and accelerations in g."""
    rng, each = np.random.default_rng(seed), 900
    force = np.zeros((2 * hits * each, 2))
    for k in range(2 * hits):
        start = k * each + 60 + int(rng.integers(5))
        force[start : start + 7, k // hits] = 150 * rng.uniform(0.8, 1.2) * np.sin(np.pi * np.arange(7) / 6)
    model = sampled(method)
    y = dlsim((model.A, model.B, model.C, model.D, model.dt), force)[1] / STANDARD_GRAVITY
    y = y + 1e-3 * np.abs(y).max() * rng.standard_normal(y.shape)
    force = force + noise * rng.standard_normal(force.shape)
    names = dict(zip([*INPUTS, *OUTPUTS], np.hstack([force, y]).T, strict=True))
    return Log(np.arange(len(force)) / RATE, names, name="hammer")


@pytest.fixture(scope="module")
def found():
    return find_modes(blows(1), INPUTS, OUTPUTS)


def test_noise_out_of_contact_adds_no_modes(found):
    """Two masses are two modes, whatever the noise of the force's channel between the blows."""
    assert found.order == 4
    truth = SecondOrder(M, D, K).poles()
    for mode, pole in zip(found.modes, truth[truth.imag > 0], strict=True):
        assert abs(mode.frequency_hz - abs(pole) / (2 * np.pi)) < 3 * mode.frequency_stderr
    assert "out of contact" in found.why["forces"]


def test_accelerations_in_g_give_masses_in_kilograms(found):
    """Columns named acc1_g and acc2_g are taken for accelerations in g, and the force for linear between samples."""
    m = found.mechanical
    assert (m.status, m.hold, m.sensor) == ("identified", "linear", "acceleration")
    np.testing.assert_allclose(m.M, M, atol=4 * m.stderr.M.max())
    np.testing.assert_allclose(np.diag(m.M), np.diag(M), rtol=0.01)
    assert m.to_dict()["sensor_unit"] == STANDARD_GRAVITY


def test_a_sensor_that_drifts_adds_no_modes():
    """A charge amplifier's offset and drift are no motion: the modes are those without them, and the sensor is named."""
    log = blows(1)
    drift = 0.3 + 0.02 * log.t
    drifting = Log(log.t, {**log.channels, "acc1_g": log.channels["acc1_g"] + drift}, name="hammer")
    records = [prepare_records([x], INPUTS, OUTPUTS) for x in (log, drifting)]
    assert ["acc1_g drifts" in w for r in records for w in r.warnings if "drifts" in w] == [True]
    clean, mended = (np.concatenate([r.y for r in x.whole]) for x in records)
    noise = 1e-3 * np.abs(log.channels["acc1_g"]).max()
    assert np.sqrt(np.mean((clean - mended)[:, 0] ** 2)) < 0.5 * noise < 0.1 * np.ptp(drift) / 8
    assert np.array_equal(clean[:, 1], mended[:, 1])


def test_an_accelerometer_that_holds_only_noise_is_named():
    """A cable that is off leaves noise, which no force explains; the other sensor's modes and verdict stay."""
    log = blows(1)
    noise = 0.01 * np.random.default_rng(2).standard_normal(len(log.t))
    dead = Log(log.t, {**log.channels, "acc2_g": noise}, name="hammer")
    found = find_modes(dead, INPUTS, OUTPUTS, order=4, delay=0)
    assert found.silent_outputs == ("acc2_g",)
    assert [w.code for w in found.warnings if "acc2_g" in w] == ["faulty_channel"]
    verdict = present(found).verdict
    assert verdict is not None and "Disturbances" not in verdict.sentence
    assert find_modes(log, INPUTS, OUTPUTS, order=4, delay=0).silent_outputs == ()


def fit_masses(seed: int, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Both masses and their standard errors, from the true model on."""
    data = window_forces(prepare_records([blows(seed, noise=noise)], INPUTS, OUTPUTS))[0]
    model = sampled("foh")
    fitted = refine(replace(model, C=model.C / STANDARD_GRAVITY, D=model.D / STANDARD_GRAVITY), data.whole)
    found = fit_mechanical(fitted, output="acceleration").in_units_of(STANDARD_GRAVITY)
    assert found.M is not None and found.stderr is not None
    return np.diag(found.M), np.diag(found.stderr.M)


def test_standard_errors_include_the_noise_of_the_force():
    """With noise of 1 % of the force the masses scatter by it, and their standard errors are that scatter."""
    found = [fit_masses(seed, 1.5) for seed in range(8)]
    ratio = np.sqrt(np.mean([np.square((mass - np.diag(M)) / stderr) for mass, stderr in found]))
    assert 0.5 < ratio < 1.6  # the two masses err together, so these are about eight numbers
    assert found[0][1][1] > 3 * fit_masses(0, 0.0)[1][1]


@pytest.mark.parametrize(("method", "hold"), [("zoh", "held"), ("foh", "linear")])
def test_either_hold_gives_back_the_structure(method, hold):
    """A force that is held, or linear, between samples gives the same sampled model of two structures; the right one fits."""
    found = fit_mechanical(sampled(method), output="acceleration")
    assert found.hold == hold
    np.testing.assert_allclose(found.M, M, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.K, K, rtol=1e-6, atol=1e-2)


def test_a_force_that_never_rests_is_not_windowed():
    """Where a shaker goes on pushing between its pulses, its record is a force, and simulation is worse without it."""
    log = blows(2, noise=0.0)
    rng = np.random.default_rng(3)
    force = np.column_stack([log.channels[name] for name in INPUTS]) + 0.5 * rng.standard_normal((log.n_samples, 2))
    model = sampled("foh")
    y = dlsim((model.A, model.B, model.C, model.D, model.dt), force)[1]
    record = prepare_records(
        [Log(log.t, dict(zip([*INPUTS, *OUTPUTS], np.hstack([force, y]).T, strict=True)), name="s")], INPUTS, OUTPUTS
    )
    assert record.kind == "impulse"
    assert window_forces(record) == (record, "")


def test_a_record_that_a_shaker_drives_keeps_its_force():
    """Held-out records may be driven; only blows are windowed."""
    data = prepare_records([blows(1)], INPUTS, OUTPUTS)
    driven = np.random.default_rng(0).standard_normal((800, 2)) * 50
    shaken = replace(data.holdout[0], u=driven, y=np.zeros((800, 2)))
    windowed, why = window_forces(replace(data, holdout=(shaken,)))
    assert why
    np.testing.assert_array_equal(windowed.holdout[0].u, driven)


def test_contact_holds_each_blow_with_its_flanks():
    """A half sine of 30 samples, and a second hit after it, are contact; noise is none."""
    rng = np.random.default_rng(0)
    u = 0.01 * rng.standard_normal((400, 1))
    for start, size in ((100, 1.0), (160, 0.3)):
        u[start : start + 31, 0] += size * np.sin(np.pi * np.arange(31) / 30)
    touching = find_contact(u, find_least_force(u))[:, 0]
    assert touching[100:131].all() and touching[160:191].all()
    assert touching.sum() < 100


def test_what_noise_of_the_force_explains_leaves_the_errors():
    """Errors made of noise in contact and white noise are white noise again without what the force explains."""
    model, rng = sampled("foh"), np.random.default_rng(4)
    u = np.zeros((600, 2))
    u[30:37, 0] = 100.0
    record = Record(u, np.zeros((600, 2)), model.dt, ("f1", "f2"), ("a", "b"), input_noise=np.array([0.5, 0.5]))
    g = compute_noise_responses(record, model.markov(600))
    white = 1e-3 * rng.standard_normal((600, 2))
    errors = white + g @ rng.standard_normal(g.shape[2])
    left = remove_input_noise([errors], [record], model.markov(600))[0]
    assert np.std(left) < 1.1 * np.std(white) < 0.5 * np.std(errors)
    no_noise = replace(record, input_noise=None)
    np.testing.assert_array_equal(remove_input_noise([errors], [no_noise], model.markov(600))[0], errors)


def test_pulses_are_kept_apart_at_each_place():
    """Of four blows at one place and then four at another, the last one of each is compared on."""
    pulse = np.zeros((200, 2))
    records = []
    for place in (0, 0, 0, 0, 1, 1, 1, 1):
        u = pulse.copy()
        u[20:25, place] = 10.0
        records.append(Record(u, np.zeros((200, 1)), 0.01, ("f1", "f2"), ("a",)))
    fitted, kept = split_pulses(records, 0.25)
    assert [int(np.argmax(r.u.max(axis=0))) for r in kept] == [0, 1]
    assert len(fitted) == 6
    assert split_pulses(records[3:5], 0.25)[1] == []  # one blow at each place cannot be spared


def test_a_filter_of_sensors_is_no_resonance():
    """A pair of poles with the damping of a Butterworth filter has no peak."""
    pole = np.exp(0.01 * 2 * np.pi * 10 * (-0.7072 + 0.7071j))
    block = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    model = StateSpace(block, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), np.zeros((2, 1)), 0.01)
    assert find_resonances(model) == ()
    pole = np.exp(0.01 * 2 * np.pi * 10 * (-0.3 + 0.954j))
    light = replace(model, A=np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
    assert len(find_resonances(light)) == 1


@pytest.mark.parametrize(
    ("outputs", "kind", "unit"),
    [
        (["acc1_g", "acc2_g"], "acceleration", STANDARD_GRAVITY),
        (["ax_tool", "ay_tool"], "acceleration", 1.0),
        (["a1"], "acceleration", 1.0),
        (["x_tool", "y_tool"], "displacement", 1.0),
        (["vel_1"], "velocity", 1.0),
        (["place1"], "auto", 1.0),
        (["x_tool", "ax_tool"], "auto", 1.0),
    ],
)
def test_names_tell_what_sensors_measure(outputs, kind, unit):
    """Names that begin with a word or an axis tell the quantity; others leave it to the fit."""
    found = find_sensor_kind(outputs)
    assert (found.kind, found.unit) == (kind, unit)
    assert find_sensor_kind(outputs, "velocity").kind == "velocity"


def test_without_names_what_fits_tells_the_sensor():
    """Of displacement, velocity and acceleration one alone makes a structure of the sampled model."""
    assert fit_mechanical(sampled("foh"), output="auto").sensor == "acceleration"
    held = SecondOrder(M, D, K).sampled(1 / RATE, [0, 1], [0, 1], "velocity")
    assert fit_mechanical(held, output="auto").sensor == "velocity"
    few = fit_mechanical(SecondOrder(M, D, K).sampled(1 / RATE, [0], [0]), output="auto", collocated=[(0, 0)])
    assert few.sensor == "displacement"


@pytest.mark.parametrize(("white", "behind", "order"), [(True, 3.0, 4), (True, 5.0, 10), (False, 3.0, 10)])
def test_fewer_states_are_enough_where_they_leave_white_noise(white, behind, order):
    """The best of many orders is better by chance: BIC's smaller one is taken if it leaves white noise and is not far behind."""
    model = sampled("foh")
    small = OrderTrial(4, 0.0, 0.0, 10.0, 95.0, behind, True, white, (), model)
    large = replace(small, order=10, bic=20.0, behind=0.0, white=True)
    assert order_choice._chosen((small, large), True).order == order


def test_poles_of_a_sensors_filter_are_no_degree_of_freedom():
    """Where more pairs of poles than places answer, those without a peak are left out of the modes."""
    plain = sampled("foh")
    pole = np.exp(2 * np.pi * 200 / RATE * (-0.8 + 0.6j))
    block = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    gain = 1e-3 * np.ones((2, 2))
    A = np.block([[plain.A, np.zeros((4, 2))], [np.zeros((2, 4)), block]])
    B, C = np.vstack([plain.B, gain]), np.hstack([plain.C, gain])
    why = fit_mechanical(StateSpace(A, B, C, plain.D, np.zeros((6, 2)), plain.dt), output="acceleration").why
    assert "2 of the model's 6 poles are no mode" in why
