"""Replays: a recording made by another integrator is repeated, and what the model lacks shows in the errors."""

import json
from dataclasses import fields

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.linalg import expm

from tau_dyn.effects import Delay, ThermalDrift, build_friction_model
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.simulate import CascadeController, CascadeLaw, Replay, Sensors, move, replay, simulate
from tau_dyn.simulate.log_replay import _reference

MASS, VISCOUS = 95.0, 200.0
LAW = CascadeLaw.of(25.0, 240.0, na=1, integral_rate=8.0, speed_feedforward=0.7, force_per_unit=35.0, limit=10.0)


def record_exactly(law: CascadeLaw = LAW, push: float = 0.0, rate: int = 1000, size: float = 1.0) -> Log:
    """Return 3 s of a mass with viscous drag and a constant push [N], each period solved in closed form.

    A drive's sequence: read the position, compute, hold the force until the next sample.
    """
    dt, n = 1 / rate, 3 * rate
    t = np.arange(n) * dt
    step = expm(np.array([[0, 1, 0], [0, -VISCOUS / MASS, 1 / MASS], [0, 0, 0]]) * dt)
    slow, fast = 2 * np.pi * 0.8, 2 * np.pi * 3.1
    q_ref = size * (0.05 * (1 - np.cos(slow * t)) + 0.004 * (1 - np.cos(fast * t)))
    v_ref = size * (0.05 * slow * np.sin(slow * t) + 0.004 * fast * np.sin(fast * t))
    kp, kv, windup, share, unit, limit = (float(getattr(law, f.name)[0]) for f in fields(law)[:6])
    q, tau, state, integral = np.zeros(n), np.zeros(n), np.zeros(2), -push / unit
    for k in range(n):
        q[k] = state[0]
        speed = (q[k] - q[max(k - 2, 0)]) / (2 * dt)
        amount = kv * (kp * (q_ref[k] - q[k]) + share * v_ref[max(k - 1, 0)] - speed)
        output = float(np.clip(amount + integral, -limit, limit))
        integral += windup * amount * dt if output == amount + integral else 0.0
        tau[k] = unit * output
        state = (step @ [*state, tau[k] + push])[:2]
    return Log(t, {"q_axis": q, "tau_axis": tau, "q_ref_axis": q_ref}, "exact")


@pytest.fixture(scope="module")
def viscous(make) -> Model:
    """The plant of `record_exactly`."""
    return make.friction(make.block(MASS), 0.0, VISCOUS)


def errors(found: Replay) -> dict[str, float]:
    """Return the first joint's errors by signal [%]."""
    return {signal: float(found.relative_error_percent(signal)[0]) for signal in found.measured}


def test_a_held_force_is_repeated(viscous):
    """The closed form and the replay agree but for the start: the hold is neither late nor early by part of a sample."""
    found = errors(replay(viscous, record_exactly().window(500, 2500), LAW, cutoff_hz=np.inf))
    assert found["position"] < 2e-3 and found["following"] < 0.05 and found["force"] < 0.05
    assert found["speed"] < 0.01 and found["acceleration"] < 0.05


def test_substeps_of_the_plant_change_nothing_that_matters(viscous):
    """The mean of two forces is the hold itself, so that four steps a sample are hardly better than one."""
    log = record_exactly().window(500, 1500)
    one, four = (replay(viscous, log, LAW, substeps=n) for n in (1, 4))
    assert_allclose(one.simulated["position"], four.simulated["position"], atol=1e-7)


def test_a_wound_up_integral_is_resumed(viscous):
    """Against a steady push of 80 N the first force is the measured one, which the integral had learnt before the log began."""
    model = Model.of(viscous.robot, build_friction_model("symmetric", ("axis",), ("N",)))
    model = model.with_values({"axis.viscous": VISCOUS, "axis.coulomb": 0.0, "axis.offset": -80.0})
    log = record_exactly(push=80.0).window(1130, 2500)
    found = replay(model, log, LAW)
    assert_allclose(found.simulated["force"][:50], found.measured["force"][:50], atol=0.5)
    assert errors(found)["position"] < 5e-3 and errors(found)["force"] < 0.1


