"""How far the tool can lean at one place: its axis tilted towards every side, until a demand is not met."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.mechanism import Poses

_SIDES = 24  # directions of leaning, 15 degrees apart
_MAX_TILT_RAD = np.deg2rad(120.0)
_STEP = np.deg2rad(1.0)


class Tilt(NamedTuple):
    """Reachable orientations at a place.

    Attributes:
        place: (3,) [m].
        towards: Directions in the tool's xy plane into which its z axis leans (m,) [rad].
        angle: How far it can lean towards each (m,) [rad].
        reason: Why not farther (m words).
    """

    place: np.ndarray
    towards: np.ndarray
    angle: np.ndarray
    reason: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return a plain mapping, angles in degrees."""
        return {
            "place": self.place,
            "towards_deg": np.rad2deg(self.towards),
            "tilt_deg": np.rad2deg(self.angle),
            "every_way_deg": float(np.rad2deg(self.angle.min())),
            "best_way_deg": float(np.rad2deg(self.angle.max())),
            "limited_by": list(self.reason),
        }


def turns_freely(found: Workspace) -> bool:
    """Return whether the tool's orientation can be chosen: six freedoms, six actuators."""
    machine = found.machine
    if machine.robot.na < 6:
        return False
    return machine.rods is None or not machine.rods.translates


def measure_tilt(found: Workspace, place: np.ndarray) -> Tilt:
    """Return how far the tool can lean at a place, starting from the workspace's orientation.

    Raises:
        InputError: The robot's tool does not turn freely, or the place does not belong to the workspace.
    """
    if not turns_freely(found):
        raise InputError(
            "unsupported", f"{found.machine.robot.source}: the tool does not turn freely, so it has no range of tilt"
        )
    place = np.asarray(place, float)
    judged = found.judge.judge(found.poses(place[None]))
    if judged.code[0] != INSIDE:
        words = found.reasons.words(int(judged.code[0]))
        raise InputError(
            "unreachable",
            f"the place {', '.join(f'{x:.4g}' for x in place)} m does not belong to the workspace ({words})",
        )
    towards = np.arange(_SIDES) * 2 * np.pi / _SIDES
    angles = np.arange(1, round(_MAX_TILT_RAD / _STEP) + 1) * _STEP
    axes = np.stack([-np.sin(towards), np.cos(towards), np.zeros(_SIDES)], axis=1)
    alive, reach, reason = np.ones(_SIDES, bool), np.full(_SIDES, angles[-1]), [""] * _SIDES
    for block in np.array_split(angles, 8):  # outwards, so that inverse kinematics has neighbours to start from
        sides = np.flatnonzero(alive)
        if not len(sides):
            break
        turn = Rotation.from_rotvec((axes[sides, None] * block[:, None]).reshape(-1, 3)).as_matrix()
        poses = Poses(np.tile(place, (len(turn), 1)), found.rotation @ turn)
        code = found.judge.judge(poses).code.reshape(len(sides), len(block))
        for k, row in zip(sides, code, strict=True):
            if (row != INSIDE).any():
                first = int(np.argmax(row != INSIDE))
                reach[k], alive[k] = block[first] - _STEP, False
                reason[k] = found.reasons.words(int(row[first]))
    return Tilt(place, towards, np.maximum(reach, 0.0), tuple(reason))
