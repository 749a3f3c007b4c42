r"""The memory of what a simulation leaves: an autoregressive model of all outputs together, for predictions a few steps ahead.

    v_t = sum_{k=1}^{L} F_k v_{t-k} + e_t

`v` is measured minus simulated. With it, a prediction k samples ahead is the simulation plus what `v` foretells of
itself, and e is what whiteness is asked of. L is BIC's choice; 0 says that the error of the simulation has no memory.
The long-memory counterpart is the innovation form in `refine.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAX_NOISE_ORDER = 30  # of the noise's autoregression; BIC chooses below it
MAX_SAMPLES = 50_000  # samples used; coefficients of thirty lags are known to a per cent by then


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """An autoregressive model of errors.

    Attributes:
        F: (L, p, p), one step back first.
    """

    F: np.ndarray

    @property
    def lags(self) -> int:
        """Number of lags L."""
        return len(self.F)

    def ahead(self, v: np.ndarray, k: int) -> np.ndarray:
        """Return the errors (N, p) of predictions k samples ahead; the first ones know no past."""
        if not self.lags:
            return v
        known = np.vstack([np.zeros((self.lags, v.shape[1])), v])
        window = [known[self.lags - j : len(known) - j] for j in range(1, self.lags + 1)]  # v_{t-1}, v_{t-2}, ..
        for _ in range(k):
            guess = np.sum([x @ f.T for x, f in zip(window, self.F, strict=True)], axis=0)
            window = [guess, *window[:-1]]
        late = np.vstack([np.zeros((k - 1, v.shape[1])), guess[: len(v) - k + 1]])  # made at t - k for t
        return v - late


def fit_noise_model(errors: Sequence[np.ndarray]) -> NoiseModel:
    """Fit the model to a simulation's errors, one (N, p) a record; its length is BIC's choice.

    From tapered autocovariances (Yule-Walker), which make it stable whatever the errors are.
    """
    few, left = [], MAX_SAMPLES
    for v in errors:
        if left > 0:
            few.append(v[:left])
            left -= len(v)
    n, p = sum(len(v) for v in few), few[0].shape[1]
    most = int(max(0, min(MAX_NOISE_ORDER, min(len(v) for v in few) // 4, n // (10 * p))))
    size = np.sqrt(np.sum([np.sum(v**2, axis=0) for v in few], axis=0) / n)
    size[size == 0] = 1.0
    R = np.array([np.sum([v[k:].T @ v[: len(v) - k] for v in few], axis=0) for k in range(most + 1)]) / n
    R = R / size[:, None] / size  # E v_t v_{t-k}'
    R[0] += 1e-9 * np.eye(p)
    best, chosen = np.inf, np.zeros((0, p, p))
    for lags in range(most + 1):
        past = (
            np.block([[R[j - i] if j >= i else R[i - j].T for j in range(lags)] for i in range(lags)]) if lags else None
        )
        ahead = np.hstack(R[1 : lags + 1]) if lags else np.zeros((p, 0))
        F = np.zeros((p, 0)) if past is None else np.linalg.solve(past.T, ahead.T).T
        score = n * np.linalg.slogdet(R[0] - F @ ahead.T)[1] + lags * p * p * np.log(n)
        if score < best:
            best, chosen = score, F.reshape(p, lags, p).transpose(1, 0, 2)
    return NoiseModel(chosen * size[:, None] / size)
