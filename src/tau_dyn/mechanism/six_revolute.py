r"""All inverse solutions of a chain of six turning joints, by elimination to an eigenvalue problem (Raghavan & Roth 1990).

With `R_k` the turn of joint k about its z axis and `G_k` the constant placements between, tool and pose included, the loop is

    R_3 G_4 R_4 G_5 R_5 G_6  =  G_3^-1 R_2^-1 G_2^-1 R_1^-1 G_1^-1 R_6^-1

Joint 6 leaves its own axis in place: a point `p` on it and its direction `l` give 14 equations free of `q_6`,

    p,   l,   p x l,   (p . p) l - 2 (p . l) p,   p . p,   p . l

whose right sides are linear in eight products of sines and cosines of `q_1`, `q_2`. The orthogonal complement of those leaves
six equations in the nine products of `q_4`, `q_5`, linear in the sine and cosine of `q_3`. Here all are written in
`w = exp(i q)`: real angles lie on the unit circle, `q = pi` needs no special case, and the factor `(1 + x^2)^4` of the
half-angle form has its roots at 0 and infinity. The equations and those times `w_4` are a matrix polynomial of 12 rows,
`(A w^2 + B w + C) m = 0`, with 24 eigenvalues (Manocha & Canny 1994). Where it is regular, every solution is among them; the
rest is bookkeeping: each eigenvalue that may lie on the circle must give its solutions or be shown to have no solution. Any
joint may be taken as the third: the loop has no first joint, and where special axes make one polynomial singular another is
regular.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

_ANGLES = 2 * np.pi / 3 * np.arange(3)  # [rad] where functions of harmonics -1, 0, 1 are sampled
_ORDER = [2, 0, 1]  # of the discrete Fourier transform, so that harmonics run from -1 to 1
_RANK = 1e-7  # singular values below this, relative to the largest, are those of axes that are special up to a file's digits
_REGULAR = 1e6  # smallest singular value at a random w by the coefficients' error; less is singular
_NULL, _NOT_NULL = 1e-7, 1e-5  # relative singular values: below, a solution; above, no solution; between, doubt
_EXACT = 1e-12  # error of the coefficients up to which eigenvalues prove anything
_SHARP = 1e4  # times the coefficients' error: separates products from noise to 1e-4
_BAND = 1e-4  # of log |w|: eigenvalues nearer to the circle must be explained; rounding moves simple roots by 1e-10
_TOGETHER = 1e-6  # eigenvalues nearer to each other are looked at together
_ROUNDING = 1e-13  # of the polynomial relative to its size, from which an eigenvalue's error follows
_SPREAD = 1e8  # condition number above which directions of a null space cannot be separated
_PRODUCT_TOLERANCE = 1e-5  # relative error by which products of a null space may miss being such
_POINT = 1e-9  # [m] lengths of an arm whose axes all meet
_OPEN = 1e-2  # of a loop relative to the arm's size: larger gaps exclude candidates of real solutions
_ONE_EQUATION = 1e-4  # singular value relative to the largest; less, and an equation's rounding is too much to use it
_ON_AXIS = [2, 5, 8, 11, 12, 13]  # of the 14 numbers, those that a turn about z leaves

MAX_SOLUTIONS = 16
"""Isolated solutions that six turning joints can have."""


class Candidates(NamedTuple):
    """The result of one elimination.

    Attributes:
        q: Rows of angles near all real solutions (m, 6) [rad]; two may lead to the same one.
        needed: Number of real solutions below which some are missing.
        doubt: Why solutions may be missing, '' if the rows are complete.
    """

    q: np.ndarray
    needed: int
    doubt: str


class _Polynomial(NamedTuple):
    """Coefficients of w^0, w^1, w^2 with joint `first + 3` as the third.

    Attributes:
        first: Index of the joint that is taken as the first.
        G: Placements from there (6, 4, 4), lengths relative to the longest.
        tall: Coefficients of all equations (3, rows, 12).
        square: Coefficients of twelve combinations of them (3, 12, 12).
        error: Error of the coefficients, relative to their size.
        regular: Smallest singular value relative to the largest; zero for a singular polynomial.
    """

    first: int
    G: np.ndarray
    tall: np.ndarray
    square: np.ndarray
    error: float
    regular: float


def eliminate(G: np.ndarray) -> Iterator[Candidates]:
    """Yield candidates of all real solutions of `R_1 G[1] R_2 G[2] .. R_6 G[0] = 1`, the best conditioned elimination first.

    Args:
        G: Placements (6, 4, 4): of joint k + 1 in joint k's frame [m], `G[0]` of the first in the last one's.
    """
    built = sorted((_build_polynomial(G, first) for first in range(6)), key=lambda P: -P.regular / P.error)
    for P in built:
        if P.regular >= _REGULAR * P.error:
            yield _solve(P)


def _solve(P: _Polynomial) -> Candidates:
    groups, doubt = _find_on_circle(P)
    if P.error > _EXACT:
        doubt = "axes are special up to a file's digits only"
    found: list[np.ndarray] = []
    needed = 0
    for w, multiplicity in groups:
        pairs, why = _solve_products(_at(P.tall, w), multiplicity, P.error)
        doubt = doubt or why
        if not pairs and not why and P.tall.shape == P.square.shape:
            doubt = doubt or "an eigenvalue gives no solution"
        for pair in pairs:
            all_rows, why = _complete(P.G, np.angle([w, *pair]))
            rows = [q for q in all_rows if _measure_gap(P.G, q) < _OPEN]
            doubt = (
                doubt or why or ("the angles of an eigenvalue do not close the loop" if all_rows and not rows else "")
            )
            needed += bool(rows)
            found += rows
    return Candidates(np.roll(np.array(found).reshape(-1, 6), P.first, axis=1), needed, doubt)


def _measure_gap(G: np.ndarray, q: np.ndarray) -> float:
    X = np.eye(4)
    for turn, placement in zip(_turn(q), np.roll(G, -1, axis=0), strict=True):
        X = X @ turn @ placement
    return float(np.abs(X - np.eye(4)).max())


def _build_polynomial(G: np.ndarray, first: int) -> _Polynomial:
    G = np.roll(G, -first, axis=0)
    size = np.linalg.norm(G[:, :3, 3], axis=1).max()
    G[:, :3, 3] /= size if size > _POINT else 1.0
    turns = _turn(_ANGLES)
    tail = G[3] @ turns[:, None] @ G[4] @ turns[None] @ G[5]
    left = _invariants(turns[:, None, None] @ tail[None])
    head = np.linalg.inv(G[2]) @ turns[None].swapaxes(-1, -2) @ np.linalg.inv(G[1]) @ turns[:, None].swapaxes(-1, -2)
    right = _invariants(head @ np.linalg.inv(G[0]))
    L = np.fft.fftn(left, axes=(1, 2, 3))[:, _ORDER][:, :, _ORDER][:, :, :, _ORDER] / 27
    R = np.fft.fftn(right, axes=(1, 2))[:, _ORDER][:, :, _ORDER].reshape(14, 9) / 9
    L[:, 1, 1, 1] -= R[:, 4]
    u, s, _ = np.linalg.svd(np.delete(R, 4, axis=1))
    rank = int(np.sum(s > _RANK * s[0]))
    six = np.tensordot(u[:, rank:].conj().T, L, axes=1)
    tall, square = _times_w4(six), _times_w4(np.tensordot(_mix(len(six)), six, axes=1))
    tried = [np.linalg.svd(_at(square, np.exp(1j * angle)), compute_uv=False) for angle in (0.3, 1.7, 4.1)]
    error = _ROUNDING + float(s[rank:].max(initial=0.0) / max(s[0], 1e-300))
    return _Polynomial(first, G, tall, square, error, float(min(s[-1] / s[0] for s in tried)))


def _mix(rows: int) -> np.ndarray:
    """Return six combinations (6, rows) of more equations, at random but the same every time."""
    if rows == 6:
        return np.eye(6)
    return np.linalg.qr(np.random.default_rng(rows).standard_normal((rows, rows)))[0][:6]


def _times_w4(six: np.ndarray) -> np.ndarray:
    """Return the coefficients (3, 2 rows, 12) of equations (rows, 3, 3, 3) and of those times w_4."""
    out = np.zeros((3, 2, len(six), 4, 3), complex)
    coefficients = six.swapaxes(0, 1)
    out[:, 0, :, :3], out[:, 1, :, 1:] = coefficients, coefficients
    return out.reshape(3, 2 * len(six), 12)


def _invariants(X: np.ndarray) -> np.ndarray:
    """Return the 14 left or right sides (14, ...) of frames (..., 4, 4) whose z axis is joint 6's."""
    p, line = X[..., :3, 3], X[..., :3, 2]
    pp, pl = np.sum(p * p, axis=-1, keepdims=True), np.sum(p * line, axis=-1, keepdims=True)
    parts = [p, line, np.cross(p, line), pp * line - 2 * pl * p, pp, pl]
    return np.moveaxis(np.concatenate(parts, axis=-1), -1, 0)


