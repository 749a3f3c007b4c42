"""Curves of a result in Matplotlib, for notebooks and scripts; an extra, imported when it is used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INCHES = (10.0, 2.2)
"""Width of a figure and height of each of its axes."""


class PlottedSegment(NamedTuple):
    """Curves over one stretch of time.

    Attributes:
        name: Name of its log.
        t: Time (n,) [s].
        measured: Measured values (n, m).
        predicted: Predicted values (n, m) by name of the predictor.
        used: Samples that are used (n, m).
    """

    name: str
    t: np.ndarray
    measured: np.ndarray
    predicted: Mapping[str, np.ndarray]
    used: np.ndarray


def _make_axes(rows: int) -> tuple[Figure, Any]:
    """Return a figure with a column of axes (rows,).

    Raises:
        InputError: Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("missing_package", "plots need Matplotlib: pip install 'tau_dyn[plot]'") from None

    class NotebookFigure(Figure):
        """A figure that a notebook shows as a picture although pyplot, which would show it twice, is not used."""

        def _repr_png_(self) -> bytes:
            with BytesIO() as picture:
                self.savefig(picture, format="png")
                return picture.getvalue()

    figure = NotebookFigure(figsize=(_INCHES[0], _INCHES[1] * rows + 0.6), layout="constrained")
    return figure, figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]


def plot_outputs(stretches: Sequence[PlottedSegment], outputs: Sequence[str], units: Sequence[str]) -> Figure:
    """Return a figure with one row per output: measured, predicted, and the residual of the last prediction.

    Unused samples are left out of the residual. Stretches follow each other with a gap.

    Args:
        stretches: The stretches to draw, in this order.
        outputs: Names of the outputs (m).
        units: Their units (m).

    Raises:
        InputError: Matplotlib is not installed, or there are no data to draw.
    """
    if not stretches:
        raise InputError("unsupported", "no samples are kept in memory, so that there is no curve to draw")
    figure, axes = _make_axes(len(outputs))
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


class PlottedResponse(NamedTuple):
    """A frequency response.

    Attributes:
        name: Its name in the legend.
        frequency: (F,) [Hz].
        value: Response from inputs to outputs (F, p, m), complex; nan where unknown.
    """

    name: str
    frequency: np.ndarray
    value: np.ndarray


def plot_responses(
    responses: Sequence[PlottedResponse], outputs: Sequence[str], inputs: Sequence[str], modes_hz: Sequence[float]
) -> Figure:
    """Return a figure with one row per output: magnitudes of responses from each input, and the frequencies of modes.

    Args:
        responses: The responses to draw; the first one as points.
        outputs: Names of the outputs (p).
        inputs: Names of the inputs (m).
        modes_hz: Frequencies of modes [Hz].

    Raises:
        InputError: Matplotlib is not installed.
    """
    figure, axes = _make_axes(len(outputs))
    for k, axis in enumerate(axes):
        for number, one in enumerate(responses):
            for i, name in enumerate(inputs):
                style: dict[str, Any] = {"ls": "", "marker": ".", "ms": 2, "alpha": 0.5} if number == 0 else {"lw": 1.0}
                axis.plot(
                    one.frequency, np.abs(one.value[:, k, i]), color=f"C{i}", label=f"{one.name}, {name}", **style
                )
        for hz in modes_hz:
            axis.axvline(hz, color="0.6", lw=0.8)
        axis.set(yscale="log", ylabel=outputs[k])
        axis.grid(alpha=0.3)
    if responses:
        axes[0].legend(loc="upper right", ncols=2, fontsize="small")
    axes[-1].set_xlabel("f [Hz]")
    return figure


def plot_stability(hz: np.ndarray, order: np.ndarray, is_stable: np.ndarray, modes_hz: Sequence[float]) -> Figure:
    """Return the stabilisation diagram: modes of models of all orders, and the chosen modes.

    Args:
        hz: Frequencies (P,) [Hz].
        order: Order of the model of each (P,).
        is_stable: Whether the next lower order has the same mode (P,).
        modes_hz: Frequencies of the chosen modes [Hz].

    Raises:
        InputError: Matplotlib is not installed.
    """
    figure, (axis,) = _make_axes(1)
    for name, which, colour in (("stable", is_stable, "C0"), ("other", ~is_stable, "0.7")):
        axis.plot(hz[which], order[which], ls="", marker=".", color=colour, label=name)
    for x in modes_hz:
        axis.axvline(x, color="C1", lw=0.8)
    axis.set(xlabel="f [Hz]", ylabel="order")
    axis.legend(loc="best", fontsize="small")
    return figure


def plot_pose_errors(errors: Mapping[str, np.ndarray]) -> Figure:
    """Return a figure of position errors (N,) [m] at poses by model, with their root mean squares.

    Raises:
        InputError: Matplotlib is not installed.
    """
    figure, (axis,) = _make_axes(1)
    for k, (name, size) in enumerate(errors.items()):
        rms = float(np.sqrt(np.nanmean(size**2)))
        axis.plot(1e3 * size, ls="", marker=".", color=f"C{k}", label=f"{name}: {1e3 * rms:.3g} mm rms")
        axis.axhline(1e3 * rms, color=f"C{k}", lw=0.8)
    axis.set(yscale="log", xlabel="pose", ylabel="position error [mm]")
    axis.grid(alpha=0.3)
    axis.legend(loc="best", fontsize="small")
    return figure
