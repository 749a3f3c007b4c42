"""The equations of motion at a log's own rate, without the low-pass that the regression puts before decimation.

Accelerations are second differences of the raw positions, so that the noise of an equation is known exactly
(`estimate/position_noise.py`); positions and speeds, whose noise matters little, come low-passed. An equation is left out where
a sign is not sure, where a force is saturated or flagged, and within reach of a reversal of any joint: a jump of the
acceleration there is no second difference of anything.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from tau_dyn.estimate import REACH, compute_accelerations
from tau_dyn.identify.gate import find_excluded_samples
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.signals import get_measured_signals
from tau_dyn.log import Log, compute_edge_samples, differentiate, lowpass
from tau_dyn.model import Model

INERTIA_EVERY = 10
"""Samples between two mass matrices; those between are interpolated."""

SIGN_THRESHOLD_RATIO = 0.4
"""Share of the regression's speed threshold above which a sign is sure here: four times the velocity's noise."""


@dataclass(frozen=True, eq=False)
class FullRate:
    """One even stretch of a log.

    Attributes:
        log: The stretch.
        position: Raw positions (n, m) [m or rad].
        smooth: Positions and speeds behind the position low-pass, each (n, m).
        signals: What else effects feel.
        force: Logged forces (n, m) [N or N m].
        W: Columns with the accelerations of the raw positions (n, m, p).
        inertia: Mass matrices (n, m, m).
        keep: Which equations count (n, m).
    """

    log: Log
    position: np.ndarray
    smooth: tuple[np.ndarray, np.ndarray]
    signals: Mapping[str, np.ndarray]
    force: np.ndarray
    W: np.ndarray
    inertia: np.ndarray
    keep: np.ndarray

    def columns(self, model: Model, a: np.ndarray) -> np.ndarray:
        """Return the columns (n, m, p) with other accelerations (n, m)."""
        return _columns(model, self.log, *self.smooth, a, self.signals)


def build_full_rate_equations(model: Model, log: Log, preparation: Preparation) -> FullRate:
    """Return the equations of one even stretch.

    Args:
        model: Its values give the mass matrices.
        log: An even stretch without gaps.
        preparation: Gives the position low-pass, the speed thresholds and the columns that flag samples.
    """
    joints, rate = model.robot.actuated, log.rate_hz
    raw = log.joint("q", joints)
    q = lowpass(raw, preparation.position_cutoff_hz, rate)
    v = differentiate(q, log.dt, accuracy=4)
    signals = get_measured_signals(log, joints, q, v, preparation.speed_threshold)
    W = _columns(model, log, q, v, compute_accelerations(raw, log.dt), signals)
    keep = _sure(v, SIGN_THRESHOLD_RATIO * preparation.speed_threshold)
    flagged = find_excluded_samples(log, joints, model.robot.effort_limit, preparation.exclude)
    keep &= ~np.asarray(binary_dilation(flagged, np.ones((2 * REACH + 1, 1), bool)), dtype=bool)
    edge = compute_edge_samples(preparation.position_cutoff_hz, rate)
    keep[:edge] = keep[len(keep) - edge :] = False
    return FullRate(log, raw, (q, v), signals, log.joint("tau", joints), W, _inertia(model, q), keep)


def _columns(model: Model, log: Log, q: np.ndarray, v: np.ndarray, a: np.ndarray, signals: Mapping) -> np.ndarray:
    return model.columns(model.motion(q, v, a, np.sign(v), t=log.t, signals=signals))


def _sure(v: np.ndarray, threshold: np.ndarray) -> np.ndarray:
    """Return where each joint's sign is sure (n, m), out of the acceleration's reach of where it is not."""
    slow = np.abs(v) < threshold
    slow[1:] |= np.sign(v[1:]) != np.sign(v[:-1])
    return ~np.asarray(binary_dilation(slow, np.ones((2 * REACH + 1, 1), bool)), dtype=bool)


def _inertia(model: Model, q: np.ndarray) -> np.ndarray:
    """Return mass matrices (n, m, m) along positions (n, m), interpolated between every tenth."""
    places = np.unique(np.append(np.arange(0, len(q), INERTIA_EVERY), len(q) - 1))
    found = model.mechanism.inertia(q[places])
    share = np.interp(np.arange(len(q)), places, np.arange(len(places)))
    low = np.minimum(share.astype(int), max(len(places) - 2, 0))
    part = (share - low)[:, None, None]
    return (1 - part) * found[low] + part * found[np.minimum(low + 1, len(places) - 1)]
