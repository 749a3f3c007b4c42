"""Columns of pose files with the names of controllers and devices, mapped to our names.

Positions `x y z`, `tcp_x`, `x_mm`, or `x1 y1 z1`, the first of several points; orientations as quaternions `qx qy qz qw`, as
rotation vectors `rx ry rz` (UR), or as angles: `roll pitch yaw`, `phix1 phiy1 phiz1` (FIGAROH) and `w p r` (FANUC) about fixed
x, y, z; `a b c` (KUKA) about z, y', x''. Endings `_mm`, `_deg` give units. Angles of `w p r` and `a b c` are degrees, others
radians unless one exceeds a turn. `rx_tool ry_tool rz_tool` is our name of three numbers.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.log import Table, format_names
from tau_dyn.message_codes import CodedWarning

ANGLES = ("rx_tool", "ry_tool", "rz_tool")
_UNIT_FACTORS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "deg": np.pi / 180, "rad": 1.0}
_UNIT_END = re.compile(r"(?:[_ ]?[\[(]|[_ ])(mm|cm|m|deg|rad)[\])]?$")
_PLACE = re.compile(r"^(?:(?:tcp|tool|pos|position|ee|flange|target|p)[_.]?)?([xyz])(?:1|[_.]?(?:tcp|tool|ee|pos))?$")
_QUATERNION = re.compile(r"^(?:(?:tcp|tool|ee)[_.]?)?(?:q|quat_?|quaternion_?|o)([xyzw])(?:[_.]?(?:tcp|tool|ee))?$")
_DISTANCES = ("distance", "distance_tool", "wire_length", "range")
_ONE_TURN = 2 * np.pi
"""Largest angle [rad] that a controller writes; a larger number is in degrees."""


class _Triple(NamedTuple):
    """Names of three angles about x, y and z, SciPy's sequence of axes ('' a rotation vector), and whether degrees are usual."""

    names: tuple[str, str, str]
    sequence: str
    degrees: bool


_TRIPLES = (
    _Triple(("rx", "ry", "rz"), "", False),
    _Triple(("roll", "pitch", "yaw"), "xyz", False),
    _Triple(("phix1", "phiy1", "phiz1"), "xyz", False),
    _Triple(("w", "p", "r"), "xyz", True),
    _Triple(("c", "b", "a"), "xyz", True),
)


def find_pose_columns(table: Table, joints: Sequence[str], passive: Sequence[str] = ()) -> dict[str, str]:
    """Return the foreign column of each of our names that a table lacks, for groups whose columns are all present."""
    found: dict[str, str] = {}
    groups = (
        *(([f"q_{joint}" for joint in some], _find_joint) for some in (joints, passive)),
        (("x_tool", "y_tool", "z_tool"), _find_by(_PLACE, 0)),
        (("qx_tool", "qy_tool", "qz_tool", "qw_tool"), _find_by(_QUATERNION, 1)),
        (ANGLES, _find_angle),
        (("distance_tool",), _find_distance),
    )
    for wanted, find in groups:
        missing = [name for name in wanted if name not in table.cells]
        sources = {name: source for name in missing if (source := find(name, table.cells))}
        if len(sources) == len(missing):
            found |= sources
    return found


def name_pose_columns(table: Table, joints: Sequence[str], passive: Sequence[str] = ()) -> Table:
    """Return a table with the columns of foreign names under ours, and a warning that names them."""
    cells, found = dict(table.cells), find_pose_columns(table, joints, passive)
    if not found:
        return table
    for name, source in found.items():
        factor = 1.0 if name in ANGLES else get_unit_factor(source)
        cells[name] = cells[source] if factor == 1.0 else factor * table.numbers(source, gaps=True)
    pairs = ", ".join(f"{source} as {name}" for name, source in found.items())
    said = CodedWarning(
        "columns_read", f"{table.name}: columns are read by their names: {pairs}; a column map settles others"
    )
    return replace(table, cells=cells, warnings=(*table.warnings, said))


def _find_by(pattern: re.Pattern[str], letter: int) -> Callable[[str, dict[str, np.ndarray]], str]:
    """Return a function that finds the one column whose name fits a pattern with the letter of our name."""

    def find(name: str, cells: dict[str, np.ndarray]) -> str:
        hits = [c for c in cells if (m := pattern.match(_strip_unit(c))) and m[1] == name[letter]]
        return hits[0] if len(hits) == 1 else ""

    return find


def _find_joint(name: str, cells: dict[str, np.ndarray]) -> str:
    """Return the column of a joint's name, with or without `q_` and a unit."""
    wanted = name.lower()
    hits = [c for c in cells if _strip_unit(c) in (wanted, wanted.removeprefix("q_"))]
    return hits[0] if len(hits) == 1 else ""


def _find_distance(name: str, cells: dict[str, np.ndarray]) -> str:
    """Return the one column of distances with or without a unit."""
    hits = [c for c in cells if _strip_unit(c) in _DISTANCES]
    return hits[0] if len(hits) == 1 else ""


def _find_angle(name: str, cells: dict[str, np.ndarray]) -> str:
    """Return the column of the angle about an axis."""
    return _find_triple(cells)[0].get(name, "")


def _find_triple(cells: dict[str, np.ndarray]) -> tuple[dict[str, str], _Triple]:
    """Return the columns of three angles by our names, and their kind; no columns if a kind is incomplete."""
    plain = {_strip_unit(c).removeprefix("tcp_").removesuffix("_tool").removesuffix("_tcp"): c for c in cells}
    for triple in _TRIPLES:
        if all(name in plain for name in triple.names):
            return {ours: plain[name] for ours, name in zip(ANGLES, triple.names, strict=True)}, triple
    return {}, _TRIPLES[0]


def _strip_unit(column: str) -> str:
    """Return a column's name in small letters without a unit at its end."""
    return _UNIT_END.sub("", column.strip().lower())


def get_unit_factor(column: str) -> float:
    """Return the factor that converts a column to SI units, from the end of its name."""
    found = _UNIT_END.search(column.strip().lower())
    return _UNIT_FACTORS[found[1]] if found else 1.0


def read_angles(table: Table) -> tuple[np.ndarray, np.ndarray, str]:
    """Return rotation matrices (N, 3, 3) of a table's three angles, the angles as written (N, 3), and how they are read."""
    angles = np.column_stack([table.numbers(name) for name in ANGLES])
    columns, triple = _find_triple({c: x for c, x in table.cells.items() if c not in ANGLES})
    columns = columns or dict(zip(ANGLES, ANGLES, strict=True))
    ends = {found[1] for c in columns.values() if (found := _UNIT_END.search(c.lower()))}
    degrees = "deg" in ends or (
        "rad" not in ends and (triple.degrees or bool(np.abs(angles).max(initial=0) > _ONE_TURN))
    )
    turns = np.deg2rad(angles) if degrees else angles
    rotation = Rotation.from_euler(triple.sequence, turns) if triple.sequence else Rotation.from_rotvec(turns)
    kind = "angles about fixed x, y, z" if triple.sequence else "a rotation vector"
    said = f"{format_names(columns.values())} are read as {kind} in {'degrees' if degrees else 'rad'}"
    return rotation.as_matrix(), angles, said
