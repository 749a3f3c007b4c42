"""Dexterity of a robot at a pose: condition, manipulability, distance to singularities, worst speed and force.

All measures follow from the closure's rates, which relate the tool's twist (linear first) to the actuators' speeds:

    J_x V = J_q v,      J = J_x^-1 J_q.

A rod gives the row `[u', (r x u)'] V = u' dA/dq v` with `u` its direction and `r` from the tool to its end on the plate; a
serial arm has `J_x = 1`. Lengths and angles are made comparable by one characteristic length `l`: turns count as `l` times
their angle, `V_h = (v, l w)`, for revolute actuators too (homogenised, as Angeles 1992; Merlet 2006, ch. 5). For a plate,
`l` is the root mean square distance of its joints from the tool. Singular values of `J_x` and `J_q` are distances, in the
2-norm, to the nearest matrix that is singular: parallel singularities (the plate moves with actuators locked) and serial
ones (an actuator moves without moving the plate; Gosselin & Angeles 1990).

The compliance of the tool follows from the linearised robot (`mechanism.flexible`), not from these rates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Rates(NamedTuple):
    """The closure's derivative at many poses.

    Attributes:
        tool: `J_x` (N, n, d) by the requested components of the twist, linear ones first: 3 for a tool that only translates
            (or whose rotation is not requested), else up to 6.
        actuators: `J_q` (N, n, na).
        turns: Which actuators are revolute (na,).
        length: Characteristic length [m].
        linear: Largest number of linear components.
    """

    tool: np.ndarray
    actuators: np.ndarray
    turns: np.ndarray
    length: float
    linear: int = 3

    def take(self, index: np.ndarray | slice) -> Rates:
        """Return the rates at some of the poses."""
        return self._replace(tool=self.tool[index], actuators=self.actuators[index])


class Dexterity(NamedTuple):
    """Dexterity of the robot at N poses.

    Attributes:
        condition: Condition number of the homogenised Jacobian (N,), 1 at best, inf if it is singular.
        manipulability: Product of its singular values (N,), Yoshikawa's measure.
        parallel: Least singular value of the homogenised `J_x` (N,): distance to a parallel singularity.
        serial: Least singular value of the homogenised `J_q` (N,): distance to a serial singularity.
        tool_sign: Sign of `det J_x` (N,), 0 if it is not square.
        actuator_sign: Sign of `det J_q` (N,), 0 if it is not square.
    """

    condition: np.ndarray
    manipulability: np.ndarray
    parallel: np.ndarray
    serial: np.ndarray
    tool_sign: np.ndarray
    actuator_sign: np.ndarray

    @property
    def singularity(self) -> np.ndarray:
        """Distance to the nearest singularity of either kind (N,)."""
        return np.minimum(self.parallel, self.serial)


def homogenise_jacobians(rates: Rates) -> tuple[np.ndarray, np.ndarray]:
    """Return `J_x` (N, n, d) and `J_q` (N, n, na) with turns counted as lengths; a serial arm's rows are scaled as well."""
    tool, actuators = rates.tool.copy(), rates.actuators.copy()
    tool[:, :, rates.linear :] /= rates.length
    if is_serial(rates):  # rows of a serial arm are the twist itself
        tool[:, rates.linear :] *= rates.length
        actuators[:, rates.linear :] *= rates.length
    actuators[:, :, rates.turns] /= rates.length
    return tool, actuators


def is_serial(rates: Rates) -> bool:
    """Return whether the rates are a serial arm's: `J_x = 1`."""
    n, d = rates.tool.shape[1:]
    return n == d and bool(np.array_equal(rates.tool, np.broadcast_to(np.eye(n), rates.tool.shape)))


def compute_dexterity(rates: Rates) -> Dexterity:
    """Return the measures at every pose; nan rates give nan."""
    tool, actuators = homogenise_jacobians(rates)
    sound = np.isfinite(tool).all(axis=(1, 2)) & np.isfinite(actuators).all(axis=(1, 2))
    out = np.full((6, len(tool)), np.nan)
    if sound.any():
        out[:, sound] = _measures(tool[sound], actuators[sound])
    return Dexterity(*out)


