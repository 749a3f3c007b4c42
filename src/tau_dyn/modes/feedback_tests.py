"""Do the inputs answer to the outputs: a loop was closed, and methods for open loop would be biased. Two tests tell.

Innovations `e` of a high-order ARX model are what cannot be foreseen in the outputs. In open loop they tell nothing about the
inputs to come; in a closed one the controller answers to them. So each input is predicted from its own past, with and without
past innovations (Granger 1969; Caines & Chan 1975):

    u_t = sum a_k u_{t-k} + sum b_k e_{t-k},  k = 1 .. L          all b = 0 in open loop

The ARX model may look at a few inputs to come as well: a path sampled behind anti-alias filters is two-sided, because the force
between samples shows in those before and after, and a causal model would leave those inputs in e, more so the more outputs
there are and the less noise. A controller's answer lasts longer than these few samples (Sims 1972). An F-test says whether the
b help, their share of the input's movement whether it matters: innovations that make up a thousandth of the input bias nothing
that anyone could see. An input that repeats itself exactly answers to nobody's noise. A purely proportional controller that
acts within the same sample on white noise leaves no trace here; where a loop is known, name its reference.

The second test looks at what a causal model leaves, e = y - G u, whitened in the band that the input excites, by a filter A(f)
= W(f) / |U(f)| without phase,

    r_k = mean_t (A e)_t (A u)_{t+k},        cross-spectrum  (E/U)(f) W(f)^2

What the model misses of the path from u to y shows at lags k <= 0 and, through the short kernel of W^2, at a few positive ones.
Disturbances that come back through a controller show beyond, at k > 0: the input follows what is left. r at lags far away on
both sides is chance alone and gives the false-alarm rate, whatever the colours. References: Sims 1972; Söderström & Stoica
1989, 11.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import qr, solve_triangular
from scipy.signal import welch
from scipy.stats import f as fisher, gamma

from tau_dyn.modes.record import Record, stack_lags

LAGS = (10, 20, 60)  # lengths of the ARX model to choose from; many modes with little noise outlast the short ones
LEADS = 4
"""Inputs to come that the ARX model sees: the two-sided kernel of a path whose input ends at 0.2 to 0.9 of the Nyquist
frequency has died away by then, down to noise of a thousandth."""
MAX_SAMPLES = 10_000  # samples looked at: more add power to see what would not matter
SIGNIFICANCE_LEVEL = 1e-3  # of feedback that is not there; one record in a thousand
MIN_VARIANCE_SHARE = 1e-3  # share of an input's variance that answers to innovations, from which on a loop counts
NEW = 0.01  # the same as a share of what is new in the input
# squared difference of an input from itself a period later, relative to its power, below which it counts as periodic
REPEATS = 1e-4


@dataclass(frozen=True)
class Feedback:
    """Whether the inputs answer to the outputs.

    Attributes:
        suspected: Whether methods that bear feedback are to be used.
        p_value: How often open-loop data would look more like feedback.
        share: Largest share of an input's variance that past innovations foretell beyond its own past.
        why: The reason, as a sentence.
        input: The input concerned; empty where none is.
        possible: Whether feedback cannot be excluded, so that standard errors have to allow for it.
    """

    suspected: bool
    p_value: float
    share: float
    why: str
    input: str = ""
    possible: bool = False

    def to_dict(self) -> dict:
        """Return it for the JSON result."""
        names = ("suspected", "possible", "p_value", "share", "why")
        return {name: getattr(self, name) for name in names}


def detect_feedback(records: Sequence[Record]) -> Feedback:
    """Tell whether the inputs answer to the outputs.

    Args:
        records: Inputs and outputs as deviations from their means.
    """
    if any(r.reference is not None for r in records):
        return Feedback(True, 0.0, float("nan"), "a reference is named, so a feedback loop was closed")
    few = _first(records)
    if all(_repeats(r.u) for r in few):
        return Feedback(False, 1.0, 0.0, "the inputs repeat themselves exactly, so they answer to no noise")
    lags = max(L for L in LAGS if L == LAGS[0] or _affordable(few, L))
    innovations = _innovations(few, lags)
    few = [r.window(slice(0, r.n_samples - LEADS)) for r in few]
    found = [_answers(few, innovations, lags, j) for j in range(few[0].u.shape[1])]
    j = int(np.argmin([p if share > MIN_VARIANCE_SHARE else 1.0 for p, share, _ in found]))
    p = min(1.0, found[j][0] * len(found))
    share, new = found[j][1:]
    name = few[0].inputs[j]
    if p < SIGNIFICANCE_LEVEL and share > MIN_VARIANCE_SHARE and new > NEW:
        why = f"input '{name}' answers to past disturbances of the outputs ({100 * new:.2g} % of what is new in it, p = {p:.1g})"
        return Feedback(True, p, share, why, name)
    return Feedback(False, p, share, "no input answers to past disturbances of the outputs")


def _first(records: Sequence[Record]) -> list[Record]:
    """Return records with so many samples in all."""
    kept, left = [], MAX_SAMPLES
    for r in records:
        if left >= 200 or not kept:
            kept.append(r.window(slice(0, max(left, 200))))
            left -= r.n_samples
    return kept


def _affordable(records: Sequence[Record], lags: int) -> bool:
    unknowns = lags * (records[0].u.shape[1] + records[0].y.shape[1])
    return sum(max(0, r.n_samples - lags) for r in records) > 8 * unknowns


def _innovations(records: Sequence[Record], lags: int) -> list[np.ndarray]:
    """Return one-step errors of an ARX model that sees inputs to come (N - lags - LEADS, p), one array a record."""
    rows = [np.hstack([stack_lags(r.y[:-LEADS], lags), stack_lags(r.u, lags + LEADS, 0)]) for r in records]
    ys = [r.y[lags:-LEADS] for r in records]
    basis = _orthonormal(np.vstack(rows))
    left = np.vstack(ys)
    left = left - basis @ (basis.T @ left)
    return np.split(left, np.cumsum([len(y) for y in ys])[:-1])


def _answers(records: Sequence[Record], innovations: list[np.ndarray], lags: int, j: int) -> tuple[float, float, float]:
    """Return the p-value, and the share of the input's variance, and of its own news, that past innovations foretell."""
    own, extra, target = [], [], []
    for r, e in zip(records, innovations, strict=True):
        start = r.n_samples - len(e) + lags  # first sample with `lags` innovations behind it
        own.append(stack_lags(r.u, lags)[start - lags :])
        extra.append(stack_lags(e, lags))
        target.append(r.u[start:, j])
    a, b, u = np.vstack(own), np.vstack(extra), np.concatenate(target)
    base = _orthonormal(a)
    u1, b1 = u - base @ (base.T @ u), b - base @ (base.T @ b)
    more = _orthonormal(b1)
    gained, left = float(np.sum((more.T @ u1) ** 2)), float(u1 @ u1)
    free = len(u) - base.shape[1] - more.shape[1]
    if free < 10 or left <= 1e-18 * float(u @ u):
        return 1.0, 0.0, 0.0
    excess = max(gained - (left - gained) * more.shape[1] / free, 0.0)  # chance alone gains something too
    statistic = gained / more.shape[1] / max((left - gained) / free, 1e-300)
    return float(fisher.sf(statistic, more.shape[1], free)), excess / float(u @ u), excess / left


