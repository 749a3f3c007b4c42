"""An expression graph: the operations of a computation, recorded once, to be written out in another language.

A `Node` represents a number that is not known yet. Arithmetic on nodes records instead of computing; equal expressions become
one node, and a value that depends on no input stays a plain float. Every node also carries its value at one reference state, so
that a comparison (`if height > 0`) can be evaluated during tracing; its result is kept as a guard, which the written code
checks. Reference: King 1976 (symbolic execution); Godefroid, Klarlund & Sen 2005 (with concrete values).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


def _sign(x: float) -> float:
    return float((x > 0) - (x < 0))


def _divide(x: float, y: float) -> float:
    return x / y if y else math.nan  # a quotient that a `where` leaves out


def _select(condition: bool, x: float, y: float) -> float:
    return x if condition else y


MEANING: dict[str, Callable[..., Any]] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": _divide, "neg": operator.neg, "abs": abs,
    "floor": lambda x: float(math.floor(x)),
    "sqrt": lambda x: math.sqrt(x) if x >= 0 else math.nan, "exp": math.exp, "log": math.log, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "tanh": math.tanh, "atan2": math.atan2, "hypot": math.hypot, "sign": _sign,
    "min": min, "max": max, "select": _select, "lt": operator.lt, "le": operator.le, "eq": operator.eq,
    "and": lambda x, y: bool(x) and bool(y), "or": lambda x, y: bool(x) or bool(y), "not": operator.not_,
}  # fmt: skip
"""Implementation of each operation on plain numbers."""

_COMMUTES = frozenset({"add", "mul", "min", "max", "eq", "and", "or", "hypot"})


class Graph:
    """All nodes of one computation, each after its arguments.

    Attributes:
        nodes: The nodes.
        guards: Conditions evaluated during tracing, with their result at the reference state.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.nodes: list[Node] = []
        self.guards: dict[int, bool] = {}
        self._known: dict[tuple, Node] = {}

    def input(self, name: str, value: float) -> Node:
        """Return an input of this name, with its value at the reference state."""
        return self._node("input", (name,), value)

    def constant(self, value: float) -> Node:
        """Return a plain number as a node, where a node is needed."""
        return self._node("const", (float(value),), float(value))

    def apply(self, op: str, *args: Any) -> Any:
        """Return the result of an operation on nodes and numbers: a node, or a number if all arguments are numbers."""
        if not any(isinstance(x, Node) for x in args):
            return MEANING[op](*args)
        simple = _simplified(op, args)
        if simple is not None:
            return simple
        nodes = [x if isinstance(x, Node) else self.constant(x) for x in args]
        if op in _COMMUTES:
            nodes.sort(key=lambda node: node.index)
        return self._node(op, tuple(n.index for n in nodes), MEANING[op](*(n.value for n in nodes)))

    def factored(self, matrix: Any) -> Node:
        """Return a square matrix made ready for `solved`."""
        flat = [x if isinstance(x, Node) else self.constant(x) for row in matrix for x in row]
        value = np.array([x.value for x in flat]).reshape(len(matrix), len(matrix))
        return self._node("factor", tuple(x.index for x in flat), value)

    def solved(self, factor: Node, b: Sequence[Any], *, transposed: bool = False) -> list[Node]:
        """Return x of `A x = b`, or of `A' x = b`, for a factored A."""
        flat = [x if isinstance(x, Node) else self.constant(x) for x in b]
        A = factor.value.T if transposed else factor.value
        value = np.linalg.solve(A, np.array([x.value for x in flat]))
        op = "solve_t" if transposed else "solve"
        x = self._node(op, (factor.index, *(n.index for n in flat)), value)
        return [self._node("item", (x.index, k), float(value[k])) for k in range(len(flat))]

    def answer(self, node: Node) -> bool:
        """Return whether a condition holds at the reference state, and add it to the guards."""
        self.guards[node.index] = bool(node.value)
        return bool(node.value)

    def needed(self, outputs: Sequence[Any]) -> list[Node]:
        """Return the nodes that outputs and guards depend on, in order."""
        open_ = [x.index for x in outputs if isinstance(x, Node)] + list(self.guards)
        seen: set[int] = set()
        while open_:
            index = open_.pop()
            if index not in seen:
                seen.add(index)
                open_ += self.nodes[index].before
        return [self.nodes[k] for k in sorted(seen)]

    def uses(self, op: str, outputs: Sequence[Any]) -> bool:
        """Return whether outputs and guards need an operation."""
        return any(node.op == op for node in self.needed(outputs))

    def _node(self, op: str, args: tuple, value: Any) -> Node:
        key = (op, *args)
        if key not in self._known:
            node = Node(self, len(self.nodes), op, args, value)
            self.nodes.append(node)
            self._known[key] = node
        return self._known[key]


def _simplified(op: str, args: tuple) -> Any:
    """Return an operation's result where one of its numbers is 0, 1 or -1, else None."""
    x, y = args[0], args[-1]
    zero_x, zero_y = not isinstance(x, Node) and x == 0, not isinstance(y, Node) and y == 0
    one_x, one_y = not isinstance(x, Node) and x == 1, not isinstance(y, Node) and y == 1
    match op:
        case "add" if zero_x or zero_y:
            return y if zero_x else x
        case "sub" if zero_y:
            return x
        case "sub" if zero_x:
            return -y
        case "sub" if x is y:
            return 0.0
        case "mul" if zero_x or zero_y:
            return 0.0
        case "mul" if one_x or one_y:
            return y if one_x else x
        case "mul" if (not isinstance(x, Node) and x == -1) or (not isinstance(y, Node) and y == -1):
            return -y if not isinstance(x, Node) else -x
        case "div" if zero_x or one_y:
            return x if one_y else 0.0
        case "neg" if x.op == "neg":
            return x.graph.nodes[x.args[0]]
        case "select" if not isinstance(x, Node):
            return args[1] if x else args[2]
        case "select" if args[1] is args[2]:
            return args[1]
        case "and" if not (isinstance(x, Node) and isinstance(y, Node)):
            known, other = (y, x) if isinstance(x, Node) else (x, y)
            return other if known else False
        case "or" if not (isinstance(x, Node) and isinstance(y, Node)):
            known, other = (y, x) if isinstance(x, Node) else (x, y)
            return True if known else other
    return None


