"""When is another reading of a log accepted: another sign, joint, scale or clock of its columns, or forces without gravity?

Readings have no parameter, or one number a column. Each is compared with the log as read by its log marginal likelihood,
Laplace's approximation about the maximum a posteriori fit of a whole-robot model (MacKay 1992; Kass & Raftery 1995):

    log p = -sum_j n_j log(sigma_j) - |u|^2 / 2 - log det(A / P) / 2,     n_j = effective number of samples

with the prior's precision `P` and the posterior's `A`. A reading is named only if four conditions hold.

1. **Gain**: more than `MIN_GAIN_NATS`, and it halves the residual's power of a joint or restores the bodies of the file.
2. **Good fit**: the joints concerned are predicted to `MAX_GOOD_SHARE`. A true reading is exact, so it leaves the sensor's noise
   and the model's small errors; a machine that the model describes badly is not described well by another wrong model. Gains
   alone do not separate the two: model errors are correlated between samples, and their likelihood ratio grows with the log's
   length.
3. **Both halves agree**: columns are named once, so each half of the log prefers the reading by itself. A chance winner gains
   in one half and loses in the other.
4. **No veto**: recorded velocities, and limits of position, speed and force in the robot file, do not contradict it.

A column map is advised only after the log read so passes the test again, and each joint concerned is predicted well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

MIN_GAIN_NATS = 30.0
"""Log-likelihood gain from which a reading is named [nats]; sound logs with bodies 40 % off the file reach about 5."""

MIN_LACK_NATS = 12.0
"""The same for forces that lack a known part [nats]: a reading without a number among some ten; 1 log in 1e4 by chance."""

MAX_LACK_POWER_RATIO = 2.0
"""Residual power of forces that lack a part over that of the log as read: the true reading leaves the noise, which no other fit
goes below by half. Bodies that are in the forces leave far more once they are denied, also below the model error."""

ALIAS_NATS = 5.0
"""Readings closer than this cannot be distinguished [nats]; both are reported."""

NATS_PER_NUMBER = 5.0
"""Cost of a number that a reading estimates [nats]: a range of three decades at a standard error of 5 %."""

MIN_POWER_DROP = 0.5
"""Share of the residual's power that a reading leaves of some joint: model errors are not repaired by another reading."""

SPARED_NATS = 15.0
"""Gain of the prior alone from which a reading counts without a better fit [nats]: bodies as in the file, not absurd ones."""

MAX_GOOD_SHARE = 0.15
"""Largest residual of the joints concerned, as a share of their force; sound robots leave 2 to 15 %.
The force of a joint that swings nearly free is the small difference of large terms, and no reading of the log explains it."""

MAX_HALF_LOSS_NATS = 1.0
"""Loss in one half of a log that is no objection [nats]: a half without evidence has a ratio of likelihoods near one."""

EXPLAINED = 0.02
"""Residual of each joint, as a share of its force, that a reading must reach to be judged by the finer measure."""

MAX_FINE_SHARE = 0.15
"""Residual of a joint, as a share of its force, from which the coarser measure has already judged all."""

MAX_VELOCITY_MISMATCH = 0.1
"""Difference between the ratio of recorded to differentiated velocity and a reading's ratio that is no veto."""

LIMIT_MARGIN = 2.0
"""Factor by which a reading may exceed limits of speed or force that the log as read keeps: limits are rated values, and peaks
reach twice the rated torque."""

MIN_MODEL_ERROR = 0.002
"""Least model error, as a share of a joint's force, at which readings are told apart: filters and masks leave as much."""

MAX_NUMBER_STDERR = 0.3
"""Largest relative standard error of a number that a reading estimates; beyond it, the log does not determine the reading."""

MAX_LEFT = 0.15
"""Share of gravity that may be left in forces from which a controller subtracted it: bodies of its model are 15 % off."""

MAX_LEFT_AT_JOINT = 0.05
"""The same for a single joint, which springs and counterweights balance to 60 to 90 %."""

MIN_MEAN_SHARE = 0.15
"""Model's mean force, as a share of the joint's force, from which a mean of zero is remarkable: three times the model error."""

MAX_ZERO_MEAN = 1e-2
"""Mean of a force, as a share of its standard deviation, below which the mean may have been removed: a cut leaves about this."""

ROUNDING_SHARE = 1e-8
"""Mean of a force, as a share of its root mean square, that rounding leaves of zero."""