def test_a_slow_log_of_a_fast_loop_is_repeated_at_the_loops_rate(viscous):
    """Of a 1 kHz loop every fourth sample is kept; the replay takes the loop for 1 kHz by itself, and 250 Hz is worse."""
    log = record_exactly()
    kept = Log(log.t[2000::4], {key: x[2000::4] for key, x in log.channels.items()}, "kept")
    found, slow = replay(viscous, kept, LAW), replay(viscous, kept, LAW, rate_hz=250)
    assert found.rate_hz == pytest.approx(1000) and slow.rate_hz == pytest.approx(250)
    assert errors(found)["following"] < 0.15 and errors(found)["force"] < 0.8
    assert errors(slow)["following"] > 15 * errors(found)["following"]


def test_a_step_of_the_reference_stays_a_step(viscous):
    """Between samples no value is asked for that lies beyond those beside it, where a spline would swing by a tenth."""
    t = np.arange(40) / 250
    step = np.where(t > 0.08, 0.2, 0.0)
    reference = _reference(Log(t, {"q_ref_axis": step}), ("axis",), 4)
    assert reference.q.min() > -0.002 and reference.q.max() < 0.202
    assert_allclose(reference.q[::4, 0], step, atol=1e-12)


def test_what_the_model_lacks_shows(gantry, make):
    """Three axes with friction, recorded by `simulate`: the truth repeats them, a frictionless robot does not."""
    law = CascadeLaw.of(40.0, [4000.0, 4000.0, 7000.0], na=3, limit=gantry.robot.effort_limit.tolist())
    motion = move(gantry.robot.actuated, np.zeros(3), np.array([0.15, 0.1, 0.2]), 0.8)
    log = simulate(gantry, motion, CascadeController(law), Sensors(encoder_resolution=1e-6))
    log = log.window(100, log.n_samples)
    truth, smooth = replay(gantry, log, law), replay(make.friction(gantry.robot, 0.0, 0.0), log, law)
    assert np.all(truth.relative_error_percent("following") < 2) and np.all(truth.relative_error_percent("force") < 5)
    for signal in ("position", "following", "force"):
        assert np.all(smooth.relative_error_percent(signal) > 4 * truth.relative_error_percent(signal))
    assert truth.cutoff_hz == smooth.cutoff_hz
    assert np.all(truth.stuck < 0.5)


def test_the_recordings_own_faults_are_simulated(viscous):
    """A log whose forces are 3 ms late is repeated by a model that knows it, and not by one that does not."""
    log = record_exactly().window(500, 1500)
    late = log.with_channels(tau_axis=np.interp(log.t - 3e-3, log.t, log.channels["tau_axis"]))
    knows = Model.of(viscous.robot, (*viscous.effects, Delay(("axis",), ("N",))))
    values = {p.name: p.value for p in viscous.effect_parameters}
    knows = knows.with_values(values | {knows.effects[-1].parameters.names[0]: 3e-3})
    assert errors(replay(knows, late, LAW))["force"] < 0.2 < 2 < errors(replay(viscous, late, LAW))["force"]


def test_friction_follows_the_measured_temperature(viscous):
    """Viscous friction of 10 N/(m/s) a kelvin at 20 degrees above the reference is that of the recording."""
    log = record_exactly().window(500, 1500)
    warm = Model.of(viscous.robot, (ThermalDrift(("axis",), ("N",)),)).with_values({"axis.thermal_viscous": 10.0})
    found = replay(warm, log.with_channels(temp_room=np.full(log.n_samples, 40.0)), LAW)
    assert errors(found)["force"] < 0.05
    with raises_code("missing_column"):
        replay(warm, log, LAW)


