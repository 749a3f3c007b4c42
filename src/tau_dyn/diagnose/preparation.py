"""Preparation of logs for finding causes: filters chosen from the logs themselves, and the timing of the logged forces.

Causes act far above the motion's own band, so forces and positions are filtered wider than for an identification, as far as the
encoders' noise allows; the positions from which columns are made are low-passed at the highest frequency at which the motion
exceeds that noise.

A fit of late forces mistakes a part of the delay for viscous friction and for masses: `m a(t - d)` contains `m w^2 d v`, which
at 60 ms and 1 Hz exceeds the friction of many joints, and its residual resembles springs and hysteresis. So the delay `d` and
the time constant `T` of each output are profiled (variable projection, Golub & Pereyra 1973). Forces are shifted back,
`y(t + d) + T y'(t + d)`, the baseline is refitted, and the values at the best `d` and `T` predict the force that effects of the
recording act on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence import (
    compute_fast_speeds,
    orthonormalise,
)
from tau_dyn.identify import (
    CODE,
    NOISE_FACTOR,
    RATE_FACTOR,
    RECORDED,
    Kept,
    Preparation,
    TooShort,
    choose_preparation,
    keep_long,
    refuse_short,
    select_long,
)
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    Log,
    compute_edge_samples,
    compute_noise_gain,
    decimate,
    differentiate,
    estimate_encoder_noise,
    find_motion_band,
    lowpass,
    lowpass_and_decimate,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

BAND_FACTOR = 20.0
"""Highest frequency used, in edges of the motion's own band; a tooth passes many times in one stroke."""
SLOW_SHARE = 0.01  # speed at which a joint's direction has to be known, as a share of its fast speed
MIN_DIRECTION_SNR = 5.0
"""Least speed of certain direction, in standard deviations of the velocity's noise."""
REVERSAL_GAP_PERIODS = 1.0
"""Time masked around a reversal, in periods of the position filter. A joint may rest unseen for half a period, with friction
anywhere between both directions, and the filter spreads the start over the same time. Unmasked rests resemble hysteresis and
delays."""
OVERSAMPLING = 5.0
"""Rate to which a log is decimated, in cutoffs of the position filter."""
SMOOTH_FACTOR = 2.0
"""Share of the frequency up to which the motion exceeds the encoder's noise; a wider filter lets noise into the columns."""


def choose_diagnosis_preparation(robot: Robot, logs: Sequence[Log], exclude: tuple[str, ...]) -> Preparation:
    """Choose filters for finding causes, which may act far above the motion's own band.

    The band of the forces is as wide as encoder noise permits: above it, forces show only that noise times a mass, on which a
    noise model would use up its order. The low-pass of positions is as wide as possible with ten times the velocity's noise
    below 1 % of the fast speeds, so that reversals are sharp. A floating base's pose is so noisy that its filters are those of an
    identification.
    """
    plain = choose_preparation(robot, logs, exclude)
    if robot.base_coordinates:
        return plain
    rate = min(log.rate_hz for log in logs)
    q = [log.joint("q", robot.actuated) for log in logs]
    noise = np.max([estimate_encoder_noise(x) for x in q], axis=0)
    smooth = [lowpass(x, plain.position_cutoff_hz, log.rate_hz) for x, log in zip(q, logs, strict=True)]
    speeds = [compute_fast_speeds(differentiate(x, log.dt)) for x, log in zip(smooth, logs, strict=True)]
    fast = np.max(speeds, axis=0)
    moving = fast > plain.speed_threshold
    cutoffs = np.geomspace(min(2 * plain.force_cutoff_hz, 0.4 * rate), 0.4 * rate, 40)
    gains = np.array([compute_noise_gain(rate, f) for f in cutoffs])
    allowed = SLOW_SHARE * fast[moving] / np.maximum(NOISE_FACTOR * noise[moving], 1e-300)
    within = gains <= allowed.min() if moving.any() else np.ones(1, bool)
    position_cutoff = float(cutoffs[max(0, int(within.sum()) - 1)])
    bands = [find_motion_band(x, log.rate_hz) for x, log in zip(q, logs, strict=True)]
    edge = max(float(band.edge_hz.max()) for band in bands)
    noise_edge = min((float(e) for b in bands for e in b.noise_edge_hz[b.edge_hz > 0]), default=rate)
    force_cutoff = max(plain.force_cutoff_hz, min(0.16 * rate, BAND_FACTOR * edge, noise_edge))
    threshold = MIN_DIRECTION_SNR * noise * compute_noise_gain(rate, position_cutoff)
    return Preparation(
        position_cutoff,
        force_cutoff,
        RATE_FACTOR * force_cutoff,
        threshold,
        REVERSAL_GAP_PERIODS / position_cutoff,
        exclude,
    )


