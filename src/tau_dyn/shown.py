"""What a notebook makes of a result: a table, and a page of its own when it stands at the end of a cell.

`report/` reads results and therefore stands below every room that makes one. A result so does not import how it looks: it is a
`Shown`, and a `Shown` asks the module named here, by its name and only when somebody looks. Nothing flows back but text and
tables, so that leaving `report/` out takes away the faces and nothing else.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

_FACES = "tau_dyn.report.notebook"
"""Has `render_html(result)` and `build_table(result)`."""


class Shown:
    """A result that shows itself in a notebook and hands out its table."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        """Return the notebook's view: headline, table, small charts; Jupyter calls it."""
        return _faces().render_html(self)

    def to_pandas(self) -> pd.DataFrame:
        """Return the result's main table, one row a thing, in SI units, units in a column of their own where they differ."""
        return _faces().build_table(self)


def _faces() -> Any:
    return import_module(_FACES)
