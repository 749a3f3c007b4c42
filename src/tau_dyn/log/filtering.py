"""Velocities from measured positions without time shift, the noise of positions, and the band of the motion.

**Low-pass**: a Butterworth filter run forwards and backwards, so its power response is |H|^4 and its phase is zero:

    |H(f)|^2 = 1 / (1 + (tan(pi f dt) / tan(pi f_c dt))^(2 order))

with half the amplitude at `cutoff_hz`. Columns of a fit have to pass the same filter as the forces; filtering `W` and `tau`
differently biases it. Derivatives are central differences, with the gain `sin(w dt) / (w dt)`, 2.3 % short at 60 Hz
and 1 kHz. Arrays are (N, ...) along axis 0. Reference: Gautier, Vandanjon & Presse 1994. Clocks are in `resample.py`.

**Noise**: an encoder's noise and its quantisation while moving are white; a motion driven through a mass is not, and its
spectrum falls steeply. So the level is read at frequencies without motion, in the upper half of the band (a quarter to half of
the sampling rate):

1. fourth differences remove the motion (2 Hz at 1 kHz is reduced to 2.5e-8) and multiply white noise by |2 sin(w
   dt / 2)|^4;
2. the log is cut into windows, and those in which the joint is at rest are left out, since a resting encoder hides
   its rounding;
3. in each window the level is the median over frequencies of the periodogram divided by that gain, which a few lines (a
   gear, a resonance) do not affect; over windows it is the median again, which a few knocks do not affect;
4. a level below that of uniform rounding, step / sqrt(12), is raised to it.

Then `sigma_v^2 = sigma^2 (2 dt) int |H|^4 (sin(w dt) / dt)^2 df`. The estimate is too high if real vibration
fills the whole upper band, and too low if the drive has already filtered q.

**Band**: the spectrum is taken of second differences of q (Welch, Blackman-Harris windows of 8 s), which keeps the motion's
large slow part from leaking over everything else, and divided by their gain. The noise floor is the median over 0.25 to 0.49
of the sampling rate. The motion band reaches from the spectral peak as far as the signal stays ten times above that floor; its
edge is where 99.9 % of the *velocity's* power is reached. Acceleration would count vibration.

**Low-pass with decimation**: away from the ends a zero-phase filter is a convolution with the response `h` to one sample. Only
every `factor`-th sample of the filtered signal is needed, so

    y[j] = sum_k h[k] x[j factor - k],     |k| <= half,

is computed for those alone: the signal in blocks, each times one matrix that holds its contribution to the kept samples of its
own block and of the neighbouring ones. `h` fades exponentially, by the filter's slowest pole; the ends are filtered recursively.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import signal

from tau_dyn.exceptions import InputError

TRANSIENT = 0.01
"""Share of a start-up transient that may be left after `compute_edge_samples`."""

_FLOOR = 1e-30
"""Constant put under a signal while it is filtered, in parts of its largest value, far below rounding: where a signal is zero for
long, the filter would fade into denormal numbers, with which processors are twenty times slower."""


def lowpass(x: ArrayLike, cutoff_hz: float, rate_hz: float, order: int = 4) -> NDArray[np.float64]:
    """Low-pass a signal with zero phase.

    The ends are continued point-symmetrically, which keeps slopes but not curvature: discard `compute_edge_samples` there.

    Args:
        x: Samples (N, ...), evenly spaced.
        cutoff_hz: Frequency at which half the amplitude passes [Hz] (each of the two runs lets 71 % pass).
        rate_hz: Sampling rate [Hz].
        order: Order of one run.

    Returns:
        Filtered samples (N, ...), in the unit of `x`.

    Raises:
        InputError: The cutoff is not below half the sampling rate, or the log is shorter than the filter's transient.
    """
    x = np.asarray(x, dtype=np.float64)
    if not 0.0 < cutoff_hz < rate_hz / 2:
        raise InputError(
            "invalid_value",
            f"cutoff {cutoff_hz:g} Hz has to be above 0 and below {rate_hz / 2:g} Hz, half the sampling rate.",
        )
    pad = compute_edge_samples(cutoff_hz, rate_hz, order)
    if len(x) <= pad:
        raise InputError(
            "invalid_value",
            f"{len(x)} samples at {rate_hz:g} Hz are too few for a low-pass of {cutoff_hz:g} Hz; give more than {pad}.",
        )
    rows = _filter_both_ways(np.moveaxis(x, 0, -1), min(2 * pad, len(x) - 1), _design(order, cutoff_hz, rate_hz))
    return np.moveaxis(rows, -1, 0)


Design = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A filter's second-order sections, and their states after a long step."""


