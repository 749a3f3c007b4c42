"""The floor that a robot stands on: its frame and its carts' travel, seen from above.

No source defines the ratio it goes with, so both readings are reported: workspace volume per floor area [m], and per volume
of the upright box around frame and carts (the installation). Rods and plate, which reach beyond, belong to the workspace
and do not count.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.kinematics.collisions import PlacedSolid
from tau_dyn.kinematics.shapes import Box, Capsule, Cylinder, HalfSpace
from tau_dyn.kinematics.workspace.machine import WorkspaceModel, get_travel
from tau_dyn.kinematics.workspace.result import Footprint


def build_footprint(machine: WorkspaceModel) -> Footprint:
    """Return a robot's footprint."""
    solids = machine.solids(machine.robot.home[None], machine.home)
    fixed = [_corners(s) for s, body in zip(solids, machine.bodies, strict=True) if body.joint == 0]
    what = ["frame"] if fixed else []
    if machine.rods is not None:
        lower, upper = get_travel(machine.robot)
        share = np.random.default_rng(0).random((400, machine.robot.na))
        q = np.concatenate([[lower, upper, machine.robot.home], lower + share * (upper - lower)])
        fixed.append(machine.rods.base_points(q).reshape(-1, 3))
        what.append("rods' joints over the actuators' travel")
    if not fixed:
        return Footprint(np.zeros(2), np.zeros(2), 0.0, "unknown: the file draws no frame in simple shapes")
    points = np.concatenate(fixed)
    low, high = points.min(axis=0), points.max(axis=0)
    return Footprint(low[:2], high[:2], float(high[2] - low[2]), " and ".join(what))


def _corners(solid: PlacedSolid) -> np.ndarray:
    """Return the corners (8, 3) of a box around a solid at its first pose."""
    shape = solid.shape
    if isinstance(shape, Box):
        half = np.array(shape.size) / 2
    elif isinstance(shape, Cylinder):
        half = np.array([shape.radius, shape.radius, shape.height / 2])
    elif isinstance(shape, Capsule):
        half = np.array([shape.radius, shape.radius, shape.length / 2 + shape.radius])
    else:
        assert not isinstance(shape, HalfSpace)
        half = np.full(3, shape.radius)
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return solid.position[0] + (signs * half) @ solid.rotation[0].T