def _measures(tool: np.ndarray, actuators: np.ndarray) -> np.ndarray:
    parallel = np.linalg.svd(tool, compute_uv=False)[:, -1]
    serial = np.linalg.svd(actuators, compute_uv=False)[:, -1]
    sound = parallel > 1e-12
    s = np.full((len(tool), min(tool.shape[2], actuators.shape[2])), np.nan)
    if sound.any():
        s[sound] = np.linalg.svd(_solved(tool[sound], actuators[sound]), compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = np.where(sound, s[:, 0] / s[:, -1], np.inf)
    condition = np.where(condition < 1e12, condition, np.inf)
    manipulability = np.where(sound, s.prod(axis=1), np.inf)
    return np.array([condition, manipulability, parallel, serial, _sign(tool), _sign(actuators)])


def compute_tool_jacobian(rates: Rates) -> np.ndarray:
    """Return `J` (N, d, na): tool twist per actuator speed [m or rad per m or rad]; nan if `J_x` is singular."""
    J = np.full((len(rates.tool), rates.tool.shape[2], rates.actuators.shape[2]), np.nan)
    sound = np.asarray(np.isfinite(rates.tool).all(axis=(1, 2)) & np.isfinite(rates.actuators).all(axis=(1, 2)))
    if sound.any():
        sound[sound] = np.linalg.svd(rates.tool[sound], compute_uv=False)[:, -1] > 1e-12
    if sound.any():
        J[sound] = _solved(rates.tool[sound], rates.actuators[sound])
    return J


def compute_worst_speed(rates: Rates, limits: np.ndarray) -> np.ndarray:
    """Return the tool speed (N,) [m/s] that is reached in every direction without turning, at speed limits (na,).

    `v = K d` for a unit direction `d`, so actuator i allows `limit_i / |K_i|` in its own worst direction.
    """
    sound = np.isfinite(rates.actuators).all(axis=(1, 2)) & np.isfinite(rates.tool).all(axis=(1, 2))
    per = np.full((len(rates.tool), rates.actuators.shape[2], min(rates.linear, rates.tool.shape[2])), np.nan)
    if sound.any():
        per[sound] = np.linalg.pinv(rates.actuators[sound], rcond=1e-9) @ rates.tool[sound][:, :, : rates.linear]
    with np.errstate(divide="ignore"):
        speed = (limits / np.linalg.norm(per, axis=2)).min(axis=1)
    gone = sound & (compute_dexterity(rates).serial < 1e-9)
    return np.where(gone, 0.0, speed)


def compute_worst_force(rates: Rates, limits: np.ndarray) -> np.ndarray:
    """Return the force at the tool (N,) [N] that actuators with force limits (na,) hold in every direction; no gravity.

    `tau = J' F`, so actuator i allows `limit_i / |J_i|` along its own column of the linear rows.
    """
    J = compute_tool_jacobian(rates)[:, : rates.linear]
    with np.errstate(divide="ignore"):
        return (limits / np.linalg.norm(J, axis=1)).min(axis=1)


def _solved(tool: np.ndarray, actuators: np.ndarray) -> np.ndarray:
    if tool.shape[1] == tool.shape[2]:
        return np.linalg.solve(tool, actuators)
    return np.linalg.pinv(tool) @ actuators


def _sign(matrix: np.ndarray) -> np.ndarray:
    if matrix.shape[1] != matrix.shape[2]:
        return np.zeros(len(matrix))
    return np.sign(np.linalg.det(matrix))


class Softest(NamedTuple):
    """The tool's displacement under a pure force, the tool free to turn.

    Attributes:
        stiffness: Stiffness along the three main directions (N, 3) [N/m], softest first; the axes of the stiffness ellipsoid.
        directions: Unit vectors as columns (N, 3, 3), softest first.
    """

    stiffness: np.ndarray
    directions: np.ndarray


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
