r"""Inverse kinematics of a free plate on fewer than six actuators: the tool's position, and the closest orientation.

The rods then hold the plate on a surface of as many dimensions as there are actuators, and a pose asked for need not lie
on it. Position is met; the rotation follows (three actuators) or comes as near as it can in the sense of the smallest
angle (four, five). Newton on all unknowns at once, `q` and the rotation, with the tool's position fixed where it is
wanted:

    C_w w + C_q dq = -f,   minimise |w - log(R_wanted R')|,   R <- Exp(w) R,   f_k = (|A_k - B_k|^2 - L_k^2) / 2 L_k.

Where turns are commanded in place of positions (a 3-PRS: height and two tilts), the commanded coordinates are met instead,
and all other coordinates of the tool follow (`CommandedInverse`):

    G_x (x, w) + C_q dq = -f,   c(X) = c_wanted.

A pose on the surface, as forward kinematics gives them, is found exactly. Where actuators can move without the plate (a
telescopic arm on a cart) the positions nearest to a start are taken, slides measured in mean rods' lengths, turns in rad.
A pose out of reach is given up when its gap stops shrinking. Reference: Merlet 2006, ch. 2 and 3.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tau_dyn.mechanism import frames as chain_points, rod_dimensions
from tau_dyn.mechanism.chain_inverse import NewtonChain, RootChain
from tau_dyn.mechanism.kinematics import CommandedCoordinates
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import Poses, StraightWay, measure_turns, turn_rotations
from tau_dyn.mechanism.rod_dimensions import Plate, RodDimensions, compute_equation_rows
from tau_dyn.mechanism.small_systems import (
    Move,
    NewtonRules,
    iterate_newton,
    solve_least_motion_step,
    solve_with_lapack,
    solve_with_pseudo_inverse,
)

_CLOSED = 1e-11  # [m]
_MISSED = 1e-7  # [m] by how much a position that is asked for may be missed
_RULES = NewtonRules(60, 5, 0.3, _CLOSED, 1e-7)  # steps of the rods' length or rad, damped far from the solution
_WAY = 0.15  # steps on the way from home, of the rods' length or rad
_STEPS = 40  # at most on that way
_ROUGH = 1e-3  # relative to the rods' length: gap that may stay open on the way
_DAMPING = 1e-6  # cost of an actuator's motion relative to a rotation of the tool
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
        self._near = [_measure_rail(rods.numbers, k) for k in range(rods.n)]
        self._far = np.where(rods.numbers.slides >= 0, np.inf, rods.lengths) + (
            np.zeros(rods.n) if rods.translates else np.linalg.norm(self._local, axis=1)
        )

    def solve(
        self, tool: Poses, signs: tuple[int, ...], walk: bool, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, Poses]:
        """Return positions (N, na) and the tool's poses there; nan without a solution.

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
        return q, Poses(tool.position, rotation)

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
        self, tool: Poses, q: np.ndarray, rotation: np.ndarray, toward: np.ndarray, rules: NewtonRules = _RULES
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return closed positions and rotations from a start; nan where Newton does not come to rest."""
        q, rotation = q.copy(), np.array(rotation)

        def advance(left: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
            gap, w, dq = self._step(tool.take(left), q[left], rotation[left], toward[left])

            def move(share: np.ndarray) -> None:
                q[left] += share[:, None] * dq
                rotation[left] = turn_rotations(share[:, None] * w, rotation[left])

            return gap, self._size(w, dq), move

        sound = np.isfinite(q).all(axis=1) & np.isfinite(tool.position).all(axis=1)
        closed = iterate_newton(sound, advance, rules)
        q[~closed], rotation[~closed] = np.nan, np.nan
        return q, rotation

    def _size(self, twist: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return how large steps are (N,): turns, shifts [m], and actuated steps by the rods' length."""
        return np.maximum(np.abs(twist).max(axis=1), np.abs(dq).max(axis=1) / max(self.scale, 1.0))

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
        n, way = len(tool.position), StraightWay(self._home_tool, tool, turns=bool(self._turns))
        steps = np.clip(np.ceil(way.measure(self.scale) / _WAY), 1, _STEPS)
        rules = _RULES.roughly(3, _ROUGH * self.scale)
        q, rotation = np.repeat(self.rods.robot.home[None], n, axis=0), np.repeat(way.home.rotation, n, axis=0)
        for step in range(1, int(steps.max(initial=1.0))):
            on = np.flatnonzero((step < steps) & np.isfinite(q[:, 0]))
            if not on.size:
                break
            q[on], rotation[on] = self.newton(way.at(step / steps[on], on), q[on], rotation[on], near[on], rules)
        return q, rotation

    def _step(
        self, tool: Poses, q: np.ndarray, rotation: np.ndarray, toward: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the largest gap (N,) [m], the turn (N, 3) and the actuated step (N, na)."""
        f, moments, _, by_q = self._rows(Poses(tool.position, rotation), q)
        C = np.empty((len(q), self.rods.n, self._turns + self.rods.na))
        if self._turns:
            C[:, :, :3] = -moments
        C[:, :, self._turns :] = by_q
        if C.shape[1] == C.shape[2]:
            y = solve_with_pseudo_inverse(C, -f)
        else:
            y = self._chosen(C, f, tool.rotation, rotation, toward - q)
        w = y[:, :3] if self._turns else np.zeros((len(q), 3))
        return np.abs(f).max(axis=1), w, y[:, self._turns :]

    def _rows(self, tool: Poses, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return `f` (N, n) [m], the rods' moments about the tool and directions (N, n, 3), and `C_q` (N, n, na)."""
        numbers, qt = self.rods.numbers, q.T
        points = chain_points.compute_points(numbers.joints, numbers.carried, qt)
        lengths = rod_dimensions.compute_leg_lengths(numbers, qt)
        plate = Plate(tool.position.T, np.moveaxis(tool.rotation, 0, 2))
        at = compute_equation_rows(points, self._local, lengths**2, plate)
        by_q = rod_dimensions.compute_closure_by_q(numbers, qt, points, at.d).transpose(2, 0, 1)
        wide = np.broadcast_to(lengths, (self.rods.n, len(q))).T[:, :, None]
        moments, ways = (np.stack(x).transpose(2, 0, 1) / wide for x in (at.moment, at.d))
        return (np.stack(at.f) / lengths).T, moments, ways, by_q / wide

    def _chosen(
        self, C: np.ndarray, f: np.ndarray, wanted: np.ndarray, rotation: np.ndarray, away: np.ndarray
    ) -> np.ndarray:
        """Return the step that closes, turns towards the rotation wanted, and idles towards the start."""
        turning = np.zeros((len(C), self._turns, C.shape[2]))
        turning[:, :, : self._turns] = np.eye(self._turns)
        wish = measure_turns(wanted, rotation)[:, : self._turns]
        pull = np.zeros((len(C), C.shape[2]))
        if self.idle:
            vt = np.linalg.svd(C[:, :, self._turns :] * self._unit)[2][:, -self.idle :]
            pull[:, self._turns :] = self._unit * np.einsum("nki,nkj,nj->ni", vt, vt, away / self._unit)
        return solve_least_motion_step(C, f, turning, wish, self._weight, pull, _SOFT)


class CommandedInverse(ManifoldInverse):
    """Solves one robot whose commanded coordinates are not all positions."""

    def __init__(self, rods: Legs, chains: list[RootChain | NewtonChain], commanded: CommandedCoordinates) -> None:
        """Keep which coordinates are met."""
        super().__init__(rods, chains)
        self._commanded = commanded

    def solve(
        self, tool: Poses, signs: tuple[int, ...], walk: bool, start: np.ndarray | None = None
    ) -> tuple[np.ndarray, Poses]:
        """Return positions (N, na) and the tool's poses there; see `ManifoldInverse.solve`.

        A position that is not commanded must be met too, unless it is home's, as in `CommandedCoordinates.to_poses`.
        """
        near = np.repeat(self.rods.robot.home[None], len(tool.position), axis=0) if start is None else start
        wanted = self._commanded.of(tool)
        q, reached = self._closed(wanted, tool, self.started(tool, signs, near) if start is None else near)
        good = self.keeps(q, reached.position, reached.rotation, signs)
        lost = np.flatnonzero(~good & np.isfinite(wanted).all(axis=1)) if walk else np.zeros(0, int)
        if lost.size:
            here = Poses(*(np.repeat(x, len(lost), axis=0) for x in self._home_tool))
            at, home = np.repeat(self.rods.robot.home[None], len(lost), axis=0), self._commanded.of(self._home_tool)
            far = np.abs(wanted[lost] - home) / np.where(np.array(self._commanded.index) < 3, self.scale, 1.0)
            steps = int(np.clip(np.ceil(far.max() / _WAY), 1, _STEPS))
            for share in np.linspace(0, 1, steps + 1)[1:]:
                at, here = self._closed(home + share * (wanted[lost] - home), here, at)
            q[lost], reached.position[lost], reached.rotation[lost] = at, *here
            good[lost] = np.isfinite(at[:, 0])
        given = np.abs(tool.position - self._home_tool.position) > _CLOSED
        with np.errstate(invalid="ignore"):
            good &= ~(given & (np.abs(reached.position - tool.position) > _MISSED)).any(axis=1)
        return np.where(good[:, None], q, np.nan), reached

    def _closed(self, wanted: np.ndarray, tool: Poses, q: np.ndarray) -> tuple[np.ndarray, Poses]:
        """Return closed positions and poses with these commanded coordinates (N, k), from starts; nan without a solution."""
        q, position, rotation = q.copy(), tool.position.copy(), np.array(tool.rotation)

        def advance(left: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
            here = Poses(position[left], rotation[left])
            f, moments, ways, by_q = self._rows(here, q[left])
            n, gap = f.shape[1], np.concatenate([f, self._commanded.of(here) - wanted[left]], axis=1)
            C = np.zeros((*gap.shape, 6 + q.shape[1]))
            C[:, :n, :3], C[:, :n, 3:6], C[:, :n, 6:] = -ways, -moments, by_q
            C[:, n:, :6] = self._commanded.by_twist(here)
            y = solve_with_lapack(C, -gap.T).T

            def move(share: np.ndarray) -> None:
                step = share[:, None] * y
                position[left] += step[:, :3]
                rotation[left] = turn_rotations(step[:, 3:6], rotation[left])
                q[left] += step[:, 6:]

            return np.abs(gap).max(axis=1), self._size(y[:, :6], y[:, 6:]), move

        closed = iterate_newton(np.isfinite(q).all(axis=1) & np.isfinite(wanted).all(axis=1), advance, _RULES)
        for x in (q, position, rotation):
            x[~closed] = np.nan
        return q, Poses(position, rotation)


def _measure_rail(numbers: RodDimensions, k: int) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the distance (N,) [m] of positions (N, 3) to the set that rod k's point A can reach without limits.

    A point at rest, on one slide (a line) or on one turn (a circle) has one; None for longer chains.
    """
    carrier, local = numbers.carried.carrier[k], numbers.carried.local[k]
    if carrier < 0:
        return lambda place: np.linalg.norm(place - local, axis=1)
    joint = numbers.joints[carrier]
    if joint.parent >= 0:
        return None
    axis, point = joint.direction / np.linalg.norm(joint.direction), joint.rotation @ local
    centre = joint.origin + (point if joint.slides else axis * (axis @ point))
    radius = 0.0 if joint.slides else float(np.linalg.norm(point - axis * (axis @ point)))

    def distance(place: np.ndarray) -> np.ndarray:
        along = (place - centre) @ axis
        across = np.linalg.norm(place - centre - along[:, None] * axis, axis=1)
        return across if joint.slides else np.hypot(across - radius, along)

    return distance
