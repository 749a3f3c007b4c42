"""What a result offers by itself: its presentation, its view in a notebook, its table.

The words and figures of a result stand in `render/`, which reads results and therefore stands below every package that makes one.
A result does not import them: a `Shown` asks `render` by its name, and only when somebody looks.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from tau_dyn.results.presentation import Presentation

_RENDER = "tau_dyn.render"
"""Has `present(result)`, `render_notebook(result)` and `tabulate(result)`."""


class Shown:
    """A result that can be presented, shows itself in a notebook and hands out its table."""

    __slots__ = ()

    def present(self, **options: Any) -> Presentation:
        """Return headline, verdict, sections, warnings and data, for any renderer."""
        return import_module(_RENDER).present(self, **options)

    def _repr_html_(self) -> str:
        """Return the notebook's view: headline, table, small charts; Jupyter calls it."""
        return import_module(_RENDER).render_notebook(self)

    def to_pandas(self) -> pd.DataFrame:
        """Return the result's main table, one row a thing, in SI units, units in a column of their own where they differ."""
        return import_module(_RENDER).tabulate(self)
