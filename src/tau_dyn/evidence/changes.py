r"""Changes within a log: a sign, a gain, friction, a constant force, a body at the tool or the direction of gravity.

Every log is tested by itself: another load in another log is no change within one. With white rows

    no change    y = X theta + e                              X: all columns of the model, smooth functions of q and v
    step         y = X theta + 1[t > tau] C gamma + e
    drift        y = X theta + r(t) C gamma + e               r: linear, or exponential with a time constant
    factor       y_k(t > tau) = s (X theta)_k + e             of one joint; s = -1 where its sign turns

the score statistic of every time tau follows from cumulative products of `C`, of an orthonormal basis `Q` of `X` and of the
residual, in one pass over the rows (Andrews 1993). A sign that turns spoils the fit itself, so it is tried without a fit: the
joint's forces are turned after every tau and X is fitted again. The best hypothesis is then refined: the noise is estimated with
it, its time is looked for again, and its statistic is divided by the scatter of blocks of 2 s and more.

A change has to be significant over all joints, kinds and times of all logs, to fit better than every drift of the same column
(what warms up drifts), and to be larger than the error of a textbook law. Smooth functions of a joint's own motion are in X, so
that friction that the model lacks is no change between a slow and a fast part of the motion.

Reference: Andrews 1993 (tests for a structural change with unknown change point); Bai & Perron 1998 (several changes, one after
the other).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.estimate import (
    Autoregression,
    Regression,
    RegressionRun,
    Whitener,
    assign_blocks,
    fit_autoregression,
    solve_scaled,
)
from tau_dyn.evidence.null_model import (
    MIN_UNABSORBED_SHARE,
    compute_overdispersion,
    compute_score_statistics,
    orthonormalise,
    smooth,
)
from tau_dyn.evidence.plausibility import MAX_LAW_ERROR
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE
from tau_dyn.log import find_true_runs
from tau_dyn.mechanism import Mechanism
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import find_end_link

LEVEL = 1e-6
"""Chance, by the test, that any of the logs of one fit gets a change that it does not have. It is stricter than the level of a
cause: ten blocks of a residual with structure have heavier tails than their F distribution, and a true change exceeds the bound
by orders of magnitude."""
MAX_CHANGES = 4
"""Changes looked for in one log; with more, the log is a sequence of states, and the first ones are reported."""
MAX_TESTS = 12
"""Hypotheses tested in one log, those that are rejected and drifts included; bounds the time."""
MIN_SIDE_BLOCKS = 2
"""Blocks of 2 s with usable samples that both sides of a change need; one block alone has no scatter."""
MIN_BLOCKS = 5
"""Blocks of a log below which no time is tried: two on both sides, and one between."""
MAX_ROWS = 20_000
"""Rows of a log that are tested; of a longer one, every second, third, .. block of 2 s."""
N_TIMES = 250
"""Times tried at first, evenly spread over the rows; the best is refined among all rows near it."""
DRIFT_TIME_SHARES = (0.03, 0.1, 0.3, 1.0)
"""Time constants of a drift over the log's length; a linear drift is an exponential one of infinite time constant."""
BLOCKS_TOGETHER = (1, 2, 4)
"""Blocks of 2 s joined for the scatter: a residual that repeats with the motion is correlated over its period, up to 8 s."""
MIN_SCATTER_BLOCKS = 8
"""Joined blocks from which their scatter is used; fewer do not estimate a variance."""
MAX_ORDER = 8
"""Order of the autoregressive noise model, as for causes."""

POINT_BODY = ("mass", "mx", "my", "mz")
"""Inertial numbers of a body at the tool that is tried; its inertia about its own centre is small against those."""

MIN_FRICTION_RATIO = 0.2
"""Change of a joint's force over its friction from which it is reported: friction of geared joints varies by tens of per cent
with speed, load, position and temperature, and another part of the motion sees another part of it."""
SLOW_SPEED_SHARES = (0.02, 0.06, 0.2)
"""Speeds over the fastest at which Stribeck friction that the model may lack has fallen to a third: a logarithmic grid, as
polynomials of the speed do not follow it."""
MIN_FACTOR = 1e-3
"""Smallest factor by which forces are divided; a channel that dies has none."""
MEMORY_PERIODS = 2.0
"""Half-width of a step after the fit's low-pass, in periods of its cutoff: 0.3 % of the step is left after it."""
MEMORY_ROWS = 2
"""Rows on both sides of a change that are left out where no low-pass is known."""

