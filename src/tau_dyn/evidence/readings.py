"""Acceptance of another reading of a log or a pose file: another sign, joint, scale, unit or clock, or forces without gravity.

Readings have no parameter, or one number per column. Each is compared with the data as read by its log marginal likelihood,
Laplace's approximation about the maximum a posteriori fit (MacKay 1992; Kass & Raftery 1995; Burnham & Anderson 2002, 2.2):

    log p = -sum_j n_j log(sigma_j) - |u|^2 / 2 - log det(A / P) / 2,     n_j = effective number of samples

with the prior's precision `P` and the posterior's `A`. The outputs `j` are joints of a log, or position and orientation of poses,
whose fit has no prior. A reading is named only if four conditions hold.

1. **Gain**: more than `MIN_GAIN_NATS`, and it halves the residual's power of an output or restores the bodies of the file.
2. **Good fit**: the outputs concerned are predicted well. A true reading is exact, so it leaves the sensor's noise and the
   model's small errors; a machine that the model describes badly is not described well by another wrong model. Gains alone do
   not separate the two: model errors are correlated between samples, and their likelihood ratio grows with the data's length.
3. **Both halves of a log agree**: column names hold for the whole log, so each half has to prefer the reading separately. A
   chance winner gains in one half and loses in the other. Poses are no sequence; four fifths of them have to fit well.
4. **No veto**: recorded velocities, and limits of position, speed and force in the robot file, do not contradict it.

Readings closer than `ALIAS_NATS` are reported together. A reading is recommended or applied only if the data read in this way
pass the test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

Reading = TypeVar("Reading")

MIN_GAIN_NATS = 30.0
"""Log-likelihood gain from which a reading is named [nats]; sound logs with bodies that differ by 40 % from the file reach
about 5."""

MIN_LACK_NATS = 12.0
"""The same for forces that lack a known part [nats]: a reading without a number among some ten; 1 log in 1e4 by chance."""

MAX_LACK_POWER_RATIO = 2.0
"""Residual power of forces that lack a part over that of the log as read: the residual of the true reading is the noise, and no
other fit has less than half of it. If bodies that are in the forces are left out, the residual is far larger, also below the
model error."""

ALIAS_NATS = 5.0
"""Readings closer than this cannot be distinguished [nats]; both are reported."""

NATS_PER_NUMBER = 5.0
"""Penalty of a number that a reading estimates [nats]: a range of three decades at a standard error of 5 %."""

MIN_POWER_DROP = 0.5
"""Largest share of the residual's power of some joint under a reading: another reading does not correct model errors."""

SPARED_NATS = 15.0
"""Gain of the prior alone from which a reading is accepted without a better fit [nats]: bodies as in the file, not absurd
ones."""

MAX_GOOD_SHARE = 0.15
"""Largest residual of the joints concerned, as a share of their force; sound robots leave 2 to 15 %.
The force of a joint that moves nearly freely is the small difference of large terms, and no reading of the log explains it."""

MAX_HALF_LOSS_NATS = 1.0
"""Largest tolerated loss in one half of a log [nats]: a half without evidence has a ratio of likelihoods near one."""

MAX_JOINT_LOSS_NATS = 3.0
"""Largest tolerated loss of one joint's evidence under another direction of gravity [nats]: every joint carries weight, so a
force at one joint that resembles gravity is not allowed to name it at the cost of the others."""

EXPLAINED = 0.02
"""Residual of each joint, as a share of its force, that a reading must reach to be judged by the finer measure."""

MAX_FINE_SHARE = 0.15
"""Residual of a joint, as a share of its force, from which the coarser measure has already decided."""

MAX_VELOCITY_MISMATCH = 0.1
"""Difference between the ratio of recorded to differentiated velocity and a reading's ratio that is no veto."""

LIMIT_MARGIN = 2.0
"""Factor by which a reading may exceed limits of speed or force that the log as read keeps: limits are rated values, and peaks
reach twice the rated torque."""

MIN_MODEL_ERROR = 0.002
"""Least model error, as a share of a joint's force, at which readings are distinguished: filters and masks leave as much."""

MAX_NUMBER_STDERR = 0.3
"""Largest relative standard error of a number that a reading estimates; beyond it, the log does not determine the reading."""

MIN_FACTOR_STDERRS = 6.0
"""Distance of an estimated factor from 1, in standard errors, from which a factor is known to be wrong although its size is not:
18 nats, over half of `MIN_GAIN_NATS`."""

MAX_LEFT = 0.15
"""Share of gravity that may remain in forces from which a controller subtracted it: bodies of its model are wrong by 15 %."""

