"""What an expression in a xacro may say: sums and conditions, nothing that leads from a value to Python itself.

xacro evaluates `${...}` and `$(eval ...)` with Python's own `eval`, hides the builtins and looks at the outermost names for
double underscores. That is no wall: a comprehension hides names from it, `vars(type)` and a generator's frame lead around it.
Here the whole expression is looked at before xacro may evaluate it. Time and memory are not bounded, and a xacro may read
files and the environment: docs/results/robustness.md lists what remains.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import xacro
from xacro import substitution_args

from tau_dyn.exceptions import InputError

_FORBIDDEN = frozenset({"vars", "type", "format", "format_map", "mro"})
_INSIDES = ("_", "gi_", "ag_", "cr_", "tb_", "f_", "co_", "func_")
"""How attributes begin that lead into objects, generators, frames, code and functions."""

_MAX_EXPONENT = 100  # of a constant power; larger ones only cost time and memory

MAX_CHARACTERS = 10_000
"""Characters of an expression; the parser of longer ones may use up the stack."""


def check_expression(text: str) -> None:
    """Refuse an expression that reaches for more than values.

    Raises:
        InputError: It names what leads to Python itself, or is longer than any sensible one. Bad syntax passes: xacro says it.
    """
    if len(text) > MAX_CHARACTERS:
        raise InputError(
            "file_too_large", f"an expression of {len(text)} characters; at most {MAX_CHARACTERS} are evaluated"
        )
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if (name := _named(node)) and (name in _FORBIDDEN or name.startswith(_INSIDES)) and name != "_":
            raise InputError("file_format", f"the expression '{' '.join(text.split())[:80]}' may not use {name}")
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and not _small(node.right):
            said = f"the expression '{' '.join(text.split())[:80]}' raises to a power that is no number up to {_MAX_EXPONENT}"
            raise InputError("file_format", f"{said}; math.pow does")


def _small(power: ast.expr) -> bool:
    """Tell whether an exponent is written out and small: 9**9**9 would be computed to its last digit."""
    power = power.operand if isinstance(power, ast.UnaryOp) else power
    return isinstance(power, ast.Constant) and isinstance(power.value, int | float) and power.value <= _MAX_EXPONENT


def _named(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) and node.id.startswith("__") else ""


@contextmanager
def restrict_expressions() -> Iterator[None]:
    """Let xacro evaluate only what `check_expression` lets pass, and hide `vars` and `type` from it altogether."""
    symbols: Any = dict.__getitem__(xacro._global_symbols, "python")
    hidden = {name: dict.pop(symbols, name) for name in ("vars", "type") if name in symbols}
    evaluate, substitute = xacro.safe_eval, substitution_args._eval
    xacro.safe_eval, substitution_args._eval = _after_check(evaluate), _after_check(substitute)
    try:
        yield
    finally:
        xacro.safe_eval, substitution_args._eval = evaluate, substitute
        dict.update(symbols, hidden)


def _after_check(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    def checked(text: str, *more: Any) -> Any:
        check_expression(text)
        return evaluate(text, *more)

    return checked
