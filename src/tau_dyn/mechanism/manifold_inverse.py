r"""Inverse kinematics of a free plate on fewer than six actuators: the tool's position, and what orientation is left to choose.

The rods then hold the plate on a surface of as many dimensions as there are actuators, and a pose asked for need not lie
on it. Position is met; the rotation follows (three actuators) or comes as near as it can in the sense of the smallest
angle (four, five). Newton on all unknowns at once, `q` and the rotation, with the tool's position fixed where it is
wanted:

    C_w w + C_q dq = -f,   minimise |w - log(R_wanted R')|,   R <- Exp(w) R,   f_k = (|A_k - B_k|^2 - L_k^2) / 2 L_k.

A pose on the surface, as forward kinematics gives them, is found exactly. Where actuators can move without the plate (a
telescopic arm on a cart) the positions nearest to a start are taken, slides measured in mean rods' lengths, turns in rad.
A pose out of reach is given up when its gap stops shrinking. Reference: Merlet 2006, ch. 2 and 3.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.mechanism import chains as chain_points, rod_dimensions
from tau_dyn.mechanism.chain_inverse import NewtonChain, RootChain
from tau_dyn.mechanism.least_motion import Progress, solve_least_motion_step, solve_with_pseudo_inverse
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.plate_arrays import Plate, compute_equation_rows, log_of, rotate_by_vector
from tau_dyn.mechanism.poses import Poses

_MAX_ITERATIONS = 60  # Newton steps, damped far from the solution
_PATIENCE = 5  # rounds without progress after which a sample is given up
_DONE, _NEAR = 1e-13, 1e-8
_CLOSED = 1e-11  # [m]
_STEP = 0.3  # largest step, of the rods' length or rad
_WAY = 0.15  # steps on the way from home, of the rods' length or rad
_STEPS = 40  # at most on that way
_ROUGH = 1e-3  # of the rods' length: what may stay open on the way
_DAMPING = 1e-6  # what an actuator's motion costs beside a turn of the tool
_SOFT = 1e-7  # relative damping of the least-squares step, so that a singular one stays bounded
_RANK = 1e-9  # singular values relative to the matrix; less counts as zero


class ManifoldInverse:
    """Solves one robot."""

    def __init__(self, rods: Legs, chains: list[RootChain | NewtonChain]) -> None:
        """Keep the robot and its chains, whose closed forms give the starts."""
        self.rods, self._chains = rods, chains
        self._home_tool = rods.tool_poses(rods.home)
        self.scale = float(np.mean(rods.lengths))
        self._turns = 0 if rods.translates else 3
        self._local = (rods.on_plate - rods.tool.translation) @ rods.tool.rotation  # B in the tool's frame
        turning = np.array([kind == "revolute" for kind in rods.robot.joint_kinds])
        self._unit = np.where(turning, 1.0, self.scale)
        by_q = rods.gap_by_q(rods.robot.home[None], rods.home)[0] * self._unit
        self.idle = rods.na - int(np.linalg.matrix_rank(by_q, tol=_RANK * np.linalg.norm(by_q)))
        self._weight = np.concatenate([np.zeros(self._turns), _DAMPING / self._unit**2])
        self._near = rod_dimensions.measure_rail_distances(rods.numbers)
        self._far = np.where(rods.numbers.slides >= 0, np.inf, rods.lengths) + (
            np.zeros(rods.n) if rods.translates else np.linalg.norm(self._local, axis=1)
        )

    def solve(
        self, tool: Poses, signs: tuple[int, ...], walk: bool, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, na) and the tool's rotations (N, 3, 3) there; nan where there are none.

        Args:
            tool: Poses wanted.
            signs: Configuration, a sign for each chain.
            walk: Whether to try the way from home where the direct attempt fails.
            start: Positions (N, na) from which to search; idle motions are chosen nearest to it, by default to home.
        """
        toward = np.repeat(self.rods.robot.home[None], len(tool.position), axis=0) if start is None else start
        q = np.full((len(tool.position), self.rods.na), np.nan)
        rotation = np.full((len(q), 3, 3), np.nan)
        lost = np.flatnonzero(self.possible(tool.position))
        ways = [self.started, *([self._from_home] if walk else [])]
        ways = ways if start is None else [lambda asked, signs, near: near, *ways]
        for way in ways:
            if not lost.size:
                break
            asked, near = tool.take(lost), toward[lost]
            begun = way(asked, signs, near)
            begun, turned = begun if isinstance(begun, tuple) else (begun, asked.rotation)
            found, turn = self.newton(asked, begun, turned, near)
            good = np.isfinite(found[:, 0])
            if way != self._from_home:  # the way itself keeps the configuration
                good &= self.keeps(found, asked.position, turn, signs)
            q[lost[good]], rotation[lost[good]] = found[good], turn[good]
            lost = lost[~good]
        return q, rotation

    def possible(self, position: np.ndarray) -> np.ndarray:
        """Return where each rod alone could reach the tool's ball of points B, the plate turned as it may (N,)."""
        here = np.isfinite(position).all(axis=1)
        if self._turns:
            for k, near in enumerate(self._near):
                if near is not None:
                    with np.errstate(invalid="ignore"):
                        here &= near(position) <= self._far[k] + 1e-9
        return np.asarray(here)

    def started(self, tool: Poses, signs: tuple[int, ...], near: np.ndarray) -> np.ndarray:
        """Return starts (N, na): each chain's first rod in closed form, as near as it reaches; other chains near a start."""
        B = self.rods.plate_points(self.rods.plate_poses(tool)).transpose(1, 2, 0)
        q = near.copy()
        for chain, sign in zip(self._chains, signs, strict=True):
            if isinstance(chain, RootChain):
                q[:, chain.actuators[0]] = chain.solve(B[chain.rods[0]], sign, clipped=True)[0]
        return q

    def newton(
        self, tool: Poses, q: np.ndarray, rotation: np.ndarray, toward: np.ndarray, rounds: int = _MAX_ITERATIONS
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return closed positions and rotations from a start; nan where Newton does not come to rest.

        With few `rounds`, on a way, what is nearly closed is good enough.
        """
        q, rotation = q.copy(), np.array(rotation)
        left = np.flatnonzero(np.isfinite(q).all(axis=1) & np.isfinite(tool.position).all(axis=1))
        closed, progress = np.zeros(len(q), bool), Progress(len(q), _PATIENCE)
        for _ in range(rounds):
            if not left.size:
                break
            gap, w, dq = self._step(tool.take(left), q[left], rotation[left], toward[left])
            size = np.maximum(np.abs(w).max(axis=1), np.abs(dq).max(axis=1) / max(self.scale, 1.0))
            share = np.minimum(1.0, _STEP / np.maximum(size, 1e-300))[:, None]
            q[left] += share * dq
            rotation[left] = np.moveaxis(rotate_by_vector((share * w).T, np.moveaxis(rotation[left], 0, 2)), 2, 0)
            tight = gap < _CLOSED
            closed[left] = (tight & (size < 1e-7)) if rounds == _MAX_ITERATIONS else gap < _ROUGH * self.scale
            over = (tight & progress.rests(left, size, _DONE, _NEAR)) | (progress.stalled(left, gap) & ~tight)
            left = left[~over & np.isfinite(size)]
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

    def _from_home(self, tool: Poses, signs: tuple[int, ...], near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Walk the tool's position and wanted rotation straight from home; each sample in steps of its own."""
        n, home = len(tool.position), self._home_tool
        turn = log_of(np.moveaxis(tool.rotation @ home.rotation[0].T, 0, 2)) * bool(self._turns)
        away = np.linalg.norm(tool.position - home.position, axis=1) / self.scale
        steps = np.clip(np.ceil(np.maximum(away, np.abs(turn).max(axis=0)) / _WAY), 1, _STEPS)
        q, rotation = np.repeat(self.rods.robot.home[None], n, axis=0), np.repeat(home.rotation, n, axis=0)
        for step in range(1, int(steps.max(initial=1.0))):
            on = np.flatnonzero((step < steps) & np.isfinite(q[:, 0]))
            if not on.size:
                break
            share = step / steps[on]
            wanted = rotate_by_vector(share * turn[:, on], np.repeat(np.moveaxis(home.rotation, 0, 2), len(on), axis=2))
            place = home.position + share[:, None] * (tool.position[on] - home.position)
            here = Poses(place, np.moveaxis(wanted, 2, 0))
            q[on], rotation[on] = self.newton(here, q[on], rotation[on], near[on], rounds=3)
        return q, rotation

    def _step(
        self, tool: Poses, q: np.ndarray, rotation: np.ndarray, toward: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the largest gap (N,) [m], the turn (N, 3) and the actuated step (N, na)."""
        numbers, qt = self.rods.numbers, q.T
        points = chain_points.compute_points(numbers.joints, numbers.carried, qt)
        lengths = rod_dimensions.compute_leg_lengths(numbers, qt)
        at = compute_equation_rows(points, self._local, lengths**2, Plate(tool.position.T, np.moveaxis(rotation, 0, 2)))
        f = (np.stack(at.f) / lengths).T
        C = np.empty((len(q), self.rods.n, self._turns + self.rods.na))
        if self._turns:
            C[:, :, :3] = -np.stack(at.moment).transpose(2, 0, 1)
        C[:, :, self._turns :] = rod_dimensions.compute_closure_by_q(numbers, qt, points, at.d).transpose(2, 0, 1)
        C /= np.broadcast_to(lengths, (self.rods.n, len(q))).T[:, :, None]
        if C.shape[1] == C.shape[2]:
            y = solve_with_pseudo_inverse(C, -f)
        else:
            y = self._chosen(C, f, tool.rotation, rotation, toward - q)
        w = y[:, :3] if self._turns else np.zeros((len(q), 3))
        return np.abs(f).max(axis=1), w, y[:, self._turns :]

    def _chosen(
        self, C: np.ndarray, f: np.ndarray, wanted: np.ndarray, rotation: np.ndarray, away: np.ndarray
    ) -> np.ndarray:
        """Return the step that closes, turns towards the rotation wanted, and idles towards the start."""
        turning = np.zeros((len(C), self._turns, C.shape[2]))
        turning[:, :, : self._turns] = np.eye(self._turns)
        wish = log_of(np.moveaxis(wanted @ np.swapaxes(rotation, 1, 2), 0, 2)).T[:, : self._turns]
        pull = np.zeros((len(C), C.shape[2]))
        if self.idle:
            vt = np.linalg.svd(C[:, :, self._turns :] * self._unit)[2][:, -self.idle :]
            pull[:, self._turns :] = self._unit * np.einsum("nki,nkj,nj->ni", vt, vt, away / self._unit)
        return solve_least_motion_step(C, f, turning, wish, self._weight, pull, _SOFT)
