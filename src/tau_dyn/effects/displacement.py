r"""Effects that come between an encoder and its load: the load is not where the encoder says.

    deflection = encoder - load = displacement @ parameters,     q_load = q - deflection

Positive: the load stays behind, as a spring's under a positive force. What follows is written once here: in the force
channel the load's accelerations are `a - deflection''`, so the actuator adds `tau = -M(q) deflection''`; in the tool channel
the tool is at `T(q_load) = T(q) - J deflection`. Both are first order in a deflection of micrometres; changes of
weight and of `M` over it are left out. The second derivative is numerical, on a motion's even clock: without one (a single
simulator step, poses held still) there is no force.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from tau_dyn.effects.effect import Effect, Motion
from tau_dyn.log import differentiate

_FEWEST = 5  # samples that a derivative of fourth order takes


class DisplacementEffect(Effect):
    """An effect stated as what the encoder reads beyond the load's position, linear in its parameters."""

    needs = ("inertia",)

    @abstractmethod
    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad] along a motion."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p): the load's missing acceleration times the mass matrix."""
        acceleration = second_derivative(self.displacement(motion), motion.t)
        return (
            -np.einsum("nij,njp->nip", motion.signal("inertia"), acceleration) if acceleration.any() else acceleration
        )

    def tool_columns(self, motion: Motion, tool_jacobian: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per unit parameter (N, 3, p) [m], in base axes.

        Args:
            motion: Motion of the encoders.
            tool_jacobian: Tool velocity per actuated speed (N, 3, na).
        """
        made = self.displacement(motion)
        out = np.zeros((len(made), 3, made.shape[2]))
        for k in self._indices(motion):  # the others are zero
            out -= tool_jacobian[:, :, k, None] * made[:, None, k]
        return out


def second_derivative(x: np.ndarray, t: np.ndarray | None) -> np.ndarray:
    """Return the second time derivative of (N, ...) on an even clock (N,) [s], as positions are differentiated.

    Zeros without a clock or of too few samples.
    """
    if t is None or len(t) < _FEWEST or not np.any(x):
        return np.zeros(x.shape)
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    return differentiate(differentiate(x, dt, accuracy=4), dt, accuracy=4)
