"""The covariance of equations whose accelerations come from noisy positions, against dense algebra."""

import numpy as np
import pytest

from tau_dyn.estimate import PositionNoise, build_position_noise, compute_accelerations

N, M, DT = 30, 3, 0.01


@pytest.fixture
def noise() -> PositionNoise:
    """Thirty samples of three coupled joints, a fifth of the equations left out."""
    rng = np.random.default_rng(0)
    half = rng.normal(size=(N, M, M))
    keep = rng.random((N, M)) > 0.2
    keep[:2] = keep[-2:] = False
    force, position = np.array([1.0, 2.0, 3.0]), np.array([1e-4, 2e-4, 3e-4])
    return build_position_noise(half @ half.transpose(0, 2, 1) + np.eye(M), keep, DT, force, position)


def dense(noise: PositionNoise) -> np.ndarray:
    """Return `Sigma` of the equations that count, one position at a time."""
    D = np.column_stack([noise.of_positions(unit.reshape(N, M)).ravel() for unit in np.eye(N * M)])
    full = D * np.tile(noise.position**2, N) @ D.T + np.diag(np.tile(noise.force**2, N))
    kept = noise.keep.ravel()
    return full[np.ix_(kept, kept)]


def test_solving_is_dense_solving(noise):
    """The banded factor gives what the dense matrix gives, and zeros where an equation is left out."""
    x = np.random.default_rng(1).normal(size=(N, M, 2))
    got, kept = noise.solve(x), noise.keep.ravel()
    expected = np.linalg.solve(dense(noise), x.reshape(N * M, 2)[kept])
    assert np.allclose(got.reshape(N * M, 2)[kept], expected, atol=1e-10)
    assert np.all(got[~noise.keep] == 0)


def test_whitened_rows_have_the_inverse_as_gram(noise):
    """`(L^-1 x)' (L^-1 x) = x' Sigma^-1 x`."""
    x = np.random.default_rng(2).normal(size=(N, M, 4))
    white = noise.whiten(x).reshape(-1, 4)
    assert np.allclose(white.T @ white, x.reshape(-1, 4).T @ noise.solve(x).reshape(-1, 4))


def test_to_positions_is_the_transpose(noise):
    """`r . D n = n . D' r`."""
    r, n = np.random.default_rng(3).normal(size=(2, N, M))
    assert np.sum(r * noise.of_positions(n)) == pytest.approx(np.sum(noise.to_positions(r) * n))


def test_accelerations_are_of_fourth_order():
    """Halving the step divides the error by sixteen; a cubic has none."""
    errors = []
    for dt in (0.02, 0.01):
        t = np.arange(0, 1, dt)
        errors.append(np.max(np.abs((compute_accelerations(np.sin(7 * t), dt) + 49 * np.sin(7 * t))[2:-2])))
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
    assert np.allclose(compute_accelerations(t**3, 0.01)[2:-2], 6 * t[2:-2], atol=1e-9)
