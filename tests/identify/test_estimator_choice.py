"""When noise explains a residual: white ones pass, each kind of memory does not; and which references are references."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from raising import raises_code
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError
from tau_dyn.identify import build_model
from tau_dyn.identify.estimators import Estimator, is_residual_white
from tau_dyn.log import Log

N, RATE, CUTOFF = 40_000, 1000.0, 50.0


def residual(x: np.ndarray, keep: np.ndarray | None = None) -> SimpleNamespace:
    """Return what is asked of a refined fit: whitened residuals (n, m), in two stretches."""
    keep = np.ones(x.shape, bool) if keep is None else keep
    parts = (slice(0, N // 3), slice(N // 3, N))
    stretches = [SimpleNamespace(keep=keep[p], log=SimpleNamespace(rate_hz=RATE)) for p in parts]
    preparation = SimpleNamespace(force_cutoff_hz=CUTOFF)
    estimate = SimpleNamespace(regression=SimpleNamespace(preparation=preparation))
    return SimpleNamespace(estimate=estimate, residuals=[np.where(keep, x, 0.0)[p] for p in parts], stretches=stretches)


@pytest.fixture
def white():
    return np.random.default_rng(1).normal(size=(N, 2))


def test_white_residuals_are_explained(white) -> None:
    """At any size, and with gaps in which no equation counts."""
    keep = (np.arange(N)[:, None] % 300 > 40) & np.ones((N, 2), bool)
    assert (
        is_residual_white(residual(white))
        and is_residual_white(residual(7e-4 * white))
        and is_residual_white(residual(white, keep))
    )


@pytest.mark.parametrize("phi", [0.12, -0.12])
def test_neighbours_that_are_alike_are_not(white, phi: float) -> None:
    """A correlation of 0.12 where 0.05 and four standard errors, 0.02, are allowed; 0.02 passes. One joint is enough."""

    def of(memory: float) -> np.ndarray:
        return np.column_stack([white[:, 0], lfilter([1.0], [1.0, -memory], white[:, 1])])

    assert not is_residual_white(residual(of(phi))) and is_residual_white(residual(of(phi / 6)))


@pytest.mark.parametrize("hz", [0.5, 7.0])
def test_slow_waves_below_the_noise_are_seen(white, hz: float) -> None:
    """A wave of 0.21 in noise of 1 has a hundredth of its power, which in a tenth of the band makes half as much again."""
    wave = np.sin(2 * np.pi * hz * np.arange(N)[:, None] / RATE)
    assert not is_residual_white(residual(white + 0.21 * wave * [0, 1]))
    assert is_residual_white(residual(white + 0.05 * wave))
    assert is_residual_white(
        residual(white + 0.21 * np.sin(2 * np.pi * 270 * np.arange(N)[:, None] / RATE))
    )  # above the motion


@pytest.mark.parametrize(
    ("share", "sentence"), [(0.0, ""), (0.1, ""), (0.5, "q_ref_axis of made is as noisy as an encoder")]
)
def test_a_reference_may_have_a_fifth_of_the_encoders_noise(axis, rng, share: float, sentence: str) -> None:
    """10 um of encoder noise: 1 um in the reference is rounding, 5 um are a measurement."""
    t = np.arange(8000) / RATE
    path = 0.1 * np.sin(6 * t)
    noisy = {
        "q_axis": path + 1e-5 * rng.normal(size=t.size),
        "q_ref_axis": path + share * 1e-5 * rng.normal(size=t.size),
    }
    log = Log(t, noisy | {"tau_axis": np.cos(6 * t)}, "made")
    model = build_model(axis, "asymmetric")
    if sentence:
        with pytest.raises(InputError, match=sentence):
            Estimator("iv", model, [log])
    else:
        assert Estimator("iv", model, [log]).kind == "iv"
    with raises_code("bad_option"):
        Estimator("iv", model, [log.with_channels(q_ref_axis=0 * t)])
