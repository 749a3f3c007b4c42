"""The deflection channel: springs, loops, late encoders and cyclic errors hidden between two encoders of simulated joints."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.interpolate import CubicSpline

from tau_dyn.diagnose.deflection_channel import build_deflection_channel, estimate_stiffness
from tau_dyn.diagnose.pipeline import diagnose_deflection
from tau_dyn.effects import EFFECTS
from tau_dyn.evidence.channel import ColumnCache
from tau_dyn.evidence.null_model import NullModel, fit_noise_models
from tau_dyn.log import ColumnMap, Log
from tau_dyn.log.column_names import split_column_name
from tau_dyn.robot import load_robot_from_urdf

JOINTS = ("shoulder", "elbow", "wrist")  # the wrist has no encoder on its load side
STIFFNESS = 5e6  # [N m/rad]
NOISE = 2e-6  # [rad] of each encoder
RATE = 250.0

_PARTS = [
    f'<link name="{child}_link"/><joint name="{child}" type="revolute"><parent link="{parent}_link"/>'
    f'<child link="{child}_link"/><axis xyz="0 1 0"/><origin xyz="1 0 0"/>'
    '<limit lower="-3" upper="3" velocity="2" effort="20000"/></joint>'
    f'<transmission name="{child}_drive"><type>transmission_interface/SimpleTransmission</type><joint name="{child}"/>'
    f'<actuator name="{child}_motor"/></transmission>'
    for parent, child in zip(("base", *JOINTS), JOINTS, strict=False)
]
robot = load_robot_from_urdf(f'<robot name="arm"><link name="base_link"/>{"".join(_PARTS)}</robot>', "arm")


def motion(rng: np.random.Generator, duration: float = 40.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time, joint positions (N, 3), and torques (N, 3) of gravity, inertia and friction."""
    t = np.arange(0, duration, 1 / RATE)
    q = np.zeros((len(t), 3))
    for f in (0.1, 0.23, 0.41):
        q += rng.uniform(0.05, 0.15, 3) * np.sin(2 * np.pi * (f * t[:, None] * (1, 1.07, 1.13) + rng.uniform(0, 1, 3)))
    v = np.gradient(q, t, axis=0)
    a = np.gradient(v, t, axis=0)
    tau = 1500 * np.sin(2 * q + 0.3) + 400 * a + 600 * np.tanh(v / 0.01) + 800 * v
    return t, q, tau + 20 * rng.standard_normal(q.shape)


def recorded(
    t: np.ndarray, q: np.ndarray, tau: np.ndarray, load: np.ndarray, rng: np.random.Generator, name: str = "arm"
) -> Log:
    """Return a log whose load-side encoders have zeros of their own."""
    q = q + NOISE * rng.standard_normal(q.shape)
    load = load + NOISE * rng.standard_normal(q.shape) + rng.uniform(-1e-3, 1e-3, 3)
    channels = {f"q_{j}": q[:, k] for k, j in enumerate(JOINTS)} | {f"tau_{j}": tau[:, k] for k, j in enumerate(JOINTS)}
    return Log(t, channels | {f"q_link_{j}": load[:, k] for k, j in enumerate(JOINTS[:2])}, name=name)


def bristle(q: np.ndarray, distance: float) -> np.ndarray:
    """Return the state (N, ...) of a chain of elastic-slip elements that starts to slip one after the other (Iwan)."""
    out = np.zeros_like(q)
    for slip in distance * np.linspace(0.4, 1.6, 5):
        x = np.zeros_like(q)
        for k in range(1, len(q)):
            x[k] = np.clip(x[k - 1] + (q[k] - q[k - 1]) / slip, -1, 1)
        out += x / 5
    return out


def spring(tau: np.ndarray) -> np.ndarray:
    """Return the deflection (N, 3) of a spring under the smooth part of a torque."""
    width = 9
    return np.apply_along_axis(np.convolve, 0, tau, np.ones(width) / width, "same") / STIFFNESS


