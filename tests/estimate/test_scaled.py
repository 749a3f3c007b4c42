"""Least squares whose tolerance does not depend on the parameters' units."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import scale_columns, solve_scaled


def test_columns_of_any_unit_get_unit_norm_and_a_column_of_zeros_stays(rng):
    """Columns of 1e-9 and of 1e9 come out with norm 1 and give their norms back; zeros are not divided by zero."""
    W = rng.normal(size=(20, 3)) * [1e-9, 0.0, 1e9]
    unit, norm = scale_columns(W)
    assert_allclose(np.linalg.norm(unit, axis=0), [1, 0, 1], rtol=1e-12)
    assert_allclose(unit * norm, W, rtol=1e-12)
    assert norm[1] == 1.0


def test_a_parameter_in_a_small_unit_is_not_cut_off(rng):
    """A column 1e12 times smaller than another, below the tolerance as it stands, still gets its parameter."""
    W, theta = rng.normal(size=(50, 2)) * [1.0, 1e-12], np.array([2.0, 3e12])
    assert_allclose(solve_scaled(W, W @ theta, 1e-9), theta, rtol=1e-9)


def test_what_the_data_do_not_show_comes_out_as_zero(rng):
    """A column of zeros has the parameter zero, and its neighbour's is unmoved."""
    W = np.column_stack([rng.normal(size=30), np.zeros(30)])
    assert_array_equal(solve_scaled(W, 4 * W[:, 0], 1e-9)[1], 0.0)
    assert_allclose(solve_scaled(W, 4 * W[:, 0], 1e-9)[0], 4.0, rtol=1e-12)


def test_a_failure_of_divide_and_conquer_is_no_failure(monkeypatch, rng):
    """LAPACK's `gelsd` fails on some finite rows; a rank-deficient fit is then the same by QR iterations."""
    W = rng.normal(size=(30, 4))
    W[:, 3] = W[:, 0] + W[:, 1]
    y = rng.normal(size=30)
    wanted = solve_scaled(W, y, 1e-9)

    def fail(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge in Linear Least Squares")

    monkeypatch.setattr(np.linalg, "lstsq", fail)
    assert_allclose(solve_scaled(W, y, 1e-9), wanted, rtol=1e-9)
