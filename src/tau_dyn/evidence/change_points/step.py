r"""The time of a change: every time is scanned, and the best hypothesis is fitted with its own noise and time.

The score statistic of a step at every time follows from cumulative products (Andrews 1993). The fitted step is divided by the
scatter of blocks, and compared with drifts of the same columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from tau_dyn.estimate import Autoregression, solve_scaled
from tau_dyn.evidence.change_points.log_data import Hypothesis, LogData, list_drifts
from tau_dyn.evidence.change_points.white_rows import OrderedRows, estimate_noise, make_rows
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, compute_overdispersion, compute_score_statistics

MAX_ORDER = 8
"""Order of the autoregressive noise model, as for causes."""
MIN_SIDE_BLOCKS = 2
"""Least number of blocks of 2 s with usable samples on both sides of a change; one block alone has no scatter."""
MIN_BLOCKS = 5
"""Least number of blocks of a log for which times are tried: two on both sides, and one between."""
N_TIMES = 250
"""Times tried at first, evenly spread over the rows; the best is refined among all rows near it."""
BLOCKS_TOGETHER = (1, 2, 4)
"""Blocks of 2 s joined for the scatter: a residual that repeats with the motion is correlated over its period, up to 8 s."""
MIN_SCATTER_BLOCKS = 8
"""Joined blocks from which their scatter is used; fewer do not estimate a variance."""
N_PULSE_TIMES = 40
"""Times between whose pairs a change is tried that ends within the log; both are refined afterwards."""
MIN_FACTOR = 1e-3
"""Smallest factor by which forces are divided; a dead channel has factor zero."""
LEVEL = 1e-6
"""Significance level of any change over all logs of one fit. It is stricter than the level of a cause: ten blocks of a residual
with structure have heavier tails than their F distribution, and a true change exceeds the bound by orders of magnitude."""


def _list_times(white: OrderedRows, output: int, near: float | None = None) -> np.ndarray:
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


def _scan_steps(white: OrderedRows, C: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the score statistics (g,) of steps of columns (R, d) at each start (g,)."""
    e = white.y - white.fit
    s, A, D = (_sum_after(starts, C, x) for x in (e[:, None], white.Q, C))
    G = D - A @ A.swapaxes(1, 2)
    raw = np.diagonal(D, axis1=1, axis2=2)
    return compute_score_statistics(s, G, raw, np.zeros(C.shape[1], bool), MIN_UNABSORBED_SHARE)[:, 0]


def _scan_sign(white: OrderedRows, output: int, starts: np.ndarray) -> np.ndarray:
    """Return the decrease of the squared residual (g,) if one output's forces change sign from each start (g,) on."""
    mine = np.where(white.output == output, white.y, 0.0)[:, None]
    before = white.Q.T @ white.y
    after = before - 2 * _sum_after(starts, mine, white.Q)[:, 0]
    return np.sum(after**2, axis=1) - before @ before


def select_hypothesis(
    white: OrderedRows, hypotheses: Sequence[Hypothesis], n_hypotheses: int
) -> tuple[Hypothesis, float] | None:
    """Return the hypothesis of the largest statistic, penalised by Schwarz' criterion for each column, and its time [s].

    None if it would not be significant even with independent noise in the rows: coloured noise makes p-values larger.
    """
    best: tuple[float, Hypothesis, float] | None = None
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


