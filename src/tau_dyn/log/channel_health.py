"""Channels that stand still, die or clip: found before any fit, named with their time, and cut out where that can be done.

- Still: one value for unusually long. An output is at fault where other channels go on.
- Dead: an output has far less power than the other channels predict,

      y_j(t) = sum_i sum_k h_ik x_i(t - k),   |k| <= K,   i != j,                (least squares over the record)

  A linear structure satisfies this relation during decays, pauses and sweeps as well, so these raise no alarm.
- An input may rest between bursts. One that stands still or is quiet is at fault only where the outputs are driven: errors of
  y_t = sum A_k y_{t-k} + sum B_k u_{t-k}, fitted elsewhere, grow in the stretch (F-test of two variances).
- Clipped: samples crowd at an extreme, on one value or on flat tops. Within d of it are more samples than in the next 4 d.
  The top of a parabola, which every smooth wave has, holds 4 / (sqrt(5) - 1) = 3.2 times as many, whatever d is.

References: Söderström & Stoica 1989, 4.2 (least squares); Bussgang 1952 (a clipped Gaussian signal is a linear response that
is too small, plus an error uncorrelated with the input: its frequencies are unbiased, its amplitudes are not).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import f as fisher

from tau_dyn.log.log import Log
from tau_dyn.log.resample import find_true_runs
from tau_dyn.log.signal_checks import list_long_runs
from tau_dyn.message_codes import CodedWarning

LIVE_SHARE = 0.2  # of its standard deviation over the record: a channel that varies by more goes on
CHUNK = 20_000  # samples whose delayed channels are in memory at once
MAX_COLUMNS = 320  # delayed channels in that relation
MAX_LAG = 80  # samples of it, both ways
AR_LAGS = 10  # samples of the one-step prediction
MIN_VARIANCE_RATIO, SIGNIFICANCE_LEVEL = 2.0, 1e-6
"""Growth of one-step errors from which an input that stands still is at fault, and the significance of the growth."""
BLOCK_S, MIN_BLOCK = 0.1, 40  # length of the blocks whose power is compared, in seconds and samples
MIN_DEAD_BLOCKS = 4  # in a row: one quiet block happens between beats
DEAD_RATIO = 0.1  # measured over predicted rms of a dead block: a loss of 20 dB
MIN_PREDICTED = 0.1  # predicted rms over the channel's own: below it the structure is at rest
MIN_SIGNAL = 1.5  # predicted rms over that of the relation's errors in live blocks
CLIP_BANDS = (1e-3, 1e-2, 3e-2)
"""Widths d over the distance from median to extreme: an amplifier's limit has noise on it; a digital one is one value."""
MIN_FLAT, MIN_TOPS, MIN_CLIPPED = 3, 3, 10  # samples of a flat top, flat tops, and samples on them
ROUNDING = 9  # digits of the range that tell values apart: a sine repeats its own to rounding errors
MIN_CROWDING = 8.0  # samples within d of the extreme over a fourth of those in the next 4 d; see above, 3.2 for waves
MIN_OUTER_SHARE = 0.2
"""Samples in the outer half of the range over those at its end: square waves and relays have hardly any. The median of them
moves by more than d between samples: a staircase is flat everywhere."""
MIN_PART = 200  # samples of a stretch between faults that is kept


@dataclass(frozen=True)
class ChannelFault:
    """A stretch of a channel that is not what the structure did.

    Attributes:
        column: The channel.
        start: First sample.
        stop: End, one past the last sample.
        cut: Whether the stretch is left out of the fit.
        warning: The sentence with its code.
    """

    column: str
    start: int
    stop: int
    cut: bool
    warning: CodedWarning


def find_channel_faults(log: Log, inputs: Sequence[str], outputs: Sequence[str]) -> list[ChannelFault]:
    """Return stretches in which channels stand still or are dead, and channels that clip.

    Args:
        log: The log; columns that it lacks are not examined.
        inputs: Columns that excite.
        outputs: Columns that respond.
    """
    inputs, outputs = ([c for c in some if c in log.channels] for some in (inputs, outputs))
    found = _find_still_outputs(log, inputs, outputs)
    found += _find_dead_outputs(log, inputs, outputs, found)
    found += _find_lost_inputs(log, inputs, outputs, found)
    return [*found, *_find_clipping(log, inputs, outputs)]


def split_at_faults(log: Log, faults: Sequence[ChannelFault]) -> list[Log]:
    """Return the stretches of a log without the faults that are cut, those of 200 samples or more; the log if there is none."""
    sound = np.ones(log.n_samples, bool)
    for fault in faults:
        if fault.cut:
            sound[fault.start : fault.stop] = False
    if sound.all():
        return [log]
    return [log.window(s.start, s.stop) for s in find_true_runs(sound) if s.stop - s.start >= MIN_PART]


