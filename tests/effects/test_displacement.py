"""Encoder and load apart: the force that the load's missing acceleration takes away, and where the tool goes."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.effects import Motion
from tau_dyn.effects.displacement import DisplacementEffect, second_derivative
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot


class Lag(DisplacementEffect):
    """A load that stays behind by the sine of the encoder's position."""

    name = "lag"
    equation = "encoder - load = lag sin(20 q)"

    @property
    def parameters(self) -> Parameters:
        """One length a joint."""
        return Parameters(Parameter(f"{joint}.lag", 0.0, "m", origin="lag") for joint in self.joints)

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return the sine."""
        out = np.zeros((*motion.q.shape, len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            out[:, index, k] = np.sin(20 * motion.q[:, index])
        return out


def test_a_lagging_block_takes_less_force(block) -> None:
    """5 kg behind an encoder at constant speed: `tau = -m d''`, with `d = sin(20 q)` on paper."""
    t = np.arange(0, 1, 1e-3)
    q, v = (0.1 * t)[:, None], np.full((1000, 1), 0.1)
    model = Model.of(block, [Lag(("axis",), ["N"])])
    column = model.effects[0].columns(model.motion(q, v, 0 * v, t=t))[5:-5, 0, 0]
    assert_allclose(column, 5 * (20 * 0.1) ** 2 * np.sin(20 * q[5:-5, 0]), rtol=1e-5, atol=1e-6)


def test_without_a_clock_there_is_no_force(block, rng) -> None:
    """Samples in no order have no derivative: zeros, and no demand for a mass matrix."""
    q = rng.standard_normal((20, 1))
    assert not Lag(("axis",), ["N"]).columns(Motion.of(("axis",), q, q, q)).any()


def test_second_derivative_of_a_parabola_is_constant() -> None:
    """Up to the ends."""
    t = np.arange(0, 1, 0.01)
    assert_allclose(second_derivative(np.stack([3 * t**2, t], axis=1), t), np.tile([6.0, 0.0], (100, 1)), atol=1e-8)
    assert not second_derivative(t, None).any() and not second_derivative(t[:3], t[:3]).any()


def test_a_load_that_stays_behind_leaves_the_tool_behind(rng) -> None:
    """The tool is where the loads are: `T(q - d)`, to first order, whichever cart lags."""
    robot = load_robot("gantry_tau")
    model = Model.of(robot, [Lag(("cart3", "cart1"), ["N", "N"])])
    q = robot.home + rng.uniform(-0.2, 0.2, (9, 3))
    motion = model.motion(q, 0 * q, 0 * q)
    columns = model.effects[0].tool_columns(motion, model.mechanism.tool_jacobian(q))
    lags = np.array([2e-6, -3e-6])
    d = np.sin(20 * q) * [lags[1], 0, lags[0]]
    moved = model.mechanism.tool_position(q - d) - model.mechanism.tool_position(q)
    assert_allclose(columns @ lags, moved, atol=1e-10)
    assert 1e-6 < np.abs(moved).max() < 1e-5
