r"""Cartesian stiffness of a tool from the springs of rods and actuators.

With rods of stiffness `k_r` and actuators of stiffness `k_a` (the pose unloaded, so no geometric stiffness), a rod is
stretched by `J_x dX - J_q dq` and an actuator gives way until it balances its rods' pull, `k_a dq = J_q' t`, so

    K = J_x' (diag(1 / k_r) + J_q diag(1 / k_a) J_q')^-1 J_x.

Rigid rods and one actuator a rod leave `J^-T diag(k_a) J^-1`, as for a serial arm; rigid actuators leave `J_x' diag(k_r)
J_x`. Reference: Gosselin 1990; Merlet 2006, ch. 9.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.dexterity import Rates, compute_tool_jacobian


class Springs(NamedTuple):
    """What gives way.

    Attributes:
        rods: Stiffness of each rod with its joints (n,) [N/m], inf for rigid; unused for a serial arm.
        actuators: Stiffness of each actuator (na,) [N/m or N m/rad], inf for rigid.
    """

    rods: np.ndarray
    actuators: np.ndarray


class Softest(NamedTuple):
    """The tool's displacement under a pure force, the tool free to turn.

    Attributes:
        stiffness: Stiffness along the three main directions (N, 3) [N/m], softest first; the axes of the stiffness ellipsoid.
        directions: Unit vectors as columns (N, 3, 3), softest first.
    """

    stiffness: np.ndarray
    directions: np.ndarray


def combine_in_series(*stiffness: float) -> float:
    """Return the stiffness of springs one after the other; inf is rigid."""
    softness = sum(1.0 / k for k in stiffness)
    return 1.0 / softness if softness > 0 else np.inf


def compute_compliance(rates: Rates, springs: Springs) -> np.ndarray:
    """Return `K^-1` (N, d, d): tool displacement per force and torque; nan where the pose is singular.

    Raises:
        InputError: Nothing gives way.
    """
    soft_rods, soft_drives = 1.0 / springs.rods, 1.0 / springs.actuators
    if not soft_rods.any() and not soft_drives.any():
        raise InputError("unsupported", "rods and actuators are rigid; give a stiffness of either")
    J = compute_tool_jacobian(rates)
    total = np.einsum("nia,a,nja->nij", J, soft_drives, J)
    if soft_rods.any():
        total = total + _of_rods(rates.tool, soft_rods)
    return total


def compute_stiffness_matrix(rates: Rates, springs: Springs) -> np.ndarray:
    """Return `K` (N, d, d): linear first [N/m, N/rad, N m/rad]; inf entries never: rigid directions need every spring.

    Raises:
        InputError: Too few springs hold the tool: some direction is rigid and has no finite stiffness.
    """
    C = compute_compliance(rates, springs)
    sound = np.isfinite(C).all(axis=(1, 2))
    K = np.full(C.shape, np.nan)
    if sound.any() and np.linalg.matrix_rank(_scaled(C[sound], rates.length), hermitian=True).min() < C.shape[1]:
        raise InputError(
            "unsupported",
            "some direction of the tool is rigid, so K is not finite; give rods and actuators a stiffness",
        )
    K[sound] = np.linalg.inv(C[sound])
    return K


def find_softest(C: np.ndarray) -> Softest:
    """Return the main stiffnesses and directions from a compliance (N, d, d), d = 3 or 6."""
    there = np.isfinite(C).all(axis=(1, 2))
    values, vectors = np.full((len(C), 3), np.nan), np.full((len(C), 3, 3), np.nan)
    if there.any():
        soft, axes = np.linalg.eigh(C[there][:, :3, :3])
        with np.errstate(divide="ignore"):
            values[there] = 1.0 / np.maximum(soft[:, ::-1], 0.0)
        vectors[there] = axes[:, :, ::-1]
    return Softest(values, vectors)


def _of_rods(tool: np.ndarray, soft: np.ndarray) -> np.ndarray:
    """Return `J_x^+ diag(1 / k) J_x^+'`, of more rods than freedoms `(J_x' diag(k) J_x)^-1`."""
    n, d = tool.shape[1:]
    sound = np.asarray(np.isfinite(tool).all(axis=(1, 2)))
    out = np.full((len(tool), d, d), np.nan)
    if sound.any():
        sound[sound] = np.linalg.svd(tool[sound], compute_uv=False)[:, -1] > 1e-12
    if not sound.any():
        return out
    if n == d:
        inverse = np.linalg.inv(tool[sound])
        out[sound] = np.einsum("nir,r,njr->nij", inverse, soft, inverse)
    else:
        with np.errstate(divide="ignore"):
            out[sound] = np.linalg.inv(np.einsum("nri,r,nrj->nij", tool[sound], 1.0 / soft, tool[sound]))
    return out


def _scaled(C: np.ndarray, length: float) -> np.ndarray:
    """Return a compliance with turns counted as lengths, so that its rank can be judged."""
    scale = np.ones(C.shape[1])
    scale[3:] = length
    C = C * scale[:, None] * scale
    return C / np.abs(C).max(axis=(1, 2), keepdims=True)
