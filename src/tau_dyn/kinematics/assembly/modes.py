r"""All assembly modes of a six-rod plate: every pose, real or complex, that its rods allow.

Forty paths lead from a stored general hexapod to the given one (`tracking`). Each end is polished, proven to be a
solution and proven to differ from the others (`certificate`). Forty of them are all there can be, so the list is then
complete. Where the geometry is special, paths end without a pose and fewer are found. Where rods share points the
smaller count is known and proven (`counts`); elsewhere each mode is proven but the count is not, and the result says
so. The thesis' solver (4.5) returned all 80 = 2 x 40 in 16 of 50 poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly.certificate import Certificate, certify, select_distinct_balls
from tau_dyn.kinematics.assembly.counts import bound_mode_count
from tau_dyn.kinematics.assembly.equations import (
    Hexapod,
    bound_magnitudes,
    build_quadrics,
    convert_to_poses,
    measure_residuals,
    normalise_hexapod,
)
from tau_dyn.kinematics.assembly.homotopy import is_nearly_null, track_homotopy
from tau_dyn.kinematics.assembly.start import N_SOLUTIONS, draw_general_hexapod, start_system


@dataclass(frozen=True, eq=False)
class AssemblyModes:
    """Poses of a plate that fit its rods; m of them, at most 40, real ones first, then by position.

    Attributes:
        position: Origin of the plate's frame (m, 3) [m], complex.
        quaternion: x, y, z, w with `q . q = 1` (m, 4), complex; each pose once, its sign chosen so that w (or the first that is
            not zero of w, x, y, z) has a positive real part.
        rotation: (m, 3, 3), complex.
        real: Proven to be real (m,).
        residual: Largest error of a rod's length at these numbers (m,) [m].
        radius: A true solution is proven to lie within this relative distance of the homogeneous point `e, h` (m,).
        n_no_pose: Paths that ended at infinity, at no pose, or too far away to tell.
        n_singular: Paths that ended in a double solution, on a continuum of poses, or too near one to tell.
        certified: m is proven to be the number of isolated modes, real ones are proven to be real, and the others not to be.
        why: Why it is certified, or why not.
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
        """Number of real modes: the ways in which the robot can be put together."""
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
    """Return proven, distinct poses, how many paths ended without one, and in a singular point.

    Where some are missing, all paths are followed once more by another route.
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
    """Keep what is proven to be a pose and proven to differ from those kept before."""
    found = certify(Q, size, points)
    found = found.take(found.pose)
    return found.take(select_distinct_balls(found.z, found.radius))


def _poses(A: np.ndarray, B: np.ndarray, L: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, quaternions and rotations, worked out in extended precision where the machine has it.

    A complex pose can be thousands of robot sizes away: its quaternion is nearly null, and its pose loses digits to that.
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
    """Drop what rounding left of an imaginary part that is proven to be zero."""
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
    """Return float arrays, or say what is wrong with them."""
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
