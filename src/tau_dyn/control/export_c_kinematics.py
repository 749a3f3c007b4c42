"""Kinematics as C99: `name_fk`, `name_jacobian` and `name_ik`, without allocation, recursion or state but the caller's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tau_dyn.control import export_c_inverse as search, export_c_newton as text
from tau_dyn.control.export_c_graph import guard_lines, yield_graph_lines, yield_output_lines, yield_unused_lines
from tau_dyn.control.export_c_linear import FACTOR, SOLVE
from tau_dyn.control.export_c_text import format_header, format_numbers, format_source, require_c_name
from tau_dyn.control.export_kinematics import KinematicsProgram
from tau_dyn.control.export_kinematics_text import list_declarations, needs_start, yield_kinematics_description
from tau_dyn.control.expression_arrays import TracedFunction
from tau_dyn.version import __version__


def write_kinematics_source(program: KinematicsProgram, name: str = "robot") -> tuple[str, str]:
    """Return kinematics as C: the source and its header.

    Args:
        program: From `build_kinematics`.
        name: With which all functions begin; also of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    body = "\n\n".join(_filled(part, program, name) for part in _parts(program, name))
    first = f"Kinematics of {program.robot.name}, written by tau-dyn {__version__}."
    words = [first, *yield_kinematics_description(program, name)]
    return format_source(name, first, body.splitlines()), format_header(name, words, list_declarations(program, name))


def _parts(program: KinematicsProgram, name: str) -> Iterator[str]:
    follows, searches = needs_start(program)
    yield text.SIZES.rstrip()
    if follows or searches:
        yield from (FACTOR, SOLVE)
    if program.kind == "rods" or searches:
        yield text.ROTATED
    if searches:
        yield search.LOGARITHM
    if program.equations is not None:
        yield _function("static void equations", program.equations, ("gap", "G"), "void")
    if program.tool is not None and (follows or searches):
        yield _function("static void tool", program.tool, ("p", "R", "T"), "void")
    if program.kind == "rods":
        yield text.PLATE
    elif follows:
        yield text.JOINTS
    if follows or searches:
        yield text.START
    if follows:
        yield from (text.FOLLOW, text.FORWARD)
    else:
        yield from _straight(program, name)
    if program.inverse is not None or searches:
        yield search.LIMITS
    if program.inverse is not None:
        yield _function("static int drives", program.inverse, ("q",), "int")
        yield search.CLOSED_INVERSE
    elif searches:
        yield search.INVERSE


def _straight(program: KinematicsProgram, name: str) -> Iterator[str]:
    """Yield forward kinematics and Jacobian of a closed form or a serial arm."""
    given = program.forward or program.tool
    assert given is not None
    yield _function(f"int {name}_fk", given, ("p", "R"), "int")
    column = "J" if program.forward is not None else "T"
    yield (
        _function(f"int {name}_jacobian", given, (column,), "int")
        .replace("double T[", "double J[")
        .replace("    T[", "    J[")
    )


def _function(head: str, piece: TracedFunction, outputs: Sequence[str], kind: str) -> str:
    """Return one traced function with some of its outputs."""
    arguments = [f"const double {x}[{n}]" for x, n in piece.arguments.items() if n or kind == "int"]
    arguments += [f"double {x}[{len(piece.outputs[x])}]" for x in outputs]
    if head.endswith("tool") and "z" not in piece.arguments:
        arguments.insert(1, "const double *z")
    lines = [f"{head}({', '.join(arguments)})", "{"]
    if head.endswith("tool") and "z" not in piece.arguments:
        lines.append("    (void)z; /* there are no passive joints */")
    values = [x for name in outputs for x in piece.outputs[name]]
    lines += [*yield_unused_lines(piece.graph, values, list(piece.arguments)), *yield_graph_lines(piece.graph, values)]
    lines += guard_lines(piece.graph) if kind == "int" else []
    for name in outputs:
        lines += yield_output_lines(name, piece.outputs[name])
    return "\n".join([*lines, *(["    return 0;"] if kind == "int" else []), "}"])


def _filled(part: str, program: KinematicsProgram, name: str) -> str:
    """Return a part of the text with its blanks filled; a blank line of its own goes where nothing belongs there."""
    for key, value in _blocks(program).items():
        part = part.replace(f"@{key}@\n", f"{value}\n" if value else "")
    for key, value in (_values(program) | _tool_values(program) | {"NAME": name}).items():
        part = part.replace(f"@{key}@", str(value))
    return part


def _blocks(program: KinematicsProgram) -> dict[str, str]:
    whole, solved = program.rank == 6, program.freedoms > 0
    return {
        "EQUATIONS": search.GAPS if solved else "",
        "WHOLE": search.WHOLE_POSE if whole else "",
        "COSTS": search.COSTS if program.idle else "",
        "AIM": search.AIM_NEAR if program.idle else search.AIM_NOWHERE if whole else search.AIM_TURN,
        "MOVED": "    moved(x + NA, b + NA);" if solved else "",
        "BEYOND": search.BEYOND if program.kind == "rods" else "",
    }


def _values(program: KinematicsProgram) -> dict[str, object]:
    robot, na = program.robot, program.robot.na
    return {
        "NA": na,
        "NT": program.freedoms,
        "NZ": len(program.home) - na,
        "POSE": 6 if program.rank == 6 else 3,
        "COST": _numbers(_cost(program)),
        "HOME": _numbers(program.home),
        "LOWER": _numbers(np.maximum(robot.lower, -1e300)),
        "UPPER": _numbers(np.minimum(robot.upper, 1e300)),
        "TURNS": ", ".join("1" if kind == "revolute" else "0" for kind in robot.joint_kinds),
        "WHOLE_TURN": repr(2 * np.pi),
        "STEP": repr(text.STEP),
        "STEPS": text.STEPS,
        "ITERATIONS": text.ITERATIONS,
        "ROUNDS": search.ROUNDS,
        "ON_THE_WAY": search.ON_THE_WAY,
        "LEGS": search.LEGS,
        "LEG": repr(search.LEG),
    }


def _tool_values(program: KinematicsProgram) -> dict[str, object]:
    if program.rods is None or program.kind != "rods":
        return {"SIDE": "1"}
    tool, side = program.rods.tool, _home_side(program)
    return {
        "PLACE": _numbers(tool.translation),
        "TURN": _numbers(tool.rotation),
        "HOME_SIDE": side,
        "SIDE": f"side == {side}",
    }


def _home_side(program: KinematicsProgram) -> int:
    """Return the sign of the determinant of the rods' equations by the plate at home."""
    from tau_dyn.control.export_kinematics_check import evaluate_traced

    assert program.equations is not None
    na = program.robot.na
    known = {"q": program.home[None, :na], "z": program.home[None, na:]}
    G = evaluate_traced(program.equations, known)["G"].reshape(program.freedoms, -1)
    return int(np.sign(np.linalg.det(G[:, na:])))


def _cost(program: KinematicsProgram) -> np.ndarray:
    """Return what a drive's motion costs where drives can move without the tool, slides in mean rods' lengths."""
    slides = np.array([kind == "prismatic" for kind in program.robot.joint_kinds])
    length = 1.0 if program.rods is None else float(np.mean(program.rods.lengths))
    return np.where(slides, length**-2, 1.0)


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return ", ".join(format_numbers(values))
