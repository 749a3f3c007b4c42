"""Whole runs on one axis: short logs with something hidden by formulas of their own, and what `diagnose` makes of them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter1d

from tau_dyn.diagnose import diagnose
from tau_dyn.effects import build_friction_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_named_motion

RATE_HZ = 250.0
NOISE_N, ENCODER_M = 2.0, 2e-6
FRICTION = {"coulomb_pos": 20.0, "coulomb_neg": 21.0, "viscous_pos": 200.0, "viscous_neg": 190.0}

axis = load_robot("linear_axis")
truth = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units)).with_values(
    {f"axis.{name}": x for name, x in FRICTION.items()}
)


def logged(t, q, v, a, hidden=0.0, seed=0, late=0.0, name="made.csv", **channels) -> Log:
    """Return a log of a motion (n,) with a hidden force, the force `late` seconds behind."""
    rng = np.random.default_rng([63, seed])
    force = truth.torque(q[:, None], v[:, None], a[:, None])[:, 0] + hidden
    tau = np.interp(t - late, t, force) + NOISE_N * rng.standard_normal(len(t))
    q = q + ENCODER_M * rng.standard_normal(len(t))
    return Log(t, {"q_axis": q, "tau_axis": tau, **channels}, name)


def recorded(hidden=lambda q, v, t: 0.0, *, duration=40.0, seed=0, **more) -> Log:
    """Return a log of constant-speed strokes."""
    path = build_named_motion("strokes", truth, duration, seed).every(round(1000 / RATE_HZ))
    t, q, v, a = path.t, path.q[:, 0], path.v[:, 0], path.a[:, 0]
    return logged(t, q, v, a, hidden(q, v, t), seed, **more)


def driven(v: np.ndarray, **more) -> Log:
    """Return a log of prescribed velocities (n,)."""
    t = np.arange(len(v)) / RATE_HZ
    v = gaussian_filter1d(v, 12)
    q = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2)]) / RATE_HZ
    return logged(t, q, v, np.gradient(v, 1 / RATE_HZ), **more)


@pytest.fixture(scope="module")
def clean():
    """The diagnosis of a log in which nothing hides."""
    return diagnose(axis, [recorded()], seed=3)


@pytest.fixture(scope="module")
def stribeck():
    """The diagnosis of a friction peak of 8 N, Gaussian where the library's is exponential."""
    return diagnose(axis, [recorded(lambda q, v, t: 8 * np.sign(v) * np.exp(-((v / 0.05) ** 2)))])


def named(diagnosis, cause):
    """Return the first finding, which must be this cause, confirmed and worth something."""
    first = diagnosis.findings[0]
    assert diagnosis.verdict == "named" and diagnosis.exit_status == 0
    assert (first.cause, first.joints, first.status) == (cause, ("axis",), "confirmed")
    assert first.gain.reduction_percent > 0 and first.gain.ci95[1] > first.gain.reduction_percent > first.gain.ci95[0]
    assert first.p_value < 1e-6
    assert_allclose(first.confirmation[0], 1.0, atol=4 * first.confirmation[1])
    assert any(e.name == cause for e in diagnosis.extended_model.effects)
    assert diagnosis.extended.relative_error_percent < diagnosis.baseline.relative_error_percent
    assert f"{cause} axis" in [step.step for step in diagnosis.waterfall]
    return first


def test_a_clean_log_has_no_confirmed_finding(clean):
    """Nothing hides, nothing is named: the baseline is at the noise, and what would have been seen is listed."""
    assert clean.verdict == "nothing_found"
    assert not any(f.status == "confirmed" for f in clean.findings)
    assert clean.extended_model.effects == clean.model.effects
    assert_allclose(clean.extended.rms, clean.noise_floor.rms, rtol=0.05)
    assert {"stribeck", "quadratic_drag", "cyclic_ripple", "delay"} <= {x.cause for x in clean.limits}
    limits = {x.cause: x for x in clean.limits}
    assert 0.2 < limits["stribeck"].amplitude < 20 and limits["stribeck"].unit == "N"
    assert 1e-5 < limits["delay"].amplitude < 5e-3 and limits["delay"].unit == "s"


def test_both_models_name_their_logs(clean):
    """The refitted and the extended model say which logs their values come from, by name and hash."""
    log, later = (replace(recorded(seed=k), name=f"{k}.csv", sha256=f"{k}" * 64) for k in (1, 2))
    found = diagnose(axis, [log], holdout=[later], seed=3)
    for model in (found.model, found.extended_model):
        source = model.provenance
        assert source["trained_on"] == [{"path": "1.csv", "sha256": "1" * 64}] and source["seed"] == 3
        assert source["held_out"] == [{"path": "2.csv", "sha256": "2" * 64}]
    assert [row["path"] for row in clean.extended_model.provenance["trained_on"]] == ["made.csv"]


