"""What exported kinematics say of themselves: declarations, drives and units, statuses, bounds of a call."""

from __future__ import annotations

from collections.abc import Iterator

from tau_dyn.control import export_c_inverse as search, export_c_newton as text
from tau_dyn.control.export_c_text import build_identifiers
from tau_dyn.control.export_kinematics import KinematicsProgram


def needs_start(program: KinematicsProgram) -> tuple[bool, bool]:
    """Return whether forward and inverse kinematics begin at a last configuration."""
    return program.kind != "closed" and program.freedoms > 0, program.inverse is None and not program.no_inverse


def list_declarations(program: KinematicsProgram, name: str) -> list[str]:
    """Return what the header declares."""
    upper, na = name.upper(), program.robot.na
    follows, searches = needs_start(program)
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


def yield_kinematics_description(program: KinematicsProgram, name: str) -> Iterator[str]:
    """Yield what the header says: drives and units, what the functions return, how long they may take."""
    robot = program.robot
    follows, searches = needs_start(program)
    yield f"Robot: {robot.source}" + (f", sha256 {robot.sha256}" if robot.sha256 else "")
    yield ""
    yield "Drives, in the order of q:"
    for k, (joint, unit, low, high) in enumerate(
        zip(robot.actuated, robot.position_units, robot.lower, robot.upper, strict=True)
    ):
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
    yield "Each function returns 0, or else leaves its outputs (and start) as they were and returns"
    yield "  1  out of reach, or beyond a singularity from home"
    if follows or searches:
        yield "  2  Newton's method did not end: out of reach, beyond a singularity, or too far from start"
    if not program.no_inverse:
        yield "  3  a drive's range would be left (ik alone; fk and jacobian do not look at ranges)"
    yield "No allocation, no recursion, no state" + (
        " but `start`: safe in several threads, each with its own."
        if follows or searches
        else "; safe in several threads."
    )
    if follows or searches:
        yield f"`start` is the last configuration: {name}_start sets it to home; every call that returns 0 moves it on."
    if follows:
        yield f"fk, jacobian: drives that moved further than {text.STEP:g} m or rad are followed in such steps,"
        yield f"at most {text.STEPS}, each of at most {text.ITERATIONS} iterations."
    if searches:
        yield f"ik: the straight way from the last tool pose in at most {search.LEGS} pieces of {search.LEG:g} m or"
        yield f"{2 * search.LEG:g} rad with {search.ON_THE_WAY} iterations each, then at most {search.ROUNDS}."
    yield ""
    yield f"Checked when it was written: within {max(program.difference, 1e-16):.1g} of Python's."
