"""RAPID as text: names, joint targets in mm and degrees, robot targets, comments that nothing breaks out of."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError

UNUSED = "9E9"
AXES = 6  # of a robtarget's robot axes and of its external axes alike (RAPID reference manual)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_RESERVED = frozenset(
    "alias and backward case connect const default div do else elseif endfor endfunc endif endmodule endproc endrecord "
    "endtest endtrap endwhile error exit false for from func goto if inout local mod module nostepin not noview or pers "
    "proc raise readonly record retry return step sysmodule task test then to trap true trynext undo var viewonly while "
    "with xor".split()
)


def require_rapid_name(name: str, what: str = "a RAPID module") -> str:
    """Return a name that RAPID takes.

    Raises:
        InputError: It is none, or a word of the language.
    """
    if not _NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise InputError(
            "invalid_value",
            f"'{name}' is no name for {what}: a letter, then letters, digits and _, at most 32, no word of RAPID",
        )
    return name


def require_few_joints(kinds: Sequence[str]) -> None:
    """Refuse a robot with more drives than a joint target holds.

    Raises:
        InputError: More than twelve joints.
    """
    if len(kinds) > 2 * AXES:
        raise InputError(
            "unsupported", f"a RAPID jointtarget holds 12 axes; this robot has {len(kinds)} actuated joints"
        )


def format_jointtarget(row: np.ndarray, kinds: Sequence[str]) -> str:
    """Return positions (na,) [m or rad] as a joint target: mm along slides, degrees about turns, 9E9 for axes not there."""
    values = [f"{1e3 * x if kind == 'prismatic' else np.rad2deg(x):.4f}" for x, kind in zip(row, kinds, strict=True)]
    robot = values[:AXES] + ["0"] * (AXES - len(values[:AXES]))
    external = values[AXES:] + [UNUSED] * (AXES - len(values[AXES:]))
    return f"[[{','.join(robot)}],[{','.join(external)}]]"


def format_robtarget(position: np.ndarray, quaternion: np.ndarray) -> str:
    """Return a place (3,) [m] and a quaternion x y z w as a robot target: mm, the quaternion's scalar first."""
    place = ",".join(f"{1e3 * x:.4f}" for x in position)
    turn = ",".join(f"{x:.8f}" for x in np.roll(quaternion, 1))
    return f"[[{place}],[{turn}],[0,0,0,0],[{','.join([UNUSED] * AXES)}]]"


def format_array(declaration: str, rows: Sequence[str]) -> list[str]:
    """Return lines that declare a constant array, a row a line."""
    return [f"  CONST {declaration}{{{len(rows)}}} := [", ",\n".join(f"    {row}" for row in rows), "  ];"]


def format_comment(text: str) -> str:
    """Return a comment line; what is no printable ASCII becomes a question mark."""
    return f"  ! {re.sub(r'[^ -~]', '?', text)}"
