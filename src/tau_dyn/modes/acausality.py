r"""Do the inputs answer to what the model leaves of the outputs: the two-sided correlation test for feedback.

With e = y - G u of a causal model, whitened in the band that the input excites, by a filter A(f) = W(f) / |U(f)| without phase,

    r_k = mean_t (A e)_t (A u)_{t+k},        cross-spectrum  (E/U)(f) W(f)^2

What the model misses of the path from u to y shows at lags k <= 0 and, through the short kernel of W^2, at a few positive
ones: a band-limited path looks acausal there although no loop is closed. Disturbances that come back through a controller
show beyond, at k > 0: the input follows what is left. r at lags far away on both sides is chance alone and gives the
false-alarm rate, whatever the colours. References: Sims 1972 (future inputs foretell nothing in open loop); Söderström &
Stoica 1989, 11.2 (correlation of residuals with inputs, both signs of the lag).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len
from scipy.signal import welch
from scipy.stats import gamma

SEGMENT = 128
"""Samples of a segment of the input's spectrum: short, so that the whitening filter is smooth and its kernel short."""
EXCITED_SHARE = 0.05
"""Power density over its maximum from which on a band counts as excited (-13 dB): folded frequencies lie below."""
TAPER_SHARE = 0.3
"""Share of the excited band over which W falls to zero at its edges."""
KERNEL_LEVEL = 1e-3
"""Height of the kernel of W^2 over its peak beyond which lags are free of the path from input to output."""
SPANS = (30, 100, 300)
"""Lags that are added up, in samples: controllers answer at once, structures ring on."""
MAX_SAMPLES = 60_000
"""Samples looked at."""


@dataclass(frozen=True)
class Acausality:
    """Whether an input follows what a causal model leaves.

    Attributes:
        p_value: How often open-loop data would look more like feedback, over all inputs, outputs and spans.
        share: Correlation power at acausal lags beyond chance, over that at all lags up to the same distance.
        input: The number of the input concerned.
        output: The number of the output concerned.
    """

    p_value: float
    share: float
    input: int = 0
    output: int = 0


def find_acausality(residuals: Sequence[np.ndarray], inputs: Sequence[np.ndarray]) -> Acausality:
    """Test whether inputs follow residuals.

    Args:
        residuals: Measured minus simulated outputs, one (N, p) a record.
        inputs: Inputs (N, m) of the same samples.
    """
    found = [
        _pair([e[:, i] for e in residuals], [u[:, j] for u in inputs], j, i)
        for j in range(inputs[0].shape[1])
        for i in range(residuals[0].shape[1])
    ]
    best = min(found, key=lambda f: f.p_value)
    return Acausality(min(1.0, best.p_value * len(found)), best.share, best.input, best.output)


def _pair(e: list[np.ndarray], u: list[np.ndarray], j: int, i: int) -> Acausality:
    x, z = max(zip(u, e, strict=True), key=lambda pair: len(pair[0]))
    x, z = x[:MAX_SAMPLES] - x[:MAX_SAMPLES].mean(), z[:MAX_SAMPLES] - z[:MAX_SAMPLES].mean()
    n = len(x)
    if n < 400 or not (x.any() and z.any()):
        return Acausality(1.0, 0.0, j, i)
    size = int(next_fast_len(2 * n, real=True) or 2 * n)
    band, gain = compute_whitening(x, size)
    gap = _kernel_width(band**2, size, n // 8)
    own = gain * _colour_gain(np.fft.irfft(gain * np.fft.rfft(z, size), size)[:n], size, band)
    white = np.fft.rfft(x, size) * gain
    left = np.conj(np.fft.rfft(z, size))
    tests = [_judge(np.fft.irfft(left * kernel * white, size), n, gap) for kernel in (own, band)]
    p, share = min(tests)
    return Acausality(min(1.0, len(tests) * p), share, j, i)


def _judge(r: np.ndarray, n: int, gap: int) -> tuple[float, float]:
    """Return the p-value and share of acausal lags of r[k] = sum_t e_t u_{t+k}, negative lags at the end."""
    best = (1.0, 0.0)
    for span in SPANS:
        far = np.arange(gap + min(span, n // 16) + SPANS[-1], n // 2)
        if len(far) < 6 * span:
            continue
        scale = 1 / (n - far)
        chance = np.concatenate([r[far] ** 2 * scale, r[len(r) - far] ** 2 * scale])
        windows = chance[: len(chance) // span * span].reshape(-1, span).sum(axis=1)
        mean, spread = float(windows.mean()), float(windows.var(ddof=1))
        lags = np.arange(gap, gap + span)
        after, before = (float(np.sum(r[k] ** 2 / (n - lags))) for k in (lags, len(r) - lags))
        if mean > 0 and spread > 0:
            p = float(gamma.sf(after, mean**2 / spread, scale=spread / mean))
            best = min(best, (p * len(SPANS), max(after - mean, 0.0) / (after + before)))
    return best


def compute_whitening(x: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the window W and the gain W / |U| of an input's excited band on the grid of a real FFT of `size`."""
    f, density = _density(x)
    excited = np.append(density > EXCITED_SHARE * density.max(), False)
    edges = np.flatnonzero(np.diff(excited.astype(int), prepend=0))
    runs = list(zip(edges[::2], edges[1::2], strict=True))
    first, last = max(runs, key=lambda run: float(density[run[0] : run[1]].sum()))
    low, high = float(f[first]), float(f[last - 1])
    grid = np.arange(size // 2 + 1) / size
    width = max(TAPER_SHARE * (high - low), float(f[1]))
    up = np.ones_like(grid) if first <= 1 else _step((grid - low) / width)
    down = _step((high - grid) / width)
    band = up * down
    amplitude = np.sqrt(np.exp(np.interp(grid, f, np.log(np.maximum(density, 1e-12 * density.max())))))
    return band, band / amplitude


def _density(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [cycles a sample] and a smooth power density; at zero, where the mean is taken off, that beside it."""
    f, density = welch(x, nperseg=min(SEGMENT, len(x) // 4))
    density[0] = density[1]
    return f, density


def _step(x: np.ndarray) -> np.ndarray:
    """Return a smooth step from 0 to 1 over x = 0 .. 1."""
    return np.sin(0.5 * np.pi * np.clip(x, 0, 1)) ** 2


def _colour_gain(z: np.ndarray, size: int, band: np.ndarray) -> np.ndarray:
    """Return a smooth gain that levels the spectrum of a signal inside a band."""
    f, density = _density(z)
    grid = np.arange(size // 2 + 1) / size
    level = np.exp(np.interp(grid, f, np.log(np.maximum(density, 1e-4 * density.max()))))
    return np.where(band > 0, 1 / np.sqrt(level), 0.0)


def _kernel_width(spectrum: np.ndarray, size: int, most: int) -> int:
    """Return the lag beyond which the kernel of a spectrum stays below a share of its peak."""
    kernel = np.abs(np.fft.irfft(spectrum, size))
    loud = np.flatnonzero(kernel[: size // 2] > KERNEL_LEVEL * kernel[0])
    return int(min(loud[-1] + 1, most)) + 2