def test_a_gaussian_friction_peak_is_named_stribeck(stribeck):
    """Another exponent than the library's is the same cause; amplitude within a factor two, as the form is a choice."""
    first = named(stribeck, "stribeck")
    amplitude = next(p for p in first.parameters if p.name == "axis.stribeck")
    assert 4 < amplitude.value < 24 and amplitude.stderr > 0
    assert len(first.parameters) == 2  # its speed as well
    assert "stribeck" not in {x.cause for x in stribeck.limits}


def test_viscous_asymmetry_is_missed_by_a_symmetric_baseline_only():
    """Forward 200, backward 190: half the difference is found beside symmetric friction, within four standard errors."""
    first = named(diagnose(axis, [recorded()], model="symmetric"), "viscous_asymmetry")
    (half,) = first.parameters
    assert_allclose(half.value, 5.0, atol=4 * half.stderr)
    assert half.stderr < 1


def test_a_ripple_is_named_with_its_period():
    """A force every 20.9 mm with a second harmonic: the period within 0.5 %, both amplitudes within 10 % of the first."""
    wave = 2 * np.pi / 0.0209
    log = recorded(lambda q, v, t: 3 * np.sin(wave * q + 0.7) + 0.6 * np.sin(2 * wave * q))
    first = named(diagnose(axis, [log]), "cyclic_ripple")
    *waves, period = (p.value for p in first.parameters)
    assert_allclose(period, 0.0209, rtol=5e-3)
    assert_allclose(np.hypot(waves[::2], waves[1::2]), [3.0, 0.6], atol=0.3)
    assert first.gain.reduction_percent > 20
    assert len(first.signature.x) == len(first.signature.y) == len(first.signature.fitted) > 100


def test_a_delay_is_named_with_its_length_and_its_twin():
    """Forces logged 2 ms late: within 10 %, and a clock offset is said to be the same thing."""
    first = named(diagnose(axis, [recorded(late=0.002)]), "delay")
    (delay,) = first.parameters
    assert_allclose(delay.value, 0.002, rtol=0.1)
    assert "clock_offset" in first.indistinguishable_from and first.experiment


@pytest.mark.parametrize("which", ["clean", "stribeck"])
def test_the_json_form_is_complete(which, request):
    """Everything that the contract's section 5 names is there, in plain JSON without NaN."""
    found = request.getfixturevalue(which)
    result = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert {"seed", "status", "warnings", "verdict", "baseline", "extended", "noise_floor", "waterfall"} <= set(result)
    assert {"findings", "unexplained", "detection_limits", "untestable"} <= set(result)
    assert result["status"] == "ok" and result["seed"] == found.seed
    for key in ("baseline", "extended", "noise_floor"):
        assert {"rms_per_joint", "relative_error_percent"} <= set(result[key])
        assert set(result[key]["rms_per_joint"]) == {"axis"}
    steps = [x["step"] for x in result["waterfall"]]
    assert steps[:2] == ["nominal", "refitted"] and steps[-1] == "noise_floor"
    for x in result["waterfall"]:
        (low, high), rms = x["ci95"]["axis"], x["rms_per_joint"]["axis"]
        assert low < rms < high
    for finding in result["findings"]:
        expected = {"cause", "joints", "status", "score", "p_value", "parameters", "gain", "indistinguishable_from"}
        assert {*expected, "equation"} <= set(finding)
        for p in finding["parameters"]:
            assert {"name", "value", "unit", "stderr", "ci95"} <= set(p)
        if finding["status"] == "confirmed":
            assert {"rms_before", "rms_after", "reduction_percent", "ci95"} <= set(finding["gain"])
    assert all({"amplitude", "unit"} <= set(x) for x in result["detection_limits"].values())
    assert all(x["cause"] and x["why"] and x["experiment"] for x in result["untestable"])
    tried = {*result["detection_limits"], *(x["cause"] for x in result["untestable"])}
    assert not tried & {f["cause"] for f in result["findings"]}


def test_no_part_of_the_data_serves_two_purposes(clean):
    """Three parts of about 60, 20 and 20 % of the log; the time view shows each sample in one of them or in none."""
    train, confirm, gain = clean.n_parts
    assert_allclose(np.array([train, confirm, gain]) / (train + confirm + gain), [0.6, 0.2, 0.2], atol=0.05)
    assert train + confirm + gain < 40.0
    (trace,) = clean.traces
    assert set(np.unique(trace.part)) == {-1, 0, 1, 2}


