"""A feedforward as C99: one function, and where loops are solved numerically the closing of these before it.

Newton's method follows the passive joints from the last configuration in bounded steps (`c/follow.c`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn.codegen.c_writer import (
    ITERATIONS,
    MAX_NUMBER,
    STEP,
    STEPS,
    fill_template,
    format_header,
    format_source,
    list_numbers,
    require_c_name,
)
from tau_dyn.codegen.loops import Loops
from tau_dyn.codegen.program import Program, yield_description
from tau_dyn.equations import TracedFunction, yield_function, yield_graph_lines, yield_guard_lines, yield_output_lines

_TAKEN = frozenset(
    {
        "factor",
        "solve",
        "solve_t",
        "equations",
        "home",
        "solved",
        "newton",
        "follow",
        "moved",
        "largest",
        "sound",
        "limit",
        "force",
    }
)
"""Functions and tables of the source itself."""


def write_c_source(program: Program, name: str = "tau_ff", *, limited: bool = True) -> tuple[str, str]:
    """Return a feedforward as C: the source and its header.

    Args:
        program: From `build_program`.
        name: Name of the function and of the header, `name.h`.
        limited: Refuse forces beyond the joints' limits.

    Raises:
        InputError: The name is no identifier of C, or means something else there.
    """
    require_c_name(name, _TAKEN)
    words = list(yield_description(program))
    header = format_header(name, [*words, "", *_list_statuses(program)], _list_declarations(program, name))
    effort = (
        program.feedforward.model.robot.effort_limit if limited else np.full_like(program.feedforward.width, MAX_NUMBER)
    )
    return format_source(name, words[0], _yield_parts(program, name, effort)), header


def _list_statuses(program: Program) -> list[str]:
    solved = program.loops is not None
    lines = [
        f"Returns 0, or else leaves tau{' and start' * solved} alone and returns",
        f"  1  an input or a force is no number or beyond {MAX_NUMBER:g}, the position is out of reach,",
        "     or it is outside the set of states for which the function was written",
        *(["  2  the loops could not be closed"] if solved else []),
        "  3  a force is beyond its joint's limit above",
        "Compile without -ffast-math, which takes the checks of numbers away. No allocation, no state"
        + (" but `start`:" if solved else ":"),
        "safe in an interrupt and in several threads.",
    ]
    if solved:
        lines += [
            "The loops are solved by Newton's method from `start`, which holds the last configuration: set it once with",
            f"the _start function. A joint that moved more than {STEP:g} m or rad since is followed in steps of that",
            f"size, at most {STEPS} of them, each of at most {ITERATIONS} iterations.",
        ]
    return lines


def _list_arguments(program: Program) -> list[str]:
    return ["q", "v", "a", *program.signals]


def _format_signature(program: Program, name: str) -> str:
    n = program.feedforward.model.robot.na
    start = [f"double start[{name.upper()}_START]"] if program.loops is not None else []
    arguments = [*start, *(f"const double {x}[{n}]" for x in _list_arguments(program)), f"double tau[{n}]"]
    return f"int {name}({', '.join(arguments)})"


def _list_declarations(program: Program, name: str) -> list[str]:
    upper, na = name.upper(), program.feedforward.model.robot.na
    lines = [f"#define {upper}_JOINTS {na}"]
    if program.loops is not None:
        size = f"{upper}_START"
        lines += [f"#define {size} {na + len(program.loops.passive)}", f"void {name}_start(double start[{size}]);"]
    return [*lines, f"{_format_signature(program, name)};"]


def _yield_parts(program: Program, name: str, effort: np.ndarray) -> Iterator[str]:
    robot = program.feedforward.model.robot
    yield f"enum {{ NA = {robot.na} }};"
    yield fill_template("checks")
    if program.loops is not None and program.closure is not None:
        transposed = program.graph.uses("solve_t", program.outputs)
        yield from yield_closing_parts(program.loops, program.closure, name, transposed=transposed)
    yield f"static const double limit[NA] = {{{list_numbers(np.minimum(effort, MAX_NUMBER))}}};"
    yield "\n".join(_yield_body(program, name))


def _yield_body(program: Program, name: str) -> Iterator[str]:
    arguments = _list_arguments(program)
    yield _format_signature(program, name)
    yield "{"
    yield f"    if ({' || '.join(f'!sound(NA, {x})' for x in arguments)}) return 1;"
    if program.loops is not None:
        yield "    double next[NA + NZ];"
        yield "    for (int k = 0; k < NA + NZ; ++k) next[k] = start[k];"
        yield "    if (!follow(next, q)) return 2;"
        yield "    const double *p = next + NA;"
    yield from yield_graph_lines(program.graph, program.outputs)
    yield from yield_guard_lines(program.graph)
    yield "    double force[NA];"
    yield from yield_output_lines("force", program.outputs)
    yield "    if (!sound(NA, force)) return 1;"
    yield "    for (int k = 0; k < NA; ++k) if (fabs(force[k]) > limit[k]) return 3;"
    yield "    for (int k = 0; k < NA; ++k) tau[k] = force[k];"
    if program.loops is not None:
        yield "    for (int k = 0; k < NA + NZ; ++k) start[k] = next[k];"
    yield "    return 0;"
    yield "}"


def yield_closing_parts(loops: Loops, closure: TracedFunction, name: str, *, transposed: bool) -> Iterator[str]:
    """Yield the functions that close the loops of `NA` drives: `follow(start, q)` is the one to call, `name_start` sets home.

    `transposed` adds the function that solves with transposed matrices.
    """
    n, gaps = len(loops.passive), len(closure.outputs["gap"])
    yield f"enum {{ NT = {n}, NZ = {n}, NG = {gaps}, WIDE = {n} }};"
    yield fill_template("linear", {"TRANSPOSED"} if transposed else ())
    head = (
        f"/* Gap of every loop [m] and, of those solved, the derivative by the {n} passive joints. */\n"
        f"static void equations(const double *q, const double *p, double gap[{gaps}], double J[{n * n}])"
    )
    yield "\n".join(yield_function(head, closure.graph, ["q", "p"], closure.outputs, checked=False))
    home = list_numbers([*loops.robot.home, *loops.home[loops.passive]])
    yield fill_template("start", NAME=name, HOME=home)
    yield fill_follow(loops.rows, {"JOINTS", "DIRECT"})


def fill_follow(rows: list[int], flags: set[str], side: str = "1") -> str:
    """Return the text that follows drives from the last configuration; see `c/follow.c`."""
    return fill_template(
        "follow", flags, ROWS=", ".join(map(str, rows)), SIDE=side, STEP=repr(STEP), STEPS=STEPS, ITERATIONS=ITERATIONS
    )
