r"""What learning has done, trial by trial."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.control.iterative.convergence_analysis import Convergence
from tau_dyn.control.iterative.reference import Reference


@dataclass(frozen=True, eq=False)
class LearningHistory:
    """Errors and corrections of all trials; the first has no correction.

    Attributes:
        motion: What was repeated.
        convergence: What was known beforehand.
        corrections: Of each trial (k + 1, N, m).
        errors: What was learnt from, r less its estimate (k + 1, N, m).
        motor_errors: Actuator references less measured positions (k + 1, N, na), thesis (7.23).
        tool_errors: The tool's reference less its measured position (k + 1, N, 3) [m], thesis (7.24).
    """

    motion: Reference
    convergence: Convergence
    corrections: np.ndarray
    errors: np.ndarray
    motor_errors: np.ndarray
    tool_errors: np.ndarray

    def relative(self, which: str = "errors") -> np.ndarray:
        """Return (7.25), each trial's error in percent of the first one's (k + 1, m), where learning acts fully.

        Args:
            which: 'errors', 'motor_errors' or 'tool_errors'.
        """
        size = np.linalg.norm(getattr(self, which)[:, self.motion.full], axis=1)
        return 100 * size / np.where(size[0] > 0, size[0], 1.0)

    def rms(self, which: str = "errors") -> np.ndarray:
        """Return root mean squares (k + 1, m) where learning acts fully."""
        return np.sqrt(np.mean(getattr(self, which)[:, self.motion.full] ** 2, axis=1))
