"""Known loads on the tool in a pose file: a weight that hangs at the tool frame's origin, and a force and a moment on it.

`load` [kg] pulls along gravity. `fx_tool fy_tool fz_tool` [N] and `mx_tool my_tool mz_tool` [N m] act on the tool in the robot's
base axes, the force at the tool frame's origin: a cable, a press. A missing column and an empty cell mean no load.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import Table, format_names

LOAD = ("load",)
FORCE = ("fx_tool", "fy_tool", "fz_tool")
MOMENT = ("mx_tool", "my_tool", "mz_tool")
LOADS = (*LOAD, *FORCE, *MOMENT)
_MAX_LOADS = {LOAD: 2e4, FORCE: 2e5, MOMENT: 2e5}
"""Largest accepted loads [kg], [N], [N m]; larger ones indicate a file in g, mN or N mm."""


def read_loads(table: Table) -> np.ndarray:
    """Return the loads of each row (N, 7), zeros if the table has no loads.

    Raises:
        InputError: Some of three components are missing, a cell is no number, a weight is below zero, or a load exceeds the
            largest accepted value.
    """
    loads = np.zeros((table.n_rows, len(LOADS)))
    for names, largest in _MAX_LOADS.items():
        some = [name for name in names if name in table.cells]
        if some and len(some) < len(names):
            lacking = [name for name in names if name not in some]
            raise InputError("missing_column", f"{table.name} has {format_names(some)} but not {format_names(lacking)}")
        for name in some:
            loads[:, LOADS.index(name)] = _read(table, name, largest)
    return loads


def _read(table: Table, name: str, largest: float) -> np.ndarray:
    values = table.numbers(name, gaps=True)
    values = np.where(np.isnan(values), 0.0, values)
    bad = np.flatnonzero(~(np.abs(values) <= largest) | (values < 0 if name in LOAD else False))
    if len(bad):
        k = int(bad[0])
        unit = "kg" if name in LOAD else "N" if name in FORCE else "N m"
        least = "0" if name in LOAD else f"{-largest:g}"
        raise InputError(
            "bad_sample",
            f"{table.where(k)}, column {name}: {values[k]:g} {unit} is no load on a tool; give {least} to {largest:g} {unit}",
        )
    return values
