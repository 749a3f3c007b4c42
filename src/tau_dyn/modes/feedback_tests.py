"""Two tests for feedback from the outputs to the inputs, under which methods for open loop are biased.

Innovations `e` of a high-order ARX model are the part of the outputs that cannot be predicted. In open loop they
contain no information about future inputs; in closed loop the controller responds to them. So each input is predicted
from its own past, with and without past innovations (Granger 1969; Caines & Chan 1975):

    u_t = sum a_k u_{t-k} + sum b_k e_{t-k},  k = 1 .. L          all b = 0 in open loop

The ARX model may also use a few future inputs: a path sampled behind anti-alias filters is two-sided, because the force
between samples appears in the samples before and after. A causal model would leave those inputs in e, the more so with
more outputs and less noise. The response of a controller lasts longer than these few samples (Sims 1972). An F-test
decides whether the b are significant; their share of the input's variance decides whether they matter: innovations that
make up a thousandth of the input cause no visible bias. An input that repeats itself exactly does not respond to noise.
A purely proportional controller that acts within the same sample on white noise leaves no trace in this test; if a loop
is known, name its reference.

The second test examines the residual of a causal model, e = y - G u, in the band W that the input excites, by
zero-phase filters,

    r_k = sum_t e'_t u'_{t+k},   e' = e / |U|,   u' = W^2 u / |U|,        cross-spectrum  (E/U)(f) W(f)^2

Errors of the model's path from u to y appear at lags k <= 0 and, through the short kernel of W^2, at a few positive
ones. Disturbances that return through a controller appear at larger lags, because the input follows the residual. In
open loop the r_k at these lags are normally distributed with Bartlett's covariance, given e:

    E r_k r_{k+l} = (1 - k/N) sum_j c_e'(j) c_u'(j + l)

so a sum of squares over a span of lags is a quadratic form of known moments. The tests of all spans, with e unfiltered
(which favours resonances) and whitened by a causal autoregression (which favours the whole band), are combined into one
p-value. References: Sims 1972; Söderström & Stoica 1989, 11.2; Box & Jenkins 1976, 11.1 (Bartlett's formula); Liu & Xie
2020 (Cauchy combination).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import next_fast_len
from scipy.linalg import qr, solve_triangular, toeplitz
from scipy.signal import welch
from scipy.stats import chi2, f as fisher

from tau_dyn.modes.hankel import fit_autoregression
from tau_dyn.modes.record import Record, stack_lags
from tau_dyn.modes.state_space import StateSpace

LAGS = (10, 20, 60)  # lengths of the ARX model to choose from; many modes with little noise outlast the short ones
LEADS = 4
"""Inputs to come that the ARX model sees: the two-sided kernel of a path whose input ends at 0.2 to 0.9 of the Nyquist
frequency has died away by then, down to noise of a thousandth."""
MAX_SAMPLES = 10_000  # samples examined: more would only detect feedback that does not matter
SIGNIFICANCE_LEVEL = 1e-3  # of feedback that is not there; one record in a thousand
MIN_VARIANCE_SHARE = 1e-3  # share of an input's variance that responds to innovations, from which on a loop counts
NEW = 0.01  # the same as a share of what is new in the input
# squared difference of an input from itself a period later, relative to its power, below which it counts as periodic
REPEATS = 1e-4


@dataclass(frozen=True)
class Feedback:
    """Whether the inputs respond to the outputs.

    Attributes:
        suspected: Whether methods that remain consistent under feedback are to be used.
        p_value: How often open-loop data would look more like feedback.
        share: Largest share of an input's variance that past innovations predict beyond its own past.
        why: The reason, as a sentence.
        input: The input concerned; empty without feedback.
        possible: Whether feedback cannot be excluded, so that standard errors have to allow for it.
        detectable_loop_gain: Loop gain of a constant controller below which a loop may stay unseen in this record; nan
            if not computed.
    """

    suspected: bool
    p_value: float
    share: float
    why: str
    input: str = ""
    possible: bool = False
    detectable_loop_gain: float = float("nan")


def detect_feedback(records: Sequence[Record]) -> Feedback:
    """Test whether the inputs respond to the outputs.

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
    found = _answers(few, innovations, lags)
    j = int(np.argmin([p if share > MIN_VARIANCE_SHARE else 1.0 for p, share, _ in found]))
    p = min(1.0, found[j][0] * len(found))
    share, new = found[j][1:]
    name = few[0].inputs[j]
    if p < SIGNIFICANCE_LEVEL and share > MIN_VARIANCE_SHARE and new > NEW:
        why = f"input '{name}' answers to past disturbances of the outputs ({100 * new:.2g} % of its innovation, p = {p:.1g})"
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
    """Return one-step errors of an ARX model that uses future inputs (N - lags - LEADS, p), one array per record."""
    rows = [np.hstack([stack_lags(r.y[:-LEADS], lags), stack_lags(r.u, lags + LEADS, 0)]) for r in records]
    ys = [r.y[lags:-LEADS] for r in records]
    basis = _orthonormal(np.vstack(rows))
    left = np.vstack(ys)
    left = left - basis @ (basis.T @ left)
    return np.split(left, np.cumsum([len(y) for y in ys])[:-1])