@lru_cache(maxsize=64)
def _design(order: int, cutoff_hz: float, rate_hz: float) -> Design:
    """Return the low-pass; designing it takes as long as filtering a short log."""
    sections = np.asarray(signal.butter(order, cutoff_hz, fs=rate_hz, output="sos"))
    return sections, np.asarray(signal.sosfilt_zi(sections))


def _filter_both_ways(x: NDArray[np.float64], pad: int, design: Design) -> NDArray[np.float64]:
    """Return rows (..., N) filtered as `scipy.signal.sosfiltfilt` does, continued by `pad` samples."""
    sections, steady = design
    N, floor = x.shape[-1], _FLOOR * float(max(np.max(x, initial=0.0), -np.min(x, initial=0.0)))
    long = np.empty((*x.shape[:-1], N + 2 * pad))
    np.add(x, floor, out=long[..., pad : pad + N])
    ends = long[..., pad : pad + 1], long[..., pad + N - 1 : pad + N]
    np.subtract(2 * ends[0], long[..., 2 * pad : pad : -1], out=long[..., :pad])
    np.subtract(2 * ends[1], long[..., pad + N - 2 : N - 2 : -1], out=long[..., pad + N :])
    steady = steady.reshape(len(sections), *[1] * (x.ndim - 1), 2)
    for _ in range(2):
        long = signal.sosfilt(sections, long, axis=-1, zi=steady * long[..., :1])[0][..., ::-1]
    return long[..., pad : pad + N] - floor


def compute_attenuation(f: NDArray[np.float64], cutoff_hz: float, order: int = 4) -> NDArray[np.float64]:
    """Return the attenuation of `lowpass` for sines of frequencies f (...) [Hz], far below half the sampling rate."""
    square = np.square(f / cutoff_hz)
    return 1 + (np.square(np.square(square)) if order == 4 else square**order)  # a power takes the time of ten products


def compute_edge_samples(cutoff_hz: float, rate_hz: float, order: int = 4) -> int:
    """Return the number of samples at each end of a log that `lowpass` disturbs.

    After them 1 % of a transient is left, by the filter's slowest pole, of real part `-2 pi f_c sin(pi / (2 order))`.
    """
    decay = 2 * np.pi * cutoff_hz * np.sin(np.pi / (2 * order))
    return int(np.ceil(-np.log(TRANSIENT) / decay * rate_hz))


def differentiate(x: ArrayLike, dt: float, accuracy: int = 2) -> NDArray[np.float64]:
    """Differentiate by central differences, keeping all N samples.

    Args:
        x: Samples (N, ...), evenly spaced.
        dt: Time between samples [s].
        accuracy: Order of the error in `dt`: 2, or 4 if the motion reaches above 2 % of the sampling rate.

    Returns:
        Derivative (N, ...) in the unit of `x` per second. The first and last samples (two of each with `accuracy=4`)
        are of second order too, but one-sided or shorter, and noisier.

    Raises:
        InputError: There are too few samples, or the accuracy is neither 2 nor 4.
    """
    x = np.asarray(x, dtype=np.float64)
    if accuracy not in (2, 4) or len(x) < accuracy + 1:
        raise InputError(
            "invalid_value",
            f"{len(x)} samples cannot be differentiated with accuracy {accuracy}; give 2 or 4 and more samples.",
        )
    derivative = cast(Any, np.gradient(x, dt, axis=0, edge_order=2))
    if accuracy == 4:
        derivative[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * dt)
    return np.asarray(derivative)


def decimate(x: ArrayLike, factor: int) -> NDArray[np.float64]:
    """Keep every `factor`-th sample of (N, ...), starting with the first; low-pass it below half the new rate first."""
    if factor < 1:
        raise InputError("invalid_value", f"decimation by {factor} makes no sense; give a whole number from 1.")
    return np.asarray(x, dtype=np.float64)[::factor]


def find_reversals(v: ArrayLike, threshold: float = 0.0) -> NDArray[np.intp]:
    """Return the samples at which a velocity (N,) first exceeds `threshold` with the other sign."""
    v = np.asarray(v, dtype=np.float64)
    moving = np.flatnonzero(np.abs(v) > threshold)
    return moving[1:][np.diff(np.sign(v[moving])) != 0]


WINDOW_SAMPLES = 128
"""Samples of one window: a spectral resolution of 1/128 of the sampling rate."""

