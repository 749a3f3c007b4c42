r"""Kinematics as C99: `name_fk`, `name_jacobian` and `name_ik`, without allocation, recursion or state but the caller's.

A configuration consists of the drives `q` and of `z`, which the loops determine: a plate's position and rotation, or passive
joints. Its equations `gap(q, z) = 0` and their derivative `G` are traced. Forward (`c/follow.c`, `c/forward.c`): `z` follows
`q` from the last configuration in bounded steps of Newton's method; the Jacobian is `T_q - T_z G_z^-1 G_q`, with `T` the tool's
twist. Inverse: in closed form, or by Newton's method on drives and loops at once (`c/inverse_search.c`),

    [H  C'; C  -eps] (dx, y) = (H pull, -c),   C = [G; T_place (; T_turn)].

Drives that reach all six degrees of freedom meet the whole pose and, if they can move without the tool, stay near their start.
Others meet the position, and the rotation as closely as they can, `H = T_turn' T_turn + small`: the equations of
`mechanism/small_systems.py` (Nocedal & Wright 2006, ch. 16).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse.csgraph import connected_components

from tau_dyn.codegen.c_writer import (
    ITERATIONS,
    MAX_NUMBER,
    STEP,
    STEPS,
    build_identifiers,
    fill_template,
    format_header,
    format_source,
    list_numbers,
    require_c_name,
)
from tau_dyn.codegen.feedforward_c import fill_follow
from tau_dyn.codegen.kinematics import KinematicsProgram
from tau_dyn.equations import TracedFunction, yield_function, yield_graph_lines, yield_guard_lines, yield_output_lines
from tau_dyn.version import __version__

ROUNDS, ON_THE_WAY, LEGS, LEG = 40, 3, 60, 0.1
"""Most iterations at the goal, on the way, most pieces of the way, and how long one may be [m or 2 rad]."""
MAX_MISS_SHARE = 0.1  # of a piece: how far its last iteration may still be off, where legs can turn over


def write_kinematics_source(program: KinematicsProgram, name: str = "robot") -> tuple[str, str]:
    """Return kinematics as C: the source and its header.

    Args:
        program: From `build_kinematics`.
        name: Prefix of all functions, and name of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    first = f"Kinematics of {program.robot.name}, written by tau-dyn {__version__}."
    header = format_header(name, [first, *_yield_description(program, name)], _list_declarations(program, name))
    return format_source(name, first, _yield_parts(program, name)), header


def _needs_start(program: KinematicsProgram) -> tuple[bool, bool]:
    """Return whether forward and inverse kinematics begin at a last configuration."""
    return program.kind != "closed" and program.freedoms > 0, program.inverse is None and not program.no_inverse


def _list_declarations(program: KinematicsProgram, name: str) -> list[str]:
    """Return the declarations of the header."""
    upper, na = name.upper(), program.robot.na
    follows, searches = _needs_start(program)
    start = f"double start[{upper}_START], "
    lines = [f"#define {upper}_JOINTS {na}", f"#define {upper}_ROWS {program.rows}"]
    lines += [f"#define {upper}_JOINT_{x} {k}" for k, x in enumerate(build_identifiers(program.robot.actuated))]
    if follows or searches:
        lines += [f"#define {upper}_START {len(program.home)}", f"void {name}_start(double start[{upper}_START]);"]
    one = start if follows else ""
    lines.append(f"int {name}_fk({one}const double q[{na}], double p[3], double R[9]);")
    lines.append(f"int {name}_jacobian({one}const double q[{na}], double J[{program.rows * na}]);")
    if not program.no_inverse:
        one = start if searches else ""
        lines.append(f"int {name}_ik({one}const double p[3], const double R[9], double q[{na}]);")
    return lines


