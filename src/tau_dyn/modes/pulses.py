r"""What a unit pulse does, in the data and in the model, so that both can be laid over each other.

A driven record is divided by its inputs in the frequency domain, with a floor where they hold little power:

    h = F^-1 [ Y U^H (U U^H + floor)^-1 ]

The model's simulation of the same inputs goes through the same division, so that the floor, the inputs' band and the
record's ends do the same to both and only the difference between data and model is left to see. Pulse tests need none
of that: the record is the answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.fft import irfft, rfft
from scipy.fft import next_fast_len

from tau_dyn.modes.fit_quality import ImpulseResponses
from tau_dyn.modes.modal import Mode
from tau_dyn.modes.record import Record
from tau_dyn.modes.simulate import simulate
from tau_dyn.modes.state_space import StateSpace

FLOOR = 1e-2
"""Floor as a share of the inputs' mean power."""
TIME_CONSTANTS = 2.5
"""Of the slowest decaying mode, as many as are shown."""
PERIODS = 12
"""Of the lowest mode, as many as are shown at most."""
MAX_SAMPLES = 200_000  # samples used; a response of some hundred lags is known by then


def compute_impulse_responses(
    model: StateSpace, records: Sequence[Record], modes: Sequence[Mode], *, kind: str, held_out: bool
) -> ImpulseResponses | None:
    """Return the response to a unit pulse, measured and of the model.

    Args:
        model: The model.
        records: What to compare on.
        modes: Its modes; they tell how long a response lasts.
        kind: `driven` or `impulse`.
        held_out: Whether the model was not fitted to these records.
    """
    if not records:
        return None
    if kind == "impulse":
        return _of_pulses(model, records, held_out)
    length = _length(model, modes, min(r.n_samples for r in records))
    few = [r.window(slice(0, MAX_SAMPLES)) for r in records]
    pairs = [(r.u, np.hstack([r.y, simulate(model, r)])) for r in few]
    h = _divided(pairs, length)
    p = model.D.shape[0]
    how = "outputs divided by inputs in the frequency domain, alike for data and model"
    return ImpulseResponses(np.arange(length) * model.dt, h[:, :p], h[:, p:], how, held_out)


def _divided(pairs: Sequence[tuple[np.ndarray, np.ndarray]], length: int) -> np.ndarray:
    """Return responses (length, outputs, m) of all records together."""
    size = int(next_fast_len(max(len(u) for u, _ in pairs) + length, real=True) or 0)
    m, c = pairs[0][0].shape[1], pairs[0][1].shape[1]
    suu, syu = np.zeros((size // 2 + 1, m, m), complex), np.zeros((size // 2 + 1, c, m), complex)
    for u, y in pairs:
        a, b = rfft(u, size, axis=0), rfft(y, size, axis=0)
        suu += a[:, :, None] * a[:, None, :].conj()
        syu += b[:, :, None] * a[:, None, :].conj()
    power = np.real(np.einsum("fii->i", suu)) / len(suu)
    floor = FLOOR * np.diag(power)
    h = np.swapaxes(np.linalg.solve(np.swapaxes(suu + floor, 1, 2), np.swapaxes(syu, 1, 2)), 1, 2)
    return irfft(h, size, axis=0)[:length]


def _of_pulses(model: StateSpace, records: Sequence[Record], held_out: bool) -> ImpulseResponses:
    """Return each input's strongest pulse, per unit of its area over one sample."""
    m = model.D.shape[1]
    best = [max(records, key=lambda r: float(np.abs(r.u[:, j]).max())) for j in range(m)]
    length = min(r.n_samples for r in best)
    area = np.array([float(r.u[:, j].sum()) or 1.0 for j, r in enumerate(best)])
    measured = np.stack([r.y[:length] / a for r, a in zip(best, area, strict=True)], axis=2)
    followed = np.stack([simulate(model, r)[:length] / a for r, a in zip(best, area, strict=True)], axis=2)
    return ImpulseResponses(
        np.arange(length) * model.dt, measured, followed, "as recorded, per unit of the pulse's sum", held_out
    )


def _length(model: StateSpace, modes: Sequence[Mode], n: int) -> int:
    """Return how many samples to show: until the slowest mode has decayed, and some periods of the lowest at most."""
    if not modes:
        return min(n // 2, 200)
    slowest = min(2 * np.pi * m.frequency_hz * max(m.damping_ratio, 1e-4) for m in modes)
    period = 1 / min(m.frequency_hz for m in modes)
    return int(np.clip(min(TIME_CONSTANTS / slowest, PERIODS * period) / model.dt + model.delay, 20, n // 2))