def _answers(records: Sequence[Record], innovations: list[np.ndarray], lags: int) -> list[tuple[float, float, float]]:
    """Return for each input the p-value, and the share of its variance and of its innovation that past innovations predict."""
    own, extra, target = [], [], []
    for r, e in zip(records, innovations, strict=True):
        start = r.n_samples - len(e) + lags  # first sample with `lags` innovations behind it
        own.append(stack_lags(r.u, lags)[start - lags :])
        extra.append(stack_lags(e, lags))
        target.append(r.u[start:])
    a, b, inputs = np.vstack(own), np.vstack(extra), np.vstack(target)
    base = _orthonormal(a)
    more = _orthonormal(b - base @ (base.T @ b))
    free = len(inputs) - base.shape[1] - more.shape[1]
    found = []
    for u in inputs.T:
        u1 = u - base @ (base.T @ u)
        gained, left = float(np.sum((more.T @ u1) ** 2)), float(u1 @ u1)
        if free < 10 or left <= 1e-18 * float(u @ u):
            found.append((1.0, 0.0, 0.0))
            continue
        excess = max(gained - (left - gained) * more.shape[1] / free, 0.0)  # subtract the gain expected by chance
        statistic = gained / more.shape[1] / max((left - gained) / free, 1e-300)
        p_value = float(fisher.sf(statistic, more.shape[1], free))
        found.append((p_value, excess / float(u @ u), excess / left))
    return found