def test_a_seed_settles_everything(clean):
    """The same seed gives the same answer to the last digit."""
    again = diagnose(axis, [recorded()], seed=3)
    assert json.dumps(again.to_dict()) == json.dumps(clean.to_dict())


def test_drift_without_a_temperature_is_untestable():
    """Friction that falls by a third while the robot warms up: no cause is guessed, thermal drift asks for a thermometer."""
    found = diagnose(axis, [recorded(lambda q, v, t: -8 * np.sign(v) * (1 - np.exp(-t / 20)), duration=45.0)])
    why = {u.cause: u for u in found.untestable}
    assert "temperature" in why["thermal_drift"].why and "temp" in why["thermal_drift"].experiment
    assert not any(f.cause == "thermal_drift" for f in found.findings)
    assert any("t" in u.depends_on for u in found.unexplained)
    assert "drifts in time" in why["thermal_drift"].why


def test_with_a_temperature_the_drift_is_named():
    """The same with a thermometer: thermal drift, confirmed."""
    warmth = lambda t: 1 - np.exp(-t / 20)  # noqa: E731
    log = recorded(lambda q, v, t: -8 * np.sign(v) * warmth(t), duration=45.0)
    log = replace(log, channels={**log.channels, "temp_axis": 20 + 10 * warmth(log.t)})
    first = named(diagnose(axis, [log]), "thermal_drift")
    coulomb = next(p for p in first.parameters if p.name.endswith("thermal_coulomb"))
    assert_allclose(coulomb.value, -0.8, atol=4 * coulomb.stderr)


def test_one_speed_says_nothing_of_the_law_of_friction():
    """Strokes at one speed: a law that needs a second one is not found, and would only be from a fifth of Coulomb's force on."""
    v = 0.15 * np.sign(np.sin(2 * np.pi * np.arange(0, 40, 1 / RATE_HZ) / 4.0))
    found = diagnose(axis, [driven(v)])
    assert not any(f.status == "confirmed" for f in found.findings)
    limits = {limit.cause: limit.amplitude for limit in found.limits}  # the ramps show a little of them
    assert limits.get("quadratic_drag", np.inf) * 0.15**2 > 0.2 * FRICTION["coulomb_pos"]
    assert limits.get("stribeck", np.inf) > FRICTION["coulomb_pos"]


def test_without_reversals_nothing_is_said_of_the_directions():
    """Always forward: asymmetries are untestable beside symmetric friction, with the strokes that would show them."""
    t = np.arange(0, 40, 1 / RATE_HZ)
    found = diagnose(axis, [driven(0.03 + 0.02 * np.sin(2 * np.pi * 0.3 * t))], model="symmetric")
    assert not any(f.status == "confirmed" for f in found.findings)
    untestable = {u.cause: u for u in found.untestable}
    assert {"coulomb_asymmetry", "viscous_asymmetry"} <= set(untestable)
    assert "both directions" in untestable["viscous_asymmetry"].experiment


def test_a_log_that_is_trained_on_does_not_confirm():
    """Given for training and as held-out, a log is used for training alone, and a warning says so."""
    one, other = recorded(duration=20.0), recorded(duration=20.0, seed=1, name="other.csv")
    found = diagnose(axis, [one], holdout=[one, other])
    assert any("both trained on and held out" in w for w in found.warnings)
    assert "held-out" in found.how
    parts = {trace.log: set(np.unique(trace.part)) for trace in found.traces}
    assert parts["made.csv"] == {0} and parts["other.csv"] == {-1, 1, 2}


def test_sharp_held_out_strokes_behind_a_slow_training_log_are_predicted_down_to_the_noise(monkeypatch):
    """Positions of slow waves need a low-pass of 5 Hz; cut alike, strokes would lose accelerations of 20 N."""
    monkeypatch.setattr(f"{__name__}.ENCODER_M", 2e-5)
    t = np.arange(0, 60, 1 / RATE_HZ)
    slow = driven(0.3 * np.sin(2 * np.pi * 0.31 * t) + 0.2 * np.sin(2 * np.pi * 0.83 * t + 1), name="slow.csv")
    found = diagnose(axis, [slow], holdout=[recorded(name="sharp.csv", seed=4)])
    assert found.verdict == "nothing_found"
    assert found.baseline.rms[0] < NOISE_N