MAX_SUBTRACTED_MORE = 1.0
"""Share of the bodies' forces by which a controller's model may exceed the robot file's: a payload doubles an arm's torques."""

MAX_LEFT_AT_JOINT = 0.05
"""The same for a single joint, which springs and counterweights balance to 60 to 90 %."""

MIN_MEAN_SHARE = 0.15
"""Model's mean force, as a share of the joint's force, from which a mean of zero is unlikely: three times the model error."""

MAX_ZERO_MEAN = 1e-2
"""Mean of a force, as a share of its standard deviation, below which the mean may have been removed: cutting a log leaves about
this mean."""

ROUNDING_SHARE = 1e-8
"""Mean of a force, as a share of its root mean square, that is zero except for rounding."""


@dataclass(frozen=True, eq=False)
class ReadingFit:
    """A whole-robot fit under one reading; outputs are joints, or position and orientation of poses.

    Attributes:
        log_p: Log marginal likelihood [nats].
        log_posterior: Log posterior density at its maximum [nats].
        power: Residual power of each output (na,) [N^2 or (N m)^2; for poses, the squared share of the spread, rad^2].
        prior: Half the squared misfit of the prior [nats].
        residual: Residual of the samples used, zero elsewhere (n, na) [N or N m; for poses, m, rad].
    """

    log_p: float
    log_posterior: float
    power: np.ndarray
    prior: float
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class ReadingTest:
    """The measure by which readings are judged.

    Attributes:
        size: Size of each output (na,): root mean square force [N or N m]; for poses, 1 and the angle [rad] that corresponds to
            the spread.
        model_error: Least residual of a sound robot, as a share of the size.
        is_fine: Whether each joint must be explained to `EXPLAINED`.
        max_good_share: Largest residual of the outputs concerned, as a share of the size.
    """

    size: np.ndarray
    model_error: float
    is_fine: bool = False
    max_good_share: float = MAX_GOOD_SHARE

    @property
    def floor(self) -> np.ndarray:
        """Least residual power (na,)."""
        return (self.model_error * self.size) ** 2

    def accepts_lack(self, before: ReadingFit, after: ReadingFit) -> bool:
        """Return whether forces that lack a part, a reading without a number, gain enough."""
        explained = not self.is_fine or np.all(np.sqrt(after.power) <= EXPLAINED * self.size)
        as_good = np.all(after.power <= MAX_LACK_POWER_RATIO * before.power)
        return bool(explained and as_good and after.log_p - before.log_p > MIN_LACK_NATS)

    def accepts(self, before: ReadingFit | None, after: ReadingFit) -> bool:
        """Return whether a reading gains enough, and improves a joint or restores the bodies; `before` may be None."""
        if self.is_fine and np.any(np.sqrt(after.power) > EXPLAINED * self.size):
            return False
        if (
            before is None
        ):  # as logged, the robot does not reach the positions; a robot that explains no force has log_p 0
            return after.log_p > MIN_GAIN_NATS
        gain = after.log_p - before.log_p
        least = (MIN_MODEL_ERROR * self.size) ** 2 if self.is_fine else self.floor
        drop = np.min(np.maximum(after.power, least) / np.maximum(before.power, least))
        spared = before.prior - after.prior
        return is_preferred(gain, MIN_POWER_DROP / 2 if spared > SPARED_NATS else float(drop))

    def is_mended(self, after: ReadingFit, joints: Sequence[int], columns: Sequence[int]) -> bool:
        """Return whether the joints concerned, read from columns (na,), are predicted well together."""
        size, which = self.size[list(columns)], list(joints) or list(range(len(columns)))
        return bool(np.sum(after.power[which]) <= self.max_good_share**2 * np.sum(size[which] ** 2))

    def is_good(self, after: ReadingFit, joints: Sequence[int], columns: Sequence[int]) -> bool:
        """Return whether each joint concerned, read from columns (na,), is predicted well."""
        share = np.sqrt(after.power) / self.size[list(columns)]
        return bool(np.all(share[list(joints)] <= self.max_good_share))

    def sharpened(self, after: ReadingFit, columns: Sequence[int]) -> ReadingTest:
        """Return the measure with the residual that a reading leaves as the model error, at most the usual one."""
        share = float(np.max(np.sqrt(after.power) / self.size[list(columns)]))
        return replace(self, model_error=min(self.model_error, max(share, MIN_MODEL_ERROR)))


def is_preferred(gain: float, power_left: float) -> bool:
    """Return whether a gain [nats], and the remaining share of an output's residual power, support a reading."""
    return bool(gain > MIN_GAIN_NATS and power_left < MIN_POWER_DROP)


