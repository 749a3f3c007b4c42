"""What pieces of logs have in common, whatever was measured: sure directions of motion, and samples free of the filter's ends."""

from __future__ import annotations

import numpy as np

from tau_dyn.log import compute_edge_samples


def find_directions(v: np.ndarray, threshold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of the last motion that was surely one, and from when on there was any.

    Args:
        v: Speeds (N, na) [m/s or rad/s].
        threshold: Slowest speed with a sure sign (na,).

    Returns:
        -1 or 1 (N, na), before a joint's first sure motion that of the first, 0 where there is none at all; and whether a
        sure motion came before (N, na).
    """
    sides = [_direction(v[:, k], float(threshold[k])) for k in range(v.shape[1])]
    return np.column_stack([sign for sign, _ in sides]), np.column_stack([known for _, known in sides])


def _direction(v: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    sure = np.flatnonzero(np.abs(v) >= threshold)
    if not len(sure):
        return np.zeros_like(v), np.zeros(len(v), bool)
    last = np.searchsorted(sure, np.arange(len(v)), side="right") - 1
    return np.sign(v[sure[np.maximum(last, 0)]]), last >= 0


def mask_filter_edges(mask: np.ndarray, cutoff_hz: float, rate_hz: float, factor: int) -> np.ndarray:
    """Return which samples count, without those at both ends that the low-pass disturbs.

    Args:
        mask: Samples (N, ...) at the log's rate.
        cutoff_hz: The low-pass [Hz].
        rate_hz: Rate of the log [Hz].
        factor: Decimation.

    Returns:
        Samples (n, ...) after decimation.
    """
    inner = mask[::factor].copy()
    edge = int(np.ceil(compute_edge_samples(cutoff_hz, rate_hz) / factor))
    inner[:edge] = inner[len(inner) - edge :] = False
    return inner
