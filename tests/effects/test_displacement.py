"""Encoder and load apart: the force that the load's missing acceleration takes away, and where the tool goes."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.effects import AsymmetricFriction, DisplacementEffect, Motion
from tau_dyn.effects.jointwise import differentiate_columns
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


def test_the_derivative_of_a_parabola_is_a_line() -> None:
    """Up to the ends."""
    t = np.arange(0, 1, 0.01)
    parabola = np.stack([3 * t**2, t], axis=1)
    assert_allclose(differentiate_columns(parabola, t), np.stack([6 * t, np.ones(100)], axis=1), atol=1e-8)
    assert not differentiate_columns(t, None).any() and not differentiate_columns(t[:3], t[:3]).any()


def test_a_lagging_load_weighs_and_rubs_where_it_is(rng) -> None:
    """Gantry-Tau with viscous friction: the column is the change of all forces, `tau(q - d) - tau(q)`, to first order in d."""
    robot = load_robot("gantry_tau")
    size = 1e-6
    friction = AsymmetricFriction(robot.actuated, robot.force_units)
    lag = Lag(("cart2",), ("N",))
    speeds = {f"{joint}.viscous_{side}": 400.0 for joint in robot.actuated for side in ("pos", "neg")}
    model = Model.of(robot, [friction, lag]).with_values(speeds)
    t = np.arange(0, 2, 1e-3)
    phase = rng.uniform(0, 6, 3)
    q = robot.home + 0.1 * np.sin(2 * t[:, None] + phase)
    v, a = 0.2 * np.cos(2 * t[:, None] + phase), -0.4 * np.sin(2 * t[:, None] + phase)
    column = lag.columns(model.motion(q, v, a, np.ones_like(v), t=t))[:, :, 0]
    x, dx, ddx = q[:, 1], v[:, 1], a[:, 1]
    d = np.zeros((3, *q.shape))
    d[0, :, 1] = np.sin(20 * x)
    d[1, :, 1] = 20 * np.cos(20 * x) * dx
    d[2, :, 1] = 20 * np.cos(20 * x) * ddx - 400 * np.sin(20 * x) * dx**2
    plain = model.only([friction])
    moved = plain.torque(q - size * d[0], v - size * d[1], a - size * d[2], np.ones_like(v), t=t)
    truth = (moved - plain.torque(q, v, a, np.ones_like(v), t=t)) / size
    # what M and velocity products change over a displacement is left out, at most 5 % here; without weight and friction: 90 %
    assert_allclose(column[5:-5], truth[5:-5], atol=0.05 * np.std(truth))


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
