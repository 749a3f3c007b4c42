"""Quantities that outputs measure, from the names of their columns: displacement, velocity or acceleration, also in g."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tau_dyn.log import split_words

STANDARD_GRAVITY = 9.80665  # [m/s^2]
_BEGINNINGS = {"acc": "acceleration", "vel": "velocity", "disp": "displacement", "pos": "displacement"}
_LETTERS = {"a": "acceleration", "v": "velocity", "x": "displacement", "y": "displacement", "z": "displacement"}
_AXES = "xyz"


@dataclass(frozen=True)
class SensorKind:
    """Quantity that outputs measure.

    Attributes:
        kind: `displacement`, `velocity` or `acceleration`; `auto` if the names do not state it.
        unit: Size of their unit in SI, 1 unless they are accelerations in g.
    """

    kind: str
    unit: float = 1.0


DISPLACEMENT = SensorKind("displacement")


def find_sensor_kind(outputs: Sequence[str], asked: str = "auto") -> SensorKind:
    """Return the quantity that outputs measure: as requested, or as their names state (`acc1_g`, `ax_tool`, `x_tool`)."""
    kinds = {_find_kind(split_words(name)) for name in outputs}
    kind = asked if asked != "auto" or len(kinds) > 1 else kinds.pop()
    in_g = kind == "acceleration" and all("g" in split_words(name)[1:] for name in outputs)
    return SensorKind(kind, STANDARD_GRAVITY if in_g else 1.0)


def _find_kind(words: tuple[str, ...]) -> str:
    first = words[0] if words else ""
    found = next((kind for start, kind in _BEGINNINGS.items() if first.startswith(start)), "auto")
    is_axis = len(first) == 1 or (len(first) == 2 and first[0] in "av" and first[1] in _AXES)
    return _LETTERS.get(first[0], found) if first and is_axis else found
