r"""Inverse kinematics chain by chain: from where the plate's points B are to the actuators that move the chain's rods.

One actuator and one distance have a closed form, with `w = B - A(0)`, `e = B - o` and `p` the turning point before its
turn:

    slide   q^2 - 2 q (w . d) / |d|^2 + (|w|^2 - L^2) / |d|^2 = 0         (thesis (4.9))
    turn    (e . p_across) cos + (e . (n x p)) sin = (|e|^2 + |p|^2 - L^2) / 2 - e . p_along     (a cos + b sin = c)
    leg     sqrt(offset^2 + (along + q)^2) = |A - B|                       (thesis, after (4.3))

with two solutions for slide and turn, sign -1 and 1, and one for a leg. A chain of several actuators (F1's carts with
their plates) is solved by Newton, walked to from home: thesis (4.32). Arrays have samples last.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.mechanism import frames, rod_dimensions
from tau_dyn.mechanism.frames import Carried, ChainJoint
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.rod_dimensions import RodDimensions
from tau_dyn.mechanism.small_systems import Move, NewtonRules, iterate_newton

_MAX_ITERATIONS = 30  # Newton steps; quadratic convergence needs five to eight
_STILL, _DONE = 1e-6, 1e-9  # [m or rad] sizes of steps whose square is rounding, and after which no step is needed
_REACHED = 1e-10  # relative to the rod: largest `(|d|^2 - L^2) / 2 L^2`
_TURNS = 6  # starting angles a turn when all solutions of a chain are looked for
_EQUALITY_TOLERANCE = 1e-6  # [m or rad] closer solutions are one


class RootChain:
    """A chain of one actuator: its first rod decides, in closed form."""

    signs: tuple[int, ...]

    def __init__(self, rods: Legs, own: tuple[int, ...], actuator: int) -> None:
        """Read the first rod's numbers, and which root is home's."""
        numbers, k = rods.numbers, own[0]
        self.rods, self.actuators, self._k = own, (actuator,), k
        self.length, self.offset, self.gain = numbers.lengths[k], numbers.offsets[k], numbers.gains[k]
        carrier, local = numbers.carried.carrier[k], numbers.carried.local[k]
        self.leg = numbers.slides[k] >= 0
        self.joint = None if self.leg else numbers.joints[carrier]
        self.point = local if self.joint is None else self.joint.rotation @ local
        self.turns = self.joint is not None and not self.joint.slides
        self.signs = (1,) if self.leg else (-1, 1)
        self.home = float(rods.robot.home[actuator])
        at_home = rods.plate_points(rods.home)[0, k][:, None]
        roots = {s: float(self.solve(at_home, s)[0, 0]) for s in self.signs}
        self.home_sign = min(roots, key=lambda s: abs(np.nan_to_num(roots[s], nan=np.inf) - self.home))

    def solve(self, B: np.ndarray, sign: int, clipped: bool = False) -> np.ndarray:
        """Return the actuator's position (1, N) for the plate's point (3, N); nan where out of reach, the nearest if clipped."""
        with np.errstate(invalid="ignore"):
            if self.joint is None:
                return self._leg(B, clipped)[None]
            found = (
                self._turn(self.joint, B, sign, clipped) if self.turns else self._slide(self.joint, B, sign, clipped)
            )
        return found[None]

    def _slide(self, joint: ChainJoint, B: np.ndarray, sign: int, clipped: bool) -> np.ndarray:
        square = float(joint.direction @ joint.direction)
        w = B - (joint.origin + self.point)[:, None]
        along = joint.direction @ w / square
        across = w - joint.direction[:, None] * along
        rest = (self.length**2 - np.sum(across**2, axis=0)) / square
        return along + sign * np.sqrt(np.maximum(rest, 0.0) if clipped else rest)

    def _turn(self, joint: ChainJoint, B: np.ndarray, sign: int, clipped: bool) -> np.ndarray:
        gain = float(np.linalg.norm(joint.direction))
        n = joint.direction / gain
        e = B - joint.origin[:, None]
        along = n * (n @ self.point)
        a, b = (self.point - along) @ e, np.cross(n, self.point) @ e
        c = 0.5 * (np.sum(e**2, axis=0) + self.point @ self.point - self.length**2) - along @ e
        rest = a**2 + b**2 - c**2
        turned = np.arctan2(b, a) + sign * np.arctan2(np.sqrt(np.maximum(rest, 0.0) if clipped else rest), c)
        away = turned - self.home * gain
        return (turned - 2 * np.pi * np.floor((away + np.pi) / (2 * np.pi))) / gain

    def _leg(self, B: np.ndarray, clipped: bool) -> np.ndarray:
        square = np.sum((B - self.point[:, None]) ** 2, axis=0) - self.offset**2
        reach = np.sqrt(np.maximum(square, 0.0) if clipped else square)
        return (reach - np.sqrt(self.length**2 - self.offset**2)) / self.gain


class NewtonChain:
    """A chain of several actuators with as many distances."""

    signs: tuple[int, ...] = (0,)
    home_sign = 0

    def __init__(self, rods: Legs, own: tuple[int, ...], actuators: tuple[int, ...]) -> None:
        """Cut the chain's own joints and rods out of the robot's."""
        self.rods, self.actuators = own, actuators
        self.numbers = _cut(rods.numbers, own, actuators)
        self.home = rods.robot.home[list(actuators)]
        self.scale = float(np.mean(self.numbers.lengths))
        self.turning = np.array([rods.robot.joint_kinds[a] == "revolute" for a in actuators])
        self._at_home = rods.plate_points(rods.home)[0, list(own)]

    def solve(self, B: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """Return positions (m, N) for points `B` (m, 3, N) at the end of ways (steps, m, 3, N) from home; nan where barred."""
        q = np.repeat(self.home[:, None], B.shape[2], axis=1)
        for here in ways:
            q = self.newton(here, q, rounds=6)
        return self.wrapped(self.newton(B, q))

    def newton(self, B: np.ndarray, q: np.ndarray, rounds: int = _MAX_ITERATIONS) -> np.ndarray:
        """Return positions (m, N) that put the points A at a rod's length from `B`, from a start; nan where it fails."""
        q = q.copy()

        def advance(left: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
            f, J = self._equations(B[:, :, left], q[:, left])
            step = _solve(J, -f)

            def move(share: np.ndarray) -> None:
                q[:, left] += share * step

            return np.abs(f).max(axis=0), np.abs(step).max(axis=0), move

        rules = NewtonRules(rounds + 1, rounds, 0.5 * max(self.scale, 0.5), _REACHED * self.scale**2, _STILL, _DONE)
        closed = iterate_newton(np.isfinite(q).all(axis=0) & np.isfinite(B).all(axis=(0, 1)), advance, rules)
        q[:, ~closed] = np.nan
        return q

    def all(self, B: np.ndarray) -> list[np.ndarray]:
        """Return distinct solutions, each (m, N), found from many starts; not certified to be all."""
        found: list[np.ndarray] = []
        for start in self._starts(B):
            q = self.wrapped(self.newton(B, start, rounds=15))
            for k, known in enumerate(found):
                empty = np.isnan(known[0])
                same = np.abs(known - q).max(axis=0) < _EQUALITY_TOLERANCE
                found[k] = np.where(empty & ~np.isnan(q[0]), q, known)
                q = np.where(same | empty, np.nan, q)
            if np.isfinite(q[0]).any():
                found.append(q)
        return found

    def wrapped(self, q: np.ndarray) -> np.ndarray:
        """Return the positions with whole turns away from home taken out."""
        away = (q - self.home[:, None] + np.pi) % (2 * np.pi) - np.pi + self.home[:, None]
        return np.where(self.turning[:, None], away, q)

    def _equations(self, B: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `f` (m, N) and `df/dq` (m, m, N)."""
        joints, carried = self.numbers.joints, self.numbers.carried
        places = frames.compute_points(joints, carried, q)
        d = places - B
        f = 0.5 * (np.sum(d * d, axis=1) - rod_dimensions.compute_squared_lengths(self.numbers, q))
        return f, rod_dimensions.compute_closure_by_q(self.numbers, q, places, d)

    def _starts(self, B: np.ndarray) -> list[np.ndarray]:
        """Return starts (m, N): turns on a grid, slides either way of the nearest point."""
        n = B.shape[2]
        angles = np.linspace(-np.pi, np.pi, _TURNS, endpoint=False)
        turns = np.flatnonzero(self.turning)
        grids = np.stack(np.meshgrid(*[angles] * len(turns), indexing="ij"), axis=-1).reshape(-1, len(turns))
        starts = []
        for grid in grids:
            for side in (-1.0, 1.0):
                q = np.repeat(self.home[:, None], n, axis=1)
                q[turns] += grid[:, None]
                slides = np.flatnonzero(~self.turning)
                q[slides] += self._moved(B, q, slides) + 0.7 * side * self.scale
                starts.append(q)
        return starts

    def _moved(self, B: np.ndarray, q: np.ndarray, slides: np.ndarray) -> np.ndarray:
        """Return how far slides (s, N) must go so that the points are nearest to `B`."""
        joints, carried = self.numbers.joints, self.numbers.carried
        at, places = frames.compute_joint_frames(joints, q), frames.compute_points(joints, carried, q)
        columns = frames.compute_velocities(joints, carried, at, places)
        out = np.zeros((len(slides), q.shape[1]))
        for row, slide in enumerate(slides):
            column = columns.get((0, int(slide)))
            if column is not None:
                out[row] = np.sum(column * (B[0] - places[0]), axis=0) / np.sum(column**2, axis=0)
        return out


def build_chains(rods: Legs) -> list[RootChain | NewtonChain]:
    """Return a robot's chains, in the order of its first rods."""
    found: list[RootChain | NewtonChain] = []
    for own, actuators in rods.groups:
        single = len(actuators) == 1
        found.append(RootChain(rods, own, actuators[0]) if single else NewtonChain(rods, own, actuators))
    return found


def _cut(numbers: RodDimensions, own: tuple[int, ...], actuators: tuple[int, ...]) -> RodDimensions:
    """Return the dimensions of some rods, with joints and actuators renumbered."""
    rows = list(own)
    used = sorted({i for k in own for i in frames.list_path(numbers.joints, numbers.carried.carrier[k])})
    index = {-1: -1} | {old: new for new, old in enumerate(used)}
    number = {old: new for new, old in enumerate(actuators)} | {-1: -1}
    joints = tuple(
        numbers.joints[i]._replace(parent=index[numbers.joints[i].parent], actuator=number[numbers.joints[i].actuator])
        for i in used
    )
    return replace(
        numbers,
        names=tuple(numbers.names[k] for k in own),
        joints=joints,
        carried=Carried(tuple(index[numbers.carried.carrier[k]] for k in own), numbers.carried.local[rows]),
        lengths=numbers.lengths[rows],
        on_plate=numbers.on_plate[rows],
        slides=np.array([number[int(numbers.slides[k])] for k in own]),
        offsets=numbers.offsets[rows],
        gains=numbers.gains[rows],
        arms=(),
    )


def _solve(J: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return least-squares solutions (c, N) of `J x = b` with J (r, c, N)."""
    matrices, sides = J.transpose(2, 0, 1), b.T[:, :, None]
    if J.shape[0] == J.shape[1]:
        with np.errstate(all="ignore"):
            size = np.abs(matrices).max(axis=(1, 2), keepdims=True)
            regular = np.abs(np.linalg.det(matrices / np.where(size > 0, size, 1.0))) > 1e-12
        out = np.empty((len(matrices), J.shape[1], 1))
        out[regular] = np.linalg.solve(matrices[regular], sides[regular])
        out[~regular] = np.linalg.pinv(matrices[~regular], rcond=1e-9) @ sides[~regular]
        return out[:, :, 0].T
    return (np.linalg.pinv(matrices, rcond=1e-9) @ sides)[:, :, 0].T
