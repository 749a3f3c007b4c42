"""A robot with errors: the displacement of its tool and its sensitivity, for many poses at once.

With rods `w_k = B_k - A_k`, `u_k = w_k / |w_k|` and the plate's motion (dp, phi), the constraint `|w_k| = L_k` (4.4) gives

    u_k . (dp + phi x R b_k) = u_k . dA_k - u_k . R db_k + dL_k,

one scalar equation per rod: `C X = G e`. So only the component along the rod of an error of a base point counts, and it
counts like an error of the rod's length (A.3). `closed` solves the constraints themselves by Newton's method; it does not
step over a singularity unnoticed. Without rods the kinematics of the whole tree are used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.error_bounds import ErrorBounds, build_rod_sources
from tau_dyn.mechanism import Kinematics, Poses, Rods

_TOLERANCE = 1e-12
"""[m and rad] After a step this small the next one, a quadratic one, would be rounding."""
_STEPS = 40  # Newton steps; small errors need three to five


@dataclass(frozen=True, eq=False)
class State:
    """State of the robot without errors.

    Attributes:
        q: Actuated positions (N, na) [m or rad].
        position: Position of the tool (N, 3) [m].
        rotation: Rotation of the tool (N, 3, 3).
        plate: Poses of the plate; for a serial arm those of the tool.
    """

    q: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    plate: Poses

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.q)

    def take(self, index: np.ndarray | slice) -> State:
        """Return some of the poses."""
        plate = Poses(self.plate.position[index], self.plate.rotation[index])
        return State(self.q[index], self.position[index], self.rotation[index], plate)


@dataclass(frozen=True, eq=False)
class Moved:
    """Effect of errors on the tool.

    Attributes:
        shift: Displacement of the tool (N, 3) [m]; nan if the robot has no pose with these errors on its branch.
        turn: Rotation vector of the tool's change of orientation (N, 3) [rad], in the world.
        plate: Poses of the plate.
        ok: Whether there is such a pose (N,).
    """

    shift: np.ndarray
    turn: np.ndarray
    plate: Poses
    ok: np.ndarray


class Device:
    """Any mechanism; each actuator has an error within an interval along its own motion.

    Attributes:
        kinematics: The mechanism.
        legs: The device itself if it models the errors of its legs, else None.
        balls: Slice of each source in an error vector `e` (m,); the numbers of a source are within a unit ball.
        labels: Description of each source.
        m: Length of `e`.
        along: Largest error of each actuator along its own motion (na,) [m or rad].
        own: Whether every source touches one leg only.
    """

    legs: LegsDevice | None = None
    own = False

    def __init__(self, kinematics: Kinematics, errors: ErrorBounds) -> None:
        """Prepare.

        Raises:
            InputError: An error is given for a rod, or across a joint's motion.
        """
        robot = kinematics.robot
        if errors.rods:
            raise InputError(
                "unsupported",
                f"{robot.source}: no rods between chains and a plate are known here; give errors of actuators only",
            )
        for joint, error in errors.actuators.items():
            if error.axes is not None:
                raise InputError(
                    "unsupported",
                    f"{joint}: x, y and z are for carts that carry rods; give one number, its own motion's",
                )
        self.kinematics = kinematics
        self.along = np.array([errors.actuators[j].along if j in errors.actuators else 0.0 for j in robot.actuated])
        erring = np.flatnonzero(self.along)
        self.labels = tuple(robot.actuated[j] for j in erring)
        self.m, self.balls = len(erring), tuple(slice(k, k + 1) for k in range(len(erring)))
        self._actuator = np.zeros((robot.na, self.m))
        self._actuator[erring, range(self.m)] = self.along[erring]

    def state(self, q: np.ndarray, tool: Poses) -> State:
        """Return the state at actuated positions (N, na) and the tool's poses there."""
        return State(q, tool.position, tool.rotation, tool)

    def by_actuators(self, state: State) -> np.ndarray:
        """Return `d(tool) / dq` (N, 3 or 6, na)."""
        return self.kinematics.jacobian(state.q, Poses(state.position, state.rotation))

    def sensitivity(self, state: State, plate: Poses | None = None, e: np.ndarray | None = None) -> np.ndarray:
        """Return `d(tool) / de` (N, 3 or 6, m): position, then rotation; at the errors given, else without errors."""
        if e is None:
            return self.by_actuators(state) @ self._actuator
        return self.kinematics.jacobian(state.q + e @ self._actuator.T, plate) @ self._actuator

    def closed(self, state: State, e: np.ndarray) -> Moved:
        """Return the tool displaced by errors `e` (N, m): all constraints solved, on the branch that starts without errors."""
        found = self.kinematics.forward(state.q + e @ self._actuator.T, start=Poses(state.position, state.rotation))
        return _compare(state, found.poses, found.poses, np.asarray(found.ok))


