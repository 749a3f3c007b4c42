"""The stability limit of a force loop."""

import numpy as np
import pytest

from tau_dyn.control.lead_through import ForceLoop
from tau_dyn.exceptions import InputError

LOOPS = [
    ForceLoop(),
    ForceLoop(servo_hz=12.0, delay=2),
    ForceLoop(delay=1, filter_hz=20.0),
    ForceLoop(sample_time=0.001, servo_hz=30.0, delay=5),
]


def radius(loop, gain, stiffness, damping):
    return np.abs(np.linalg.eigvals(loop.matrix(gain, stiffness, damping))).max()


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("damping", [0.0, 30.0])
def test_at_the_limit_the_loop_neither_grows_nor_decays(loop, damping):
    """The gain at which the frequency response passes -1 puts a pole on the unit circle, at that frequency."""
    limit = loop.limit(30e3, damping)
    poles = np.linalg.eigvals(loop.matrix(limit.gain, 30e3, damping))
    worst = poles[np.argmax(np.abs(poles))]
    assert abs(abs(worst) - 1) < 1e-6
    assert abs(abs(np.angle(worst)) / (2 * np.pi * loop.sample_time) - limit.hz) < 1e-3 * limit.hz
    assert radius(loop, 0.98 * limit.gain, 30e3, damping) < 1 < radius(loop, 1.02 * limit.gain, 30e3, damping)


@pytest.mark.parametrize("loop", LOOPS)
def test_only_gain_times_stiffness_counts(loop):
    """A contact ten times as stiff bears a tenth of the gain and oscillates at the same frequency."""
    soft, hard = loop.limit(2e3), loop.limit(20e3)
    assert soft.gain == pytest.approx(10 * hard.gain, rel=1e-6)
    assert soft.hz == pytest.approx(hard.hz, rel=1e-6)


def test_a_sampled_integrator_has_the_limits_of_the_textbook():
    """Without servo lag x+ = x + T u bears K k T = 2 (at half the sampling rate); a sample late, 1 (at a sixth)."""
    ideal, late = (ForceLoop(servo_hz=1e7, delay=d).limit(1.0) for d in (0, 1))
    assert ideal.gain * 0.004 == pytest.approx(2, rel=1e-4)
    assert ideal.hz == pytest.approx(125)
    assert late.gain * 0.004 == pytest.approx(1, rel=1e-4)
    assert late.hz == pytest.approx(250 / 6, rel=1e-4)


def test_a_long_delay_obeys_the_rule_of_thumb():
    """An integrator behind a delay T_d oscillates from K k = pi / (2 T_d) on, at 1 / (4 T_d)."""
    loop = ForceLoop(sample_time=0.001, servo_hz=1e6, delay=20)
    limit, late = loop.limit(1.0), 20.5 * 0.001  # with half a sample of hold
    assert limit.gain == pytest.approx(np.pi / 2 / late, rel=0.01)
    assert limit.hz == pytest.approx(1 / (4 * late), rel=0.01)


def test_a_filter_forgets_with_its_time_constant():
    """A sample that lasts one time constant, 1 / (2 pi f), takes 63 % of the new force."""
    loop = ForceLoop(sample_time=0.01, filter_hz=1 / (2 * np.pi * 0.01))
    assert loop.smoothing == pytest.approx(1 - np.exp(-1))
    assert ForceLoop().smoothing == 1


def test_lag_lowers_the_limit_and_damping_of_the_contact_raises_it():
    """Every lag in the loop costs phase; a damper in the contact gives some back."""
    plain = ForceLoop(servo_hz=20.0)
    assert ForceLoop(servo_hz=10.0).limit(1e4).gain < plain.limit(1e4).gain
    assert ForceLoop(servo_hz=20.0, delay=1).limit(1e4).gain < plain.limit(1e4).gain
    assert plain.limit(1e4, 20.0).gain > plain.limit(1e4).gain


@pytest.mark.parametrize(
    "wrong",
    [
        {"sample_time": 0.0},
        {"sample_time": np.nan},
        {"servo_hz": -1.0},
        {"filter_hz": 0.0},
        {"delay": -1},
        {"delay": 0.5},
    ],
)
def test_a_loop_that_cannot_be_is_refused(wrong):
    """Time, bandwidth and delay are positive."""
    with pytest.raises(InputError, match=next(iter(wrong))):
        ForceLoop(**wrong)
