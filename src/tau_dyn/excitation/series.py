r"""A periodic Fourier series a joint that starts and ends each period at home, at rest and without acceleration.

    q_j(t) = home_j + sum_h a_jh sin(h w t) + b_jh (cos(h w t) - 1),   w = 2 pi / period,   h = 1 .. harmonics

with `sum_h h a_jh = 0` (no speed at t = 0) and `sum_h h^2 b_jh = 0` (no acceleration): the motion can start from rest, stop after
any number of whole periods, and contains nothing above its highest harmonic. What the two conditions leave free is spanned by
`free` directions; they are what is optimised. Reference: Swevers, Ganseman, Tukel, De Schutter & Van Brussel 1997.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import null_space

from tau_dyn.simulate import MotionProfile


@dataclass(frozen=True, eq=False)
class Series:
    """The family of motions that is searched.

    Attributes:
        home: Where every period starts (na,) [m or rad].
        reach: How far each joint may go (na,) [m or rad]; the size of a coefficient of one.
        period: [s].
        harmonics: Number of harmonics, at least 2.
        periods: How often the period is repeated.
    """

    home: np.ndarray
    reach: np.ndarray
    period: float
    harmonics: int
    periods: int

    @cached_property
    def free(self) -> np.ndarray:
        """Directions that start at rest (2 harmonics, 2 harmonics - 2); sines first, then cosines."""
        h = np.arange(1, self.harmonics + 1)
        size = 1 / h  # of one unit, so that all directions move about as fast
        rest = np.zeros((2, 2 * self.harmonics))
        rest[0, : self.harmonics], rest[1, self.harmonics :] = h * size, h**2 * size
        return np.tile(size, 2)[:, None] * null_space(rest)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the coefficients: joints, free directions."""
        return len(self.home), 2 * self.harmonics - 2

    @property
    def duration(self) -> float:
        """Length of all periods [s]."""
        return self.period * self.periods

    def waves(self, t: np.ndarray) -> MotionProfile:
        """Return displacement, speed and acceleration of each free direction (n, k) at times (n,) [s], per unit of reach."""
        w = 2 * np.pi / self.period * np.arange(1, self.harmonics + 1)
        sine, cosine = np.sin(t[:, None] * w), np.cos(t[:, None] * w)
        made = (
            np.hstack([sine, cosine - 1]),
            np.hstack([w * cosine, -w * sine]),
            np.hstack([-(w**2) * sine, -(w**2) * cosine]),
        )
        return MotionProfile(*(x @ self.free for x in made))

    def path(self, waves: MotionProfile, x: np.ndarray) -> MotionProfile:
        """Return the motion (n, na) of coefficients (na, k)."""
        scaled = (self.reach[:, None] * x).T
        return MotionProfile(self.home + waves.q @ scaled, waves.v @ scaled, waves.a @ scaled)

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Return coefficients (na, k) of a motion that uses all harmonics."""
        return 0.3 * rng.standard_normal(self.shape)
