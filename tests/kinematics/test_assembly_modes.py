"""Every pose that six rods allow is found, proven, and counted as often as theory says."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assembly import find_assembly_modes
from tau_dyn.kinematics.assembly.equations import (
    Hexapod,
    bound_magnitudes,
    build_quadrics,
    convert_to_poses,
    draw_general_hexapod,
    multiply_quaternions,
    normalise_hexapod,
    start_system,
)
from tau_dyn.kinematics.assembly.homotopy import track_homotopy
from tau_dyn.kinematics.assembly.modes import certify, select_distinct_balls

BASE = np.array(  # Dietmaier 1998, Advances in Robot Kinematics, p. 7
    [[0, 0, 0], [1.107915, 0, 0], [0.549094, 0.756063, 0]]
    + [[0.735077, -0.223935, 0.525991], [0.514188, -0.526063, -0.368418], [0.590473, 0.094733, -0.205018]]
)
PLATE = np.array(
    [[0, 0, 0], [0.542805, 0, 0], [0.956919, -0.528915, 0]]
    + [[0.665885, -0.353482, 1.402538], [0.478359, 1.158742, 0.107672], [-0.137087, -0.235121, 0.353913]]
)
LENGTHS = np.array([1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071])


def drawn(rng, plate_points=(0, 1, 2, 3, 4, 5)):
    """Return base, plate, lengths and the real pose that they fit."""
    A, B = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))[list(plate_points)]
    R, T = Rotation.from_quat(rng.normal(size=4)), rng.normal(size=3)
    return A, B, np.linalg.norm(T + R.apply(B) - A, axis=1), T, R.as_matrix()


def true_gaps(A, B, L, modes) -> np.ndarray:
    """Return the squared lengths' errors by nothing but the definition (thesis 4.34)."""
    d = modes.position[:, None] + np.einsum("nij,kj->nki", modes.rotation, B) - A
    return (d * d).sum(axis=2) - L**2


def test_dietmaiers_hexapod_has_forty_real_modes() -> None:
    """The published hexapod with the most real modes: 40, each proven real, and no residual."""
    modes = find_assembly_modes(BASE, PLATE, LENGTHS)
    assert modes.certified and modes.n_real == len(modes.real) == 40
    assert modes.residual.max() < 1e-13
    assert_allclose(true_gaps(BASE, PLATE, LENGTHS, modes), 0, atol=1e-12)
    assert np.abs(modes.position.imag).max() == np.abs(modes.rotation.imag).max() == 0
    poses = np.concatenate([modes.position.real, modes.rotation.real.reshape(40, 9)], axis=1)
    between = np.linalg.norm(poses[:, None] - poses, axis=2) + 9 * np.eye(40)
    assert between.min() > 1e-3


def test_random_hexapods_have_forty_certified_modes_and_know_their_pose(rng) -> None:
    """40 complex modes, in conjugate pairs but for an even number of real ones, the pose they were built from among them."""
    for _ in range(3):
        A, B, L, T, R = drawn(rng)
        modes = find_assembly_modes(A, B, L)
        assert modes.certified and len(modes.real) == 40 and modes.n_real % 2 == 0 and modes.n_real >= 2
        size = 1 + np.abs(modes.position).max(axis=1)
        assert (modes.residual / size).max() < 1e-9
        near = np.abs(modes.position - T).max(axis=1) + np.abs(modes.rotation - R).max(axis=(1, 2))
        assert near[modes.real].min() < 1e-9
        unit = np.einsum("nji,njk->nik", modes.rotation, modes.rotation)
        assert_allclose(unit / (size**2)[:, None, None], np.eye(3) / (size**2)[:, None, None], atol=1e-9)


def test_modes_move_with_the_frames_and_scale_with_the_robot(rng) -> None:
    """Real modes do not depend on where the origin is, nor on metres or millimetres."""
    A, B, L, _, _ = drawn(rng)
    first = find_assembly_modes(A, B, L)
    moved = find_assembly_modes(1000 * (A + [3, -2, 5]), 1000 * B, 1000 * L)
    real = first.position[first.real].real
    assert_allclose(moved.position[moved.real].real / 1000 - [3, -2, 5], real, atol=1e-8)


@pytest.mark.parametrize(
    ("pattern", "count"), [((0, 0, 0, 1, 1, 2), 8), ((0, 0, 0, 1, 2, 3), 16), ((0, 0, 1, 1, 2, 2), 16)]
)
def test_rods_that_share_points_have_the_known_smaller_number(rng, pattern, count) -> None:
    """3-2-1, 3-1-1-1 and 2-2-2 clusters: 8, 16 and 16 modes, certified as all there are."""
    A, B, L, T, _ = drawn(rng, pattern)
    modes = find_assembly_modes(A, B, L)
    assert len(modes.real) == count and modes.certified
    assert np.abs(modes.position[modes.real] - T).max(axis=1).min() < 1e-9


