"""Ordinary shaker tests: band-limited force and anti-alias filters are no feedback, and many modes need many states."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt
from scipy.stats import binom

from tau_dyn.modes import Mode, Modes, StateSpace, find_modes
from tau_dyn.modes.feedback_tests import detect_feedback, find_acausality
from tau_dyn.modes.methods import build_initial_estimator
from tau_dyn.modes.modal import widen_modes
from tau_dyn.modes.order import choose_order
from tau_dyn.modes.record import prepare_records
from tau_dyn.modes.residuals import compute_residuals

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from recordings import recorded, structure
from shaker_tests import TESTS, Shaker, record_shaker


@pytest.fixture(scope="module")
def found() -> Modes:
    """Three modes under a force that ends at 400 Hz, filtered and sampled at 1 kHz."""
    return find_modes(record_shaker(TESTS["three_short"]), ["force"], ["place1"], delay=0)


def test_an_ordinary_shaker_test_is_followed(found):
    """The default explains 99 % of unseen data and finds 60, 150 and 280 Hz, each with 1 % damping."""
    assert found.method == "n4sid" and not found.feedback.suspected and found.holdout.mean > 99
    for f in (60, 150, 280):
        mode = min(found.modes, key=lambda m: abs(m.frequency_hz - f))
        assert mode.frequency_hz == pytest.approx(f, rel=2e-3) and mode.damping_ratio == pytest.approx(0.01, rel=0.03)


@pytest.mark.parametrize(("outputs", "noise"), [(1, 1e-3), (3, 1e-3), (28, 1e-2)])
def test_a_two_sided_path_is_no_feedback(outputs, noise):
    """Behind anti-alias filters the force to come shows in the responses, the more so in many; no loop is closed."""
    log = record_shaker(Shaker(outputs=outputs, n=6000, noise=noise), 51)
    data = prepare_records([log], ["force"], [f"place{k + 1}" for k in range(outputs)])
    assert detect_feedback(data.train).p_value > 1e-3


def test_many_modes_are_no_feedback():
    """Fourteen modes with little noise outlast a short ARX model; a long one leaves nothing that foretells the force."""
    data = prepare_records([record_shaker(TESTS["fourteen"], 40)], ["force"], ["place1", "place2"])
    assert detect_feedback(data.train).p_value > 1e-3


def test_the_final_model_rests_on_all_data(found):
    """The model answers for the held-out part too: it leaves less of all data than that of the first 70 % does."""
    assert "fitted to all data" in found.why["refinement"]
    assert found.holdout.n_samples == 900 and found.train.n_samples == 2100


def _acausality(gain: float, seed: int, order: int = 6) -> float:
    test = Shaker(gain=gain, disturbance=0.5, n=6000)
    data = prepare_records([record_shaker(test, seed)], ["force"], ["place1"])
    model = build_initial_estimator("n4sid", data.train)(order)
    return find_acausality(compute_residuals(model, data.train), [r.u for r in data.train]).p_value


def test_a_disturbed_open_loop_raises_no_alarm():
    """A disturbance of half the force's size, and two modes that the model lacks, are no feedback."""
    assert min(_acausality(0.0, 0), _acausality(0.0, 1), _acausality(0.0, 0, order=2)) > 1e-3


def test_an_input_that_follows_the_disturbance_is_seen():
    """A force that repeats the response's disturbance 40 samples later was fed back; one that comes before it was not."""
    rng = np.random.default_rng(0)
    v, r = rng.normal(size=(2, 4000))
    after, before = (r + 0.3 * np.roll(v, shift) for shift in (40, -40))
    assert find_acausality([v[:, None]], [after[:, None]]).p_value < 1e-3
    assert find_acausality([v[:, None]], [before[:, None]]).p_value > 1e-3


def _resonant_pair(seed: int, n: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Return a residual that rings for 200 samples, and a force below half the Nyquist frequency that knows nothing of it."""
    rng = np.random.default_rng(seed)
    pole = 0.995 * np.exp(0.6j)
    e = lfilter([1], np.poly([pole, pole.conj()]).real, rng.normal(size=n + 1000))[1000:]
    return e[:, None], sosfilt(butter(4, 0.5, output="sos"), rng.normal(size=n))[:, None]


def test_the_acausality_test_keeps_its_level():
    """Few independent samples, as ringing leaves them, do not make chance look like a loop: 5 % below 0.05, 1 % below 0.01."""
    p = np.array([find_acausality([e], [u]).p_value for e, u in map(_resonant_pair, range(400))])
    assert np.sum(p < 0.05) <= binom.ppf(0.999, 400, 0.05) and np.sum(p < 0.01) <= binom.ppf(0.999, 400, 0.01)
    assert np.sum(p < 0.2) >= binom.ppf(0.001, 400, 0.1)


def test_the_detection_limit_is_where_loops_are_seen():
    """A loop is rarely seen at a third of the stated gain, and nearly always at three times."""
    plant = StateSpace(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    limit = find_acausality(*([x] for x in _resonant_pair(0)), plant).detectable_gain

    def claimed(gain: float) -> int:
        pairs = (_resonant_pair(seed) for seed in range(40))
        return sum(find_acausality([e], [u - gain * e]).p_value < 1e-3 for e, u in pairs)

    assert claimed(limit / 3) <= 4 and claimed(3 * limit) >= 36


def test_many_modes_get_many_states():
    """Twelve modes need 24 states: the scan does not stop where the first twenty explain nothing more."""
    hz = tuple(np.linspace(3, 44, 12))
    whole = structure(hz, (0.01,) * 12)
    record = recorded(replace(whole, B=whole.B[:, :1], C=whole.C[:2], D=whole.D[:2, :1]), 4000, 50)
    choice = choose_order([record], lambda records: build_initial_estimator("n4sid", records), orders=None)
    assert 24 <= choice.order <= 26 and not choice.limit


def test_standard_errors_cover_other_models():
    """A neighbouring order that puts a mode ten standard errors away widens its interval to reach it; one within does not."""
    mode = Mode(10.0, 0.01, 0.01, 0.0001, np.ones(1), 0.0)
    far, near = replace(mode, frequency_hz=10.1), replace(mode, frequency_hz=10.001)
    assert widen_modes([mode], [([mode], [far])])[0].frequency_stderr == pytest.approx(0.1, rel=0.05)
    assert widen_modes([mode], [([mode], [near])])[0] == mode
