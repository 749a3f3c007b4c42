"""The motion that references ask for: found under an encoder's noise where the response to them is known by hand."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.identify import build_model, choose_preparation
from tau_dyn.identify.full_rate import predict_tracked_motion
from tau_dyn.log import Log

RATE, MASS, COULOMB, VISCOUS = 500.0, 93.0, 25.0, 150.0
T = np.arange(6000) / RATE
REFERENCE = 0.1 * np.sin(2 * T) + 0.01 * np.sin(11 * T)
SPEED = 0.2 * np.cos(2 * T) + 0.11 * np.cos(11 * T)
FORCE = (
    MASS * (-0.4 * np.sin(2 * T) - 1.21 * np.sin(11 * T)) + VISCOUS * SPEED + COULOMB * np.sign(SPEED)
)  # of the file's mass, and of friction


def tracked(axis, q: np.ndarray) -> np.ndarray:
    """Return what follows from the reference alone, for a model with this mass and friction."""
    values = {"coulomb_pos": COULOMB, "coulomb_neg": COULOMB, "viscous_pos": VISCOUS, "viscous_neg": VISCOUS}
    model = build_model(axis, "asymmetric").with_values(
        {f"axis.{k}": x for k, x in values.items()} | {"carriage_link.mass": MASS}
    )
    log = Log(T, {"q_axis": q, "q_ref_axis": REFERENCE, "tau_axis": FORCE}, "made")
    return predict_tracked_motion(model, log, choose_preparation(axis, [log]), q[:, None])[:, 0]


def test_a_yielding_controller_is_followed_through_the_noise(axis, rng) -> None:
    """The drive gives way by 1 um per N, 25 N of friction and all, and 6 ms later: found to a tenth of 10 um of noise."""
    late = np.interp(T - 0.006, T, FORCE)
    for true in (REFERENCE - 1e-6 * FORCE, REFERENCE - 1e-6 * late):
        error = tracked(axis, true + 1e-5 * rng.normal(size=T.size)) - true
        calm = np.abs(SPEED) > 0.02  # a low-passed reference turns a few ms beside the true one
        inner = calm & (T > 0.5) & (T < 11.5)
        assert np.sqrt(np.mean(error[inner] ** 2)) < 1e-6


def test_noise_is_not_followed(axis, rng) -> None:
    """Of noise alone what some 60 numbers can take up, a tenth of it; of what no reference made, a drift, nothing."""
    noise = 1e-5 * rng.normal(size=T.size)
    assert np.std(tracked(axis, REFERENCE + noise) - REFERENCE) < 0.15 * 1e-5
    assert_allclose(tracked(axis, REFERENCE), REFERENCE, atol=1e-9)
    assert_allclose(tracked(axis, REFERENCE + 0.003) - REFERENCE, 0.003, atol=1e-6)  # a constant is an offset
