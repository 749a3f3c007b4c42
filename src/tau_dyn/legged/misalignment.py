r"""A logged orientation of a floating base that is turned against the base: the forces that it seems to need.

In: positions, velocities, accelerations of all coordinates, the orientation as it was logged. The true one is

    R = R_log exp(phi),   phi constant in axes of the base: an IMU that is mounted at an angle.

In world axes turned by `Q = R phi`, the base has the logged orientation, and gravity, the base's acceleration, angular velocity
and angular acceleration are turned back by `Q`. The legs, the contacts and the forces of the ground are the same vectors there.
So to first order the forces are those of inverse dynamics after

    a - g, w, dw/dt   ->   x + x cross (R_log phi).

The point at which a ball touches the ground moves by its radius times the angle, which is left out. A turn about the vertical
changes nothing, so `phi` has two components, along the base's x and y axes. Reference for the dynamics: Featherstone 2008, ch. 5.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism import Mechanism

_STEP_RAD = 1e-4  # of the central difference; forces are quadratic in angular velocity, so its error is a rounding


def compute_imu_turn(mechanism: Mechanism, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the change of forces (N, n, 2) [N/rad or N m/rad] per turn of the base against its logged axes, about x and y.

    Args:
        mechanism: The dynamics of a robot with a floating base.
        q: Logged positions (N, n) [m or rad], the base's six coordinates first.
        v: Velocities (N, n).
        a: Accelerations (N, n).
    """
    rotation = Rotation.from_euler("ZYX", q[:, 3:6]).as_matrix()
    found = []
    for axis in (rotation[:, :, 0], rotation[:, :, 1]):
        ends = [mechanism.inverse_dynamics(q, *_turn(mechanism, q, v, a, h * axis)) for h in (_STEP_RAD, -_STEP_RAD)]
        found.append((ends[0] - ends[1]) / (2 * _STEP_RAD))
    return np.stack(found, axis=2)


def _turn(
    mechanism: Mechanism, q: np.ndarray, v: np.ndarray, a: np.ndarray, turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities and accelerations (N, n) whose vectors of the base are turned back by small angles (N, 3) [rad]."""
    gravity = np.asarray(mechanism.robot.model.gravity.linear, float)
    axes = _find_angle_axes(q)
    rates = v[:, 3:6]
    spin, change = _apply(axes, rates), _apply(axes, a[:, 3:6]) + _compute_bias(axes, rates)
    v, a = v.copy(), a.copy()
    v[:, 3:6] = rates = _solve(axes, spin + np.cross(spin, turn))
    a[:, 3:6] = _solve(axes, change + np.cross(change, turn) - _compute_bias(axes, rates))
    a[:, :3] += np.cross(a[:, :3] - gravity, turn)
    return v, a


def _find_angle_axes(q: np.ndarray) -> np.ndarray:
    """Return the axes of yaw, pitch and roll in the world, as columns (N, 3, 3)."""
    yaw = Rotation.from_euler("Z", q[:, 3:4]).as_matrix()
    roll = Rotation.from_euler("ZYX", q[:, 3:6]).as_matrix()
    return np.stack([np.broadcast_to([0.0, 0.0, 1.0], (len(q), 3)), yaw[:, :, 1], roll[:, :, 0]], axis=2)


def _compute_bias(axes: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the angular acceleration (N, 3) at constant rates (N, 3) of the three angles."""
    yaw, pitch, roll = (axes[:, :, k] * rates[:, k : k + 1] for k in range(3))
    return np.cross(yaw, pitch) + np.cross(yaw + pitch, roll)


def _apply(axes: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (axes @ x[:, :, None])[:, :, 0]


def _solve(axes: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.linalg.solve(axes, x[:, :, None])[:, :, 0]
