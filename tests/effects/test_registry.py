"""Effects from outside: what may be registered, and the sentence for what may not."""

from __future__ import annotations

import pytest
from raising import raises_code

from tau_dyn.effects import EFFECTS, Effect, JointwiseEffect, QuadraticDrag, Stribeck, register
from tau_dyn.exceptions import InputError


@pytest.fixture(autouse=True)
def as_before():
    """Leave the register as it was."""
    before = dict(EFFECTS)
    yield
    EFFECTS.clear()
    EFFECTS.update(before)


def made(name: str = "bellows", **attributes) -> type[Effect]:
    """Return a class of one's own, `k q`."""
    body = {"name": name, "quantities": (("k", "F/Q"),), "per_joint": lambda self, joint: [joint.q], **attributes}
    return type("Bellows", (JointwiseEffect,), body)


def test_a_class_of_ones_own_is_known_and_may_come_again():
    """A notebook's cell that is run twice replaces its class; the decorator hands the class back."""
    first, second = made(), made()
    assert register(first) is first and EFFECTS["bellows"] is first
    assert register(first) is first
    register(second)
    assert EFFECTS["bellows"] is second


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (dict, "is no effect"),
        (Effect, "is no effect"),
        (made("Bad Name"), "needs a name of small letters"),
        (type("Other", (QuadraticDrag,), {"name": "stribeck"}), "there is an effect 'stribeck' already"),
        (made(cause=True), "has no equation, which"),
        (made(cause=True, equation="tau += k q"), "has no reveals, which"),
    ],
)
def test_what_cannot_be_registered_is_refused(effect, said):
    """One sentence each, and the register stays as it was."""
    before = dict(EFFECTS)
    with pytest.raises(InputError, match=said):
        register(effect)
    assert before == EFFECTS


def test_ours_is_not_replaced_by_a_namesake():
    """A class outside that is called like ours, name and class alike, is still not ours."""
    with raises_code("unsupported", "already"):
        register(type("Stribeck", (Stribeck,), {}))
