"""Display methods of a result: a few lines as its `repr`, its presentation, its view in a notebook, its table.

The texts and figures of a result are in `render/`, which reads results and therefore depends on every package that makes one. A
result does not import them: a `Shown` imports `render` by its name when it is displayed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from textwrap import shorten, wrap
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

    from tau_dyn.results.presentation import Presentation

_RENDER = "tau_dyn.render"
"""Has `present(result)`, `summarise(result)`, `render_notebook(result)` and `tabulate(result)`."""
_WIDTH = 88  # columns of a `repr` that fit next to a debugger's or a notebook's margin
_MAX_LINES = 12  # of a `repr`, so that the prompt stays on the screen


class Brief:
    """A dataclass whose `repr` describes its fields, without the contents of arrays and long texts."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Keep this `repr`: a dataclass generates one if its class body does not define it."""
        super().__init_subclass__(**options)
        cls.__repr__ = cls.__repr__

    def __repr__(self) -> str:
        """Return a few lines: the fields in brief."""
        said = [f"{f.name}={_shorten(getattr(self, f.name))}" for f in fields(self) if f.repr]  # pyright: ignore[reportArgumentType]
        lines = wrap(
            f"{type(self).__name__}({', '.join(said)})", _WIDTH, subsequent_indent="  ", break_long_words=False
        )
        return "\n".join([*lines[:_MAX_LINES], *(["  ..."] if len(lines) > _MAX_LINES else [])])


def _shorten(value: Any) -> str:
    """Return a value in a word or two: a number or a short text itself, the shape of an array, the size of a collection."""
    if isinstance(value, np.ndarray):
        return f"array {value.shape}"
    if isinstance(value, bool | int | float | None):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    if isinstance(value, str):
        return repr(shorten(value, 50, placeholder=" ..."))
    if isinstance(value, Collection) and not hasattr(value, "_fields"):
        few = isinstance(value, tuple | list) and len(value) <= 6
        if few and all(isinstance(x, str | float | int) for x in value):
            return f"({', '.join(map(_shorten, value))}{',' * (len(value) == 1)})"
        return f"<{len(value)} {_name_things(value)}>"
    return type(value).__name__ if is_dataclass(value) or hasattr(value, "_fields") else shorten(repr(value), 50)


def _name_things(value: Collection[Any]) -> str:
    """Return a description of a collection's contents."""
    kinds = {type(x).__name__ for x in (value.values() if isinstance(value, Mapping) else value)}
    return kinds.pop() if len(kinds) == 1 else "items"


class Shown(Brief):
    """A result that describes itself, can be presented, displays itself in a notebook and returns its table."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Return a few lines: the subject, the inputs, the headline, the verdict."""
        return import_module(_RENDER).summarise(self)

    def present(self, **options: Any) -> Presentation:
        """Return headline, verdict, sections, warnings and data, for any renderer."""
        return import_module(_RENDER).present(self, **options)

    def _repr_html_(self) -> str:
        """Return the notebook's view: headline, table, small charts; Jupyter calls it."""
        return import_module(_RENDER).render_notebook(self)

    def to_pandas(self) -> pd.DataFrame:
        """Return the result's main table, one row per thing, in SI units, with a column of units if they differ."""
        return import_module(_RENDER).tabulate(self)