def _find_on_circle(P: _Polynomial) -> tuple[list[tuple[complex, int]], str]:
    """Return eigenvalues near the unit circle with the multiplicity of each, and a doubt about the others."""
    from scipy.linalg import eig

    zero, one, C = np.zeros((12, 12)), np.eye(12), P.square
    A, B = np.block([[zero, one], [-C[0], -C[1]]]), np.block([[one, zero], [zero, C[2]]])
    alpha, beta = np.asarray(eig(A, B, right=False, homogeneous_eigvals=True))
    with np.errstate(all="ignore"):
        off = np.abs(np.log(np.abs(alpha)) - np.log(np.abs(beta)))
        w, off = (alpha / beta)[off < 1], off[off < 1]
    u, s, vh = np.linalg.svd(_at(C[:, None], w[:, None, None]))
    rate = C[1] + 2 * w[:, None, None] * C[2]
    slope = np.abs(np.einsum("ni,nij,nj->n", u[:, :, -1].conj(), rate, vh[:, -1].conj()))
    unclear = (off >= _BAND) & (P.error * s[:, 0] > 0.1 * slope * off)
    left, groups = list(w[off < _BAND]), []
    while left:
        near = [x for x in left if abs(x - left[0]) < _TOGETHER]
        left = [x for x in left if abs(x - left[0]) >= _TOGETHER]
        groups.append((complex(np.mean(near)), len(near)))
    return groups, "an eigenvalue is too sensitive to be separated from a real one" if unclear.any() else ""