def keep_diagnosable(
    robot: Robot, logs: Sequence[Log], train: Sequence[Log], held: Sequence[Log], exclude: tuple[str, ...]
) -> tuple[list[Log], list[Log], tuple[str, ...]]:
    """Return the pieces that are long enough for every filter of a diagnosis, and warnings about the others.

    Args:
        robot: The robot, for its actuated joints.
        logs: Logs from which the training pieces are cut.
        train: Pieces of the training logs; the filters are chosen from them.
        held: Pieces of held-out logs; they may all be too short.
        exclude: Log columns whose nonzero samples are left out.

    Raises:
        TooShort: No training piece is long enough.
    """
    if not train:
        raise refuse_short(logs, MIN_SEGMENT_SAMPLES / min((log.rate_hz for log in logs), default=1.0))
    long = select_long(train)
    plain = choose_preparation(robot, long, exclude)
    lowest_hz = min(plain.force_cutoff_hz, clear_cutoff(robot, long), smooth_cutoff(robot, long))
    kept = keep_long(train, lowest_hz, plain.factor)
    try:
        kept_held = keep_long(held, lowest_hz, plain.factor) if held else Kept((), ())
    except TooShort as fault:
        kept_held = Kept((), (CodedWarning(CODE, fault.missing),))
    return kept.of(train), kept_held.of(held), (*kept.warnings, *kept_held.warnings)


