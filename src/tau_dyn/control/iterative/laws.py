"""Learning laws, from one trial's error to the next correction: filters, a norm-optimal law, and a robust filter Q.

The learning law `u_{k+1} = Q (u_k + L e_k)` (thesis 7.2, 7.6), `Q = Q_w Q_z` (7.13): weights after a zero-phase filter.

Norm-optimal learning, for comparison: each correction minimises the cost that the model predicts for the next trial.

    |W e_{k+1}|^2 + effort |u_{k+1}|^2 + change |u_{k+1} - u_k|^2,   e_{k+1} = e_k - T (u_{k+1} - u_k),   T = F_u + F_y T_uy

with the weights W of (7.14) on the errors, and corrections only where these are not zero. This is again `Q (u + L e)`, with
matrices in place of filters: with `S = T'W^2 T`, `N = S + effort + change`,

    Q = N^-1 (S + change),    Q L = N^-1 T'W^2,    H = Q - Q L T = change N^-1,

so the model's H never has a singular value above `change / (effort + change)`: convergence is monotone for every choice. The
whole model is used, its coupling and its resonances too, so errors of the model matter. Reference: Amann, Owens, Rogers 1996,
IEE Proc.; Bristow, Tharayil, Alleyne 2006, IEEE Control Systems 26.

The robust filter Q for learning above resonances (thesis 7.4, Figures 7.14, 7.17) is a low-pass with notches.

Near a resonance `|I - L (F_u + F_y T_uy)|` is large and Q has to be small; at other frequencies, also above the resonance, Q may
stay near 1 up to the low-pass. Notches are added one at a time, at the frequency with the largest growth, and deepened or widened
until no frequency grows more than allowed. The growth at a frequency is the largest value of the model within the tolerance of
that frequency: a resonance slightly off its modelled frequency must not be learnt either.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import aslinearoperator

from tau_dyn.control.iterative.filters import (
    LearningFilter,
    TimeShift,
    ZeroPhase,
    build_notch,
    chain_filters,
    design_low_pass,
)
from tau_dyn.control.iterative.learned_outputs import LearnedOutput, Reference
from tau_dyn.control.iterative.lifted_system import Operator, build_signal_operator, stack_channels, unstack_channels
from tau_dyn.exceptions import InputError


class UpdateLaw(Protocol):
    """How one trial's error changes the next trial's correction."""

    @property
    def side(self) -> LearnedOutput:
        """The learned output."""
        ...

    @property
    def bound(self) -> float | None:
        """A bound on H's singular values that holds by construction; None if they have to be computed."""
        ...

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        ...

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        ...

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return Q and L without weights as responses (F, m, m); None if they vary along the trial."""
        ...


@dataclass(frozen=True, eq=False)
class LearningLaw:
    """Filters Q and L.

    Attributes:
        side: The learned output.
        forgetting: Q without its weights, one per channel.
        learning: L, the same for all channels.
        bound: None: singular values have to be computed.
    """

    side: LearnedOutput
    forgetting: tuple[ZeroPhase, ...]
    learning: LearningFilter
    bound: None = None

    def __post_init__(self) -> None:
        """Refuse filters made for another step than the models."""
        for what, dt in [("L", self.learning.dt), *(("Q", q.dt) for q in self.forgetting)]:
            if abs(dt - self.side.dt) > 1e-9 * self.side.dt:
                raise InputError(
                    "mismatch",
                    f"filter {what} is made for {1000 * dt:g} ms, the model for {1000 * self.side.dt:g} ms; "
                    "a law, its models and the robot need the same sampling step",
                )

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        if error.shape != (motion.n, len(self.forgetting)):
            raise InputError(
                "mismatch", f"{len(self.forgetting)} filter(s) Q for errors {error.shape}; one a channel is needed"
            )
        asked = correction + self.learning.apply(error)
        kept = [q.apply(asked[:, k]) for k, q in enumerate(self.forgetting)]
        return motion.weights()[:, None] * np.column_stack(kept)

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        n, m, w = motion.n, len(self.forgetting), motion.weights()[:, None]

        def filtered(x: np.ndarray) -> np.ndarray:  # its own transpose
            return np.column_stack([q.apply(x[:, k]) for k, q in enumerate(self.forgetting)])

        Q = build_signal_operator(lambda x: w * filtered(x), lambda x: filtered(w * x), n, m, m)
        L = build_signal_operator(self.learning.apply, self.learning.transposed, n, m, m)
        return Q, Q @ L

    def matrices(self, motion: Reference, channel: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return Q and L of one channel (N, N), thesis (7.10) to (7.14)."""
        w = motion.weights()[:, None]
        return w * self.forgetting[channel].matrix(motion.n), self.learning.matrix(motion.n)

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Q and L without weights as responses (F, m, m)."""
        eye = np.eye(len(self.forgetting))
        Q = np.column_stack([q.response(frequency) for q in self.forgetting])
        return Q[:, :, None] * eye, self.learning.response(frequency)[:, None, None] * eye


@dataclass(frozen=True, eq=False)
class NormOptimalLaw:
    """Norm-optimal learning.

    Attributes:
        side: The learned output.
        effort: Cost of the correction's size relative to that of the error.
        change: Cost of the correction's change; a large one learns slowly and averages noise.
    """

    side: LearnedOutput
    effort: float = 1e-3
    change: float = 0.1
    _kept: list[tuple[Reference, tuple[np.ndarray, np.ndarray]]] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse negative costs, and costs that are both zero."""
        if min(self.effort, self.change) < 0 or not self.effort + self.change > 0:
            raise InputError("invalid_value", "norm-optimal learning takes costs not below zero, and not both zero")

    @property
    def bound(self) -> float:
        """Largest singular value that H can have; its many values close together are costly to compute."""
        return self.change / (self.effort + self.change)

    def update(self, motion: Reference, correction: np.ndarray, error: np.ndarray) -> np.ndarray:
        """Return the next correction (N, m)."""
        Q, G = self._solved(motion)
        return unstack_channels(Q @ stack_channels(correction) + G @ stack_channels(error), correction.shape[1])

    def operators(self, motion: Reference) -> tuple[Operator, Operator]:
        """Return Q and Q L (m N, m N), channel after channel."""
        Q, G = self._solved(motion)
        return aslinearoperator(Q), aslinearoperator(G)

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return None: the law varies along the trial."""
        return None

    def _solved(self, motion: Reference) -> tuple[np.ndarray, np.ndarray]:
        if not self._kept or self._kept[0][0] is not motion:
            self._kept[:] = [(motion, self._solve(motion))]
        return self._kept[0][1]

    def _solve(self, motion: Reference) -> tuple[np.ndarray, np.ndarray]:
        T = self.side.operator(motion.n) @ np.eye(motion.n * self.side.reference(motion).shape[1])
        w = np.tile(motion.weights(), len(T) // motion.n)
        on = np.flatnonzero(w > 0)
        seen = (w**2)[:, None] * T[:, on]
        S = T[:, on].T @ seen + self.change * np.eye(len(on))
        factor = cho_factor(S + self.effort * np.eye(len(on)))
        Q, G = np.zeros_like(T), np.zeros_like(T)
        Q[np.ix_(on, on)] = cho_solve(factor, S)
        G[on] = cho_solve(factor, seen.T)
        return Q, G


_MIN_DIP = 1e-3  # no dip is deeper
_TURNS = 300  # notches placed or deepened at most; designs that converge need tens


def design_robust_filter(
    side: LearnedOutput, learning: TimeShift, cutoff_hz: float, *, growth: float = 0.9, tolerance: float = 0.03
) -> ZeroPhase:
    """Return the robust filter Q: a low-pass with notches.

    Args:
        side: The learned output with its model.
        learning: L.
        cutoff_hz: Highest frequency that is learnt [Hz].
        growth: Largest growth of an error in one iteration, according to the model; below 1.
        tolerance: Relative error of the model's frequencies that is allowed for.

    Raises:
        InputError: No filter of this form keeps the growth below `growth`.
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
    """Add a notch at a frequency, or change an existing one: deeper if the frequency is near its centre, else wider."""
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
