"""The largest displacement that errors within their bounds can cause: to first order, with the constraints solved, and drawn.

To first order the tool moves by `H e = sum_s H_s e_s` with every source `|e_s| <= 1`. Its largest length is

    max_e |H e| = max_{|c| = 1} sum_s |H_s' c|,

reached at `e_s = H_s' c / |H_s' c|`. For three rods with independent errors this set is A.4's parallelepiped and `c` points
along one of its four diagonals; rods that share a cart round it off. The right side is convex in `c`, so the iteration
`c <- H e(c)` increases it. It starts at every diagonal, which makes it exact if every source belongs to one rod, and in 13
more directions otherwise. The same iteration with the constraints solved at every step gives the true worst case; if the
error sets are small compared with the rods this is the corner of the curved body S^T of A.2. Monte Carlo draws errors at
random within their bounds and solves the constraints for each draw.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from tau_dyn.kinematics.accuracy.device import Device, State

MAX_ITERATIONS = 12
"""Steps to first order; each doubles the digits of a direction that is not yet a corner."""
CLOSED_CLIMBS = 4  # fixed-point steps from each corner; the first two do nearly all
MAX_SIGNED_RODS = 6
"""Rods up to which every combination of signs is tried."""
MAX_CORNERS = 8
"""Corners that are followed with the constraints solved, the farthest to first order."""


class Worst(NamedTuple):
    """A largest displacement.

    Attributes:
        size: Size (N,) [m or rad]; nan if the robot has no pose on its branch at some corner of the errors.
        e: The errors that cause it (N, m).
        direction: Its direction (N, 3).
    """

    size: np.ndarray
    e: np.ndarray
    direction: np.ndarray


def bound_first_order(H: np.ndarray, balls: tuple[slice, ...], own: bool) -> tuple[Worst, np.ndarray]:
    """Return the largest `|H e|` and all corners tried.

    Args:
        H: Sensitivity (N, 3, m) [m or rad a unit].
        balls: Sources, each within its unit ball.
        own: Whether each column pair of a rod points one way, so that signs alone give every corner.

    Returns:
        The worst case, and the corners `e` (N, S, m), farthest first.
    """
    c = _starts(H, balls, own)
    e = _aligned(H, c, balls)
    for _ in range(MAX_ITERATIONS):
        moved = np.einsum("Nam,Nsm->Nsa", H, e)
        e = _aligned(H, moved, balls)
    moved = np.einsum("Nam,Nsm->Nsa", H, e)
    size = np.linalg.norm(moved, axis=2)
    order = np.argsort(-size, axis=1, kind="stable")
    corners = np.take_along_axis(e, order[:, :, None], axis=1)
    best = np.take_along_axis(moved, order[:, :1, None], axis=1)[:, 0]
    return Worst(np.linalg.norm(best, axis=1), corners[:, 0], _unit(best)), corners


def _aligned(H: np.ndarray, c: np.ndarray, balls: tuple[slice, ...]) -> np.ndarray:
    """Return the errors (N, S, m) that move the tool farthest along directions `c` (N, S, 3)."""
    along = np.einsum("Nam,Nsa->Nsm", H, c)
    out = np.empty_like(along)
    for ball in balls:
        out[..., ball] = _unit(along[..., ball])
    return out


def _starts(H: np.ndarray, balls: tuple[slice, ...], own: bool) -> np.ndarray:
    """Return start directions (N, S, 3): the diagonals of sign combinations, and others if rods share sources."""
    main = [_main_direction(H[:, :, ball]) for ball in balls]
    groups = _parallel_groups(main)
    starts = []
    if len(groups) <= MAX_SIGNED_RODS:
        sums = np.stack(
            [sum(main[i] * np.sign((main[i] * main[g[0]]).sum(1, keepdims=True)) for i in g) for g in groups], 1
        )
        signs = np.array([(1, *s) for s in product((1, -1), repeat=len(groups) - 1)], float)
        starts.append(np.einsum("sg,Nga->Nsa", signs, sums))
    if not own or len(groups) > MAX_SIGNED_RODS:
        cube = np.array([v for v in product((-1, 0, 1), repeat=3) if v > (0, 0, 0)], float)
        starts.append(np.broadcast_to(cube, (len(H), *cube.shape)))
    return np.concatenate(starts, axis=1)


def _main_direction(H: np.ndarray) -> np.ndarray:
    """Return the longest semi-axis (N, 3) of each source's set `H_s e_s`."""
    u, s, _ = np.linalg.svd(np.nan_to_num(H), full_matrices=False)
    return u[:, :, 0] * s[:, :1]