def _one(op: str) -> Callable[[Any], Any]:
    return lambda x: x.graph.apply(op, x)


def _two(op: str) -> Callable[[Any, Any], Any]:
    return lambda x, y: x.graph.apply(op, x, y)


def _turned(op: str) -> Callable[[Any, Any], Any]:
    return lambda x, y: x.graph.apply(op, y, x)


class Node:
    """A number, or a truth, that depends on the inputs."""

    __slots__ = ("args", "graph", "index", "op", "value")
    __hash__ = object.__hash__

    def __init__(self, graph: Graph, index: int, op: str, args: tuple, value: Any) -> None:
        """Build a node; `Graph` does."""
        self.graph, self.index, self.op, self.args, self.value = graph, index, op, args, value

    @property
    def before(self) -> tuple[int, ...]:
        """Indices of the nodes it is made of."""
        if self.op in ("input", "const"):
            return ()
        return self.args[:1] if self.op == "item" else self.args

    def __repr__(self) -> str:
        """Return the operation and its arguments, for messages."""
        return f"{self.op}{self.args}"

    def __bool__(self) -> bool:
        """Answer as at the reference state, and keep a guard."""
        if self.op not in ("lt", "le", "eq", "and", "or", "not"):
            raise TypeError("a number that depends on the inputs is not a condition")
        return self.graph.answer(self)

    def __float__(self) -> float:
        """Refuse: the number is not known."""
        raise TypeError("this code needs a plain number where only an expression of the inputs is known")

    def __pow__(self, power: float) -> Any:
        """Return a power; one that is neither a whole number up to 8 nor half of one up to 4 is that of a base from zero up."""
        if power < 0:
            return 1.0 / self**-power
        if power in (0.5, 1.5, 2.5, 3.5):
            return self.sqrt() * (self ** int(power) if power > 1 else 1.0)
        if power != int(power) or not 0 < power <= 8:
            return self.graph.apply("exp", power * self.graph.apply("log", self))
        half = self * self
        rest = half ** (int(power) // 2) if power >= 4 else half if power >= 2 else 1.0
        return rest * self if power % 2 else rest

    __add__, __radd__ = _two("add"), _turned("add")
    __sub__, __rsub__ = _two("sub"), _turned("sub")
    __mul__, __rmul__ = _two("mul"), _turned("mul")
    __truediv__, __rtruediv__ = _two("div"), _turned("div")
    __and__, __or__ = _two("and"), _two("or")
    __lt__, __gt__, __le__, __ge__ = _two("lt"), _turned("lt"), _two("le"), _turned("le")
    __eq__ = _two("eq")  # type: ignore[assignment]
    __neg__, __abs__, __invert__ = _one("neg"), _one("abs"), _one("not")
    sqrt, exp, sin, cos, tanh = _one("sqrt"), _one("exp"), _one("sin"), _one("cos"), _one("tanh")

    def __pos__(self) -> Node:
        """Return the node itself."""
        return self

    def __ne__(self, other: Any) -> Any:
        """Return the opposite of being equal."""
        return self.graph.apply("not", self == other)


def evaluate_graph(graph: Graph, outputs: Sequence[Any], known: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs (N, k) and whether every guard holds (N,), by walking through a graph.

    Args:
        graph: The graph.
        outputs: Its outputs: nodes or numbers.
        known: The input arrays (N, ...) by name.
    """
    n = len(next(iter(known.values())))
    values: dict[int, Any] = {}
    for node in graph.needed(outputs):
        values[node.index] = _value(node, values, known, n)
    shown = [values[x.index] if isinstance(x, Node) else x for x in outputs]
    fine = np.ones(n, bool)
    for index, answer in graph.guards.items():
        fine &= values[index] == answer
    return np.column_stack([np.broadcast_to(x, n) for x in shown]), fine


def _value(node: Node, values: dict[int, Any], known: dict[str, np.ndarray], n: int) -> Any:
    if node.op == "const":
        return node.args[0]
    if node.op == "input":
        name = node.args[0].rstrip("0123456789")
        return known[name][:, int(node.args[0][len(name) :])]
    if node.op == "item":
        return values[node.args[0]][:, node.args[1]]
    args = [values[k] for k in node.args]
    if node.op == "factor":
        size = round(len(args) ** 0.5)
        return np.stack([np.broadcast_to(x, n) for x in args], axis=1).reshape(n, size, size)
    if node.op in ("solve", "solve_t"):
        A = args[0] if node.op == "solve" else np.swapaxes(args[0], 1, 2)
        return np.linalg.solve(A, np.stack([np.broadcast_to(x, n) for x in args[1:]], axis=1)[:, :, None])[:, :, 0]
    with np.errstate(all="ignore"):
        return NUMPY[node.op](*args)


NUMPY: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative, "abs": np.abs, "floor": np.floor,
    "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh,
    "atan2": np.arctan2, "hypot": np.hypot, "sign": np.sign, "min": np.minimum, "max": np.maximum, "select": np.where,
    "lt": np.less, "le": np.less_equal, "eq": np.equal, "and": np.logical_and, "or": np.logical_or,
    "not": np.logical_not,
}  # fmt: skip
"""Implementation of each operation on arrays."""
