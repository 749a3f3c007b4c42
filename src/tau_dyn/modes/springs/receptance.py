r"""Receptances of a robot with springs at one pose, with their derivatives by stiffness and damping.

With the free coordinates `x` (drives with known forces, then springs) about rest, `Z(s) = s^2 M + s D + K` and `H = Z^-1`,

    Y = s^n C H B U,    dY/dk_i = -s^n (C H)_i (H B U)_i,    dY/dd_i = s dY/dk_i,

`n` counts the derivatives that a sensor measures. `H` is computed from the eigenvalues of the state matrix. A stretch of a
record neither begins nor ends at rest. Jumps `dx` and `dv` of position and velocity between its ends add

    X_0 = -H (M dv + (s M + D) dx),    Y_0 = C X_0,    s C X_0 + C dx,    s^2 C X_0 + s C dx + C dv

to displacements, velocities and accelerations. References: Ewins 2000, 2.5; Pintelon & Schoukens 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import FlexibleModel
from tau_dyn.modes.springs.channels import PosedRecord, RecordChannel, Spectrum

RING_DOWN = 8.0
"""Time constants after which a mode counts as at rest: an amplitude of 3e-4."""


@dataclass(frozen=True, eq=False)
class PoseModel:
    """The robot about rest at the pose of a record, in its free coordinates.

    Attributes:
        M: Mass matrix (n, n).
        D: Damping matrix (n, n).
        K: Stiffness matrix (n, n), with the weight's share.
        B: Generalised force per input (n, m).
        C: Output's displacement per coordinate (p, n).
        orders: Derivatives by time of each output (p,).
        parameters: Coordinate of each spring, then of each drive with a known force.
    """

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    B: np.ndarray
    C: np.ndarray
    orders: np.ndarray
    parameters: np.ndarray

    def with_springs(self, stiffness: np.ndarray, damping: np.ndarray, before: np.ndarray) -> PoseModel:
        """Return the model with other springs at the same rest position.

        Args:
            stiffness: Of each spring (ns,).
            damping: Of each spring, then of each drive with a known force (ns + free,).
            before: Stiffness that `K` holds (ns,).
        """
        K, D = self.K.copy(), np.zeros_like(self.D)
        springs = self.parameters[: len(stiffness)]
        K[springs, springs] += stiffness - before
        D[self.parameters, self.parameters] = damping
        return replace(self, K=K, D=D)

    def respond(self, spectra: Sequence[Spectrum]) -> list[Responses]:
        """Return the outputs at the inputs of stretches, and what derivatives need; stretches share their lines."""
        lines, at = np.unique(np.concatenate([x.s for x in spectra]), return_inverse=True)
        forced, by_output = self._solve(lines)
        lift = lines[:, None] ** self.orders
        gain, out = lift[:, :, None] * (self.C @ forced), []
        for spectrum, rows in zip(spectra, np.split(at, np.cumsum([len(x.s) for x in spectra])[:-1]), strict=True):
            acting = np.flatnonzero(np.any(spectrum.u, axis=0))
            u = spectrum.u[:, acting]
            x = np.einsum("fnm,fm->fn", forced[rows][:, :, acting], u)
            value = np.einsum("fpm,fm->fp", gain[rows][:, :, acting], u)
            by_error = gain[rows][:, :, spectrum.error_inputs]
            out.append(Responses(value, by_error, lift[rows], x, by_output[rows]))
        return out

    def _solve(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `H B` (F, n, m) and `H C'` (F, n, p)."""
        n, m = self.B.shape
        right = np.linalg.solve(self.M, np.hstack([self.B, self.C.T]))
        slope = np.linalg.solve(self.M, np.hstack([self.K, self.D]))
        values, vectors = np.linalg.eig(np.block([[np.zeros((n, n)), np.eye(n)], [-slope]]))
        if np.linalg.cond(vectors) > 1e12:  # a defective matrix, as of a free drive without friction
            Z = s[:, None, None] ** 2 * self.M + s[:, None, None] * self.D + self.K
            both = np.linalg.solve(Z, np.hstack([self.B, self.C.T])[None])
        else:
            weights = np.linalg.solve(vectors, np.vstack([np.zeros_like(right), right]))
            parts = (vectors[:n, :, None] * weights).transpose(1, 0, 2).reshape(2 * n, -1)
            both = (1 / (s[:, None] - values) @ parts).reshape(len(s), n, -1)
        return both[:, :, :m], both[:, :, m:]

    def build_end_columns(self, spectrum: Spectrum, found: Responses) -> np.ndarray:
        """Return the effect (F, p, c) of jumps between a stretch's ends, of the modes that may ring there.

        Offsets `a_p + b_p s` of each output are left to the caller.
        """
        squares, shapes = eigh(self.K, self.M)
        w = np.sqrt(np.abs(squares))
        decay = np.einsum("ij,ij->j", shapes, self.D @ shapes) / 2
        near = (w < 1.5 * np.abs(spectrum.s.imag).max()) & (decay * spectrum.duration < RING_DOWN)
        P, s = shapes[:, near], spectrum.s[:, None, None]
        CH, CP = np.swapaxes(found.by_output, 1, 2), self.C @ P
        by_speed, by_damping = -CH @ (self.M @ P), -CH @ (self.D @ P)
        by_place = s * by_speed + by_damping
        first, second = (self.orders[:, None] == k for k in (1, 2))
        lift = found.lift[:, :, None]
        return np.concatenate([lift * by_speed + second * CP, lift * by_place + first * CP + s * second * CP], axis=2)


@dataclass(frozen=True, eq=False)
class Responses:
    """Outputs of a model at the lines of a stretch.

    Attributes:
        value: Outputs (F, p).
        by_error: Output per input whose force has errors (F, p, e).
        lift: `s^n` of each output (F, p).
        x: Coordinates (F, n).
        by_output: `H C'` (F, n, p).
    """

    value: np.ndarray
    by_error: np.ndarray
    lift: np.ndarray
    x: np.ndarray
    by_output: np.ndarray

    def differentiate(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the outputs' derivatives by the stiffness at some coordinates (F, p, c)."""
        return -self.lift[:, :, None] * np.swapaxes(self.by_output[:, coordinates] * self.x[:, coordinates, None], 1, 2)


def build_pose_model(flexible: FlexibleModel, record: PosedRecord) -> PoseModel:
    """Return the receptance model of a robot at the pose and for the channels of a record.

    If the springs are too soft to carry the weight at this pose, they count as preloaded to carry it without deflection.
    """
    try:
        near = flexible.at(record.q, tool=flexible.robot.tool)
    except InputError:
        near = flexible.at(record.q, tool=flexible.robot.tool, sag=False)
    robot, a = flexible.robot, near.na
    free = [robot.actuated.index(joint) for joint in record.free]
    kept = np.array([*free, *range(a, len(near.M))], int)

    def project(channels: Sequence[RecordChannel]) -> np.ndarray:
        places = {c.place: flexible.compute_jacobian(near, c.place) for c in channels if c.place}
        rows = [
            places[c.place][c.axis] if c.place else np.eye(len(near.M))[robot.actuated.index(c.joint)] for c in channels
        ]
        return np.array(rows)[:, kept]

    springs = len(free) + np.arange(len(near.springs))
    square = np.ix_(kept, kept)
    return PoseModel(
        near.M[square],
        near.D[square],
        near.K[square],
        project(record.inputs).T,
        project(record.outputs),
        np.array([c.order for c in record.outputs]),
        np.concatenate([springs, np.arange(len(free))]).astype(int),
    )
