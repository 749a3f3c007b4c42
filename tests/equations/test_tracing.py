"""Tracing: NumPy code run on expressions leaves the graph of what it computes."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.equations import Graph, Node, as_expression_array, build_inputs, evaluate_graph


def test_equal_expressions_are_one_node_and_numbers_stay_numbers() -> None:
    """Common subexpressions are computed once; zeros, ones and constants cost nothing."""
    graph = Graph()
    x, y = build_inputs(graph, "x", np.array([2.0, 3.0]))
    assert (x * y + 1.0) is (1.0 + y * x)
    assert x * 0.0 == 0.0 and x * 1.0 is x and x + 0.0 is x and -(x.__neg__()) is x and (x - x) == 0.0
    assert isinstance(np.sin(as_expression_array([0.5]))[0], float)


def test_array_code_computes_what_it_computes_on_numbers(rng) -> None:
    """Reductions, products, choices and inverses of expressions have the values of the same code on arrays."""

    def code(A: np.ndarray) -> np.ndarray:
        b = np.where(A[0] > A[1], np.clip(A[0], -0.5, 0.5), np.abs(A[1]))
        slow = np.divide(b, A[2], out=np.zeros_like(b), where=np.abs(A[2]) > 0.3)
        total = np.einsum("ij,j->i", np.linalg.inv(A), b) + np.max(A, axis=0) - np.sum(A**2, axis=(0, 1)) + slow
        out = np.zeros(3)
        out += np.sign(total) * np.sqrt(total**2 + 1)
        return np.stack([out, np.hypot(total, 2.0) @ A])

    A = rng.standard_normal((3, 3))
    made = code(build_inputs(Graph(), "a", A.ravel()).reshape(3, 3))
    values = np.array([x.value if isinstance(x, Node) else x for x in made.ravel()])
    np.testing.assert_allclose(values, code(A).ravel(), rtol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_small_matrices_have_inverses(n: int, rng) -> None:
    """The inverse of an expression's matrix times the matrix is the unit matrix, for one number too."""
    A = rng.standard_normal((n, n)) + 2 * np.eye(n)
    made = np.linalg.inv(build_inputs(Graph(), "a", A.ravel()).reshape(n, n))
    np.testing.assert_allclose([[x.value for x in row] for row in made] @ A, np.eye(n), atol=1e-12)


def test_a_question_becomes_a_guard() -> None:
    """`if x > 1` is answered as at the reference state, and the answer is kept to be checked where the code runs."""
    graph = Graph()
    (x,) = build_inputs(graph, "x", np.array([2.0]))
    assert bool(x > 1.0) and not bool(x < 0.5)
    assert sorted(graph.guards.values()) == [False, True]


@pytest.mark.parametrize("power", [0.5, -0.5, 1.7, 2.5, -3.0, 9.0])
def test_any_power_of_what_is_not_negative(power: float) -> None:
    """Curves over the speed have powers that are no whole numbers; at zero they are NumPy's, too."""
    graph = Graph()
    made = build_inputs(graph, "x", np.array([2.0])) ** power
    known = {"x": np.array([[2.0], [0.3], [0.0]])}
    found, fine = evaluate_graph(graph, tuple(made), known)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(found, known["x"] ** power, rtol=1e-13)
    assert fine.all()


@pytest.mark.parametrize(
    "code",
    [lambda x: float(x[0]), lambda x: np.arccosh(x), lambda x: 2.0**x, lambda x: bool(x[0])],
)
def test_what_cannot_be_recorded_is_refused(code) -> None:
    """Nothing is written out that was only half understood."""
    with pytest.raises(TypeError):
        code(build_inputs(Graph(), "x", np.array([2.0, 3.0])))
