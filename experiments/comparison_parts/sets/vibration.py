"""Five sets of the DaISy collection as SLICOT keeps them; the last 30 % are held out."""

from collections.abc import Iterator

import numpy as np
from scipy.io import loadmat

from comparison_parts.case import DATA, Case, split_in_time
from tau_dyn.log import Log

SETS = {
    "CD_player_arm": (0, 2, 2, 76.7, 8), "cstr": (1, 1, 2, 87.8, 5), "evaporator": (0, 3, 3, 56.9, 4),
    "exchanger": (1, 1, 1, 58.5, 4), "steamgen": (1, 4, 4, 70.6, 9),
}  # fmt: skip
"""Leading columns to leave out, inputs, outputs, SLICOT's fit [%] and its order."""


def read_set(name: str) -> Log:
    """Return a set as a log with columns u0, u1, .. and y0, y1, .., a sample a second."""
    first, n_inputs, n_outputs, _, _ = SETS[name]
    x = loadmat(DATA / "vibration" / f"{name}_dat.mat")[f"{name}_dat"]
    columns = {f"u{k}": x[:, first + k] for k in range(n_inputs)}
    columns |= {f"y{k}": x[:, first + n_inputs + k] for k in range(n_outputs)}
    return Log(np.arange(len(x), dtype=float), columns, name=name)


def read() -> Iterator[Case]:
    for name, (_, n_inputs, n_outputs, fit, order) in SETS.items():
        train, held = split_in_time(read_set(name))
        yield Case(
            name, "vibration", train, held, inputs=tuple(f"u{k}" for k in range(n_inputs)),
            outputs=tuple(f"y{k}" for k in range(n_outputs)), order=order,
            published=f"SLICOT, order {order}: {100 - fit:.1f} % left", origin="DaISy",
        )  # fmt: skip
