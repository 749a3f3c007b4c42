"""A feedforward as C99: one function without allocation, recursion or libraries beyond math.h, and its header.

The code is the program's graph, a line a node, in the order of computation. With loops that are solved numerically a function for
gap and Jacobian stands beside it, called a bounded number of times; the last configuration is where the next call starts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from tau_dyn.control.export_model import Program
from tau_dyn.control.export_text import about
from tau_dyn.control.graph import Graph, Node
from tau_dyn.exceptions import InputError

_FORM: Mapping[str, str] = {
    "add": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}", "abs": "fabs({})",
    "sqrt": "sqrt({})", "exp": "exp({})", "log": "log({})", "sin": "sin({})", "cos": "cos({})", "tan": "tan({})",
    "tanh": "tanh({})", "atan2": "atan2({}, {})", "hypot": "hypot({}, {})", "sign": "(double)(({0} > 0.0) - ({0} < 0.0))",
    "min": "({0} < {1} ? {0} : {1})", "max": "({0} > {1} ? {0} : {1})", "select": "({} ? {} : {})", "lt": "{} < {}",
    "le": "{} <= {}", "eq": "{} == {}", "and": "{} && {}", "or": "{} || {}", "not": "!{}",
}  # fmt: skip
_TRUTHS = frozenset({"lt", "le", "eq", "and", "or", "not"})

STEP, STEPS, ITERATIONS, CLOSED = 0.05, 100, 12, 1e-9
"""Largest step of a joint at once [m or rad], most steps a call, most Newton iterations a step, largest gap left [m]."""


def c_source(program: Program, name: str = "tau_ff") -> tuple[str, str]:
    """Return a feedforward as C: the source and its header.

    Args:
        program: From `build_program`.
        name: Of the function; also of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name):
        raise InputError(f"'{name}' cannot name a function in C; use letters, digits and underscores, a letter first")
    words = [line.replace("*/", "* /") for line in about(program)]
    comment = "\n".join(f" * {line}".rstrip() for line in words)
    returns = _returns(program)
    header = "\n".join(
        [
            f"/*\n{comment}\n *",
            *(f" * {line}" for line in returns),
            " */",
            f"#ifndef {name.upper()}_H",
            f"#define {name.upper()}_H",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            f"#define {name.upper()}_JOINTS {program.feedforward.model.robot.na}",
            *_declared(program, name),
            "",
            "#ifdef __cplusplus",
            "}",
            "#endif",
            f"#endif /* {name.upper()}_H */",
            "",
        ]
    )
    top = [
        f"/* {words[0]} Units, joints and provenance: {name}.h */",
        f'#include "{name}.h"',
        "",
        "#include <math.h>",
        "",
    ]
    body = _with_loops(program, name) if program.loops is not None else _plain(program, name)
    return "\n".join([*top, *body, ""]), header


def _returns(program: Program) -> list[str]:
    lines = [
        "Returns 0; 1 where the position is out of reach, or beside the sort of state it was written for.",
        "Then tau is left as it was. No allocation, no state" + (":" if program.loops is None else " but `start`:"),
        "safe in an interrupt and in several threads.",
    ]
    if program.loops is not None:
        lines += [
            "The loops are solved by Newton's method from `start`, which holds the last configuration: set it once with",
            f"the _start function. A joint that moved more than {STEP:g} m or rad since is followed in steps of that",
            f"size, at most {STEPS} of them, each of at most {ITERATIONS} iterations. 2: the loops could not be closed.",
        ]
    return lines


def _arguments(program: Program) -> str:
    n = program.feedforward.model.robot.na
    names = ["q", "v", "a", *program.signals]
    return ", ".join([*(f"const double {x}[{n}]" for x in names), f"double tau[{n}]"])


def _declared(program: Program, name: str) -> list[str]:
    if program.loops is None:
        return [f"int {name}({_arguments(program)});"]
    size = f"{name.upper()}_START"
    n = program.feedforward.model.robot.na + len(program.loops.passive)
    return [
        f"#define {size} {n}",
        f"void {name}_start(double start[{size}]);",
        f"int {name}(double start[{size}], {_arguments(program)});",
    ]


