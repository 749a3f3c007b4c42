"""C99 functions from expression graphs: one line for each node, in the order of computation.

A function has no allocation, no recursion and no header beyond `math.h`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from tau_dyn.equations.graph import Graph, Node

_FORM: Mapping[str, str] = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}", "abs": "fabs({})", "floor": "floor({})",
    "sqrt": "sqrt({})", "exp": "exp({})", "log": "log({})", "sin": "sin({})", "cos": "cos({})", "tan": "tan({})",
    "tanh": "tanh({})", "atan2": "atan2({}, {})", "hypot": "hypot({}, {})", "sign": "(double)(({0} > 0.0) - ({0} < 0.0))",
    "min": "({0} < {1} ? {0} : {1})", "max": "({0} > {1} ? {0} : {1})", "select": "({} ? {} : {})", "lt": "{} < {}",
    "le": "{} <= {}", "eq": "{} == {}", "and": "{} && {}", "or": "{} || {}", "not": "!{}",
}  # fmt: skip
_TRUTHS = frozenset({"lt", "le", "eq", "and", "or", "not"})


def yield_graph_lines(graph: Graph, outputs: Sequence[Any]) -> Iterator[str]:
    """Yield one line a node that outputs and guards need; an input `q3` is read as `q[3]`, node 7 is called `t7`."""

    def show(k: int) -> str:
        return _shown(graph.nodes[k])

    for node in graph.needed(outputs):
        k = node.index
        if node.op in ("input", "const", "item"):
            continue
        if node.op == "factor":
            n = round(len(node.args) ** 0.5)
            yield f"    double t{k}[{len(node.args)}] = {{{', '.join(show(x) for x in node.args)}}};"
            yield f"    int t{k}p[{n}];"
            yield f"    if (!factor({n}, t{k}, t{k}p)) return 2;"
        elif node.op in ("solve", "solve_t"):
            n, A = len(node.args) - 1, node.args[0]
            yield f"    double t{k}[{n}] = {{{', '.join(show(x) for x in node.args[1:])}}};"
            yield f"    {node.op}({n}, t{A}, t{A}p, t{k});"
        else:
            kind = "int" if node.op in _TRUTHS else "double"
            yield f"    const {kind} t{k} = {_FORM[node.op].format(*(show(x) for x in node.args))};"


def yield_guard_lines(graph: Graph, status: int = 1) -> Iterator[str]:
    """Yield one line for each condition evaluated during tracing: if its result differs, the function returns."""
    for index, answer in graph.guards.items():
        yield f"    if ({'!' if answer else ''}t{index}) return {status};"


def yield_output_lines(array: str, outputs: Sequence[Any]) -> Iterator[str]:
    """Yield the assignments of an output array."""
    for k, x in enumerate(outputs):
        yield f"    {array}[{k}] = {_shown(x) if isinstance(x, Node) else format_number(float(x))};"


def yield_unused_lines(graph: Graph, outputs: Sequence[Any], arrays: Sequence[str]) -> Iterator[str]:
    """Yield a line for each input array that does not matter, so that no compiler warns of it."""
    used = {node.args[0].rstrip("0123456789") for node in graph.needed(outputs) if node.op == "input"}
    yield from (f"    (void){x}; /* does not matter */" for x in arrays if x not in used)


def yield_function(
    head: str, graph: Graph, takes: Sequence[str], gives: Mapping[str, Sequence[Any]], *, checked: bool = True
) -> Iterator[str]:
    """Yield a function that assigns each output array; `checked`: it returns 0, or 1 where a guard does not hold."""
    values = [x for outputs in gives.values() for x in outputs]
    yield from (head, "{")
    yield from yield_unused_lines(graph, values, takes)
    yield from yield_graph_lines(graph, values)
    if checked:
        yield from yield_guard_lines(graph)
    for name, outputs in gives.items():
        yield from yield_output_lines(name, outputs)
    yield from (*(["    return 0;"] if checked else []), "}")


def _shown(node: Node) -> str:
    if node.op == "const":
        return format_number(node.args[0])
    if node.op == "input":
        name = node.args[0].rstrip("0123456789")
        return f"{name}[{node.args[0][len(name) :]}]"
    if node.op == "item":
        return f"t{node.args[0]}[{node.args[1]}]"
    return f"t{node.index}"


def format_number(x: float) -> str:
    """Return a number as C reads it back to the last digit."""
    text = repr(float(x))
    return f"({text})" if x < 0 else text