def select_pulse(
    white: OrderedRows, hypotheses: Sequence[Hypothesis], n_hypotheses: int
) -> tuple[Hypothesis, float, float] | None:
    """Return the hypothesis whose columns act from one time to another with the largest statistic, and both times [s].

    None if it would not be significant even with independent noise in the rows.
    """
    best: tuple[float, Hypothesis, float, float] | None = None
    for hypothesis in (one for one in hypotheses if one.columns):
        starts = _list_times(white, hypothesis.output)
        starts = starts[:: max(1, -(-len(starts) // N_PULSE_TIMES))]
        if len(starts) < 2:
            continue
        C = white.make_rows(hypothesis)
        first, last = np.triu_indices(len(starts), 1)
        sums = (_sum_after(starts, C, x) for x in ((white.y - white.fit)[:, None], white.Q, C))
        s, A, D = (x[first] - x[last] for x in sums)
        raw, size = np.diagonal(D, axis1=1, axis2=2), C.shape[1]
        G = D - A @ A.swapaxes(1, 2)
        T = compute_score_statistics(s, G, raw, np.zeros(size, bool), MIN_UNABSORBED_SHARE)[:, 0]
        k = int(np.argmax(T))
        if n_hypotheses * len(first) * stats.chi2.sf(T[k], size) > LEVEL:
            continue
        merit = float(T[k]) - size * np.log(len(white.y))
        if best is None or merit > best[0]:
            ends = (float(white.t[starts[first[k]]]), float(white.t[starts[last[k]]]))
            best = merit, hypothesis, *ends
    return None if best is None else best[1:]


def _find_gap(white: OrderedRows, output: int, start: int) -> tuple[float, float]:
    """Return the times of the last row before a start and of the start [s], for the output that changes."""
    before = white.t[:start][(white.output[:start] == output) | (output < 0)]
    return float(before[before < white.t[start]].max()), float(white.t[start])


class Step(NamedTuple):
    """A step at its best time, tested against noise that was estimated with it.

    Attributes:
        time_s: Its time, in the middle between two usable rows [s].
        time_stderr_s: Standard error [s].
        factor: Its factor; 1 for a step of columns.
        amplitudes: Amplitudes of its columns (d,).
        chance: p-value of its statistic at one time, by the scatter of blocks.
        over_drift: Statistic over that of the best drift of the same columns.
        drift: Number of that drift in `list_drifts`.
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


def fit_step(data: LogData, hypothesis: Hypothesis, time_s: float) -> Step | None:
    """Return the step with its own noise and time; None if the rows do not show a step.

    Its time is searched in rows that are weighted but not whitened: an autoregressive filter would smooth the step.
    """
    factor, stderr = -1.0 if hypothesis.kind == "sign" else 1.0, 0.0
    for _ in range(2):
        noise = _estimate_noise_with(data, hypothesis, time_s, factor, 0)
        white = make_rows(data, noise)
        times = None if white is None else _list_times(white, hypothesis.output, time_s)
        if white is None or times is None or not len(times):
            return None
        factor, C = _make_step(white, hypothesis, time_s, factor)
        time_s, stderr = map(float, _find_time(white, C, hypothesis.output, time_s))
    noise = _estimate_noise_with(data, hypothesis, time_s, factor, MAX_ORDER)
    white = make_rows(data.leave_out(time_s), noise)
    if white is None or not (white.t > time_s).any():
        return None
    factor, C = _make_step(white, hypothesis, time_s, factor)
    return _measure_step(white, C, time_s, stderr, factor)


def _estimate_noise_with(
    data: LogData, hypothesis: Hypothesis, time_s: float, factor: float, order: int
) -> tuple[Autoregression, ...]:
    """Return the noise with a change in the model and without the samples about it; for a factor, from forces before it."""
    taken = data.take(hypothesis, time_s, factor).leave_out(time_s)
    return estimate_noise(taken, order)


def _make_step(white: OrderedRows, hypothesis: Hypothesis, time_s: float, factor: float) -> tuple[float, np.ndarray]:
    """Return the factor of a change, 1 for a step of columns, and the rows (R, d) whose step it is."""
    if hypothesis.columns:
        return 1.0, white.whiten_columns(hypothesis.columns)
    changed = (white.output == hypothesis.output) & (white.t > time_s)
    return _estimate_factor(white, changed, factor, hypothesis.output)


def _estimate_factor(white: OrderedRows, changed: np.ndarray, factor: float, output: int) -> tuple[float, np.ndarray]:
    """Return the factor of one output's forces at the changed rows (R,), and their prediction without it (R, 1)."""
    f = white.y
    for _ in range(20):
        made = np.where(changed, white.y / factor, white.y)
        f = white.Q @ (white.Q.T @ made)
        size = float(f[changed] @ f[changed])
        factor = float(white.y[changed] @ f[changed]) / size if size > 0 else 0.0
        factor = factor if abs(factor) > MIN_FACTOR else MIN_FACTOR
    return factor, np.where(white.output == output, f, 0.0)[:, None]


def _find_time(white: OrderedRows, C: np.ndarray, output: int, near: float) -> tuple[float, float]:
    """Return the best time of a step of columns C (R, d), and its standard error [s], that of a uniform 95 % interval."""
    starts = np.unique(np.concatenate([_list_times(white, output), _list_times(white, output, near)]))
    T = _scan_steps(white, C, starts)
    within = starts[T >= T.max() - stats.chi2.ppf(0.95, 1)]
    early, late = _find_gap(white, output, within[0])[0], float(white.t[within[-1]])
    return float(np.mean(_find_gap(white, output, starts[int(np.argmax(T))]))), (late - early) / np.sqrt(12)


def _measure_step(white: OrderedRows, C: np.ndarray, time_s: float, stderr: float, factor: float) -> Step:
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
    return Step(time_s, stderr, factor, gamma, chance, (T - drifts[best]) / spread, best, blocks)


def _measure_scatter(block: np.ndarray, scores: np.ndarray, square: float) -> float:
    """Return the largest scatter of blocks' scores, joined to several lengths, divided by that of white noise."""
    found = [compute_overdispersion(block, scores, square)]
    for together in BLOCKS_TOGETHER[1:]:
        joined = block // together
        if len(np.unique(joined)) >= MIN_SCATTER_BLOCKS:
            found.append(compute_overdispersion(joined, scores, square))
    return max(found)


def _measure_drifts(white: OrderedRows, e: np.ndarray, C: np.ndarray) -> list[float]:
    """Return the statistic of each drift of columns C (R, d) in the residual (R,)."""
    found = []
    for shape in list_drifts(white.t):
        drift = C * shape[:, None]
        clean = drift - white.Q @ (white.Q.T @ drift)
        found.append(float(e @ (clean @ solve_scaled(clean, e, 1e-7))))
    return found
