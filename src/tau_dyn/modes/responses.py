"""Measured responses in frequency and in time, next to those of the model.

    H(f) = S_yu S_uu^-1,      coherence(f) = S_yu S_uu^-1 S_uy / S_yy,      h = F^-1 [ Y U^H (U U^H + floor)^-1 ]

Spectra are averaged over windowed segments. With several inputs the coherence is the multiple one: the share of an
output's power that all inputs explain together. Under feedback `S_yu` mixes plant and controller; with the loop's
reference r known, `H = S_yr S_ur^-1` does not (Pintelon & Schoukens 2012, 2.6). In pulse tests, whose response decays
within the record, each record is one segment and no window is needed. Noise in the inputs pulls H towards zero.

For the response to a unit pulse h, a driven record is divided by its inputs in the frequency domain, with a floor where
they hold little power. The model's simulation of the same inputs is divided in the same way, so that the floor, the
inputs' band and the record's ends affect both equally and only the difference between data and model remains.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.fft import irfft, rfft
from scipy.fft import next_fast_len
from scipy.signal import get_window

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace, simulate
from tau_dyn.results import Brief

STRETCHES = 5
"""Half-overlapping segments in addition to one for each input: fewer leave too much scatter, more blur light damping."""
MAX_WINDOW_SAMPLES = 32_768  # of a window; finer lines than its are not drawn
RESOLUTION = 6.0  # lines within the width of the narrowest resonance


@dataclass(frozen=True, eq=False)
class EmpiricalResponse(Brief):
    """Response and coherence seen in the data.

    Attributes:
        frequency: (F,) [Hz].
        response: (F, p, m), nan where the inputs hold no power.
        coherence: Share of each output's power that the inputs explain together (F, p), 0 to 1; nan where it is not
            defined.
        excited: Frequencies at which the inputs hold power (F,) bool.
        n_averages: Number of averaged segments.
        how: Description of the computation.
    """

    frequency: np.ndarray
    response: np.ndarray
    coherence: np.ndarray
    excited: np.ndarray
    n_averages: int
    how: str


def estimate_empirical_response(
    records: Sequence[Record], *, impulses: bool = False, resolve: float = 0.0
) -> EmpiricalResponse:
    """Return the response from inputs to outputs estimated from spectra alone.

    Args:
        records: Inputs and outputs on one step; their references are used if there are as many as inputs.
        impulses: Whether each record holds one short pulse and its decay.
        resolve: Width of the narrowest resonance [Hz]; segments are no longer than required to resolve it. 0 if
            unknown.
    """
    m, references = records[0].u.shape[1], [r.reference for r in records if r.reference is not None]
    looped = len(references) == len(records) and references[0].shape[1] == m and not impulses
    drives = references if looped else [r.u[:, :0] for r in records]  # without a reference the inputs drive themselves
    columns = [np.column_stack([x, r.u, r.y]) for x, r in zip(drives, records, strict=True)]
    f, s, n = _spectra(columns, records[0].dt, _size(records, impulses, resolve), impulses)
    u, y = (slice(m, 2 * m), slice(2 * m, None)) if looped else (slice(0, m), slice(m, None))
    drive = slice(0, m)
    srr, sur, syr, syy = s[:, drive, drive], s[:, u, drive], s[:, y, drive], s[:, y, y]
    excited = _excited(srr)
    response = _divide(syr, sur, excited)
    explained = np.real(np.einsum("fij,fij->fi", _divide(syr, srr, excited) if looped else response, syr.conj()))
    power = np.real(np.einsum("fii->fi", syy))
    coherence = np.where(excited[:, None] & (power > 0), explained / np.maximum(power, 1e-300), np.nan)
    if n <= 2 * m and not looped:
        coherence = np.full_like(coherence, np.nan)  # the coherence of a single segment is always one
    how = "one Fourier transform a pulse" if impulses else f"{n} half-overlapping stretches, Hann window"
    how += ", through the reference" if looped else ""
    return EmpiricalResponse(f, response, np.clip(coherence, 0, 1), excited, n, how)


def _spectra(columns: Sequence[np.ndarray], dt: float, size: int, whole: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """Return frequencies, the cross-spectral matrix S_ij = a_i conj(a_j) (F, c, c), and how many stretches were averaged."""
    total, n = np.zeros((size // 2 + 1, columns[0].shape[1], columns[0].shape[1]), complex), 0
    for x in columns:
        for stretch in [x[:size]] if whole else _stretches(x, size):
            a = np.fft.rfft(stretch, size, axis=0)
            total += np.einsum("fi,fj->fij", a, a.conj())
            n += 1
    return np.fft.rfftfreq(size, dt)[1:], total[1:] / n, n


def _stretches(x: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Yield half-overlapping stretches (size, c), their means taken off, under a Hann window."""
    window = np.asarray(get_window("hann", size))[:, None]
    for start in range(0, len(x) - size + 1, size - size // 2):
        part = x[start : start + size]
        yield window * (part - part.mean(axis=0))


def _size(records: Sequence[Record], impulses: bool, resolve: float) -> int:
    """Return the length of a stretch."""
    lengths, m = [r.n_samples for r in records], records[0].u.shape[1]
    if impulses:
        return min(lengths)
    most = min(min(lengths), MAX_WINDOW_SAMPLES, max(64, 2 * sum(lengths) // (STRETCHES + m + 1)))
    wanted = RESOLUTION / (resolve * records[0].dt) if resolve > 0 else most
    return 2 * int(min(most, max(256, wanted)) // 2)


def _excited(suu: np.ndarray) -> np.ndarray:
    """Return where the inputs have power in every direction (F,): above -60 dB relative to the maximum over frequency."""
    weakest = np.linalg.eigvalsh(suu / _scale(suu))[:, 0]
    return weakest > 1e-6 * float(np.max(weakest, initial=0.0))


def _scale(s: np.ndarray) -> np.ndarray:
    size = np.sqrt(np.maximum(np.real(np.einsum("fii->i", s)), 1e-300))
    return np.outer(size, size)


def _divide(top: np.ndarray, bottom: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return `top @ bottom^-1` at the frequencies of `where`, NaN elsewhere."""
    out = np.full(top.shape, np.nan + 0j)
    out[where] = np.swapaxes(np.linalg.solve(np.swapaxes(bottom[where], 1, 2), np.swapaxes(top[where], 1, 2)), 1, 2)
    return out


COHERENCE_LEVEL = 0.05
"""Probability of the coherence of noise above which outputs count as following the inputs."""
OVERLAP_SHARE = 0.75
"""Independent stretches in one of half-overlapping ones."""


def is_coherent(mode: Mode, seen: EmpiricalResponse, n_inputs: int) -> bool:
    """Return whether an output follows the inputs around a mode, by the median of its coherence there; True if unknown.

    The multiple coherence of noise with m inputs in k stretches exceeds c with the probability (1 - c)^(k - m).
    """
    more = OVERLAP_SHARE * seen.n_averages - n_inputs
    step = float(seen.frequency[1] - seen.frequency[0]) if len(seen.frequency) > 1 else 0.0
    near = np.abs(seen.frequency - mode.frequency_hz) <= max(mode.damping_ratio * mode.frequency_hz, 1.5 * step)
    values = seen.coherence[near & seen.excited]
    values = values[np.isfinite(values).all(axis=1)]
    if more <= 1 or not len(values):
        return True
    return bool(np.max(np.median(values, axis=0)) > 1 - COHERENCE_LEVEL ** (1 / more))


TONE_LINES, AROUND_LINES = 2, 30
"""Lines of a spectrum next to a frequency that belong to a tone, and lines that give the level around it."""
MIN_TONE_RATIO = 300.0
"""Power of a tone over the median around it; the largest of a few lines of noise is seldom 20 times the median."""
MAX_TONE_WIDTH = 3.0
"""Half width of a mode, in lines, beyond which it is no tone."""
MIN_DAMPING_T = 3.0
"""Standard errors of a damping ratio from zero from which on a structure rings at the tone."""


def find_tones(modes: Sequence[Mode], records: Sequence[Record]) -> list[Mode]:
    """Return modes without width where the inputs have a tone: a model of the tone, not of the structure."""
    longest = max(records, key=lambda r: r.n_samples)
    n, found = longest.n_samples, []
    window = np.asarray(get_window("hann", n))[:, None]
    power = np.abs(np.fft.rfft(window * (longest.u - longest.u.mean(axis=0)), axis=0)) ** 2
    for mode in modes:
        line, width = round(mode.frequency_hz * n * longest.dt), mode.damping_ratio * mode.frequency_hz * n * longest.dt
        around = power[max(1, line - AROUND_LINES) : line + AROUND_LINES + 1]
        near = power[max(1, line - TONE_LINES) : line + TONE_LINES + 1]
        rings = mode.damping_ratio > MIN_DAMPING_T * mode.damping_stderr
        if len(near) and width < MAX_TONE_WIDTH and not rings:
            if np.any(near.max(axis=0) > MIN_TONE_RATIO * np.median(around, axis=0)):
                found.append(mode)
    return found


@dataclass(frozen=True, eq=False)
class Response(Brief):
    """The model's frequency response with its uncertainty, on a grid of frequencies.

    Attributes:
        frequency: (F,) [Hz].
        value: (F, p, m) complex.
        deviation: Standard error of real and imaginary part together, as a radius in the complex plane (F, p, m).
    """

    frequency: np.ndarray
    value: np.ndarray
    deviation: np.ndarray


@dataclass(frozen=True, eq=False)
class ImpulseResponses(Brief):
    """Response to a unit pulse, measured and of the model, both seen through the same band of the inputs.

    Attributes:
        t: (T,) [s].
        measured: (T, p, m).
        model: (T, p, m).
        how: Description of the computation of the measured response.
        held_out: Whether from data that the model was not fitted to.
    """

    t: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    how: str
    held_out: bool


FLOOR = 1e-2  # floor as a share of the inputs' mean power
TIME_CONSTANTS = 2.5  # of the slowest decaying mode, as many as are shown
PERIODS = 12  # of the lowest mode, as many as are shown at most
MAX_SAMPLES = 200_000  # samples used; a response of some hundred lags is known by then


def compute_impulse_responses(
    model: StateSpace, records: Sequence[Record], modes: Sequence[Mode], *, kind: str, held_out: bool
) -> ImpulseResponses | None:
    """Return the response to a unit pulse, measured and of the model.

    Args:
        model: The model.
        records: Records on which they are compared.
        modes: Modes of the model; they determine how long a response lasts.
        kind: `driven` or `impulse`.
        held_out: Whether the model was not fitted to these records.
    """
    if not records:
        return None
    if kind == "impulse":
        return _of_pulses(model, records, held_out)
    length = _length(model, modes, min(r.n_samples for r in records))
    few = [r.window(slice(0, MAX_SAMPLES)) for r in records]
    pairs = [(r.u, np.hstack([r.y, simulate(model, r)])) for r in few]
    h = _divided(pairs, length)
    p = model.D.shape[0]
    how = "outputs divided by inputs in the frequency domain, for data and model"
    return ImpulseResponses(np.arange(length) * model.dt, h[:, :p], h[:, p:], how, held_out)


def _divided(pairs: Sequence[tuple[np.ndarray, np.ndarray]], length: int) -> np.ndarray:
    """Return responses (length, outputs, m) of all records together."""
    size = int(next_fast_len(max(len(u) for u, _ in pairs) + length, real=True) or 0)
    m, c = pairs[0][0].shape[1], pairs[0][1].shape[1]
    suu, syu = np.zeros((size // 2 + 1, m, m), complex), np.zeros((size // 2 + 1, c, m), complex)
    for u, y in pairs:
        a, b = rfft(u, size, axis=0), rfft(y, size, axis=0)
        suu += a[:, :, None] * a[:, None, :].conj()
        syu += b[:, :, None] * a[:, None, :].conj()
    power = np.real(np.einsum("fii->i", suu)) / len(suu)
    floor = FLOOR * np.diag(power)
    h = np.swapaxes(np.linalg.solve(np.swapaxes(suu + floor, 1, 2), np.swapaxes(syu, 1, 2)), 1, 2)
    return irfft(h, size, axis=0)[:length]


def _of_pulses(model: StateSpace, records: Sequence[Record], held_out: bool) -> ImpulseResponses:
    """Return each input's strongest pulse, per unit of its area over one sample."""
    m = model.D.shape[1]
    best = [max(records, key=lambda r: float(np.abs(r.u[:, j]).max())) for j in range(m)]
    length = min(r.n_samples for r in best)
    area = np.array([float(r.u[:, j].sum()) or 1.0 for j, r in enumerate(best)])
    measured = np.stack([r.y[:length] / a for r, a in zip(best, area, strict=True)], axis=2)
    followed = np.stack([simulate(model, r)[:length] / a for r, a in zip(best, area, strict=True)], axis=2)
    return ImpulseResponses(
        np.arange(length) * model.dt, measured, followed, "as recorded, per unit of the pulse's sum", held_out
    )


def _length(model: StateSpace, modes: Sequence[Mode], n: int) -> int:
    """Return the number of samples to show: until the slowest mode has decayed, and some periods of the lowest at most."""
    if not modes:
        return min(n // 2, 200)
    slowest = min(2 * np.pi * m.frequency_hz * max(m.damping_ratio, 1e-4) for m in modes)
    period = 1 / min(m.frequency_hz for m in modes)
    return int(np.clip(min(TIME_CONSTANTS / slowest, PERIODS * period) / model.dt + model.delay, 20, n // 2))
