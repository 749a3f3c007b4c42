"""Joints that stand still: what remembers a motion before there was one, and what is not tried where nothing moved."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.effects import EFFECTS, Motion, Scene, name_effect_in_errors
from tau_dyn.effects.presliding import integrate_bristle


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("still", [0, 1, 40])
def test_a_bristle_starts_on_the_other_side_of_its_first_motion(way: float, still: int) -> None:
    """As if it had just turned: -1 before a way forward, 1 before a way back, however long the joint rested before it moved."""
    q = np.concatenate([np.zeros(still), way * np.linspace(0, 5e-3, 6)])
    z = integrate_bristle(q, 1e-3)
    assert_array_equal(z[: still + 1], -way)
    assert_allclose(z[still:], way * (1 - 2 * np.exp(-np.arange(6.0))), atol=1e-12)


def test_a_bristle_that_turns_at_once_starts_by_its_first_step() -> None:
    """One step of a distance forward, then back: -1, `1 - 2 / e`, `(2 - 2 / e) / e - 1`; rest in between keeps it."""
    z = integrate_bristle(np.array([0.0, 1.0, 1.0, 1.0, 0.0]), 1.0)
    turned = 1 - 2 * np.exp(-1)
    assert_allclose(z, [-1, turned, turned, turned, (1 + turned) * np.exp(-1) - 1], atol=1e-12)
    assert_array_equal(integrate_bristle(np.zeros(5), 1e-3), 0)


def test_a_bristle_forgets_over_a_long_way(rng) -> None:
    """Hundreds of distances in one recording, and far beyond in single steps: no number overflows."""
    q = np.cumsum(np.where(rng.random(4000) < 0.5, 1.0, -1.0) * rng.exponential(0.7, 4000))
    z = integrate_bristle(q, 1.0)
    now = z[0]
    for k, dq in enumerate(np.diff(q)):
        now = np.sign(dq) - (np.sign(dq) - now) * np.exp(-abs(dq))
        assert abs(z[k + 1] - now) < 1e-9
    assert_allclose(integrate_bristle(np.array([0.0, 1e3, -1e4]), 1.0), [-1, 1, -1], atol=1e-12)


NEEDS_A_WAY = [
    "backlash",
    "hysteresis",
    "cyclic_ripple",
    "transmission_error",
    "position_friction",
    "cart_tilt",
    "stribeck",
]


def scene(travel: float) -> Scene:
    """Return one slide that travelled so far, at speeds in proportion, of which a recording of two minutes was made."""
    way, one = np.array([travel]), np.ones(1)
    return Scene(("x",), ("N",), 0 * one, way, 0.01 * way, way, 60.0, 120.0)


@pytest.mark.parametrize("name", NEEDS_A_WAY)
def test_nothing_is_tried_of_a_joint_that_stood_still(name: str) -> None:
    """A length of nothing is no setting; of a joint that moved there are some, each of which makes an effect."""
    cls = EFFECTS[name]
    assert cls.grid(scene(0.0), ("x",)) == []
    grid = cls.grid(scene(0.5), ("x",))
    assert grid and all(cls(["x"], ["N"], **settings).settings for settings in grid)  # type: ignore[arg-type]


def test_a_motion_too_poor_names_who_feels_what() -> None:
    """The motion does not know who asks; whoever asks an effect through `naming` says so, and keeps the first fault."""
    rest = Motion.of(("x",), *np.zeros((3, 4, 1)))
    effect = EFFECTS["load_friction"](["x"], ["N"])
    with raises_code("unsupported", "load_friction") as fault:
        with name_effect_in_errors(effect):
            effect.columns(rest)
    assert str(fault.value.__cause__) == "this effect feels load, which the motion does not give"
    with pytest.raises(KeyError), name_effect_in_errors(effect):
        raise KeyError("not ours")
