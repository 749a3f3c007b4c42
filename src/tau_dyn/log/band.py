"""Where the motion of a log lives in frequency, against the encoder's own noise.

The spectrum is taken of second differences of q (Welch, Blackman-Harris windows of 8 s), which keeps the motion's large
slow part from leaking over everything else, and divided by their gain. The noise floor is the median over the upper band
(0.25 to 0.49 of the sampling rate), where motion through a mass has died out. The motion band reaches from the spectral peak
as far as the signal stays ten times above that floor; its edge is where 99.9 % of the *velocity's* power is reached.
Acceleration would count vibration.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

_WINDOW_S = 8.0  # [s] of Welch's method
_SMOOTHING_HZ = 2.0  # [Hz] over which the spectrum is averaged
_MIN_SNR = 10.0  # power over that of the noise, at the band's edge
_CLEAR_SNR = 300.0  # power over that of the noise, where the motion is beyond doubt
_POWER_SHARE = 0.999  # of the motion's power lies below the band's edge
_NOISE_SHARE = 1e-4  # of the motion's power that noise within the band may have


@dataclass(frozen=True)
class MotionBand:
    """The band of the motion of each joint.

    Attributes:
        edge_hz: Below it lies 99.9 % of the velocity's power (n,) [Hz].
        noise_edge_hz: Below it, the acceleration's noise power is less than 1e-4 of the acceleration's power (n,) [Hz]; a
            regressor low-passed there is not biased by its own noise.
        encoder_noise: White-noise level of the encoder (n,), in the unit of q.
        signal_edge_hz: Up to it the motion stands ten times above the encoder's noise (n,) [Hz].
        clear_edge_hz: Up to it the motion stands 300 times above the encoder's noise (n,) [Hz].
    """

    edge_hz: NDArray[np.float64]
    noise_edge_hz: NDArray[np.float64]
    encoder_noise: NDArray[np.float64]
    signal_edge_hz: NDArray[np.float64]
    clear_edge_hz: NDArray[np.float64]


def find_motion_band(q: ArrayLike, rate_hz: float) -> MotionBand:
    """Find the band of the motion in measured positions (N, n), evenly spaced and not filtered."""
    q = np.asarray(q, dtype=np.float64)
    acceleration = np.diff(q, 2, axis=0) * rate_hz**2
    n = min(len(acceleration), round(_WINDOW_S * rate_hz))  # a rate of 199.9999 Hz is one of 200
    f, power = signal.welch(acceleration, rate_hz, "blackmanharris", nperseg=n, detrend=cast(Any, False), axis=0)
    gain = (2 * np.sin(np.pi * f / rate_hz)) ** 4 * rate_hz**4
    upper = (f > 0.25 * rate_hz) & (f < 0.49 * rate_hz)
    sigma = np.sqrt(np.median(power[upper] / gain[upper, None], axis=0) * rate_hz / 2)
    noise = gain[:, None] * 2 * sigma**2 / rate_hz
    columns = [_edges(f, power[:, k], noise[:, k], rate_hz / len(q)) for k in range(q.shape[1])]
    edges = np.array(columns, dtype=np.float64).reshape(-1, 4)
    return MotionBand(edges[:, 0], edges[:, 1], sigma, edges[:, 2], edges[:, 3])


def _edges(f: NDArray, power: NDArray, noise: NDArray, resolution: float) -> tuple[float, ...]:
    """Return the motion's edge, the noise edge, the signal's edge and the clear edge of one joint."""
    width = max(3, int(round(_SMOOTHING_HZ / f[1])))
    ratio = _smooth(power, width) / np.maximum(_smooth(noise, width), 1e-300)
    clean = np.clip(power - noise, 0, None)
    velocity = np.divide(clean, (2 * np.pi * f) ** 2, out=np.zeros_like(clean), where=f > 0.5 * resolution)
    peak = int(np.argmax(velocity))
    clear, top = (peak + int(np.argmax(np.append(ratio[peak:], 0.0) < least)) for least in (_CLEAR_SNR, _MIN_SNR))
    if top == peak or velocity[:top].sum() <= 0:  # nothing stands out of the noise: a joint at rest
        return 0.0, 0.0, 0.0, 0.0
    share = np.cumsum(velocity[:top])
    edge = f[np.searchsorted(share, _POWER_SHARE * share[-1])]
    within = np.searchsorted(np.cumsum(noise), _NOISE_SHARE * clean[:top].sum())
    last = len(f) - 1
    return float(edge), float(f[min(last, int(within))]), float(f[min(top, last)]), float(f[min(clear, last)])


def _smooth(x: NDArray, width: int) -> NDArray:
    return np.asarray(signal.convolve(x, np.full(width, 1 / width), "same"))
