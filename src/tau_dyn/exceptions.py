"""Errors as sentences: every error that a user can cause states the fault and its remedy.

The command line prints the sentence and exits with the class' `exit_status`: 2 for faulty input, 3 for data that
cannot answer, 1 for a defect of this package.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from types import UnionType
from typing import Any

MAX_MESSAGE_CHARACTERS = 1000
"""Largest length of a message; it may quote a file, whose content has any length."""


def format_one_line(text: str) -> str:
    """Return text as one printable line of bounded length: names in it must neither steer a terminal nor fill it."""
    words = " ".join(text.split())
    if len(words) > MAX_MESSAGE_CHARACTERS:
        words = f"{words[: MAX_MESSAGE_CHARACTERS - 300]} ... {words[-250:]}"
    return (
        words if words.isprintable() else "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in words)
    )


def suggest_nearest(word: str, known: Iterable[str]) -> str:
    """Return a question about the nearest known word, in brackets; case is ignored.

    It is empty if no word is near, or if only its number differs.
    """
    plain = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), plain, n=1, cutoff=0.7)
    return f" (did you mean {plain[near[0]]}?)" if near and _digits(near[0]) == _digits(word) else ""


def _sort_nearest(word: str, known: Iterable[str]) -> list[str]:
    """Return all known words: near ones first (case is ignored), then the others in their order."""

    def likeness(name: str) -> float:
        ratio = difflib.SequenceMatcher(None, name.lower(), word.lower()).ratio()
        return ratio if ratio >= _MIN_LIKENESS else 0.0

    return sorted(known, key=likeness, reverse=True)


_MIN_LIKENESS = 0.6  # as difflib takes words for close


def _digits(word: str) -> str:
    return "".join(c for c in word if c.isdigit())


class TauDynError(Exception):
    """Base of every error this package raises on purpose: a sentence with a stable code.

    Attributes:
        code: One of `message_codes.ERROR_CODES`; sentences may be reworded, codes stay.

    Example:
        >>> try:
        ...     td.Log(np.array([0.0, 0.0]), {})
        ... except td.TauDynError as fault:
        ...     print(fault.code, fault.exit_status)
        time_stamps 2
    """

    exit_status = 1

    def __init__(self, code: str, sentence: str) -> None:
        """Store the code and the sentence."""
        self.code = code
        super().__init__(sentence)

    def __str__(self) -> str:
        """Return the sentence itself (a KeyError would quote it), printable and of bounded length."""
        return format_one_line(str(self.args[0]))

    def __reduce__(self) -> tuple[Any, ...]:
        """Support transfer between processes, independent of the constructor's arguments."""
        return _restore, (type(self), self.args, self.__dict__)


def _restore(kind: type[TauDynError], args: tuple[Any, ...], state: dict[str, Any]) -> TauDynError:
    made = kind.__new__(kind, *args)
    made.__dict__.update(state)
    return made


class InputError(TauDynError, ValueError):
    """The input is invalid; the message names the place and the remedy.

    Example:
        >>> td.load_robot("gantry_tua")
        Traceback (most recent call last):
        tau_dyn.exceptions.UnknownName: ...(did you mean gantry_tau?)...
    """

    exit_status = 2


class UnknownName(InputError, KeyError):
    """A name that does not exist; the message lists the existing names, the nearest first if there are many."""

    def __init__(self, kind: str, name: object, known: Iterable[object], where: str = "", more: str = "") -> None:
        """Build the sentence from the kind of thing, the requested name, the existing names, and further advice."""
        names = [str(k) for k in known]
        listed = ", ".join(names if len(names) <= 12 else _sort_nearest(str(name), names)[:12])
        listed += f" and {len(names) - 12} more" if len(names) > 12 else ""
        there_are = f"there are {listed}" if names else "there are none"
        near = suggest_nearest(str(name), names)  # in a file a name may be a number
        sentence = f"{where + ': ' if where else ''}no {kind} named '{name}'{near}; {there_are}{more}"
        super().__init__("unknown_name", sentence)


def require_kind(value: object, kind: type | UnionType, name: str, remedy: str) -> None:
    """Refuse a value of another type.

    Args:
        value: The value.
        kind: Types that are accepted.
        name: Name of such a value, for the message.
        remedy: Advice for the message, behind "give".

    Raises:
        InputError: The value has another type.
    """
    if not isinstance(value, kind):
        raise InputError("invalid_value", f"an object of type {type(value).__name__} is no {name}; give {remedy}")


def require_names(value: object, name: str) -> None:
    """Refuse a value that is no list of names; a lone string would be taken letter by letter.

    Raises:
        InputError: The value is a string, or cannot be iterated over.
    """
    if isinstance(value, str) or not isinstance(value, Iterable):
        given = f"the string '{value}'" if isinstance(value, str) else f"an object of type {type(value).__name__}"
        raise InputError("invalid_value", f"{name} is a list of names, not {given}; write ['a', 'b']")


class LoopClosureError(InputError):
    """A kinematic loop cannot be closed at the given actuated positions."""

    def __init__(self, sentence: str) -> None:
        """Build it from its sentence."""
        super().__init__("loop_not_closed", sentence)


class CannotAnswer(TauDynError):
    """The data are sound but cannot answer the question; the error states the missing information and an experiment to get it.

    Example:
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> try:
        ...     td.identify(td.load_robot("linear_axis"), td.Log(t, {"q_axis": 0.0 * t, "tau_axis": 0.0 * t}))
        ... except td.CannotAnswer as fault:
        ...     print(fault.exit_status, bool(fault.experiment))
        3 True
    """

    exit_status = 3

    def __init__(self, code: str, missing: str, experiment: str) -> None:
        """Store both halves of the sentence: the missing information and the experiment to obtain it."""
        self.missing = missing
        self.experiment = experiment
        self.warnings: tuple[str, ...] = ()  # doubts found before the error; often its reason
        super().__init__(code, f"{missing}; {experiment}")
