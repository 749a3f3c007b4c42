"""From past samples to states to matrices, in compressed data.

Once the state is a known linear function of the past, x_t = T (z_{t-s}, ..., z_{t-1}), the matrices and the
innovations' covariance follow from two regressions: y on (x, u), then x one sample later on (x, u, e). Reference:
Chiuso 2007; van der Veen et al. 2013, (21)-(24).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.modes.hankel import HankelFactor, solve_least_squares


def estimate_matrices_from_states(
    T: np.ndarray, factor: HankelFactor, past: int, direct: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C, D, K and the innovations' covariance.

    Args:
        T: (n, past w), states from the past, oldest first.
        factor: Compressed data of at least `past` + 1 block rows.
        past: Block rows of past.
        direct: Whether D may differ from zero.
    """
    n, m = len(T), factor.n_inputs
    x, later = T @ factor.past(0, past), T @ factor.past(1, past + 1)
    u, y = factor.inputs(past, past + 1), factor.outputs(past, past + 1)
    seen = np.vstack([x, u]) if direct else x
    CD = solve_least_squares(y, seen)
    e = y - CD @ seen
    ABK = solve_least_squares(later, np.vstack([x, u, e]))
    D = CD[:, n:] if direct else np.zeros((len(y), m))
    return ABK[:, :n], ABK[:, n : n + m], CD[:, :n], D, ABK[:, n + m :], e @ e.T


def estimate_innovation_gain(
    A: np.ndarray, C: np.ndarray, T: np.ndarray, factor: HankelFactor, past: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return K and the innovations' covariance for given A and C, states T of the past.

    K is drawn back towards zero until A - K C is stable.
    """
    x, later = T @ factor.past(0, past), T @ factor.past(1, past + 1)
    u, y = factor.inputs(past, past + 1), factor.outputs(past, past + 1)
    rest = y - C @ x
    e = rest - solve_least_squares(rest, u) @ u if len(u) else rest
    K = solve_least_squares(later - A @ x, np.vstack([u, e]))[:, len(u) :]
    for _ in range(40):
        if np.abs(np.linalg.eigvals(A - K @ C)).max(initial=0) < 1:
            return K, e @ e.T
        K = K * 0.8
    return np.zeros_like(K), e @ e.T