def test_noise_is_kept_out_of_accelerations(viscous, rng):
    """2 um of encoder noise would be an acceleration of 2 m/s^2 at 1 kHz; the low-pass leaves what can be compared."""
    log = record_exactly().window(500, 2000)
    log = log.with_channels(q_axis=log.channels["q_axis"] + 2e-6 * rng.standard_normal(log.n_samples))
    found = replay(viscous, log, LAW)
    rough, sharp = found.with_cutoff(np.inf), found.with_cutoff(20.0)
    assert errors(found)["acceleration"] < 5 and errors(rough)["acceleration"] > 30
    assert errors(sharp)["acceleration"] < errors(found)["acceleration"]
    assert errors(sharp)["following"] == errors(found)["following"] and sharp.cutoff_hz == 20.0


def test_errors_are_what_they_are_called():
    """One per cent too large is an error of 1 %, whatever the sign; what was zero throughout has no relative error."""
    x = np.array([[1.0, 0.0], [-2.0, 0.0], [3.0, 0.0]])
    measured = dict.fromkeys(("position", "speed", "acceleration", "force", "following"), x)
    simulated = {key: 1.01 * value + [0.0, 0.5] for key, value in measured.items()}
    units, rest = (("m", "N"), ("rad", "N m")), np.zeros(2)
    found = Replay(("a", "b"), units, np.arange(3.0), measured, simulated, np.inf, 1000.0, rest, rest)
    assert_allclose(found.relative_error_percent("speed"), [1.0, np.nan])
    assert_allclose(found.residual("force"), [[-0.01, -0.5], [0.02, -0.5], [-0.03, -0.5]])
    row = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert row["errors"]["acceleration"]["b"] == {"relative_error_percent": None, "rms": 0.5, "unit": "rad/s^2"}
    assert row["errors"]["force"]["b"]["unit"] == "N m" and row["cutoff_hz"] is None


def test_a_loop_at_its_limit_is_said(viscous):
    """A reference far too fast holds the drive at 350 N, in the recording and in the replay."""
    log = record_exactly(size=4.0)
    found = replay(viscous, log, LAW)
    assert found.at_limit[0] > 0.05 and "limit in" in found.warnings[0]
    assert np.max(np.abs(found.simulated["force"])) == pytest.approx(350)


def test_progress_is_told(viscous):
    """Shares that rise from zero."""
    told: list[float] = []
    replay(viscous, record_exactly().window(0, 500), LAW, progress=told.append)
    assert told[0] == 0 and len(told) >= 90 and np.all(np.diff(told) > 0)


def test_what_cannot_be_repeated_is_refused_in_one_sentence(viscous):
    """Missing references, holes, gaps, another robot's law, a rate that does not fit, gains that make it run away."""
    log = record_exactly()
    holes = log.channels["tau_axis"].copy()
    holes[7] = np.nan
    gap = Log(np.where(log.t > 1, log.t + 0.5, log.t), log.channels, "gap")
    bare = Log(log.t, {key: log.channels[key] for key in ("q_axis", "tau_axis")}, "bare")
    wild = CascadeLaw.of(30.0, 1e4, na=1, force_per_unit=35.0)
    cases = [
        (bare, LAW, {}, "bare has no q_ref column for axis"),
        (log.with_channels(tau_axis=holes), LAW, {}, "tau_axis has samples that are no finite number"),
        (gap, LAW, {}, "gap has 1 gap"),
        (log.window(0, 9), LAW, {}, "too few"),
        (log, CascadeLaw.of(1.0, 1.0, na=2), {}, "for 2 joint"),
        (log, LAW, {"rate_hz": 1500}, "no whole multiple"),
        (log, LAW, {"rate_hz": np.nan}, "no whole multiple"),
        (log, LAW, {"substeps": 0}, "from 1"),
        (log, wild, {}, "ran away before"),
    ]
    for faulty, law, options, words in cases:
        with pytest.raises(InputError, match=words) as fault:
            replay(viscous, faulty, law, **options)
        assert "\n" not in str(fault.value)
