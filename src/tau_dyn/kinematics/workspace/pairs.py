"""Which solids of a robot are tested against each other.

A rod is not tested against the cart and the plate that hold its joints, nor against what that cart rides on: there the ball
joint's angle is the limit, and how brackets and sockets are cut is not in a robot file. What touches at home is left out as
well, and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.kinematics.bodies import Body
from tau_dyn.kinematics.collisions import PlacedSolid, find_collisions
from tau_dyn.kinematics.workspace.machine import WorkspaceModel

_GUIDEWAY_CLEARANCE_M = 0.02  # [m] what a cart keeps from the guideway that it rides on


@dataclass(frozen=True)
class SolidPair:
    """Two solids: indices among the bodies, and what the pair is called."""

    first: int
    second: int
    name: str

    def touches(self, solids: Mapping[int, PlacedSolid] | Sequence[PlacedSolid], margin: float) -> np.ndarray:
        """Return at which poses (N,) they come closer than `margin` [m]."""
        return find_collisions(solids[self.first], solids[self.second], margin)


def list_pairs(machine: WorkspaceModel, margin: float = 0.0) -> tuple[list[SolidPair], list[str]]:
    """Return the pairs to test, and the names of those left out because they touch at home though nothing joins them."""
    bodies = machine.bodies
    solids = machine.solids(machine.robot.home[None], machine.home)
    kept: list[SolidPair] = []
    touching: list[str] = []
    for i in range(len(bodies)):
        for j in range(i):
            a, b = (i, j) if bodies[i].rod >= 0 else (j, i)  # a rod first: its cover is the finest
            if _joined(a, b, bodies, solids, machine):
                continue
            pair = SolidPair(a, b, f"{bodies[a].name} and {bodies[b].name}")
            if not pair.touches(solids, margin)[0]:
                kept.append(pair)
            elif not _rides(bodies[a], bodies[b], machine):
                touching.append(pair.name)
    return kept, list(dict.fromkeys(touching))


def _joined(a: int, b: int, bodies: list[Body], solids: list[PlacedSolid], machine: WorkspaceModel) -> bool:
    """Return whether two solids belong to one link, or one is a rod and the other holds its joint or carries what does."""
    if bodies[a].rod < 0:
        return bodies[a].joint == bodies[b].joint
    if bodies[b].rod >= 0:
        return _share_an_end(solids[a], solids[b])
    holders = machine.holders(bodies[a].rod)
    if bodies[b].joint in holders:
        return True
    carts = [k for k, body in enumerate(bodies) if body.rod < 0 and body.joint in holders]
    under = [machine.robot.model.parents[j] for j in holders]
    return bodies[b].joint in under and any(
        find_collisions(solids[k], solids[b], _GUIDEWAY_CLEARANCE_M)[0] for k in carts
    )


def _rides(a: Body, b: Body, machine: WorkspaceModel) -> bool:
    """Return whether a joint lies between two links."""
    parents = machine.robot.model.parents
    return a.rod < 0 and (parents[a.joint] == b.joint or parents[b.joint] == a.joint)


def _share_an_end(a: PlacedSolid, b: PlacedSolid) -> bool:
    return bool(np.linalg.norm(_ends(a)[:, None] - _ends(b)[None], axis=2).min() < 1e-3)


def _ends(rod: PlacedSolid) -> np.ndarray:
    """Return a rod's joints (2, 3) at its first pose."""
    assert rod.length is not None
    half = rod.rotation[0][:, 2] * rod.length[0] / 2
    return np.array([rod.position[0] - half, rod.position[0] + half])