_DIFFERENCES = 4  # order of differences, which remove a smooth motion


def estimate_quantisation_step(q: ArrayLike) -> NDArray[np.float64]:
    """Return the step (n,) or () of a rounded signal (N, n) or (N,), and 0 for values on no grid.

    The step is the smallest change between samples; it counts only if 99 % of all changes are whole multiples of it.
    """
    q = np.asarray(q, dtype=np.float64)
    steps = np.array([_step(column) for column in q.reshape(len(q), -1).T])
    return steps.reshape(q.shape[1:])


def estimate_encoder_noise(q: ArrayLike) -> NDArray[np.float64]:
    """Return the standard deviation (n,) or () of the white noise on positions (N, n) or (N,), in their unit."""
    q = np.asarray(q, dtype=np.float64)
    columns = q.reshape(len(q), -1).T
    floor = estimate_quantisation_step(q).reshape(-1) / np.sqrt(12)
    return np.maximum([_white_level(column) for column in columns], floor).reshape(q.shape[1:])


def compute_noise_gain(rate_hz: float, cutoff_hz: float, order: int = 4, derivatives: int = 1) -> float:
    """Return the gain of `lowpass` and central differences on white noise [1/s^derivatives]."""
    half_turns = (np.arange(4096) + 0.5) / 4096 * np.pi / 2  # pi f dt, from 0 to half the sampling rate
    with np.errstate(over="ignore"):
        passed = 1.0 / (1.0 + (np.tan(half_turns) / np.tan(np.pi * cutoff_hz / rate_hz)) ** (2 * order))
    slope = np.sin(2 * half_turns) * rate_hz
    return float(np.sqrt(np.mean(passed**2 * slope ** (2 * derivatives))))


def _step(q: NDArray[np.float64]) -> float:
    changes = np.abs(np.diff(q))
    changes = changes[changes > 1e-12 * max(float(np.abs(q).max()), 1e-300)]
    if changes.size == 0:
        return 0.0
    step = float(changes.min())
    multiples = changes / step
    on_grid = np.abs(multiples - np.round(multiples)) <= 0.05
    return step if np.mean(on_grid) >= 0.99 and np.median(multiples) < 1e4 else 0.0