def _plain(program: Program, name: str) -> Iterator[str]:
    yield f"int {name}({_arguments(program)})"
    yield "{"
    yield from _forces(program)
    yield "}"


def _forces(program: Program) -> Iterator[str]:
    """Yield the body that computes the forces and leaves with a status."""
    used = {node.args[0].rstrip("0123456789") for node in program.graph.needed(program.outputs) if node.op == "input"}
    yield from (f"    (void){x}; /* does not matter */" for x in ("q", "v", "a", *program.signals) if x not in used)
    yield from _lines(program.graph, program.outputs, {})
    for index, answer in program.graph.guards.items():
        yield f"    if ({'!' if answer else ''}t{index}) return 1;"
    for k, x in enumerate(program.outputs):
        yield f"    tau[{k}] = {_named(x)};"
    yield "    return 0;"


def _lines(graph: Graph, outputs: Sequence[Any], inputs: Mapping[str, str]) -> Iterator[str]:
    """Yield one line a node; `inputs` renames arrays of inputs."""
    show: Callable[[int], str] = lambda k: _shown(graph.nodes[k], inputs)  # noqa: E731
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


def _shown(node: Node, inputs: Mapping[str, str] | None = None) -> str:
    if node.op == "const":
        return _number(node.args[0])
    if node.op == "input":
        name = node.args[0].rstrip("0123456789")
        return f"{(inputs or {}).get(name, name)}[{node.args[0][len(name) :]}]"
    if node.op == "item":
        return f"t{node.args[0]}[{node.args[1]}]"
    return f"t{node.index}"


def _named(x: Any, inputs: Mapping[str, str] | None = None) -> str:
    return _shown(x, inputs) if isinstance(x, Node) else _number(float(x))


def _number(x: float) -> str:
    text = repr(float(x))
    return f"({text})" if x < 0 else text


def _with_loops(program: Program, name: str) -> Iterator[str]:
    loops, graph = program.loops, program.closure
    assert loops is not None and graph is not None
    robot, n = program.feedforward.model.robot, len(loops.passive)
    yield from _LINEAR.splitlines()
    yield ""
    yield f"/* Gap of every loop [m] and, of those solved, the derivative by the {n} passive joints. */"
    outputs = f"double gap[{len(program.gap)}], double J[{n * n}]"
    yield f"static void closure(const double q[{robot.na}], const double p[{n}], {outputs})"
    yield "{"
    flat = [x for row in program.jacobian for x in row]
    yield from _lines(graph, [*program.gap, *flat], {})
    for array, values in (("gap", program.gap), ("J", flat)):
        for k, x in enumerate(values):
            yield f"    {array}[{k}] = {_named(x)};"
    yield "}"
    yield ""
    home = [*robot.home, *loops.home[loops.passive]]
    text = _CLOSE.replace("@NAME@", name).replace("@NA@", str(robot.na)).replace("@NP@", str(n))
    text = text.replace("@NG@", str(len(program.gap))).replace("@HOME@", ", ".join(repr(float(x)) for x in home))
    text = text.replace("@ROWS@", ", ".join(str(r) for r in loops.rows)).replace("@STEP@", repr(STEP))
    text = (
        text.replace("@STEPS@", str(STEPS)).replace("@ITERATIONS@", str(ITERATIONS)).replace("@CLOSED@", repr(CLOSED))
    )
    yield from text.splitlines()
    yield ""
    yield f"int {name}(double start[{name.upper()}_START], {_arguments(program)})"
    yield "{"
    yield f"    const double *p = start + {robot.na};"
    yield "    if (!closed(start, q)) return 2;"
    yield from _forces(program)
    yield "}"


