r"""A filter Q for learning above resonances (thesis 7.4, Figures 7.14, 7.17): a low-pass with a dip wherever one is needed.

Where `|I - L (F_u + F_y T_uy)|` is large, near a resonance, Q has to be small; elsewhere, above the resonance too, it may stay
near 1 up to the low-pass. Dips are set one at a time, at the frequency that grows most, and deepened or widened until nothing
grows more than asked. Growth at a frequency is the worse of what the model says there and at frequencies off by the tolerance:
a resonance that is not quite where the model has it must not be learnt either.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.control.iterative.learned_outputs import LearnedOutput
from tau_dyn.control.iterative.shift import TimeShift
from tau_dyn.control.iterative.zero_phase import ZeroPhase, build_notch, chain_filters, design_low_pass
from tau_dyn.exceptions import InputError

_MIN_DIP = 1e-3  # no dip is deeper
_TURNS = 300  # notches placed or deepened at most; designs that converge need tens


def design_robust_filter(
    side: LearnedOutput, learning: TimeShift, cutoff_hz: float, *, growth: float = 0.9, tolerance: float = 0.03
) -> ZeroPhase:
    """Return Q.

    Args:
        side: What is learnt, with its model.
        learning: L.
        cutoff_hz: Up to which frequency is learnt [Hz].
        growth: Largest growth of an error in an iteration that the model may show, below 1.
        tolerance: Relative error of the model's frequencies that is allowed for.

    Raises:
        InputError: Nothing of this form keeps the growth below what is asked.
    """
    if not 0 < growth < 1 or not 0 <= tolerance < 0.5:
        raise InputError("invalid_value", "a growth between 0 and 1 and a tolerance between 0 and 0.5 are needed")
    base, dips = design_low_pass(cutoff_hz, side.dt), {}
    f = np.geomspace(0.2, 0.499 / side.dt, 1500)
    left = _worst_nearby(f, side, learning, tolerance)
    for _ in range(_TURNS):
        Q = chain_filters([base, *(build_notch(c, width, floor, side.dt) for c, (width, floor) in dips.items())])
        whole = Q.response(f) * left
        k = int(np.argmax(whole))
        if whole[k] <= growth:
            return Q
        _deepen(dips, float(f[k]), growth / float(whole[k]))
    raise InputError(
        "unstable",
        f"no low-pass at {cutoff_hz:g} Hz with dips keeps the growth below {growth:g}; at {f[k]:.1f} Hz it is {whole[k]:.2f}. "
        "Take a lower cutoff, a smaller gain or a better shift",
    )


def _worst_nearby(f: np.ndarray, side: LearnedOutput, learning: TimeShift, tolerance: float) -> np.ndarray:
    """Return the largest growth without Q within the tolerance of each frequency (F,)."""
    L = learning.response(f)[:, None, None]
    response = side.response(f)
    size = np.linalg.svd(np.eye(response.shape[-1]) - L * response, compute_uv=False)[:, 0]
    reach = np.searchsorted(f, [f[0] * (1 + tolerance)])[0]
    padded = np.pad(size, reach, mode="edge")
    return np.max([padded[k : k + len(size)] for k in range(2 * reach + 1)], axis=0)


def _deepen(dips: dict[float, tuple[float, float]], f: float, factor: float) -> None:
    """Set a dip at a frequency, or make the one that is there deeper near its centre, wider at its side."""
    near = [c for c, (width, _) in dips.items() if abs(f - c) < max(width, 0.1 * c)]
    if not near:
        dips[f] = (0.1 * f, factor)
        return
    c = min(near, key=lambda c: abs(f - c))
    width, floor = dips[c]
    if abs(f - c) < 0.15 * width:
        dips[c] = (width, max(floor * max(factor, 0.7), _MIN_DIP))
    else:
        dips[c] = (width * 1.1, max(floor * 0.97, _MIN_DIP))
