r"""When pulse tests are answered first: no delay can be longer, whatever a model says.

Before a pulse the structure at most rings on, y_t = C A^t x_0. That is fitted to the samples of rest and followed into
the pulse; the first sample at which an output leaves it by more than noise and rounding is the answer. A model that
lacks modes would trade them for a delay; this bound has none to lack.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.modes.era import EraFactors
from tau_dyn.modes.record import Record

ORDER = 12
"""States that ring on, at most."""
MIN_ONSET_SNR = 8.0
"""Times the noise before the pulse that an answer differs from ringing on."""
OF_PEAK = 2e-4
"""Part of the output's peak that it must reach at least."""
STARTED = 0.005
"""Part of the peak of the force at which the pulse has begun."""


def find_response_onset(records: Sequence[Record], decays: EraFactors, most: int) -> int:
    """Return how many samples after a pulse's first one an output moves; `most` where none does earlier.

    Args:
        records: Pulses with some samples of rest before them.
        decays: Their decays, for how the structure rings on.
        most: Samples to look at.
    """
    found = [_answer(r, decays, most) for r in records]
    return min([k for k in found if k is not None], default=most)


def _answer(record: Record, decays: EraFactors, most: int) -> int | None:
    size = np.abs(record.u / np.maximum(np.abs(record.u).max(axis=0), 1e-300)).max(axis=1)
    hit = int(np.argmax(size))
    noise = np.quantile(size[: max(hit - 5, 1)], 0.9)
    start = int(np.flatnonzero(size > max(STARTED, 4 * noise))[0])
    order = min(ORDER, start * record.y.shape[1] // 3)
    if start < 10 or order < 1:
        return None
    A, C = decays.dynamics(order)
    y = record.y[: start + most] / decays.scales.y
    gamma = np.array([C @ np.linalg.matrix_power(A, t) for t in range(len(y))])
    x0 = np.linalg.lstsq(gamma[:start].reshape(-1, order), y[:start].ravel(), rcond=1e-8)[0]
    off = np.abs(y - gamma @ x0)
    limit = np.maximum(
        MIN_ONSET_SNR * np.sqrt(np.mean(off[:start] ** 2, axis=0)),
        OF_PEAK * np.abs(record.y).max(axis=0) / decays.scales.y,
    )
    moved = np.flatnonzero((off[start:] > limit).any(axis=1))
    return int(moved[0]) if len(moved) else None