Kind = Literal["sign", "gain", "friction", "offset", "payload", "gravity_direction"]
Columns = Sequence[np.ndarray]


@dataclass(frozen=True)
class LogChange:
    """A change within a log.

    Attributes:
        log: Name of the log.
        joint: The joint; empty for a change that acts on all joints.
        time_s: Time of the change on the log's clock [s].
        time_stderr_s: Standard error of the time [s].
        kind: What changes.
        before: Value before the change: 1 for a factor, 0 for an added force, body or turn.
        after: Value after the change, in the same unit.
        unit: Unit of both values; empty for a factor.
        p_value: Chance of such a step in any log without a change.
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
        regression: Columns and forces; nominal or fitted values play no part.
        shared: Columns (n, m, d) of each run of changes that act on all joints, by kind.

    Returns:
        The changes; empty also where the runs hold no positions and speeds, or too few rows for their columns.
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
        regression: Holds the columns of all bodies and the positions.
        mechanism: At fitted or nominal values, which a turn of gravity acts on.
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
    """Return the two fields of a JSON result: `changes`, and their times [s] as `time_s`; none without a change."""
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


class _Hypothesis(NamedTuple):
    """A change of one kind: the output that it acts on (-1 for all), and columns (n, m, d) of each run; none for a factor."""

    kind: Kind
    output: int
    columns: Columns


class _LogData(NamedTuple):
    """One log with all changes accounted for that were found.

    Attributes:
        regression: The runs of this log.
        factors: Joint, time [s] and factor of forces that changed by a factor.
        steps: Columns (n, m, d) of each run of the other changes.
        times: Times of the changes whose transition is left out [s].
    """

    regression: Regression
    factors: tuple[tuple[int, float, float], ...] = ()
    steps: tuple[Columns, ...] = ()
    times: tuple[float, ...] = ()

    @property
    def runs(self) -> tuple[RegressionRun, ...]:
        """The runs with forces divided by the factors found."""
        found = []
        for run in self.regression.runs:
            y, usable = run.y.copy(), run.usable.copy()
            for output, time_s, factor in self.factors:
                y[run.t > time_s, output] /= factor
            for time_s in self.times:
                usable[np.abs(run.t - time_s) < self.memory_s] = False
            found.append(replace(run, y=y, usable=usable))
        return tuple(found)

    @property
    def columns(self) -> list[np.ndarray]:
        """The model's columns and those of the changes found (n, m, p) of each run."""
        runs = self.regression.runs
        return [np.concatenate([run.W, *(step[r] for step in self.steps)], axis=2) for r, run in enumerate(runs)]

    @property
    def memory_s(self) -> float:
        """Time for which the fit's low-pass smears a step [s]."""
        cutoff = self.regression.preparation.force_cutoff_hz
        step = max((float(np.median(np.diff(run.t))) for run in self.regression.runs if len(run.t) > 1), default=0.0)
        return max(MEMORY_PERIODS / cutoff, MEMORY_ROWS * step)

    def take(self, hypothesis: _Hypothesis, time_s: float, factor: float) -> _LogData:
        """Return the log with one more change accounted for."""
        if hypothesis.columns:
            step = [c * (run.t > time_s)[:, None, None] for c, run in zip(hypothesis.columns, self.runs, strict=True)]
            return self._replace(steps=(*self.steps, step))
        return self._replace(factors=(*self.factors, (hypothesis.output, time_s, factor)))

    def drift(self, hypothesis: _Hypothesis, number: int) -> _LogData:
        """Return the log with a drift of a hypothesis' columns accounted for; of a factor, unchanged."""
        if not hypothesis.columns:
            return self
        ends = min(run.t[0] for run in self.runs), max(run.t[-1] for run in self.runs)
        shapes = [_list_drifts(run.t, *map(float, ends))[number] for run in self.runs]
        drift = [c * x[:, None, None] for c, x in zip(hypothesis.columns, shapes, strict=True)]
        return self._replace(steps=(*self.steps, drift))

    def leave_out(self, time_s: float) -> _LogData:
        """Return the log without the samples about a change."""
        return self._replace(times=(*self.times, time_s))