def _white_level(q: NDArray[np.float64]) -> float:
    """Return the standard deviation of the white part of one signal (N,)."""
    width = min(WINDOW_SAMPLES, len(q) - _DIFFERENCES)
    if width < 16:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(np.diff(q, n=_DIFFERENCES), width)[:: width // 2]
    moving = np.any(windows != 0.0, axis=1) & (np.mean(windows != 0.0, axis=1) > 0.5)
    windows = windows[moving] if np.any(moving) else windows
    taper = np.hanning(width)
    power = np.abs(np.fft.rfft(windows * taper, axis=1)) ** 2 / np.sum(taper**2)
    omega = 2 * np.pi * np.fft.rfftfreq(width)
    band = (omega >= np.pi / 2) & (omega < 0.98 * np.pi)
    level = np.median(power[:, band] / (2 * np.sin(omega[band] / 2)) ** (2 * _DIFFERENCES), axis=1) / np.log(2)
    return float(np.sqrt(np.median(level)))


_WINDOW_S = 8.0  # [s] of Welch's method
_SMOOTHING_HZ = 2.0  # [Hz] over which the spectrum is averaged
_MIN_SNR = 10.0  # power over that of the noise, at the band's edge
_CLEAR_SNR = 300.0  # power over that of the noise, for motion beyond doubt
_POWER_SHARE = 0.999  # of the motion's power that is below the band's edge
_NOISE_SHARE = 1e-4  # of the motion's power that noise within the band may have


@dataclass(frozen=True)
class MotionBand:
    """The band of the motion of each joint.

    Attributes:
        edge_hz: Frequency below which 99.9 % of the velocity's power is (n,) [Hz].
        noise_edge_hz: Frequency below which the acceleration's noise power is less than 1e-4 of the acceleration's power (n,)
            [Hz]; a regressor low-passed there is not biased by its own noise.
        encoder_noise: White-noise level of the encoder (n,), in the unit of q.
        signal_edge_hz: Frequency up to which the motion's power is 10 times that of the encoder's noise (n,) [Hz].
        clear_edge_hz: Frequency up to which the motion's power is 300 times that of the encoder's noise (n,) [Hz].
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
    n = min(len(acceleration), round(_WINDOW_S * rate_hz))  # a rate of 199.9999 Hz means 200
    f, power = signal.welch(acceleration, rate_hz, "blackmanharris", nperseg=n, detrend=cast(Any, False), axis=0)
    gain = (2 * np.sin(np.pi * f / rate_hz)) ** 4 * rate_hz**4
    upper = (f > 0.25 * rate_hz) & (f < 0.49 * rate_hz)
    sigma = np.sqrt(np.median(power[upper] / gain[upper, None], axis=0) * rate_hz / 2)
    noise = gain[:, None] * 2 * sigma**2 / rate_hz
    columns = [_edges(f, power[:, k], noise[:, k], rate_hz / len(q)) for k in range(q.shape[1])]
    edges = np.array(columns, dtype=np.float64).reshape(-1, 4)
    return MotionBand(edges[:, 0], edges[:, 1], sigma, edges[:, 2], edges[:, 3])


FORCE_BAND_FACTOR = 5.0
"""Low-pass of forces over the motion's band edge."""
SPEED_NOISE_FACTOR = 10.0
"""Speed in standard deviations of its noise from which its sign is known."""


def choose_force_cutoff(bands: Sequence[MotionBand], rate_hz: float, factor: float = FORCE_BAND_FACTOR) -> float:
    """Return the cutoff [Hz] above the motion of all bands and below the band in which encoder noise disturbs accelerations.

    Args:
        bands: Motion bands of each log.
        rate_hz: Lowest sampling rate of the logs [Hz].
        factor: Cutoff over the motion's band edge.
    """
    edge = max(float(band.edge_hz.max()) for band in bands)
    moving = [band.noise_edge_hz[band.edge_hz > 0] for band in bands]
    noise_edge = min((float(x.min()) for x in moving if x.size), default=rate_hz)
    return min(max(min(factor * edge, noise_edge, 0.16 * rate_hz), edge), 0.4 * rate_hz)


FINEST_COUNT = 2.0**-26
"""Encoder noise, as a share of a joint's range, below which positions were smoothed before they were logged, or simulated: the
finest encoders resolve 26 bits a turn. The linear drive of EMPS counts 2^22 steps in its range, a UR10's smoothed joints 2^46."""

REST_SHARE = 0.02
"""Share of a joint's fast speed below which it counts as at rest if its noise does not show: stick-slip and pre-sliding do not
follow Coulomb and viscous friction. 1 to 5 % give a UR10's smoothed positions the same held-out error within 0.5 %, 0 a fifth
more."""

FAST_QUANTILE = 0.95
"""Quantile of a joint's speeds that is called its fast speed; a single knock does not move it."""


def compute_rest_speed(
    q: np.ndarray, rate_hz: float, cutoff_hz: float, factor: float = SPEED_NOISE_FACTOR
) -> np.ndarray:
    """Return the speed (n,) below which a joint's direction is unsure, from rest or from its noise.

    Args:
        q: Measured positions (N, n) [m or rad], evenly spaced and not filtered.
        rate_hz: Sampling rate [Hz].
        cutoff_hz: Cutoff of the low-pass of positions [Hz].
        factor: Standard deviations of a speed's noise from which its sign is known.
    """
    noise = estimate_encoder_noise(q)
    unsure = factor * noise * compute_noise_gain(rate_hz, cutoff_hz)
    smooth = noise < FINEST_COUNT * np.ptp(q, axis=0)
    if not smooth.any() or len(q) <= compute_edge_samples(cutoff_hz, rate_hz):
        return unsure
    v = differentiate(lowpass(q[:, smooth], cutoff_hz, rate_hz), 1 / rate_hz)
    unsure[smooth] = np.maximum(unsure[smooth], REST_SHARE * np.quantile(np.abs(v), FAST_QUANTILE, axis=0))
    return unsure


def _edges(f: NDArray, power: NDArray, noise: NDArray, resolution: float) -> tuple[float, ...]:
    """Return the motion's edge, the noise edge, the signal's edge and the clear edge of one joint."""
    width = max(3, int(round(_SMOOTHING_HZ / f[1])))
    ratio = _smooth(power, width) / np.maximum(_smooth(noise, width), 1e-300)
    clean = np.clip(power - noise, 0, None)
    velocity = np.divide(clean, (2 * np.pi * f) ** 2, out=np.zeros_like(clean), where=f > 0.5 * resolution)
    peak = int(np.argmax(velocity))
    clear, top = (peak + int(np.argmax(np.append(ratio[peak:], 0.0) < least)) for least in (_CLEAR_SNR, _MIN_SNR))
    if top == peak or velocity[:top].sum() <= 0:  # no peak above the noise: a joint at rest
        return 0.0, 0.0, 0.0, 0.0
    share = np.cumsum(velocity[:top])
    edge = f[np.searchsorted(share, _POWER_SHARE * share[-1])]
    within = np.searchsorted(np.cumsum(noise), _NOISE_SHARE * clean[:top].sum())
    last = len(f) - 1
    return float(edge), float(f[min(last, int(within))]), float(f[min(top, last)]), float(f[min(clear, last)])


def _smooth(x: NDArray, width: int) -> NDArray:
    return np.asarray(signal.convolve(x, np.full(width, 1 / width), "same"))


_CUT = 1e-12
"""Share of the response's transient at which it is cut off, a little above rounding."""
_KEPT = 32
"""Kept samples of a block: more are products with zeros, fewer are small matrices, which are slow."""


def lowpass_and_decimate(x: ArrayLike, cutoff_hz: float, rate_hz: float, factor: int) -> np.ndarray:
    """Return `decimate(lowpass(x, cutoff_hz, rate_hz), factor)` to 1e-11 of the largest sample, in a quarter of the time.

    Args:
        x: Samples (N, ...), evenly spaced.
        cutoff_hz: Frequency at which half the amplitude passes [Hz].
        rate_hz: Sampling rate [Hz].
        factor: One of so many samples is kept.

    Raises:
        InputError: As `lowpass` and `decimate`.
    """
    x = np.asarray(x, dtype=np.float64)
    if factor < 2 or not 0.0 < cutoff_hz < rate_hz / 2:
        return decimate(lowpass(x, cutoff_hz, rate_hz), factor)
    response = _find_response(cutoff_hz, rate_hz, factor)
    block, reach = len(response.matrix), response.reach
    count = len(x) // block - 2 * reach  # blocks whose neighbours are whole
    if count < 1 + 2 * reach:
        return decimate(lowpass(x, cutoff_hz, rate_hz), factor)
    rows = np.ascontiguousarray(np.moveaxis(x, 0, -1)).reshape(-1, len(x))
    out = np.empty((len(rows), -(-len(x) // factor)))
    begin, stop = reach * _KEPT, (reach + count) * _KEPT
    for row, y in zip(rows, out, strict=True):
        parts = row[: (count + 2 * reach) * block].reshape(-1, block) @ response.matrix
        parts = parts.reshape(-1, 2 * reach + 1, _KEPT)
        y[begin:stop] = sum(parts[m : m + count, m] for m in range(2 * reach + 1)).ravel()
    away = -(-response.half // factor)  # kept samples beyond which an end of a part has no effect
    late = min(stop - away, len(x) // factor - begin - away)
    ends = np.stack([rows[:, : len(x) - late * factor], rows[:, late * factor :]])
    ends = decimate(lowpass(ends.transpose(2, 0, 1), cutoff_hz, rate_hz), factor)
    out[:, :begin], out[:, stop:] = ends[:begin, 0].T, ends[stop - late :, 1].T
    return np.moveaxis(out.reshape(*np.moveaxis(x, 0, -1).shape[:-1], -1), -1, 0)


@dataclass(frozen=True, eq=False)
class _Response:
    """Response of the kept samples to a block of samples.

    Attributes:
        matrix: Contribution of a block (B) to the kept samples of the blocks around it (B, (2 reach + 1) kept), last one first.
        half: Samples to either side that a sample affects.
        reach: Blocks to either side that a block affects.
    """

    matrix: np.ndarray
    half: int
    reach: int


@lru_cache(maxsize=64)
def _find_response(cutoff_hz: float, rate_hz: float, factor: int) -> _Response:
    half = int(np.ceil(compute_edge_samples(cutoff_hz, rate_hz) * np.log(_CUT) / np.log(TRANSIENT)))
    block = _KEPT * factor
    reach = -(-half // block)
    impulse = np.zeros(4 * half + 1)
    impulse[2 * half] = 1.0
    h = np.zeros(2 * (reach + 1) * block + 1)  # by lag from -(reach + 1) blocks
    middle = (reach + 1) * block
    h[middle - half : middle + half + 1] = lowpass(impulse, cutoff_hz, rate_hz)[half : 3 * half + 1]
    lags = (
        np.arange(-reach, reach + 1)[None, :, None] * block
        + np.arange(block)[:, None, None]
        - factor * np.arange(_KEPT)
    )
    return _Response(h[middle + lags].reshape(block, -1), half, reach)
