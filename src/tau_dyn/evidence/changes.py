r"""Changes within a log: a sign, a gain, friction, a constant force, a body at the tool or the direction of gravity.

Every log is tested separately: another load in another log is not a change within a log. With white rows

    no change    y = X theta + e                              X: all columns of the model, smooth functions of q and v
    step         y = X theta + 1[t > tau] C gamma + e
    drift        y = X theta + r(t) C gamma + e               r: linear, or exponential with a time constant
    factor       y_k(t > tau) = s (X theta)_k + e             of one joint; s = -1 if its sign changes

the score statistic of every time tau follows from cumulative products of `C`, of an orthonormal basis `Q` of `X` and of the
residual, in one pass over the rows (Andrews 1993). A change of sign corrupts the fit itself, so it is tested without a fit: the
sign of the joint's forces is changed after every tau and X is fitted again. The best hypothesis is then refined: the noise is
estimated with it, its time is searched again, and its statistic is divided by the scatter of blocks of 2 s and more.

A change has to be significant over all joints, kinds and times of all logs, to fit better than every drift of the same column
(a warming machine drifts), and to be larger than the error of a textbook law. Smooth functions of a joint's own motion are in
X, so that missing friction of the model is not mistaken for a change between a slow and a fast part of the motion.

A change that ends within the log, such as a brake that drags for a while, is two steps of which none holds alone. Where no step
holds, pairs of times are scanned, and each of the two steps is tested with the other one in the model.

Reference: Andrews 1993 (tests for a structural change with unknown change point); Bai & Perron 1998 (several changes, one after
the other).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.estimate import Regression, assign_blocks, solve_scaled
from tau_dyn.evidence.change_points.log_data import Columns, Hypothesis, Kind, LogData, list_hypotheses
from tau_dyn.evidence.change_points.step import LEVEL, Step, fit_step, select_hypothesis, select_pulse
from tau_dyn.evidence.change_points.white_rows import estimate_noise, make_rows
from tau_dyn.evidence.plausibility import MAX_LAW_ERROR
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE
from tau_dyn.mechanism import Mechanism
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import find_end_link

MAX_CHANGES = 4
"""Largest number of changes in one log; with more, the log is a sequence of states, and the first ones are reported."""
MAX_TESTS = 12
"""Largest number of hypotheses tested in one log, including rejected ones and drifts; bounds computing time."""
MAX_ROWS = 20_000
"""Largest number of tested rows of a log; a longer log is reduced to every second, third, .. block of 2 s."""
POINT_BODY = ("mass", "mx", "my", "mz")
"""Inertial numbers of a tested body at the tool; its inertia about its own centre is small compared with those."""
MIN_FRICTION_RATIO = 0.2
"""Change of a joint's force over its friction from which it is reported: friction of geared joints varies by tens of per cent
with speed, load, position and temperature, and another part of the motion shows another part of it."""


@dataclass(frozen=True)
class LogChange:
    """A change within a log.

    Attributes:
        log: Name of the log.
        joint: The joint; empty for a change that acts on all joints.
        time_s: Time of the change on the log's clock [s].
        time_stderr_s: Standard error of the time [s].
        kind: Kind of the change.
        before: Value before the change: 1 for a factor, 0 for an added force, body or turn.
        after: Value after the change, in the same unit.
        unit: Unit of both values; empty for a factor.
        p_value: p-value of such a step in any log without a change.
    """

    log: str
    joint: str
    time_s: float
    time_stderr_s: float
    kind: Kind
    before: float
    after: float
    unit: str
    p_value: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "log": self.log,
            "joint": self.joint or None,
            "time_s": self.time_s,
            "time_stderr_s": self.time_stderr_s,
            "kind": self.kind,
            "before": self.before,
            "after": self.after,
            "unit": self.unit,
            "p_value": self.p_value,
        }


def find_changes(regression: Regression, shared: Mapping[Kind, Columns] | None = None) -> tuple[LogChange, ...]:
    """Return the changes within each log of a regression, in time order.

    Args:
        regression: Columns and forces; nominal or fitted values are not used.
        shared: Columns (n, m, d) of each run of changes that act on all joints, by kind.

    Returns:
        The changes; also empty if the runs hold no positions and speeds, or too few rows for their columns.
    """
    if any(not {"q", "v"} <= set(run.signals) for run in regression.runs):
        return ()
    logs = list(dict.fromkeys(run.name for run in regression.runs))
    found: list[LogChange] = []
    for name in logs:
        places = [k for k, run in enumerate(regression.runs) if run.name == name]
        runs = tuple(regression.runs[k] for k in places)
        both: dict[Kind, Columns] = {kind: [columns[k] for k in places] for kind, columns in (shared or {}).items()}
        found += _search_log(replace(regression, runs=runs, everything=None), both, len(logs))
    return tuple(found)


def build_shared_columns(regression: Regression, mechanism: Mechanism) -> dict[Kind, Columns]:
    """Return the columns (n, m, d) of each run of a body at the tool and of a turn of gravity [kg, kg m; rad].

    Args:
        regression: Regression with the columns of all bodies and the positions.
        mechanism: Mechanism at fitted or nominal values, for the turn of gravity.
    """
    found: dict[Kind, Columns] = {}
    runs, link = regression.runs, find_end_link(mechanism.robot)
    plain = [name.partition("@")[0] for name in regression.parameters.names]
    own = [[k for k, name in enumerate(plain) if link and name == f"{link.link}.{part}"] for part in POINT_BODY]
    if own[0]:
        found["payload"] = [np.stack([run.W[:, :, k].sum(axis=2) for k in own if k], axis=2) for run in runs]
    if np.any(mechanism.robot.model.gravity.linear) and all("q" in run.signals for run in runs):
        found["gravity_direction"] = [mechanism.gravity_turn(run.signals["q"]) for run in runs]
    return found


def describe_changes(changes: Sequence[LogChange]) -> list[str]:
    """Return a warning with the code `changes_within_log` for each change."""
    return [_describe(change) for change in changes]


def list_changes(changes: Sequence[LogChange]) -> dict[str, Any]:
    """Return the two fields of a JSON result, `changes` and their times [s] as `time_s`; empty without a change."""
    if not changes:
        return {}
    return {"changes": [one.to_dict() for one in changes], "time_s": [one.time_s for one in changes]}


def _describe(change: LogChange) -> CodedWarning:
    at = f"at t = {change.time_s:.4g} s (± {change.time_stderr_s:.2g} s)"
    joint, size = change.joint, f"{change.after - change.before:+.3g} {change.unit}"
    sentence = {
        "sign": f"{joint}: the force changes its sign {at}",
        "gain": f"{joint}: the force changes by a factor of {change.after:.3g} {at}",
        "friction": f"{joint}: friction changes by {size} {at}; a brake, contact or a tight cable",
        "offset": f"{joint}: a constant force of {size} is added {at}",
        "payload": f"the body at the tool changes by {size} {at}",
        "gravity_direction": f"the direction of gravity turns by {change.after:.3g} rad {at}; the base tilts",
    }[change.kind]
    remedy = "use the parts before and after as two logs"
    return CodedWarning("changes_within_log", f"{change.log}: {sentence}; {remedy}", [joint] if joint else [])


def _search_log(regression: Regression, shared: Mapping[Kind, Columns], n_logs: int) -> list[LogChange]:
    """Return the changes of one log; the largest is added to the model before the next is searched."""
    regression = _thin(regression)
    data, found = LogData(regression), []
    every = list_hypotheses(regression, shared)
    left = every
    for _ in range(MAX_TESTS):
        white = make_rows(data, estimate_noise(data, 0))
        best = None if white is None else select_hypothesis(white, left, len(every) * n_logs)
        if best is None or len(found) == MAX_CHANGES:
            break
        change, now = _test(data, *best, len(every) * n_logs)
        left = [one for one in left if one is not best[0]] if now is data else every
        new = change is not None and not any(_is_one_event(change, other, data.memory_s) for other in found)
        found, data = [*found, *([change] if change and new else [])], now
    found = found or _search_pulse(LogData(regression), every, len(every) * n_logs)
    return sorted(found, key=lambda one: one.time_s)


def _is_one_event(change: LogChange, other: LogChange, memory_s: float) -> bool:
    """Return whether a change is part of an earlier one: at the same time, at its joint or at all joints."""
    apart = abs(change.time_s - other.time_s) - 2 * (change.time_stderr_s + other.time_stderr_s)
    return apart < memory_s and other.joint in ("", change.joint)


def _thin(regression: Regression) -> Regression:
    """Return the log with at most `MAX_ROWS` usable rows, whole blocks left out evenly."""
    every = -(-sum(int(run.usable.sum()) for run in regression.runs) // MAX_ROWS)
    if every <= 1:
        return regression
    runs = [
        replace(run, usable=run.usable & (assign_blocks(run.t - run.t[0]) % every == 0)[:, None])
        for run in regression.runs
    ]
    return replace(regression, runs=tuple(runs))


def _test(
    data: LogData, hypothesis: Hypothesis, time_s: float, n_hypotheses: int, until_s: float = np.inf
) -> tuple[LogChange | None, LogData]:
    """Return a change if a hypothesis holds, and the log with it, or with an equivalent drift, in the model.

    Args:
        data: The log.
        hypothesis: The change.
        time_s: Its time [s].
        n_hypotheses: Number of hypotheses that were tried.
        until_s: Its end, which is in the model of the log [s]: the size of its force counts up to it.
    """
    step = fit_step(data, hypothesis, time_s)
    if step is None:
        return None, data
    p_value = min(1.0, float(n_hypotheses * step.n_blocks * step.chance))
    if p_value > LEVEL:
        return None, data
    if step.over_drift < MIN_2LOGL_DIFFERENCE:
        return None, data.drift(hypothesis, step.drift)
    taken = data.take(hypothesis, step.time_s, step.factor).leave_out(step.time_s)
    # joints share bodies: those of a poor model may fit other joints better by another sign of this one
    if not hypothesis.columns and _measure_own_misfit(taken, hypothesis) > _measure_own_misfit(data, hypothesis):
        return None, data
    size, before, after, unit = _measure(taken, hypothesis, step, until_s)
    if size < 1:  # in the model, so that no other kind is named in its place
        return None, taken
    kind = hypothesis.kind
    if not hypothesis.columns:
        kind = "sign" if step.factor < 0 else "gain"
    joint = "" if hypothesis.output < 0 else data.regression.outputs[hypothesis.output]
    name = data.regression.runs[0].name
    found = LogChange(name, joint, step.time_s, step.time_stderr_s, kind, before, after, unit, p_value)
    return found, taken


def _search_pulse(data: LogData, every: Sequence[Hypothesis], n_hypotheses: int) -> list[LogChange]:
    """Return a change and its end, such as a brake that drags for a while; empty unless both hold.

    None of the two may hold alone. Each is tested with the other one in the model (Bai & Perron 1998).
    """
    white = make_rows(data, estimate_noise(data, 0))
    pulse = None if white is None else select_pulse(white, every, n_hypotheses)
    if pulse is None:
        return []
    hypothesis, start_s, end_s = pulse
    end, _ = _test(data.take(hypothesis, start_s, 1.0).leave_out(start_s), hypothesis, end_s, n_hypotheses)
    if end is None:
        return []
    rest = data.take(hypothesis, end.time_s, 1.0).leave_out(end.time_s)
    start, _ = _test(rest, hypothesis, start_s, n_hypotheses, end.time_s)
    return [] if start is None else [start, end]


def _measure(data: LogData, hypothesis: Hypothesis, step: Step, until_s: float) -> tuple[float, float, float, str]:
    """Return the size of a change over the least reported size, the values before and after it, and their unit.

    The change is in the model of the log. Its size is the rms of its force. Models are wrong by `MAX_LAW_ERROR` of a joint's
    force without its mean and by `MIN_FRICTION_RATIO` of its friction; the larger of the two is the least reported size.
    """
    sizes, coulomb, output = [0.0], 0.0, hypothesis.output
    for k in range(len(data.regression.outputs)):
        if output not in (-1, k) or not any(run.usable[:, k].any() for run in data.runs):
            continue
        force = np.concatenate([run.y[run.usable[:, k], k] for run in data.runs])
        friction, coulomb = _estimate_friction(data, k)
        added = _add_step(data, hypothesis, step, k, until_s) if hypothesis.columns else (step.factor - 1) * force
        least = max(MAX_LAW_ERROR * float(np.std(force)), MIN_FRICTION_RATIO * float(np.std(friction)))
        sizes.append(_measure_rms(added) / max(least, 1e-300) if len(added) else 0.0)
    size = max(sizes)
    if not hypothesis.columns:
        return size, 1.0, step.factor, ""
    amplitude = float(step.amplitudes[0])
    if hypothesis.kind == "payload":
        return size, 0.0, amplitude, "kg"
    if hypothesis.kind == "gravity_direction":
        return size, 0.0, float(np.linalg.norm(step.amplitudes)), "rad"
    before = coulomb if hypothesis.kind == "friction" else 0.0
    return size, before, before + amplitude, data.regression.units[output]


def _measure_rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _add_step(data: LogData, hypothesis: Hypothesis, step: Step, output: int, until_s: float) -> np.ndarray:
    """Return the force of a step at the usable samples (n,) of an output after it, up to a time [s]."""
    made = []
    for c, run in zip(hypothesis.columns, data.runs, strict=True):
        after = run.usable[:, output] & (run.t > step.time_s) & (run.t <= until_s)
        made.append(c[after, output] @ step.amplitudes)
    return np.concatenate(made)


def _measure_own_misfit(data: LogData, hypothesis: Hypothesis) -> float:
    """Return the residual of a fit of the joint's force alone, over that force without its mean."""
    W, y, theta = _fit_alone(data, hypothesis.output)
    return float(np.std(y - W @ theta)) / max(float(np.std(y)), 1e-300)


def _fit_alone(data: LogData, output: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns (n, p), force (n,) and parameters (p,) of a joint at its usable samples, fitted to its force alone."""
    rows, y = [], []
    for columns, run in zip(data.columns, data.runs, strict=True):
        rows.append(columns[run.usable[:, output], output])
        y.append(run.y[run.usable[:, output], output])
    W, force = np.concatenate(rows), np.concatenate(y)
    return W, force, solve_scaled(W, force, 1e-7)


def _estimate_friction(data: LogData, output: int) -> tuple[np.ndarray, float]:
    """Return a joint's friction at its usable samples (n,) and its mean Coulomb friction, by a fit of its force alone."""
    joint, names = data.regression.outputs[output], data.regression.parameters.names
    W, _, theta = _fit_alone(data, output)
    coulomb, viscous = (
        [k for k, name in enumerate(names) if name.startswith(f"{joint}.{law}")] for law in ("coulomb", "viscous")
    )
    both = [*coulomb, *viscous]
    return W[:, both] @ theta[both], float(theta[coulomb].mean()) if coulomb else 0.0
