"""Waves over the place that hide below the encoder's noise, frequency by frequency: an encoder's error, or a true motion."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.force_baseline import detect_position_periodicity
from tau_dyn.effects import build_friction_model
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

RATE_HZ, SECONDS = 250.0, 100.0
PERIOD, SIZE, STEP = 0.033, 8e-6, 16e-6
"""A wave of 8 um every 33 mm, read in steps of 16 um."""


def shown(n_waves: float, kind: str) -> Log:
    """Return a log of the linear axis; `kind` is `encoder` (it errs), `motion` (it truly moves so) or `none`."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units))
    rng, t = np.random.default_rng(4), np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    q, v, a = np.zeros((3, len(t), 1))
    for f, size in ((0.31, 0.12), (0.53, 0.1), (0.83, 0.06)):
        w, phase = 2 * np.pi * f, rng.uniform(0, 6)
        q[:, 0] += size * np.sin(w * t + phase)
        v[:, 0] += size * w * np.cos(w * t + phase)
        a[:, 0] -= size * w**2 * np.sin(w * t + phase)
    wave, k = n_waves * SIZE, 2 * np.pi / PERIOD
    waved = (
        q + wave * np.sin(k * q),
        v * (1 + wave * k * np.cos(k * q)),
        a * (1 + wave * k * np.cos(k * q)) - wave * k**2 * v**2 * np.sin(k * q),
    )
    tau = model.torque(*(waved if kind == "motion" else (q, v, a))) + 2.0 * rng.standard_normal(q.shape)
    read = (q if kind == "none" else waved[0]) + 2e-6 * rng.standard_normal(q.shape)
    channels = {"q": np.round(read / STEP) * STEP, "tau": tau}
    return Log(t, {f"{key}_{axis.actuated[0]}": x[:, 0] for key, x in channels.items()}, f"{kind}.csv")


@cache
def answer(kind: str) -> Diagnosis:
    return diagnose(load_robot("linear_axis"), shown(1.0, kind))


def test_an_encoder_error_that_only_positions_show_is_found():
    """The axis moves smoothly and its forces show nothing; positions err by half a step, above the smoothed band."""
    first = next(f for f in answer("encoder").findings if f.status == "confirmed")
    assert first.cause == "transmission_error"
    size = np.hypot.reduce([p.value for p in first.parameters if "error_" in p.name])
    assert size == pytest.approx(SIZE, rel=0.1)


@pytest.mark.parametrize("kind", ["motion", "none"])
def test_a_true_motion_with_waves_is_no_error(kind):
    """The axis truly moves in waves, and its forces say so: with smoothed positions they would pass for an error."""
    assert [f.cause for f in answer(kind).findings if f.status == "confirmed"] == []


def test_a_quick_motion_read_finely_shows_no_wave(monkeypatch):
    """Sines up to 1.6 Hz and an encoder of 1 um: no wave, though half of the band's lower edge moves 300,000 times as far."""

    class Stop(Exception):
        pass

    def look(channel, smooth_hz):
        assert not detect_position_periodicity(channel, smooth_hz)
        raise Stop

    monkeypatch.setattr(importlib.import_module("tau_dyn.diagnose.force_baseline"), "detect_position_periodicity", look)
    axis, rng, t = load_robot("linear_axis"), np.random.default_rng(5), np.arange(10000) / RATE_HZ
    q, a = np.zeros((2, len(t)))
    for f, size in ((0.4, 0.1), (0.9, 0.1), (1.6, 0.1)):
        wave = size * np.sin(2 * np.pi * f * t + 1)
        q, a = q + wave, a - (2 * np.pi * f) ** 2 * wave
    force = 20 * a + 0.5 * rng.standard_normal(len(t))
    channels = {f"q_{axis.actuated[0]}": q + 1e-6 * rng.standard_normal(len(t)), f"tau_{axis.actuated[0]}": force}
    with pytest.raises(Stop):
        diagnose(axis, Log(t, channels, "quick.csv"))


def test_a_sharper_held_out_log_hides_no_wave(monkeypatch):
    """Each piece is looked through above its own smoothed band; one whose band is as wide as the forces' is passed over."""
    module, seen = importlib.import_module("tau_dyn.diagnose.force_baseline"), []
    monkeypatch.setattr(module, "detect_position_periodicity", lambda *given: seen.append(given) or False)
    diagnose(load_robot("linear_axis"), shown(1.0, "encoder"))
    ((channel, (smooth,)),) = seen
    twice = replace(channel, prepared=channel.prepared * 2, thinned=channel.thinned * 2)
    assert detect_position_periodicity(twice, (smooth, 1e3)) and not detect_position_periodicity(twice, (1e3, 1e3))
