"""The tool along some world axes as what is learnt: drives' commands to tool positions, and a correction of the tool back.

Cases 2 and 3 of the thesis (7.4): the correction is added to the tool's reference, and the inverse kinematics give the drives'
references. Other directions and the orientation keep their reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.control.iterative.learning_step import LearningStep
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.mechanism import Poses, forward_kinematics, inverse_kinematics
from tau_dyn.robot import Robot

AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class ToolAxes:
    """A robot's tool along x, or x and y, or x, y and z.

    Attributes:
        robot: The robot.
        names: Columns of the tool's position, in this order.
    """

    robot: Robot
    names: tuple[str, ...]

    @classmethod
    def find(cls, robot: Robot, names: Sequence[str], log: Log) -> ToolAxes:
        """Return the axes of columns; without names those of x_tool, y_tool and z_tool that a log has.

        Raises:
            InputError: There is no such column, or more than three are named.
        """
        usual = [f"{axis}_tool" for axis in AXES]
        found = tuple(names)
        if not found:
            n = next((k for k, name in enumerate(usual) if name not in log.channels), len(usual))
            found = tuple(usual[:n])
        missing = next((name for name in found if name not in log.channels), None)
        if not found or missing is not None:
            raise InputError(
                "missing_column",
                f"{log.name}: there is no column {missing or usual[0]}; --measured names the tool's position along x, y, z",
            )
        if len(found) > len(AXES):
            raise InputError("bad_option", f"--measured names at most x, y and z, not {len(found)} columns")
        return cls(robot, found)

    def require_joints(self, joints: Sequence[str], reference: str) -> None:
        """Refuse a reference of other joints than the robot's.

        Raises:
            InputError: Joints differ.
        """
        if tuple(joints) != self.robot.actuated:
            raise InputError(
                "mismatch",
                f"{reference}: it moves {', '.join(joints)}, the robot has {', '.join(self.robot.actuated)}",
            )

    def read(self, log: Log, n: int) -> np.ndarray:
        """Return the tool's position (n, m) [m] in a trial's log.

        Raises:
            InputError: A column is missing, or the log is shorter.
        """
        missing = next((name for name in self.names if name not in log.channels), None)
        if missing is not None:
            raise InputError("missing_column", f"{log.name}: there is no column {missing}")
        found = np.column_stack([log.channels[name] for name in self.names])
        if len(found) < n:
            raise InputError("mismatch", f"{log.name}: it has {len(found)} samples, the motion has {n}")
        return found[:n]

    def read_stderr(self, log: Log) -> np.ndarray | None:
        """Return the standard error (m,) [m] of an observed tool, from the intervals of `observe`; None without them."""
        ends = [(f"{name}_low", f"{name}_high") for name in self.names]
        if any(end not in log.channels for pair in ends for end in pair):
            return None
        return np.array([np.mean(log.channels[high] - log.channels[low]) / (2 * 1.96) for low, high in ends])

    def compute_positions(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's positions (N, m) [m] at drives' positions (N, na), by the rigid kinematics."""
        return forward_kinematics(self.robot, q).poses.position[:, : len(self.names)]

    def invert(self, q: np.ndarray, correction: np.ndarray) -> np.ndarray:
        """Return the change of the drives' positions (N, na) that moves the tool by a correction (N, m) [m].

        Args:
            q: Positions of the drives without correction (N, na).
            correction: Of the tool (N, m) [m].

        Raises:
            InputError: The corrected tool is out of reach.
        """
        poses = forward_kinematics(self.robot, q).poses
        moved = poses.position.copy()
        moved[:, : correction.shape[1]] += correction
        plain, found = (
            inverse_kinematics(self.robot, Poses(p, poses.rotation), start=q) for p in (poses.position, moved)
        )
        if not (np.isfinite(found.q).all() and np.isfinite(plain.q).all()):
            k = int(np.argmax(~np.isfinite(found.q).all(axis=1)))
            raise InputError(
                "unreachable", f"{self.robot.source}: the corrected tool is out of reach at sample {k + 1}"
            )
        return found.q - plain.q

    def describe_unseen(self, found: LearningStep, stderr: np.ndarray | None) -> list[str]:
        """Return a sentence for each axis whose error is below the standard error with which the tool is observed."""
        if stderr is None:
            return []
        return [
            f"{name}: the last error, {1e6 * drive.outcomes[-1]:.3g} um, is below the observed tool's standard error, "
            f"{1e6 * s:.3g} um; more trials do not improve the tool"
            for name, drive, s in zip(self.names, found.drives, stderr, strict=True)
            if drive.outcomes[-1] < s
        ]