def _yield_description(program: KinematicsProgram, name: str) -> Iterator[str]:
    """Yield the header's comment: drives and units, return values of the functions, bounds on their run time."""
    robot = program.robot
    follows, searches = _needs_start(program)
    yield f"Robot: {robot.source}" + (f", sha256 {robot.sha256}" if robot.sha256 else "")
    yield ""
    yield "Drives, in the order of q:"
    ranges = zip(robot.actuated, robot.position_units, robot.lower, robot.upper, strict=True)
    for k, (joint, unit, low, high) in enumerate(ranges):
        yield f"  [{k}] {joint}: {unit}, {low:g} to {high:g}"
    yield "p: place of the tool in the world [m]; R: its rotation row by row, columns the tool's axes."
    if program.rows == 3:
        yield f"J: the tool's velocity by the drives' speeds, row by row (3 x {robot.na}). The plate keeps its rotation:"
        yield "fk gives it, ik does not look at R."
    else:
        yield f"J: the tool's twist by the drives' speeds, row by row (6 x {robot.na}): velocity, then turning, in world axes."
    if program.rank < 6 and program.rows == 6 and not program.no_inverse:
        yield f"ik: {program.rank} freedoms: the place is met, the rotation as near as it can."
    if program.idle and not program.no_inverse:
        yield "ik: drives can move without the tool; the positions nearest to where they started are taken."
    if program.no_inverse:
        yield f"No ik: {program.no_inverse}."
    yield ""
    yield "Each function returns 0, or else leaves its outputs (and start) alone and returns"
    yield f"  1  out of reach, beyond a singularity from home, a number that is none or beyond {MAX_NUMBER:g}, R no rotation"
    if follows or searches:
        yield "  2  Newton's method did not end: out of reach, beyond a singularity, or too far from start"
    if not program.no_inverse:
        yield "  3  a drive's range would be left (ik alone; fk and jacobian do not look at ranges)"
    if _find_leg_groups(program) and searches:
        yield "  4  a leg would pass its own singularity on the way, so the answer lies on another branch than start (ik alone)"
    yield "Compile without -ffast-math, which takes the checks of numbers away."
    yield "No allocation, no recursion, no state" + (
        " but `start`: safe in several threads, each with its own."
        if follows or searches
        else "; safe in several threads."
    )
    if follows or searches:
        yield f"`start` is the last configuration: {name}_start sets it to home; every call that returns 0 moves it on."
    if follows:
        yield f"fk, jacobian: drives that moved further than {STEP:g} m or rad are followed in such steps,"
        yield f"at most {STEPS}, each of at most {ITERATIONS} iterations."
    if searches:
        yield f"ik: the straight way from the last tool pose in at most {LEGS} pieces of {LEG:g} m or"
        yield f"{2 * LEG:g} rad with {ON_THE_WAY} iterations each, then at most {ROUNDS}."
    yield ""
    yield f"Checked when it was written: within {max(program.difference, 1e-16):.1g} of Python's."


def _yield_parts(program: KinematicsProgram, name: str) -> Iterator[str]:
    na, nt = program.robot.na, program.freedoms
    follows, searches = _needs_start(program)
    rods = program.kind == "rods"
    yield f"enum {{ NA = {na}, NT = {nt}, NZ = {len(program.home) - na}, NG = NT, NX = NA + NT, WIDE = NX }};"
    yield fill_template("checks")
    if follows or searches:
        yield fill_template("linear")
    if rods or searches:
        yield fill_template("rotation", {"SEARCHES"} if searches else ())
    if program.inverse is not None and program.rows == 6 or searches:
        yield fill_template("is_rotation")
    if program.equations is not None:
        yield _write_inner("equations", program.equations, ("gap", "G"))
    if program.tool is not None and (follows or searches):
        yield _write_inner("tool", program.tool, ("p", "R", "T"))
    if program.rods is not None and rods:
        tool = program.rods.tool
        yield fill_template("plate", PLACE=list_numbers(tool.translation), TURN=list_numbers(tool.rotation))
    side = _find_home_side(program) if rods else 0
    if follows or searches:
        yield fill_template("start", NAME=name, HOME=list_numbers(program.home))
    if follows:
        flags = {"COPIED"} | (set() if rods else {"JOINTS"})
        yield fill_follow(list(range(nt)), flags, f"side == {side}" if rods else "1")
        yield fill_template("forward", NAME=name)
    else:
        yield from _yield_straight(program, name)
    if not program.no_inverse:
        yield from _yield_inverse(program, name, side)


def _yield_inverse(program: KinematicsProgram, name: str, side: int) -> Iterator[str]:
    robot, rods = program.robot, program.kind == "rods"
    yield fill_template(
        "within",
        LOWER=list_numbers(np.maximum(robot.lower, -MAX_NUMBER)),
        UPPER=list_numbers(np.minimum(robot.upper, MAX_NUMBER)),
        TURNS=", ".join("1" if kind == "revolute" else "0" for kind in robot.joint_kinds),
        WHOLE_TURN=repr(2 * np.pi),
    )
    if program.inverse is not None:
        head = "static int drives(const double p[3], const double R[9], double q[NA])"
        yield "\n".join(yield_function(head, program.inverse.graph, ["p", "R"], program.inverse.outputs))
        rotation = " || !is_rotation(R)" if program.rows == 6 else ""
        yield fill_template("inverse_closed", {"PLATE"} if rods else (), NAME=name, HOME_SIDE=side, ROTATION=rotation)
        return
    whole = program.rank == 6
    flags = {"IDLE" if program.idle else "BUSY"} | ({"SOLVED"} if program.freedoms else set())
    flags |= {"WHOLE"} if whole else set()
    flags |= {"TURNING"} if not whole and not program.idle else set()
    groups = _find_leg_groups(program)
    flags |= {"BRANCHES"} if groups else set()
    sides = "\n".join(f"    side[{k}] = {_format_determinant(*group)};" for k, group in enumerate(groups))
    yield fill_template(
        "inverse_search", flags, NAME=name, POSE=6 if whole else 3, COST=list_numbers(_compute_cost(program)),
        GROUPS=len(groups), SIDES=sides, NEAR=MAX_MISS_SHARE,
        ROUNDS=ROUNDS, ON_THE_WAY=ON_THE_WAY, LEGS=LEGS, LEG=repr(LEG),
    )  # fmt: skip


