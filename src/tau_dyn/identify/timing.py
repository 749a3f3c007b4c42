"""Time of the force relative to the motion: late, early, or low-passed by its drive; its uncertainty widens the intervals.

A force that is logged late by `d` is `tau(t - d)`, to first order `tau - d * dtau/dt`; a drive that filters it gives `tau / (1
+ T s)`. The jerk separates both from wrong parameters: no body and no friction makes a force like the rate of the whole force.

**Before the fit** (`check_timing`), on an excerpt: the columns of a linear model with all parameters free (no prior: wrong
masses must not look like a delay) are joined by `-d(model force)/dt` of each joint, and by Gauss-Newton the delays of all
joints are found with the parameters. Standard errors are robust to residuals that are correlated in time (cluster-robust,
Liang & Zeger 1986, blocks of a second). A delay is reported if it exceeds one sample and 8 standard errors, and either all
joints agree on it or it removes two fifths of the joint's residual power: load-dependent friction or an elastic drive also
leave a trace of jerk, in single joints.

**After the fit** (`estimate_offset`): a force that is held over a sample and logged at the start of its hold is half a
sample before its effect. The offset is one more column of the regression, `-dF/dt` of the predicted force `F`, with the prior
that forces are at most about a sample late. If the data show an offset, the forces are read that much later (linearisation of
the time delay, Ljung 1999, 14.4); its standard error widens every interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.effects import Delay
from tau_dyn.estimate import Estimate, PhysicalConstraints, Regression, solve_least_squares
from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.identify.excerpt import Excerpt, compute_clipped_power
from tau_dyn.identify.regression import prepare_segment
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

MIN_DELAY_Z = 8.0
"""Least size of a delay in its standard errors: jerk-like model errors of sound robots reach 5."""

MIN_DELAY_SAMPLES = 0.7
"""Smaller delays are the hold of a sampled force, half a sample [samples]."""

MAX_DELAY_S = 0.1
"""Longer delays are not searched [s]: a motion reverses in the meantime."""

MIN_POWER_REMOVED = 0.4
"""Share of a joint's residual power that its delay must remove to be reported for this joint alone."""

MIN_POWER_REMOVED_TOGETHER = 0.2
"""The same, on average, if all joints agree on one delay."""

AGREEMENT = 0.3
"""Joints agree on a delay if theirs are within this share of the mean, or within three standard errors."""

BLOCK_S = 1.0
"""Length of the blocks within which residuals may be correlated [s]: longer than the memory of friction and cables."""

ITERATIONS = 6
"""Gauss-Newton converges in four steps for delays below a quarter of the motion's shortest period."""

LAG_GAIN_NATS = 5.0
"""Log-likelihood gain [nats] from which a lag and a delay are distinguished."""


PRIOR_SAMPLES = 0.5
"""Standard deviation of the offset before the data, in samples: half a sample is the effect of a hold."""
MAX_OFFSET_SAMPLES = 1.5
"""Largest offset that is corrected; a hold does not explain more, which gives a warning (`force_late`)."""
MIN_OFFSET_Z = 4.0
"""Standard errors from which an offset is corrected: one log in 15,000 by chance."""
MIN_OFFSET_SAMPLES = 0.02
"""Smallest offset [samples] that is corrected; less changes no reported digit."""
_NAME = "drive.delay"


class ForceDelay(NamedTuple):
    """Delays of the forces.

    Attributes:
        delay_s: Delay of each joint's force (na,) [s].
        stderr_s: Standard errors (na,) [s].
        removed: Share of each joint's residual power that its delay removes (na,).
        residual: Weighted residual power with the delays (na,).
        judged: Joints with enough samples (na,).
    """

    delay_s: np.ndarray
    stderr_s: np.ndarray
    removed: np.ndarray
    residual: np.ndarray
    judged: np.ndarray


def check_timing(robot: Robot, excerpt: Excerpt, name: str) -> list[CodedWarning]:
    """Return the warning `force_late` or `force_lowpassed` of a log, with evidence and remedy.

    Args:
        robot: The robot file; only its geometry counts.
        excerpt: Its log.
        name: The log's name, for the sentences.
    """
    fitter = _Fitter.of(robot, excerpt)
    if fitter is None:
        return []
    found = fitter.delays()
    late = _believed(found, excerpt.log.dt)
    if not late.any():
        return []
    return [_say(robot, name, found, late, _gain_of_lag(fitter, found, late), excerpt.log.dt)]


