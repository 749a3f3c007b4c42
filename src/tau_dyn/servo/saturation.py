"""Servos that saturate, where no law is given: the start of a fit with a largest torque.

Without a law, torque grows with the position error. A servo that turns at full output for most of a step does not fit that: a
linear law follows its steps with a gain far below the true one, and no local search finds the other solution. The equation error
of samples with small position errors gives the gain below saturation; with it and a limit where these errors end, a few steps
of the search tell by their residual whether the joint saturates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.servo.data import LoopData, is_large
from tau_dyn.servo.fit import fit_loop
from tau_dyn.servo.preparation import LoopLogs, prepare_loop
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import COMMANDS

_SHARES = (0.5, 0.3, 0.2, 0.1, 0.05)
"""Position errors up to which a joint may be linear, as shares of its largest ones."""
_ITERATIONS = 12
"""Steps of the search that are compared: residuals with and without a limit differ by factors then."""
_MAX_LEFT = 0.7
"""Largest residual with a limit, as a share of that without, of a joint that saturates."""


def start_saturated(given: LoopLogs, records: Sequence[LoopRecord]) -> tuple[LoopLogs, LoopData]:
    """Return logs and the start of their fit, with an estimated limit of the torque at joints that saturate.

    A given law, and one whose residual is small without a limit, stay as they are.

    Args:
        given: The logs, with their law.
        records: The records to fit.
    """
    data, law = prepare_loop(given, records), given.law
    is_guessed = law.estimated == {"position_gain"} and np.all(np.isinf(law.values["limit"]))
    if (
        not is_guessed
        or law.command != COMMANDS[0]
        or any("limit" in text for text in (*given.own.fix, *given.own.bound))
    ):
        return given, data
    plain = fit_loop(data.shorten().build_problem(), max_iterations=_ITERATIONS)
    if not is_large(plain):
        return given, data
    given.progress("torque limits from several starts")
    errors = [np.quantile(np.abs(r.command - r.q), 0.99, axis=0) for r in records]
    limited = replace(law, estimated=law.estimated | {"limit"})
    tried = []
    for share in _SHARES:
        widest = share * np.max(errors, axis=0)
        start = prepare_loop(replace(given, law=limited), records, widest)
        gain = start.unknowns.values["position_gain"] * law.values["force_per_unit"]
        unknowns = replace(start.unknowns, values={**start.unknowns.values, "limit": gain * widest})
        start = replace(start, unknowns=unknowns)
        tried.append((start, fit_loop(start.shorten().build_problem(), max_iterations=_ITERATIONS)))
    sigma = np.array([fit.sigma for _, fit in tried])
    best, found = np.argmin(sigma, axis=0), np.min(sigma, axis=0) < _MAX_LEFT * plain.sigma
    if not np.any(found):
        return given, data
    values = {key: np.array(x) for key, x in data.unknowns.values.items()}
    for j in np.flatnonzero(found):
        start, fit = tried[best[j]]
        for key, x in start.unknowns.with_values(fit.x).items():
            values[key][j] = x[j]
    start = tried[0][0]
    free = np.array(start.unknowns.free)
    free[start.unknowns.kinds.index("limit"), ~found] = False
    unknowns = replace(start.unknowns, values=values, free=free, space=data.space)
    given = replace(given, law=limited)
    return given, replace(data, law=limited, unknowns=unknowns)
