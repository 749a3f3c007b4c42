"""An operator's hand on the handle: a spring and a damper towards where the operator wants the tool, with a wander.

The hand sees roughly where the tool is, not what it presses: its wish strays by some millimetres below 1 Hz and trembles a
little near 9 Hz (postural tremor, 8-12 Hz: Elble & Koller 1990). It never pushes harder than its strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError

_TREMOR_HZ = 9.0  # Hz, physiological tremor of the hand (8 to 12 Hz)
_WAVES = 12  # sines that make a hand's wander


@dataclass(frozen=True, eq=False)
class Hand:
    """What the operator does.

    Attributes:
        times: Times of the way points (n,) [s].
        points: Where the tool is wanted, from its start (n, 3) [m]; between them a smooth step of zero end speed.
        stiffness: Of arm and hand [N/m].
        damping: [N s/m].
        wander: Standard deviation of the stray, per axis [m].
        tremor: Amplitude of the tremor, per axis [m].
        strength: Largest force [N].
    """

    times: Sequence[float]
    points: np.ndarray
    stiffness: float = 300.0
    damping: float = 10.0
    wander: float = 0.0
    tremor: float = 0.0
    strength: float = 15.0

    def __post_init__(self) -> None:
        """Refuse way points out of order."""
        times, points = np.asarray(self.times, float), np.asarray(self.points, float)
        if points.shape != (len(times), 3) or len(times) < 1 or np.any(np.diff(times) <= 0):
            raise InputError("wrong_shape", "a hand's way points are rising times (n,) and points (n, 3)")
        object.__setattr__(self, "points", points)

    def path(self, t: np.ndarray, seed: int) -> np.ndarray:
        """Return where the hand wants the tool at times (N,), from its start (N, 3) [m], stray included."""
        rng = np.random.default_rng(seed)
        out = np.array([np.interp(t, self.times, column) for column in self.points.T]).T
        for k in range(len(self.times) - 1):
            inside = (t >= self.times[k]) & (t <= self.times[k + 1])
            s = (t[inside, None] - self.times[k]) / (self.times[k + 1] - self.times[k])
            out[inside] = self.points[k] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (self.points[k + 1] - self.points[k])
        hz, phase = rng.uniform(0.1, 0.8, (_WAVES, 3)), rng.uniform(0, 2 * np.pi, (_WAVES + 1, 3))
        stray = np.sin(2 * np.pi * t[:, None, None] * hz + phase[:_WAVES]).sum(axis=1) * np.sqrt(2 / _WAVES)
        return out + self.wander * stray + self.tremor * np.sin(2 * np.pi * _TREMOR_HZ * t[:, None] + phase[-1])

    def force(self, wanted: np.ndarray, moving: np.ndarray, at: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the hand's force (3,) [N] from the wish and its rate, and the tool's place and speed, each (3,)."""
        force = self.stiffness * (wanted - at) + self.damping * (moving - speed)
        size = float(np.linalg.norm(force))
        return force * (self.strength / size) if size > self.strength else force
