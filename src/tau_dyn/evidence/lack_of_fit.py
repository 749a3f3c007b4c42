r"""The part of each joint's force that a model does not explain and that is not noise of the force.

The noise is estimated in the upper half of the fit's band, f_c / 2 to f_c: motion ends at about a fifth of the low-pass' cutoff
f_c, and missing friction of a model is smooth in time except at reversals, which are masked. With the periodogram S of short
stretches of the residual and the low-pass' gain |F|^2,

    sigma^2 = mean(S / |F|^4 over the upper half) * integral of |F|^4,        R^2 = mean(e^2)
    missed share = sqrt(R^2 - sigma^2) / rms(tau)

white noise of that level in the whole band; noise that grows with frequency gives a larger sigma and a smaller share. The
residual is compared with the noise by an F test, whose degrees of freedom are the independent values of each. Reference:
Welch 1967.

Simulated positions have the encoder's noise as their lower bound. Their scale is the distance of the robot from its command,
which a simulation without a model leaves: `missed share = sqrt(R^2 - sigma^2) / rms(q - command)`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from tau_dyn.estimate import Regression
from tau_dyn.log import compute_attenuation, find_true_runs
from tau_dyn.message_codes import CodedWarning

MAX_MISSED_SHARE = 0.2
"""Largest share of a joint's force, beyond noise, that a model may leave unexplained. Models of sound geared robots leave 2 to
15 % of it, by friction that no textbook law describes; beyond a fifth a force is missing, or a sign, unit or zero is wrong."""
MIN_STRUCTURED_SHARE = 0.02
"""Share beyond noise from which a search for causes is advised: below it, the spectrum assumed for the noise decides."""
MIN_MISSED_MOTION = 0.005
"""Share of a joint's distance from its command, beyond the encoder's noise, from which a simulation lacks an effect. In
simulated hobby servos 0.1 to 0.6 % is left with the true law, 1.6 to 3.5 % without its back EMF, 4 to 17 % with a gain of 1.4
times the true one (worst joint of each arm)."""
MIN_NOISE_RATIO = 1.5
"""Residual over the encoder's noise from which a simulation lacks an effect: more than half of its variance is no noise."""
LEVEL = 1e-3
"""Significance level, over all joints, of a residual beyond noise."""
SEGMENT_ROWS = 16
"""Rows of a stretch whose spectrum is taken: 16 values resolve a sixth of the cutoff at 2.5 rows per period of it."""
UPPER_BAND = (0.5, 1.0)
"""Band in which the noise is estimated, in cutoffs of the fit's low-pass."""


@dataclass(frozen=True)
class PoorFit:
    """A joint whose force or motion a model does not explain.

    Attributes:
        joint: The joint.
        missed_share: Rms of the residual without noise over that of the force, or of the distance from the command.
        noise_rms: Rms of the noise [N or N m, rad or m].
        p_value: p-value of such a residual under noise alone, over all joints.
        missed_rms: Rms of the residual without noise [the noise's unit].
    """

    joint: str
    missed_share: float
    noise_rms: float
    p_value: float
    missed_rms: float


def find_poor_fits(
    regression: Regression, residuals: Sequence[np.ndarray], min_share: float = MAX_MISSED_SHARE
) -> tuple[PoorFit, ...]:
    """Return the joints at which a model leaves more than a share of the force unexplained, beyond noise.

    Args:
        regression: Forces, masks and the low-pass applied to them.
        residuals: Measured minus predicted (n, m) of each run, filtered equally.
        min_share: Smallest rms of the residual without noise over that of the force.
    """
    found = []
    for k, joint in enumerate(regression.outputs):
        e = np.concatenate([x[run.usable[:, k], k] for x, run in zip(residuals, regression.runs, strict=True)])
        y = np.concatenate([run.y[run.usable[:, k], k] for run in regression.runs])
        if not len(e) or not np.any(y):
            continue
        noise, freedom = _estimate_noise(regression, residuals, k)
        square = float(np.mean(e**2))
        missed = float(np.sqrt(max(0.0, square - noise)))
        share = missed / float(np.sqrt(np.mean(y**2)))
        chance = float(stats.f.sf(square / noise, *freedom)) if noise > 0 else 0.0
        p_value = min(1.0, len(regression.outputs) * chance)
        if share > min_share and p_value < LEVEL:
            found.append(PoorFit(joint, share, float(np.sqrt(noise)), p_value, missed))
    return tuple(found)


