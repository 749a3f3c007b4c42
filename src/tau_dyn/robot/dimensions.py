"""Dimensions of a robot family by name: numbers in the YAML tables that a xacro loads, and files of user-defined dimensions.

A name is the path to an entry, such as `simplified.arms.1.rods.1.length`; lists count from 1. Entries that an alias of the
table repeats change with it. A file of user-defined dimensions holds the same names as nested mappings, in addition to xacro
arguments:

    arms: complete
    home: {tool: [1.7, -0.6, 0.8]}
    simplified: {arms: {1: {rods: {1: {length: 2.1}}}}}
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import PlainLoader, read_yaml

MAX_DIMENSIONS = 1000
"""Largest number of entries of a file of user-defined dimensions; the largest built-in table has about 150."""
_FLOAT = "tag:yaml.org,2002:float"
_NUMBERS = (_FLOAT, "tag:yaml.org,2002:int")


def read_dimensions_file(path: str | Path) -> dict[str, str]:
    """Return a YAML file's entries as names and values, as `--set NAME=VALUE` takes them.

    Raises:
        InputError: The file cannot be read, is not a mapping, or holds values other than numbers, texts and lists of them.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InputError("file_format", f"{path}: dimensions are names and values, such as rod_length: 0.8")
    found: dict[str, str] = {}
    for name, value in _flatten(content, "", str(path)):
        if len(found) >= MAX_DIMENSIONS:
            raise InputError("file_too_large", f"{path}: at most {MAX_DIMENSIONS} dimensions are read")
        found[name] = value
    return found


def _flatten(value: Any, name: str, where: str) -> Iterator[tuple[str, str]]:
    """Yield the names and values of all entries below a value."""
    if isinstance(value, list) and value and all(isinstance(x, int | float | str) for x in value):
        yield name, "[" + ", ".join(_format(x) for x in value) + "]"
    elif isinstance(value, dict | list) and value:
        pairs = value.items() if isinstance(value, dict) else enumerate(value, 1)
        for key, inside in pairs:
            if not re.fullmatch(r"\w{1,80}", str(key)):
                raise InputError("file_format", f"{where}: '{str(key)[:80]}' is no name of a dimension")
            yield from _flatten(inside, f"{name}.{key}" if name else str(key), where)
    elif isinstance(value, bool | int | float | str):
        yield name, _format(value)
    else:
        raise InputError("file_format", f"{where}: {name or 'the file'} is no number, text or list of them")


def _format(value: bool | int | float | str) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


class TableChanges:
    """Changes to make in the tables that a xacro loads, and what those tables hold.

    Attributes:
        values: Values by name, as given.
        listing: Whether tables are read even if no value changes.
        numbers: Every number in the tables loaded so far, by name.
        fault: The error in a table or a value, if any.
    """

    def __init__(self, values: Mapping[str, str], *, listing: bool = False) -> None:
        """Begin with values by name."""
        self.values, self.listing = dict(values), listing
        self.numbers: dict[str, str] = {}
        self.fault: InputError | None = None
        self._used: set[str] = set()

    def apply(self, text: str, where: str) -> str:
        """Return a table's text with the changes of its entries.

        Raises:
            InputError: A value is of another kind or length than the entry it replaces.
        """
        root = yaml.compose(text, Loader=PlainLoader) if self.values or self.listing else None
        if not isinstance(root, yaml.MappingNode):
            return text
        used = len(self._used)
        for name, value in self.values.items():
            node = _find(root, name.split("."))
            if node is not None:
                _replace(node, value, f"{where}: {name}")
                self._used.add(name)
        self.numbers |= {name: node.value for name, node in _list_scalars(root, "") if node.tag in _NUMBERS}
        return yaml.serialize(root) if len(self._used) > used else text

    def require_all_used(self, arguments: list[str], where: str) -> None:
        """Reject a name that neither arguments nor tables have.

        Raises:
            UnknownName: The message lists the names that exist at that place.
        """
        for name in self.values:
            if name not in self._used:
                parents = [name[:k] for k in range(len(name), 0, -1) if name[k : k + 1] == "."]
                beside = next((b for p in parents if (b := self._list_below(p))), None)
                if beside is not None:
                    raise UnknownName("dimension", name, beside, where)
                kind = "xacro argument or dimension" if self.numbers else "xacro argument"
                raise UnknownName(kind, name, [*arguments, *self._list_below("")], where)

    def _list_below(self, parent: str) -> list[str]:
        """Return the names one level below another name; those of the top level for an empty name."""
        start = f"{parent}." if parent else ""
        return list(dict.fromkeys(start + n[len(start) :].split(".")[0] for n in self.numbers if n.startswith(start)))


def _find(node: Any, path: list[str]) -> Any:
    """Return the node at the end of a path, or None."""
    for key in path:
        if isinstance(node, yaml.MappingNode):
            node = next((inside for own, inside in node.value if own.value == key), None)
        elif isinstance(node, yaml.SequenceNode) and key.isascii() and key.isdigit() and len(key) < 6:
            node = node.value[int(key) - 1] if 1 <= int(key) <= len(node.value) else None
        else:
            return None
    return node


def _replace(node: Any, text: str, where: str) -> None:
    """Write a value into a node of its kind."""
    if isinstance(node, yaml.SequenceNode) and all(isinstance(inside, yaml.ScalarNode) for inside in node.value):
        parts = text.strip().removeprefix("[").removesuffix("]").split(",")
        if len(parts) != len(node.value):
            raise InputError("invalid_value", f"{where} has {len(node.value)} entries, not {len(parts)}")
        for inside, part in zip(node.value, parts, strict=True):
            _replace(inside, part.strip(), where)
    elif not isinstance(node, yaml.ScalarNode):
        raise InputError("invalid_value", f"{where} is a group; name one of its entries")
    elif node.tag not in _NUMBERS:
        raise InputError("invalid_value", f"{where} is a text; only numbers are dimensions")
    else:
        node.value, node.tag = repr(read_number(text, where)), _FLOAT


def read_number(text: str, where: str) -> float:
    """Return a finite number.

    Raises:
        InputError: The text is not a finite number.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or "_" in text:
        raise InputError("invalid_value", f"{where} is a finite number, not '{text[:80]}'")
    return number


def _list_scalars(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield every scalar of a tree of nodes with its name."""
    if isinstance(node, yaml.ScalarNode):
        yield name, node
        return
    pairs = ((k.value, v) for k, v in node.value) if isinstance(node, yaml.MappingNode) else enumerate(node.value, 1)
    for key, inside in pairs:
        yield from _list_scalars(inside, f"{name}.{key}" if name else str(key))
