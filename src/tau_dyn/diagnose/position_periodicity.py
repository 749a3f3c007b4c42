"""Waves over the place that positions themselves show, above the band in which they stand out of the encoder's noise.

Positions are smoothed before columns are made of them (`filters.smooth_cutoff`): what lies above is noise to a spectrum in
time. An encoder's periodic error, or a motion that cogging shakes, may lie there: a few micrometres spread over many
frequencies by the changing speed, but at one line over the place. Such positions must not be smoothed: the error would be gone
from speeds and accelerations before anybody looks for it, and the force of a true motion would pass for an error.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import butter, sosfiltfilt

from tau_dyn.diagnose.force import ForceChannel
from tau_dyn.diagnose.periodogram import build_force_terms, compute_period_statistics
from tau_dyn.effects import TransmissionError
from tau_dyn.log import compute_edge_samples, decimate, lowpass

_DRAWS = 8  # of white noise, by which the level of a peak is set
_ROOM = 1.25  # least ratio of the upper to the lower end of the band
_ORDER = 8
"""Of the high-pass, run forwards and backwards: it leaves 1e-8 of an amplitude at a third of its cutoff."""
_EDGE_FACTOR = 3
"""Edges left out, in those of the usual low-pass, which rings for a third of the time."""
_SIGNIFICANCE_LEVEL = 1e-6
"""Of any wave at all in positions that hold noise alone; true ones exceed it by far, since positions are hardly noisy."""


def detect_position_periodicity(channel: ForceChannel, smooth_hz: Sequence[float]) -> bool:
    """Tell whether positions above `smooth_hz` [Hz] repeat with the place, up to the frequencies that forces are looked at.

    Pieces in which these lie hardly above it are passed over: what little is between is in the columns anyway.
    """
    rng = np.random.default_rng(0)
    return any(_wave(channel, joint, smooth_hz, rng) for joint in channel.scene.joints)


def _wave(channel: ForceChannel, joint: str, smooth_hz: Sequence[float], rng: np.random.Generator) -> bool:
    j, fastest, top = channel.scene.index(joint), 0.0, channel.preparation.force_cutoff_hz
    pieces, lowest = [], top
    for piece, motion, smooth in zip(channel.prepared, channel.thinned, smooth_hz, strict=True):
        if _ROOM * smooth >= top:
            continue
        read, rate = piece.log.joint("q", [joint])[:, 0], piece.log.rate_hz
        made = rng.standard_normal((len(read), _DRAWS))
        both = np.column_stack([read, made])
        above = _between(both, smooth, top, rate)
        inner = slice(edge := _EDGE_FACTOR * compute_edge_samples(smooth, rate), len(above) - edge)
        if inner.stop - inner.start < 2 * edge:
            continue  # a log that begins in motion makes the filter ring there
        size = np.std(above[inner], axis=0)  # what is left of the motion counts as noise
        few = decimate(above / np.where(size > 0, size, 1.0), piece.factor)
        far = slice(-(-inner.start // piece.factor), inner.stop // piece.factor)
        pieces.append((motion.q[far, j], motion.v[far, j], few[far]))
        fastest, lowest = max(fastest, float(np.max(np.abs(motion.v[:, j])))), min(lowest, smooth)
    if not pieces:
        return False
    q, v, u = (np.concatenate(x) for x in zip(*pieces, strict=True))
    periods = np.array([setting["period"] for setting in TransmissionError.grid(channel.scene, (joint,))])
    periods = periods[fastest / periods > lowest]
    if not periods.size:
        return False
    T = compute_period_statistics(q, v, u, np.ones(len(q), bool), periods, top, build_force_terms(q))
    return bool(len(periods) * len(channel.scene.joints) * np.exp(-0.5 * T[:, 0].max()) < _SIGNIFICANCE_LEVEL)


def _between(x: np.ndarray, low_hz: float, high_hz: float, rate_hz: float) -> np.ndarray:
    """Return what of columns (N, n) lies between two frequencies [Hz].

    The high-pass is steep: encoders resolve a millionth of the motion, which has its power an octave or two below.
    """
    steep = butter(_ORDER, low_hz, "highpass", fs=rate_hz, output="sos")
    return np.asarray(sosfiltfilt(steep, lowpass(x, high_hz, rate_hz), axis=0))
