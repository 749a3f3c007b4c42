r"""Assembly modes of a robot at given actuated positions: six free rods, or three on a plate that keeps its orientation."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.modes import AssemblyModes, find_assembly_modes
from tau_dyn.kinematics.poses import Poses, convert_to_quaternions
from tau_dyn.kinematics.positions import require_positions
from tau_dyn.kinematics.rods import Rods, build_rods
from tau_dyn.robot import Robot

_FLAT = 1e-12
"""Squared height over the plane of the centres, as a share of the largest radius', below which the two modes may be one."""


def find_robot_assembly_modes(robot: Robot | Rods, q: np.ndarray) -> AssemblyModes:
    """Return all poses of a robot's plate at one set of actuated positions.

    Args:
        robot: The robot, or its rods.
        q: Actuated positions (na,) [m or rad].

    Raises:
        NotRods: The mechanism is not one of rods between points.
        InputError: Its number of rods is not six (free plate) or three (plate that translates), or `q` does not fit.
    """
    rods = robot if isinstance(robot, Rods) else build_rods(robot)
    q = require_positions(rods.robot, q)
    if len(q) != 1 or not np.isfinite(q).all():
        raise InputError(
            "wrong_shape", f"assembly modes are found at one set of finite positions; these are {np.shape(q)}"
        )
    A, L = rods.base_points(q)[0], rods.leg_lengths(q)[0]
    if rods.translates and rods.n == 3:
        return find_translating_modes(A, rods.on_plate, L, rods.rotation)
    if rods.translates or rods.n != 6:
        kind = "translates" if rods.translates else "is free"
        raise InputError(
            "unsupported",
            "assembly modes need six rods on a free plate or three on one that translates; "
            f"{rods.robot.source} has {rods.n} on a plate that {kind}",
        )
    return find_assembly_modes(A, rods.on_plate, L)


def find_translating_modes(
    base: np.ndarray, plate: np.ndarray, lengths: np.ndarray, rotation: np.ndarray
) -> AssemblyModes:
    """Return the two points where three spheres meet (thesis 4.9), real or a conjugate pair.

    Args:
        base: A (3, 3) [m].
        plate: B in the plate's frame (3, 3) [m].
        lengths: L (3,) [m].
        rotation: The plate's (3, 3).
    """
    centres = base - plate @ rotation.T
    u, w = centres[1] - centres[0], centres[2] - centres[0]
    normal = np.cross(u, w)
    area = normal @ normal
    if area <= 1e-24 * (u @ u) * (w @ w) or area == 0:
        raise InputError(
            "unsupported",
            "the spheres' centres stand in one line, so the plate is free to go round it: infinitely many modes",
        )
    square = lengths**2
    p, r = 0.5 * (u @ u + square[0] - square[1]), 0.5 * (w @ w + square[0] - square[2])
    foot = (p * np.cross(w, normal) + r * np.cross(normal, u)) / area
    height = square[0] - foot @ foot
    offset = np.sqrt(complex(height) / area) * normal
    position = np.array([centres[0] + foot + offset, centres[0] + foot - offset])
    gaps = position[:, None] - centres
    residual = np.abs(np.sqrt((gaps * gaps).sum(axis=2)) - lengths).max(axis=1)
    flat = abs(height) <= _FLAT * square.max()
    why = "three spheres meet in two points" + ("; here the two are closer than rounding can tell" if flat else "")
    quaternion = convert_to_quaternions(Poses(np.zeros((1, 3)), rotation[None]))
    return AssemblyModes(
        position=position,
        quaternion=np.tile(quaternion, (2, 1)).astype(complex),
        rotation=np.tile(rotation, (2, 1, 1)).astype(complex),
        real=np.full(2, height >= 0 and not flat),
        residual=residual,
        radius=np.full(2, np.finfo(float).eps * square.max() / max(abs(height), 1e-300)),
        n_no_pose=0,
        n_singular=2 if flat else 0,
        certified=not flat,
        why=why,
    )


def select_real_poses(modes: AssemblyModes) -> Poses:
    """Return the real modes as poses of the plate."""
    return Poses(modes.position[modes.real].real, modes.rotation[modes.real].real)