def test_clean_logs_stay_clean(rng) -> None:
    """Zeros that differ from log to log are refitted, and nothing is named; the joint without a second encoder is left out."""
    logs = [recorded(t, q, tau, q, rng, name) for name in "ab" for t, q, tau in [motion(rng)]]
    found = diagnose_deflection(robot, logs[0], holdout=logs[1])
    assert found.verdict == "nothing_found" and found.channel == "deflection"
    assert found.outputs == ("shoulder", "elbow") and found.units == ("rad", "rad")
    assert found.extended.rms.max() < 1.5 * np.sqrt(2) * NOISE
    assert not found.extended_model.effects


def test_spring_and_loop_are_both_named(rng) -> None:
    """5 MN m/rad and a loop of slipping elements on the elbow: both named there, the stiffness within 15 %."""
    logs = []
    for name in "ab":
        t, q, tau = motion(rng)
        load = q - spring(tau) * (0, 1, 0) - 2e-4 * bristle(q, 0.03) * (0, 1, 0)
        logs.append(recorded(t, q, tau, load, rng, name))
    found = diagnose_deflection(robot, logs[0], holdout=logs[1])
    confirmed = {f.cause: f for f in found.findings if f.status == "confirmed"}
    assert found.verdict == "named" and {"joint_compliance", "hysteresis"} <= set(confirmed)
    assert confirmed["joint_compliance"].joints == ("elbow",)
    compliance = next(p for p in confirmed["joint_compliance"].parameters if p.name == "elbow.compliance")
    assert 1 / compliance.value == pytest.approx(STIFFNESS, rel=0.15)
    assert {e.name for e in found.extended_model.effects} >= {"joint_compliance", "hysteresis"}
    assert found.extended.rms[1] < 0.2 * found.baseline.rms[1]


def test_a_loop_left_out_makes_the_joint_look_soft(rng) -> None:
    """Friction lets torque follow the direction of motion, so compliance takes the loop over: the stiffness drops by half."""
    t, q, tau = motion(rng)
    load = q - spring(tau) - 2e-4 * bristle(q, 0.03)
    channel = build_deflection_channel(robot, [recorded(t, q, tau, load, rng)])
    readings = {reading.causes: reading for reading in estimate_stiffness(channel)}
    alone, both = readings[("joint_compliance",)], readings[("joint_compliance", "hysteresis")]
    assert_allclose(both.stiffness, STIFFNESS, rtol=0.15)
    assert np.all(alone.stiffness < 0.65 * both.stiffness)
    assert np.all(both.rms < 0.4 * alone.rms)


def test_a_late_encoder_is_not_taken_for_a_spring(rng) -> None:
    """A load side read 3 ms late follows the speed: clock offset, within 2 %, and neither spring nor loop beside it."""
    logs = []
    for name in "ab":
        t, q, tau = motion(rng)
        late = CubicSpline(t, q)(t - 3e-3)
        logs.append(recorded(t, q, tau, late, rng, name))
    found = diagnose_deflection(robot, logs[0], holdout=logs[1])
    confirmed = [f for f in found.findings if f.status == "confirmed"]
    assert [f.cause for f in confirmed] == ["clock_offset"] and set(confirmed[0].joints) == {"shoulder", "elbow"}
    assert_allclose([p.value for p in confirmed[0].parameters], 3e-3, rtol=0.02)
    assert "load-side encoder's reading is 3.0" in confirmed[0].sentence
    assert not found.extended_model.effects  # it is the recording's, and not the robot's


def test_a_late_encoder_passes_for_a_soft_joint_with_a_loop(rng) -> None:
    """Were a late reading no possible cause, a rigid joint would read a stiffness, and the engine says what it depends on."""
    t, q, tau = motion(rng)
    late = CubicSpline(t, q)(t - 3e-3)
    log = recorded(t, q, tau, late, rng)
    readings = {r.causes: r for r in estimate_stiffness(build_deflection_channel(robot, [log]))}
    assert np.all(readings[("joint_compliance",)].stiffness < 1e7)
    assert np.all(readings[("joint_compliance", "clock_offset")].stiffness > 1e8)
    displacements = [EFFECTS[name] for name in ("joint_compliance", "hysteresis", "backlash", "pinion_scale")]
    found = diagnose_deflection(robot, log, causes=displacements)
    assert any(u.status == "confirmed" and f"v_{u.joint}" in u.depends_on for u in found.unexplained)