@dataclass(frozen=True, eq=False)
class _WhiteRows:
    """White rows of one log in time order, no change accounted for that is not in the columns.

    Attributes:
        whiten: Makes rows of arrays over the runs.
        order: Order of those rows in time (R,).
        y: Forces (R,).
        Q: Orthonormal basis of everything accounted for (R, r).
        t: Times (R,) [s].
        output: Outputs (R,).
        block: Numbers of blocks of 2 s (R,).
    """

    whiten: Whitener
    order: np.ndarray
    y: np.ndarray
    Q: np.ndarray
    t: np.ndarray
    output: np.ndarray
    block: np.ndarray

    @property
    def fit(self) -> np.ndarray:
        """Predicted forces (R,)."""
        return self.Q @ (self.Q.T @ self.y)

    def whiten_columns(self, columns: Columns) -> np.ndarray:
        """Return rows (R, d) of columns (n, m, d) over the runs."""
        return self.whiten(columns)[self.order]

    def make_rows(self, hypothesis: _Hypothesis) -> np.ndarray:
        """Return the rows (R, d) whose step a hypothesis is; of a factor, the predicted force."""
        if hypothesis.columns:
            return self.whiten_columns(hypothesis.columns)
        return np.where(self.output == hypothesis.output, self.fit, 0.0)[:, None]


def _search_log(regression: Regression, shared: Mapping[Kind, Columns], n_logs: int) -> list[LogChange]:
    """Return the changes of one log, the largest first taken into account before the next is looked for."""
    regression = _thin(regression)
    data, found = _LogData(regression), []
    every = _list_hypotheses(regression, shared)
    left = every
    for _ in range(MAX_TESTS):
        white = _make_rows(data, _estimate_noise(data, (), 0))
        best = None if white is None else _select(white, left, len(every) * n_logs)
        if best is None or len(found) == MAX_CHANGES:
            break
        change, now = _test(data, *best, len(every) * n_logs)
        left = [one for one in left if one is not best[0]] if now is data else every
        new = change is not None and not any(_is_one_event(change, other, data.memory_s) for other in found)
        found, data = [*found, *([change] if change and new else [])], now
    return sorted(found, key=lambda one: one.time_s)


def _is_one_event(change: LogChange, other: LogChange, memory_s: float) -> bool:
    """Return whether a change is part of one found before: at the same time, at its joint or at all joints."""
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


def _list_hypotheses(regression: Regression, shared: Mapping[Kind, Columns]) -> list[_Hypothesis]:
    """Return all kinds of changes: of each joint, and of all joints together."""
    found = [_Hypothesis(kind, -1, columns) for kind, columns in shared.items()]
    for k in range(len(regression.outputs)):
        if not any(run.usable[:, k].any() for run in regression.runs):
            continue
        constant = [np.ones((len(run.t), 1)) for run in regression.runs]
        found += [_Hypothesis("sign", k, ()), _Hypothesis("gain", k, ())]
        found.append(_Hypothesis("offset", k, _place(regression, k, constant)))
        found.append(_Hypothesis("friction", k, _place(regression, k, _make_friction(regression, k))))
    return found


def _place(regression: Regression, output: int, columns: Columns) -> list[np.ndarray]:
    """Return columns (n, m, d) that are zero at all outputs but one, at which they are given (n, d)."""
    found = []
    for run, x in zip(regression.runs, columns, strict=True):
        made = np.zeros((len(run.t), len(regression.outputs), x.shape[1]))
        made[:, output] = x
        found.append(made)
    return found


def _make_friction(regression: Regression, output: int) -> list[np.ndarray]:
    """Return Coulomb friction (n, 1) of one joint, filtered as the fit's where the model has it: a brake or contact adds it."""
    joint, found = regression.outputs[output], []
    own = [k for k, name in enumerate(regression.parameters.names) if name.startswith(f"{joint}.coulomb")]
    for run in regression.runs:
        found.append(run.W[:, output, own].sum(axis=1)[:, None] if own else np.sign(run.signals["v"][:, [output]]))
    return found