def _name_still(log: Log, column: str, start: int, stop: int) -> ChannelFault:
    said = "stands still {} while the rest goes on: the sensor gave no values there. The stretch is left out; look at the sensor."
    return _name_stretch("held_channel", said, log, column, start, stop)


def _name_dead(log: Log, column: str, start: int, stop: int) -> ChannelFault:
    said = (
        "gives no signal {}: its level falls below a tenth while the other channels go on. "
        "The stretch is left out; look at sensor, cable and amplifier."
    )
    return _name_stretch("faulty_channel", said, log, column, start, stop)


def _name_stretch(CODE: str, said: str, log: Log, column: str, start: int, stop: int) -> ChannelFault:
    span = said.format(f"from t = {log.t[start]:.4g} to {log.t[stop - 1]:.4g} s")
    return ChannelFault(column, start, stop, True, CodedWarning(CODE, f"{log.name}: {column} {span}"))


def _find_still_outputs(log: Log, inputs: Sequence[str], outputs: Sequence[str]) -> list[ChannelFault]:
    """Return the stretches in which an output keeps one value for long while another channel goes on."""
    found = []
    for name in outputs:
        others = [log.channels[c] for c in (*inputs, *outputs) if c != name]
        for start, stop in list_long_runs(log.channels[name], log.rate_hz)[0]:
            middle = (start + stop) // 2
            halves = ((start, middle), (middle, stop))  # a blow at one end is no motion throughout
            if any(all(np.std(x[a:b]) > LIVE_SHARE * np.std(x) for a, b in halves) for x in others):
                found.append(_name_still(log, name, start, stop))
    return found


def _find_lost_inputs(
    log: Log, inputs: Sequence[str], outputs: Sequence[str], known: Sequence[ChannelFault]
) -> list[ChannelFault]:
    """Return the stretches in which an input keeps one value or is quiet for long while the outputs are driven."""
    still = [(c, a, b, _name_still) for c in inputs for a, b in list_long_runs(log.channels[c], log.rate_hz)[0]]
    quiet = [(c, a, b, _name_dead) for c in inputs for a, b in _list_quiet(log, c)]
    if not (still or quiet) or not outputs:
        return []
    usable, found = np.ones(log.n_samples, bool), []
    for fault in known:
        usable[fault.start : fault.stop + AR_LAGS] = False
    past, y = _build_one_step_regression(log, inputs, outputs)
    for column, start, stop, name in sorted([*still, *quiet], key=lambda s: s[1] - s[2]):
        inside = np.zeros(log.n_samples, bool)
        inside[start:stop] = True
        if _is_driven(past, y, (inside & usable)[AR_LAGS:], (~inside & usable)[AR_LAGS:]):
            found.append(name(log, column, start, stop))
            usable[start : stop + AR_LAGS] = False
    return found


