"""What a motion's information is weighed by: noise of forces and of encoders, and what is known beforehand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.excitation.information import Information, Noise
from tau_dyn.identify import build_model
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.simulate import MotionProfile


def test_encoder_noise_weighs_as_the_force_of_its_acceleration(write) -> None:
    """White noise n of a block's position up to f Hz is a force of rms `m (2 pi f)^2 n / sqrt(5)`, beside that of the forces."""
    model = Model.of(load_robot_from_urdf(write.block(), "block"))
    f = (np.arange(4000) + 0.5) / 4000 * 30.0
    rms = 5.0 * 1e-6 * np.sqrt(np.mean((2 * np.pi * f) ** 4))
    both = Noise(np.array([0.02]), np.array([1e-6]), 1000.0, "").weighing(model, 30.0)
    assert_allclose(both, np.hypot(0.02, rms), rtol=1e-3)
    assert both[0] > 1.2 * 0.02


def test_what_was_weighed_before_counts_by_its_variance() -> None:
    """A mass known to 0.5 kg is information of 4 / kg^2; what nobody measured is none."""
    known = Parameters([Parameter("m", 5.0, "kg", prior_stderr=0.5), Parameter("c", 1.0, "N")])
    base = SimpleNamespace(names=("m", "c"), kept=np.array([0, 1]))
    prior = Information.prior.fget(SimpleNamespace(model=SimpleNamespace(parameters=known), base=base))  # type: ignore[attr-defined]
    assert_allclose(prior, np.diag([4.0, 0.0]))


def test_a_sample_that_half_counts_is_half_the_information(write) -> None:
    """At the slowest sure speed a half of the samples is left: Coulomb friction's rows lose half of their squares."""
    model = build_model(load_robot_from_urdf(write.block(), "block"), "symmetric")
    rng, slow = np.random.default_rng(0), np.array([0.02])
    states = MotionProfile(*rng.standard_normal((3, 40, 1)))
    information = Information.of(model, np.array([2.0]), 0.1, slow, states)
    still = np.zeros((1, 1))
    near, far = (information.rows(MotionProfile(still, still + v, still)).Y[0, 0] for v in (slow[0], 1e6))
    names = [information.base.names[k] for k in information.base.kept]
    coulomb = next(k for k, name in enumerate(names) if name.endswith(".coulomb"))
    assert_allclose([far[coulomb], near[coulomb]], [1 / 2.0, np.sqrt(0.5) / 2.0])
