"""The thesis' own route to M, D and K, for comparison, and what its printed matrices amount to.

A model of 2p states and p outputs is brought to the states (x, x'), where its lower rows are `-M^-1 K` and `-M^-1 D` and its
input rows `M^-1 B` (after Cescon et al. 2009). Nothing makes M, D, K symmetric or definite. Of the printed matrices: K, called
positive definite there, has the eigenvalues -1588 +- 2500i. The 13.8 and 103.3 Hz of (6.15) are `sqrt|lambda|` with D left out,
and lambda is positive: those roots grow or decay and do not oscillate. With D, two of the four poles are unstable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvals

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.modes import StateSpace
from tau_dyn.modes.mechanical import SecondOrder
from tau_dyn.modes.mechanical.structure import convert_to_continuous, count_derivatives

PRINTED = SecondOrder(
    np.array([[0.0278, -0.0331], [-0.1759, 0.3086]]),
    np.array([[3.7432, -4.7826], [-9.7408, -3.4976]]),
    1e3 * np.array([[-3.7326, -1.5671], [6.9209, 0.5560]]),
)
"""M, D and K as printed in the thesis, 6.3, from the vision measurements with cart 3 moving; units are not stated."""


@dataclass(frozen=True, eq=False)
class Character:
    """What matrices M, D, K amount to.

    Attributes:
        stiffness_eigenvalues: Of K (n,).
        undamped_roots: lambda of `det(M lambda + K) = 0` (n,) [1/s^2]; a structure has them real and negative.
        undamped_hz: `sqrt|lambda| / 2 pi` (n,), whether or not that is an oscillation.
        poles: Of `M s^2 + D s + K` (2n,) [rad/s].
        asymmetry: Part of M, D and K (3,) that is skew, as a ratio of norms.
        lowest: Least eigenvalue of the symmetric parts of M, D and K (3,), by their norms.
    """

    stiffness_eigenvalues: np.ndarray
    undamped_roots: np.ndarray
    undamped_hz: np.ndarray
    poles: np.ndarray
    asymmetry: np.ndarray
    lowest: np.ndarray

    @property
    def n_unstable(self) -> int:
        """Number of poles in the right half plane."""
        return int(np.sum(self.poles.real > 0))

    @property
    def physical(self) -> bool:
        """Whether M and K are symmetric and positive definite and D symmetric and not negative."""
        return bool(np.all(self.asymmetry < 1e-9) and np.all(self.lowest[[0, 2]] > 0) and self.lowest[1] >= 0)


def judge_character(structure: SecondOrder) -> Character:
    """Return what matrices M, D, K amount to."""
    roots = np.asarray(eigvals(-structure.K, structure.M))
    roots = roots[np.argsort(np.abs(roots))]
    parts = (structure.M, structure.D, structure.K)
    skew = [np.linalg.norm(part - part.T) / 2 / np.linalg.norm(part) for part in parts]
    lowest = [np.linalg.eigvalsh((part + part.T) / 2)[0] / np.linalg.norm(part) for part in parts]
    hz = np.sqrt(np.abs(roots)) / (2 * np.pi)
    return Character(
        np.linalg.eigvals(structure.K), roots, hz, structure.poles(), np.array(skew), np.array(lowest)
    )  # fmt: skip


def solve_unconstrained(model: StateSpace, output: str = "displacement") -> SecondOrder:
    """Return M, D, K of a model by change of states alone, one input at each output's place.

    Args:
        model: Of order 2p, with p outputs and p inputs.
        output: What the outputs measure.

    Raises:
        CannotAnswer: The model is not square, not of order 2p, or its outputs and their rates do not span its states.
    """
    p, m = model.D.shape
    if m != p:
        raise CannotAnswer(
            "not_identifiable",
            f"{m} inputs and {p} outputs leave M open: only M^-1 B can be read off",
            "give as many inputs as outputs, in the same order",
        )
    if model.order != 2 * p:
        raise CannotAnswer(
            "not_identifiable",
            f"the states (x, x') of {p} outputs are {2 * p}, and the model has {model.order}",
            "choose that order",
        )
    found = convert_to_continuous(model)
    left = found.left / found.poles ** count_derivatives(output)
    states = np.vstack([left, left * found.poles])
    if np.linalg.cond(states) > 1e12 * np.abs(found.poles).max():
        raise CannotAnswer(
            "not_identifiable", "the outputs and their rates do not span the model's states", "sense other places"
        )
    lower = ((left * found.poles**2) @ np.linalg.inv(states)).real
    M = np.linalg.inv(((left * found.poles) @ found.right).real)
    return SecondOrder(M, -M @ lower[:, p:], -M @ lower[:, :p])