def _gain_of_lag(fitter: _Fitter, found: ForceDelay, late: np.ndarray) -> float:
    """Return the log-likelihood gain [nats] of a first-order lag over a delay for the joints that are late."""
    late = late & (found.delay_s > 0)
    if not late.any():
        return -np.inf
    by_lag = fitter.residual_with_lags(np.where(late, found.delay_s, 0.0))
    ratio = np.log(np.maximum(found.residual[late], 1e-300) / np.maximum(by_lag[late], 1e-300))
    return float(fitter.used.sum(axis=0)[late] @ ratio / 2)


def _believed(found: ForceDelay, dt: float) -> np.ndarray:
    """Return the joints whose delays are significant (na,)."""
    z = np.abs(found.delay_s) / found.stderr_s
    large = np.abs(found.delay_s) > MIN_DELAY_SAMPLES * dt
    alone = found.judged & large & (z > MIN_DELAY_Z) & (found.removed > MIN_POWER_REMOVED)
    weight = np.where(found.judged, found.stderr_s**-2.0, 0.0)
    mean = float(weight @ found.delay_s / max(weight.sum(), 1e-300))
    near = np.abs(found.delay_s - mean) < np.maximum(AGREEMENT * abs(mean), 3 * found.stderr_s)
    together = (
        found.judged.sum() >= 2
        and bool(np.all(near | ~found.judged))
        and abs(mean) > MIN_DELAY_SAMPLES * dt
        and abs(mean) * np.sqrt(weight.sum()) > MIN_DELAY_Z
        and np.count_nonzero(found.judged & (z > 3)) >= 2
        and float(np.mean(found.removed[found.judged & (z > 3)])) > MIN_POWER_REMOVED_TOGETHER
    )
    return found.judged if together else alone


