"""The C source of an FMU: the model's equations as functions, the simulator's step, the functions of FMI, in one file.

`c/fmu_plant.c` is the simulator's time step, leapfrog with sharp friction, as `simulate/plant.py` and `simulate/slip.py` have
it: with equal steps the trajectory is the simulator's but for rounding. `c/fmu_interface.c` are the functions of FMI 2.0 for
co-simulation; a step that cannot be made leaves the state as it was, is logged, and is an error. An instance is one block of
memory, so its state is stored and restored as bytes. Reference: FMI for Model Exchange and Co-Simulation 2.0.4.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn.codegen.c_writer import escape_comment_line, fill_template, list_numbers, yield_function
from tau_dyn.codegen.feedforward_c import yield_closing_parts
from tau_dyn.codegen.fmu_equations import Equations
from tau_dyn.codegen.tracing import TracedFunction


def write_fmu_source(equations: Equations, guid: str, about: str) -> str:
    """Return the source, which needs no header of others beyond the C library's; `about` says what it is, in a paragraph."""
    return "\n\n".join(_yield_parts(equations, guid, about)) + "\n"


def _yield_parts(equations: Equations, guid: str, about: str) -> Iterator[str]:
    model, loops = equations.model, equations.loops
    yield f"/* {escape_comment_line(about)} FMI 2.0 for co-simulation; C99. */\n" + "\n".join(
        f"#include <{name}.h>" for name in ("math", "stddef", "stdlib", "string")
    )
    sizes = {
        "NA": model.robot.na,
        "NP": len(loops.passive) if loops is not None else 0,
        "NTHETA": max(1, len(equations.parameters)),
        "NTOOL": 3 if equations.tool else 0,
    }
    yield f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};"
    yield "\n".join(_yield_macros(equations, guid))
    names, values = model.parameters.names, model.parameters.values
    places = list(equations.parameters)
    yield "\n".join(
        (
            f"/* Parameters: {escape_comment_line(', '.join(names[k] for k in places)) or 'none'}. */",
            f"static const double nominal[NTHETA] = {{{list_numbers(values[places] if places else np.zeros(1))}}};",
            f"static const double home_position[NA] = {{{list_numbers(model.robot.home)}}};",
        )
    )
    yield fill_template("checks")
    if loops is not None and equations.closure is not None:
        yield from yield_closing_parts(loops, equations.closure, "plant")
    moved = {f"theta[{k}]": f"theta[{i}]" for i, k in enumerate(places)}
    for name in ("dynamics", "friction", "tool"):
        part: TracedFunction | None = getattr(equations, name)
        if part is not None:
            yield _write_part(name, part, moved)
    yield fill_template("fmu_plant", {"FRICTION"} if equations.friction is not None else ())
    yield fill_template("fmu_interface")


def _yield_macros(equations: Equations, guid: str) -> Iterator[str]:
    solved = equations.loops is not None
    yield f'#define GUID "{guid}"'
    yield f"#define PASSIVE(s) {'(s)->start + NA,' if solved else ''}"
    yield f"#define CLOSED(s) {'(follow((s)->start, (s)->q) ? 0 : 2)' if solved else '0'}"
    yield f"#define START(s) {'plant_start((s)->start)' if solved else '((void)0)'}"
    yield f"#define TOOL(s, x) {'tool((s)->q, PASSIVE(s) x)' if equations.tool else '0'}"


def _write_part(name: str, part: TracedFunction, moved: dict[str, str]) -> str:
    """Return one part as a function that leaves with 0, or with 1 where the robot cannot be; parameters by their FMU's places."""
    takes = ", ".join(f"const double *{array}" for array in part.arguments)
    gives = ", ".join(f"double {array}[{len(values)}]" for array, values in part.outputs.items())
    head = f"static int {name}({takes}, {gives})"
    text = "\n".join(yield_function(head, part.graph, list(part.arguments), part.outputs))
    pieces = text.split("theta[")
    for k, piece in enumerate(pieces[1:], start=1):
        index, _, rest = piece.partition("]")
        pieces[k] = moved[f"theta[{index}]"] + rest
    return "".join(pieces)
