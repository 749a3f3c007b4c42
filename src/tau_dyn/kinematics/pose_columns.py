"""Columns of a table by name: actuated positions and tool poses of `fk`, `ik` and of logs."""

from __future__ import annotations

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, convert_from_quaternions, forward_kinematics
from tau_dyn.robot import Robot

TOOL = ("x_tool", "y_tool", "z_tool", "qx_tool", "qy_tool", "qz_tool", "qw_tool")


def read_positions(columns: dict[str, np.ndarray], robot: Robot, where: str) -> np.ndarray:
    """Return actuated positions (N, na) from a table's columns `q_<joint>`."""
    return pick_columns(columns, [f"q_{joint}" for joint in robot.actuated], where)


def read_poses(columns: dict[str, np.ndarray], robot: Robot, where: str) -> Poses:
    """Return tool poses from a table's columns `x_tool`..; without a quaternion the orientation is home's."""
    position = pick_columns(columns, list(TOOL[:3]), where)
    if not any(name in columns for name in TOOL[3:]):
        return place_home_orientation(robot, position)
    return convert_from_quaternions(position, pick_columns(columns, list(TOOL[3:]), where))


def place_home_orientation(robot: Robot, position: np.ndarray) -> Poses:
    """Return poses at positions (N, 3) [m] with home's orientation."""
    home = forward_kinematics(robot, robot.home[None]).poses.rotation[0]
    return Poses(position, np.repeat(home[None], len(position), axis=0))


def pick_columns(columns: dict[str, np.ndarray], names: list[str], where: str) -> np.ndarray:
    """Return columns of a table, side by side (N, n), as numbers.

    Raises:
        InputError: A column is missing, or holds text.
    """
    for name in names:
        if name not in columns:
            raise InputError("missing_column", f"{where}: no column '{name}'; there are {', '.join(columns)}")
    return np.stack([_numbers(columns[name], f"{where}: column '{name}'") for name in names], axis=1)


def _numbers(cells: np.ndarray, where: str) -> np.ndarray:
    """Return cells as numbers, empty ones as nan."""
    if cells.dtype.kind in "fiu":
        return cells.astype(float)
    texts = [str(cell).strip() for cell in cells]
    try:
        return np.array([float(text) if text else np.nan for text in texts])
    except ValueError as fault:
        raise InputError("bad_sample", f"{where} must hold numbers; {fault}") from fault