def _is_driven(past: np.ndarray, y: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> bool:
    """Return whether one-step errors inside a stretch exceed those outside of it, where the prediction is fitted.

    If another channel is active inside only, as a hammer that moves on to the next place, the prediction does not include its
    effect, and the answer is no.

    Args:
        past: Regressors (N, k).
        y: Outputs (N, p).
        inside: Samples of the stretch (N,).
        outside: Samples to fit to (N,).
    """
    n, k = int(inside.sum()), past.shape[1]
    if n < AR_LAGS or outside.sum() < 4 * k:
        return False
    z = past[outside]
    level, known = (np.mean(past[use] ** 2, axis=0) for use in (inside, outside))
    if np.any(DEAD_RATIO**2 * level > known):
        return False
    G = z.T @ z
    theta = np.linalg.solve(G + 1e-12 * np.mean(np.diag(G)) * np.eye(k), z.T @ y[outside])
    error, usual = (np.mean((y[use] - past[use] @ theta) ** 2, axis=0) for use in (inside, outside))
    ratio = error / np.maximum(usual, 1e-300)
    p = fisher.sf(ratio, n, outside.sum() - k) * y.shape[1]
    return bool(np.any((ratio > MIN_VARIANCE_RATIO) & (p < SIGNIFICANCE_LEVEL)))


def _build_one_step_regression(
    log: Log, inputs: Sequence[str], outputs: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return past outputs and inputs (N - 10, k), the present inputs among them, and outputs (N - 10, p)."""
    u, y = (_standardise(log, some) for some in (inputs, outputs))
    before, acting = (sliding_window_view(x, AR_LAGS + 1, axis=0) for x in (y, u))
    n = len(before)
    return np.hstack([before[..., :-1].reshape(n, -1), acting.reshape(n, -1)]), y[AR_LAGS:]


def _list_quiet(log: Log, column: str) -> list[tuple[int, int]]:
    """Return first sample and end of the stretches in which a channel stays within a tenth of its rms around its median."""
    x, width = log.channels[column], _get_block_length(log)
    if len(x) < 2 * MIN_DEAD_BLOCKS * width:
        return []
    starts = np.arange(len(x) // width) * width
    away = np.maximum.reduceat(np.abs(x - np.median(x)), starts)
    runs = _list_long(away < DEAD_RATIO * np.std(x), width, len(x))
    return [_find_edges(x, a, b, width) for a, b in runs]


def _get_block_length(log: Log) -> int:
    return max(MIN_BLOCK, round(BLOCK_S * log.rate_hz))


def _measure_blocks(x: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations of blocks (B,), and each sample's block (N,); the last block takes the remainder."""
    count = len(x) // width
    block = np.minimum(np.arange(len(x)) // width, count - 1)
    starts, size = np.arange(count) * width, np.bincount(block)
    mean = np.add.reduceat(x, starts) / size
    return np.sqrt(np.add.reduceat((x - mean[block]) ** 2, starts) / size), block


def _list_long(dead: np.ndarray, width: int, n: int) -> list[tuple[int, int]]:
    """Return first sample and end of runs of four or more dead blocks (B,) of `n` samples."""
    runs = [(s.start, s.stop) for s in find_true_runs(dead) if s.stop - s.start >= MIN_DEAD_BLOCKS]
    return [(a * width, n if b == len(dead) else b * width) for a, b in runs]


def _standardise(log: Log, names: Sequence[str]) -> np.ndarray:
    """Return columns (N, c) without mean and of unit standard deviation."""
    x = np.column_stack([np.zeros((log.n_samples, 0)), *(log.channels[c] for c in names)])
    spread = x.std(axis=0)
    return (x - x.mean(axis=0)) / np.where(spread > 0, spread, 1.0)


def _find_dead_outputs(
    log: Log, inputs: Sequence[str], outputs: Sequence[str], still: Sequence[ChannelFault]
) -> list[ChannelFault]:
    """Return the stretches in which an output has less than a tenth of the level that the other channels predict."""
    names = (*inputs, *outputs)
    x = _standardise(log, names)
    width = _get_block_length(log)
    lag = min(MAX_LAG, MAX_COLUMNS // (2 * len(names)))
    n = len(x) - 2 * lag
    if n < 4 * MIN_DEAD_BLOCKS * width or len(names) < 2:
        return []
    live = np.ones(n, bool)
    for fault in still:
        live[max(fault.start - 2 * lag, 0) : fault.stop] = False
    delayed = sliding_window_view(x, 2 * lag + 1, axis=0)
    normal = _sum_products(delayed, live)
    found = []
    for j in range(len(inputs), len(names)):
        for first, end in _find_dead_blocks(delayed, j, live, normal, width):
            start, stop = _find_edges(x[:, j], first + lag, end + lag, width)
            if not any(f.column == names[j] and f.start < stop and start < f.stop for f in still):
                found.append(_name_dead(log, names[j], start, stop))
    return found


def _sum_products(delayed: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return the sums of products (c L, c L) of delayed channels (N, c, L) over the samples to use (N,)."""
    n, c, lags = delayed.shape
    total = np.zeros((c * lags, c * lags))
    for a in range(0, n, CHUNK):
        z = delayed[a : a + CHUNK][use[a : a + CHUNK]].reshape(-1, c * lags)
        total += z.T @ z
    return total


def _predict_from_others(delayed: np.ndarray, j: int, normal: np.ndarray) -> np.ndarray:
    """Return what the other channels predict of channel `j` (N,), from delayed channels (N, c, L) and their products."""
    n, c, lags = delayed.shape
    others = np.repeat(np.arange(c) != j, lags)
    own = j * lags + lags // 2
    G = normal[np.ix_(others, others)]
    G = G + 1e-9 * np.mean(np.diag(G)) * np.eye(len(G))
    h = np.zeros(c * lags)
    h[others] = np.linalg.solve(G, normal[others, own])
    return np.concatenate([delayed[a : a + CHUNK].reshape(-1, c * lags) @ h for a in range(0, n, CHUNK)])


def _find_dead_blocks(
    delayed: np.ndarray, j: int, live: np.ndarray, normal: np.ndarray, width: int
) -> list[tuple[int, int]]:
    """Return first sample and end of runs of four or more dead blocks.

    Args:
        delayed: Delayed channels (N, c, L).
        j: The output's number among them.
        live: Samples that the relation is fitted to (N,).
        normal: Sums of their products (c L, c L).
        width: Samples of a block.
    """
    y = delayed[:, j, delayed.shape[2] // 2]
    own, block = _measure_blocks(y, width)
    dead = np.zeros(len(own), bool)
    for _ in range(2):  # the second fit leaves dead blocks out
        use = live & ~dead[block]
        if use.sum() < 2 * len(normal):
            return []
        predicted = _predict_from_others(delayed, j, _sum_products(delayed, use) if dead.any() else normal)
        foretold, _ = _measure_blocks(predicted, width)
        dead = (own < DEAD_RATIO * foretold) & (foretold > MIN_PREDICTED * np.std(y[use]))
        if not dead.any():
            return []
    dead &= foretold > MIN_SIGNAL * np.std((y - predicted)[use & ~dead[block]])
    for gap in find_true_runs(~dead):  # a pause between dead stretches, in which nothing is to be measured
        if 0 < gap.start and gap.stop < len(dead) and (own[gap] < DEAD_RATIO * np.std(y[use])).all():
            dead[gap] = True
    return _list_long(dead, width, len(y))


def _find_edges(y: np.ndarray, start: int, stop: int, width: int) -> tuple[int, int]:
    """Return a dead stretch extended to the last sample on either side that is beyond six deviations of its middle."""
    inner = y[start + width : stop - width]
    loud = np.abs(y - np.median(inner)) > 6 * np.std(inner)
    before, after = np.flatnonzero(loud[: start + width]), np.flatnonzero(loud[stop - width :])
    return (int(before[-1]) + 1 if len(before) else 0), (stop - width + int(after[0]) if len(after) else len(y))


def _find_clipping(log: Log, inputs: Sequence[str], outputs: Sequence[str]) -> list[ChannelFault]:
    """Return the channels whose samples crowd at an extreme."""
    found = []
    for name in (*inputs, *outputs):
        x = log.channels[name]
        sides = [(value, mask) for value, mask in (_find_flat_tops(x), _find_flat_tops(-x)) if mask.any()]
        if not sides:
            continue
        tops = np.any([mask for _, mask in sides], axis=0)
        level = " and ".join(f"{value:.4g}" for value in sorted({x[mask].mean() for _, mask in sides}))
        first, last = np.flatnonzero(tops)[[0, -1]]
        share = f"{100 * tops.mean():.2g} % of its samples, first at t = {log.t[first]:.4g} s"
        sentence = f"{log.name}: {name} clips at {level}: {share}. "
        sentence += (
            "Sound if the force itself was limited there; if its sensor or amplifier was, amplitudes and damping are biased."
            if name in inputs
            else "Its amplitudes, and with them mode shapes, mass and stiffness, are biased. Leave it out, or widen its range."
        )
        found.append(ChannelFault(name, int(first), int(last) + 1, False, CodedWarning("faulty_channel", sentence)))
    return found


def _find_flat_tops(x: np.ndarray) -> tuple[float, np.ndarray]:
    """Return a channel's largest value, and the samples (N,) on flat tops at it; none where it does not clip."""
    none = np.zeros(len(x), bool)
    top, span = float(x.max()), float(x.max() - np.median(x))
    if span <= 0:
        return top, none
    levels, counts = np.unique(np.round((x - top) / span, ROUNDING), return_counts=True)
    if top == 0 or len(levels) < 20:
        return top, none
    below = (top - x) / span
    step = np.abs(np.diff(x, prepend=x[0])) / span
    usual = MIN_CLIPPED * np.median(counts)  # a value is repeated where an input is held or periodic
    beside = np.count_nonzero((below > CLIP_BANDS[0]) & (below <= 5 * CLIP_BANDS[0])) / 4
    enough = counts[-1] >= max(usual, MIN_CROWDING * np.mean(counts[-5:-1]), MIN_CROWDING * beside)
    if enough and _is_smooth_below(below, step, 0.0, counts[-1]):
        return top, below < 10.0**-ROUNDING
    finest = 4 * float(np.diff(levels).min())
    for d in sorted({max(d, finest) for d in CLIP_BANDS}):
        if d > CLIP_BANDS[-1]:
            break
        lengths = [s.stop - s.start for s in find_true_runs(below <= d) if s.stop - s.start >= MIN_FLAT]
        flat = sum(lengths)
        beside = np.count_nonzero((below > d) & (below <= 5 * d)) / 4
        enough = len(lengths) >= MIN_TOPS and flat >= max(usual, MIN_CROWDING * beside)
        if enough and _is_smooth_below(below, step, d, flat):
            return top, below <= d
    return top, none


def _is_smooth_below(below: np.ndarray, step: np.ndarray, d: float, flat: int) -> bool:
    """Return whether a channel passes through the outer half of its range, at a speed: not so square waves and staircases.

    Args:
        below: Distance from the extreme over that of the median (N,).
        step: Change since the sample before over the same (N,).
        d: Width of the extreme over the same.
        flat: Samples on flat tops.
    """
    outer = (below > 5 * d) & (below <= 0.5)
    return bool(outer.sum() >= MIN_OUTER_SHARE * flat and np.median(step[outer]) > max(d, CLIP_BANDS[0]))
