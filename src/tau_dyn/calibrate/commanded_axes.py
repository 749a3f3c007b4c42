"""Which part of the tool's pose a robot commands: all of it with six joints, as many axes as joints with fewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.calibrate.frames import AXES
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import Robot

_LENGTH = 0.5  # [m] at which a turn counts as much as a shift
_INDEPENDENT = 1e-3  # part of a row that the ones before must leave unexplained


def require_valid_axes(robot: Robot, axes: Sequence[str]) -> tuple[str, ...]:
    """Return axes that a user names.

    Raises:
        UnknownName: An axis that does not exist.
        InputError: More axes than joints, or one of them twice.
    """
    for axis in axes:
        if axis not in AXES:
            raise UnknownName("axis", axis, AXES)
    if len(set(axes)) != len(axes) or not 0 < len(axes) <= robot.na:
        raise InputError(
            "invalid_value",
            f"{robot.source} has {robot.na} actuated joints; name as many different axes or fewer, not {list(axes)}",
        )
    return tuple(axes)


def find_independent_axes(robot: Robot, geometry: Geometry, nominal: np.ndarray) -> tuple[str, ...]:
    """Return the first axes that the joints move independently at home, as many as there are joints.

    Raises:
        InputError: The tool's motion at home is not known.
    """
    if robot.na >= 6:
        return AXES
    q = robot.home[None]
    found = geometry.forward(nominal, q)
    J = geometry.tool_by_joint(nominal, q, found.poses)[0].copy()
    J[3:] *= _LENGTH
    if not np.isfinite(J).all():
        raise InputError(
            "unsupported",
            f"{robot.source}: the tool's motion at home is not known ({found.reason[0]}); name the commanded axes",
        )
    rows: list[int] = []
    for k in range(6):
        basis = np.linalg.qr(J[rows].T)[0] if rows else np.zeros((robot.na, 0))
        rest = J[k] - basis @ (basis.T @ J[k])
        if len(rows) < robot.na and np.linalg.norm(rest) > _INDEPENDENT * np.abs(J).max():
            rows.append(k)
    return tuple(AXES[k] for k in rows)