def _estimate_noise(data: _LogData, further: Columns, order: int) -> tuple[Autoregression, ...]:
    """Return the noise model of each output, of at most an order, with further columns (n, m, d) of each run accounted for."""
    runs, known, rich, models = data.runs, data.columns, _make_smooth(data.regression), []
    for k in range(len(data.regression.outputs)):
        columns = [np.concatenate([c[:, k], x], axis=1) for c, x in zip(known, rich[k], strict=True)]
        if further:
            columns = [np.concatenate([c, x[:, k]], axis=1) for c, x in zip(columns, further, strict=True)]
        models.append(_fit_noise(runs, k, columns, order))
    return tuple(models)


def _make_rows(data: _LogData, noise: Sequence[Autoregression]) -> _WhiteRows | None:
    """Return white rows; None where the log is too short for its columns."""
    runs, rich = data.runs, _make_smooth(data.regression)
    known = data.columns
    if sum(int(run.usable.sum()) for run in runs) < 2 * (sum(x[0].shape[1] for x in rich) + known[0].shape[2]):
        return None
    whiten = Whitener.of(runs, [run.usable for run in runs], noise)
    order = np.argsort(whiten.t, kind="stable")
    own = []
    for k, x in enumerate(rich):
        placed = np.zeros((whiten.n_rows, x[0].shape[1]))
        placed[whiten.index == k] = whiten.one(k, x)
        own.append(placed)
    Q = orthonormalise(np.concatenate([whiten(known), *own], axis=1)[order])
    y = whiten([run.y for run in runs])[order]
    return _WhiteRows(whiten, order, y, Q, whiten.t[order], whiten.index[order], whiten.block[order])


def _make_smooth(regression: Regression) -> list[list[np.ndarray]]:
    """Return smooth functions (n, c) of each joint's own position and speed, and the same times the direction, of each run."""
    ends = np.cumsum([len(run.t) for run in regression.runs])[:-1]
    found = []
    for k in range(len(regression.outputs)):
        q, v = (np.concatenate([run.signals[x][:, k] for run in regression.runs]) for x in ("q", "v"))
        slow = [np.exp(-np.abs(v) / max(share * np.abs(v).max(), 1e-300)) for share in SLOW_SPEED_SHARES]
        basis = [*smooth(q), *smooth(v), *slow]
        basis += [np.sign(v) * c for c in (np.ones(len(v)), *basis)]
        found.append(np.split(np.column_stack(basis), ends))
    return found


def _fit_noise(runs: Sequence[RegressionRun], output: int, columns: Columns, order: int) -> Autoregression:
    """Return the noise model of what columns (n, c) of one output leave of it."""
    masks = [run.usable[:, output] for run in runs]
    rows = np.concatenate([c[m] for c, m in zip(columns, masks, strict=True)])
    y = np.concatenate([run.y[m, output] for run, m in zip(runs, masks, strict=True)])
    if not len(y):
        return Autoregression(np.zeros(0), 1.0)
    theta = solve_scaled(rows, y, 1e-7)
    stretches = []
    for run, c, mask in zip(runs, columns, masks, strict=True):
        e = run.y[:, output] - c @ theta
        stretches += [e[s] for s in find_true_runs(mask)]
    found = fit_autoregression(stretches, order)
    return replace(found, variance=found.variance * len(y) / max(1, len(y) - np.linalg.matrix_rank(rows)))