def find_poor_simulations(
    joints: Sequence[str], residual: np.ndarray, noise: np.ndarray, distance: np.ndarray, n_values: float
) -> tuple[PoorFit, ...]:
    """Return the joints whose simulated motion differs from the measured one by far more than the encoder's noise.

    Args:
        joints: The joints.
        residual: Rms of measured minus simulated positions (na,) [rad or m].
        noise: Rms of the encoders' noise and rounding (na,).
        distance: Rms of measured minus commanded positions (na,).
        n_values: Number of independent samples.
    """
    found = []
    for joint, r, s, d in zip(joints, residual, noise, distance, strict=True):
        share = float(np.sqrt(max(0.0, r**2 - s**2)) / d) if d > 0 else 0.0
        if share <= MIN_MISSED_MOTION or r <= MIN_NOISE_RATIO * s:
            continue
        chance = float(stats.chi2.sf(n_values * (r / s) ** 2, n_values)) if s > 0 else 0.0
        if (p_value := min(1.0, len(joints) * chance)) < LEVEL:
            found.append(PoorFit(joint, share, float(s), p_value, share * float(d)))
    return tuple(found)


def describe_poor_simulations(found: Sequence[PoorFit], units: Mapping[str, str]) -> list[CodedWarning]:
    """Return the warning that names the joints of a poor simulation; empty if there are no such joints.

    Args:
        found: The joints.
        units: Unit of each joint's position, rad or m.
    """
    if not found:
        return []
    listed = ", ".join(
        f"{one.joint} ({1e3 * one.missed_rms:.2g} m{units[one.joint]} beyond {1e3 * one.noise_rms:.2g} m{units[one.joint]})"
        for one in found
    )
    sentence = (
        f"the simulation differs from the training logs by far more than the encoder's noise at {listed}; the servo's law, the "
        "friction or the bodies lack an effect, and values with their intervals contain its error; look for it (tau-dyn diagnose)"
    )
    return [CodedWarning("poor_fit", sentence, [one.joint for one in found])]


def describe_poor_fits(found: Sequence[PoorFit], *, causes_sought: bool = False) -> list[CodedWarning]:
    """Return the warning that names the joints of a poor fit; empty if there are no such joints.

    Args:
        found: The joints.
        causes_sought: Whether causes were searched already, so that this is no advice.
    """
    if not found:
        return []
    listed = ", ".join(f"{one.joint} ({100 * one.missed_share:.0f} %)" for one in found)
    sentence = (
        f"the model misses much of the force beyond its noise at {listed}; check the sign, unit, zero and order of columns "
        "(tau-dyn check LOG ROBOT)"
    )
    sentence += "" if causes_sought else ", then look for a cause (tau-dyn diagnose)"
    return [CodedWarning("poor_fit", sentence, [one.joint for one in found])]


def _estimate_noise(
    regression: Regression, residuals: Sequence[np.ndarray], output: int
) -> tuple[float, tuple[float, float]]:
    """Return the variance of one output's noise, and the independent values of the residual and of that estimate."""
    cutoff_hz, levels, power, n_values = regression.preparation.force_cutoff_hz, [], 0.0, 0.0
    window = np.hanning(SEGMENT_ROWS + 2)[1:-1]
    for run, residual in zip(regression.runs, residuals, strict=True):
        if len(run.t) < SEGMENT_ROWS:
            continue
        step = float(np.median(np.diff(run.t)))
        f = np.asarray(np.fft.rfftfreq(SEGMENT_ROWS, step), np.float64)
        passed = compute_attenuation(f, cutoff_hz) ** -2.0 if np.isfinite(cutoff_hz) else np.ones(len(f))
        top = min(cutoff_hz, f[-1])
        upper = (f >= UPPER_BAND[0] * top) & (f <= UPPER_BAND[1] * top)
        n_values += float(run.usable[:, output].sum()) * min(1.0, 2 * top * step)
        for piece in _cut(residual[:, output], run.usable[:, output]):
            spectrum = np.abs(np.fft.rfft(piece * window)) ** 2 / float(window @ window)
            levels.append(float(np.mean(spectrum[upper] / passed[upper])))
            power = float(np.mean(np.concatenate([passed, passed[1:-1]])))
    if not levels:
        return 0.0, (1.0, 1.0)
    independent = max(1.0, 2 * len(levels) * float(upper.sum()) / 2)
    return float(np.mean(levels)) * power, (max(1.0, n_values), independent)


def _cut(x: np.ndarray, usable: np.ndarray) -> list[np.ndarray]:
    """Return unbroken pieces (`SEGMENT_ROWS`,) of usable samples, each without its mean, overlapping by half."""
    found = []
    for stretch in find_true_runs(usable):
        for first in range(stretch.start, stretch.stop - SEGMENT_ROWS + 1, SEGMENT_ROWS // 2):
            piece = x[first : first + SEGMENT_ROWS]
            found.append(piece - piece.mean())
    return found
