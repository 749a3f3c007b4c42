"""Forces that drives report otherwise than they give them, with numbers by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import DELIVERED, Motion, Scene, TorqueCrosstalk, TorqueSaturation
from tau_dyn.model import Model
from tau_dyn.simulate import Sensors, measure, move, simulate_drive

JOINTS, UNITS = ("i", "k"), ("N m", "N m")


def motion(**signals: np.ndarray) -> Motion:
    """Return two samples of two hinges."""
    still = np.zeros((2, 2))
    return Motion.of(JOINTS, still, still, still, signals=signals)


def test_a_saturated_drive_adds_the_cube_of_its_share() -> None:
    """15 % at 40 N m: 6 N m more there, an eighth of it at half the force, with the force's sign."""
    effect = TorqueSaturation(["i"], ["N m"], largest=40.0)
    parameters = effect.parameters.with_values(np.array([0.15]))
    force = effect.force(motion(**{DELIVERED: np.array([[40.0, 7.0], [-20.0, 7.0]])}), parameters)
    assert_allclose(force, [[6.0, 0.0], [-0.75, 0.0]])


def test_a_leaking_drive_adds_a_share_of_the_other_one() -> None:
    """5 % of 40 N m of joint k are 2 N m in the log of joint i; that of joint k stays."""
    effect = TorqueCrosstalk(JOINTS, UNITS)
    force = effect.force(
        motion(force=np.array([[1.0, 40.0], [1.0, -20.0]])), effect.parameters.with_values(np.array([0.05]))
    )
    assert_allclose(force, [[2.0, 0.0], [-1.0, 0.0]])
    assert effect.parameters.names == ("i.torque_crosstalk_k",)
    with raises_code("invalid_value", "torque_crosstalk"):
        TorqueCrosstalk(["i"], ["N m"])


def test_forces_leak_both_ways_between_joints_of_one_kind() -> None:
    """Two hinges and a slide: two ordered pairs; a hinge and a slide have none, and no such robot can show it."""
    one = np.ones(3)
    three = Scene(("i", "k", "s"), ("N m", "N m", "N"), -one, one, one, one, 1.0, 1.0, frozenset({"force"}))
    assert TorqueCrosstalk.groups(three) == [("i", "k"), ("k", "i")]
    two = Scene(("i", "s"), ("N m", "N"), -one[:2], one[:2], one[:2], one[:2], 1.0, 1.0, frozenset({"force"}))
    assert TorqueCrosstalk.groups(two) == [] and "no two joints" in (TorqueCrosstalk.untestable(two) or ("",))[0]


@pytest.mark.parametrize("kind", [TorqueSaturation, TorqueCrosstalk])
def test_a_simulated_drive_reports_what_the_law_makes_of_its_force(two_link, kind) -> None:
    """The log holds the law of the true force, and the robot moves as without it."""
    joints = two_link.actuated if kind is TorqueCrosstalk else two_link.actuated[:1]
    effect = kind(joints, ["N m"] * len(joints))
    effect = effect if kind is TorqueCrosstalk else effect.with_settings(largest=30.0)
    model = Model.of(two_link, [effect]).with_values({effect.parameters.names[0]: 0.2})
    moving = move(two_link.actuated, np.zeros(2), np.array([0.1, -0.1]), 0.2)
    run = simulate_drive(model, moving, None, Sensors(), np.random.default_rng(0), feedback="ideal")
    log = measure(run, Sensors(), np.random.default_rng(0))
    first, second = run.tau.T
    added = 0.2 * (second if kind is TorqueCrosstalk else first * (first / 30.0) ** 2)
    assert np.abs(added).max() > 0.01 * np.abs(first).max()
    assert_allclose(log["tau_shoulder"], first + added, rtol=1e-9)
    assert_allclose(log["tau_elbow"], second, rtol=1e-9)


def test_a_models_force_holds_the_law_of_the_rigid_force(two_link, rng) -> None:
    """A saved model predicts the log of a recording: rigid force and its cube."""
    effect = TorqueSaturation(["shoulder"], ["N m"], largest=30.0)
    model = Model.of(two_link, [effect]).with_values({"shoulder.torque_saturation": 0.1})
    q, v, a = rng.standard_normal((3, 10, 2))
    rigid = model.mechanism.inverse_dynamics(q, v, a)
    rigid[:, 0] += 0.1 * rigid[:, 0] * (rigid[:, 0] / 30.0) ** 2
    assert_allclose(model.torque(q, v, a, t=np.arange(10) * 0.01), rigid)
