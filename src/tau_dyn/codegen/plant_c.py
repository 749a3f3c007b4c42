"""A plant in C: its equations as functions, the simulator's step (`c/plant.c`), and whole runs of it (`c/plant_run.c`).

Nothing of a model's numbers is in the source but its geometry and its effects' settings: parameters, gains, references and steps
are given when it runs. So one library serves all values of a model's parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tau_dyn.codegen.c_writer import STEP, fill_template, yield_function
from tau_dyn.codegen.feedforward_c import yield_closing_parts
from tau_dyn.codegen.plant_equations import Equations
from tau_dyn.codegen.tracing import TracedFunction

_FURTHER = ("memory", "tool", "encoders", "encoder_memory")


def write_plant_source(equations: Equations) -> str:
    """Return C99 that steps a plant from sample to sample; see `c/plant_run.c` for its interface."""
    return "\n\n".join(_yield_parts(equations)) + "\n"


def _yield_parts(equations: Equations) -> Iterator[str]:
    na = equations.model.robot.na
    read = equations.encoder_memory
    sizes = {
        "NA": na,
        "NP": len(equations.loops.passive) if equations.loops is not None else 0,
        "NTHETA": max(1, len(equations.parameters)),
        "NM": max(1, 0 if equations.memory is None else equations.memory.arguments["m"]),
        "NR": max(1, na * len(equations.warm)),
        "NS": max(1, 0 if read is None else read.arguments["m"]),
    }
    yield "#include <math.h>\n#include <stdint.h>\n#include <string.h>"
    yield f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};"
    yield fill_template("checks")
    yield from yield_plant_parts(equations, _FURTHER)
    flags = {name.upper() for name in _FURTHER if getattr(equations, name) is not None}
    flags |= {"WARM"} if equations.warm else set()
    shown = "s->shown, " if read is not None else ""
    yield fill_template("plant_run", flags | (set() if equations.encoders else {"TRUE"}), SHOWN=shown)


def yield_plant_parts(equations: Equations, further: Sequence[str]) -> Iterator[str]:
    """Yield a plant's equations, some further parts by name, and its step; `PASSIVE`, `REMEMBERED` and `CLOSED` are defined."""
    loops, remembers = equations.loops, equations.memory is not None or bool(equations.warm)
    felt = ("(s)->memory, " if equations.memory is not None else "") + ("(s)->felt," if equations.warm else "")
    yield "\n".join(
        (
            f"#define PASSIVE(s) {'(s)->start + NA,' if loops is not None else ''}",
            f"#define REMEMBERED(s) {felt}",
            f"#define CLOSED(s) {'(close_loops(s) ? 0 : 2)' if loops is not None else '0'}",
        )
    )
    if loops is not None and equations.closure is not None:
        yield from yield_closing_parts(loops, equations.closure, "plant")
    moved = {f"theta[{k}]": f"theta[{i}]" for i, k in enumerate(equations.parameters)}
    for name in ("dynamics", "friction", "mass", *further):
        part: TracedFunction | None = getattr(equations, name)
        if part is not None:
            yield _write_part(name, part, moved)
    flags = {"FRICTION": equations.friction, "MASS": equations.mass, "REMEMBERS": remembers or None, "LOOPS": loops}
    yield fill_template("plant", {flag for flag, part in flags.items() if part is not None}, STEP=repr(STEP))


def _write_part(name: str, part: TracedFunction, moved: dict[str, str]) -> str:
    """Return one part as a function that leaves with 0, or with 1 where the robot cannot be; parameters by their places."""
    takes = ", ".join(f"const double *{array}" for array in part.arguments)
    gives = ", ".join(f"double {array}[{len(values)}]" for array, values in part.outputs.items())
    head = f"static int {name}({takes}, {gives})"
    text = "\n".join(yield_function(head, part.graph, list(part.arguments), part.outputs))
    pieces = text.split("theta[")
    for k, piece in enumerate(pieces[1:], start=1):
        index, _, rest = piece.partition("]")
        pieces[k] = moved[f"theta[{index}]"] + rest
    return "".join(pieces)
