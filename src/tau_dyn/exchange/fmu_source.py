"""The C source of an FMU: the model's equations as functions, the simulator's step, the functions of FMI, in one file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tau_dyn.control import (
    Feedforward,
    Program,
    escape_comment_line,
    format_number,
    guard_lines,
    yield_closing_lines,
    yield_graph_lines,
    yield_output_lines,
    yield_unused_lines,
)
from tau_dyn.exchange.content import list_nominal_parameters
from tau_dyn.exchange.fmu_equations import EquationFunction, Equations
from tau_dyn.exchange.fmu_interface import INTERFACE
from tau_dyn.exchange.fmu_plant import PLANT
from tau_dyn.exchange.fmu_states import STATES
from tau_dyn.model import Model
from tau_dyn.version import __version__


def format_source(equations: Equations, guid: str) -> str:
    """Return the source, which needs no header of others beyond the C library's."""
    return "\n".join(_lines(equations, guid)) + "\n"


def _lines(equations: Equations, guid: str) -> Iterator[str]:
    model, loops = equations.model, equations.loops
    na, nt = model.robot.na, max(1, len(equations.parameters))
    passive = len(loops.passive) if loops is not None else 0
    yield f"/* {escape_comment_line(describe_fmu(model))} FMI 2.0 for co-simulation; C99. */"
    yield from ("#include <math.h>", "#include <stddef.h>", "#include <stdlib.h>", "#include <string.h>", "")
    sizes = {
        "NA": na,
        "NP": passive,
        "NT": nt,
        "NX": 3 if equations.tool else 0,
        "HAS_FRICTION": int(bool(equations.friction)),
    }
    yield from (f"#define {name} {value}" for name, value in sizes.items())
    yield f'#define GUID "{guid}"'
    yield f"#define PASSIVE(s) {'(s)->start + NA,' if loops is not None else ''}"
    yield f"#define CLOSED(s) {'(closed((s)->start, (s)->q) ? 0 : 2)' if loops is not None else '0'}"
    yield f"#define START(s) {'plant_start((s)->start)' if loops is not None else '((void)0)'}"
    yield f"#define TOOL(s, x) {'tool((s)->q, PASSIVE(s) x)' if equations.tool else '0'}"
    names = model.parameters.names
    values = model.parameters.values
    yield ""
    yield f"/* Parameters: {escape_comment_line(', '.join(names[k] for k in equations.parameters)) or 'none'}. */"
    yield _array("nominal", [float(values[k]) for k in equations.parameters] or [0.0])
    yield _array("home_position", [float(x) for x in model.robot.home])
    yield ""
    if loops is not None:
        yield from yield_closing_lines(_closing(equations), "plant")
        yield ""
    place = {f"theta{k}": f"theta[{i}]" for i, k in enumerate(equations.parameters)}
    parts = {"dynamics": equations.dynamics, "friction": equations.friction, "tool": equations.tool}
    for name, part in parts.items():
        if part is not None:
            yield from _function(name, part, na, passive, place)
            yield ""
    yield PLANT if equations.friction is not None else _without_friction(PLANT)
    yield INTERFACE
    yield STATES


def describe_fmu(model: Model) -> str:
    """Return what an FMU says of itself, in one paragraph."""
    leaning = list_nominal_parameters(model)
    effects = ", ".join(effect.name for effect in model.effects) or "none"
    text = f"{model.robot.name}, written by tau_dyn {__version__} from {model.robot.source}. Effects: {effects}."
    return text + (f" Not determined by data, so nominal: {', '.join(leaning)}." if leaning else "")


def _function(name: str, part: EquationFunction, na: int, passive: int, place: dict[str, str]) -> Iterator[str]:
    """Yield one part as a function that leaves with 0, or with 1 where the robot cannot be."""
    takes = [f"const double *{array}" for array in part.takes]
    gives = [f"double {array}[{len(values)}]" for array, values in part.gives.items()]
    yield f"static int {name}({', '.join([*takes, *gives])})"
    yield "{"
    yield from yield_unused_lines(part.graph, part.outputs, part.takes)
    for line in (*yield_graph_lines(part.graph, part.outputs), *guard_lines(part.graph)):
        yield _renamed(line, place)
    for array, values in part.gives.items():
        yield from (_renamed(line, place) for line in yield_output_lines(array, values))
    yield "    return 0;"
    yield "}"


def _renamed(line: str, place: dict[str, str]) -> str:
    """Return a line with the model's places of parameters changed for those among the FMU's."""
    parts = line.split("theta[")
    out = [parts[0]]
    for part in parts[1:]:
        index, _, rest = part.partition("]")
        out.append(place[f"theta{index}"] + rest)
    return "".join(out)


def _without_friction(text: str) -> str:
    """Return the plant without the functions that only friction needs."""
    start, end = text.index("/* u = free - A f"), text.index("/* The velocity u half a step after")
    return text[:start] + text[end:]


def _closing(equations: Equations) -> Program:
    """Return what writes the closing of loops."""
    part, loops = equations.closure, equations.loops
    assert part is not None and loops is not None
    n, flat = len(loops.passive), part.gives["J"]
    rows = tuple(flat[k * n : (k + 1) * n] for k in range(n))
    feedforward = Feedforward(equations.model.only(()))
    return Program(feedforward, part.graph, (), (), loops, part.graph, part.gives["gap"], rows)


def _array(name: str, values: Sequence[float]) -> str:
    return f"static const double {name}[{len(values)}] = {{{', '.join(format_number(x) for x in values)}}};"
