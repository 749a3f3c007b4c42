"""Names to numbers and back."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.parameters import Parameter, Parameters


@pytest.fixture
def some() -> Parameters:
    """A mass, a fixed drive inertia and a friction."""
    return Parameters(
        [
            Parameter("a_link.mass", 2.0, "kg", 0.0, prior_stderr=0.04),
            Parameter("a.armature", 0.0, "kg", 0.0, free=False),
            Parameter("a.coulomb", 5.0, "N", 0.0, 9.0, stderr=0.1, origin="estimate"),
        ]
    )


def test_a_vector_and_its_names_are_one_thing(some) -> None:
    """Values by name, by order, and back."""
    assert some.names == ("a_link.mass", "a.armature", "a.coulomb")
    assert_allclose(some.values, [2, 0, 5])
    assert some.free.tolist() == [True, False, True]
    assert_allclose(some.with_values(np.array([1.0, 2.0, 3.0])).values, [1, 2, 3])
    changed = some.with_values({"a.coulomb": 6.0})
    assert changed["a.coulomb"].value == 6.0 and some["a.coulomb"].value == 5.0
    assert changed["a.coulomb"].upper == 9.0


def test_patterns_select_and_an_unmatched_one_is_an_error(some) -> None:
    """`*.armature` is how the command line names many."""
    assert some.match("a.*") == ("a.armature", "a.coulomb")
    assert some.select(["a.coulomb", "a_link.mass"]).names == ("a.coulomb", "a_link.mass")
    for wrong in (lambda: some.match("*.viscous"), lambda: some["b"], lambda: some.with_values({"b": 1.0})):
        with raises_code("unknown_name", "a_link.mass", "a.armature", "a.coulomb"):
            wrong()


def test_a_part_is_taken_by_pattern_place_or_slice(some) -> None:
    """A part of a table is a table, and its data frame holds its values."""
    assert some.select("*.mass").names == some[:1].names == ("a_link.mass",)
    assert some.select(["a.*", "a_link.mass", "a.armature"]).names == ("a.armature", "a.coulomb", "a_link.mass")
    assert some[-1] == some["a.coulomb"]
    frame = some[1:].to_pandas()
    assert frame["name"].tolist() == ["a.armature", "a.coulomb"] and frame["value"].tolist() == [0.0, 5.0]
    assert some.select([]).to_pandas().empty


def test_a_table_prints_a_line_a_parameter(some) -> None:
    """Name and value with standard error, ten lines at most; names and values are those of the data frame."""
    head, *rows = repr(some).splitlines()
    assert head == "Parameters: 3 parameters" and rows[2].split() == ["a.coulomb", "5.00", "±", "0.10", "N"]
    many = Parameters(Parameter(f"p{k}", k, "kg") for k in range(40))
    assert len(repr(many).splitlines()) == 11 and repr(many).endswith("and 31 more")


def test_a_list_of_plain_rows_keeps_everything(some) -> None:
    """What goes into a model file comes back equal, infinite bounds included."""
    assert list(Parameters.from_list(some.to_list())) == list(some)


def test_numbers_no_solver_could_start_from_are_refused() -> None:
    """NaN, crossed bounds, a name twice, a vector of the wrong length."""
    with raises_code("invalid_value"):
        Parameter("x", np.nan, "kg")
    with raises_code("invalid_value", "2.0", "1.0"):
        Parameter("x", 1.0, "kg", 2.0, 1.0)
    with raises_code("duplicate_name"):
        Parameters([Parameter("x", 1.0, "kg"), Parameter("x", 2.0, "kg")])
    with raises_code("wrong_shape", "1"):
        Parameters([Parameter("x", 1.0, "kg")]).with_values(np.zeros(2))


def test_a_file_holds_no_number_beyond_all_units() -> None:
    """A mass of 1e300 kg is no mass; squared it would be none of a computer's numbers."""
    with raises_code("invalid_value", "link.mass"):
        Parameters.from_list([{"name": "link.mass", "value": -1e300, "unit": "kg"}], "model.yaml")


def test_a_value_on_its_bound_says_so(some) -> None:
    """Reports need to tell an estimate from a wall."""
    assert some["a.armature"].at_bound and not some["a.coulomb"].at_bound
    assert some.with_values({"a.coulomb": 9.0})["a.coulomb"].at_bound
