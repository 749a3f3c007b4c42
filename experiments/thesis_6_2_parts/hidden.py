r"""Two effects of the simulated robot that section 6.2's model does not have.

Stribeck        tau = s sign(v) exp(-(v / v_s)^2): friction is larger by s near standstill.
Passive joints  each ball joint resists its rod's turning with a constant moment. With the rod `d_i` of length `L_i`, its
                turning speed is `|u_i| / L_i`, `u_i = T' - e_i v_i` (a rigid rod's ends differ in speed only across it), so by
                virtual work `tau = sum_i n_i / L_i (du_i / dv)' u_i / |u_i|`, `n_i` ball joints of arm i. The direction
                turns over `SMOOTH`. Closed form of the simplified Gantry-Tau: `D T' = diag(b) v`, in `mechanism/gantry_tau.py`.
"""

import numpy as np

from tau_dyn.effects import Effect, JointwiseEffect, Motion
from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.parameters import Parameter, Parameters

STRIBECK_SPEED = 0.02  # m/s
JOINTS_OF_ARM = np.array([2.0, 4.0, 6.0])  # two ball joints a rod, and 1, 2 and 3 rods an arm
SMOOTH = 1e-3  # m/s


class Stribeck(JointwiseEffect):
    """Coulomb friction that is larger near standstill."""

    name = "stribeck"
    equation = "tau = stribeck sign(v) exp(-(v / 0.02 m/s)^2)"
    quantities = (("stribeck", "F"),)

    def per_joint(self, v: np.ndarray, sign: np.ndarray) -> list[np.ndarray]:
        """Return the direction, fading with speed."""
        return [sign * np.exp(-((v / STRIBECK_SPEED) ** 2))]


class PassiveJointFriction(Effect):
    """A constant moment in every ball joint against its rod's turning."""

    name = "passive_joint_friction"
    equation = "moment = -passive_moment, in each ball joint, against its rod's turning"

    def __init__(self, mechanism: GantryTauMechanism) -> None:
        """Take guideways and rods from the mechanism."""
        super().__init__(mechanism.robot.actuated, mechanism.robot.force_units)
        self._mechanism = mechanism

    @property
    def parameters(self) -> Parameters:
        """The moment [N m], zero."""
        return Parameters([Parameter("rods.passive_moment", 0.0, "N m", 0.0)])

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit moment (N, 3, 1)."""
        robot = self._mechanism
        rods = robot.tool_position(motion.q)[:, None] - (robot.origin + motion.q[:, :, None] * robot.direction)
        J = np.linalg.solve(rods, np.einsum("nij,ij->ni", rods, robot.direction)[:, :, None] * np.eye(3))
        across = J[:, None] - np.einsum("ij,ik->ijk", robot.direction, np.eye(3))  # d u_i / d v: (N, arm, axis, cart)
        u = np.einsum("nijk,nk->nij", across, motion.v)
        force = u / np.sqrt(np.sum(u**2, axis=2, keepdims=True) + SMOOTH**2) * (JOINTS_OF_ARM / robot.length)[:, None]
        return np.einsum("nijk,nij->nk", across, force)[:, :, None]
