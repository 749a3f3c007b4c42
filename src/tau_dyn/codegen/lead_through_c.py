"""A lead-through controller as C99: `name_start` at rest, then `name_step` once a sample, from two wrenches to a velocity.

The text is `c/lead_through.c`; the numbers come from checked settings (`control/lead_through`), so this room knows no limits.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from tau_dyn.codegen.c_writer import (
    MAX_NUMBER,
    fill_template,
    format_header,
    format_source,
    format_table,
    require_c_name,
)
from tau_dyn.version import __version__

_STATE = 37  # numbers that the controller remembers; SIZE in c/lead_through.c


@dataclass(frozen=True, eq=False)
class LeadThroughNumbers:
    """Constants of a lead-through controller.

    Attributes:
        inverse_mass: Inverse of the handle's mass (6, 6).
        damping: Damping of the handle (6, 6).
        gain: Gain of the tool force (6, 6) [m/s per N, rad/s per N m].
        nominal: Nominal unit normal (3,).
        locked: Axis in the tool's frame about which the tool does not turn (3,); zero without such an axis.
        handle_sensor: Position, axes by rows, weight in the world, centre and offset of the handle's sensor (24,).
        tool_sensor: The same of the tool's sensor.
        switches: Choices, by their names in C, 0 or 1.
        values: Numbers, by their names in C.
    """

    inverse_mass: np.ndarray
    damping: np.ndarray
    gain: np.ndarray
    nominal: np.ndarray
    locked: np.ndarray
    handle_sensor: np.ndarray
    tool_sensor: np.ndarray
    switches: dict[str, bool]
    values: dict[str, float]


def write_lead_through_source(
    numbers: LeadThroughNumbers, name: str = "lead", words: Sequence[str] = ()
) -> tuple[str, str]:
    """Return a lead-through controller as C: the source and its header.

    Args:
        numbers: Its constants, as `control.lead_through.LeadThrough.list_numbers` returns them.
        name: Prefix of both functions, and name of the header, `name.h`.
        words: Lines for the header: settings and stability limits.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    first = f"Lead-through with two force sensors, written by tau-dyn {__version__}."
    said = [first, f"Sampling step {numbers.values['SAMPLE_TIME']!r} s.", *words, "", *_WORDS]
    return format_source(name, first, _yield_parts(numbers, name)), format_header(name, said, _declare(name))


def _yield_parts(numbers: LeadThroughNumbers, name: str) -> Iterator[str]:
    yield f"enum {{ {', '.join(f'{key} = {int(on)}' for key, on in numbers.switches.items())} }};"
    yield "\n".join(f"#define {key} {float(x)!r}" for key, x in numbers.values.items())
    for field in fields(numbers):
        table = getattr(numbers, field.name)
        if isinstance(table, np.ndarray):
            yield format_table("double", field.name, table.ravel(), table.size)
    yield from (fill_template("checks"), fill_template("is_rotation"), fill_template("lead_through", NAME=name))


def _declare(name: str) -> list[str]:
    state = f"double state[{name.upper()}_STATE]"
    return [
        f"#define {name.upper()}_STATE {_STATE}",
        f"void {name}_start({state});",
        f"int {name}_step({state}, const double handle[6], const double tool[6], const double position[3],",
        f"{' ' * len(f'int {name}_step(')}const double rotation[9], double velocity[6]);",
    ]


_WORDS = (
    "start: at rest, without contact. step: one call a sample, in order.",
    "handle, tool: readings of both sensors, force [N] then torque [N m], on the handle and on the tool.",
    "position, rotation: the tool point in the world [m], and the tool's axes there, row by row.",
    "velocity: of the tool point in world axes, linear [m/s] then angular [rad/s], to command until the next call.",
    f"step returns 0; or 1 where an input, the state or the answer is no number or beyond {MAX_NUMBER:g}, or the rotation",
    "is none; then the velocity is zero, and the next call starts from rest.",
    "Compile without -ffast-math, which takes the checks away. No allocation, no state but the caller's.",
)
