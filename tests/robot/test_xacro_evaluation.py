"""What an expression in a xacro may say: lengths and conditions pass, every way from a value to Python itself is named."""

from __future__ import annotations

import pytest
from raising import raises_code

from tau_dyn.robot.xacro_evaluation import MAX_CHARACTERS, check_expression


@pytest.mark.parametrize(
    "text",
    ["2 * pi / 3", "length**2 - 0.5", "2**100", "2**-3", "10**(-100)", "limits['upper'] if wide else 0", "d.keys()",
     "text.split('_')", "[k for k in range(3)]", "_", "a_b.c_d", " mass ", "2 *", "x" * MAX_CHARACTERS],
)  # fmt: skip
def test_lengths_and_conditions_pass(text: str) -> None:
    """Bad syntax too: xacro says it better."""
    check_expression(text)


@pytest.mark.parametrize(
    "name",
    ["__class__", "__globals__", "_private", "gi_frame", "ag_frame", "cr_frame", "tb_frame", "f_back", "f_globals", "co_code",
     "func_globals", "format", "format_map", "mro", "vars", "type"],
)  # fmt: skip
def test_every_way_into_python_is_named(name: str) -> None:
    """Of a value, of what is made in a comprehension, and deep inside a sum."""
    for text in (f"x.{name}", f"[y.{name} for y in (1,)]", f"1 + (2 * (x.{name}))"):
        with raises_code("file_format", name):
            check_expression(text)


@pytest.mark.parametrize("text", ["__import__('os')", "1 if __builtins__ else 2"])
def test_names_of_pythons_own_are_refused(text: str) -> None:
    """Outermost names that begin with two underscores."""
    with raises_code("file_format", "__"):
        check_expression(text)


@pytest.mark.parametrize("text", ["2**101", "9**9**9", "2**x", "2**-101.5", "2**'a'", "1 + 2**1e9"])
def test_powers_that_would_be_computed_for_ever_are_refused(text: str) -> None:
    """An exponent is written out, and at most 100 in size."""
    with raises_code("file_format", "100", "math.pow"):
        check_expression(text)


def test_an_endless_expression_is_refused_before_it_is_parsed() -> None:
    """Ten thousand characters are enough for a length."""
    with raises_code("file_too_large", "10001", "10000"):
        check_expression("1+" * 5000 + "1")
