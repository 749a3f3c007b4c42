"""NumPy arrays of expressions: array code that runs on them records the graph of its computation.

`ExpressionArray` is an array whose elements are numbers or `Node`s. NumPy lets it override each function (NEP 13 and 18), so
mechanisms and effects are traced without a second version of any formula. An operation that cannot be recorded raises
`TypeError`. Code to be traced makes its arrays `like` those given (`np.zeros_like(v, shape=...)`), as `np.zeros` cannot hold
expressions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.equations.graph import MEANING, Graph, Node, evaluate_graph


def _op(name: str) -> Callable[..., Any]:
    def scalar(*args: Any) -> Any:
        graph = next((x.graph for x in args if isinstance(x, Node)), None)
        return MEANING[name](*args) if graph is None else graph.apply(name, *args)

    return scalar


_SCALAR: dict[np.ufunc, tuple[Callable[..., Any], int]] = {
    ufunc: (_op(name), ufunc.nin)
    for ufunc, name in (
        (np.add, "add"), (np.subtract, "sub"), (np.multiply, "mul"), (np.divide, "div"), (np.negative, "neg"),
        (np.absolute, "abs"), (np.fabs, "abs"), (np.sqrt, "sqrt"), (np.exp, "exp"), (np.log, "log"), (np.sin, "sin"),
        (np.cos, "cos"), (np.tan, "tan"), (np.tanh, "tanh"), (np.arctan2, "atan2"), (np.hypot, "hypot"),
        (np.floor, "floor"), (np.sign, "sign"), (np.minimum, "min"), (np.maximum, "max"), (np.less, "lt"), (np.less_equal, "le"),
        (np.equal, "eq"), (np.logical_and, "and"), (np.logical_or, "or"), (np.logical_not, "not"),
        (np.bitwise_and, "and"), (np.bitwise_or, "or"), (np.invert, "not"),
    )
}  # fmt: skip
_SCALAR |= {
    np.greater: (lambda x, y: _op("lt")(y, x), 2),
    np.greater_equal: (lambda x, y: _op("le")(y, x), 2),
    np.not_equal: (lambda x, y: _op("not")(_op("eq")(x, y)), 2),
    np.power: (lambda x, y: x**y, 2),
    np.square: (lambda x: x * x, 1),
    np.positive: (lambda x: x, 1),
}


class ExpressionArray(np.ndarray):
    """An array of numbers and nodes, of dtype object."""

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, where: Any = True, **options: Any
    ) -> Any:
        """Record an elementwise function, a reduction or a matrix product."""
        options.pop("dtype", None)
        plain = [_plain(x) for x in inputs]
        if ufunc is np.matmul:
            made = np.matmul(*plain)
        elif ufunc not in _SCALAR:
            raise TypeError(f"numpy.{ufunc.__name__} of an expression of the inputs")
        elif method == "__call__":
            made = np.frompyfunc(*_SCALAR[ufunc], 1)(*plain)
        elif method == "reduce":
            made = _reduced(ufunc, plain[0], options.get("axis", 0), bool(options.get("keepdims")))
        else:
            raise TypeError(f"numpy.{ufunc.__name__}.{method} of an expression of the inputs")
        into = None if out is None else out[0] if isinstance(out, tuple) else out
        if where is not True:
            if into is None:
                raise TypeError(f"numpy.{ufunc.__name__} with `where` but without `out`")
            made = _where(where, made, into)
        made = as_expression_array(made)
        if isinstance(into, ExpressionArray):
            into[...] = made
            return into
        return made

    def __array_function__(self, func: Callable, types: Any, args: tuple, kwargs: dict) -> Any:
        """Record functions that have their own implementation in `_FUNCTIONS`; run all others on these arrays."""
        if func in _FUNCTIONS:
            return as_expression_array(_FUNCTIONS[func](*args, **kwargs))
        return _wrapped(super().__array_function__(func, types, args, kwargs))


def as_expression_array(x: Any) -> Any:
    """Return numbers and nodes as a traced array."""
    return np.asarray(x, dtype=object).view(ExpressionArray)


def build_inputs(graph: Graph, name: str, values: np.ndarray) -> ExpressionArray:
    """Return inputs `name0`, `name1`, ... (n,) with their values at the reference state."""
    return as_expression_array([graph.input(f"{name}{k}", float(x)) for k, x in enumerate(values)])


def _plain(x: Any) -> Any:
    return np.asarray(x, dtype=object)


def _wrapped(made: Any) -> Any:
    if isinstance(made, np.ndarray) and made.dtype == object:
        return made.view(ExpressionArray)
    if isinstance(made, list | tuple):
        wrapped = [_wrapped(x) for x in made]
        return tuple(wrapped) if isinstance(made, tuple) else wrapped
    return made


def _reduced(ufunc: np.ufunc, x: np.ndarray, axis: Any, keepdims: bool) -> Any:
    axes = tuple(range(x.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    function: Any = np.frompyfunc(*_SCALAR[ufunc], 1)
    for k in sorted((a % x.ndim for a in axes), reverse=True):
        if x.shape[k] == 0:
            shape = x.shape[:k] + x.shape[k + 1 :]
            made: Any = np.full(shape, ufunc.identity, dtype=object)
        else:
            made = function.reduce(x, axis=k)
        x = np.expand_dims(_plain(made), k) if keepdims else _plain(made)
    return x


def _where(condition: Any, x: Any, y: Any) -> np.ndarray:
    return np.frompyfunc(_op("select"), 3, 1)(_plain(condition), _plain(x), _plain(y))


def _clip(x: Any, low: Any, high: Any) -> Any:
    return np.minimum(np.maximum(as_expression_array(x), low), high)


def _inverse(A: Any) -> Any:
    """Return the inverse of matrices (..., n, n) up to 3 by 3, by cofactors."""
    A = _plain(A)
    n = A.shape[-1]
    out = np.empty(A.shape, dtype=object)
    for index in np.ndindex(A.shape[:-2]):
        out[index] = _inverse_of(A[index], n)
    return out


def _inverse_of(A: np.ndarray, n: int) -> np.ndarray:
    if n == 1:
        return np.array([[_op("div")(1.0, A[0, 0])]], dtype=object)
    if n == 2:
        cofactors = np.array([[A[1, 1], -A[0, 1]], [-A[1, 0], A[0, 0]]], dtype=object)
        return cofactors * _op("div")(1.0, A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0])
    if n > 3:
        raise TypeError("the inverse of a matrix larger than 3 by 3")
    ring = np.pad(A, (0, 2), mode="wrap")
    cofactors = ring[1:4, 1:4] * ring[2:, 2:] - ring[1:4, 2:] * ring[2:, 1:4]
    return cofactors.T * _op("div")(1.0, A[0] @ cofactors[0])


def _like(value: float) -> Callable[..., Any]:
    def made(x: Any, dtype: Any = None, shape: Any = None, **_: Any) -> np.ndarray:
        return np.full(np.shape(x) if shape is None else shape, value, dtype=object)

    return made


_FUNCTIONS: dict[Callable, Callable] = {
    np.where: _where,
    np.clip: _clip,
    np.linalg.inv: _inverse,
    np.zeros_like: _like(0.0),
    np.ones_like: _like(1.0),
    np.einsum: lambda subscripts, *operands: np.einsum(subscripts, *(_plain(x) for x in operands)),
}


@dataclass(frozen=True, eq=False)
class TracedFunction:
    """One traced function.

    Attributes:
        graph: Its expressions.
        arguments: Names of its input arrays and their sizes.
        outputs: Its output arrays, flat, by name.
    """

    graph: Graph
    arguments: dict[str, int]
    outputs: dict[str, tuple[Any, ...]]

    @property
    def values(self) -> tuple[Any, ...]:
        """All outputs, in order."""
        return tuple(x for values in self.outputs.values() for x in values)

    def evaluate(self, known: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the outputs (N, k) by name at input arrays (N, ...); nan where a guard does not hold."""
        found, fine = evaluate_graph(self.graph, self.values, known)
        found[~fine] = np.nan
        ends = np.cumsum([len(x) for x in self.outputs.values()])[:-1]
        return dict(zip(self.outputs, np.split(found, ends, axis=1), strict=True))


def trace_function(arguments: dict[str, np.ndarray], make: Callable[..., dict[str, Any]]) -> TracedFunction:
    """Trace a function of input arrays, given with their values at the reference state."""
    graph = Graph()
    made = make(*(build_inputs(graph, name, value) for name, value in arguments.items()))
    return TracedFunction(graph, {name: len(value) for name, value in arguments.items()}, flatten_outputs(made))


def flatten_outputs(made: dict[str, Any]) -> dict[str, tuple[Any, ...]]:
    """Return output arrays as flat tuples."""
    return {name: tuple(np.ravel(np.asarray(x, dtype=object))) for name, x in made.items()}
