r"""How stiff the contact proves to be, and the gain that it bears.

Whoever states a stiffness may be wrong: the thesis' gain, right for cardboard, met a metal plate. Each touch tells: between
samples the force changes by `k` times the way along the normal, which the joints know. Regression over a few samples,

    k = sum dx df / sum dx^2,   taken where sum df^2 is above noise and dx explains at least half of it,

finds it at the first touch. Since only the product of gain and stiffness counts (`stability.py`), the gain is lowered to a
share of the limit where the contact is stiffer than stated, and comes back slowly where it is not.
"""

from __future__ import annotations

import numpy as np

_SAMPLES = 6  # memory of the regression
_COHERENT = 0.5  # least squared coherence of force and motion for a stiffness to be read
_BACK = 5.0  # [s] in which the estimate falls back


class StiffnessWatch:
    """Follows the stiffness along the normal."""

    def __init__(self, least_force: float, sample_time: float) -> None:
        """Know nothing yet.

        Args:
            least_force: Changes of force (root of the sum of squares) below which noise is all there is [N].
            sample_time: [s].
        """
        self._least, self._fade = least_force, float(np.exp(-sample_time / _BACK))
        self._sums, self._last = np.zeros(3), None
        self.stiffness = 0.0

    def reset(self) -> None:
        """Leave the contact; the stiffness stays known."""
        self._sums, self._last = np.zeros(3), None

    def update(self, force: float, place: float) -> float:
        """Return the stiffness [N/m], 0 while unknown, from the force along the normal [N] and the way into the work [m]."""
        self.stiffness *= self._fade
        if self._last is not None:
            df, dx = force - self._last[0], place - self._last[1]
            self._sums = (1 - 1 / _SAMPLES) * self._sums + [df * df, df * dx, dx * dx]
            ff, fx, xx = map(float, self._sums)
            if ff > self._least**2 and fx > 0 and fx * fx > _COHERENT * ff * xx:
                self.stiffness = max(self.stiffness, fx / xx)
        self._last = (force, place)
        return self.stiffness
