r"""Does the input answer to the output: a loop was closed, and methods for open loop would be biased.

Innovations `e` of a high-order ARX model are what cannot be foreseen in the outputs. In open loop they tell nothing about
the inputs to come; in a closed one the controller answers to them. So each input is predicted from its own past, with and
without past innovations:

    u_t = sum a_k u_{t-k} + sum b_k e_{t-k},  k = 1 .. L          all b = 0 in open loop (Granger 1969; Caines & Chan
    1975)

The ARX model may look at a few inputs to come as well: a path sampled behind anti-alias filters is two-sided, because the
force between samples shows in those before and after, and a causal model would leave those inputs in e, more so the more
outputs there are and the less noise. A controller's answer lasts longer than these few samples (Sims 1972).

An F-test says whether the b help, their share of the input's movement whether it matters: innovations that make up a
thousandth of the input bias nothing that anyone could see. An input that repeats itself exactly answers to nobody's
noise. A purely proportional controller that acts within the same sample on white noise leaves no trace here; where a
loop is known, name its reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.stats import f as fisher

from tau_dyn.modes.record import Record

LAGS = (10, 20, 60)
"""Lengths of the ARX model to choose from; many modes with little noise outlast the short ones."""
LEADS = 4
"""Inputs to come that the ARX model sees: the two-sided kernel of a path whose input ends at 0.2 to 0.9 of the Nyquist
frequency has died away by then, down to noise of a thousandth."""
MAX_SAMPLES = 10_000
"""Samples looked at: more add power to see what would not matter."""
SIGNIFICANCE_LEVEL = 1e-3  # of feedback that is not there; one record in a thousand
MIN_VARIANCE_SHARE = 1e-3
"""Share of an input's variance that answers to innovations, from which on a loop counts."""
NEW = 0.01
"""The same as a share of what is new in the input."""
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
    rows = [np.hstack([_past(r.y[:-LEADS], lags), _past(r.u, lags + LEADS, 0)]) for r in records]
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
        own.append(_past(r.u, lags)[start - lags :])
        extra.append(_past(e, lags))
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


def _past(x: np.ndarray, lags: int, first: int = 1) -> np.ndarray:
    """Return x_{t-first}, .., x_{t-lags} side by side for t = lags .. N-1."""
    return np.hstack([x[lags - k : len(x) - k] for k in range(first, lags + 1)])


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
