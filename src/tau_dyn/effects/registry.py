"""Which effects exist: those of this package, and those that a program adds from outside by `register`.

    @tau_dyn.effects.register
    class Bellows(JointwiseEffect): ...

From then on model files, effect files, `simulate` and `diagnose` know it by its name, as they know ours. Nothing is searched for
and no file is run by itself: a program that loads a model with an effect of its own imports the module that registers it first.
"""

from __future__ import annotations

import re
from inspect import isabstract
from typing import TypeVar

from tau_dyn.effects.effect import Effect
from tau_dyn.exceptions import InputError

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by the name model files use, causes in the order in which they are listed."""

_SAID_BY_A_CAUSE = ("equation", "reveals")
E = TypeVar("E", bound=type[Effect])


def register(effect: E) -> E:
    """Make an effect known by its name, and return it, so that it serves as a decorator.

    A class of your own may come again under its name, as it does where a notebook's cell is run twice; the last one counts.

    Raises:
        InputError: It is no effect that can be built, its name is no name or another effect's, or it is a cause and does not say
            by which equation it acts and which motion reveals it.
    """
    name = getattr(effect, "name", None)
    if not (isinstance(effect, type) and issubclass(effect, Effect)) or isabstract(effect):
        raise InputError(
            "invalid_value",
            f"{effect!r} is no effect: derive it from Effect or JointwiseEffect, with all that they leave open",
        )
    if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise InputError(
            "invalid_value", f"effect {effect.__name__} needs a name of small letters, digits and _, not {name!r}"
        )
    known = EFFECTS.get(name)
    if known is not None and not _again(known, effect):
        raise InputError(
            "unsupported",
            f"there is an effect '{name}' already, {known.__module__}.{known.__qualname__}; name yours otherwise",
        )
    missing = [key for key in _SAID_BY_A_CAUSE if effect.cause and not getattr(effect, key, "")]
    if missing:
        raise InputError(
            "invalid_value", f"effect {name} is a cause and has no {missing[0]}, which the answer tells people"
        )
    EFFECTS[name] = effect
    return effect


def _again(known: type[Effect], effect: type[Effect]) -> bool:
    """Whether this is a class from outside once more, such as a notebook's cell that is run again."""
    ours = known.__module__.startswith("tau_dyn.")
    return known is effect or (known.__qualname__ == effect.__qualname__ and not ours)
