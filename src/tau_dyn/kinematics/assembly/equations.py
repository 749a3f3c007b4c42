"""A six-rod plate as seven quadrics in eight homogeneous unknowns, and how many solutions they have.

With a quaternion `e` (scalar first) and `h` so that the plate's position is `T = vec(h e*) / |e|^2`, every rod's
closure `|T + R B - A|^2 = L^2` (thesis 4.34) times `|e|^2` is a quadratic form in `x = (e, h)`, and so is Study's
condition `e . h = 0`:

    K |e|^2 + |h|^2 + 2 e' L_A R_B e + 2 h' (R_B - L_A) e = 0,      K = |A|^2 + |B|^2 - L^2,

with the products of quaternions `L_A e = A e` and `R_B e = e B`. `x` and `c x` are the same pose, so both signs of a
quaternion count once: 40 points for the general hexapod, not 80. `e = 0` is a solution as well, but no pose. References:
Husty 1996 and Wampler 1996, Mechanism and Machine Theory 31, pp. 365 and 331.

`start.csv` holds a general complex hexapod with its 40 solutions. A straight line from general complex numbers to any real ones
meets no double solution before its end, with probability one, and every isolated solution is the end of a path (Morgan &
Sommese 1989, Appl. Math. Comput. 29, 123). Rods that end in one point of the plate, or of the base, leave fewer than 40:

- three in one point, two in another (3-2-1): three spheres meet in 2 points, and so does each next pair of distances: 8;
- three in one point (3-1-1-1): 2, then three quadrics in the quaternion's projective space, at most 8: 16;
- three pairs (2-2-2): 16 (Nanua, Waldron & Murthy 1990, IEEE Trans. Robotics and Automation 6, 438).

`experiments/assembly_modes.py` measures the same numbers on random points, and 32 for two pairs (2-2-1-1; Faugere &
Lazard 1995, Mechanism and Machine Theory 30, 765), which is not used here as a bound.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

_LEFT = np.zeros((3, 4, 4))  # left products by i, j, k
_LEFT[0, [0, 1, 2, 3], [1, 0, 3, 2]] = -1, 1, -1, 1
_LEFT[1, [0, 2, 3, 1], [2, 0, 1, 3]] = -1, 1, -1, 1
_LEFT[2, [0, 3, 1, 2], [3, 0, 2, 1]] = -1, 1, -1, 1
_RIGHT = np.zeros((3, 4, 4))
_RIGHT[0, [0, 1, 2, 3], [1, 0, 3, 2]] = -1, 1, 1, -1
_RIGHT[1, [0, 2, 3, 1], [2, 0, 1, 3]] = -1, 1, 1, -1
_RIGHT[2, [0, 3, 1, 2], [3, 0, 2, 1]] = -1, 1, 1, -1
_PURE = np.array([1.0, -1.0, -1.0, -1.0])  # conjugates a quaternion


class Hexapod(NamedTuple):
    """Six rods as numbers that the quadrics depend on; complex for a start system.

    Attributes:
        base: Points A (6, 3).
        plate: Points B in the plate's frame (6, 3).
        offset: `|A|^2 + |B|^2 - L^2` (6,).
    """

    base: np.ndarray
    plate: np.ndarray
    offset: np.ndarray

    def towards(self, other: Hexapod, t: float) -> Hexapod:
        """Return the hexapod at `t` of the straight line to another one."""
        return Hexapod(*(a + t * (b - a) for a, b in zip(self, other, strict=True)))


class Gauge(NamedTuple):
    """Shift and scale that bring a hexapod to size one: `A -> (A - base) / scale`, `B -> (B - plate) / scale`."""

    base: np.ndarray
    plate: np.ndarray
    scale: float


def normalise_hexapod(base: np.ndarray, plate: np.ndarray, lengths: np.ndarray) -> tuple[Hexapod, Gauge]:
    """Return the hexapod of real points (6, 3) and lengths (6,) [m] at size one, and how it got there."""
    a0, b0 = base.mean(axis=0), plate.mean(axis=0)
    A, B = base - a0, plate - b0
    scale = np.sqrt(np.mean((A**2).sum(axis=1) + (B**2).sum(axis=1) + lengths**2))
    A, B, L = A / scale, B / scale, lengths / scale
    return Hexapod(A, B, (A**2).sum(axis=1) + (B**2).sum(axis=1) - L**2), Gauge(a0, b0, scale)


def build_quadrics(hexapod: Hexapod) -> np.ndarray:
    """Return seven symmetric matrices (7, 8, 8): the first rod, the others minus the first, Study's condition.

    The differences have no `|h|^2`, which would dominate the other terms if a pose is far away and `e` is small.
    """
    left = np.tensordot(hexapod.base, _LEFT, 1)
    right = np.tensordot(hexapod.plate, _RIGHT, 1)
    Q = np.zeros((7, 8, 8), dtype=np.result_type(left, right))
    Q[:6, :4, :4] = hexapod.offset[:, None, None] * np.eye(4) + 2 * left @ right
    Q[:6, 4:, :4] = right - left
    Q[:6, :4, 4:] = np.swapaxes(right - left, 1, 2)
    Q[1:6] -= Q[0]
    Q[0, 4:, 4:] = np.eye(4)
    Q[6, :4, 4:] = Q[6, 4:, :4] = 0.5 * np.eye(4)
    return Q


def bound_magnitudes(hexapod: Hexapod, lengths: np.ndarray) -> np.ndarray:
    """Return bounds (7, 8, 8) on every term of the sums in `build_quadrics`; rounding errors are relative to them."""
    A, B = np.abs(hexapod.base), np.abs(hexapod.plate)
    left, right = np.tensordot(A, np.abs(_LEFT), 1), np.tensordot(B, np.abs(_RIGHT), 1)
    offset = (A**2).sum(axis=1) + (B**2).sum(axis=1) + lengths**2
    Q = np.zeros((7, 8, 8))
    Q[:6, :4, :4] = offset[:, None, None] * np.eye(4) + 2 * left @ right
    Q[:6, 4:, :4] = Q[:6, :4, 4:] = left + right
    Q[1:6] += Q[0]
    Q[0, 4:, 4:] = np.eye(4)
    Q[6, :4, 4:] = Q[6, 4:, :4] = 0.5 * np.eye(4)
    return Q


def convert_to_poses(x: np.ndarray, gauge: Gauge) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (n, 3) [m], quaternions (n, 4) scalar first with `e . e = 1`, and rotations (n, 3, 3), all complex."""
    e, h = x[:, :4], x[:, 4:]
    norm = np.sqrt((e * e).sum(axis=1, keepdims=True) + 0j)
    e, h = e / norm, h / norm
    R = convert_to_rotations(e)
    T = multiply_quaternions(h, e * _PURE)[:, 1:] * gauge.scale
    return T + gauge.base - R @ gauge.plate, e, R


