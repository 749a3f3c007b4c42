"""What stands between a device and its target: obstacles, and the robot itself."""

from __future__ import annotations

import numpy as np

from tau_dyn.calibrate.poses.devices import SEEN, MeasuringDevice
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import PlacedSolid, Surroundings, build_capsule, build_standing_solid, find_collisions
from tau_dyn.kinematics.workspace import WorkspaceModel
from tau_dyn.mechanism import Poses

_BEAM = 1e-4  # [m] radius of a line of sight
_FREE = 0.02  # [m] before the mark that may be hidden: the target's own mount


def check_place(device: MeasuringDevice, around: Surroundings) -> None:
    """Refuse a device that stands inside an obstacle.

    Raises:
        InputError: It does; names both.
    """
    if device.place is None:
        return
    for solid in around.obstacles:
        if solid.blocks == "robot" and solid.distance(device.place[None])[0] < 0:
            place = ", ".join(f"{x:g}" for x in device.place)
            raise InputError(
                "invalid_value",
                f"the {device.name} at ({place}) m stands inside the obstacle '{solid.name}'; move one of them",
            )


def find_occlusions(
    device: MeasuringDevice, tool: Poses, q: np.ndarray, around: Surroundings, machine: WorkspaceModel | None
) -> np.ndarray:
    """Return what hides the target at each pose (N,), '' where nothing does.

    Args:
        device: Looks.
        tool: Tool poses (N).
        q: Actuated positions there (N, na).
        around: Obstacles; zones that only the tool must keep out of hide nothing.
        machine: The robot, whose own solids hide as well; None leaves them out.
    """
    out = np.full(len(q), SEEN, dtype=object)
    if device.place is None or not len(q):
        return out
    solids = [(o.name, build_standing_solid(o.shape, o.placement)) for o in around.obstacles if o.blocks == "robot"]
    if machine is not None:
        bodies = zip(machine.bodies, machine.solids(q, tool), strict=True)
        solids += [
            (f"the robot's own {body.name}", solid) for body, solid in bodies if not _carries(body.joint, machine)
        ]
    marks = device.marks(tool)
    for k in range(marks.shape[1]):
        beam = _beam(device.place, marks[:, k])
        for name, solid in solids:
            left = np.flatnonzero(out == SEEN)
            if len(left):
                hit = np.broadcast_to(find_collisions(beam.take(left), solid.take(left)), len(left))
                out[left[hit]] = f"hidden by {name}"
    return out


def _beam(place: np.ndarray, marks: np.ndarray) -> PlacedSolid:
    along = marks - place
    size = np.linalg.norm(along, axis=1, keepdims=True)
    end = place + along * np.maximum(1 - _FREE / np.maximum(size, 1e-9), 0.0)
    start = np.repeat(place[None], len(marks), axis=0)
    return build_capsule(_BEAM, float(size.max(initial=1e-6)), start, end)


def _carries(joint: int, machine: WorkspaceModel) -> bool:
    """Return whether a body is the tool's own link, which holds the target."""
    robot = machine.robot
    frame = robot.tool_frame if robot.tool_frame is not None else robot.model.nframes - 1
    return robot.model.frames[frame].parentJoint == joint
