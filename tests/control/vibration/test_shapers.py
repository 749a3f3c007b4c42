"""Shapers and notch filters keep a resonance at rest: checked by simulating the second-order system that they are made for."""

from __future__ import annotations

import json

import numpy as np
import pytest
from raising import raises_code
from scipy.linalg import expm
from scipy.signal import TransferFunction, lsim

from tau_dyn.control.vibration import (
    SHAPERS,
    Resonance,
    Shaper,
    combine_shapers,
    compute_residual_vibration,
    design_causal_notch,
    design_shaper,
    read_resonances,
)
from tau_dyn.exceptions import CannotAnswer

MODE = Resonance(7.3, 0.04, 0.15, 0.005)


def ring(shaper: Shaper, hz: float, z: float) -> float:
    """Return the amplitude of s^2 + 2 z w s + w^2 at the last impulse, over that of one impulse then; by matrix exponentials."""
    w = 2 * np.pi * hz
    A, x, before = np.array([[0, 1], [-(w**2), -2 * z * w]]), np.zeros(2), 0.0
    for t, a in zip(shaper.times, shaper.amplitudes, strict=True):
        x, before = expm(A * (t - before)) @ x + np.array([0, a]), t
    wd = w * np.sqrt(1 - z**2)
    return float(np.hypot(x[0], (x[1] + z * w * x[0]) / wd) * wd)


