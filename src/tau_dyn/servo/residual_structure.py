"""What the extended loop still leaves: the floor that encoders set, and structure above it.

The floor is the white part of the measured positions, rounding included. Residuals above it are regressed on smooth functions
(Legendre, degree 4) of each joint's position, speed, acceleration and position error and of time, with and without the
direction of motion; what the search's data show must be there again in the two parts that it did not see. Residuals that
depend on none of these, but are far above the floor and coloured, are reported as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2, norm

from tau_dyn.evidence import Unexplained
from tau_dyn.log import estimate_encoder_noise
from tau_dyn.servo.records import LoopRecord

DEGREE = 4  # of the Legendre polynomials, as in a diagnosis of forces
MIN_SHARE = 0.1
"""Share of the residual's variance on data not fitted, from which a dependence is reported; less changes no simulation."""
FAMILY_LEVEL = 0.01
"""Chance that any variable of a joint without structure seems to matter."""
ABOVE_FLOOR = 1.5
"""Residual over the floor from which colour without a cause is reported: more than half of its variance is not the encoder's."""
MAX_LAG_S = 0.5  # over which autocorrelations are tested
_MOVING = 0.02  # rad/s; below it a joint has no direction

_Part = tuple[Sequence[LoopRecord], np.ndarray, np.ndarray]
"""Records, residuals (N, na, S) and blocks (N, S) of a part of the data."""
_Rows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Residual of a joint (M,), variables (M, k), direction of motion (M,) and blocks (M,)."""


def compute_noise_floor(records: Sequence[LoopRecord]) -> np.ndarray:
    """Return the rms of the encoders' noise and rounding (na,) [rad], which no simulation gets below."""
    return np.sqrt(np.mean([estimate_encoder_noise(r.q) ** 2 for r in records], axis=0))


def find_structure(
    joints: Sequence[str],
    parts: Sequence[_Part],
    floor: np.ndarray,
) -> tuple[Unexplained, ...]:
    """Return what is left at each joint.

    Args:
        joints: Actuated joints.
        parts: Records, residuals (N, na, S) and blocks (N, S) of what was fitted, confirmed on, and measured on.
        floor: See `compute_noise_floor`.
    """
    names, tables = _build_variables(joints, [p[0] for p in parts])
    found = []
    for j, joint in enumerate(joints):
        rows = [_gather(p, table, j) for p, table in zip(parts, tables, strict=True)]
        if any(len(r) < 20 * DEGREE for r, *_ in rows):
            continue
        structure = _find_dependence(joint, names, rows) or _find_colour(joint, parts[-1], j, float(floor[j]))
        if structure is not None:
            found.append(structure)
    return tuple(found)


def _build_variables(joints: Sequence[str], sets: Sequence[Sequence[LoopRecord]]) -> tuple[list[str], list[np.ndarray]]:
    """Return names, and for each part the values (M, k) of all records' used samples, with each joint's direction (M, na)."""
    names = [f"{kind}_{j}" for kind in ("q", "v", "a", "error") for j in joints] + ["t"]
    tables = []
    for records in sets:
        rows = [np.column_stack([*r.motion, r.goal - r.q, r.t])[r.used] for r in records]
        tables.append(np.concatenate(rows))
    return names, tables


def _gather(part: _Part, table: np.ndarray, j: int) -> _Rows:
    """Return the residual of a joint (M,), the variables (M, k), the direction (M,) and the blocks (M,)."""
    records, residual, blocks = part
    na = residual.shape[1]
    r = np.concatenate([residual[: len(x.t), j, k][x.used] for k, x in enumerate(records)])
    b = np.concatenate([blocks[: len(x.t), k][x.used] for k, x in enumerate(records)])
    v = table[:, na + j]
    return r, table, np.where(np.abs(v) > _MOVING, np.sign(v), 0.0), b


def _find_dependence(joint: str, names: Sequence[str], rows: Sequence[_Rows]) -> Unexplained | None:
    """Return the variable on which a residual depends most, alike in all parts."""
    best = None
    for k, name in enumerate(names):
        low, high = np.percentile(rows[0][1][:, k], [0.5, 99.5])
        if high - low < 1e-9:
            continue
        columns = [_build_columns(table[:, k], sign, low, high) for _, table, sign, _ in rows]
        weights = np.linalg.lstsq(columns[0], rows[0][0], rcond=1e-8)[0]
        told = [_test(c @ weights, r, b) for c, (r, _, _, b) in zip(columns[1:], rows[1:], strict=True)]
        p = float(norm.sf(min(t for t, _ in told))) * len(names)
        share = min(s for _, s in told)
        if p < FAMILY_LEVEL and share > MIN_SHARE and (best is None or share > best.share_of_residual_variance):
            best = Unexplained(joint, (name,), share, "", p, "confirmed")
    return best


def _build_columns(x: np.ndarray, sign: np.ndarray, low: float, high: float) -> np.ndarray:
    scaled = np.clip((2 * x - low - high) / (high - low), -1.0, 1.0)
    smooth = np.polynomial.legendre.legvander(scaled, DEGREE)
    return np.concatenate([smooth, smooth * sign[:, None]], axis=1)


def _test(predicted: np.ndarray, r: np.ndarray, blocks: np.ndarray) -> tuple[float, float]:
    """Return how many standard errors, by blocks, a prediction is found in a residual, and the share that it takes off."""
    gained = r**2 - (r - predicted) ** 2
    spread = float(np.sqrt((np.bincount(blocks, weights=gained - gained.mean()) ** 2).sum()))
    return float(gained.sum()) / max(spread, 1e-300), float(gained.sum() / max((r**2).sum(), 1e-300))


def _find_colour(joint: str, part: _Part, j: int, floor: float) -> Unexplained | None:
    """Return colour of a residual that is far above the floor, by a portmanteau test of samples in order (Ljung & Box 1978)."""
    records, residual, _ = part
    x = residual[:, j] * np.stack([np.pad(r.used, (0, len(residual) - len(r.t))) for r in records], axis=1)
    count = int(sum(r.used.sum() for r in records))
    rms = float(np.sqrt((x**2).sum() / max(count, 1)))
    if floor <= 0 or rms < ABOVE_FLOOR * floor:
        return None
    lags = int(np.clip(MAX_LAG_S / records[0].dt, 5, 100))
    rho = np.array([(x[lag:] * x[:-lag]).sum() for lag in range(1, lags + 1)]) / (x**2).sum()
    p = float(chi2.sf(count * (count + 2) * (rho**2 / np.maximum(count - np.arange(1, lags + 1), 1)).sum(), lags))
    return Unexplained(joint, (), 1 - (floor / rms) ** 2, "", p, "confirmed") if p < FAMILY_LEVEL else None