def _yield_straight(program: KinematicsProgram, name: str) -> Iterator[str]:
    """Yield forward kinematics and Jacobian of a closed form or a serial arm."""
    given = program.forward or program.tool
    assert given is not None
    column = "J" if program.forward is not None else "T"
    for function, gives in (("fk", {"p": "p", "R": "R"}), ("jacobian", {column: "J"})):
        arrays = {new: given.outputs[old] for old, new in gives.items()}
        yield "\n".join(_yield_checked(f"{name}_{function}", given, arrays))


def _yield_checked(name: str, given: TracedFunction, arrays: dict[str, tuple]) -> Iterator[str]:
    """Yield a function of the drives that gives out sound numbers or a status."""
    values = [x for outputs in arrays.values() for x in outputs]
    yield f"int {name}(const double q[NA], {', '.join(f'double {x}[{len(v)}]' for x, v in arrays.items())})"
    yield "{"
    yield "    if (!sound(NA, q)) return 1;"
    yield from yield_graph_lines(given.graph, values)
    yield from yield_guard_lines(given.graph)
    yield f"    double out[{len(values)}];"
    yield from yield_output_lines("out", values)
    yield f"    if (!sound({len(values)}, out)) return 1;"
    first = 0
    for array, outputs in arrays.items():
        yield f"    for (int k = 0; k < {len(outputs)}; ++k) {array}[k] = out[{first} + k];"
        first += len(outputs)
    yield "    return 0;"
    yield "}"


def _write_inner(name: str, given: TracedFunction, gives: tuple[str, ...]) -> str:
    """Return a function of drives and `z` that the others call; its numbers are judged there."""
    arrays = {x: given.outputs[x] for x in gives}
    outputs = ", ".join(f"double {x}[{len(v)}]" for x, v in arrays.items())
    head = f"static void {name}(const double *q, const double *z, {outputs})"
    return "\n".join(yield_function(head, given.graph, ["q", "z"], arrays, checked=False))


def _find_home_side(program: KinematicsProgram) -> int:
    """Return the sign of the determinant of the rods' equations by the plate at home."""
    assert program.equations is not None
    na = program.robot.na
    known = {"q": program.home[None, :na], "z": program.home[None, na:]}
    G = program.equations.evaluate(known)["G"].reshape(program.freedoms, -1)
    return int(np.sign(np.linalg.det(G[:, na:])))


def _find_leg_groups(program: KinematicsProgram) -> list[tuple[list[int], list[int]]]:
    """Return rows and drives of rods that hang together, where each group has as many drives as rods, three at most."""
    if program.rods is None or program.equations is None or program.idle:
        return []
    na, rng = (
        program.robot.na,
        np.random.default_rng(0),
    )  # any states: a rod that a drive moves does not move at one by chance
    q = program.home[:na] + 0.05 * rng.standard_normal((4, na))
    z = np.broadcast_to(program.home[na:], (4, len(program.home) - na))
    G = program.equations.evaluate({"q": q, "z": z})["G"].reshape(4, program.freedoms, -1)[:, :, :na]
    count, label = connected_components(
        np.block([[np.zeros((len(G[0]),) * 2), np.abs(G).sum(axis=0)], [np.zeros((na, len(G[0]) + na))]]),
        directed=False,
    )
    groups = [(np.flatnonzero(label[: len(G[0])] == k), np.flatnonzero(label[len(G[0]) :] == k)) for k in range(count)]
    if any(len(rows) != len(columns) or len(rows) > 3 for rows, columns in groups):
        return []
    return [(rows.tolist(), columns.tolist()) for rows, columns in groups]


def _format_determinant(rows: list[int], columns: list[int]) -> str:
    """Return the determinant of a part of G in C, by its first row."""
    if not rows:
        return "1.0"
    terms = [
        f"{'-' if k % 2 else '+'} G[{rows[0]} * NX + {c}] * ({_format_determinant(rows[1:], [x for x in columns if x != c])})"
        for k, c in enumerate(columns)
    ]
    return " ".join(terms)


def _compute_cost(program: KinematicsProgram) -> np.ndarray:
    """Return the cost of each drive's motion, for drives that can move without the tool; slides count in mean rod lengths."""
    slides = np.array([kind == "prismatic" for kind in program.robot.joint_kinds])
    length = 1.0 if program.rods is None else float(np.mean(program.rods.lengths))
    return np.where(slides, length**-2, 1.0)
