"""Servos that saturate and whose gain is not known: the start of a fit.

Without a law, torque grows with the position error. A servo that turns at full output for most of a step does not fit that: a
linear law follows its steps with a gain far below the true one, and no local search finds the other solution. The equation error
of samples with small position errors gives the gain below saturation; with it and a limit where these errors end, a few steps
of the search tell by their residual whether the joint saturates, and whether its law takes off a share of the speed. A law whose
gain is to be estimated has a limit of its own, and the start is one of several gains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.servo.data import LoopData, is_large, keep_kinds
from tau_dyn.servo.fit import LoopFit, fit_loop
from tau_dyn.servo.preparation import LoopLogs, prepare_loop
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import COMMANDS

_SHARES = (0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01)
"""Position errors up to which a joint may be linear, as shares of its largest ones."""
_ITERATIONS = 12
"""Steps of the search that are compared: residuals with and without a limit differ by factors then."""
_MAX_WITH_DERIVATIVE = 0.9
"""Largest residual with a derivative gain, as a share of that without, of a joint whose law has one: 0.1 nats a sample."""
_MAX_LEFT = 0.7
"""Largest residual with a limit, as a share of that without, of a joint that saturates."""


def start_saturated(
    given: LoopLogs, records: Sequence[LoopRecord], kinds: Sequence[str] | None = None
) -> tuple[LoopLogs, LoopData]:
    """Return logs and the start of their fit.

    Without a law, a limit of the torque is estimated at joints that saturate. With a law whose position gain is to be
    estimated, the fit starts where a few steps of the search leave least: at the gain of all samples, of those with small
    position errors, or at the law's own. A law with a known gain, and one whose residual is small at once, stay as they are.

    Args:
        given: The logs, with their law.
        records: The records to fit.
        kinds: Kinds of unknowns that the fit will have in addition to the law's; None for all.
    """
    data, law = prepare_loop(given, records), given.law
    is_guessed = law.estimated <= {"position_gain", "back_emf"} and np.all(np.isinf(law.values["limit"]))
    is_limited = any("limit" in text for text in (*given.own.fix, *given.own.bound))
    if (
        law.command != COMMANDS[0]
        or "position_gain" not in law.estimated
        or (not law.given and (is_limited or not is_guessed))
    ):
        return given, data
    plain = fit_loop(data.shorten().build_problem(), max_iterations=_ITERATIONS)
    if not is_large(plain):
        return given, data
    given.progress("torque limits from several starts" if is_guessed else "position gains from several starts")
    widest = [share * _list_largest_errors(records) for share in _SHARES]
    if is_guessed:
        limited, start = _with_limits(
            given,
            data,
            plain,
            [_start_limited(given, records, errors, beyond) for errors in widest for beyond in (True, False)],
        )
        return (limited, start) if start is data else (limited, _with_derivative_gains(given, start, kinds))
    starts = [prepare_loop(given, records, errors) for errors in widest]
    starts.append(prepare_loop(given, records, estimate_gain=False))
    tried = [(data, plain), *((start, _search(start)) for start in starts)]
    best = np.argmin([fit.sigma for _, fit in tried], axis=0)
    values = _take_values(data, [tried[k] for k in best])
    return given, replace(data, unknowns=replace(data.unknowns, values=values))


def _list_largest_errors(records: Sequence[LoopRecord]) -> np.ndarray:
    """Return the largest position error of each joint but for outliers (na,) [rad]."""
    return np.max([np.quantile(np.abs(r.command - r.q), 0.99, axis=0) for r in records], axis=0)


def _search(start: LoopData) -> LoopFit:
    return fit_loop(start.shorten().build_problem(), max_iterations=_ITERATIONS)


def _start_limited(given: LoopLogs, records: Sequence[LoopRecord], widest: np.ndarray, beyond: bool) -> LoopData:
    """Return a start with a limit where position errors of `widest` (na,) [rad] reach it."""
    law = replace(given.law, estimated=given.law.estimated | {"limit"})
    start = prepare_loop(replace(given, law=law), records, widest, beyond=beyond)
    gain = start.unknowns.values["position_gain"] * law.values["force_per_unit"]
    return replace(start, unknowns=replace(start.unknowns, values={**start.unknowns.values, "limit": gain * widest}))


def _with_limits(
    given: LoopLogs, data: LoopData, plain: LoopFit, starts: Sequence[LoopData]
) -> tuple[LoopLogs, LoopData]:
    """Return the logs and the start with a limit at the joints whose residual it reduces far below that of `plain`."""
    tried = [(start, _search(start)) for start in starts]
    sigma = np.array([fit.sigma for _, fit in tried])
    best, found = np.argmin(sigma, axis=0), np.min(sigma, axis=0) < _MAX_LEFT * plain.sigma
    if not np.any(found):
        return given, data
    values = _take_values(data, [tried[k] if found[j] else None for j, k in enumerate(best)])
    start = _free_at(starts[0], ("limit",), found)
    start = replace(start, unknowns=replace(start.unknowns, values=values, space=data.space))
    return replace(given, law=start.law), start


def _with_derivative_gains(given: LoopLogs, start: LoopData, kinds: Sequence[str] | None) -> LoopData:
    """Return a start with a derivative gain at the joints with a limit whose logs show one.

    Viscous friction is the same as a derivative gain until the servo saturates.
    """
    limited = start.unknowns.free[start.unknowns.kinds.index("limit")]
    law = replace(start.law, estimated=start.law.estimated | {"derivative_gain"})
    wide = _free_at(prepare_loop(replace(given, law=law), start.records), ("limit", "derivative_gain"), limited)
    values = {**start.unknowns.values}
    values["derivative_gain"] = values["viscous"] / values["force_per_unit"] * limited
    wide = replace(wide, unknowns=replace(wide.unknowns, values=values, space=start.unknowns.space))
    before, after = ((x, _search(x)) for x in (one if kinds is None else _keep(one, kinds) for one in (start, wide)))
    shown = limited & (after[1].sigma < _MAX_WITH_DERIVATIVE * before[1].sigma)
    if not np.any(shown):
        return start
    values = _take_values(start, [after if x else None for x in shown])
    values["derivative_gain"] = np.where(shown, values["derivative_gain"], 0.0)
    wide = _free_at(wide, ("derivative_gain",), shown)
    return replace(wide, unknowns=replace(wide.unknowns, values=values))


def _keep(data: LoopData, kinds: Sequence[str]) -> LoopData:
    """Return data with unknowns of some kinds and of the law only."""
    return replace(data, unknowns=keep_kinds(data, (*kinds, *data.law.estimated)))


def _free_at(data: LoopData, kinds: Sequence[str], joints: np.ndarray) -> LoopData:
    """Return data whose unknowns of some kinds are free at some joints (na,) only."""
    free = np.array(data.unknowns.free)
    for kind in kinds:
        free[data.unknowns.kinds.index(kind), ~joints] = False
    return replace(data, unknowns=replace(data.unknowns, free=free))


def _take_values(data: LoopData, ends: Sequence[tuple[LoopData, LoopFit] | None]) -> dict[str, np.ndarray]:
    """Return the start values with each joint's from its own search; those of `data` for a joint without one."""
    values = {key: np.array(x) for key, x in data.unknowns.values.items()}
    for j, end in enumerate(ends):
        if end is not None:
            for key, x in end[0].unknowns.with_values(end[1].x).items():
                values[key][j] = x[j]
    return values