_LINEAR = """\
/* LU factors of a matrix, row by row in place, with row exchanges; 0 where it is singular. */
static int factor(int n, double *A, int *rows)
{
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i) if (fabs(A[i * n + k]) > fabs(A[best * n + k])) best = i;
        rows[k] = best;
        if (!(fabs(A[best * n + k]) > 1e-12)) return 0;
        if (best != k) for (int j = 0; j < n; ++j) {
            const double x = A[k * n + j];
            A[k * n + j] = A[best * n + j];
            A[best * n + j] = x;
        }
        const double inverse = 1.0 / A[k * n + k];
        for (int i = k + 1; i < n; ++i) {
            const double x = A[i * n + k];
            if (x == 0.0) continue;
            A[i * n + k] = x * inverse;
            for (int j = k + 1; j < n; ++j) A[i * n + j] -= A[i * n + k] * A[k * n + j];
        }
    }
    return 1;
}

/* b becomes the x of A x = b. */
static void solve(int n, const double *A, const int *rows, double *b)
{
    for (int k = 0; k < n; ++k) {
        const double x = b[rows[k]];
        b[rows[k]] = b[k];
        b[k] = x;
    }
    for (int i = 1; i < n; ++i) for (int j = 0; j < i; ++j) b[i] -= A[i * n + j] * b[j];
    for (int i = n - 1; i >= 0; --i) {
        for (int j = i + 1; j < n; ++j) b[i] -= A[i * n + j] * b[j];
        b[i] /= A[i * n + i];
    }
}

/* b becomes the x of A' x = b. */
static void solve_t(int n, const double *A, const int *rows, double *b)
{
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < i; ++j) b[i] -= A[j * n + i] * b[j];
        b[i] /= A[i * n + i];
    }
    for (int i = n - 2; i >= 0; --i) for (int j = i + 1; j < n; ++j) b[i] -= A[j * n + i] * b[j];
    for (int k = n - 1; k >= 0; --k) {
        const double x = b[rows[k]];
        b[rows[k]] = b[k];
        b[k] = x;
    }
}"""

_CLOSE = """\
static const double home[@NA@ + @NP@] = {@HOME@};
static const int solved[@NP@] = {@ROWS@};

void @NAME@_start(double start[@NA@ + @NP@])
{
    for (int k = 0; k < @NA@ + @NP@; ++k) start[k] = home[k];
}

/* Newton's method on the passive joints p at drives q; 0 where it does not end with closed loops. */
static int newton(const double *q, double *p)
{
    double gap[@NG@], J[@NP@ * @NP@], step[@NP@];
    int rows[@NP@];
    for (int k = 0; k < @ITERATIONS@; ++k) {
        double most = 0.0, size = 0.0;
        closure(q, p, gap, J);
        if (!factor(@NP@, J, rows)) return 0;
        for (int i = 0; i < @NP@; ++i) step[i] = -gap[solved[i]];
        solve(@NP@, J, rows, step);
        for (int i = 0; i < @NP@; ++i) if (fabs(step[i]) > most) most = fabs(step[i]);
        for (int i = 0; i < @NP@; ++i) p[i] += most > 0.5 ? step[i] * 0.5 / most : step[i];
        for (int i = 0; i < @NG@; ++i) if (!(fabs(gap[i]) <= size)) size = fabs(gap[i]);
        if (size < 1e-7) return most < @CLOSED@ * 1e3; /* the step just taken leaves its square */
    }
    return 0;
}

/* Follow the drives from start to q in bounded steps; start is moved along only where this ends well. */
static int closed(double *start, const double *q)
{
    double at[@NA@], p[@NP@], far = 0.0;
    for (int k = 0; k < @NP@; ++k) p[k] = start[@NA@ + k];
    for (int k = 0; k < @NA@; ++k) if (!(fabs(q[k] - start[k]) <= far)) far = fabs(q[k] - start[k]);
    if (!(far <= @STEP@ * @STEPS@)) return 0;
    const int steps = far > @STEP@ ? (int)ceil(far / @STEP@) : 1;
    for (int i = 1; i <= steps; ++i) {
        for (int k = 0; k < @NA@; ++k) at[k] = i == steps ? q[k] : start[k] + (q[k] - start[k]) * i / steps;
        if (!newton(at, p)) return 0;
    }
    for (int k = 0; k < @NA@; ++k) start[k] = q[k];
    for (int k = 0; k < @NP@; ++k) start[@NA@ + k] = p[k];
    return 1;
}"""