def test_a_plate_that_can_move_is_not_certified() -> None:
    """Similar regular hexagons with equal rods move by themselves: no isolated mode, and the answer says that it is special."""
    angle = np.linspace(0, 2 * np.pi, 7)[:6]
    hexagon = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    modes = find_assembly_modes(hexagon, 0.5 * hexagon, np.ones(6))
    assert not modes.certified and "special" in modes.why
    assert modes.n_singular > 0


def test_a_lost_solution_is_not_hidden(rng, monkeypatch) -> None:
    """With a start system that lacks solutions the answer must not be certified, and says that modes may be missing."""
    from tau_dyn.kinematics.assembly import modes as module

    start, x = start_system()
    monkeypatch.setattr(module, "start_system", lambda: (start, x[:12]))
    modes = find_assembly_modes(*drawn(rng)[:3])
    assert not modes.certified and "more modes may exist" in modes.why


def test_rods_too_short_have_no_real_mode(rng) -> None:
    """Rods that cannot reach leave 40 complex modes and none real."""
    A, B, _, _, _ = drawn(rng)
    modes = find_assembly_modes(3 * A, B, np.full(6, 0.01))
    assert modes.n_real == 0 and modes.certified


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda A, B, L: (A[:5], B, L), "shape"),
        (lambda A, B, L: (A * np.nan, B, L), "finite"),
        (lambda A, B, L: (A, B, -L), "positive"),
    ],
)
def test_bad_input_is_named(rng, change, message) -> None:
    """Five rods, nan and negative lengths are the user's faults."""
    with pytest.raises(InputError, match=message):
        find_assembly_modes(*change(*drawn(rng)[:3]))


def convert_to_points(position, quaternion, rotation, gauge):
    """Return homogeneous points (n, 8) of poses; the inverse of `convert_to_poses`."""
    T = (position + rotation @ gauge.plate - gauge.base) / gauge.scale
    pure = np.concatenate([np.zeros_like(T[:, :1]), T], axis=1)
    return np.concatenate([quaternion, multiply_quaternions(pure, quaternion)], axis=1)


def test_the_quadrics_are_the_rods_equations(rng) -> None:
    """A pose that fits its rods solves the quadrics, one that does not does not, and comes back from its homogeneous point."""
    A, B, L, T, R = drawn(rng)
    hexapod, gauge = normalise_hexapod(A, B, L)
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    e = np.array([[w, x, y, z]])
    point = convert_to_points(T[None], e, R[None], gauge)
    assert_allclose(np.einsum("ni,kij,nj->k", point, build_quadrics(hexapod), point), 0, atol=1e-14)
    off = convert_to_points(T[None] + 0.1, e, R[None], gauge)
    assert np.abs(np.einsum("ni,kij,nj->k", off, build_quadrics(hexapod), off)[:6]).min() > 1e-4
    position, _, rotation = convert_to_poses(3j * point, gauge)
    assert_allclose(position[0], T, atol=1e-13)
    assert_allclose(rotation[0], R, atol=1e-13)


def test_a_certificate_needs_a_solution(rng) -> None:
    """Near a solution a ball is proven and holds it; away from any there is none; a copy of a solution is not another one."""
    hexapod, gauge = normalise_hexapod(BASE, PLATE, LENGTHS)
    Q, size = build_quadrics(hexapod), bound_magnitudes(hexapod, LENGTHS / gauge.scale)
    modes = find_assembly_modes(BASE, PLATE, LENGTHS)
    e = modes.quaternion[:, [3, 0, 1, 2]]
    x = convert_to_points(modes.position, e, modes.rotation, gauge)
    off = x * (1 + 1e-9 * rng.normal(size=x.shape))
    good, near, far = (
        certify(Q, size, x),
        certify(Q, size, off),
        certify(Q, size, x * (1 + 0.3 * rng.normal(size=x.shape))),
    )
    assert good.pose.all() and good.real.all() and not good.complex.any()
    proven = np.isfinite(near.relative)
    assert proven.sum() > 30
    assert (np.abs(good.z - near.z) <= near.radius + good.radius)[proven].all()
    assert np.isinf(far.relative).all() and not far.real.any()
    twice = select_distinct_balls(np.concatenate([good.z, 1j * good.z]), np.tile(good.radius, (2, 1)))
    assert twice[:40].all() and not twice[40:].any()


def test_tracking_there_and_back_returns_every_solution(rng) -> None:
    """Forty paths to another general hexapod and back end where they began, none lost and none doubled."""
    start, x = start_system()
    assert_allclose(np.einsum("ni,kij,nj->nk", x, build_quadrics(start), x), 0, atol=1e-13)
    there = track_homotopy(start, draw_general_hexapod(rng), x)
    alike = np.abs(there.x.conj() @ there.x.T)[np.triu_indices(len(x), 1)]  # 1 for the same homogeneous point
    assert there.regular.all() and len(x) == 40 and (1 - alike > 1e-9).all()
    end = Hexapod(*draw_general_hexapod(np.random.default_rng(5)))
    back = track_homotopy(end, start, track_homotopy(start, end, x).x)
    assert_allclose(np.abs((back.x.conj() * x).sum(axis=1)), 1, atol=1e-10)
