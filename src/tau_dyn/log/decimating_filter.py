r"""The low-pass of `filtering.py` where only some samples are kept: a matrix product in place of two recursive runs.

Away from the ends a zero-phase filter is a convolution with the response `h` to one sample. Of the filtered signal every
`factor`-th sample is wanted, so

    y[j] = sum_k h[k] x[j factor - k],     |k| <= half,

is computed for those alone: the signal in blocks, each times one matrix that holds what it adds to the kept samples of its own
block and of the neighbouring ones. `h` fades exponentially, by the filter's slowest pole; the ends are filtered recursively.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from tau_dyn.log.filtering import TRANSIENT, compute_edge_samples, decimate, lowpass

_CUT = 1e-12
"""Share of the response's transient at which it is cut off: rounding is not far below."""
_KEPT = 32
"""Kept samples of a block: more are products with zeros, fewer are small matrices, which are slow."""


def lowpass_and_decimate(x: ArrayLike, cutoff_hz: float, rate_hz: float, factor: int) -> np.ndarray:
    """Return `decimate(lowpass(x, cutoff_hz, rate_hz), factor)` to 1e-11 of the largest sample, in a quarter of the time.

    Args:
        x: Samples (N, ...), evenly spaced.
        cutoff_hz: Frequency at which half the amplitude passes [Hz].
        rate_hz: Sampling rate [Hz].
        factor: Every how many samples one is kept.

    Raises:
        InputError: As those two.
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
    away = -(-response.half // factor)  # kept samples beyond which an end of a part is forgotten
    late = min(stop - away, len(x) // factor - begin - away)
    ends = np.stack([rows[:, : len(x) - late * factor], rows[:, late * factor :]])
    ends = decimate(lowpass(ends.transpose(2, 0, 1), cutoff_hz, rate_hz), factor)
    out[:, :begin], out[:, stop:] = ends[:begin, 0].T, ends[stop - late :, 1].T
    return np.moveaxis(out.reshape(*np.moveaxis(x, 0, -1).shape[:-1], -1), -1, 0)


@dataclass(frozen=True, eq=False)
class _Response:
    """How kept samples answer to a block of samples.

    Attributes:
        matrix: What a block (B) adds to the kept samples of the blocks around it (B, (2 reach + 1) kept), the last one first.
        half: Samples to either side that a sample reaches.
        reach: Blocks to either side that a block reaches.
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
