r"""What a controller makes of encoder noise, seen where nothing else is to be seen.

A drive that closes its loop through a noisy encoder answers the noise with force: `tau = ... + sum_l H_l n(t - l dt)`. That
noise is in the columns as well, so force and columns agree about something that the robot never did, and a delay or a spring is
found in it. Above the motion's band the measured position is noise and the force is the answer to it, so `H` is fitted there, by
least squares on high-passed signals; how many lags there are, or none, is chosen by BIC. A few taps, as a discrete cascade
has them, are the same below that band, at the log's own rate: thinned, the same cascade has an answer of many taps, of which
the low frequencies, where motion is, show nothing.

The forces move the robot, and the encoder reads that, too: of the noise `n` the loop leaves `y = S n` in what is read, with
`S = (I + M^-1 H / w^2)^-1` and M the inertia; it follows slow noise and repeats little of it. References: Ljung 1999, 13.4
(identification in closed loop); Skogestad & Postlethwaite 2005, 2.2 (sensitivity).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.log import Log, lowpass

REACHES = (0, 1, 2, 4)
"""How many samples before and after the noise its answers are looked for in."""
_WIDEST = 0.35
"""Cutoff above which too little is left to fit to, as a share of the rate."""


def feedback_taps(log: Log, joints: Sequence[str], cutoff_hz: float) -> np.ndarray:
    """Return the answer of forces to encoder noise `H` (2 L + 1, na, na) [N/m ..] at lags -L to L; empty where there is none.

    Args:
        log: Positions and forces at the rate at which they were logged.
        joints: The actuated joints.
        cutoff_hz: Up to here positions hold motion [Hz].
    """
    q, rate_hz = log.joint("q", joints), log.rate_hz
    na = q.shape[1]
    none = np.zeros((0, na, na))
    if cutoff_hz > _WIDEST * rate_hz:
        return none
    noise, answer = (x - lowpass(x, cutoff_hz, rate_hz) for x in (q, log.joint("tau", joints)))
    inner = slice(max(REACHES), -max(REACHES))
    answer = answer[inner]
    best, chosen = _bic(answer, 0), none
    for reach in REACHES:
        rows = np.concatenate([x[inner] for x in _lagged(noise, reach)], axis=1)
        found = np.linalg.lstsq(rows, answer, rcond=None)[0]
        value = _bic(answer - rows @ found, rows.shape[1])
        if value < best:
            best, chosen = value, found.reshape(-1, na, na)
    return chosen


def answered(taps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the forces (N, na) with which these taps answer encoder noise (N, na)."""
    if not len(taps):
        return np.zeros_like(noise)
    return sum((x @ H for x, H in zip(_lagged(noise, len(taps) // 2), taps, strict=True)), np.zeros_like(noise))


def left_in_loop(taps: np.ndarray, noise: np.ndarray, inertia: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return what is read of encoder noise (N, na) while the forces of these taps act on an inertia (na, na) [kg or kg m^2]."""
    if not len(taps):
        return noise
    omega = 2 * np.pi * np.fft.rfftfreq(len(noise), 1 / rate_hz)
    lags = np.arange(len(taps)) - len(taps) // 2
    H = np.tensordot(
        np.exp(-1j * omega[:, None] * lags / rate_hz), taps.transpose(0, 2, 1), 1
    )  # forces are rows times H
    loop = inertia * omega[:, None, None] ** 2 + H
    pushed = np.fft.rfft(noise, axis=0) @ inertia.T * omega[:, None] ** 2
    left = np.zeros_like(pushed)  # a constant offset is followed
    left[1:] = np.linalg.solve(loop[1:], pushed[1:, :, None])[..., 0]
    return np.fft.irfft(left, len(noise), axis=0)


def _lagged(noise: np.ndarray, reach: int) -> list[np.ndarray]:
    """Return the noise (N, na) at lags `-reach` to `reach`, zero beyond its ends."""
    padded = np.pad(noise, ((reach, reach), (0, 0)))
    return [padded[reach - lag : reach - lag + len(noise)] for lag in range(-reach, reach + 1)]


def _bic(e: np.ndarray, freedom: int) -> float:
    """Return the criterion of all outputs together, each with `freedom` coefficients."""
    power = np.maximum(np.mean(e**2, axis=0), 1e-300)
    return float(len(e) * np.sum(np.log(power)) + e.shape[1] * freedom * np.log(len(e)))
