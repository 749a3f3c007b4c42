r"""Kinematics and rod forces of the simplified Gantry-Tau, for effects that live on its rods; written anew.

With `d_k = T - A_k`, `D` their rows, `b_k = d_k . e_k`: `D T' = b v`, `D T'' = b a - |u|^2`, `u_k = T' - e_k v_k`. Rods are
struts: half of each one's mass rides on the tool, and `sum_k f_k d_k / L_k = m (T'' - g)` gives their forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hidden_effects_parts.recording import Recording
from tau_dyn.mechanism import GantryTauMechanism


class Rods(NamedTuple):
    """Rods along a run.

    `d` (N, 3, xyz) from cart to tool [m], `u` (N, 3, xyz) speed of one end against the other [m/s], `turn` (N, 3, xyz, cart)
    the same per unit cart speed, `acceleration` (N, xyz) of the tool [m/s^2], `length` (3,) [m].
    """

    d: np.ndarray
    u: np.ndarray
    turn: np.ndarray
    acceleration: np.ndarray
    length: np.ndarray


def rods_of(run: Recording) -> Rods:
    """Return how the rods move."""
    robot = run.rig.mechanism
    assert isinstance(robot, GantryTauMechanism)
    e = robot.direction
    d = robot.tool_position(run.q)[:, None] - (robot.origin + run.q[:, :, None] * e)
    inverse = np.linalg.inv(d)
    b = np.sum(d * e, axis=2)
    J = inverse * b[:, None, :]
    u = np.einsum("nij,nj->ni", J, run.v)[:, None] - run.v[:, :, None] * e
    acceleration = np.einsum("nij,nj->ni", inverse, b * run.a - np.sum(u**2, axis=2))
    turn = J[:, None] - np.einsum("ij,ik->ijk", e, np.eye(3))
    return Rods(d, u, turn, acceleration, robot.length)


def load_across(run: Recording) -> np.ndarray:
    """Return the force that each rod puts across its guideway (N, 3) [N]."""
    rods, robot = rods_of(run), run.rig.robot
    mass = {p.name: p.value for p in robot.parameters}
    m = mass[f"{robot.plate}.mass"] + sum(mass[f"{arm.rod_link}.mass"] for arm in robot.arms) / 2
    gravity = np.array(robot.model.gravity.linear)
    along = rods.d / rods.length[:, None]
    force = np.linalg.solve(np.swapaxes(along, 1, 2), m * (rods.acceleration - gravity)[:, :, None])[:, :, 0]
    e = run.rig.mechanism.direction
    across = along - np.sum(along * e, axis=2, keepdims=True) * e
    return np.abs(force) * np.linalg.norm(across, axis=2)
