"""The residual of the extended loop as measurements for the judge: encoder floor, structure, and correlation above the floor.

Structure is found, confirmed and tested as in the residual of forces (`evidence/unexplained.py`). The variables are position,
speed, acceleration and position error of each joint, and time. Encoders set a floor that forces do not have: the white part of
the measured positions, rounding included. A residual that is far above it and coloured is reported as well, if it does not
depend on any of the variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence import EVERY, MIN_NOISE_RATIO, Measurements, Unexplained, find_unexplained
from tau_dyn.log import estimate_encoder_noise
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.servo.records import MOTION_HZ, LoopRecord

RESIDUAL_HZ = 5 * MOTION_HZ
"""Lowest rate to which residuals are averaged [Hz]: no variable has content above `MOTION_HZ`."""
COLOUR_LEVEL = 0.01
"""Significance level of the portmanteau test of a joint."""
MAX_LAG_S = 0.5  # over which autocorrelations are tested


class LoopResidual(NamedTuple):
    """Residual of one part of the data.

    Attributes:
        records: The records.
        values: Measured minus simulated positions at the used samples, in order, padded (M, na, S) [rad].
    """

    records: Sequence[LoopRecord]
    values: np.ndarray


def compute_noise_floor(records: Sequence[LoopRecord]) -> np.ndarray:
    """Return the rms of the encoders' noise and rounding (na,) [rad], the lower bound of any simulation's error."""
    return np.sqrt(np.mean([estimate_encoder_noise(r.q[:: r.every]) ** 2 for r in records], axis=0))


def find_residual_structure(
    joints: tuple[str, ...], parts: Sequence[LoopResidual], floor: np.ndarray, rng: np.random.Generator
) -> tuple[Unexplained, ...]:
    """Return the structure in the residual, and the joints whose residual is not consistent with its noise.

    Args:
        joints: Actuated joints.
        parts: Residuals of the training, validation and test data.
        floor: See `compute_noise_floor`.
        rng: For noise draws.
    """
    found = find_unexplained(build_residual_measurements(joints, parts), rng)
    known = {u.joint for u in found if u.status == "confirmed"}
    colours = [_find_colour(joint, parts[-1], j, float(floor[j])) for j, joint in enumerate(joints)]
    return (*found, *(u for u in colours if u is not None and u.joint not in known))


def build_residual_measurements(joints: tuple[str, ...], parts: Sequence[LoopResidual]) -> Measurements:
    """Return residuals as measurements, with a free mean of each joint.

    Args:
        joints: Actuated joints.
        parts: Residuals of the training, validation and test data. Parts of one log become one run.
    """
    logs: dict[int, list[tuple[int, int]]] = {}  # records of one log share its positions
    for number, part in enumerate(parts):
        for k, record in enumerate(part.records):
            logs.setdefault(id(record.q), []).append((number, k))
    made = [_build_run(joints, parts, places) for places in logs.values()]
    offsets = Parameters(Parameter(f"{joint}.mean_residual", 0.0, "rad") for joint in joints)
    runs, divided = zip(*made, strict=True)
    return Measurements("position", joints, ("rad",) * len(joints), offsets, runs, divided)


def _build_run(
    joints: tuple[str, ...], parts: Sequence[LoopResidual], places: Sequence[tuple[int, int]]
) -> tuple[RegressionRun, np.ndarray]:
    """Return one log as a run, and the part of each of its samples; places are indices of parts and of their records."""
    first = parts[places[0][0]].records[places[0][1]]
    residual, part = np.zeros(first.q.shape), np.full(len(first.t), -1)
    for number, k in places:
        used = parts[number].records[k].used
        residual[used] = parts[number].values[: used.sum(), :, k]
        part[used] = EVERY[number]
    every = max(first.every, int(1 / (RESIDUAL_HZ * first.dt)))
    q, v, a = first.motion
    t, *signals = [_average(x, every) for x in (first.t, q, v, a, first.goal - first.q)]
    groups = part[: len(t) * every].reshape(len(t), every)
    share = (groups >= 0).mean(axis=1)
    y = _average(residual, every) / np.where(share > 0, share, 1.0)[:, None]
    top, low = groups.max(axis=1), np.where(groups >= 0, groups, len(EVERY)).min(axis=1)
    whole = np.where((top == low) & ((share == 1) | (first.every > 1)), top, -1)
    W = np.broadcast_to(np.eye(len(joints)), (len(t), len(joints), len(joints)))
    usable = np.broadcast_to((whole >= 0)[:, None], y.shape)
    names: tuple[str, ...] = ("q", "v", "a", "error")
    named = {name: x for name, x in zip(names, signals, strict=True)}
    return RegressionRun(first.name, t, W, y, usable, W, y, named), whole


def _average(x: np.ndarray, every: int) -> np.ndarray:
    """Return the means (n, ...) of `every` successive samples of an array (N, ...)."""
    n = len(x) // every
    return x[: n * every].reshape(n, every, *x.shape[1:]).mean(axis=1)


def _find_colour(joint: str, part: LoopResidual, j: int, floor: float) -> Unexplained | None:
    """Return the correlation of a residual far above the floor, by a portmanteau test of samples in order (Ljung & Box 1978)."""
    records, residual = part
    kept = [residual[: r.used.sum(), j, k] for k, r in enumerate(records)]
    count = sum(len(x) for x in kept)
    square = sum(float(x @ x) for x in kept)
    rms = float(np.sqrt(square / max(count, 1)))
    if floor <= 0 or rms < MIN_NOISE_RATIO * floor:
        return None
    lags = int(np.clip(MAX_LAG_S / records[0].interval, 5, 100))
    rho = np.array([sum(float(x[lag:] @ x[:-lag]) for x in kept) for lag in range(1, lags + 1)]) / square
    p = float(chi2.sf(count * (count + 2) * (rho**2 / np.maximum(count - np.arange(1, lags + 1), 1)).sum(), lags))
    return Unexplained(joint, (), 1 - (floor / rms) ** 2, "", p, "confirmed") if p < COLOUR_LEVEL else None