class _Fitter:
    """The linear model of all joints on an excerpt, whose forces may be shifted in time."""

    def __init__(self, excerpt: Excerpt, columns: np.ndarray, used: np.ndarray) -> None:
        """Take columns (n, na, p) whose directions are independent enough."""
        self.excerpt, self.columns, self.used = excerpt, columns, used
        self.blocks = (np.arange(len(used)) * excerpt.dt / BLOCK_S).astype(int)

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt) -> _Fitter | None:
        """Return the fitter; None if the robot cannot move as logged, or no sample is left."""
        q, v, a = excerpt.q, excerpt.v, excerpt.a
        try:
            rigid = build_mechanism(robot).regressor(q, v, a)
        except (InputError, LoopClosureError, np.linalg.LinAlgError):
            return None
        na = robot.na
        used = excerpt.used & (excerpt.used.sum(axis=0) > 100)
        if not used.any() or not np.all(np.isfinite(rigid)):
            return None
        drives = np.zeros((len(q), na, 5 * na))
        for j in range(na):
            forward = v[:, j] > 0
            terms = (forward, ~forward, v[:, j] * forward, v[:, j] * ~forward, a[:, j])
            drives[:, j, 5 * j : 5 * j + 5] = np.column_stack(terms)
        columns = np.concatenate([rigid, drives], axis=2)
        flat = columns[used]
        size = np.linalg.norm(flat, axis=0)
        columns = columns[:, :, size > 1e-9 * size.max()] / size[size > 1e-9 * size.max()]
        _, singular, right = np.linalg.svd(np.linalg.qr(columns[used], mode="r"))
        return cls(excerpt, columns @ right[singular > 1e-6 * singular[0]].T, used)

    def delays(self) -> ForceDelay:
        """Return the delays of all joints, by Gauss-Newton together with the parameters."""
        na, n = self.used.shape[1], len(self.used)
        delay, stderr = np.zeros(na), np.full(na, np.inf)
        _, before, last = self._solve(self.columns, np.zeros((n, na, 0)), delay, None)
        power = before
        for _ in range(ITERATIONS):
            rate = np.gradient(self.columns @ last, self.excerpt.dt, axis=0)
            extra = -rate[:, :, None] * np.eye(na)
            residual, power, both = self._solve(self.columns, extra, delay, power)
            step = both[-na:]
            last = both[:-na]
            stderr = self._errors(extra, residual, power)
            delay = np.clip(delay + step, -MAX_DELAY_S, MAX_DELAY_S)
            if np.all(np.abs(step) < 0.1 * stderr):
                break
        _, power, _ = self._solve(self.columns, np.zeros((n, na, 0)), delay, power)
        judged = self.used.any(axis=0) & np.isfinite(stderr) & (stderr > 0) & (np.abs(delay) < 0.99 * MAX_DELAY_S)
        removed = 1 - power / np.maximum(before, 1e-300)
        return ForceDelay(delay, np.where(judged, stderr, np.inf), removed, power, judged)

    def residual_with_lags(self, lags: np.ndarray) -> np.ndarray:
        """Return the residual power (na,) where each joint's columns pass a first-order lag near the given one [s]."""
        best = np.full(len(lags), np.inf)
        for factor in (0.8, 1.0, 1.25, 1.6):
            columns = self.columns.copy()
            for j in np.flatnonzero(lags > 0):
                lag = factor * lags[j]
                columns[:, j] = _passed(columns[:, j], self.excerpt.dt, lambda w, s=lag: 1 / (1 + 1j * w * s), -lag)
            _, power, _ = self._solve(columns, np.zeros((*self.used.shape, 0)), np.zeros(len(lags)), None)
            if np.sum(np.log(power[lags > 0])) < np.sum(np.log(best[lags > 0])):
                best = power
        return best

    def _solve(
        self, columns: np.ndarray, extra: np.ndarray, delay: np.ndarray, power: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residuals (n, na), their robust power (na,) and the weighted least-squares solution for shifted forces."""
        whole = np.concatenate([columns, extra], axis=2)
        force = self.excerpt.tau
        if delay.any():
            force = _passed(force, self.excerpt.dt, lambda omega: np.exp(1j * omega * delay), delay)
        weight = np.ones(len(delay)) if power is None else power**-0.5
        residual = np.zeros_like(force)
        solution = np.zeros(whole.shape[2])
        for _ in range(2 if power is None else 1):
            W, y = self._weighted(whole, weight), self._weighted(force, weight)
            gram = W.T @ W
            gram[np.diag_indices_from(gram)] *= 1 + 1e-12
            solution = np.linalg.lstsq(gram, W.T @ y, rcond=1e-13)[0]
            residual = np.where(self.used, force - whole @ solution, 0.0)
            power = np.array(
                [max(compute_clipped_power(residual[self.used[:, j], j], 4.0), 1e-30) for j in range(len(delay))]
            )
            weight = power**-0.5
        assert power is not None
        return residual, power, solution

    def _weighted(self, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the used rows of an array (n, na, ...), joint by joint, each times its weight."""
        return np.concatenate([weight[j] * x[self.used[:, j], j] for j in range(len(weight))])

    def _errors(self, extra: np.ndarray, residual: np.ndarray, power: np.ndarray) -> np.ndarray:
        """Return standard errors of the delays (na,), robust to correlation within blocks."""
        na, m = extra.shape[2], self.columns.shape[2]
        weight = power**-0.5
        W, D, r = (self._weighted(x, weight) for x in (self.columns, extra, residual))
        block = np.concatenate([self.blocks[self.used[:, j]] for j in range(na)])
        D = D - W @ np.linalg.lstsq(W.T @ W + 1e-12 * np.eye(m), W.T @ D, rcond=1e-13)[0]
        gram = D.T @ D
        scores = np.zeros((block.max() + 1, na))
        np.add.at(scores, block, D * r[:, None])
        inverse = np.linalg.pinv(gram)
        variance = np.diag(inverse @ (scores.T @ scores) @ inverse)
        return np.sqrt(np.maximum(0.0, np.maximum(variance, np.diag(inverse))))  # zero for a joint without information


def _passed(
    x: np.ndarray, dt: float, response: Callable[[np.ndarray], np.ndarray], lead_s: np.ndarray | float
) -> np.ndarray:
    """Return signals (n, p) through a frequency response of w (k, 1) [rad/s] that moves a straight line `lead_s` forward.

    The signals minus a line from end to end are continued as odd functions, so that they do not jump at their ends.
    """
    n = len(x)
    rise = x[-1:] - x[:1]
    trend = x[:1] + rise * np.linspace(0, 1, n)[:, None]
    odd = np.concatenate([x - trend, -(x - trend)[::-1]])
    omega = 2 * np.pi * np.fft.rfftfreq(2 * n, dt)[:, None]
    passed = np.fft.irfft(np.fft.rfft(odd, axis=0) * response(omega), 2 * n, axis=0)[:n]
    return passed + trend + rise / max((n - 1) * dt, 1e-300) * lead_s


def _say(robot: Robot, name: str, found: ForceDelay, late: np.ndarray, gain: float, dt: float) -> CodedWarning:
    """Return the warning of a delay or a lag: the mean if all joints are late, else the largest."""
    chosen: Sequence[int] = np.flatnonzero(late).tolist()
    weight = found.stderr_s[late] ** -2.0
    mean = float(weight @ found.delay_s[late] / weight.sum())
    of = ", ".join(robot.actuated[k] for k in chosen)
    size = (
        f"{1e3 * abs(mean):.3g} ms ({abs(mean) / dt:.2g} samples, standard error {1e3 * weight.sum() ** -0.5:.1g} ms)"
    )
    removed = (
        f"taking that into account removes {100 * float(np.max(found.removed[late])):.0f} % of the residual's power"
    )
    if mean > 0 and gain > LAG_GAIN_NATS:
        words = (
            f"{name}: the force of {of} is low-passed: a first-order lag of about {size} explains it better than a delay; "
            f"{removed}. Log the drive's force before its filter, or low-pass the positions with the same filter"
        )
        return CodedWarning("force_lowpassed", words + ".")
    alike = " (a first-order lag of as much would look the same)" if mean > 0 and gain > -LAG_GAIN_NATS else ""
    direction = "late" if mean > 0 else "early"
    words = (
        f"{name}: the force of {of} is {direction} by {size}{alike}; {removed}. Give all channels one clock: shift tau by "
        "that time before use, and look where the logger takes its values"
    )
    return CodedWarning("force_late", words + ".")


@dataclass(frozen=True)
class ForceOffset:
    """Delay of the logged forces.

    Attributes:
        seconds: The offset [s]; positive if forces were logged late.
        stderr: Its standard error [s].
        period_s: Time between samples of the logs [s].
        corrected: Whether forces were read at the shifted times.
    """

    seconds: float
    stderr: float
    period_s: float
    corrected: bool = False

    @property
    def is_shown(self) -> bool:
        """Whether the data show an offset that a hold explains."""
        size = abs(self.seconds)
        return (
            size > MIN_OFFSET_Z * self.stderr
            and MIN_OFFSET_SAMPLES * self.period_s < size < MAX_OFFSET_SAMPLES * self.period_s
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "force_offset_s": self.seconds,
            "stderr_s": self.stderr,
            "force_offset_samples": self.seconds / self.period_s,
            "corrected": self.corrected,
        }


def build_offset_columns(model: Model, pieces: Sequence[Log], regression: Regression) -> list[np.ndarray] | None:
    """Return the force per second of offset (n, na) of each run, filtered and masked as the regression, or None.

    The result is None if the columns cannot be computed: an effect needs measured signals, the base floats, or the pieces do not
    match the runs.

    Args:
        model: The fitted model.
        pieces: Even stretches of the logs, one a run.
        regression: The regression on them.
    """
    if len(pieces) != len(regression.runs) or any(effect.measured for effect in model.effects):
        return None
    if model.robot.base_coordinates:
        return None  # the model's own force lacks the ground's share
    found = []
    effect = Delay(model.robot.actuated, model.robot.force_units, about=max(piece.dt for piece in pieces))
    for piece, run in zip(pieces, regression.runs, strict=True):
        try:
            made = prepare_segment(model, piece, regression.preparation, needs=("force",))
        except InputError:
            return None  # an effect needs more than the piece alone contains
        column = made.columns(effect.columns(made.motion))[:, :, 0]
        if column.shape != run.y.shape:
            return None
        found.append(column)
    return found


def estimate_offset(
    regression: Regression, columns: Sequence[np.ndarray], period_s: float, physics: PhysicalConstraints | None
) -> ForceOffset:
    """Return the offset, estimated together with all free parameters by weighted least squares.

    Args:
        regression: The regression.
        columns: Result of `build_offset_columns`.
        period_s: Time between samples of the logs [s].
        physics: Physical constraints of the parameters; None for bounds alone.
    """
    more = Parameter(_NAME, 0.0, "s", prior_stderr=PRIOR_SAMPLES * period_s, origin="timing")
    runs = tuple(
        replace(
            run,
            W=np.concatenate([run.W, x[:, :, None]], axis=2),
            W_all=np.concatenate([run.W_all, x[:, :, None]], axis=2),
        )
        for run, x in zip(regression.runs, columns, strict=True)
    )
    wide = replace(regression, parameters=regression.parameters + Parameters([more]), runs=runs)
    found = solve_least_squares(wide, physics=physics).parameters[_NAME]
    return ForceOffset(found.value, found.stderr or PRIOR_SAMPLES * period_s, period_s)


def widen_by_offset(estimate: Estimate, columns: Sequence[np.ndarray], offset: ForceOffset) -> Estimate:
    """Return the estimate with standard errors that include the offset's.

    The change of the base parameters per second of offset is a fit of `-dF/dt`.
    """
    base, slope = estimate.base, estimate.refit(columns)
    more = np.outer(slope, slope) * offset.stderr**2
    wider = replace(estimate, cov=estimate.cov + more, scatter=estimate.scatter + more)
    alone = base.by_name(wider.stderr)
    changes = {name: {"stderr": x} for name, x in alone.items() if estimate.parameters[name].stderr is not None}
    return replace(wider, parameters=estimate.parameters.update(changes))
