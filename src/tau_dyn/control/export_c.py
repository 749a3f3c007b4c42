"""A feedforward as C99: one function without allocation, recursion or libraries beyond math.h, and its header.

The code is the program's graph, a line a node, in the order of computation. With loops that are solved numerically the last
configuration is where the next call starts (`export_c_loops.py`).
"""

from __future__ import annotations

from collections.abc import Iterator

from tau_dyn.control.export_c_graph import guard_lines, yield_graph_lines, yield_output_lines, yield_unused_lines
from tau_dyn.control.export_c_loops import yield_closing_lines
from tau_dyn.control.export_c_newton import ITERATIONS, STEP, STEPS
from tau_dyn.control.export_c_text import format_header, format_source, require_c_name
from tau_dyn.control.export_model import Program
from tau_dyn.control.export_text import yield_description

_TAKEN = frozenset({"factor", "solve", "solve_t", "closure", "home", "solved", "newton", "closed"})
"""Functions and tables of the source itself."""


def write_c_source(program: Program, name: str = "tau_ff") -> tuple[str, str]:
    """Return a feedforward as C: the source and its header.

    Args:
        program: From `build_program`.
        name: Of the function; also of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C, or means something else there.
    """
    require_c_name(name, _TAKEN)
    words = list(yield_description(program))
    joints = f"#define {name.upper()}_JOINTS {program.feedforward.model.robot.na}"
    declared = format_header(name, [*words, "", *_returns(program)], [joints, *_declared(program, name)])
    return format_source(name, words[0], _body(program, name)), declared


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


def _body(program: Program, name: str) -> Iterator[str]:
    if program.loops is None:
        yield f"int {name}({_arguments(program)})"
        yield "{"
    else:
        yield from yield_closing_lines(program, name)
        yield ""
        yield f"int {name}(double start[{name.upper()}_START], {_arguments(program)})"
        yield "{"
        yield f"    const double *p = start + {program.feedforward.model.robot.na};"
        yield "    if (!closed(start, q)) return 2;"
    yield from yield_unused_lines(program.graph, program.outputs, ["q", "v", "a", *program.signals])
    yield from yield_graph_lines(program.graph, program.outputs)
    yield from guard_lines(program.graph)
    yield from yield_output_lines("tau", program.outputs)
    yield "    return 0;"
    yield "}"
