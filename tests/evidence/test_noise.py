"""The noise of an output, judged on what a rich model leaves."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import Autoregression
from tau_dyn.evidence.channel import ColumnCache
from tau_dyn.evidence.null_model import NullModel, fit_noise_models


def test_the_noise_model_is_not_fooled_by_what_hides(make):
    """Judged on a rich model, noise is 1 N and AR(1) 0.8 although a friction of 30 N hides in the force."""
    rng = np.random.default_rng(3)
    channel = make.bench(rng, lambda m: 30 * m.sign * np.exp(-np.abs(m.v) / 0.2) + 40 * m.q**2, n=8000)
    (model,) = fit_noise_models(channel, (0,))
    assert_allclose(np.sqrt(model.variance), 1.0, rtol=0.15)
    assert_allclose(model.autocovariance(4) / model.variance, 0.8 ** np.arange(4), atol=0.1)


def test_the_rich_model_is_one_function_over_logs_of_different_range(make):
    """A force of the place is one function of it, in a log of short strokes and in one of long ones alike."""
    rng = np.random.default_rng(4)
    motions = [make.moving(rng, ("x",), 4000, size) for size in (0.4, 1.0)]
    channel = make.bench(rng, lambda m: 400 * m.q**3 - 300 * m.q**2, motions=motions)
    (model,) = fit_noise_models(channel, (0,))
    assert_allclose(np.sqrt(model.variance), 1.0, rtol=0.1)


def test_a_joint_that_never_moved_has_a_noise_model_all_the_same(make, rng):
    """No usable sample of an output is no reason to fail: it has no rows, and its model is never used."""
    motion = make.moving(rng, ("x", "still"), 2000)
    for array in (motion.q, motion.v, motion.a, motion.sign):
        array[:, 1] = 0.0
    channel = make.bench(rng, motions=[motion])
    models = fit_noise_models(channel, (0,))
    null_model = NullModel.of(ColumnCache(channel), (0,), models)
    assert_array_equal(np.unique(null_model.whiten.index), [0])


def test_temperature_that_stands_still_in_one_log_is_compared_with_the_other(make, rng):
    """Cold log, warm log: a temperature constant in each still separates them; one log without it leaves it out."""
    motions = [make.moving(rng, ("x",), 1500) for _ in range(2)]
    for motion, warmth in zip(motions, (20.0, 30.0), strict=True):
        motion.signals["temperature"] = np.full((1500, 1), warmth)  # type: ignore[index]
    drifting = make.bench(rng, lambda m: 0.5 * (m.signals["temperature"] - 20) * m.sign, motions=motions)
    (model,) = fit_noise_models(drifting, (0,))
    assert_allclose(np.sqrt(model.variance), 1.0, rtol=0.15)
    del motions[1].signals["temperature"]  # type: ignore[attr-defined]
    assert isinstance(fit_noise_models(make.bench(rng, motions=motions), (0,))[0], Autoregression)
