"""Ours and somebody else's xacro in one process do not change each other."""

from __future__ import annotations

from pathlib import Path

import pytest
import xacro
import yaml
from raising import raises_code
from xacro import substitution_args

from tau_dyn.robot import load_robot

HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
INERTIA = '<mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LINK = f'<link name="base"><inertial>{INERTIA}</inertial></link>'


def written(folder: Path, mass: str, table: str = "m: 1") -> Path:
    """Return a xacro with a body of that mass, and a table beside it."""
    (folder / "table.yaml").write_text(table)
    path = folder / "robot.urdf.xacro"
    joint = (
        '<link name="end"/><joint name="j" type="revolute"><parent link="base"/><child link="end"/><axis xyz="0 0 1"/>'
    )
    joint += '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    path.write_text(f"{HEAD}{LINK.format(mass=mass)}{joint}</robot>")
    return path


def test_an_expansion_leaves_the_installed_xacro_and_yaml_as_they_are(tmp_path) -> None:
    """Functions, symbols and the safe loader's tags."""
    ours = (xacro.safe_eval, xacro.parse, xacro.load_yaml, substitution_args._eval)
    tags = dict(yaml.SafeLoader.yaml_constructors)
    load_robot(written(tmp_path, "${xacro.load_yaml('table.yaml').m}", "m: !millimeters 2000"))
    assert (xacro.safe_eval, xacro.parse, xacro.load_yaml, substitution_args._eval) == ours
    assert "type" in xacro._global_symbols["python"]
    assert yaml.SafeLoader.yaml_constructors == tags


@pytest.mark.parametrize(
    "mass", ["${().__class__}", "$(eval ().__class__)", "${python.vars(python)}", "${python.type(1)}"]
)
def test_a_foreign_xacro_that_lets_all_pass_opens_nothing_here(tmp_path, monkeypatch, mass: str) -> None:
    """Whoever replaces the installed one's functions has not replaced ours."""
    monkeypatch.setattr(xacro, "safe_eval", lambda text, *more: 1.0)
    monkeypatch.setattr(substitution_args, "_eval", lambda text, *more: "1")
    with raises_code("file_format"):
        load_robot(written(tmp_path, mass))


def test_the_units_of_a_table_are_expressions_of_ours(tmp_path, monkeypatch) -> None:
    """A foreign constructor of the safe loader evaluates nothing of our tables, and what a unit may not say is refused."""
    monkeypatch.setitem(yaml.SafeLoader.yaml_constructors, "!millimeters", lambda loader, node: 7.0)
    robot = load_robot(written(tmp_path, "${xacro.load_yaml('table.yaml').m}", "m: !millimeters 1000 * 2"))
    assert robot.urdf.count('value="2.0"') == 1
    with raises_code("file_format", "__class__"):
        load_robot(written(tmp_path, "${xacro.load_yaml('table.yaml').m}", "m: !millimeters ().__class__"))
