"""Base parameters: the combinations of columns that a regressor can see."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tau_dyn.estimate import BaseParameters, find_base, read_expression
from tau_dyn.estimate.base_parameters import find_contained
from tau_dyn.identify.fitted_model import find_structural_base
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

NAMES = ("a", "b", "c", "d", "e")


@pytest.fixture
def dependent(rng):
    """Return columns a, b, c = 2 a - b / 4, d = 0, e, at very different sizes, and the generator's size."""
    a, b, e = rng.normal(size=(3, 200))
    return np.column_stack([a, b, 2 * a - b / 4, np.zeros(200), 1e6 * e])


def test_dependent_columns_are_explained_by_those_before_them(dependent):
    """`c = 2 a - b / 4` drops out and shows in the expressions of a and b; a zero column is seen nowhere."""
    base = find_base(dependent, NAMES)
    assert_array_equal(base.kept, [0, 1, 4])
    assert_array_equal(base.dropped, [2, 3])
    assert_allclose(base.K, [[2, 0], [-0.25, 0], [0, 0]], atol=1e-12)
    assert [base.expression(k) for k in range(3)] == ["a + 2*c", "b - 0.25*c", "e"]
    assert_array_equal(base.alone, [False, False, False, False, True])


def test_base_parameters_predict_what_all_parameters_predict(dependent, rng):
    """`W theta = W_B (theta_B + K theta_D)` for any theta."""
    base, theta = find_base(dependent, NAMES), rng.normal(size=5)
    assert_allclose(dependent[:, base.kept] @ base.combine(theta), dependent @ theta, rtol=1e-12, atol=1e-9)


def test_a_parameter_says_with_whom_it_shares_its_sums(dependent):
    """A dropped column names the kept ones that hold it, a kept one also its fellow passengers."""
    base = find_base(dependent, NAMES)
    assert base.depends_on(2) == ("a", "b")
    assert base.depends_on(0) == ("c",)
    assert base.depends_on(3) == base.depends_on(4) == ()


@pytest.mark.parametrize(("unexplained", "rank"), [(1e-9, 1), (1e-5, 2)])
def test_rank_takes_a_nearly_dependent_column_for_dependent_below_the_closures_accuracy(rng, unexplained, rank):
    """A column counts if 1e-7 of it is its own: closures leave 1e-10, and a dull motion more than 1e-5."""
    a, b = np.linalg.qr(rng.normal(size=(300, 2)))[0].T
    W = np.column_stack([a, a + unexplained * b])
    assert find_base(W, ("a", "b")).rank == rank
    assert find_base(W * [1e-5, 1e5], ("a", "b")).rank == rank  # units do not matter


def test_a_four_bar_has_as_many_base_parameters_as_its_columns_have_rank(four_bar):
    """Of three links' thirty numbers the crank sees few: mass and inertia out of the plane never show."""
    model = Model.of(four_bar)
    base = find_structural_base(model)
    rng = np.random.default_rng(1)
    q, v, a = four_bar.home + rng.uniform(-0.4, 0.4, (80, 1)), *rng.normal(size=(2, 80, 1))
    W = model.regressor(q, v, a)[:, 0, model.parameters.free]
    size = np.linalg.norm(W, axis=0)
    singular = np.linalg.svd(W / np.where(size > 0, size, 1.0), compute_uv=False)
    assert base.rank == np.sum(singular > 1e-9 * singular[0])
    theta = model.parameters.select(base.names).values
    assert_allclose(W[:, base.kept] @ base.combine(theta), W @ theta, rtol=1e-8, atol=1e-8)
    for name in ("crank_link.mass", "coupler_link.ixx", "rocker_link.mz"):
        assert not base.alone[base.names.index(name)]


def test_rods_that_move_alike_show_only_their_sum():
    """The two rods of L1's complete arm 2 stay parallel: their masses enter every force as one sum."""
    base = find_structural_base(Model.of(load_robot("gantry_tau", prototype="l1", arms="complete")))
    text = [base.expression(k) for k in range(base.rank)]
    assert "rod2a_link.mass + rod2b_link.mass" in text
    assert "rod3a_link.mass + rod3b_link.mass + rod3c_link.mass" in text
    assert base.depends_on(base.names.index("rod2b_link.mass")) == ("rod2a_link.mass",)
    assert base.alone[base.names.index("plate_link.mass")]


def test_nothing_seen_is_rank_zero():
    """Columns of zeros identify nothing, and say so instead of dividing by zero."""
    base = find_base(np.zeros((10, 3)), ("a", "b", "c"))
    assert base.rank == 0
    assert_array_equal(base.dropped, [0, 1, 2])


def test_a_rounding_of_the_robot_file_is_not_a_parameter(rng):
    """A column 1e-6 of its unit's largest, as an angle of 3.14159 makes, is unseen; other units are judged by themselves."""
    W = rng.normal(size=(50, 3)) * [1.0, 1e-6, 1e-8]
    base = find_base(W, ("a.mx", "b.mx", "c.viscous"), units=("kg m", "kg m", "N s"))
    assert [base.names[k] for k in base.kept] == ["a.mx", "c.viscous"]


def test_noise_on_the_left_does_not_take_the_place_of_what_stands_on_the_right():
    """Eight columns that are one but for noise as large as the tolerance, and one of its own: that one is always kept."""
    names = (*(f"a{k}" for k in range(8)), "b")
    for seed in range(20):
        rng = np.random.default_rng(seed)
        a, b = rng.normal(size=(2, 200))
        W = np.column_stack([*(a + 1e-6 * rng.normal(size=200) for _ in range(8)), b])
        base, theta = find_base(W, names), rng.normal(size=9)
        assert base.kept[0] == 0 and base.kept[-1] == 8
        assert_allclose(W[:, base.kept] @ base.combine(theta), W @ theta, atol=1e-3)
        assert base.alone[8]


def test_an_expression_is_read_back():
    """Signs, factors with exponents, and joints joined by a plus come back as written."""
    base = BaseParameters(("a+b.inertia", "c", "d"), np.array([0]), np.array([1, 2]), np.array([[-1.0, 2.5e-7]]))
    assert read_expression(base.expression(0)) == {"a+b.inertia": 1.0, "c": -1.0, "d": 2.5e-7}


def test_a_fixed_column_in_the_span_of_base_columns_is_contained(dependent, rng):
    """The column c = 2 a - b / 4 is contained with these factors; one that differs from it by 1e-4 is not, nor is d = 0."""
    W = np.column_stack([dependent, dependent[:, 2] * (1 + 1e-4 * rng.normal(size=200))])
    assert_allclose(
        find_contained(W, [0, 1, 4], [2, 5, 3]), [[2, 0, 0], [-0.25, 0, 0], [0, 0, 0]], rtol=1e-9, atol=1e-12
    )
