"""All assembly modes of a six-rod plate: every pose, real or complex, that its rods allow, each proven.

Forty paths lead from a stored general hexapod to the given one (`homotopy.py`). Each end is polished, proven to be a solution
and proven to differ from the others. No more than forty can exist, so a list of forty is complete. If the geometry is
special, paths end without a pose and fewer are found. If rods share points, the smaller count is known and proven; otherwise
each mode is proven but the count is not, and the result states this. The thesis' solver (4.5) returned all 80 = 2 x 40 in 16
of 50 poses.

The proof is a Newton-Kantorovich ball with all rounding errors counted. In the chart where the largest homogeneous coordinate
is 1, seven quadrics `F` in seven unknowns are left, and with an approximate inverse `Y` of the Jacobian

    |Y F(z)| <= a,   |1 - Y F'(z)| <= b,   |Y (F'(z + u) - F'(z))| <= c |u|   (largest entries),

`z -> z - Y F(z)` maps the ball of radius `r` into itself and contracts it if `a + b r + c r^2 / 2 <= r` and `b + c r < 1`.
The ball then contains exactly one solution, and it is regular. Balls are complex, so the solution in a real centre's ball is
real: its conjugate would be a second one. Floating-point sums are bounded by several times the usual `gamma_n` (Higham 2002,
ch. 3). Reference: Rump 2010, Acta Numerica 19, section 13; Breiding, Rose & Timme 2023, ACM TOMS 49(1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.equations import (
    N_SOLUTIONS,
    Hexapod,
    bound_magnitudes,
    bound_mode_count,
    build_quadrics,
    convert_to_poses,
    draw_general_hexapod,
    measure_residuals,
    normalise_hexapod,
    start_system,
)
from tau_dyn.kinematics.assembly.homotopy import is_nearly_null, track_homotopy

_GAMMA = 200 * np.finfo(float).eps
"""Relative rounding error of any sum here with fewer than 70 complex products, coefficients included."""


class Certificate(NamedTuple):
    """Proven properties of points (n, 8).

    Attributes:
        z: Points with their largest coordinate 1.
        radius: One solution is within this distance in each coordinate (n, 8); inf without a proof.
        relative: The same relative to the largest entry of `e` and that of `h` (n,).
        pose: The quaternion is not null, so the solution is a pose (n,).
        real: The solution is real (n,).
        complex: The solution is not real (n,).
    """

    z: np.ndarray
    radius: np.ndarray
    relative: np.ndarray
    pose: np.ndarray
    real: np.ndarray
    complex: np.ndarray

    def take(self, index: np.ndarray) -> Certificate:
        """Return those of some points."""
        return Certificate(*(values[index] for values in self))


def certify(Q: np.ndarray, size: np.ndarray, x: np.ndarray) -> Certificate:
    """Try to prove that each of the points is near one true solution.

    Args:
        Q: Seven real quadrics (7, 8, 8).
        size: Bounds on the terms summed up in them (7, 8, 8), `magnitudes`.
        x: Polished points (n, 8).
    """
    chart = np.argmax(np.abs(x), axis=1)
    z = x / np.take_along_axis(x, chart[:, None], 1)
    z[np.arange(len(z)), chart] = 1.0  # exactly
    scale = _scales(z)
    relative, _ = _balls(Q, size, z / scale, chart, scale)
    _, reach = _balls(Q, size, z.real / scale + 0j, chart, scale)
    proven, imaginary = np.isfinite(relative), np.abs(z.imag / scale).max(axis=1)
    radius = relative[:, None] * scale
    with np.errstate(invalid="ignore"):
        real = proven & (imaginary + relative <= reach)
        e, r = z[:, :4], radius[:, :4]
        open_ = (2 * r * np.abs(e) + r**2 + _GAMMA * np.abs(e) ** 2).sum(axis=1)
        pose = proven & (np.abs((e * e).sum(axis=1)) > open_)
    return Certificate(z, radius, relative, pose, real, proven & (imaginary > relative))


def select_distinct_balls(z: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return which balls (n, 8), (n, 8) hold a solution that no earlier ball holds, as homogeneous points.

    `z_i w_j - z_j w_i` vanishes if `z` and `w` are one point; it is compared with its uncertainty from the balls' radii.
    """
    i, j = np.triu_indices(8, 1)
    size = np.abs(z) + radius
    out = np.ones(len(z), dtype=bool)
    for k in range(1, len(z)):
        minors = np.abs(z[k, i] * z[:k, j] - z[k, j] * z[:k, i])
        open_ = (
            radius[k, i] * size[:k, j]
            + radius[k, j] * size[:k, i]
            + radius[:k, j] * size[k, i]
            + radius[:k, i] * size[k, j]
        )
        rounding = _GAMMA * (size[k, i] * size[:k, j] + size[k, j] * size[:k, i])
        out[k] = (minors > open_ + rounding).any(axis=1).all()
    return out


