"""A controller that answers encoder noise with force: the answer is seen above the motion's band, and no cause is found in it."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import csd, welch

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.noise_only_log import NoiseOnlyLog, apply_feedback_taps, estimate_feedback_taps
from tau_dyn.diagnose.preparation import decimate_log
from tau_dyn.effects import CyclicRipple, build_friction_model
from tau_dyn.estimate import BaseParameters
from tau_dyn.evidence.candidate_scan import CandidateCause, GroupTest
from tau_dyn.evidence.claims import MIN_AMPLITUDE_Z
from tau_dyn.evidence.noise_only_bootstrap import compute_artefact_chance, estimate_noncentrality
from tau_dyn.evidence.plausibility import is_distinct_from_zero
from tau_dyn.log import Log, lowpass
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Sensors, build_named_motion, simulate

RATE_HZ = 500.0
JOINTS = ("one", "two")
PD = np.array([np.zeros((2, 2)), [[-7e4, 1e4], [0.0, -5e4]], [[6e4, 0.0], [0.0, 4e4]]])
"""Taps of two joints at lags -1, 0, 1 [N/m]; the second answers the first's noise as well."""


def moved(rng: np.random.Generator, n: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Return slow positions (n, 2) and encoder noise of 5 um."""
    t = np.arange(n) / RATE_HZ
    q = np.column_stack([0.3 * np.sin(2 * np.pi * 0.7 * t), 0.2 * np.sin(2 * np.pi * 1.1 * t)])
    return q, 5e-6 * rng.standard_normal((n, 2))


def logged(q: np.ndarray, tau: np.ndarray, joints: Sequence[str] = JOINTS, rate_hz: float = RATE_HZ) -> Log:
    """Return positions and forces (n, na) as a log."""
    signals = {"q": q, "tau": tau}
    channels = {f"{key}_{j}": x[:, k] for key, x in signals.items() for k, j in enumerate(joints)}
    return Log(np.arange(len(q)) / rate_hz, channels, "loop.csv")


def test_taps_come_back_within_their_noise():
    """From the part above 20 Hz alone, behind 0.5 N of noise: each tap within 5 errors of noise over signal."""
    rng = np.random.default_rng(1)
    q, noise = moved(rng)
    log = logged(q + noise, apply_feedback_taps(PD, noise) + 0.5 * rng.standard_normal(q.shape))
    found = estimate_feedback_taps(log, JOINTS, 20.0)
    assert found.shape == PD.shape
    assert_allclose(found, PD, atol=5 * 0.5 / (5e-6 * np.sqrt(len(q))))


def test_a_controller_that_sees_the_truth_has_no_taps():
    """Forces that do not know the encoder's noise: no lag earns its freedom."""
    rng = np.random.default_rng(2)
    q, noise = moved(rng)
    assert len(estimate_feedback_taps(logged(q + noise, 0.5 * rng.standard_normal(q.shape)), JOINTS, 20.0)) == 0


def test_motion_that_fills_the_band_leaves_its_upper_part():
    """Positions hold motion up to 0.4 of the rate: a drive's plain gain is still seen above it, to 10 %."""
    rng = np.random.default_rng(6)
    q, noise = moved(rng)
    gain = np.array([[[-5e4, 0.0], [0.0, -3e4]]])
    found = estimate_feedback_taps(
        logged(q + noise, apply_feedback_taps(gain, noise) + 0.1 * rng.standard_normal(q.shape)), JOINTS, 200.0
    )
    assert_allclose(found, gain, atol=5e3)


def test_logs_made_of_noise_alone_answer_it_as_the_measured_one_did():
    """Taps fitted to the made log are those of the loop, sign and all."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units))
    rng = np.random.default_rng(3)
    t = np.arange(15_000) / RATE_HZ
    w = 2 * np.pi * 0.7
    q, v, a = (x[:, None] for x in (0.3 * np.sin(w * t), 0.3 * w * np.cos(w * t), -0.3 * w**2 * np.sin(w * t)))
    noise, loop = 5e-6 * rng.standard_normal(q.shape), np.array([[[0.0]], [[-8e4]], [[6e4]]])
    tau = model.torque(q, v, a) + apply_feedback_taps(loop, noise) + 0.2 * rng.standard_normal(q.shape)
    log = logged(q + noise, tau, axis.actuated)
    motion = model.motion(q, v, a, np.sign(v), t=t)
    piece = SimpleNamespace(motion=motion, contacts=None, log=log, preparation=SimpleNamespace(position_cutoff_hz=60.0))
    made = NoiseOnlyLog.of(cast(Any, piece), model, log, 20.0).draw(rng)
    taps = estimate_feedback_taps(made, axis.actuated, 20.0)
    assert_allclose(taps, loop, rtol=0.05, atol=0.05 * 6e4)


def test_made_logs_round_as_the_measured_one_did():
    """Steps of 16 um behind noise of 1.7 um: moving, made positions err by 5 um, not 7; at rest by as much, over many draws."""
    axis, step, sd = load_robot("linear_axis"), 16.3e-6, 1.67e-6
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units))
    rng, t = np.random.default_rng(5), np.arange(8000) / RATE_HZ
    w = 2 * np.pi * 0.25
    q = (0.03 * np.sin(w * np.minimum(t, 4.0 * t[-1] / 8)))[:, None]
    v = np.gradient(q, t, axis=0)
    log = logged(np.round((q + sd * rng.standard_normal(q.shape)) / step) * step, 0 * q, axis.actuated)
    motion = model.motion(q, v, 0 * v, np.sign(v), t=t)
    piece = SimpleNamespace(motion=motion, contacts=None, log=log, preparation=SimpleNamespace(position_cutoff_hz=60.0))
    found = []
    clean = NoiseOnlyLog.of(cast(Any, piece), model, log, 20.0)
    for _ in range(60):
        made = clean.draw(rng)
        error = made.channels["q_axis"] - q[:, 0]
        found.append([np.mean(error[part] ** 2) for part in (slice(500, 3500), slice(4500, 7500))])
    assert_allclose(np.sqrt(np.mean(found, axis=0)), np.hypot(step / np.sqrt(12), sd), rtol=0.12)


def test_a_log_that_is_thinned_keeps_the_answer_with_its_phase():
    """A 2 kHz drive answers by two samples; in made logs at 250 Hz gain and phase at 5 and 20 Hz are its own: 10 %, 0.1 rad."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units))
    rng, rate, gains = np.random.default_rng(4), 2000.0, (2e4, 400.0)
    t = np.arange(200_000) / rate
    noise = 5e-6 * rng.standard_normal((len(t), 1))
    answer = -gains[0] * noise - gains[1] * rate * np.diff(noise, axis=0, prepend=0.0)
    log = logged(noise, answer + 0.2 * rng.standard_normal(noise.shape), axis.actuated, rate)
    thin, zero = decimate_log(log, 50.0), np.zeros((len(t) // 8, 1))
    motion = model.motion(zero, zero, zero, zero, t=thin.t)
    piece = SimpleNamespace(
        motion=motion, contacts=None, log=thin, preparation=SimpleNamespace(position_cutoff_hz=50.0)
    )
    made = NoiseOnlyLog.of(cast(Any, piece), model, log, 30.0).draw(rng)
    assert made.rate_hz == pytest.approx(250.0)
    f, crossed = csd(made.channels["q_axis"], made.channels["tau_axis"], 250.0, nperseg=250)
    _, power = welch(made.channels["q_axis"], 250.0, nperseg=250)
    for hz in (5, 20):
        true = -gains[0] - gains[1] * rate * (1 - np.exp(-2j * np.pi * f[hz] / rate))
        assert abs(crossed[hz] / power[hz] / true) == pytest.approx(1.0, abs=0.1)
        assert np.angle(crossed[hz] / true) == pytest.approx(0.0, abs=0.1)


def test_no_cause_is_found_in_a_loop_closed_through_the_encoder():
    """A cascade answers the encoder's noise, with a phase; without its answer counted, it passes for a spring."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units)).with_values(
        {"axis.coulomb_pos": 20.0, "axis.coulomb_neg": 21.0, "axis.viscous_pos": 200.0, "axis.viscous_neg": 190.0}
    )
    sensors = Sensors(encoder_noise=1e-5, force_noise=1.0, log_rate_hz=RATE_HZ)
    log = simulate(model, build_named_motion("fourier", model, 60.0, 1), sensors=sensors, seed=1)
    found = diagnose(axis, [log])
    assert [f.cause for f in found.findings if f.status == "confirmed"] == []


def test_rests_at_reversals_are_no_cause():
    """Friction of 60 N holds an axis at rest for moments that coarse encoders do not show; they pass for no hysteresis."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units)).with_values(
        {"axis.coulomb_pos": 60.0, "axis.coulomb_neg": 65.0, "axis.viscous_pos": 200.0, "axis.viscous_neg": 190.0}
    )
    sensors = Sensors(encoder_noise=2e-5, force_noise=1.0, log_rate_hz=RATE_HZ)
    log = simulate(model, build_named_motion("prbs", model, 60.0, 1), sensors=sensors, seed=1, feedback="ideal")
    assert [f.cause for f in diagnose(axis, [log]).findings if f.status == "confirmed"] == []


def test_noise_too_small_to_bound_the_motion_ends_no_diagnosis():
    """Encoders of 0.1 um show motion up to half the rate; 8 N of ripple are still named beside a whole motion."""
    axis = load_robot("linear_axis")
    effects = [*build_friction_model("asymmetric", axis.actuated, axis.force_units)]
    effects += [CyclicRipple(axis.actuated, axis.force_units, period=0.02)]
    model = Model.of(axis, effects).with_values(
        {"axis.coulomb_pos": 60.0, "axis.coulomb_neg": 65.0, "axis.ripple_sin": 8.0}
    )
    sensors = Sensors(encoder_noise=1e-7, force_noise=1.0, log_rate_hz=250.0)
    log = simulate(model, build_named_motion("fourier", model, 30.0, 2), sensors=sensors, seed=2)
    assert "cyclic_ripple" in [f.cause for f in diagnose(axis, [log]).findings if f.status == "confirmed"]


@pytest.mark.parametrize(
    ("amplitudes", "stderr", "correlation", "distinct"),
    [
        ((-0.05, 0.01), (0.06, 0.006), 0.0, False),
        ((1.0, 0.0), (0.1, 0.1), 0.0, True),
        ((-0.054, -0.032), (0.035, 0.024), -0.95, True),
        ((-0.054, 0.032), (0.035, 0.024), -0.95, False),
    ],
)
def test_amplitudes_are_judged_together(amplitudes, stderr, correlation: float, distinct: bool):
    """Two of 1.5 standard errors each are not both zero where the errors' correlation of -0.95 excludes it, else may be."""
    C = np.outer(stderr, stderr) * np.array([[1.0, correlation], [correlation, 1.0]])
    names = ("mass", "a", "b")
    base = BaseParameters(names, np.array([0, 1, 2]), np.array([], int), np.zeros((3, 0)))
    values = Parameters(
        [Parameter(n, v, "", stderr=s) for n, v, s in zip(names, (9.0, *amplitudes), (0.1, *stderr), strict=True)]
    )
    cov = np.block([[np.eye(1), np.zeros((1, 2))], [np.zeros((2, 1)), C]])
    estimate = cast(Any, SimpleNamespace(base=base, parameters=values, cov=cov, scatter=0.8 * cov))
    effects = [cast(Any, SimpleNamespace(parameters=SimpleNamespace(names=("a", "b"))))]
    assert is_distinct_from_zero(effects, estimate, MIN_AMPLITUDE_Z) is distinct


@pytest.mark.parametrize(("made", "counts"), [(0.5, 0.25), (1.0, 1.0), (4.0, 1.0)])
def test_made_noise_counts_for_no_more_than_was_measured(made: float, counts: float):
    """What a column finds in made noise counts by that noise's power over the measured one's, at most by one."""
    rng = np.random.default_rng(7)
    e, C = rng.standard_normal(50), rng.standard_normal((50, 1))
    blank = SimpleNamespace(whiten_columns=lambda columns: C, e=e, gram=lambda rows: rows.T @ rows, scale=made)
    found = estimate_noncentrality([cast(Any, blank)], cast(Any, SimpleNamespace(scale=1.0)), [[]], np.array([False]))
    assert found[0] == pytest.approx(counts * float(C[:, 0] @ e) ** 2 / float(C[:, 0] @ C[:, 0]))


def test_what_draws_of_encoder_noise_make_of_a_column_is_their_mean_without_their_own_chance():
    """A bias of two standard errors in 400 draws: noncentrality 4, where the mean of squares is 5; without a bias, none."""
    rng = np.random.default_rng(8)
    C = rng.standard_normal((50, 1))
    unit = C[:, 0] / np.linalg.norm(C)

    def seen(bias: float) -> float:
        noise_only_models = []
        for _ in range(400):
            e = rng.standard_normal(50) + bias * unit
            noise_only_models.append(
                SimpleNamespace(whiten_columns=lambda columns: C, e=e, gram=lambda rows: rows.T @ rows, scale=1.0)
            )
        null_model = cast(Any, SimpleNamespace(scale=1.0))
        return estimate_noncentrality(
            cast(Any, noise_only_models), null_model, [[]] * len(noise_only_models), np.array([False])
        )[0]

    assert seen(2.0) == pytest.approx(4.0, abs=0.6)
    assert seen(0.0) < 0.25


def test_a_line_whose_phase_decides_what_a_column_sees_scatters_from_draw_to_draw():
    """A column sees 20 cos(phase) of a line: a noncentrality of 200, variance 400^2 / 8; a fixed one has no scatter."""
    rng = np.random.default_rng(9)
    C = rng.standard_normal((50, 1))
    unit = C[:, 0] / np.linalg.norm(C)

    def seen(sizes: np.ndarray) -> tuple[float, float]:
        drawn = [
            SimpleNamespace(
                whiten_columns=lambda columns: C,
                e=rng.standard_normal(50) + size * unit,
                gram=lambda rows: rows.T @ rows,
                scale=1.0,
            )
            for size in sizes
        ]
        scale = cast(Any, SimpleNamespace(scale=1.0))
        return estimate_noncentrality(cast(Any, drawn), scale, [[]] * len(sizes), np.array([False]))

    mean, variance = seen(20 * np.cos(rng.uniform(0, 2 * np.pi, 2000)))
    assert mean == pytest.approx(200, rel=0.1)
    assert variance == pytest.approx(20_000, rel=0.2)
    assert seen(np.full(2000, 20.0))[1] < 300


@pytest.mark.parametrize(("mean", "variance"), [(1e-9, 1e3), (1e-2, 1e3), (50.0, 0.0), (50.0, 2.0), (50.0, 2500.0)])
def test_the_nodes_of_a_noncentrality_are_numbers_with_its_mean(mean: float, variance: float):
    """From a distribution that is nearly all at zero to one without scatter, nodes are finite and their mean is the mean."""
    nodes, weights = importlib.import_module("tau_dyn.evidence.noise_only_bootstrap")._list_gamma_nodes(mean, variance)
    assert np.isfinite(nodes).all() and weights.sum() == pytest.approx(1)
    assert weights @ nodes == pytest.approx(mean, rel=1e-6)


@pytest.mark.parametrize("phase", [0.0, 0.5, 1.0])
def test_four_draws_of_a_line_do_not_make_another_phase_of_it_significant(phase: float):
    """The p-value of a line of amplitude 20 at any phase is above 1 % for nine of ten sets of four draws of it."""
    rng = np.random.default_rng(10)
    C = rng.standard_normal((50, 1))
    unit, scale = C[:, 0] / np.linalg.norm(C), cast(Any, SimpleNamespace(scale=1.0))
    found = []
    for _ in range(200):
        drawn = [
            SimpleNamespace(
                whiten_columns=lambda columns: C,
                e=rng.standard_normal(50) + 20 * np.cos(angle) * unit,
                gram=lambda rows: rows.T @ rows,
                scale=1.0,
            )
            for angle in rng.uniform(0, 2 * np.pi, 4)
        ]
        statistic = (20 * np.cos(phase) + rng.standard_normal()) ** 2
        found.append(compute_artefact_chance(statistic, cast(Any, drawn), scale, [[]] * 4, np.array([False])))
    assert np.mean(np.array(found) > 0.01) > 0.9


def test_motion_that_fades_into_the_noise_is_not_taken_for_an_answer():
    """Just above its band some of what is read is motion, which answers by its mass: the one tap of a loop comes back alone."""
    rng, rate, mass, gain = np.random.default_rng(9), 250.0, 90.0, -7e6
    shaken = lowpass(lowpass(rng.standard_normal((25_000, 1)), 6.0, rate, order=1), 6.0, rate, order=1)
    q = 0.002 * shaken / np.std(shaken)
    noise = 2e-5 * rng.standard_normal(q.shape)
    force = mass * np.gradient(np.gradient(q, 1 / rate, axis=0), 1 / rate, axis=0)
    log = logged(q + noise, force + gain * noise + 2.0 * rng.standard_normal(q.shape), ("one",), rate)
    assert_allclose(estimate_feedback_taps(log, ("one",), 22.5), [[[gain]]], rtol=0.1)


def test_a_joint_on_which_encoder_noise_makes_the_cause_is_left_out(monkeypatch):
    """Noise makes 50 of 22 on one joint and 1 of 60 on the other: the cause stands on the other; the first is chance."""
    noise_only_bootstrap = importlib.import_module("tau_dyn.evidence.noise_only_bootstrap")
    made = {("a",): 50.0, ("b",): 1.0}
    monkeypatch.setattr(
        noise_only_bootstrap, "ColumnCache", lambda clean: SimpleNamespace(columns=lambda effect: effect.joints)
    )
    monkeypatch.setattr(noise_only_bootstrap, "NullModel", SimpleNamespace(of=lambda *parts: None))
    monkeypatch.setattr(
        noise_only_bootstrap,
        "estimate_noncentrality",
        lambda noise_only_models, null_model, columns, *_: (made[columns[0]], 0.0),
    )

    def fit(joint: str, T: float) -> GroupTest:
        effect = SimpleNamespace(joints=(joint,), parameters=[SimpleNamespace(lower=-np.inf)])
        return GroupTest(cast(Any, effect), T, 1.0, 1, False, 1.0, np.zeros(1))

    a, b, null_model = fit("a", 22.0), fit("b", 60.0), cast(Any, SimpleNamespace(noise=(), parts=()))
    noise = noise_only_bootstrap.NoiseOnlyBootstrap(lambda: [None])
    left = noise.reject_artefacts(null_model, CandidateCause("spring", (b, a), 0.0, (a, b)), [], 20)
    assert left is not None and left.fits == (b,)
    assert noise.reject_artefacts(null_model, CandidateCause("spring", (a,), 0.0, (a,)), [], 20) is None


def test_an_answer_one_sample_later_stands_at_lag_one():
    """A controller that pushes 1e5 N/m against the noise of the sample before: the tap at lag +1, and none before it."""
    rng = np.random.default_rng(8)
    q, noise = moved(rng)
    later = np.vstack([np.zeros((1, 2)), noise[:-1]])
    found = estimate_feedback_taps(logged(q + noise, -1e5 * later + 1e-3 * rng.standard_normal(q.shape)), JOINTS, 20.0)
    reach = len(found) // 2
    assert_allclose(found[reach + 1], -1e5 * np.eye(2), atol=0.1e5)
    assert np.abs(found[: reach + 1]).max() < 0.1e5
