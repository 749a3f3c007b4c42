"""Long series for a page: an identification's forces by log and joint, thinned so that peaks survive, packed as 16-bit numbers.

Thinning keeps the smallest and the largest sample of each bin, in the order they came; an even clock stays even.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.estimate import Regression
from tau_dyn.identify import Identification


@dataclass(frozen=True)
class ForcePanel:
    """One joint's force in one stretch of a log.

    Attributes:
        log: The log's name.
        joint: The joint.
        unit: Unit of the force.
        held_out: Whether the fit never saw the log.
        t: Time (n,) [s].
        measured: Measured force (n,), filtered as for the fit.
        predicted: Predicted force (n,).
        usable: Samples that the fit and the errors use (n,).
        shaded: From when to when the stretch serves as held-out data [s]; None where it does not or all of it does.
    """

    log: str
    joint: str
    unit: str
    held_out: bool
    t: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    usable: np.ndarray
    shaded: tuple[float, float] | None

    @property
    def force_limits(self) -> tuple[float, float]:
        """Range of the forces over the used samples, with air; filter ends and reversals do not widen it."""
        return compute_limits(np.concatenate([self.measured[self.usable], self.predicted[self.usable]]))

    @property
    def residual_limits(self) -> tuple[float, float]:
        """Range of the residual over the used samples, equal on both sides of zero, with air."""
        used = np.abs(self.residual[self.usable])
        return compute_limits(np.concatenate([used, -used]), 0.25)

    @property
    def residual(self) -> np.ndarray:
        """Measured minus predicted (n,)."""
        return self.measured - self.predicted


def build_panels(found: Identification) -> list[ForcePanel]:
    """Return every stretch and joint there is to look at: logs the fit never saw first."""
    own_logs = bool(found.model.provenance.get("held_out"))
    train = found.estimate.regression
    shown = _panels(found, found.held, True, None) if own_logs and found.held is not None else []
    return shown + _panels(found, train, False, None if own_logs else found.held)


def compute_limits(values: np.ndarray, air: float = 0.08) -> tuple[float, float]:
    """Return the range of values with some air; -1 to 1 where there are none."""
    if not values.size:
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    more = air * (high - low) or abs(high) or 1.0
    return low - more, high + more


def _panels(found: Identification, regression: Regression, held_out: bool, part: Regression | None) -> list[ForcePanel]:
    rows = []
    for i, run in enumerate(regression.runs):
        predicted = run.W @ found.estimate.theta
        shaded = None if part is None else (float(part.runs[i].t[0]), float(part.runs[i].t[-1]))
        for k, joint in enumerate(regression.outputs):
            rows.append(ForcePanel(run.name, joint, regression.units[k], held_out, run.t, run.y[:, k], predicted[:, k],
                              run.usable[:, k], shaded))  # fmt: skip
    return rows


def decimate_min_max(t: np.ndarray, columns: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most about `most` rows of time (n,) and columns (n, m): two a bin, its extremes in their order."""
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
    """Return the intervals [s] that are not usable, those closer together than `shortest` joined."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~usable).astype(int), [0]])))
    found: list[tuple[float, float]] = []
    for start, stop in zip(t[edges[::2]], t[edges[1::2] - 1], strict=True):
        if found and start - found[-1][1] < shortest:
            found[-1] = (found[-1][0], float(stop))
        else:
            found.append((float(start), float(stop)))
    return found


def encode_int16(values: np.ndarray) -> dict[str, Any]:
    """Return values as base64 of little-endian 16-bit numbers, `value = middle + scale * number`; -32768 stands for NaN."""
    there = np.isfinite(values)
    low, high = (float(values[there].min()), float(values[there].max())) if there.any() else (0.0, 0.0)
    middle, scale = (low + high) / 2, (high - low) / 65000 or 1.0
    numbers = np.where(there, np.round((np.where(there, values, middle) - middle) / scale), -32768).astype("<i2")
    return {"middle": middle, "scale": scale, "data": base64.b64encode(numbers.tobytes()).decode("ascii")}