def _orthonormal(x: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the columns, without linearly dependent ones."""
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    r, pivot = (np.asarray(a) for a in qr(x.T @ x, pivoting=True, mode="r"))
    rank = int(np.sum(np.abs(np.diag(r)) > 1e-9 * max(abs(r[0, 0]), 1e-300))) if x.size else 0
    kept = x[:, pivot[:rank]]
    upper = np.linalg.qr(kept, mode="r")
    return solve_triangular(upper, kept.T, trans=1).T if rank else np.zeros((len(x), 0))


def _repeats(u: np.ndarray) -> bool:
    """Return whether the inputs are periodic within the record, up to a small error."""
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
MAX_LEAK = 0.1
"""Largest contribution of the path from input to output through the kernel of W^2, in standard deviations of a lag."""
KERNEL_LEVELS = (1e-3, 0.03)
"""Least and greatest height of that kernel over its peak at the first acausal lag that counts: a path left out by 30 dB over
the noise, and one that is not seen."""
SPANS = (10, 30, 100)
"""Acausal lags that are added up, in samples: controllers respond at once, structures decay slowly. Longer spans
add only noise: of 20 loops of gain 3 in 6 s, sums of 30 lags show 16 to 19 at 0.001, sums of 300 lags 1 to 5."""
MIN_ACAUSALITY_SAMPLES, MAX_ACAUSALITY_SAMPLES = 400, 60_000  # samples needed, and used at most
ACAUSALITY_SIGNIFICANCE_LEVEL = 1e-3
"""p-value below which a loop was closed: at most one false alarm in a thousand open-loop tests."""


@dataclass(frozen=True)
class Acausality:
    """Whether an input follows the residual of a causal model.

    Attributes:
        p_value: How often open-loop data would look more like feedback, over all inputs, outputs and spans.
        share: Correlation power at acausal lags beyond chance, over that at all lags up to the same distance.
        input: The number of the input concerned.
        output: The number of the output concerned.
        detectable_gain: Detection limit: the largest loop gain over the excited band above which a controller of
            constant gain is detectable in weak loops, for the pair that is hardest to detect; nan if no model is given.
            Loops at the limit are detected in about every fourth record, at twice the limit in nearly all.
    """

    p_value: float
    share: float
    input: int = 0
    output: int = 0
    detectable_gain: float = float("nan")


def find_acausality(
    residuals: Sequence[np.ndarray], inputs: Sequence[np.ndarray], model: StateSpace | None = None
) -> Acausality:
    """Test whether inputs follow residuals.

    Args:
        residuals: Measured minus simulated outputs, one (N, p) a record.
        inputs: Inputs (N, m) of the same samples.
        model: The path from inputs to outputs, for the detection limit.
    """
    f = np.linspace(0.001, 0.499, 500)
    H = np.full((len(f), residuals[0].shape[1], inputs[0].shape[1]), np.nan)
    if model is not None:
        f = np.union1d(f, np.abs(np.angle(model.poles())) / (2 * np.pi))
        H = np.abs(model.frequency_response(f / model.dt))
    found, gains = [], []
    for i, j in np.ndindex(H.shape[1:]):
        x, z = max(((u[:, j], e[:, i]) for u, e in zip(inputs, residuals, strict=True)), key=lambda pair: len(pair[0]))
        tests = _test_pair(x[:MAX_ACAUSALITY_SAMPLES], z[:MAX_ACAUSALITY_SAMPLES], f, H[:, i, j])
        found += [replace(test, input=j, output=i) for test in tests]
        gains += [min(test.detectable_gain for test in tests)] if tests else []
    if not found:
        return Acausality(1.0, 0.0)
    p = _combine_p_values(np.array([test.p_value for test in found]))
    return replace(min(found, key=lambda test: test.p_value), p_value=p, detectable_gain=max(gains))


def _combine_p_values(p: np.ndarray) -> float:
    """Return the p-value of several tests (k,), however they depend on each other (Cauchy combination, Liu & Xie 2020)."""
    p = np.clip(p, 1e-300, 0.99)
    return float(np.arctan2(1.0, np.mean(1 / np.tan(np.pi * p))) / np.pi)


def _test_pair(x: np.ndarray, z: np.ndarray, f: np.ndarray, path: np.ndarray) -> list[Acausality]:
    """Return the tests of all spans of one input x (N,) and residual z (N,), unfiltered and whitened.

    Args:
        x: The input.
        z: Residual of the output.
        f: Frequencies [cycles a sample].
        path: Magnitude of the response from input to output there.
    """
    n, x, z = len(x), x - x.mean(), z - z.mean()
    if n < MIN_ACAUSALITY_SAMPLES or not (x.any() and z.any()):
        return []
    size = int(next_fast_len(2 * n, real=True) or 2 * n)
    band, gain = compute_whitening(x, size)
    highest = path[np.interp(f, np.arange(len(band)) / size, band) > 0.5].max(initial=0.0)
    white = np.fft.rfft(x, size) * gain * band
    density = np.mean(np.abs(white) ** 2) / np.mean(band**4) * band**4
    transform = np.fft.rfft(z, size)
    plain = transform * np.where(band > 0, gain / np.maximum(band, 1e-12), 0.0)
    kernel = np.abs(np.fft.irfft(band**2, size))[: n // 8]
    kernel = np.maximum.accumulate(kernel[::-1])[::-1] / kernel[0]
    found = []
    whitening = np.r_[1.0, -fit_autoregression([z[:, None]])[0].ravel()]
    for error in (plain, plain * np.fft.rfft(whitening, size)):
        r, fed_back = np.fft.irfft([np.conj(error) * white, np.conj(error) * transform * gain * band], size)
        autocovariance = np.fft.irfft(np.abs(error) ** 2 * density, size) / n
        sigma = np.sqrt(max(autocovariance[0], 1e-300))
        level = np.clip(MAX_LEAK * sigma / max(np.abs(r[-(n // 4) :]).max(), abs(r[0])), *KERNEL_LEVELS)
        gap = int(np.argmax(kernel < level)) or len(kernel)
        for span in (span for span in SPANS if gap + span <= n // 4):
            lags = np.arange(gap, gap + span)
            power, behind, shift = (np.sum(v**2 * n / (n - lags)) for v in (r[lags], r[-lags], fed_back[lags]))
            p, critical = _compare_with_chance(power, toeplitz(autocovariance[:span]))
            excess = max(power - span * sigma**2, 0.0)
            limit = float(np.sqrt(max(critical - span * sigma**2, 0.0) / max(shift, 1e-300)) * highest)
            found.append(Acausality(p, float(excess / (power + behind)), detectable_gain=limit))
    return found


def _compare_with_chance(power: float, covariance: np.ndarray) -> tuple[float, float]:
    """Return the chance that normal numbers of a covariance (k, k) have a sum of squares above `power`, and the critical one.

    Pearson's approximation by the first three moments. The critical power is that of the significance level shared by all tests
    of a pair.
    """
    square = covariance @ covariance
    mean, second, third = np.trace(covariance), np.trace(square), np.sum(square * covariance)
    freedom = second**3 / third**2
    unit = np.sqrt(second / freedom)
    level = ACAUSALITY_SIGNIFICANCE_LEVEL / (2 * len(SPANS))
    p = chi2.sf(freedom + (power - mean) / unit, freedom)
    return float(p), float(mean + unit * (chi2.isf(level, freedom) - freedom))


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
    """Return frequencies [cycles per sample] and a smooth power density.

    The mean is removed; the density at zero is therefore set to that of the next frequency.
    """
    f, density = welch(x, nperseg=min(SEGMENT, len(x) // 4))
    density[0] = density[1]
    return f, density


def _step(x: np.ndarray) -> np.ndarray:
    """Return a smooth step from 0 to 1 over x = 0 .. 1."""
    return np.sin(0.5 * np.pi * np.clip(x, 0, 1)) ** 2
