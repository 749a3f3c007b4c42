"""Curves of a result in Matplotlib, for notebooks and scripts; an extra, imported when it is used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INCHES = (10.0, 2.2)
"""Width of a figure and height of each of its axes."""


class PlottedSegment(NamedTuple):
    """Curves over one stretch of time.

    Attributes:
        name: The log that it is of.
        t: Time (n,) [s].
        measured: Measured values (n, m).
        predicted: Predicted values (n, m) by what predicted them.
        used: Samples that count (n, m).
    """

    name: str
    t: np.ndarray
    measured: np.ndarray
    predicted: Mapping[str, np.ndarray]
    used: np.ndarray


def plot_outputs(stretches: Sequence[PlottedSegment], outputs: Sequence[str], units: Sequence[str]) -> Figure:
    """Return a figure with one row an output: measured, predicted, and the residual of the last prediction.

    Samples that do not count are left out of the residual. Stretches follow each other with a gap.

    Args:
        stretches: What is drawn, in this order.
        outputs: Names of the outputs (m).
        units: Their units (m).

    Raises:
        InputError: Matplotlib is not installed, or there is nothing to draw.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("missing_package", "plots need Matplotlib: pip install 'tau_dyn[plot]'") from None
    if not stretches:
        raise InputError("unsupported", "no samples are kept in memory, so that nothing can be drawn")
    figure = Figure(figsize=(_INCHES[0], _INCHES[1] * len(outputs) + 0.6), layout="constrained")
    axes = figure.subplots(len(outputs), 1, sharex=True, squeeze=False)[:, 0]
    start = 0.0
    for number, one in enumerate(stretches):
        t = one.t - one.t[0] + start
        start = float(t[-1]) + 0.02 * float(one.t[-1] - one.t[0])
        for k, axis in enumerate(axes):
            label = number == 0
            axis.plot(t, one.measured[:, k], color="0.6", lw=1.4, label="measured" if label else None)
            for colour, (name, values) in zip(("C0", "C2", "C3"), one.predicted.items(), strict=False):
                axis.plot(t, values[:, k], color=colour, lw=0.9, label=name if label else None)
            last = list(one.predicted.values())[-1]
            left = np.where(one.used[:, k], one.measured[:, k] - last[:, k], np.nan)
            axis.plot(t, left, color="C1", lw=0.8, label="residual" if label else None)
    for axis, output, unit in zip(axes, outputs, units, strict=True):
        axis.set_ylabel(f"{output} [{unit}]")
        axis.grid(alpha=0.3)
    axes[0].legend(loc="upper right", ncols=4, fontsize="small")
    axes[-1].set_xlabel("t [s]")
    return figure