def multiply_quaternions(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return products (n, 4) of quaternions, scalar first."""
    return a[:, :1] * b + np.einsum("nk,kij,nj->ni", a[:, 1:], _LEFT, b)


def convert_to_rotations(e: np.ndarray) -> np.ndarray:
    """Return rotation matrices (n, 3, 3) of quaternions (n, 4), scalar first, `e . e = 1`."""
    left = np.einsum("nk,kij->nij", e[:, 1:], _LEFT) + e[:, :1, None] * np.eye(4)
    right = np.einsum("nk,kij->nij", -e[:, 1:], _RIGHT) + e[:, :1, None] * np.eye(4)
    return (left @ right)[:, 1:, 1:]


def measure_residuals(
    base: np.ndarray, plate: np.ndarray, lengths: np.ndarray, T: np.ndarray, R: np.ndarray
) -> np.ndarray:
    """Return the largest error (n,) of a rod's length [m] at complex poses; the length is the root of `d . d`."""
    d = T[:, None] + np.einsum("nij,kj->nki", R, plate) - base
    found = np.sqrt((d * d).sum(axis=2).astype(complex))  # principal root: its real part is not negative, as L
    return np.abs(found - lengths).max(axis=1)


N_SOLUTIONS = 40
"""Isolated solutions of the general hexapod: Ronga & Vust 1995, Lazard 1993, Mourrain 1993; an upper bound: Wampler 1996."""

START_FILE = Path(__file__).with_name("start.csv")


@lru_cache(maxsize=1)
def start_system() -> tuple[Hexapod, np.ndarray]:
    """Return the stored hexapod and its solutions (40, 8)."""
    lines = [
        line.split(",") for line in START_FILE.read_text(encoding="utf-8").splitlines() if not line.startswith("#")
    ]
    rods, solutions = (
        np.array([row[1:] for row in lines if row[0] == kind], float).view(complex) for kind in ("rod", "solution")
    )
    return Hexapod(rods[:, :3], rods[:, 3:6], rods[:, 6]), solutions


def draw_general_hexapod(rng: np.random.Generator) -> Hexapod:
    """Draw a complex hexapod of size one."""
    return Hexapod(draw_normal(rng, 6, 3), draw_normal(rng, 6, 3), draw_normal(rng, 6))


def draw_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw complex numbers of mean square one."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


_BOUNDS = {(3, 2, 1): 8, (3, 1, 1, 1): 16, (2, 2, 2): 16}


def count_shared_ends(points: np.ndarray) -> tuple[int, ...]:
    """Return how many rods end in each point of (6, 3), most first; only exactly equal points count as one."""
    return tuple(sorted(np.unique(points, axis=0, return_counts=True)[1].tolist(), reverse=True))


def bound_mode_count(base: np.ndarray, plate: np.ndarray) -> int:
    """Return a proven bound on the number of isolated modes of rods between points (6, 3)."""
    return min(_BOUNDS.get(count_shared_ends(points), N_SOLUTIONS) for points in (base, plate))
