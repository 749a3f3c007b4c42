"""A private copy of xacro whose expressions may compute sums and conditions but have no access to Python itself.

xacro evaluates `${...}` and `$(eval ...)` with Python's own `eval`, hides the builtins and checks the outermost names for
double underscores. That is not a safe barrier: a comprehension hides names from it, and `vars(type)` or a generator's frame
bypass it. Here the whole expression is checked before xacro may evaluate it. Time and memory are not bounded, and a xacro may
read files and the environment: docs/results/robustness.md lists the remaining risks.

The copy is loaded from xacro's files under a private module name and restricted once. So another user of xacro in the same
process does not change this copy, and this copy does not change theirs: neither the functions, nor the symbols, nor the tags of
PyYAML's safe loader, to which xacro adds its units.
"""

from __future__ import annotations

import ast
import sys
import threading
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any
from xml.dom.minidom import Document

import yaml

from tau_dyn.exceptions import InputError

_NAME = "tau_dyn.robot._restricted_xacro"
_LOCK = threading.Lock()  # xacro keeps its state in module globals

_FORBIDDEN = frozenset({"vars", "type", "format", "format_map", "mro"})
_INSIDES = ("_", "gi_", "ag_", "cr_", "tb_", "f_", "co_", "func_")
"""Prefixes of attributes that give access to objects, generators, frames, code and functions."""

_MAX_EXPONENT = 100  # largest exponent of a constant power; larger ones only take time and memory

MAX_CHARACTERS = 10_000
"""Largest number of characters of an expression; longer ones may overflow the parser's stack."""


def check_expression(text: str) -> None:
    """Reject an expression that accesses more than values.

    Raises:
        InputError: It names something that gives access to Python itself, or is too long to be sensible. Bad syntax passes:
            xacro reports it.
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
    """Return whether an exponent is a small literal: 9**9**9 would be computed to its last digit."""
    power = power.operand if isinstance(power, ast.UnaryOp) else power
    return isinstance(power, ast.Constant) and isinstance(power.value, int | float) and power.value <= _MAX_EXPONENT


def _named(node: ast.AST) -> str:
    if isinstance(node, ast.Attribute):
        return node.attr
    return node.id if isinstance(node, ast.Name) and node.id.startswith("__") else ""


def evaluate_xacro(
    document: Document,
    path: Path,
    arguments: Mapping[str, str],
    parse: Callable[..., Document],
    read_table: Callable[[str], str],
    find: Callable[[str], str],
) -> None:
    """Evaluate a xacro in place.

    Args:
        document: The parsed file.
        path: Path of the file; included files and tables are searched in its folder.
        arguments: Values of its arguments, by name.
        parse: Parses an included file, named by `filename`.
        read_table: Returns the text of a YAML table that the file loads.
        find: Returns the folder of a ROS package.

    Raises:
        InputError: An expression accesses more than values.
        Exception: Whatever an expression, a parser or a table raises.
    """
    with _LOCK:
        xacro = _load_restricted_xacro()
        xacro.parse, xacro.read_table = parse, read_table
        substitution: Any = import_module(f"{_NAME}.substitution_args")
        substitution._eval_find = substitution._eval_dict["find"] = find
        xacro.init_stacks(str(path))
        xacro.process_doc(document, mappings=dict(arguments))


@cache
def _load_restricted_xacro() -> Any:
    """Return a silent copy of xacro that evaluates only expressions accepted by `check_expression`, without `vars` and `type`."""
    installed = find_spec("xacro")
    assert installed is not None and installed.origin is not None  # a dependency of this package
    own = spec_from_file_location(
        _NAME, installed.origin, submodule_search_locations=list(installed.submodule_search_locations or ())
    )
    assert own is not None and own.loader is not None
    xacro: Any = module_from_spec(own)
    sys.modules[_NAME] = xacro  # its own modules import it from there
    own.loader.exec_module(xacro)
    substitution: Any = import_module(f"{_NAME}.substitution_args")
    xacro.safe_eval, substitution._eval = _after_check(xacro.safe_eval), _after_check(substitution._eval)
    for said in ("error", "message", "warning", "print_location"):
        setattr(xacro, said, lambda *text, **how: None)

    class TableLoader(yaml.SafeLoader):
        """PyYAML's safe loader with xacro's units, in a separate table."""

        yaml_constructors = yaml.SafeLoader.yaml_constructors.copy()

    for unit in xacro.ConstructUnits:
        TableLoader.add_constructor(unit.value.tag, unit.constructor)

    def load_yaml(filename: str) -> Any:
        """Return a table as xacro wraps it; its units are expressions of the file on top of the stack."""
        found = xacro.abs_filename_spec(filename)
        text = xacro.read_table(found)
        xacro.filestack.append(found)
        try:
            return xacro.YamlListWrapper.wrap(yaml.load(text, Loader=TableLoader))  # noqa: S506
        finally:
            xacro.filestack.pop()

    xacro.load_yaml = load_yaml
    xacro._global_symbols = xacro.create_global_symbols()
    for name in ("vars", "type"):
        dict.pop(dict.__getitem__(xacro._global_symbols, "python"), name, None)
    return xacro


def _after_check(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    def checked(text: str, *more: Any) -> Any:
        check_expression(text)
        return evaluate(text, *more)

    return checked