def _parallel_groups(main: list[np.ndarray]) -> list[list[int]]:
    """Return sources whose main directions are parallel at every pose: those of one rod."""
    groups: list[list[int]] = []
    for i, v in enumerate(main):
        for group in groups:
            w = main[group[0]]
            off = np.linalg.norm(np.cross(v, w), axis=1)
            if np.all(off <= 1e-9 * np.linalg.norm(v, axis=1) * np.linalg.norm(w, axis=1)):
                group.append(i)
                break
        else:
            groups.append([i])
    return groups


def solve_worst_case(device: Device, state: State, corners: np.ndarray, *, part: slice = slice(0, 3)) -> Worst:
    """Return the largest displacement with all constraints solved.

    Args:
        device: The robot with its errors.
        state: Poses (N).
        corners: Errors to start from (N, S, m), farthest first; their negatives are tried too.
        part: Rows of the sensitivity: the first three for the tool's position, the last three for its orientation.
    """
    best = Worst(np.zeros(len(state)), np.zeros((len(state), device.m)), np.zeros((len(state), 3)))
    lost = np.zeros(len(state), bool)
    for corner in range(min(corners.shape[1], MAX_CORNERS // 2)):
        for sign in (1.0, -1.0):
            found, fell = _climb(device, state, sign * corners[:, corner], part)
            lost |= fell
            farther = found.size > best.size
            best = Worst(
                *(np.where(farther.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(found, best, strict=True))
            )
    return best._replace(size=np.where(lost, np.nan, best.size))


def _climb(device: Device, state: State, e: np.ndarray, part: slice) -> tuple[Worst, np.ndarray]:
    """Return the largest displacement found from errors `e` (N, m), and which poses lost their branch on the way."""
    best = Worst(np.zeros(len(e)), e, np.zeros((len(e), 3)))
    lost = np.zeros(len(e), bool)
    for _ in range(CLOSED_CLIMBS):
        moved = device.closed(state, e)
        lost |= ~moved.ok
        d = np.where(moved.ok[:, None], moved.shift if part.start == 0 else moved.turn, 0.0)
        size = np.linalg.norm(d, axis=1)
        farther = size > best.size * (1 + 1e-12)
        best = Worst(np.where(farther, size, best.size), np.where(farther[:, None], e, best.e),
                     np.where(farther[:, None], _unit(d), best.direction))  # fmt: skip
        if not farther.any():
            break
        e = _aligned(device.sensitivity(state, moved.plate, e)[:, part], d[:, None], device.balls)[:, 0]
    return best, lost


def _unit(v: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, size, out=np.zeros_like(v), where=size > 0)


BLOCK = 20_000
"""Poses solved at once."""


class Draws(NamedTuple):
    """Effect of random errors at each pose, in metres; `turn_` in radians.

    Attributes:
        largest: Largest displacement drawn (N,).
        usual: 95 % quantile of the displacement (N,).
        mean: Mean displacement (N,).
        turn_largest: Largest change of orientation drawn (N,) [rad].
        lost: Share of the draws for which the robot has no pose on its branch (N,).
    """

    largest: np.ndarray
    usual: np.ndarray
    mean: np.ndarray
    turn_largest: np.ndarray
    lost: np.ndarray


def draw(balls: tuple[slice, ...], m: int, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return errors (*shape, m), each source uniform in its unit ball."""
    e = np.empty((*shape, m))
    for ball in balls:
        size = ball.stop - ball.start
        normal = rng.standard_normal((*shape, size))
        radius = rng.random((*shape, 1)) ** (1 / size)
        e[..., ball] = radius * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return e


def monte_carlo(device: Device, state: State, samples: int, seed: int) -> Draws:
    """Return statistics of `samples` draws at every pose, with the same draws at all poses.

    The same draws make a map smooth and cheap, and poses comparable.
    """
    e = draw(device.balls, device.m, (samples,), np.random.default_rng(seed))
    rows = [_draw_at(device, state.take(slice(i, i + step)), e)
            for step in [max(1, BLOCK // samples)] for i in range(0, len(state), step)]  # fmt: skip
    return Draws(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _draw_at(device: Device, state: State, e: np.ndarray) -> Draws:
    n, k = len(state), len(e)
    moved = device.closed(state.take(np.repeat(np.arange(n), k)), np.tile(e, (n, 1)))
    size, turn = (np.linalg.norm(x, axis=1).reshape(n, k) for x in (moved.shift, moved.turn))
    lost = np.mean(~moved.ok.reshape(n, k), axis=1)
    whole = lost == 0
    size, turn = np.where(whole[:, None], size, np.nan), np.where(whole[:, None], turn, np.nan)
    return Draws(size.max(axis=1), np.quantile(size, 0.95, axis=1), size.mean(axis=1), turn.max(axis=1), lost)