def search_readings(
    start: Reading,
    grow: Callable[[Sequence[Reading]], Sequence[Reading]],
    max_changes: int,
    n_branches: int = 1,
    is_enough: Callable[[Reading], bool] = lambda best: False,
) -> list[Reading]:
    """Return the readings of a beam search: those of one change first, in each step the best first.

    Args:
        start: The data as read.
        grow: Returns readings with one more change than given ones, best first.
        max_changes: Number of steps.
        n_branches: Number of readings from which each step continues.
        is_enough: Whether the best reading of a step ends the search.
    """
    met: list[Reading] = []
    last: Sequence[Reading] = [start]
    for _ in range(max_changes):
        grown = grow(last)
        met += grown
        last = grown[:n_branches]
        if not last or is_enough(last[0]):
            break
    return met


def list_aliases(log_p: Sequence[float]) -> list[int]:
    """Return the indices of readings that the data do not distinguish from the best one, best first."""
    best = max(log_p)
    return [int(k) for k in np.argsort(-np.asarray(log_p), kind="stable") if best - log_p[k] < ALIAS_NATS]


def is_hopeless(test: ReadingTest, fit: ReadingFit, noise: np.ndarray) -> bool:
    """Return whether no reading can meet the finer measure: noise of a joint is too large, or its model too poor.

    Args:
        test: The measure.
        fit: The fit of the log as read.
        noise: Power of white noise in each joint's residual (na,); no reading explains it.
    """
    if not test.is_fine:
        return False
    noisy = np.sqrt(noise) > EXPLAINED * test.size
    poor = np.sqrt(fit.power) > MAX_FINE_SHARE * test.size
    return bool(np.any(noisy | poor))


def is_part_missing(left: float, *, is_single: bool, of_bodies: bool = False) -> bool:
    """Return whether the remaining share of gravity, or of the bodies' forces, is consistent with zero.

    Args:
        left: Remaining share; below zero where more was subtracted than the robot file's bodies exert.
        is_single: Whether one joint alone lacks it.
        of_bodies: Whether forces of inertia were subtracted as well, which no spring balances.
    """
    most = MAX_LEFT_AT_JOINT if is_single else MAX_LEFT
    return -(MAX_SUBTRACTED_MORE if of_bodies else most) < left < most


def is_preferred_in_each_half(gains: Sequence[float]) -> bool:
    """Return whether the gains of a reading in parts of a log [nats] do not contradict it."""
    return min(gains, default=0.0) > -MAX_HALF_LOSS_NATS


def is_preferred_at_each_joint(test: ReadingTest, before: ReadingFit, after: ReadingFit, counts: np.ndarray) -> bool:
    """Return whether no joint contradicts a reading of the whole robot, with the effective number of samples of each (na,)."""
    gains = counts * np.log(np.maximum(before.power, test.floor) / np.maximum(after.power, test.floor)) / 2
    return bool(np.min(gains) > -MAX_JOINT_LOSS_NATS)


def is_factor_known(factor: float, stderr: float) -> bool:
    """Return whether a factor is known, or at least known to differ from 1; `stderr` is that of its logarithm."""
    return stderr < MAX_NUMBER_STDERR or abs(np.log(abs(factor))) > MIN_FACTOR_STDERRS * stderr


def permits_speed_scale(recorded: np.ndarray, expected: np.ndarray) -> bool:
    """Return whether recorded velocities permit a reading.

    Args:
        recorded: Ratio of recorded velocity to the derivative of the position as read (na,); nan without a record.
        expected: The ratio that the reading implies (na,).
    """
    known = np.isfinite(recorded)
    off = np.abs(np.abs(recorded[known] / expected[known]) - 1)
    return bool(np.all(off < MAX_VELOCITY_MISMATCH))


def permits_size(logged: np.ndarray, read: np.ndarray, limit: np.ndarray) -> bool:
    """Return whether limits (na,) permit a reading: signals within them as logged (na,) may not far exceed them as read (na,)."""
    kept = np.isfinite(limit) & (limit > 0) & (logged <= limit)
    return bool(np.all(read[kept] <= LIMIT_MARGIN * limit[kept]))


def compute_zero_mean_nats(mean: np.ndarray, expected: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the evidence (na,) [nats] of logged mean forces for a removed mean.

    Without removal an offset would have to cancel the model's mean force to within the logged mean by chance, with a probability
    of about their ratio.

    Args:
        mean: Mean force of the whole log (na,).
        expected: Mean force of the model (na,).
        size: Root mean square force (na,).
    """
    least = np.maximum(np.abs(mean), ROUNDING_SHARE * size)
    nats = np.log(np.maximum(np.abs(expected) / least, 1.0))
    return np.where(np.abs(expected) > MIN_MEAN_SHARE * size, nats, 0.0)
