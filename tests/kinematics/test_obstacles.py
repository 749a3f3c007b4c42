"""Obstacle files: signed distances against geometry on paper, and sentences for what is at fault."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import Surroundings, add_limits, read_surroundings
from tau_dyn.kinematics.obstacles import build_surroundings


def one(**entry: Any):
    return build_surroundings({"obstacles": [{"name": "thing", **entry}]}, "f.yaml").obstacles[0]


@pytest.mark.parametrize(
    ("entry", "point", "distance"),
    [
        ({"box": {"centre": [1, 0, 0], "size": [2, 1, 1]}}, [3.0, 0.0, 0.0], 1.0),
        ({"box": {"centre": [1, 0, 0], "size": [2, 1, 1]}}, [3.0, 1.5, 0.0], np.sqrt(2)),
        ({"box": {"centre": [1, 0, 0], "size": [2, 1, 1]}}, [1.0, 0.4, 0.0], -0.1),
        ({"box": {"centre": [0, 0, 0], "size": [2, 1, 1], "rpy": [0, 0, np.pi / 2]}}, [0.0, 2.0, 0.0], 1.0),
        ({"cylinder": {"centre": [0, 0, 0], "radius": 0.5, "height": 2}}, [1.5, 0.0, 0.0], 1.0),
        ({"cylinder": {"centre": [0, 0, 0], "radius": 0.5, "height": 2, "axis": [1, 0, 0]}}, [1.5, 0.0, 0.0], 0.5),
        ({"sphere": {"centre": [0, 0, 1], "radius": 0.25}}, [0.0, 0.0, 0.0], 0.75),
        ({"half_space": {"point": [0, 2, 0], "normal": [0, -2, 0]}}, [0.3, 1.5, 7.0], 0.5),
        ({"half_space": {"point": [0, 2, 0], "normal": [0, -2, 0]}}, [0.3, 2.5, 7.0], -0.5),
    ],
)
def test_distance_is_signed_and_exact(entry: dict[str, Any], point: list[float], distance: float) -> None:
    """The distance to a solid's surface, negative within; a half-space is solid behind its normal."""
    np.testing.assert_allclose(one(**entry).distance(np.array([point])), [distance], atol=1e-12)


BOX = {"centre": [0, 0, 0], "size": [1, 1, 1]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            {"obstacles": [{"name": "a", "box": {"centre": [0, 0, 0], "size": [1, -1, 1]}}]},
            "size must hold three numbers above",
        ),
        (
            {"obstacles": [{"name": "a", "box": {"centre": [0, 0, float("nan")], "size": [1, 1, 1]}}]},
            "centre must hold three",
        ),
        (
            {"obstacles": [{"name": "a", "sphere": {"centre": [0, 0, 0], "radius": 0}}]},
            "radius must be a number above zero",
        ),
        ({"obstacles": [{"name": "a", "cylinder": {"centre": [0, 0, 0], "radius": 1}}]}, "'height' is missing"),
        (
            {"obstacles": [{"name": "a", "half_space": {"point": [0, 0, 0], "normal": [0, 0, 0]}}]},
            "must have a direction",
        ),
        ({"obstacles": [{"name": "a", "box": BOX, "margin": -1}]}, "margin must be"),
        ({"obstacles": [{"name": "a", "box": BOX, "blocks": "arm"}]}, "blocks is robot or tool"),
        ({"obstacles": [{"name": "a", "ball": {}}]}, "exactly one of box"),
        ({"obstacles": [{"box": BOX}]}, "needs a name"),
        ({"obstacles": [{"name": "a", "box": BOX}, {"name": "a", "box": BOX}]}, "two obstacles are called 'a'"),
        ({"obstacles": {"name": "a"}}, "must be a list"),
        ({"limits": {"x": [1, 0]}}, "inverted"),
        ({"limits": {"w": [0, 1]}}, "'w' is not known"),
        ({"limits": {"x": 3}}, "two numbers"),
        (["x"], "needs a list 'obstacles'"),
        ({"obstakles": []}, "'obstakles' is not known"),
    ],
)
def test_fault_is_named(content: Any, words: str) -> None:
    """Each fault of an obstacle file is one sentence that opens with the file's name."""
    with pytest.raises(InputError, match=words) as caught:
        build_surroundings(content, "f.yaml")
    assert str(caught.value).startswith("f.yaml")


def test_file_is_read_safely(tmp_path: Path) -> None:
    """A YAML file that would run code is not valid here, and a good one gives its solids and open limits."""
    bad = tmp_path / "bad.yaml"
    bad.write_text("!!python/object/apply:os.system ['true']")
    with raises_code("file_format"):
        read_surroundings(bad)
    good = tmp_path / "good.yaml"
    good.write_text(
        "limits: {x: [-100000000000000000000, 2], z: [0.2, .inf]}\n"
        "obstacles:\n  - name: lamp\n    sphere: {centre: [1, 0, 2], radius: 0.1}\n"
    )
    around = read_surroundings(good)
    assert around.lower[2] == 0.2 and around.upper[2] == np.inf and around.lower[0] == -1e20
    assert [o.name for o in around.obstacles] == ["lamp"]


@pytest.mark.parametrize("text", ["x=1:0", "x=a:b", "w=0:1", "x", "x=nan:1", "x=1"])
def test_bad_tool_limit_is_refused(text: str) -> None:
    """A limit is an axis and two places in order."""
    with raises_code("invalid_value", "limit"):
        add_limits(Surroundings(), [text])


def test_tool_limits_meet() -> None:
    """The narrower of file and command line holds; an end may stay open."""
    around = add_limits(Surroundings(), ["x=0:2", "x=1:", "z=:0.5"])
    np.testing.assert_array_equal(around.lower, [1, -np.inf, -np.inf])
    np.testing.assert_array_equal(around.upper, [2, np.inf, 0.5])
