"""Encoder noise that is drawn again for the bootstrap has the power of the recorded one, below the motion's low-pass too."""

import numpy as np
import pytest

from tau_dyn.diagnose.noise_only_log import NoiseOnlyLog
from tau_dyn.log import Log, lowpass

RATE_HZ, SMOOTH_HZ, STEP = 1000.0, 27.0, 2.6e-4
"""An encoder of 24,000 steps a turn [rad]."""


def measure(speed: float, level: float, rng: np.random.Generator) -> tuple[float, np.ndarray]:
    """Return rms errors [steps] below the low-pass, recorded and of four draws (4,), of a joint at a speed [steps a sample]."""
    t = np.arange(0, 30, 1 / RATE_HZ)
    true = STEP * speed * RATE_HZ * t
    recorded = STEP * np.round((true + level * rng.standard_normal(len(t))) / STEP)
    read = Log(t, {"q_axis": lowpass(recorded, SMOOTH_HZ, RATE_HZ)}, "log.csv")
    still, none = np.zeros((len(t), 1)), np.zeros((0, 1, 1))
    noise_only = NoiseOnlyLog(
        read, ["axis"], still, still, read, np.array([STEP]), np.array([0.1 * STEP]), SMOOTH_HZ, none, SMOOTH_HZ
    )
    drawn = [noise_only.draw_noise(rng)[:, 0] for _ in range(4)]
    errors = np.column_stack([recorded - true, *drawn])
    rms = lowpass(errors - errors.mean(axis=0), SMOOTH_HZ, RATE_HZ)[500:-500].std(axis=0) / STEP
    return float(rms[0]), rms[1:]


@pytest.mark.parametrize("speed", [0.004, 0.012, 0.03, 0.1, 0.3, 0.77, 1.3, 6.12, 40.3])
def test_rounding_is_drawn_with_its_power_below_the_low_pass(rng, speed):
    """Steps that pass slowly leave a sawtooth, and fast ones the part that noise makes of it; drawn to 45 % of the recorded rms.

    Errors that repeat with each step would be a third of the recorded ones.
    """
    recorded, drawn = measure(speed, 0.1 * STEP, rng)
    assert np.sqrt(np.mean(drawn**2)) == pytest.approx(recorded, rel=0.45)


@pytest.mark.parametrize(("beat_hz", "least"), [(2, 0.5), (4, 0.5), (12, 0.75), (20, 0.75)])
@pytest.mark.parametrize("steps", [1, 2])
def test_rounding_at_a_constant_speed_leaves_a_line_below_the_low_pass(rng, steps, beat_hz, least):
    """Steps that beat with the clock leave errors of more than a tenth of a step, where independent ones leave 0.067.

    Drawn errors have most of a line's power; the smoothed path follows a part of a slow line.
    """
    recorded, drawn = measure(steps + beat_hz / RATE_HZ, 0.1 * STEP, rng)
    assert recorded > 0.1
    assert np.all(drawn > least * recorded)
    assert np.all(drawn < 1.25 * recorded)
