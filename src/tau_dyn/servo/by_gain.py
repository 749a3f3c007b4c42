"""Logs at several servo gains: what each gain's logs alone say of the drive, and what is missing where they disagree.

The torque that a drive gives for its whole supply does not depend on the gain of the loop around it. Where fits at each
gain alone find different torques, beyond their errors, the law is incomplete, however well each fit follows its own logs.
Then what a law may lack is tried on all logs together, and the entry that explains most is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.message_codes import CodedWarning
from tau_dyn.servo.fit import LoopFit, LoopProblem, fit_loop
from tau_dyn.servo.unknowns import LoopUnknowns, build_unknowns

if TYPE_CHECKING:
    from tau_dyn.servo.data import LoopData

MISSING = {"drive_exponent": "a drive law that bends", "supply_sag": "a supply that sags", "dead_band": "a dead band",
           "carried_friction": "a friction that grows with the load"}  # fmt: skip
"""Entries that a law may lack, tried where fits disagree."""
DISAGREES = 3.3
"""Difference over its standard error from which two fits disagree: one pair in a thousand by chance."""
MIN_DIFFERENCE = 0.1  # relative; smaller differences change no simulation
MIN_FALL = 0.08
"""Fall of the residual's rms from which an entry is named as missing."""
_ITERATIONS = 10  # from a solution of all logs


def compare_gains(
    data: LoopData, x: np.ndarray, progress: Callable[[str], None]
) -> tuple[tuple[dict[str, Any], ...], list[str]]:
    """Return what each gain's logs alone say, row by row, and what is to be said of it."""
    gains = [tuple(r.entries["position_gain"]) for r in data.records]
    u = extend_unknowns(data.unknowns, x, ("force_per_unit",), data)
    rows, fits = [], []
    for gain in sorted(set(gains)):
        progress(f"logs at gain {gain[0]:.3g} alone")
        chosen = [k for k, g in enumerate(gains) if g == gain]
        fit = fit_loop(_build_problem(data, u, chosen), max_iterations=_ITERATIONS)
        torque, sigma = read_kind(u, fit, "force_per_unit")
        fits.append((torque, sigma))
        joints = data.law.joints
        rows.append({
            "position_gain": dict(zip(joints, gain, strict=True)),
            "logs": [data.records[k].name for k in chosen],
            "force_per_unit": dict(zip(joints, map(float, torque), strict=True)),
            "force_per_unit_stderr": dict(zip(joints, map(float, sigma), strict=True)),
            "rms": dict(zip(joints, map(float, fit.sigma), strict=True)),
        })  # fmt: skip
    odd, pairs = _count_disagreements(fits)
    if not odd:
        return tuple(rows), []
    values = ", ".join(f"{f[0][0]:.3g} ± {f[1][0]:.2g}" for f in fits)
    said = (
        f"the fits at each gain alone disagree in {odd} of {pairs} pairs about the torque for the whole supply "
        f"({values} N m at rising gain), so the servo's law is incomplete"
    )
    return tuple(rows), [CodedWarning("law_incomplete", said + _name_missing(data, x, progress))]


def _count_disagreements(fits: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[int, int]:
    odd = pairs = 0
    for (a, sa), (b, sb) in combinations(fits, 2):
        for j in range(len(a)):
            pairs += 1
            apart = abs(a[j] - b[j])
            odd += apart > DISAGREES * np.hypot(sa[j], sb[j]) and apart > MIN_DIFFERENCE * min(a[j], b[j])
    return odd, pairs


def _name_missing(data: LoopData, x: np.ndarray, progress: Callable[[str], None]) -> str:
    """Return which entry explains most of the residual of all logs, as the end of a sentence."""
    everything = range(len(data.records))
    plain = extend_unknowns(data.unknowns, x, ("force_per_unit",), data)
    before = fit_loop(_build_problem(data, plain, everything), max_iterations=_ITERATIONS).sigma
    found = []
    for kind, words in MISSING.items():
        if kind in data.unknowns.kinds:
            continue
        progress(f"trying {words}")
        u = extend_unknowns(data.unknowns, x, ("force_per_unit", kind), data)
        fit = fit_loop(_build_problem(data, u, everything), max_iterations=_ITERATIONS)
        fall = float(1 - np.exp(np.mean(np.log(fit.sigma / before))))
        value = read_kind(u, fit, kind)[0]
        found.append((fall, f"{words} ({kind} {value[0]:.2g}) takes {100 * fall:.0f} % off the residual", kind))
    best = max(found, default=(0.0, "", ""))
    if best[0] < MIN_FALL:
        return f"; neither {' nor '.join(MISSING.values())} explains it; log the servo's output and supply voltage"
    return f"; what is missing most is {best[1]}; write '{best[2]}: {{estimate: START}}' into the controller file"


def extend_unknowns(u: LoopUnknowns, x: np.ndarray, kinds: Sequence[str], data: LoopData) -> LoopUnknowns:
    """Return the unknowns at a solution, with further kinds free at all joints."""
    values = u.with_values(x)
    more = [kind for kind in kinds if kind not in u.kinds]
    wider = build_unknowns(data.law, u.space, values, [*u.kinds, *more])
    n = len(u.kinds)
    free, lower, upper, prior = (np.array(a) for a in (wider.free, wider.lower, wider.upper, wider.prior))
    free[:n], lower[:n], upper[:n], prior[:n] = u.free, u.lower, u.upper, u.prior
    return replace(wider, free=free, lower=lower, upper=upper, prior=prior)


def read_kind(u: LoopUnknowns, fit: LoopFit, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (na,) of a kind, and their standard errors, zero where it is not free."""
    where = np.full(u.free.shape, -1)
    where[u.free] = np.arange(int(u.free.sum()))
    at, sigma = where[u.kinds.index(kind)], np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    return u.with_values(fit.x)[kind], np.where(at >= 0, sigma[at], 0.0)


def _build_problem(data: LoopData, u: LoopUnknowns, chosen: Sequence[int]) -> LoopProblem:
    return data.pick(chosen).build_problem(u)