class LegsDevice(Device):
    """A plate on legs and its error sources: of actuators along and across their motion, of legs and their joints."""

    def __init__(self, legs: Rods, errors: ErrorBounds) -> None:
        """Prepare; the robot must have exactly as many rods as its plate has degrees of freedom."""
        self.kinematics, self.rods, self.legs = legs, legs, self
        self.sources = s = build_rod_sources(legs, errors)
        self.balls, self.labels, self.m, self.along, self.own = s.balls, s.labels, s.m, s.along, s.own
        self.freedoms = 3 if legs.translates else 6
        if legs.n != self.freedoms:
            raise InputError(
                "unsupported",
                f"{legs.robot.source}: {legs.n} rods hold a plate with {self.freedoms} freedoms; this analysis needs one each",
            )

    def state(self, q: np.ndarray, tool: Poses) -> State:
        """Return the state at actuated positions (N, na) and the tool's poses there."""
        return State(q, tool.position, tool.rotation, self.rods.plate_poses(tool))

    def sensitivity(self, state: State, plate: Poses | None = None, e: np.ndarray | None = None) -> np.ndarray:
        """Return `d(tool) / de` (N, 3 or 6, m): position, then rotation; at the errors given, else without errors."""
        plate = state.plate if plate is None else plate
        C, G = self.tangent(state, plate, e)
        return self._at_tool(plate, solve(C, G))

    def tangent(self, state: State, plate: Poses, e: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return `C` (N, n, 3 or 6) and `G` (N, n, m) of `C X = G e`."""
        s, (u, arm) = self.sources, self._rod_directions(state, plate, e)
        q = state.q if e is None else state.q + e @ s.actuator.T
        moved = np.einsum("Nkcj,jm->Nkcm", self.rods.base_jacobian(q), s.actuator) + s.shift
        moved -= np.einsum("Nab,kbm->Nkam", plate.rotation, s.plate)
        grown = self.rods.leg_rates(q) @ s.actuator + s.length
        return self._rows(u, arm), np.einsum("Nkc,Nkcm->Nkm", u, moved) + grown

    def ends(self, q: np.ndarray, e: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return base points (N, n, 3), joints on the plate in its frame (N or 1, n, 3), lengths (N, n), with errors (N, m)."""
        if e is None:
            return self.rods.base_points(q), self.rods.on_plate[None], self.rods.leg_lengths(q)
        s, q = self.sources, q + e @ self.sources.actuator.T
        A = self.rods.base_points(q) + np.tensordot(e, s.shift, (1, 2))
        return A, self.rods.on_plate + np.tensordot(e, s.plate, (1, 2)), self.rods.leg_lengths(q) + e @ s.length.T

    def closed(self, state: State, e: np.ndarray) -> Moved:
        """Return the tool displaced by errors `e` (N, m): all constraints solved, on the branch that starts without errors."""
        A, b, L = self.ends(state.q, e)
        b = np.broadcast_to(b, A.shape)
        position, rotation = state.plate.position.copy(), np.array(state.plate.rotation)
        side = np.sign(np.linalg.det(self.tangent(state, state.plate)[0]))
        ok, left = np.zeros(len(A), bool), np.arange(len(A))
        for _ in range(_STEPS):
            C, short = self._constraints(position[left], rotation[left], A[left], b[left], L[left])
            step = _limited(solve(C, short[..., None])[..., 0], L[left])
            position[left] += np.nan_to_num(step[:, :3])
            if not self.rods.translates:
                rotation[left] = Rotation.from_rotvec(np.nan_to_num(step[:, 3:])).as_matrix() @ rotation[left]
            done = np.asarray(np.abs(step).max(axis=1) < _TOLERANCE)
            ok[left[done]] = np.sign(np.linalg.det(C[done])) == side[left[done]]
            left = left[~done & np.isfinite(step).all(axis=1)]
            if not left.size:
                break
        plate = Poses(position, rotation)
        return _compare(state, self.rods.tool_poses(plate), plate, ok)

    def _constraints(
        self, position: np.ndarray, rotation: np.ndarray, A: np.ndarray, b: np.ndarray, L: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `C` (N, n, 3 or 6) and each rod's length minus the present distance of its ends (N, n) [m]."""
        arm = np.einsum("Nab,Nkb->Nka", rotation, b)
        w = position[:, None] + arm - A
        reach = np.linalg.norm(w, axis=2)
        return self._rows(w / np.maximum(reach, 1e-300)[..., None], arm), L - reach

    def _rod_directions(self, state: State, plate: Poses, e: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        A, b, _ = self.ends(state.q, e)
        arm = np.einsum("Nab,Nkb->Nka", plate.rotation, np.broadcast_to(b, A.shape))
        w = plate.position[:, None] + arm - A
        return w / np.linalg.norm(w, axis=2, keepdims=True), arm

    def _rows(self, u: np.ndarray, arm: np.ndarray) -> np.ndarray:
        return u if self.rods.translates else np.concatenate([u, np.cross(arm, u)], axis=2)

    def _at_tool(self, plate: Poses, X: np.ndarray) -> np.ndarray:
        """Return the tool's motion for the plate's."""
        if self.rods.translates:
            return X
        lever = plate.rotation @ self.rods.tool.translation
        shift = X[:, :3] + np.cross(X[:, 3:], lever[:, :, None], axisa=1, axisb=1, axisc=1)
        return np.concatenate([shift, X[:, 3:]], axis=1)


def _compare(state: State, tool: Poses, plate: Poses, ok: np.ndarray) -> Moved:
    """Return the displacement of the tool from its intended pose."""
    turn = np.full((len(ok), 3), np.nan)
    turn[ok] = Rotation.from_matrix(tool.rotation[ok] @ state.rotation[ok].transpose(0, 2, 1)).as_rotvec()
    return Moved(np.where(ok[:, None], tool.position - state.position, np.nan), turn, plate, ok)


def solve(C: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return `C^-1 right` for many matrices; nan if C is singular."""
    try:
        return np.linalg.solve(C, right)
    except np.linalg.LinAlgError:
        whole = np.isfinite(C).all(axis=(1, 2))
        safe = np.where(np.reshape(whole, (-1, 1, 1)), C, np.eye(C.shape[1]))
        bad = np.asarray(~whole | (np.abs(np.linalg.det(safe)) < 1e-14))
        safe = np.where(bad[:, None, None], np.eye(C.shape[1]), safe)
        return np.where(bad[:, None, None], np.nan, np.linalg.solve(safe, right))


def _limited(step: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Shorten steps that leave the neighbourhood in which linearisation is valid."""
    most = 0.2 * L.min(axis=1, keepdims=True)
    size = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
    with np.errstate(all="ignore"):
        return step * np.minimum(1.0, most / np.maximum(size, 1e-300))
