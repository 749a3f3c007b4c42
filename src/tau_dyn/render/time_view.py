"""The zoomable time view of a page: strips that share a time axis, as data for the script and as drawings for paper.

Series are decimated such that peaks are kept (the smallest and the largest sample of each bin, in their order) and packed as
16-bit numbers. Samples are on a uniform grid; in a gap of the recording, values are NaN and the curves are interrupted.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from tau_dyn.log import find_true_runs
from tau_dyn.render.chart import Chart
from tau_dyn.results import Line, Spans, View

TOTAL_POINTS = 120_000  # largest number of points in a page, which limits its size to a few MB
VIEW_POINTS = 8_000  # largest number of points of one view, several per pixel
PAPER_POINTS = 1_200  # largest number of points of a printed view, the resolution of paper
PRINTED_VIEWS = 12  # largest number of printed views
WIDE = 1000  # width of a drawing in its own units
THICKNESS = {"measured": 3.0, "predicted": 1.2, "residual": 1.0}
"""Line widths by the colour's name in the style sheet: the reference is drawn thick and pale below the other curves."""


def build_payload(views: Sequence[View]) -> list[dict[str, Any]]:
    """Return the data for the page's script, as plain data for JSON."""
    total = sum(len(s.curves) for view in views for s in view.strips)
    most = int(np.clip(TOTAL_POINTS / max(1, total), 400, VIEW_POINTS))
    return [_build_payload(view, most) for view in views]


def _build_payload(view: View, most: int) -> dict[str, Any]:
    t, thinned = _thin(view, most)
    step = float(t[1] - t[0]) if len(t) > 1 else 1.0
    unused = [] if view.usable is None else find_gaps(view.t, view.usable, 2 * step)
    columns = iter(thinned.T)
    strips = [
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
    ]
    masked = [[round(a, 4), round(b, 4)] for a, b in unused]
    return {"log": view.log, "joint": view.joint, "heldOut": view.held_out, "bands": view.bands, "masked": masked,
            "t0": float(t[0]), "step": step, "n": len(t), "strips": strips}  # fmt: skip


def select_printed(views: Sequence[View]) -> list[tuple[View, Markup]]:
    """Return the printed views: each joint once, in its first segment, which is held out if there are held-out data."""
    first = {view.joint: view for view in reversed(views)}
    return [(v, _draw(v)) for v in views if first[v.joint] is v][:PRINTED_VIEWS]


def _draw(view: View) -> Markup:
    t, thinned = _thin(view, PAPER_POINTS)
    start, end = float(view.t[0]), float(view.t[-1])
    xlim = (start, end if end > start else start + 1.0)
    unused = [] if view.usable is None else find_gaps(view.t, view.usable, (xlim[1] - xlim[0]) / 1000)
    columns, charts = iter(thinned.T), []
    for k, s in enumerate(view.strips):
        chart = Chart(WIDE, int(0.8 * s.height), xlim, s.limits, "" if k else view.joint, "time [s]", s.label)
        lines = [Line(t, np.clip(next(columns), *s.limits), c.ink) for c in s.curves]
        across = [Line(np.array(xlim), np.full(2, b), "limit") for b in s.bounds]
        shades = [Spans([(low, high)], ink) for low, high, ink in view.bands]
        charts.append(chart.render(*shades, Spans(unused if s.masked else [], "masked"), *across, *lines))
    return Markup("").join(charts)


def _thin(view: View, most: int) -> tuple[np.ndarray, np.ndarray]:
    return decimate_min_max(view.t, np.column_stack([c.values for s in view.strips for c in s.curves]), most)


def decimate_min_max(t: np.ndarray, columns: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most about `most` rows of time (n,) and columns (n, m): two per bin, its extremes in their order."""
    size = int(np.ceil(2 * len(t) / most))
    if len(t) <= most or size < 2:
        return t, columns
    bins = int(np.ceil(len(t) / size))
    padded = np.concatenate([columns, np.repeat(columns[-1:], bins * size - len(t), axis=0)])
    blocks = padded.reshape(bins, size, -1)
    low, high = blocks.min(axis=1), blocks.max(axis=1)
    rising = blocks.argmin(axis=1) <= blocks.argmax(axis=1)
    out = np.stack([np.where(rising, low, high), np.where(rising, high, low)], axis=1).reshape(2 * bins, -1)
    return t[0] + np.arange(2 * bins) * (t[1] - t[0]) * size / 2, out


def find_gaps(t: np.ndarray, usable: np.ndarray, shortest: float = 0.0) -> list[tuple[float, float]]:
    """Return the intervals [s] that are not usable; intervals closer than `shortest` are joined."""
    found: list[tuple[float, float]] = []
    for run in find_true_runs(~usable):
        start, stop = t[run.start], t[run.stop - 1]
        if found and start - found[-1][1] < shortest:
            found[-1] = (found[-1][0], float(stop))
        else:
            found.append((float(start), float(stop)))
    return found


def encode_int16(values: np.ndarray) -> dict[str, Any]:
    """Return values as base64 of little-endian 16-bit numbers, `value = middle + scale * number`; -32768 means NaN."""
    there = np.isfinite(values)
    low, high = (float(values[there].min()), float(values[there].max())) if there.any() else (0.0, 0.0)
    middle, scale = (low + high) / 2, (high - low) / 65000 or 1.0
    numbers = np.where(there, np.round((np.where(there, values, middle) - middle) / scale), -32768).astype("<i2")
    return {"middle": middle, "scale": scale, "data": base64.b64encode(numbers.tobytes()).decode("ascii")}
