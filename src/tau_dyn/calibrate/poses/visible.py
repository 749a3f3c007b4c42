"""Which candidates a device sees, and why not the others."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from tau_dyn.calibrate.poses.devices import SEEN, MeasuringDevice
from tau_dyn.calibrate.poses.line_of_sight import check_place, find_occlusions
from tau_dyn.calibrate.poses.reachable import Reachable
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.kinematics import Surroundings
from tau_dyn.kinematics.workspace import WorkspaceModel

_HELP = {
    "nearer": "a device farther away",
    "farther": "a device nearer to the robot",
    "pattern not wholly": "a wider lens, a smaller pattern, or a camera farther away",
    "pattern seen from behind": "a pattern that faces the camera",
    "pattern seen at": "a pattern that faces the camera",
    "behind": "a camera that looks at the robot",
    "reflector": "a reflector that faces the tracker",
    "below": "a tracker that stands lower or farther away",
    "above": "a tracker that stands higher or farther away",
    "hidden": "another place for the device, or fewer obstacles",
}


@dataclass(frozen=True, eq=False)
class Visible:
    """Candidates that a device sees.

    Attributes:
        index: Which of the reachable poses (n,).
        reasons: Why the others are not, with their number, most frequent first.
    """

    index: np.ndarray
    reasons: dict[str, int]


def find_visible(
    device: MeasuringDevice, poses: Reachable, around: Surroundings, machine: WorkspaceModel | None
) -> Visible:
    """Return which poses a device sees.

    Args:
        device: The device.
        poses: Where the robot may be.
        around: Obstacles that may stand between.
        machine: The robot, whose own solids may hide the target; None leaves them out.

    Raises:
        InputError: The device stands in an obstacle.
        CannotAnswer: It sees none of the poses; says mostly why.
    """
    check_place(device, around)
    why = device.reasons(poses.tool)
    left = np.flatnonzero(why == SEEN)
    why[left] = find_occlusions(device, poses.tool.take(left), poses.q[left], around, machine)
    index = np.flatnonzero(why == SEEN)
    reasons = dict(Counter(why[why != SEEN].tolist()).most_common())
    if not len(index):
        word = next(iter(reasons))
        remedy = next((text for start, text in _HELP.items() if word.startswith(start)), "another place for the device")
        raise CannotAnswer(
            "not_visible",
            f"the {device.name} sees none of the {poses.n} poses in reach (mostly: {word}, {reasons[word]} of them)",
            remedy,
        )
    return Visible(index, reasons)
