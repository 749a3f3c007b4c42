r"""Systems over a whole trial as matrices (thesis 7.8, 7.9): samples of one channel stay together, channel after channel.

A trial of 1400 samples and two channels makes matrices of 2800 rows. To find a largest singular value they need not be built:
an operator that filters signals, and one that does so backwards, is enough (`LinearOperator`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import block_diag
from scipy.sparse.linalg import LinearOperator

from tau_dyn.modes import Actuator, StateSpace

Operator = Any
"""A scipy `LinearOperator`: `A @ x`, `A.T`, sums and products; its type stubs know less than it does."""


def make_operator(
    shape: tuple[int, int], forth: Callable[[np.ndarray], np.ndarray], back: Callable[[np.ndarray], np.ndarray]
) -> Operator:
    """Return the operator of a linear map of vectors and of its transpose."""
    return cast(Any, LinearOperator)(shape, matvec=forth, rmatvec=back, dtype=np.float64)


def compute_pulse_response(model: StateSpace, n: int) -> np.ndarray:
    """Return the first `n` pulse response coefficients (n, p, m), the delay included."""
    late = model.markov(max(n - model.delay, 1))
    return np.concatenate([np.zeros((model.delay, *model.D.shape)), late])[:n]


def build_convolution(pulses: np.ndarray) -> Operator:
    """Return the same as an operator that convolves by the fast Fourier transform."""
    n, p, m = pulses.shape
    length = next_fast_len(2 * n, real=True)
    response = np.asarray(rfft(pulses, length, axis=0))

    def through(x: np.ndarray, matrices: np.ndarray) -> np.ndarray:
        return np.asarray(
            irfft(np.einsum("fij,fj->fi", matrices, np.asarray(rfft(x, length, axis=0))), length, axis=0)
        )[:n]

    def back(x: np.ndarray) -> np.ndarray:  # the transpose of a lower triangular Toeplitz matrix runs backwards
        return through(x[::-1], response.transpose(0, 2, 1))[::-1]

    return build_signal_operator(lambda x: through(x, response), back, n, p, m)


def build_signal_operator(
    forth: Callable[[np.ndarray], np.ndarray], back: Callable[[np.ndarray], np.ndarray], n: int, p: int, m: int
) -> Operator:
    """Return the operator of a map from signals (n, m) to signals (n, p) and of its transpose."""
    return make_operator(
        (p * n, m * n),
        lambda x: stack_channels(forth(unstack_channels(np.ravel(x), m))),
        lambda x: stack_channels(back(unstack_channels(np.ravel(x), p))),
    )


def stack_channels(x: np.ndarray) -> np.ndarray:
    """Return signals (N, m) as one vector (m N,)."""
    return x.T.ravel()


def unstack_channels(x: np.ndarray, m: int) -> np.ndarray:
    """Return a vector (m N,) as signals (N, m)."""
    return x.reshape(m, -1).T


def stack_controlled_actuators(
    actuators: Sequence[Actuator], dt: float, jacobian: np.ndarray | None = None
) -> StateSpace:
    """Return models of controlled actuators side by side, from references to positions, (6.11).

    The common delay acts on the inputs. The additional delay of a single axis, whole samples and a fraction, is represented by
    states that hold its last references.

    Args:
        actuators: One per joint.
        dt: Step [s].
        jacobian: Jacobian of the tool (p, na) at the pose. With it, the model from the tool's reference to the tool computed
            from the joints, both (p,), is returned. If p is below na, the other tool directions are not moved.
    """
    sampled = [a.discrete(dt) for a in actuators]
    shared = min(d for _, _, d in sampled)
    parts = [_build_axis(b, a, d - shared) for b, a, d in sampled]
    A, B, C = (np.asarray(cast(Any, block_diag)(*(part[k] for part in parts))) for k in range(3))
    if jacobian is not None:
        B, C = B @ np.linalg.pinv(jacobian), jacobian @ C
    p = len(C)
    return StateSpace(A, B, C, np.zeros((p, B.shape[1])), np.zeros((len(A), p)), dt, shared - 1)


def _build_axis(b: np.ndarray, pole: float, late: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C of `q^-1 (b0 + b1 q^-1) q^-late / (1 - pole q^-1)`: the position, then the last references."""
    size, fraction = float(b.sum()), abs(b[1]) > 1e-9 * abs(b[0])
    n = 1 + late + int(fraction)
    A, B, C = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n))
    A[0, 0], C[0, 0] = pole, size
    share = np.array([b[0], b[1]] if fraction else [size]) / size
    taps = np.concatenate([np.zeros(late), share])  # of the reference now, one sample ago, ..
    B[0, 0], A[0, 1:] = taps[0], taps[1:]
    if n > 1:
        B[1, 0] = 1.0
        A[2:, 1:-1] = np.eye(n - 2)
    return A, B, C
