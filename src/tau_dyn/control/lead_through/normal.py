r"""The surface's normal from the tool's force: (8.10) of Dressler 2012, and a calmer estimate.

(8.10) takes `f / |f|` of the last sample, and the nominal normal where that lies further off than the correction range.
Noise of standard deviation s tilts it by about `s / |f|`, Coulomb friction by `atan(mu)`; both let a share
`sin(tilt)` of the hand's velocity through the projection (8.8) into the direction that the force loop must keep quiet.
That is how a wider correction range makes an oscillation larger: the noise then drives a loop that is hardly damped.

The calmer estimate smooths f first, takes friction out (what lies along the velocity *command*; the thesis had only noisy
measured velocities for that, while the command is exact), and beyond the range stops at its edge rather than jump back.
"""

from __future__ import annotations

import numpy as np

_SLOW = 2e-3  # [m/s] below which the command gives friction no direction
_WEAK = 1e-9  # [N]


class NormalEstimator:
    """Estimates the unit normal, from the work towards the tool."""

    def __init__(self, nominal: np.ndarray, reach: float, smoothing: float, calm: bool, least_force: float) -> None:
        """Start at the nominal normal.

        Args:
            nominal: Nominal unit normal (3,).
            reach: Correction range [rad].
            smoothing: Share of a new sample in the smoothed force, up to 1.
            calm: Whether friction is taken out and the range's edge held; else (8.10) as printed.
            least_force: Force below which a calm estimate keeps the last normal [N].
        """
        self.nominal, self.normal = nominal, nominal
        self._reach, self._smoothing, self._calm, self._least = reach, smoothing, calm, least_force
        self._force, self._along = np.zeros(3), np.zeros(3)

    def update(self, force: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the normal (3,) from the work's force on the tool (3,) [N] and the last linear command (3,) [m/s]."""
        if not self._calm:
            self.normal = self._printed(force)
            return self.normal
        self._force = self._force + self._smoothing * (force - self._force)
        self._along = self._along + self._smoothing * (command - self._along)
        if np.linalg.norm(self._force) >= self._least:
            self.normal = self._within(self._without_friction())
        return self.normal

    def reset(self) -> None:
        """Forget the force; the next contact starts from the nominal normal."""
        self.normal = self.nominal
        self._force, self._along = np.zeros(3), np.zeros(3)

    def _printed(self, force: np.ndarray) -> np.ndarray:
        size = np.linalg.norm(force)
        if size < _WEAK:
            return self.nominal
        estimate = force / size
        return estimate if self.nominal @ estimate > np.cos(self._reach) else self.nominal

    def _without_friction(self) -> np.ndarray:
        speed = np.linalg.norm(self._along)
        along = self._along / speed if speed > _SLOW else np.zeros(3)
        return self._force - (along @ self._force) * along

    def _within(self, force: np.ndarray) -> np.ndarray:
        """Return the direction of a force, turned back to the edge of the range where it lies outside."""
        across = force - (self.nominal @ force) * self.nominal
        tilt = np.arctan2(np.linalg.norm(across), self.nominal @ force)
        if tilt < 1e-9:
            return self.nominal
        tilt_kept = min(tilt, self._reach)
        return np.cos(tilt_kept) * self.nominal + np.sin(tilt_kept) * across / np.linalg.norm(across)