def _solve_products(P: np.ndarray, multiplicity: int, error: float) -> tuple[list[tuple[complex, complex]], str]:
    """Return the pairs (w_4, w_5) on the unit circle whose products w_4^i w_5^j (12,) the matrix annihilates, and a doubt.

    In a null space of several directions the products are those that multiplying by w_4, and by w_5, only scales.
    """
    _, s, vh = np.linalg.svd(P)
    n = int(np.sum(s < _NULL * s[0]))
    unclear = (s >= _NULL * s[0]) & (s < max(_NOT_NULL, _SHARP * error) * s[0])
    doubt = "an eigenvalue is close to others" if unclear.any() else ""
    if n == 0:
        return [], doubt
    N = vh[-n:].conj().T.reshape(4, 3, n)
    a, b, c, d, mix = np.exp(1j * np.array([0.4, 2.9, 1.3, 5.2, 0.9]))  # no solution is at the root of c w + d
    whole = np.zeros((n, n), complex)
    for low, high, share in ((N[:-1], N[1:], 1.0), (N[:, :-1], N[:, 1:], mix)):
        over, under = (a * high + b * low).reshape(-1, n), (0.7 * c * high + d * low).reshape(-1, n)
        if np.linalg.cond(under) > _SPREAD:
            return [], "solutions of one angle are not separated"
        scaled = np.linalg.lstsq(under, over, rcond=None)[0]
        if n > 1 and np.abs(under @ scaled - over).max() > _PRODUCT_TOLERANCE:
            doubt = doubt or "an eigenvalue's null space is not made of solutions"
        whole += share * scaled
    _, vectors = np.linalg.eig(whole)
    if np.linalg.cond(vectors) > _SPREAD:
        doubt = doubt or "solutions of one angle are not separated"
    pairs = []
    for k in range(n):
        m = (N @ vectors[:, k]) / np.linalg.norm(N @ vectors[:, k])
        w4, w5 = (np.vdot(x, y) / max(np.vdot(x, x).real, 1e-300) for x, y in ((m[:-1], m[1:]), (m[:, :-1], m[:, 1:])))
        if max(abs(abs(w4) - 1), abs(abs(w5) - 1)) < 1e-2:
            pairs.append((w4, w5))
    if multiplicity > n:
        doubt = doubt or "an eigenvalue is multiple"
    return pairs, doubt