def decimate_log(log: Log, cutoff_hz: float) -> Log:
    """Return a log at a lower rate if it is sampled far faster than a low-pass at `cutoff_hz` needs."""
    factor = int(log.rate_hz // (OVERSAMPLING * cutoff_hz))
    if factor < 2:
        return log
    safe = 0.4 * log.rate_hz / factor
    smooth = ("q_", "tau_", *(f"{name}_" for name in RECORDED))
    channels = {
        key: lowpass_and_decimate(x, safe, log.rate_hz, factor) if key.startswith(smooth) else decimate(x, factor)
        for key, x in log.channels.items()
    }
    return replace(log, t=decimate(log.t, factor), channels=channels)


def smooth_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] that keeps the frequencies at which positions exceed the encoder's noise, for making columns.

    Noise in the columns is noise in the residual, times a mass: a cause whose column has the same noise, or lacks the
    baseline's noise, would be found in the residual.
    """
    edges = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz).signal_edge_hz.max() for log in logs]
    return SMOOTH_FACTOR * float(max(edges))


def smooth_cutoffs(robot: Robot, train: Sequence[Log], held: Sequence[Log]) -> tuple[float, ...]:
    """Return that low-pass [Hz] of each log: the same for all training logs, at least as wide for held-out logs.

    A held-out log may hold faster motion than the training logs; with their cutoff it would lose acceleration that the robot
    had.
    """
    shared = smooth_cutoff(robot, train)
    return (*[shared] * len(train), *[max(shared, smooth_cutoff(robot, [log])) for log in held])


def clear_cutoff(robot: Robot, logs: Sequence[Log]) -> float:
    """Return the low-pass [Hz] of the forces that springs carry.

    A spring's force on the load is the fourth derivative of a position: above this frequency, its column would be encoder
    noise, and the residual, which contains the same noise times a mass, would contradict any spring.
    """
    bands = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz) for log in logs]
    return float(max(max(band.clear_edge_hz.max(), band.edge_hz.max()) for band in bands))


def compute_border_gap_s(cutoff_hz: float, rate_hz: float) -> float:
    """Return the time [s] on both sides of a border in which a low-pass at `cutoff_hz` still depends on the other side."""
    return 0.5 * compute_edge_samples(cutoff_hz, rate_hz) / rate_hz


MAX_TIME_S = 0.1
"""Longest delay and time constant in the search: the end of the plausible range of `delay` and `drive_lag`."""
MIN_TIME_S = 3e-3
"""Time below which values are not corrected: for a motion at 2 Hz it changes 4 % of the force."""
_STEPS_S = (1e-2, 2.5e-3, 6e-4, 1.5e-4, 4e-5)
"""Steps of the search: the misfit of motions up to 10 Hz has one minimum within 10 ms."""
_MAX_ROWS = 8000
"""Samples used, evenly over the runs: enough for a time to a tenth of a millisecond."""
_MIN_IMPROVEMENT = 0.02
"""Share of the squared misfit by which a time must reduce it; the best of some forty tries on noise is far less."""


@dataclass(frozen=True, eq=False)
class ForceTiming:
    """Timing of the logged forces that fits the baseline best.

    Attributes:
        delays: Delay of each output (m,) [s].
        lags: Time constants of each output's low-pass (m,) [s].
        change: Change of the baseline's values (p,) by that timing.
    """

    delays: np.ndarray
    lags: np.ndarray
    change: np.ndarray


def find_timing(runs: Sequence[RegressionRun], values: np.ndarray, free: np.ndarray) -> ForceTiming | None:
    """Return the timing of the forces that fits the baseline best; None if it is no better than no correction.

    Args:
        runs: The training runs, with the baseline's columns.
        values: The fitted baseline's values (p,).
        free: Which of them are fitted (p,).
    """
    profile = _Profile(runs, free)
    if profile.Q.shape[1] == 0:
        return None
    delays, lags = profile.minimise()
    if max(np.abs(delays).max(), lags.max()) < MIN_TIME_S:
        return None
    W, weight = profile.W, profile.weight
    norm = np.linalg.norm(W, axis=0)
    unit = np.where(norm > 0, norm, 1.0)
    predicted = np.concatenate([(run.W_all @ values)[mask] for run, mask in zip(runs, profile.usable, strict=True)])
    changed = weight * (profile.moved(delays, lags) - predicted)
    found = np.zeros(len(free))
    found[free] = np.linalg.lstsq(W * weight[:, None] / unit, changed, rcond=1e-8)[0] / unit
    return ForceTiming(delays, lags, found)


class _Profile:
    """The baseline's misfit at any timing of the forces."""

    def __init__(self, runs: Sequence[RegressionRun], free: np.ndarray) -> None:
        """Prepare the projection; rows (R,) are the usable samples, outputs by their own residual."""
        every = 1 + sum(int(run.usable.sum()) for run in runs) // _MAX_ROWS
        self.usable = [run.usable & (np.arange(len(run.t)) % every == 0)[:, None] for run in runs]
        self.t = [run.t for run in runs]
        self.splines = [CubicSpline(run.t, run.y_all) if len(run.t) > 3 else None for run in runs]
        self.y = [run.y_all for run in runs]
        self.m = runs[0].y_all.shape[1]
        self.output = np.concatenate([np.nonzero(mask)[1] for mask in self.usable])
        self.W = np.concatenate([run.W_all[:, :, free][mask] for run, mask in zip(runs, self.usable, strict=True)])
        now = np.concatenate([y[mask] for y, mask in zip(self.y, self.usable, strict=True)])
        Q = orthonormalise(self.W)
        e = now - Q @ (Q.T @ now)
        count = np.maximum(np.bincount(self.output, minlength=self.m), 1)
        size = np.sqrt(np.bincount(self.output, e**2, self.m) / count)
        self.weight = 1 / np.maximum(size, 1e-12 * max(float(np.abs(now).max(initial=0.0)), 1e-300))[self.output]
        self.Q = orthonormalise(self.W * self.weight[:, None])

    def moved(self, delays: np.ndarray, lags: np.ndarray) -> np.ndarray:
        """Return usable forces (R,) corrected for the outputs' delays (m,) and low-passes (m,) [s]."""
        found = []
        for t, y, spline, mask in zip(self.t, self.y, self.splines, self.usable, strict=True):
            whole = y.copy()
            for k in range(self.m):
                if spline is not None and (delays[k] or lags[k]):
                    when = np.clip(t + delays[k], t[0], t[-1])
                    whole[:, k] = spline(when)[:, k]
                    if lags[k]:
                        whole[:, k] += lags[k] * spline(when, 1)[:, k]
            found.append(whole[mask])
        return np.concatenate(found)

    def misfit(self, delays: np.ndarray, lags: np.ndarray) -> float:
        """Return the squared misfit of the refitted baseline."""
        y = self.weight * self.moved(delays, lags)
        return float(y @ y - np.sum((self.Q.T @ y) ** 2))

    def minimise(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the best delays and time constants (m,) [s]: one for all outputs first, then one per output if better."""
        best = np.zeros(self.m), np.zeros(self.m)
        least = self.misfit(*best)
        alone = [np.arange(self.m) == k for k in range(self.m)]
        for which in [np.ones(self.m, bool), *(alone if self.m > 1 else [])]:
            found = [self._search(best, least, which, kind) for kind in (0, 1)]
            value, trial = min(found, key=lambda x: x[0])
            if value < (1 - _MIN_IMPROVEMENT) * least:
                least, best = value, trial
        return best

    def _search(
        self, start: tuple[np.ndarray, np.ndarray], least: float, which: np.ndarray, kind: int
    ) -> tuple[float, tuple[np.ndarray, np.ndarray]]:
        """Return the least misfit over the delay (kind 0) or the time constant (1) of some outputs (m,), and its position."""

        def at(x: float) -> tuple[np.ndarray, np.ndarray]:
            times = [np.array(one) for one in start]
            times[kind][which] = x
            return times[0], times[1]

        now = float(start[kind][which][0])
        near = [x for x in (now - MIN_TIME_S, now + MIN_TIME_S) if x >= 0 or kind == 0]
        if min(self.misfit(*at(x)) for x in near) >= least:
            return least, start
        low, best, reach = (-MAX_TIME_S if kind == 0 else 0.0), (least, now), MAX_TIME_S
        for step in _STEPS_S:
            middle = best[1] if reach < MAX_TIME_S else 0.0
            tries = np.arange(max(low, middle - reach), min(MAX_TIME_S, middle + reach) + step / 2, step)
            best = min([best, *((self.misfit(*at(float(x))), float(x)) for x in tries)])
            reach = step
        return best[0], at(best[1])