@dataclass(frozen=True, eq=False)
class ReadingFit:
    """A whole-robot fit under one reading.

    Attributes:
        log_p: Log marginal likelihood [nats].
        log_posterior: Log posterior density at its maximum [nats].
        power: Residual power of each joint (na,) [N^2 or (N m)^2].
        prior: Half the squared misfit of the prior [nats].
        residual: Residual of the samples used, zero elsewhere (n, na) [N or N m].
    """

    log_p: float
    log_posterior: float
    power: np.ndarray
    prior: float
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class ReadingTest:
    """The measure by which readings of one log are judged.

    Attributes:
        size: Root mean square force of each column (na,) [N or N m].
        model_error: Least residual of a sound robot, as a share of its force.
        is_fine: Whether each joint must be explained to `EXPLAINED`.
    """

    size: np.ndarray
    model_error: float
    is_fine: bool = False

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
        """Return whether a reading gains enough, and mends a joint or spares the bodies; `before` is None where no fit exists."""
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
        return bool(gain > MIN_GAIN_NATS and (drop < MIN_POWER_DROP or spared > SPARED_NATS))

    def is_mended(
        self, after: ReadingFit, joints: Sequence[int], columns: Sequence[int], *, partly: bool = False
    ) -> bool:
        """Return whether the joints concerned, read from columns (na,), are predicted well together."""
        size, which = self.size[list(columns)], list(joints) or list(range(len(columns)))
        return bool(np.sum(after.power[which]) <= MAX_GOOD_SHARE**2 * np.sum(size[which] ** 2))

    def is_good(self, after: ReadingFit, joints: Sequence[int], columns: Sequence[int]) -> bool:
        """Return whether each joint concerned, read from columns (na,), is predicted well."""
        share = np.sqrt(after.power) / self.size[list(columns)]
        return bool(np.all(share[list(joints)] <= MAX_GOOD_SHARE))

    def sharpened(self, after: ReadingFit, columns: Sequence[int]) -> ReadingTest:
        """Return the measure with the residual that a reading leaves as the model error, at most the usual one."""
        share = float(np.max(np.sqrt(after.power) / self.size[list(columns)]))
        return replace(self, model_error=min(self.model_error, max(share, MIN_MODEL_ERROR)))


def is_hopeless(test: ReadingTest, fit: ReadingFit, counts: np.ndarray, used: np.ndarray) -> bool:
    """Return whether no reading can meet the finer measure: white noise of a joint is too large, or its model too poor.

    Args:
        test: The measure.
        fit: The fit of the log as read.
        counts: Effective number of samples of each joint (na,).
        used: Which samples are used (n, na).
    """
    if not test.is_fine:
        return False
    share = np.sqrt(fit.power) / test.size
    white = counts > 0.5 * used.sum(axis=0)
    return bool(np.any((share > EXPLAINED) & white & (counts > 0)) or np.any(share > MAX_FINE_SHARE))


def is_part_missing(left: float, *, is_single: bool) -> bool:
    """Return whether the share that is left of gravity, or of the bodies' forces, is consistent with none."""
    return abs(left) < (MAX_LEFT_AT_JOINT if is_single else MAX_LEFT)


def is_preferred_in_each_half(gains: Sequence[float]) -> bool:
    """Return whether the gains of a reading in parts of a log [nats] contradict it nowhere."""
    return min(gains, default=0.0) > -MAX_HALF_LOSS_NATS


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
    """Return whether limits (na,) permit a reading: what they hold as logged (na,) may not exceed them by far as read (na,)."""
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


MAX_ERROR_LEFT = 0.3
"""Error with the right reading over that as written: effects of a machine's own size seldom take more than two thirds."""
_READING_LEVEL = 1e-3
"""Share of the likelihood of all readings that the one as written may keep; of findings that need no held-out part."""
_EQUAL_ERRORS = 1e-3
"""Relative difference of errors below which two readings are one: equivalent conventions differ by iteration only."""


def prefer_reading(errors: Sequence[float], n_numbers: int) -> bool:
    """Return whether the best reading of a pose file replaces the first, the one as written.

    Readings of poses fit the same parameters, so their maximum log-likelihoods `-n log(error)` are compared directly. Misfits of
    a model that is wrong in other ways are similar between measurements, so the error has to fall by a factor as well. Reference:
    Burnham & Anderson 2002, 2.2.

    Args:
        errors: Error level of each reading, the one as written first.
        n_numbers: Numbers that each was compared at.
    """
    best = min(errors)
    if not best < MAX_ERROR_LEFT * errors[0]:
        return False
    return n_numbers * np.log(errors[0] / max(best, 1e-300)) > np.log(len(errors) / _READING_LEVEL)


def find_equivalent(errors: Sequence[float]) -> np.ndarray:
    """Return the indices of readings that the data do not distinguish from the best one."""
    return np.flatnonzero(np.asarray(errors) <= (1 + _EQUAL_ERRORS) * min(errors))