def _complete(G: np.ndarray, q345: np.ndarray) -> tuple[list[np.ndarray], str]:
    """Return rows of six angles with these of joints 3 to 5, no rows if joint 2's angle is complex, and a doubt.

    The components that joint 1 leaves in place are linear in the cosine and sine of joint 2's angle.
    """
    R3, R4, R5 = _turn(q345)
    tail = G[2] @ R3 @ G[3] @ R4 @ G[4] @ R5 @ G[5]
    at = np.fft.fft(_invariants(G[1] @ _turn(_ANGLES) @ tail)[_ON_AXIS], axis=1) / 3
    wanted = _invariants(np.linalg.inv(G[0]))[_ON_AXIS]
    A, b = np.column_stack([2 * at[:, 1].real, -2 * at[:, 1].imag]), wanted - at[:, 0].real
    u, s, vh = np.linalg.svd(A, full_matrices=False)
    if s[0] < _ONE_EQUATION:
        return [], "an angle is free"
    x = u.T @ b / s
    seconds, size, why = [vh.T @ x], float(np.hypot(*x)), ""
    if s[1] < _ONE_EQUATION * s[0]:  # one equation: two angles
        height, size = np.sqrt(max(1 - x[0] ** 2, 0.0)), max(abs(float(x[0])), 1.0)
        why = "two solutions are too close to each other" if height < _OPEN else ""
        seconds = [vh.T @ [x[0], side * height] for side in (1, -1)]
    if abs(size - 1) > _OPEN:
        return [], ""
    rows = []
    for cosine, sine in seconds:
        q2 = np.arctan2(sine, cosine)
        here, there = G[1] @ _turn(q2) @ tail, np.linalg.inv(G[0])
        # R_1 here R_6 = there: joint 1 from directions and points of joint 6's axis, joint 6 from the remaining rotation
        a, b = (_plane(X) for X in (here, there))
        q1 = np.angle(np.vdot(a, b))
        last = (_turn(q1) @ here)[:3, :3].T @ there[:3, :3]
        rows.append(np.array([q1, q2, *q345, np.arctan2(last[1, 0] - last[0, 1], last[0, 0] + last[1, 1])]))
    return rows, why


def _plane(X: np.ndarray) -> np.ndarray:
    """Return x + i y of the vectors among the 14 numbers (4,)."""
    vectors = _invariants(X)[:12].reshape(4, 3)
    return vectors[:, 0] + 1j * vectors[:, 1]


def _turn(angle: np.ndarray | float) -> np.ndarray:
    """Return turns (..., 4, 4) about z."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.zeros((*np.shape(angle), 4, 4))
    out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = c, -s, s, c
    out[..., 2, 2] = out[..., 3, 3] = 1.0
    return out


def _at(P: np.ndarray, w: complex) -> np.ndarray:
    return P[0] + w * P[1] + w**2 * P[2]
