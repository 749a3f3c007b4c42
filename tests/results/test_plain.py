"""Results as plain data: what JSON knows, and nothing that it would choke on."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.results import to_plain


class Colour(Enum):
    """A name with a value."""

    RED = "red"


@dataclass(frozen=True)
class Inner:
    """A number that may be none."""

    value: float


@dataclass(frozen=True)
class Outer:
    """One of everything."""

    name: str = "a"
    inner: Inner = field(default_factory=lambda: Inner(float("nan")))
    array: np.ndarray = field(default_factory=lambda: np.array([[1.0, np.inf], [2.0, 3.0]]))
    shape: complex = 1 + 2j
    colour: Colour = Colour.RED
    path: Path = Path("a/b.csv")
    some: frozenset[str] = frozenset({"b", "a"})
    table: dict[str, tuple[int, ...]] = field(default_factory=lambda: {"x": (1, 2)})
    flag: np.bool_ = field(default_factory=lambda: np.bool_(True))


class Told:
    """A value that says itself what it is."""

    def to_dict(self) -> dict[str, float]:
        """Return its data."""
        return {"x": float("inf")}


def test_a_result_becomes_what_json_knows():
    """Arrays become lists, NaN and infinity null, enums and paths their text, sets sorted lists; it survives strict JSON."""
    plain = to_plain(Outer())
    assert plain == {
        "name": "a", "inner": {"value": None}, "array": [[1.0, None], [2.0, 3.0]], "shape": {"re": 1.0, "im": 2.0},
        "colour": "red", "path": "a/b.csv", "some": ["a", "b"], "table": {"x": [1, 2]}, "flag": True,
    }  # fmt: skip
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


def test_fields_can_be_left_out_and_values_speak_for_themselves():
    """Only the outermost fields are left out; a `to_dict` is asked, and its own gaps are null."""
    assert set(to_plain(Outer(), leave_out=["array", "table"])) == {
        "name", "inner", "shape", "colour", "path", "some", "flag"
    }  # fmt: skip
    assert to_plain([Told()]) == [{"x": None}]


def test_what_is_no_data_is_refused():
    """A function has no place in a result."""
    with pytest.raises(TypeError, match="function is no data"):
        to_plain({"f": lambda: None})