def _list_times(white: _WhiteRows, output: int, near: float | None = None) -> np.ndarray:
    """Return the first rows after the times tried, all with `MIN_SIDE_BLOCKS` on both sides.

    Args:
        white: The rows.
        output: The output that changes; -1 for all.
        near: Time about which all rows are tried [s]; None for rows spread over the log.
    """
    rows = np.flatnonzero((white.output == output) | (output < 0))
    blocks = np.unique(white.block[rows])
    if len(blocks) < MIN_BLOCKS:
        return rows[:0]
    first, last = blocks[MIN_SIDE_BLOCKS - 1], blocks[-MIN_SIDE_BLOCKS]
    starts = rows[1:][np.diff(white.t[rows]) > 0]
    starts = starts[(white.block[starts] > first) & (white.block[starts] <= last)]
    every = max(1, -(-len(starts) // N_TIMES))
    if near is None or every == 1:
        return starts[::every]
    closest = int(np.argmin(np.abs(white.t[starts] - near)))
    return starts[max(0, closest - N_TIMES // 2) : closest + N_TIMES // 2]


def _sum_after(starts: np.ndarray, A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return `A' B` (g, a, b) of the rows from each start (g,) on, A (R, a) and B (R, b)."""
    ends = [*starts[1:], len(A)]
    parts = np.stack([A[i:j].T @ B[i:j] for i, j in zip(starts, ends, strict=True)])
    return np.cumsum(parts[::-1], axis=0)[::-1]


def _scan_steps(white: _WhiteRows, C: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the score statistics (g,) of steps of columns (R, d) at each start (g,)."""
    e = white.y - white.fit
    s, A, D = (_sum_after(starts, C, x) for x in (e[:, None], white.Q, C))
    G = D - A @ A.swapaxes(1, 2)
    raw = np.diagonal(D, axis1=1, axis2=2)
    return compute_score_statistics(s, G, raw, np.zeros(C.shape[1], bool), MIN_UNABSORBED_SHARE)[:, 0]


def _scan_sign(white: _WhiteRows, output: int, starts: np.ndarray) -> np.ndarray:
    """Return by how much the squared residual (g,) falls where one output's forces are turned from each start (g,) on."""
    mine = np.where(white.output == output, white.y, 0.0)[:, None]
    before = white.Q.T @ white.y
    after = before - 2 * _sum_after(starts, mine, white.Q)[:, 0]
    return np.sum(after**2, axis=1) - before @ before


def _select(
    white: _WhiteRows, hypotheses: Sequence[_Hypothesis], n_hypotheses: int
) -> tuple[_Hypothesis, float] | None:
    """Return the hypothesis of the largest statistic, each column at the price of Schwarz' criterion, and its time [s].

    None where not even independent noise in the rows would make it significant: coloured noise makes a chance larger.
    """
    best: tuple[float, _Hypothesis, float] | None = None
    for hypothesis in hypotheses:
        starts = _list_times(white, hypothesis.output)
        if not len(starts):
            continue
        if hypothesis.kind == "sign":
            T, size = _scan_sign(white, hypothesis.output, starts), 0
        else:
            C = white.make_rows(hypothesis)
            T, size = _scan_steps(white, C, starts), C.shape[1]
        k = int(np.argmax(T))
        if n_hypotheses * len(np.unique(white.block)) * stats.chi2.sf(T[k], max(1, size)) > LEVEL:
            continue
        merit = float(T[k]) - size * np.log(len(white.y))
        if best is None or merit > best[0]:
            best = merit, hypothesis, float(np.mean(_find_gap(white, hypothesis.output, starts[k])))
    return None if best is None else best[1:]


def _find_gap(white: _WhiteRows, output: int, start: int) -> tuple[float, float]:
    """Return the times of the last row before a start and of the start [s], of the output that changes."""
    before = white.t[:start][(white.output[:start] == output) | (output < 0)]
    return float(before[before < white.t[start]].max()), float(white.t[start])


def _test(
    data: _LogData, hypothesis: _Hypothesis, time_s: float, n_hypotheses: int
) -> tuple[LogChange | None, _LogData]:
    """Return a change if a hypothesis holds, and the log with it, or with the drift that explains as much, accounted for."""
    step = _refine(data, hypothesis, time_s)
    if step is None:
        return None, data
    p_value = min(1.0, float(n_hypotheses * step.n_blocks * step.chance))
    if p_value > LEVEL:
        return None, data
    if step.over_drift < MIN_2LOGL_DIFFERENCE:
        return None, data.drift(hypothesis, step.drift)
    taken = data.take(hypothesis, step.time_s, step.factor).leave_out(step.time_s)
    size, before, after, unit = _measure(taken, hypothesis, step)
    if size < 1:  # accounted for, so that no other kind is named in its place
        return None, taken
    kind = hypothesis.kind
    if not hypothesis.columns:
        kind = "sign" if step.factor < 0 else "gain"
    joint = "" if hypothesis.output < 0 else data.regression.outputs[hypothesis.output]
    name = data.regression.runs[0].name
    found = LogChange(name, joint, step.time_s, step.time_stderr_s, kind, before, after, unit, p_value)
    return found, taken


class _Step(NamedTuple):
    """A step at its best time, against noise that was estimated with it.

    Attributes:
        time_s: Its time, in the middle between two usable rows [s].
        time_stderr_s: Standard error [s].
        factor: The factor that it is; 1 for a step of columns.
        amplitudes: Amplitudes of its columns (d,).
        chance: Chance of its statistic at one time, by the scatter of blocks.
        over_drift: Statistic over that of the best drift of the same columns.
        drift: Number of that drift in `_list_drifts`.
        n_blocks: Blocks of 2 s.
    """

    time_s: float
    time_stderr_s: float
    factor: float
    amplitudes: np.ndarray
    chance: float
    over_drift: float
    drift: int
    n_blocks: int


def _refine(data: _LogData, hypothesis: _Hypothesis, time_s: float) -> _Step | None:
    """Return the step with noise and time of its own; None where the rows do not show one.

    Its time is looked for in rows that are weighed but not whitened: an autoregressive filter would smear the step.
    """
    factor, stderr = -1.0 if hypothesis.kind == "sign" else 1.0, 0.0
    for _ in range(2):
        noise = _estimate_noise_with(data, hypothesis, time_s, factor, 0)
        white = _make_rows(data, noise)
        times = None if white is None else _list_times(white, hypothesis.output, time_s)
        if white is None or times is None or not len(times):
            return None
        factor, C = _make_step(white, hypothesis, time_s, factor)
        time_s, stderr = map(float, _find_time(white, C, hypothesis.output, time_s))
    noise = _estimate_noise_with(data, hypothesis, time_s, factor, MAX_ORDER)
    white = _make_rows(data.leave_out(time_s), noise)
    if white is None or not (white.t > time_s).any():
        return None
    factor, C = _make_step(white, hypothesis, time_s, factor)
    return _measure_step(white, C, time_s, stderr, factor)


def _estimate_noise_with(
    data: _LogData, hypothesis: _Hypothesis, time_s: float, factor: float, order: int
) -> tuple[Autoregression, ...]:
    """Return the noise with a change accounted for and without the samples about it; of a factor, of forces before it."""
    taken = data.take(hypothesis, time_s, factor).leave_out(time_s)
    return _estimate_noise(taken, (), order)


def _make_step(white: _WhiteRows, hypothesis: _Hypothesis, time_s: float, factor: float) -> tuple[float, np.ndarray]:
    """Return the factor of a change, 1 for a step of columns, and the rows (R, d) whose step it is."""
    if hypothesis.columns:
        return 1.0, white.whiten_columns(hypothesis.columns)
    changed = (white.output == hypothesis.output) & (white.t > time_s)
    return _estimate_factor(white, changed, factor, hypothesis.output)


def _estimate_factor(white: _WhiteRows, changed: np.ndarray, factor: float, output: int) -> tuple[float, np.ndarray]:
    """Return the factor of one output's forces where they changed (R,), and their prediction without it (R, 1)."""
    f = white.y
    for _ in range(20):
        made = np.where(changed, white.y / factor, white.y)
        f = white.Q @ (white.Q.T @ made)
        size = float(f[changed] @ f[changed])
        factor = float(white.y[changed] @ f[changed]) / size if size > 0 else 0.0
        factor = factor if abs(factor) > MIN_FACTOR else MIN_FACTOR
    return factor, np.where(white.output == output, f, 0.0)[:, None]


def _find_time(white: _WhiteRows, C: np.ndarray, output: int, near: float) -> tuple[float, float]:
    """Return the best time of a step of columns C (R, d), and its standard error [s]: of times that are likely all alike."""
    starts = np.unique(np.concatenate([_list_times(white, output), _list_times(white, output, near)]))
    T = _scan_steps(white, C, starts)
    within = starts[T > T.max() - stats.chi2.ppf(0.95, 1)]
    early, late = _find_gap(white, output, within[0])[0], float(white.t[within[-1]])
    return float(np.mean(_find_gap(white, output, starts[int(np.argmax(T))]))), (late - early) / np.sqrt(12)


def _measure_step(white: _WhiteRows, C: np.ndarray, time_s: float, stderr: float, factor: float) -> _Step:
    """Return a step of columns C (R, d) at a time with its statistics."""
    step = C * (white.t > time_s)[:, None]
    clean = step - white.Q @ (white.Q.T @ step)
    e = white.y - white.Q @ (white.Q.T @ white.y)
    gamma = solve_scaled(clean, e, 1e-7)
    made = clean @ gamma
    left = e - made
    scale = max(1.0, float(left @ left) / max(1, len(left) - white.Q.shape[1] - C.shape[1]))
    spread = scale * _measure_scatter(white.block, made * left, scale * float(made @ made))
    blocks, size = len(np.unique(white.block)), C.shape[1]
    T = float(made @ e)
    drifts = _measure_drifts(white, e, C)
    best = int(np.argmax(drifts))
    chance = float(stats.f.sf(T / spread / size, size, blocks))
    return _Step(time_s, stderr, factor, gamma, chance, (T - drifts[best]) / spread, best, blocks)


def _measure_scatter(block: np.ndarray, scores: np.ndarray, square: float) -> float:
    """Return the largest scatter of blocks' scores, joined to several lengths, over what white noise gives."""
    found = [compute_overdispersion(block, scores, square)]
    for together in BLOCKS_TOGETHER[1:]:
        joined = block // together
        if len(np.unique(joined)) >= MIN_SCATTER_BLOCKS:
            found.append(compute_overdispersion(joined, scores, square))
    return max(found)


def _measure_drifts(white: _WhiteRows, e: np.ndarray, C: np.ndarray) -> list[float]:
    """Return the statistic of each drift of columns C (R, d) in the residual (R,)."""
    found = []
    for shape in _list_drifts(white.t):
        drift = C * shape[:, None]
        clean = drift - white.Q @ (white.Q.T @ drift)
        found.append(float(e @ (clean @ solve_scaled(clean, e, 1e-7))))
    return found


def _list_drifts(t: np.ndarray, begin: float | None = None, end: float | None = None) -> list[np.ndarray]:
    """Return the shapes (n,) of drifts at times (n,) [s] of a log: linear, then exponential with each time constant."""
    first, last = float(t.min() if begin is None else begin), float(t.max() if end is None else end)
    since = (t - first) / max(last - first, 1e-9)
    return [since, *(np.exp(-since / share) for share in DRIFT_TIME_SHARES)]


def _measure(data: _LogData, hypothesis: _Hypothesis, step: _Step) -> tuple[float, float, float, str]:
    """Return the size of a change over the least that is reported, the values before and after it, and their unit.

    The log has the change accounted for. Its size is the rms of its force. Models are wrong by `MAX_LAW_ERROR` of a joint's force
    without its mean and by `MIN_FRICTION_RATIO` of its friction; the larger is the least.
    """
    sizes, coulomb, output = [0.0], 0.0, hypothesis.output
    for k in range(len(data.regression.outputs)):
        if output not in (-1, k) or not any(run.usable[:, k].any() for run in data.runs):
            continue
        force = np.concatenate([run.y[run.usable[:, k], k] for run in data.runs])
        friction, coulomb = _estimate_friction(data, k)
        added = _add_step(data, hypothesis, step, k) if hypothesis.columns else (step.factor - 1) * force
        least = max(MAX_LAW_ERROR * float(np.std(force)), MIN_FRICTION_RATIO * _measure_rms(friction))
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


def _add_step(data: _LogData, hypothesis: _Hypothesis, step: _Step, output: int) -> np.ndarray:
    """Return the force of a step at the usable samples (n,) of an output after it."""
    made = []
    for c, run in zip(hypothesis.columns, data.runs, strict=True):
        after = run.usable[:, output] & (run.t > step.time_s)
        made.append(c[after, output] @ step.amplitudes)
    return np.concatenate(made)


def _estimate_friction(data: _LogData, output: int) -> tuple[np.ndarray, float]:
    """Return a joint's friction at its usable samples (n,) and its mean Coulomb friction, by a fit of its force alone."""
    joint, rows, y = data.regression.outputs[output], [], []
    for columns, run in zip(data.columns, data.runs, strict=True):
        rows.append(columns[run.usable[:, output], output])
        y.append(run.y[run.usable[:, output], output])
    W, names = np.concatenate(rows), data.regression.parameters.names
    theta = solve_scaled(W, np.concatenate(y), 1e-7)
    coulomb, viscous = (
        [k for k, name in enumerate(names) if name.startswith(f"{joint}.{law}")] for law in ("coulomb", "viscous")
    )
    both = [*coulomb, *viscous]
    return W[:, both] @ theta[both], float(theta[coulomb].mean()) if coulomb else 0.0
