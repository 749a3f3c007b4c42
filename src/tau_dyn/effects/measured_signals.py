"""Signals of a log beyond positions and forces, in the form that effects need."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.effects.motor_electrics import PULSE_WIDTH, VOLTAGE
from tau_dyn.log import Log, find_reversals

_MAX_UNPROPORTIONAL = 1e-3
"""Largest residual of a force on a constant times a voltage, as a share: a map's scale leaves rounding errors, a measured
current more."""


def get_measured_signals(
    log: Log, joints: tuple[str, ...], q: np.ndarray, v: np.ndarray, threshold: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the signals of a log beyond positions and forces: temperatures, travel since a reversal, voltages behind forces."""
    found = {"reversal": np.column_stack([compute_travel(q[:, k], v[:, k], threshold[k]) for k in range(q.shape[1])])}
    warmth = log.temperatures(joints)
    found |= {} if warmth is None else {"temperature": warmth}
    return found | {name: log.joint(name, joints) for name in (VOLTAGE, PULSE_WIDTH) if makes_force(log, joints, name)}


def compute_travel(q: np.ndarray, v: np.ndarray, threshold: float) -> np.ndarray:
    """Return the distance (N,) since a joint last reversed, from the turning point of each stretch of one direction.

    Stretches are separated where the sign of the speed is certain, above the threshold; the turning point is a little earlier.
    The first stretch also counts from its turning point, or else from the first sample.
    """
    sure = np.flatnonzero(np.abs(v) > threshold)
    starts = np.concatenate([[0], find_reversals(v, threshold), [len(q)]])
    out, before = np.zeros(len(q)), 0
    for start, stop in zip(starts[:-1], starts[1:], strict=True):
        at = start if start or not sure.size else sure[0]
        heading = np.sign(v[at]) or 1.0
        turn = np.min(heading * q[before : at + 1])
        out[start:stop] = np.maximum(0.0, heading * q[start:stop] - turn)
        before = start
    return out


def makes_force(log: Log, joints: Sequence[str], signal: str) -> bool:
    """Return whether a log has this signal for each joint, and each joint's nonzero force is a constant times it."""
    if not log.has(signal, joints):
        return False
    return not log.has("tau", joints) or bool(
        np.all(is_proportional(log.joint("tau", joints), log.joint(signal, joints)))
    )


def is_proportional(tau: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return whether each column (n, na) is a constant times another."""
    scale = np.sum(x * tau, axis=0) / np.maximum(np.sum(x**2, axis=0), 1e-300)
    left = np.linalg.norm(tau - scale * x, axis=0)
    return left <= _MAX_UNPROPORTIONAL * np.linalg.norm(tau, axis=0)
