"""Friction of bearings without a motor: virtual work, both directions, where it cannot be."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import NO_EXPERIMENT, Motion, PassiveJointFriction
from tau_dyn.model import Model
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def tau() -> SimpleNamespace:
    """A Gantry-Tau whose rods' joints rub, and a random motion of it."""
    robot = load_robot("gantry_tau")
    model = Model.of(robot, [PassiveJointFriction(robot.actuated, robot.force_units)])
    rng = np.random.default_rng(3)
    q = robot.home + rng.uniform(-0.2, 0.2, (25, 3))
    v = rng.standard_normal((25, 3))
    return SimpleNamespace(model=model, q=q, v=v, motion=model.motion(q, v, 0 * v))


def test_the_motors_give_the_power_that_the_bearings_take(tau) -> None:
    """Virtual work: `tau . v = sum of Fv |w|^2 + Fc |w|` over the rods."""
    values = tau.model.parameters.with_values({"passive.viscous": 3.0, "passive.coulomb": 7.0})
    force = tau.model.with_parameters(values).effect_force(tau.motion)
    _, P = tau.model.mechanism.passive_rates(tau.q)
    w = np.linalg.norm(np.einsum("nbxa,na->nbx", P, tau.v), axis=2)
    assert_allclose(np.sum(force * tau.v, axis=1), (3 * w**2 + 7 * w).sum(axis=1))
    assert w.min() > 0.01


def test_friction_reverses_with_the_motion(tau) -> None:
    """Coulomb friction keeps its size when faster and turns round with the speed; viscous friction grows with it."""
    effect = tau.model.effects[0]
    column = effect.columns(tau.motion)
    for factor in (-1.0, 2.0):
        other = effect.columns(tau.model.motion(tau.q, factor * tau.v, 0 * tau.v))
        assert_allclose(other[:, :, 0], factor * column[:, :, 0])
        assert_allclose(other[:, :, 1], np.sign(factor) * column[:, :, 1])


def test_rods_do_not_turn_when_all_carts_move_alike(tau) -> None:
    """Then the tool only translates along the guideways: no friction, and the direction is unsure for all joints."""
    v = np.full((25, 3), 0.3)
    motion = tau.model.motion(tau.q, v, 0 * v)
    effect = tau.model.effects[0]
    assert_allclose(effect.columns(motion)[:, :, 0], 0, atol=1e-12)
    for speed, joints in effect.other_speeds(motion):
        assert np.abs(speed).max() < 1e-12 and joints == [0, 1, 2]


def test_speeds_for_the_gate_are_the_joints(tau) -> None:
    """A bearing's speed counts as the joints' speeds: never above their norm, and with it."""
    speeds = np.array([speed for speed, _ in tau.model.effects[0].other_speeds(tau.motion)])
    assert speeds.shape == (3, 25)
    assert np.all(speeds <= np.linalg.norm(tau.v, axis=1))
    doubled = tau.model.motion(tau.q, 2 * tau.v, 0 * tau.v)
    assert_allclose([speed for speed, _ in tau.model.effects[0].other_speeds(doubled)], 2 * speeds)


def test_a_smoothed_sign_fades_it_out(tau) -> None:
    """Feedforward asks with small signs near standstill; friction goes to zero with them instead of chattering."""
    effect = tau.model.effects[0]
    slow = Motion.of(
        tau.motion.joints, tau.q, 1e-6 * tau.v, 0 * tau.v, np.full((25, 3), 0.1), signals=tau.motion.signals
    )
    assert_allclose(effect.columns(slow)[:, :, 1], 0.1 * effect.columns(tau.motion)[:, :, 1])
    still = Motion.of(tau.motion.joints, tau.q, 0 * tau.v, 0 * tau.v, signals=tau.motion.signals)
    assert not effect.columns(still).any()


def test_a_four_bars_hinges_share_one_coefficient(four_bar) -> None:
    """Coupler, rocker and cut rub at the crank with `sum of |rate|` per unit of Coulomb friction."""
    model = Model.of(four_bar, [PassiveJointFriction(four_bar.actuated, four_bar.force_units)])
    q, v = np.array([[0.3]]), np.array([[-2.0]])
    _, P = model.mechanism.passive_rates(q)
    rates = np.abs(P).max(axis=2)[0, :, 0]
    columns = model.effects[0].columns(model.motion(q, v, 0 * v))[0, 0]
    assert_allclose(columns, [-2 * np.sum(rates**2), -np.sum(rates)])


def test_without_loops_there_is_nothing_to_test() -> None:
    """A scene without passive joints: no group of joints, and a sentence."""
    scene = SimpleNamespace(joints=("j1", "j2"), signals=frozenset({"load"}))
    assert PassiveJointFriction.groups(scene) == []  # type: ignore[arg-type]
    why = PassiveJointFriction.untestable(scene)  # type: ignore[arg-type]
    assert why is not None and "no loops" in why[0] and why[1] == NO_EXPERIMENT
    scene.signals = frozenset({"passive"})
    assert PassiveJointFriction.groups(scene) == [("j1", "j2")]  # type: ignore[arg-type]
    assert PassiveJointFriction.untestable(scene) is None  # type: ignore[arg-type]
