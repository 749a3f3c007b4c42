"""Signature plots: the residual against the variable that matters, with and without the cause, in equal frames."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from tau_dyn.diagnose import Signature
from tau_dyn.report.formatting import format_unit
from tau_dyn.report.identification_charts import BINS, SMALL, average_in_bins
from tau_dyn.report.svg import Chart, pad_limits

FINE = 90
"""Steps in which the fitted effect is drawn."""
JUMP = 4.0
"""How many usual steps of the fitted curve make a jump at zero, where it is then broken."""


def draw_signature_charts(signature: Signature, *, explained: bool = True) -> list[Markup]:
    """Return the plot without the cause and, where one explains it, the plot of what is left with it.

    Args:
        signature: What to draw.
        explained: Whether `fitted` is a named cause; else it is only a smooth curve through unexplained structure.
    """
    before, after = signature.y, signature.y - signature.fitted
    xlim, ylim = pad_limits(signature.x, share=0.03), _limits(signature)
    first = Chart(*SMALL, xlim, ylim, "without the cause" if explained else signature.output,
                  format_unit(signature.x_label), format_unit(signature.y_label))  # fmt: skip
    at, fitted = _curve(signature)
    drawn = [_cloud(first, signature.x, before), first.line(at, np.clip(fitted, *ylim), "predicted"),
             _means(first, signature.x, before)]  # fmt: skip
    charts = [first.render(*drawn)]
    if explained:
        second = Chart(*SMALL, xlim, ylim, "with it", format_unit(signature.x_label), format_unit(signature.y_label))
        charts.append(second.render(_cloud(second, signature.x, after), _means(second, signature.x, after)))
    return charts


def _limits(signature: Signature) -> tuple[float, float]:
    """Return a vertical range that shows the effect and most of the cloud, the same in both frames."""
    cloud = np.quantile(np.concatenate([signature.y, signature.y - signature.fitted]), [0.01, 0.99])
    _, means, _ = average_in_bins(signature.x, signature.y)
    return pad_limits(cloud, means, np.quantile(signature.fitted, [0.005, 0.995]))


def _cloud(chart: Chart, x: np.ndarray, y: np.ndarray) -> Markup:
    inside = (y >= chart.ylim[0]) & (y <= chart.ylim[1])
    return chart.dots(x[inside], y[inside], "cloud")


def _means(chart: Chart, x: np.ndarray, y: np.ndarray) -> Markup:
    at, mean, _ = average_in_bins(x, y, BINS)
    return chart.dots(at, np.clip(mean, *chart.ylim), "mean")


def _curve(signature: Signature) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted effect over the horizontal axis (n,), its mean in fine steps, broken where it jumps at zero."""
    at, mean, _ = average_in_bins(signature.x, signature.fitted, FINE)
    change = np.flatnonzero(np.diff(np.sign(at)))
    if change.size and len(at) > 4:
        steps, k = np.abs(np.diff(mean)), int(change[0])
        if steps[k] > JUMP * float(np.median(steps)):
            at, mean = np.insert(at, k + 1, 0.0), np.insert(mean, k + 1, np.nan)
    return at, mean
