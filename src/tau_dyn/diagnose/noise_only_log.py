r"""A log that holds the fitted baseline and encoder noise alone, for the parametric bootstrap of encoder noise.

A drive that closes its loop through a noisy encoder responds with force: `tau = ... + sum_l H_l n(t - l dt)`. Far above the
motion's band the measured position is noise and the force is the response to it, so `H` is fitted there, by least squares on
high-passed signals; the number of lags, which may be zero, is chosen by BIC. A few taps, as a discrete cascade has them, are
the same below that band, at the log's own rate. Two effects are not computed: a loop follows slow noise, so that less of it is
read, and a log of every fourth sample is aliased.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tau_dyn.diagnose.preparation import decimate_log
from tau_dyn.identify import PreparedSegment
from tau_dyn.log import Log, estimate_encoder_noise, estimate_quantisation_step, lowpass
from tau_dyn.model import Model

REACHES = (0, 1, 2, 4)
"""Number of samples before and after the noise in which its response is searched."""
_MIN_CUTOFF_SHARE = 0.25
"""Lowest cutoff, as a share of the rate: above it the response of masses to motion has decayed (`log/band.py`). Just above the
motion's band a tenth of the noise is still motion, whose force is due to the mass, and many taps would fit that."""
_MAX_CUTOFF_SHARE = 0.35
"""Cutoff above which too little signal remains for a fit, as a share of the rate; motion beyond is small."""


def estimate_feedback_taps(log: Log, joints: Sequence[str], cutoff_hz: float) -> np.ndarray:
    """Return the response of forces to encoder noise `H` (2 L + 1, na, na) [N/m ..] at lags -L to L; empty without feedback.

    Args:
        log: Positions and forces at the rate at which they were logged.
        joints: The actuated joints.
        cutoff_hz: Frequency up to which positions hold motion [Hz].
    """
    q, rate_hz = log.joint("q", joints), log.rate_hz
    na, above = q.shape[1], min(max(cutoff_hz, _MIN_CUTOFF_SHARE * rate_hz), _MAX_CUTOFF_SHARE * rate_hz)
    noise, answer = (x - lowpass(x, above, rate_hz) for x in (q, log.joint("tau", joints)))
    inner = slice(max(REACHES), -max(REACHES))
    answer = answer[inner]
    free = len(answer) * (1 - 2 * above / rate_hz)  # number of independent samples in the remaining band
    best, chosen = _bic(answer, 0, free), np.zeros((0, na, na))
    for reach in REACHES:
        rows = np.concatenate([x[inner] for x in _lagged(noise, reach)], axis=1)
        found = np.linalg.lstsq(rows, answer, rcond=None)[0]
        value = _bic(answer - rows @ found, rows.shape[1], free)
        if value < best:
            best, chosen = value, found.reshape(-1, na, na)
    return chosen


