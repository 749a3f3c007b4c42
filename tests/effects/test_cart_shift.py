"""Carts off their guideways: yielding to their rods, and turning as they travel, against exact forward kinematics."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import NO_EXPERIMENT, SENSITIVITY, SIDE_FORCE, CartTilt, GuidewayCompliance, Motion
from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.robot import load_robot

JOINTS = ("cart1", "cart2", "cart3")


@pytest.fixture
def tau(rng) -> SimpleNamespace:
    """L1 at rest in random places, with what shifted carts feel."""
    mechanism = GantryTauMechanism(load_robot("gantry_tau"))
    q = mechanism.robot.home + rng.uniform(-0.25, 0.25, (30, 3))
    rest = np.zeros_like(q)
    side = mechanism.guide_force(q, rest, rest)
    signals = {SENSITIVITY: mechanism.cart_sensitivity(q), SIDE_FORCE: side}
    motion = Motion.of(JOINTS, q, rest, rest, signals=signals)
    return SimpleNamespace(
        mechanism=mechanism,
        q=q,
        side=side,
        motion=motion,
        plain=mechanism.tool_position(q),
        J=mechanism.tool_jacobian(q),
    )


def test_guideways_that_yield_shift_the_tool(tau, tool_of) -> None:
    """Each cart displaced by compliance times its side load, spheres intersected anew: the columns to first order."""
    effect = GuidewayCompliance(JOINTS, ["N"] * 3)
    values = np.array([1e-7, 3e-7, 2e-7])
    moved = tool_of(tau.mechanism, tau.q, tau.side * values[:, None]) - tau.plain
    assert_allclose(effect.tool_columns(tau.motion, tau.J) @ values, moved, atol=1e-3 * np.abs(moved).max())
    assert 1e-6 < np.abs(moved).max() < 1e-3


def test_a_yielding_guideway_lets_the_load_down(tau) -> None:
    """Softer guideways under gravity lower the tool, the more the softer: mean height falls with the compliance."""
    effect = GuidewayCompliance(("cart1",), ["N"])
    down = effect.tool_columns(tau.motion, tau.J)[:, 2, 0]
    assert down.mean() < 0
    assert effect.parameters["cart1.guideway_compliance"].lower == 0
    assert effect.parameters["cart1.guideway_compliance"].unit == "m/N"


def test_a_cart_that_turns_carries_its_rods_end(tau, tool_of) -> None:
    """A wave of angle along the guideway on a lever: displacement of the rod's end, spheres intersected anew."""
    effect = CartTilt(("cart2",), ["N"], period=0.4)
    lever_sin, lever_cos = np.array([1e-6, 4e-6, -2e-6]), np.array([0.0, -3e-6, 5e-6])
    phase = 2 * np.pi * tau.q[:, 1, None] / 0.4
    u = np.zeros((30, 3, 3))
    u[:, 1] = np.sin(phase) * lever_sin + np.cos(phase) * lever_cos
    moved = tool_of(tau.mechanism, tau.q, u) - tau.plain
    columns = effect.tool_columns(tau.motion, tau.J)
    assert columns.shape == (30, 3, 6)
    assert_allclose(columns @ np.concatenate([lever_sin, lever_cos]), moved, atol=1e-9)


def test_carts_off_their_line_take_no_force(tau) -> None:
    """Micrometres change forces in second order only: zero columns, with or without the signals."""
    for effect in (GuidewayCompliance(JOINTS, ["N"] * 3), CartTilt(JOINTS, ["N"] * 3)):
        for motion in (tau.motion, Motion.of(JOINTS, tau.q, tau.q, tau.q)):
            columns = effect.columns(motion)
            assert columns.shape == (30, 3, len(effect.parameters)) and not columns.any()
        with raises_code("unsupported", "cart_sensitivity"):
            effect.tool_columns(Motion.of(JOINTS, tau.q, tau.q, tau.q), tau.J)


def test_only_carts_and_only_with_a_tool() -> None:
    """Hinges have no guideway; forces show nothing of a cart's shift; waves cover the travel."""
    scene = SimpleNamespace(joints=("slide", "hinge"), units=("N", "N m"), signals=frozenset({SENSITIVITY, SIDE_FORCE}))
    scene.low, scene.high, scene.index = np.array([0.0, 0.0]), np.array([2.0, 1.0]), scene.joints.index
    for cls in (GuidewayCompliance, CartTilt):
        assert cls.groups(scene) == [("slide",)] and cls.untestable(scene) is None  # type: ignore[arg-type]
    periods = [row["period"] for row in CartTilt.grid(scene, ("slide",))]  # type: ignore[arg-type]
    assert max(periods) == 4.0 and min(periods) == 0.5
    scene.signals = frozenset({"load"})
    why = CartTilt.untestable(scene)  # type: ignore[arg-type]
    assert why is not None and "tool" in why[0]
    scene.units = ("N m", "N m")
    why = GuidewayCompliance.untestable(scene)  # type: ignore[arg-type]
    assert why is not None and "no carts" in why[0] and why[1] == NO_EXPERIMENT  # nobody can measure along a guideway


def test_words_say_how_much() -> None:
    """Amounts with units."""
    one = GuidewayCompliance(("cart2",), ["N"])
    said = one.describe(one.parameters.with_values({"cart2.guideway_compliance": 2e-7}))
    assert said == "the cart yields across its guideway by 200 nm/N"
    two = CartTilt(("cart2",), ["N"], period=0.5)
    said = two.describe(two.parameters.with_values({"cart2.tilt_sin_y": 3e-5, "cart2.tilt_cos_z": 4e-5}))
    assert said == "the rod's end is carried off its line by 50 µm, in a wave of 500 mm along the guideway"