def _orthonormal(x: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the columns, those that add nothing left out."""
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    r, pivot = (np.asarray(a) for a in qr(x.T @ x, pivoting=True, mode="r"))
    rank = int(np.sum(np.abs(np.diag(r)) > 1e-9 * max(abs(r[0, 0]), 1e-300))) if x.size else 0
    kept = x[:, pivot[:rank]]
    upper = np.linalg.qr(kept, mode="r")
    return solve_triangular(upper, kept.T, trans=1).T if rank else np.zeros((len(x), 0))


def _repeats(u: np.ndarray) -> bool:
    """Tell whether the inputs are periodic within the record, up to a trace."""
    n = len(u)
    x = u - u.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(x, 2 * n, axis=0)) ** 2
    r = np.fft.irfft(np.sum(spectrum, axis=1))[:n] / np.arange(n, 0, -1)
    if r[0] <= 0:
        return False
    peak = np.arange(2, n // 2 + 1)
    peak = peak[(r[peak] >= r[peak - 1]) & (r[peak] > 0.9 * r[0])] if len(peak) else peak
    off = [np.sum((x[k:] - x[:-k]) ** 2) / (2 * np.sum(x[k:] ** 2)) for k in peak[np.argsort(-r[peak])][:5]]
    return bool(off) and min(off) < REPEATS


SEGMENT = 128
"""Samples of a segment of the input's spectrum: short, so that the whitening filter is smooth and its kernel short."""
EXCITED_SHARE = 0.05
"""Power density over its maximum from which on a band counts as excited (-13 dB): folded frequencies lie below."""
TAPER_SHARE = 0.3  # share of the excited band over which W falls to zero at its edges
KERNEL_LEVEL = 1e-3
"""Height of the kernel of W^2 over its peak beyond which lags are free of the path from input to output."""
SPANS = (30, 100, 300)  # lags that are added up, in samples: controllers answer at once, structures ring on
MAX_ACAUSALITY_SAMPLES = 60_000  # samples looked at


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
    x, z = (
        x[:MAX_ACAUSALITY_SAMPLES] - x[:MAX_ACAUSALITY_SAMPLES].mean(),
        z[:MAX_ACAUSALITY_SAMPLES] - z[:MAX_ACAUSALITY_SAMPLES].mean(),
    )
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