def test_a_cyclic_error_is_found_with_its_period(rng) -> None:
    """20 urad every 40 mrad at the shoulder, with a second harmonic: transmission error, its period within 1 %."""
    t, q, tau = motion(rng)
    error = 2e-5 * np.sin(2 * np.pi * q[:, 0] / 0.04 + 0.4) + 3e-6 * np.sin(4 * np.pi * q[:, 0] / 0.04)
    load = q.copy()
    load[:, 0] -= error
    found = diagnose_deflection(robot, recorded(t, q, tau, load, rng))
    first = found.findings[0]
    assert (first.cause, first.joints, first.status) == ("transmission_error", ("shoulder",), "confirmed")
    assert first.effects[0].settings["period"] == pytest.approx(0.04, rel=0.01)
    sine, cosine = first.parameters[:2]
    assert np.hypot(sine.value, cosine.value) == pytest.approx(2e-5, rel=0.15)


def test_every_log_has_its_own_zeros(rng) -> None:
    """Two logs of two joints have four zeros, each in its own log; gaps within a log do not make further ones."""
    t, q, tau = motion(rng)
    one, other = (recorded(t, q, tau, q, rng, name) for name in "ab")
    whole = np.abs(t - 20) > 1
    cut = Log(t[whole], {key: x[whole] for key, x in one.channels.items()}, name="a")
    channel = build_deflection_channel(robot, [cut], [other])
    assert channel.parameters.names == ("shoulder.zero_1", "elbow.zero_1", "shoulder.zero_2", "elbow.zero_2")
    assert [run.name for run in channel.runs] == ["a", "a", "b"]
    for run, own, rest in zip(channel.runs, (0, 0, 2), (2, 2, 0), strict=True):
        assert_allclose(run.W[0, :, own : own + 2], np.eye(2))
        assert not run.W[:, :, rest : rest + 2].any()


def test_quick_scan_explains_what_the_exact_columns_do(rng) -> None:
    """Periods are scanned by Fourier transforms: nearly what the exact columns explain, and the period stands out."""
    t, q, tau = motion(rng)
    load = q.copy()
    load[:, 1] -= 2e-5 * np.sin(2 * np.pi * q[:, 1] / 0.04)
    channel = build_deflection_channel(robot, [recorded(t, q, tau, load, rng)])
    null_model = NullModel.of(ColumnCache(channel), (0,), fit_noise_models(channel, (0,)))
    make = EFFECTS["transmission_error"]
    effects = [make(["elbow"], ["N m"], **s) for s in make.grid(channel.scene, ("elbow",))]
    quick = channel.scan(
        effects,
        null_model.whiten,
        np.column_stack([null_model.e, null_model.draw_null_residuals(8, np.random.default_rng(0))]),
    )
    assert quick is not None
    best = effects[int(np.argmax(quick[:, 0]))]
    assert best.settings["period"] == pytest.approx(0.04, rel=0.05)


def test_what_is_missing_is_said(rng) -> None:
    """No second encoder, one that a later log lacks, samples lost, a log too short: each is one sentence."""
    t, q, tau = motion(rng)
    log = recorded(t, q, tau, q, rng)
    s, p, force = motion(rng)
    other = recorded(s, p, force, p, rng)
    bare = Log(s, {k: x for k, x in other.channels.items() if "link" not in k}, name="bare")
    with raises_code("missing_column", "q_link_shoulder"):
        diagnose_deflection(robot, bare)
    with raises_code("missing_column", "q_link_shoulder"):
        diagnose_deflection(robot, log, holdout=bare)
    lost = np.where(np.arange(len(t)) < 3, np.nan, log.channels["q_link_elbow"])
    with raises_code("bad_sample", "3"):
        diagnose_deflection(robot, log.with_channels(q_link_elbow=lost))
    with raises_code("too_little_data"):
        diagnose_deflection(robot, log.window(0, 120))


def test_q_link_is_a_signal_of_its_joint() -> None:
    """`q_link_elbow` is the load side of `elbow`, not the position of `link_elbow`; a column map may define it."""
    assert split_column_name("q_link_elbow") == ("q_link", "elbow")
    assert split_column_name("q_linkage") == ("q", "linkage")
    assert "q_link_elbow" in ColumnMap.from_dict({"q_link_elbow": "se_1"}).sources
