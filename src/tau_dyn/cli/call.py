"""A command with its arguments, before it runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any


@dataclass(frozen=True)
class Call:
    """A command with its arguments.

    Attributes:
        command: Its first word, as results name it.
        function: What it calls.
        bound: With which arguments.
    """

    command: str
    function: Callable[..., Any]
    bound: inspect.BoundArguments

    def run(self) -> Any:
        """Call the function."""
        return self.function(*self.bound.args, **self.bound.kwargs)

    def values(self) -> dict[str, Any]:
        """Return every argument by name, those of shared options beside the others, defaults included."""
        complete = inspect.BoundArguments(self.bound.signature, self.bound.arguments.copy())
        complete.apply_defaults()
        return dict(_flatten(complete.arguments))

    def replace(self, **values: Any) -> Call:
        """Return the call with other values of some arguments."""
        complete = inspect.BoundArguments(self.bound.signature, self.bound.arguments.copy())
        complete.apply_defaults()
        for name, value in complete.arguments.items():
            if name in values:
                complete.arguments[name] = values[name]
            elif is_dataclass(value) and not isinstance(value, type):
                own = {f.name: values[f.name] for f in fields(value) if f.name in values}
                complete.arguments[name] = replace(value, **own) if own else value
        return Call(self.command, self.function, complete)


def _flatten(arguments: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in arguments.items():
        if is_dataclass(value) and not isinstance(value, type) and hasattr(type(value), "__cyclopts__"):
            yield from _flatten({f.name: getattr(value, f.name) for f in fields(value)})
        else:
            yield name, value
