"""Dimensions by name: `--set` builds a family of robots at other lengths, and refuses in a sentence what is no dimension."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.mechanism import build_rods, forward_kinematics
from tau_dyn.robot import describe_robot, list_dimensions, list_robot_names, load_robot, read_dimensions_file

ALIASES = [", ".join([f"*{letter}"] * 10) for letter in "abcdef"]
BOMB = "a: &a [1]\n" + "\n".join(f"{n}: &{n} [{inside}]" for n, inside in zip("bcdefg", ALIASES, strict=True))
"""A list of lists by aliases, a million numbers once written out."""
LENGTH = "simplified.arms.1.rods.1.length"


def find_home(robot) -> np.ndarray:
    """Return the tool's position at home (3,) [m]."""
    return forward_kinematics(robot, robot.home[None]).poses.position[0]


@pytest.mark.parametrize("name", list_robot_names())
def test_every_listed_dimension_may_be_given(name: str) -> None:
    """A robot built from all its listed arguments and dimensions is the robot itself: same tree, masses and loops."""
    path = list_robot_names()[name]
    given = list_dimensions(path)
    plain, again = load_robot(name), load_robot(name, **given)
    assert given and all(value == "" or value for value in given.values())
    assert_allclose(again.home, plain.home, atol=1e-15)
    for a, b in zip(again.model.jointPlacements, plain.model.jointPlacements, strict=True):
        assert_allclose(a.homogeneous, b.homogeneous, atol=1e-15)
    assert_allclose([p.value for p in again.parameters], [p.value for p in plain.parameters], atol=1e-15)
    assert [loop.name for loop in again.loops] == [loop.name for loop in plain.loops]


@pytest.mark.parametrize(
    ("name", "dimension"),
    [
        ("delta", "arm_length=0.3"),
        ("triglide", "rod_length=0.8"), ("h4", "middle=0.1"), ("stewart", "top=0.3"),
        ("hexaglide", "arms.2.on_plate.1=-0.06"), ("hexarot", "arms.1.z=1.15"), ("hexa_321", "front=0.12"),
        ("scara_tau", "arms.1.z=1.25"),
        ("gantry_tau_f1", "arm2.rods.1.length=1.52"), ("gantry_tau_t2", "home.tool.2=-0.16"),
        ("gantry_tau_5dof", "complete.arms.1.origin.3=1.5"), ("gantry_tau_queensland", "complete.arms.2.origin.2=-1.4"),
    ],
)  # fmt: skip
def test_every_family_closes_at_other_dimensions(name: str, dimension: str) -> None:
    """With one dimension changed the loops close at home, and the robot is another one."""
    key, _, value = dimension.partition("=")
    plain, changed = load_robot(name), load_robot(name, **{key: value})
    assert changed.arguments == {key: value} and changed.urdf != plain.urdf
    assert np.isfinite(find_home(changed)).all()


def test_a_longer_rod_lowers_the_delta() -> None:
    """At home the plate hangs sqrt(L^2 - out^2) under the arms' ends, and out does not depend on L."""
    out = 0.2 + 0.235 * np.cos(-0.35) - 0.05
    for length in (0.8, 0.9):
        height = 0.235 * np.sin(-0.35) - np.sqrt(length**2 - out**2)
        assert find_home(load_robot("delta", rod_length=length))[2] == pytest.approx(height, abs=1e-12)


def test_an_entry_of_a_table_and_its_aliases() -> None:
    """The L1's first rod is one length in Table 5.7: given for simplified arms it holds for complete ones; others stay."""
    for arms in ("simplified", "complete"):
        lengths = build_rods(load_robot("gantry_tau", arms=arms, **{LENGTH: 2.1})).lengths
        assert_allclose(lengths, [2.1, 1.82, 1.81] if arms == "simplified" else [2.1, 1.82, 1.82, 1.81, 1.81, 1.81])
    moved = load_robot("gantry_tau", **{"home.tool": "[1.7, -0.5, 0.8]"})
    assert_allclose(find_home(moved), [1.7, -0.5, 0.8], atol=1e-12)


def test_a_file_of_dimensions(tmp_path: Path) -> None:
    """A file says the same as its entries one by one, --set NAME=VALUE counts before it, and the result names the file."""
    file, result = tmp_path / "mine.yaml", tmp_path / "r.json"
    file.write_text(
        "arms: complete\nhome: {tool: [1.7, -0.5, 0.8]}\nsimplified: {arms: {1: {rods: {1: {length: 2.1}}}}}\n"
    )
    assert read_dimensions_file(file) == {"arms": "complete", "home.tool": "[1.7, -0.5, 0.8]", LENGTH: "2.1"}
    argv = ["fk", "gantry_tau", "--q", "0", "0", "0.1", "--quiet", "--json", str(result)]
    assert main([*argv, "--set", str(file)]) == 0
    written = json.loads(result.read_text())
    assert [Path(i["path"]).name for i in written["inputs"]] == ["gantry_tau.urdf.xacro", "mine.yaml"]
    robot = load_robot("gantry_tau", arms="complete", **{"home.tool": "[1.7, -0.5, 0.8]", LENGTH: 2.1})
    expected = forward_kinematics(robot, np.array([[0, 0, 0.1]])).poses.position[0]
    assert_allclose(written["rows"][0]["position"], expected, atol=1e-12)
    assert main([*argv, "--set", f"{LENGTH}=2.05", "--set", str(file)]) == 0
    assert json.loads(result.read_text())["rows"][0]["position"] != written["rows"][0]["position"]