def apply_feedback_taps(taps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the forces (N, na) by which these taps respond to encoder noise (N, na)."""
    if not len(taps):
        return np.zeros_like(noise)
    return sum((x @ H for x, H in zip(_lagged(noise, len(taps) // 2), taps, strict=True)), np.zeros_like(noise))


def _lagged(noise: np.ndarray, reach: int) -> list[np.ndarray]:
    """Return the noise (N, na) at lags `-reach` to `reach`, zero beyond its ends."""
    padded = np.pad(noise, ((reach, reach), (0, 0)))
    return [padded[reach - lag : reach - lag + len(noise)] for lag in range(-reach, reach + 1)]


def _bic(e: np.ndarray, freedom: int, samples: float) -> float:
    """Return the criterion of all outputs together, each with `freedom` coefficients and this number of independent samples."""
    power = np.maximum(np.mean(e**2, axis=0), 1e-300)
    return float(samples * np.sum(np.log(power)) + e.shape[1] * freedom * np.log(samples))


def _add_ground(piece: PreparedSegment, force: np.ndarray) -> np.ndarray:
    """Return a model's forces (N, na) with the part of the measured ones that equations without contacts do not show."""
    if piece.contacts is None:
        return force
    rows = piece.contacts.G.swapaxes(1, 2)
    rest = (piece.force - force)[:, :, None]
    return force + (rest - np.linalg.pinv(rows) @ (rows @ rest))[:, :, 0]


_WIDEST_CUTOFF_SHARE = 0.45
"""Low-pass of a motion that fills the whole band, as a share of the rate."""
_MIN_LEVEL_STEPS = 0.1
"""Least noise before the rounding, in steps: rounding hides smaller noise, and without any, high harmonics are lines too."""
_STEADY_SHARE = 1 / 3
"""Low-pass of positions that hold no lines of rounding errors, as a share of the positions' own."""


@dataclass(frozen=True, eq=False)
class NoiseOnlyLog:
    """A log as the fitted baseline would have made it: the part that is the same in every draw of encoder noise.

    Attributes:
        log: The piece at the rate of the fit.
        joints: The actuated joints.
        q: Positions without noise (n, na) [m or rad], at the rate of the fit.
        force: The baseline's forces along them (n, na) [N or N m].
        read: Positions without noise at the rate of the recording (N, na), and its clock.
        step: Steps to which positions are rounded (na,); 0 without rounding.
        level: Noise before the rounding (na,), which depends on the position of the joint.
        smooth_hz: Low-pass of the positions without noise [Hz].
        taps: Response of forces to encoder noise; see `estimate_feedback_taps`.
        cutoff_hz: Low-pass by which the recording was thinned [Hz].
    """

    log: Log
    joints: Sequence[str]
    q: np.ndarray
    force: np.ndarray
    read: Log
    step: np.ndarray
    level: np.ndarray
    smooth_hz: float
    taps: np.ndarray
    cutoff_hz: float

    @classmethod
    def of(cls, piece: PreparedSegment, model: Model, log: Log, smooth_hz: float) -> NoiseOnlyLog:
        """Prepare a piece.

        Args:
            piece: The measured piece, ready for making columns.
            model: The fitted baseline.
            log: The piece as it was logged, before it was thinned.
            smooth_hz: Low-pass of its positions [Hz].
        """
        m, cutoff, joints = piece.motion, piece.preparation.position_cutoff_hz, piece.motion.joints
        whole = model.motion(m.q, m.v, m.a, np.sign(m.v), t=m.t, signals=m.signals)  # reversals of the synthetic motion
        force = _add_ground(piece, model.columns(whole) @ model.parameters.values)
        rate, q = piece.log.rate_hz, m.q
        if smooth_hz >= cutoff:
            q = lowpass(piece.log.joint("q", joints), min(smooth_hz, _WIDEST_CUTOFF_SHARE * rate), rate)
        measured = log.joint("q", joints)
        smooth_hz = min(smooth_hz, cutoff)
        smooth = lowpass(measured, smooth_hz, log.rate_hz)
        step = estimate_quantisation_step(measured)
        least = (_MIN_LEVEL_STEPS * step) ** 2
        level = np.sqrt(np.maximum(estimate_encoder_noise(measured) ** 2 - step**2 / 12, least))
        taps = estimate_feedback_taps(log, joints, smooth_hz)
        read = replace(log, channels={f"q_{joint}": smooth[:, k] for k, joint in enumerate(joints)})
        return cls(piece.log, joints, q, force, read, step, level, smooth_hz, taps, cutoff)

    def draw(self, rng: np.random.Generator) -> Log:
        """Return the log with new encoder noise, and its response in the forces."""
        noise = self.draw_noise(rng)
        seen = decimate_log(self._build(self.read, noise, apply_feedback_taps(self.taps, noise)), self.cutoff_hz)
        forces = self.force + seen.joint("tau", self.joints)
        return self._build(self.log, self.q + seen.joint("q", self.joints), forces)

    def draw_noise(self, rng: np.random.Generator) -> np.ndarray:
        """Return encoder noise (N, na) [m or rad] at the rate of the recording.

        Slow positions give their rounding errors themselves. Fast ones pass many steps within the low-pass: their errors have
        the lines of a constant speed, and are nearly white otherwise. The positions without noise follow such lines, which are
        partly below the low-pass, and rounded again would have too small errors. They are smoothed further there.
        """
        smooth = self.read.joint("q", self.joints)
        noise = self.level * rng.standard_normal(smooth.shape)
        if not np.any(self.step > 0):
            return noise
        grid = np.where(self.step > 0, self.step, 1.0)
        phase = rng.uniform(size=len(self.step))  # on the grid of the logs a rest would be exact
        steps_hz = np.abs(np.gradient(smooth, axis=0)) * self.read.rate_hz / grid
        path = np.where(steps_hz > self.smooth_hz, self._steady, smooth)
        rounded = (np.round((path + noise) / grid + phase) - phase) * grid - path
        return np.where(self.step > 0, rounded, noise)

    @cached_property
    def _steady(self) -> np.ndarray:
        """Positions (N, na) whose speed does not follow the lines of rounding errors."""
        return lowpass(self.read.joint("q", self.joints), _STEADY_SHARE * self.smooth_hz, self.read.rate_hz)

    def _build(self, log: Log, q: np.ndarray, tau: np.ndarray) -> Log:
        """Return a log with these positions and forces (n, na), and its other channels."""
        signals = {f"{key}_{j}": x[:, k] for key, x in (("q", q), ("tau", tau)) for k, j in enumerate(self.joints)}
        return replace(log, channels={**log.channels, **signals})
