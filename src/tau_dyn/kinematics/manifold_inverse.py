r"""Inverse kinematics of a free plate on fewer than six actuators: the tool's position, and what orientation is left to choose.

The rods then hold the plate on a surface of as many dimensions as there are actuators, and a pose asked for need not lie
on it. Position is met; the rotation follows (three actuators) or comes as near as it can in the sense of the smallest
angle (four, five). Newton on all unknowns at once, `q` and the rotation, with the tool's position fixed where it is
wanted:

    G_w w + G_q dq = -g,   minimise |w - log(R_wanted R')|,   R <- Exp(w) R.

A pose on the surface, as forward kinematics gives them, is found exactly. Reference: Merlet 2006, ch. 2 and 3.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.chain_inverse import NewtonChain, RootChain
from tau_dyn.kinematics.plate_arrays import log_of, turned_by
from tau_dyn.kinematics.poses import Poses
from tau_dyn.kinematics.rods import Rods

_ROUNDS = 60
_DONE = 1e-13
_CLOSED = 1e-11  # [m]
_STEP = 0.3  # largest step, of the rods' length or rad
_WAY = 0.1  # steps on the way from home, of the rods' length or rad


class ManifoldInverse:
    """Solves one robot."""

    def __init__(self, rods: Rods, chains: list[RootChain | NewtonChain]) -> None:
        """Keep the robot and its chains, whose closed forms give the starts."""
        self.rods, self._chains = rods, chains
        self._home_tool = rods.tool_poses(rods.home)
        self.scale = float(np.mean(rods.lengths))

    def solve(self, tool: Poses, signs: tuple[int, ...], walk: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, na) and the tool's rotations (N, 3, 3) there; nan where there are none.

        Args:
            tool: Poses wanted.
            signs: Configuration, a sign for each chain.
            walk: Whether to try the way from home where the direct attempt fails.
        """
        q, rotation = self.newton(tool, self.started(tool, signs), tool.rotation)
        q[~self.keeps(q, tool.position, rotation, signs)] = np.nan
        lost = np.flatnonzero(np.isnan(q[:, 0]) & np.isfinite(tool.position).all(axis=1))
        if walk and lost.size:
            q[lost], rotation[lost] = self._from_home(tool.take(lost))
        return q, rotation

    def started(self, tool: Poses, signs: tuple[int, ...]) -> np.ndarray:
        """Return starts (N, na): each chain's first rod in closed form, as near as it reaches."""
        B = self.rods.plate_points(self.rods.plate_poses(tool)).transpose(1, 2, 0)
        q = np.repeat(self.rods.robot.home[None], len(tool.position), axis=0)
        for chain, sign in zip(self._chains, signs, strict=True):
            if isinstance(chain, RootChain):
                q[:, chain.actuators[0]] = chain.solve(B[chain.rods[0]], sign, clipped=True)[0]
        return q

    def newton(self, tool: Poses, q: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return closed positions and rotations from a start; nan where Newton does not come to rest."""
        q, rotation = q.copy(), np.array(rotation)
        left = np.flatnonzero(np.isfinite(q).all(axis=1) & np.isfinite(tool.position).all(axis=1))
        closed = np.zeros(len(q), bool)
        for _ in range(_ROUNDS):
            if not left.size:
                break
            gap, w, dq = self._step(tool.take(left), q[left], rotation[left])
            size = np.maximum(np.abs(w).max(axis=1), np.abs(dq).max(axis=1) / max(self.scale, 1.0))
            share = np.minimum(1.0, _STEP / np.maximum(size, 1e-300))[:, None]
            q[left] += share * dq
            rotation[left] = np.moveaxis(turned_by((share * w).T, np.moveaxis(rotation[left], 0, 2)), 2, 0)
            tight = gap < _CLOSED
            closed[left] = tight & (size < 1e-7)
            left = left[~(tight & (size < _DONE)) & np.isfinite(size)]
        q[~closed], rotation[~closed] = np.nan, np.nan
        return q, rotation

    def keeps(self, q: np.ndarray, position: np.ndarray, rotation: np.ndarray, signs: tuple[int, ...]) -> np.ndarray:
        """Return where the positions are still of the configuration that they were started in (N,)."""
        B = self.rods.plate_points(self.rods.plate_poses(Poses(position, rotation))).transpose(1, 2, 0)
        same = np.isfinite(q).all(axis=1)
        for chain, sign in zip(self._chains, signs, strict=True):
            if isinstance(chain, RootChain) and len(chain.signs) > 1:
                own = q[:, chain.actuators[0]]
                here, other = (chain.solve(B[chain.rods[0]], s, clipped=True)[0] for s in (sign, -sign))
                with np.errstate(invalid="ignore"):
                    same &= np.abs(own - here) <= np.abs(own - other) + 1e-9
        return np.asarray(same)

    def _from_home(self, tool: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Walk the tool's position and wanted rotation straight from home."""
        n, home = len(tool.position), self._home_tool
        turn = log_of(np.moveaxis(tool.rotation @ home.rotation[0].T, 0, 2))
        away = np.linalg.norm(tool.position - home.position, axis=1).max(initial=0.0) / self.scale
        steps = int(np.ceil(min(max(away, np.abs(turn).max(initial=0.0)) / _WAY, 100.0)))
        q = np.repeat(self.rods.robot.home[None], n, axis=0)
        rotation = np.repeat(home.rotation, n, axis=0)
        for share in np.linspace(0, 1, steps + 1)[1:]:
            wanted = np.moveaxis(turned_by(share * turn, np.repeat(np.moveaxis(home.rotation, 0, 2), n, axis=2)), 2, 0)
            here = Poses(home.position + share * (tool.position - home.position), wanted)
            q, rotation = self.newton(here, q, rotation)
        return q, rotation

    def _step(self, tool: Poses, q: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the largest gap (N,) [m], the turn (N, 3) and the actuated step (N, na)."""
        rods = self.rods
        plate = rods.plate_poses(Poses(tool.position, rotation))
        gap = rods.gap(q, plate)
        by_pose = rods.gap_by_pose(q, plate)
        arm = plate.rotation @ rods.tool.translation
        by_turn = by_pose[:, :, 3:] + np.cross(by_pose[:, :, :3], arm[:, None])
        C = np.concatenate([by_turn, rods.gap_by_q(q, plate)], axis=2)
        if C.shape[1] == C.shape[2]:
            y = _solved(C, -gap)
        else:
            wish = log_of(np.moveaxis(tool.rotation @ np.swapaxes(rotation, 1, 2), 0, 2)).T
            y = _constrained(C, -gap, wish)
        return np.abs(gap).max(axis=1), y[:, :3], y[:, 3:]


def _solved(C: np.ndarray, right: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.solve(C, right[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        return np.einsum("nij,nj->ni", np.linalg.pinv(C, rcond=1e-10), right)


def _constrained(C: np.ndarray, right: np.ndarray, wish: np.ndarray) -> np.ndarray:
    """Return `y` with `C y = right` whose first three entries are nearest to a wish."""
    u, s, vt = np.linalg.svd(C)
    rank = s.shape[1]
    kept = s > 1e-10 * s[:, :1]
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=kept)
    y = np.einsum("nki,nk->ni", vt[:, :rank], inverse * np.einsum("nik,ni->nk", u[:, :, :rank], right))
    free = np.swapaxes(vt[:, rank:], 1, 2)
    z = np.einsum("nij,nj->ni", np.linalg.pinv(free[:, :3], rcond=1e-9), wish - y[:, :3])
    return y + np.einsum("nij,nj->ni", free, z)
