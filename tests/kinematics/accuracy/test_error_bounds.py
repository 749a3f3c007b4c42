"""Errors as users write them: words on the command line and files, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy import ActuatorError, RodError, read_actuator_errors, read_errors_file, read_section

CARTS = ("cart1", "cart2", "cart3")


def test_words_name_all_actuators_or_one() -> None:
    """One size is for all; a named one overrules it; a colon parts along from across."""
    found = read_actuator_errors(["50e-6", "cart2=80e-6:20e-6"], CARTS)
    assert found["cart1"] == ActuatorError(50e-6, 50e-6) and found["cart2"] == ActuatorError(80e-6, 20e-6)


def test_ellipsoid_has_its_axes_along_and_across_the_guideway() -> None:
    """The error set of 3 along and 1 across reaches 3 along a slanting guideway and 1 across it."""
    d = np.array([0.6, 0.8, 0.0])
    M = ActuatorError(3.0, 1.0).ellipsoid(d)
    assert np.allclose(np.linalg.norm(M.T @ d), 3) and np.allclose(np.linalg.norm(M.T @ np.array([-0.8, 0.6, 0])), 1)
    assert np.allclose(ActuatorError(axes=(1, 2, 3)).ellipsoid(d), np.diag([1, 2, 3]))


def test_file_names_actuators_and_rods(tmp_path: Path) -> None:
    """All forms of a size are read; a name overrules `all` wherever it stands."""
    path = tmp_path / "errors.yaml"
    path.write_text(
        "actuators:\n  cart1: {along: 1e-5, across: 2e-5}\n  all: 5e-5\n  cart3: {x: 1e-5, y: 2e-5, z: 3e-5}\n"
        "rods:\n  rod1: 1e-4\n  rod2: {base: 1e-5, plate: 2e-5}\n"
    )
    found = read_errors_file(path, CARTS, ("rod1", "rod2", "rod3"))
    assert found.actuators["cart1"] == ActuatorError(1e-5, 2e-5) and found.actuators["cart2"] == ActuatorError(
        5e-5, 5e-5
    )
    assert found.actuators["cart3"].axes == (1e-5, 2e-5, 3e-5)
    assert found.rods == {"rod1": RodError(1e-4), "rod2": RodError(0.0, 1e-5, 2e-5)}
    assert found.scaled(10).rods["rod1"].length == pytest.approx(1e-3) and found.scaled(10).actuators["cart3"].axes[
        2
    ] == pytest.approx(3e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds the mappings 'actuators' and 'rods'"),
        ("carts: {}", "holds the mappings 'actuators' and 'rods'"),
        ("actuators: {cart9: 1e-5}", "no actuated joint named 'cart9'"),
        ("actuators: {cart1: -1e-5}", "zero or a positive number"),
        ("actuators: {cart1: .nan}", "zero or a positive number"),
        ("actuators: {cart1: fifty}", "is no number"),
        ("actuators: {cart1: 50}", "not micrometres"),
        ("actuators: {cart1: {across: 1e-5}}", "one number, or along and across"),
        ("rods: {rod1: {width: 1e-5}}", "length, base and plate"),
        ("rods: [1e-5]", "mapping from each rod"),
    ],
)
def test_faulty_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    """Each fault ends in a sentence that names the file and what would be right."""
    path = tmp_path / "errors.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as fault:
        read_errors_file(path, CARTS, ("rod1",))
    assert "errors.yaml" in str(fault.value)


@pytest.mark.parametrize("words", [["cart9=1e-5"], ["nan"], ["-1e-6"], ["cart1=1e-5:x"], ["5"]])
def test_faulty_words_are_refused(words: list[str]) -> None:
    """Unknown joints, no numbers, negative and huge sizes."""
    with pytest.raises(InputError, match="--actuator-error"):
        read_actuator_errors(words, CARTS)


@pytest.mark.parametrize("text", ["x", "w=1", "x=nan", "x=far", "xy=1"])
def test_faulty_sections_are_refused(text: str) -> None:
    """A section is an axis and a finite number."""
    with raises_code("bad_option", "--section"):
        read_section(text)
    with raises_code("bad_option", "--range"):
        read_section("x=1").within(["y=1:0", "z=0:1"])