def test_robots_lists_what_may_be_set(capsys, tmp_path: Path) -> None:
    """The command lists arguments and table entries with the values that they have."""
    result = tmp_path / "r.json"
    argv = ["robots", "gantry_tau", "--set", "prototype=d1", "--json", str(result)]
    assert main(argv) == 0 and "carts.travel" in capsys.readouterr().out
    rows = {row["name"]: row["value"] for row in json.loads(result.read_text())["dimensions"]}
    assert (
        rows["prototype"] == "d1"
        and float(rows[LENGTH]) == build_rods(load_robot("gantry_tau", prototype="d1")).lengths[0]
    )
    assert main(["robots", "--set", "prototype=d1"]) == 2


def test_a_robot_is_listed_with_its_joints_and_bodies(capsys) -> None:
    """A UR5 has no dimensions to set; each joint stands on one line with kind and limits, each body with its mass."""
    assert main(["robots", "ur5"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert "shoulder_pan_joint revolute −6.28 … 6.28 rad 3.15 rad/s 150 N m" in lines
    assert "upper_arm_link 8.393 kg" in lines


def test_a_description_ends_with_its_sentence_and_keeps_brackets_whole() -> None:
    """`(section III, Fig. 3, Table 2)` and `(.., Hovland 2007a; thesis 2.2)` are not cut at the dot and the semicolon."""
    names = list_robot_names()
    assert describe_robot(names["parallelogram"]).endswith("(section III, Fig. 3, Table 2)")
    assert describe_robot(names["gantry_tau_queensland"]).endswith("Hovland 2007a; thesis 2.2)")
    assert describe_robot(names["delta"]) == "Delta"


@pytest.mark.parametrize(
    ("name", "given", "code"),
    [
        ("delta", {"rod_lenght": "0.8"}, "unknown_name"),
        ("delta", {"rod_length": "abc"}, "invalid_value"),
        ("delta", {"rod_length": "${1+1}"}, "invalid_value"),
        ("delta", {"rod_length": "nan"}, "invalid_value"),
        ("delta", {"rod_length": "1e999"}, "invalid_value"),
        ("delta", {"rod_length": "1_0"}, "invalid_value"),
        ("delta", {"rod_length": "-0.8"}, "invalid_value"),
        ("delta", {"rod_length": "0.1"}, "file_format"),
        ("delta", {"rod_length.x": "1"}, "unknown_name"),
        ("gantry_tau", {"protoype": "d1"}, "unknown_name"),
        ("gantry_tau", {"simplified.arms.1.rods.1.len": "2"}, "unknown_name"),
        ("gantry_tau", {"simplified.arms.0.origin": "[0, 0, 0]"}, "unknown_name"),
        ("gantry_tau", {"simplified.arms.-1.origin": "[0, 0, 0]"}, "unknown_name"),
        ("gantry_tau", {"__class__.__mro__": "1"}, "unknown_name"),
        ("gantry_tau", {"carts": "1"}, "invalid_value"),
        ("gantry_tau", {"carts.travel": "inf"}, "invalid_value"),
        ("gantry_tau", {"carts.travel": "__import__('os')"}, "invalid_value"),
        ("gantry_tau", {"simplified.arms.1.origin": "[0, 0]"}, "invalid_value"),
        ("gantry_tau", {"simplified.arms.1.rods.1.name": "<x/>"}, "invalid_value"),
    ],
)
def test_what_is_no_dimension_is_refused(name: str, given: dict[str, str], code: str) -> None:
    """Unknown names, texts, infinite and negative numbers and lists of another length end in one sentence with a code."""
    with raises_code(code) as caught:
        load_robot(name, **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "file_format"),
        ("- 1\n- 2\n", "file_format"),
        ("a: !!python/object/apply:os.system [echo]\n", "file_format"),
        ("'a b': 1\n", "file_format"),
        ("a: {b: null}\n", "file_format"),
        ("a: &a [*a]\n", "file_format"),
        (BOMB, "file_format"),
        ("\n".join(f"n{k}: 1" for k in range(1001)), "file_too_large"),
    ],
)  # fmt: skip
def test_hostile_files_of_dimensions(text: str, code: str, tmp_path: Path) -> None:
    """No code, no null, no endless aliases, no thousand entries: a sentence each."""
    file = tmp_path / "d.yaml"
    file.write_text(text)
    with raises_code(code):
        read_dimensions_file(file)