def _scales(z: np.ndarray) -> np.ndarray:
    """Return units (n, 8) for `e` and for `h`: powers of two, so that scaling by them is exact."""
    largest = [np.abs(part).max(axis=1, keepdims=True) for part in (z[:, :4], z[:, 4:])]
    units = [2.0 ** np.ceil(np.log2(np.maximum(part, 1e-12))) for part in largest]
    return np.repeat(np.concatenate(units, axis=1), 4, axis=1)


def _balls(
    Q: np.ndarray, size: np.ndarray, z: np.ndarray, chart: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest proven radius (n,) about points in units `scale`; inf and 0 without a proof."""
    free = np.array([[j for j in range(8) if j != k] for k in range(8)])[chart]  # unknowns of each chart
    units = scale[:, None, :, None] * scale[:, None, None, :]
    Q, size = Q * units, size * units
    V, bound = np.einsum("nkij,nj->nki", Q, z), np.einsum("nkij,nj->nki", size, np.abs(z))
    F, F_error = np.einsum("nki,ni->nk", V, z), _GAMMA * np.einsum("nki,ni->nk", bound, np.abs(z))
    J, J_error = 2 * _columns(V, free), 2 * _GAMMA * _columns(bound, free)
    curved = 2 * _columns((np.abs(Q) + _GAMMA * size).sum(axis=3), free).sum(axis=2)
    with np.errstate(all="ignore"):
        Y = _inverses(J)
        Y_size = np.abs(Y)
        a = _largest(Y_size @ (np.abs(F) + F_error)[..., None])
        b = _largest(np.abs(np.eye(7) - Y @ J) + _GAMMA * Y_size @ np.abs(J) + Y_size @ J_error)
        c = _largest(Y_size @ curved[..., None])
        root = np.sqrt((1 - b) ** 2 - 2 * a * c)
        smallest, largest = 2 * a / (1 - b + root), 0.999 * (1 - b) / c
        smallest = 1.001 * smallest + 1e-300
        good = (b < 0.5) & (root > 0) & (smallest < largest)
        good &= (a + b * smallest + 0.5 * c * smallest**2 <= smallest) & (
            a + b * largest + 0.5 * c * largest**2 <= largest
        )
    return np.where(good, smallest, np.inf), np.where(good, largest, 0.0)


def _columns(matrices: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Return the columns (n, 7, 7) of the unknowns of matrices (n, 7, 8)."""
    return np.take_along_axis(matrices, free[:, None], 2)


def _largest(matrices: np.ndarray) -> np.ndarray:
    """Return the largest sum of a row (n,), rounded up."""
    return (1 + _GAMMA) * matrices.sum(axis=2).max(axis=1)


def _inverses(J: np.ndarray) -> np.ndarray:
    """Return approximate inverses; zero for singular matrices, with which every proof fails."""
    Y = np.zeros_like(J)
    for k, matrix in enumerate(J):
        try:
            Y[k] = np.linalg.inv(matrix)
        except np.linalg.LinAlgError:
            continue
    return Y


@dataclass(frozen=True, eq=False)
class AssemblyModes:
    """Poses of a plate that fit its rods; m of them, at most 40, real ones first, then by position.

    Attributes:
        position: Origin of the plate's frame (m, 3) [m], complex.
        quaternion: x, y, z, w with `q . q = 1` (m, 4), complex; each pose once, its sign chosen so that w (or the first that is
            not zero of w, x, y, z) has a positive real part.
        rotation: Rotation matrices (m, 3, 3), complex.
        real: Proven to be real (m,).
        residual: Largest error of a rod's length at these numbers (m,) [m].
        radius: A true solution is proven to be within this relative distance of the homogeneous point `e, h` (m,).
        n_no_pose: Paths that ended at infinity, at no pose, or too far away for a decision.
        n_singular: Paths that ended in a double solution, on a continuum of poses, or too near to either for a decision.
        certified: m is proven to be the number of isolated modes, real ones are proven to be real, and the others not to be.
        why: Reason why it is certified, or not.
    """

    position: np.ndarray
    quaternion: np.ndarray
    rotation: np.ndarray
    real: np.ndarray
    residual: np.ndarray
    radius: np.ndarray
    n_no_pose: int
    n_singular: int
    certified: bool
    why: str

    @property
    def n_real(self) -> int:
        """Number of real modes: the ways in which the robot can be assembled."""
        return int(self.real.sum())


def find_assembly_modes(base_points: np.ndarray, plate_points: np.ndarray, lengths: np.ndarray) -> AssemblyModes:
    """Find all poses in which six rods of given lengths hold a plate (thesis 4.34 to 4.37).

    Args:
        base_points: A (6, 3) [m].
        plate_points: B in the plate's frame (6, 3) [m].
        lengths: L (6,) [m].

    Raises:
        InputError: Wrong shapes, numbers that are not finite, or a length that is not positive.
    """
    A, B, L = _checked(base_points, plate_points, lengths)
    hexapod, gauge = normalise_hexapod(A, B, L)
    Q, size = build_quadrics(hexapod), bound_magnitudes(hexapod, L / gauge.scale)
    found, n_no_pose, n_singular = _search(hexapod, Q, size)
    position, e, rotation = _poses(A, B, L, found.z)
    position, rotation = _real_where_proven(position, found.real), _real_where_proven(rotation, found.real)
    e = _real_where_proven(_one_sign(e), found.real)
    order = np.lexsort([*np.round(position.real.T[::-1], 9), ~found.real])
    certified, why = _verdict(found, n_no_pose, n_singular, bound_mode_count(A, B))
    return AssemblyModes(
        position[order],
        e[order][:, [1, 2, 3, 0]],
        rotation[order],
        found.real[order],
        measure_residuals(A, B, L, position, rotation)[order],
        found.relative[order],
        n_no_pose,
        n_singular,
        certified,
        why,
    )


def _search(hexapod: Hexapod, Q: np.ndarray, size: np.ndarray) -> tuple[Certificate, int, int]:
    """Return proven, distinct poses, and the numbers of paths that ended without a pose and in a singular point.

    If some are missing, all paths are followed again by another route.
    """
    start, x = start_system()
    points, n_no_pose, n_singular = np.zeros((0, 8), complex), 0, 0
    for route, tolerance in enumerate((1e-5, 1e-9)):
        if route:  # a detour by another general hexapod, with shorter steps
            middle = draw_general_hexapod(np.random.default_rng(route))
            x, start = track_homotopy(start, middle, x, tolerance=tolerance).x, middle
        paths = track_homotopy(start, hexapod, x, tolerance=tolerance)
        ends = np.where(paths.regular[:, None], _polished(Q, paths.x).astype(complex), paths.x)
        missed = ~certify(Q, size, ends).pose
        n_no_pose = int((missed & is_nearly_null(ends)).sum())
        n_singular = int(missed.sum()) - n_no_pose
        points = np.concatenate([points, ends])
        found = _proven(Q, size, points)
        if len(found.z) + n_no_pose + n_singular < N_SOLUTIONS:
            pairs = np.concatenate([found.z, found.z.conj()])  # a real system's solutions come in pairs
            found = _proven(Q, size, pairs)
        if len(found.z) + n_no_pose + n_singular >= N_SOLUTIONS:
            break
    return found, n_no_pose, n_singular


def _proven(Q: np.ndarray, size: np.ndarray, points: np.ndarray) -> Certificate:
    """Keep points that are proven to be poses and proven to differ from those kept before."""
    found = certify(Q, size, points)
    found = found.take(found.pose)
    return found.take(select_distinct_balls(found.z, found.radius))


def _poses(A: np.ndarray, B: np.ndarray, L: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, quaternions and rotations, computed in extended precision if the machine supports it.

    A complex pose can be thousands of robot sizes away: its quaternion is nearly null, so its pose loses digits.
    """
    hexapod, gauge = normalise_hexapod(*(values.astype(np.longdouble) for values in (A, B, L)))
    position, e, rotation = convert_to_poses(_polished(build_quadrics(hexapod), z), gauge)
    return position.astype(complex), e.astype(complex), rotation.astype(complex)


def _polished(Q: np.ndarray, x: np.ndarray, n_steps: int = 3) -> np.ndarray:
    """Return points (n, 8) after Newton steps with the residual in extended precision, the Jacobian in the usual one."""
    fine, narrow = x.astype(np.clongdouble), Q.astype(float)
    for _ in range(n_steps):
        fine = fine / np.linalg.norm(fine, axis=1, keepdims=True)
        residual = np.einsum("nki,ni->nk", np.einsum("kij,nj->nki", Q, fine), fine).astype(complex)
        x = fine.astype(complex)
        J = np.concatenate([2 * np.einsum("kij,nj->nki", narrow, x), x.conj()[:, None]], axis=1)
        change = np.array([np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(J, _padded(residual), strict=True)])
        fine = fine - change.reshape(x.shape)
    return fine


def _padded(residual: np.ndarray) -> np.ndarray:
    return np.concatenate([residual, np.zeros((len(residual), 1))], axis=1)


def _real_where_proven(values: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Set an imaginary part to zero if it is proven to be zero but for rounding."""
    out = values.copy()
    out[real] = out[real].real
    return out


def _one_sign(e: np.ndarray) -> np.ndarray:
    """Choose one of `e` and `-e`: the first entry whose real part is not small is positive."""
    large = np.abs(e.real) > 1e-9 * np.abs(e).max(axis=1, keepdims=True)
    first = np.take_along_axis(e.real, np.argmax(large, axis=1)[:, None], 1)
    return np.where(first < 0, -e, e)


def _verdict(found: Certificate, n_no_pose: int, n_singular: int, most: int) -> tuple[bool, str]:
    """Return whether the list is proven to be complete, and the sentence."""
    n, n_unclear = len(found.z), int((~found.real & ~found.complex).sum())
    if n_unclear:
        return False, f"{n} modes are proven, but for {n_unclear} it is not proven whether they are real"
    if n == most:
        return True, f"{n} different modes are proven, and such rods have no more than {most} isolated ones"
    ends = (
        f"{n} modes are proven; of {N_SOLUTIONS} paths {n_no_pose} end at infinity and {n_singular} in singular points"
    )
    if n + n_no_pose + n_singular >= N_SOLUTIONS:
        return False, f"{ends}: either the geometry is special, with no known bound, or modes are too far away to prove"
    return False, f"{ends}, and {N_SOLUTIONS - n - n_no_pose - n_singular} were lost: more modes may exist"


def _checked(base: np.ndarray, plate: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return float arrays; the error names the array and its fault."""
    out = []
    for name, values, shape in (
        ("base points", base, (6, 3)),
        ("plate points", plate, (6, 3)),
        ("lengths", lengths, (6,)),
    ):
        array = np.asarray(values, dtype=float)
        if array.shape != shape:
            raise InputError("wrong_shape", f"assembly modes need {name} of shape {shape}; these have {array.shape}")
        if not np.isfinite(array).all():
            raise InputError("bad_sample", f"{name} must be finite numbers")
        out.append(array)
    if not (out[2] > 0).all():
        raise InputError(
            "invalid_value", f"rod lengths must be positive; rod {int(np.argmin(out[2])) + 1} has {out[2].min():g} m"
        )
    return out[0], out[1], out[2]