@pytest.mark.parametrize("kind", SHAPERS)
@pytest.mark.parametrize("hz", [6.4, 7.3, 8.1])
def test_the_residual_is_that_of_a_simulation(kind, hz) -> None:
    """Impulses on a mass with a spring and a damper: the amplitude after the last one, for modes off the design as well."""
    shaper = design_shaper(kind, MODE)
    for z in (0.0, 0.04, 0.2):
        assert compute_residual_vibration(shaper, hz, z) == pytest.approx(ring(shaper, hz, z), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("z", [0.0, 0.05, 0.3])
def test_zv_and_zvd_leave_the_mode_at_rest_and_zvd_with_zero_slope(z) -> None:
    """A per cent of error in the frequency costs ZVD the square of what it costs ZV."""
    mode = Resonance(5.0, z)
    zv, zvd = design_shaper("zv", mode), design_shaper("zvd", mode)
    assert max(ring(zv, 5.0, z), ring(zvd, 5.0, z)) < 1e-12
    assert ring(zvd, 5.05, z) == pytest.approx(ring(zv, 5.05, z) ** 2, rel=0.05)


@pytest.mark.parametrize("z", [0.0, 0.05, 0.2])
def test_ei_leaves_what_is_tolerated_and_nothing_on_either_side(z) -> None:
    """EI: 5 % at the mode, zero at the mode's decay and two frequencies around it."""
    mode = Resonance(5.0, z)
    shaper = design_shaper("ei", mode, 0.05)
    assert ring(shaper, 5.0, z) == pytest.approx(0.05, rel=1e-9)
    K = np.exp(-z * np.pi / np.sqrt(1 - z**2))
    away = np.arccos((2 * K**2 - 0.05 * (1 + K**2)) / (2 * K * (K + 0.05))) / np.pi
    decay, turn = 2 * np.pi * 5.0 * z, 2 * np.pi * 5.0 * np.sqrt(1 - z**2)
    for side in (1 - away, 1 + away):
        size = np.hypot(decay, side * turn)
        assert ring(shaper, size / (2 * np.pi), decay / size) < 1e-9


def test_the_undamped_ei_shaper_is_the_published_one() -> None:
    """Singhose, Seering & Singer 1994: A = [(1 + V) / 4, (1 - V) / 2, (1 + V) / 4], half a period apart."""
    shaper = design_shaper("ei", Resonance(2.0, 0.0), 0.1)
    np.testing.assert_allclose(shaper.amplitudes, [1.1 / 4, 0.9 / 2, 1.1 / 4], rtol=1e-12)
    np.testing.assert_allclose(shaper.times, [0, 0.25, 0.5], rtol=1e-12)


def test_two_modes_rest_after_both_shapers() -> None:
    """One shaper after the other: the impulses of both, the sum one, and either mode at rest."""
    modes = [Resonance(5.0, 0.02), Resonance(13.7, 0.1)]
    whole = combine_shapers([design_shaper("zv", m) for m in modes])
    assert whole.amplitudes.sum() == pytest.approx(1) and len(whole.times) == 4
    assert max(ring(whole, m.frequency_hz, m.damping_ratio) for m in modes) < 1e-12


def test_a_sampled_shaper_keeps_its_sum_and_mean_time() -> None:
    """Impulses between samples are split: the same sum and the same mean delay, and little vibration at a quick step."""
    shaper = design_shaper("zvd", MODE)
    taps = shaper.sampled(0.001)
    np.testing.assert_allclose(taps.times / 0.001, np.round(taps.times / 0.001), atol=1e-9)
    assert taps.amplitudes.sum() == pytest.approx(1)
    assert taps.amplitudes @ taps.times == pytest.approx(shaper.amplitudes @ shaper.times)
    assert compute_residual_vibration(taps, 7.3, 0.04) < 1e-3
    with raises_code("invalid_value"):
        shaper.sampled(1e-9)


def test_the_worst_residual_lies_within_the_intervals_of_the_mode() -> None:
    """No mode drawn within the 95 % intervals rings more, and one at their edge as much."""
    shaper = design_shaper("zvd", MODE)
    worst = shaper.find_worst_residual(MODE)
    (low, high), (least, most) = MODE.frequency_interval, MODE.damping_interval
    drawn = np.random.default_rng(0).uniform((low, least), (high, most), (300, 2))
    assert max(ring(shaper, *row) for row in drawn) <= worst * (1 + 1e-3)
    assert worst == pytest.approx(max(ring(shaper, f, z) for f in (low, high) for z in (least, most)), rel=1e-6)


def test_a_notch_takes_the_resonance_out_and_nothing_at_rest() -> None:
    """Behind the filter a mode driven at its frequency moves as a well damped one; a constant command passes unchanged."""
    dt, z, w = 0.001, 0.02, 2 * np.pi * 11.0
    notch = design_causal_notch([Resonance(11.0, z)], dt)
    t = np.arange(6000) * dt
    plant = TransferFunction([w**2], [1, 2 * z * w, w**2])
    ringing = lsim(plant, np.sin(w * t), t)[1][-1000:]
    filtered = lsim(plant, notch.apply(np.sin(w * t)), t)[1][-1000:]
    assert np.abs(filtered).max() / np.abs(ringing).max() == pytest.approx(z / 0.7, rel=0.02)
    assert notch.response([1e-6])[0] == pytest.approx(1, abs=1e-6)
    assert abs(notch.response([11.0])[0]) == pytest.approx(z / 0.7, rel=1e-9)  # prewarped: the centre stays


def test_a_notch_is_no_use_for_a_mode_damped_as_its_poles() -> None:
    """A mode of damping ratio 0.8 has no peak that poles of 0.7 could take out."""
    with raises_code("invalid_value"):
        design_causal_notch([Resonance(11.0, 0.8)], 0.001)


def test_resonances_are_read_from_a_result(tmp_path) -> None:
    """Slowest first with their errors; modes that do not ring are left out, and other files are refused."""
    path = tmp_path / "modes.json"
    rows = [{"frequency_hz": 9.0, "damping_ratio": 0.02, "frequency_stderr": 0.1, "damping_stderr": None},
            {"frequency_hz": 4.0, "damping_ratio": 0.01, "frequency_stderr": 0.2, "damping_stderr": 0.001},
            {"frequency_hz": 2.0, "damping_ratio": 0.99}]  # fmt: skip
    path.write_text(json.dumps({"command": "modes", "modes": rows}))
    assert read_resonances(path) == [Resonance(4.0, 0.01, 0.2, 0.001), Resonance(9.0, 0.02, 0.1, 0.0)]
    path.write_text(json.dumps({"command": "modes", "modes": rows[2:]}))
    with pytest.raises(CannotAnswer):
        read_resonances(path)
    for content in ("{", "[]", '{"command": "identify", "modes": []}', '{"command": "modes", "modes": [3]}'):
        path.write_text(content)
        with raises_code("file_format"):
            read_resonances(path)
