"""The zoomable time view of every page: strips that share a time axis, as data for the script and as drawings for paper.

Samples lie on an even grid; where a recording has none, its values are NaN and the curves break.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.log import Log, examine_clock
from tau_dyn.report.force_series import ForcePanel, decimate_min_max, encode_int16, find_gaps
from tau_dyn.report.formatting import format_unit
from tau_dyn.report.svg import Chart, pad_limits

TOTAL_POINTS = 120_000  # points in a page at most, which keeps it below some MB
VIEW_POINTS = 8_000  # points of one view at most, several a pixel
PAPER_POINTS = 1_200  # points of a printed view at most, what paper resolves
PRINTED_VIEWS = 12  # views printed at most
WIDE = 1000  # width of a drawing in its own units
THICKNESS = {"measured": 3.0, "predicted": 1.2, "residual": 1.0}
"""Line widths by the colour's name in the style sheet: the reference lies thick and pale under what follows it."""


@dataclass(frozen=True)
class Curve:
    """One line.

    Attributes:
        name: What it is, for the readout.
        ink: Its colour's name: `measured`, `predicted` or `residual`.
        values: Its values (n,), NaN where there are none.
    """

    name: str
    ink: str
    values: np.ndarray


@dataclass(frozen=True)
class Strip:
    """Curves on one vertical axis.

    Attributes:
        label: Quantity and unit.
        curves: What is drawn, first below.
        limits: Range of the axis.
        height: Height on the screen [px].
        masked: Whether unused stretches are shaded here.
        bounds: Limits of the robot, drawn across where they are near.
    """

    label: str
    curves: tuple[Curve, ...]
    limits: tuple[float, float]
    height: int
    masked: bool = False
    bounds: tuple[float, ...] = ()


@dataclass(frozen=True)
class View:
    """One joint in one stretch of time.

    Attributes:
        log: The log's name.
        joint: The joint.
        t: Even times (n,) [s].
        strips: The strips, top down.
        held_out: Whether all of it is held-out data.
        bands: Stretches [s] to shade for what they served, and the shade's name: `held` or `confirm`.
        usable: Samples that are used (n,); the others are shaded where a strip wants that. None for all.
    """

    log: str
    joint: str
    t: np.ndarray
    strips: tuple[Strip, ...]
    held_out: bool = False
    bands: tuple[tuple[float, float, str], ...] = ()
    usable: np.ndarray | None = None


def strip(
    label: str, height: int, *curves: Curve, masked: bool = False, bounds: Sequence[float] = (), symmetric: bool = False
) -> Strip:
    """Return a strip whose axis holds all curves, and the bounds that are not far outside."""
    low, high = pad_limits(*(c.values for c in curves))
    if symmetric:
        low, high = -max(-low, high), max(-low, high)
    near = tuple(
        float(b) for b in bounds if np.isfinite(b) and low - 0.5 * (high - low) <= b <= high + 0.5 * (high - low)
    )
    limits = pad_limits(np.array([low, high, *near]), share=0.02) if near else (low, high)
    return Strip(label, curves, limits, height, masked, near)


def build_force_view(panel: ForcePanel) -> View:
    """Return measured and predicted force, and the residual below."""
    unit = format_unit(panel.unit)
    both = Curve("measured", "measured", panel.measured), Curve("predicted", "predicted", panel.predicted)
    below = Strip(
        f"residual [{unit}]", (Curve("residual", "residual", panel.residual),), panel.residual_limits, 180, masked=True
    )
    above = Strip(f"force [{unit}]", both, panel.force_limits, 290)
    held = (float(panel.t[0]), float(panel.t[-1])) if panel.held_out else panel.shaded
    bands = () if held is None else ((*held, "held"),)
    return View(panel.log, panel.joint, panel.t, (above, below), panel.held_out, bands, panel.usable)


def resample_evenly(log: Log, names: Sequence[str]) -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Return an even grid (n,), channels on it, NaN in gaps, and where there are samples (n,); an even log as it is."""
    clock = examine_clock(log)
    if clock.even:
        return log.t, {n: log.channels[n] for n in names}, np.ones(log.n_samples, bool)
    steps = int(np.clip(round(log.duration / clock.dt), 1, 4 * log.n_samples))
    grid = np.linspace(log.t[0], log.t[-1], steps + 1)
    there = np.ones(len(grid), bool)
    for i in clock.gaps:
        there &= (grid <= log.t[i]) | (grid >= log.t[i + 1])
    return grid, {n: np.where(there, np.interp(grid, log.t, log.channels[n]), np.nan) for n in names}, there


def build_payload(views: Sequence[View]) -> list[dict[str, Any]]:
    """Return what the page's script draws, as plain data for JSON."""
    total = sum(len(s.curves) for view in views for s in view.strips)
    most = int(np.clip(TOTAL_POINTS / max(1, total), 400, VIEW_POINTS))
    return [_payload(view, most) for view in views]


def _payload(view: View, most: int) -> dict[str, Any]:
    t, thinned = _thinned(view, most)
    step = float(t[1] - t[0]) if len(t) > 1 else 1.0
    unused = [] if view.usable is None else find_gaps(view.t, view.usable, 2 * step)
    columns = iter(thinned.T)
    return {
        "log": view.log,
        "joint": view.joint,
        "heldOut": view.held_out,
        "bands": view.bands,
        "masked": [[round(a, 4), round(b, 4)] for a, b in unused],
        "t0": float(t[0]),
        "step": step,
        "n": len(t),
        "strips": [
            {
                "label": s.label,
                "limits": s.limits,
                "height": s.height,
                "masked": s.masked,
                "bounds": s.bounds,
                "curves": [
                    {"name": c.name, "ink": c.ink, "width": THICKNESS[c.ink], **encode_int16(next(columns))}
                    for c in s.curves
                ],
            }
            for s in view.strips
        ],
    }


def select_printed(views: Sequence[View]) -> list[tuple[View, Markup]]:
    """Return what paper shows: each joint once, in its first stretch, which is held out where there is one."""
    first = {view.joint: view for view in reversed(views)}
    return [(v, _drawing(v)) for v in views if first[v.joint] is v][:PRINTED_VIEWS]


def _drawing(view: View) -> Markup:
    t, thinned = _thinned(view, PAPER_POINTS)
    end = float(view.t[-1])
    xlim = (float(view.t[0]), end if end > view.t[0] else float(view.t[0]) + 1.0)
    unused = [] if view.usable is None else find_gaps(view.t, view.usable, (xlim[1] - xlim[0]) / 1000)
    columns, charts = iter(thinned.T), []
    for k, s in enumerate(view.strips):
        chart = Chart(WIDE, int(0.8 * s.height), xlim, s.limits, "" if k else view.joint, "time [s]", s.label)
        lines = [chart.line(t, np.clip(next(columns), *s.limits), c.ink) for c in s.curves]
        across = [chart.line(np.array(xlim), np.full(2, b), "limit") for b in s.bounds]
        shades = [chart.band([(start, stop)], ink) for start, stop, ink in view.bands]
        shades.append(chart.band(unused if s.masked else [], "masked"))
        charts.append(chart.render(*shades, *across, *lines))
    return Markup("").join(charts)


def _thinned(view: View, most: int) -> tuple[np.ndarray, np.ndarray]:
    return decimate_min_max(view.t, np.column_stack([c.values for s in view.strips for c in s.curves]), most)
