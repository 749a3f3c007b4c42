r"""The passive bearings of a mechanism with loops, and how fast each turns per actuated speed.

A bearing lies between two bodies with mass. So passive hinges that follow each other through links without mass are one
(a universal joint), and a cut ball is one. A chain with a passive slide in it only says where a body is (a Gantry-Tau's
plate, counted from the base) and is no bearing. Only mechanisms with loops have passive joints.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.robot import Robot


class BearingPair(NamedTuple):
    """One passive bearing.

    Attributes:
        name: Its joints' names, or the cut's.
        weights: How each velocity of the tree turns it (nv,): 1, 0 or -1.
        hinge: Index of its only hinge in the tree's velocity, or None for a bearing with more than one axis.
    """

    name: str
    weights: np.ndarray
    hinge: int | None


def find_passive_pairs(robot: Robot, model: pin.Model) -> tuple[BearingPair, ...]:
    """Return the passive bearings of a robot; none without loops."""
    if not robot.loops:
        return ()
    pairs = [_of_chain(model, chain) for chain in _chains(robot, model) if _turns(model, chain)]
    for loop in robot.loops:
        a, b = (_carries(model, model.frames[k].parentJoint) for k in (loop.frame_a, loop.frame_b))
        pairs.append(BearingPair(loop.name.replace("_link", ""), a - b, None))
    return tuple(pairs)


def compute_turning_rates(pairs: tuple[BearingPair, ...], jacobian: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return angular velocities per actuated speed (n, 3, na).

    Args:
        pairs: The bearings.
        jacobian: The tree's angular Jacobian in world axes (3, nv), each joint's own share.
        G: Tree velocity per actuated speed (nv, na).
    """
    out = np.zeros((len(pairs), 3, G.shape[1]))
    for k, pair in enumerate(pairs):
        if pair.hinge is not None:
            out[k, 0] = G[pair.hinge]
        else:
            out[k] = (jacobian * pair.weights) @ G
    return out


def _chains(robot: Robot, model: pin.Model) -> list[list[int]]:
    """Return the passive joints, those joined by a link without mass together, base to tip."""
    passive = [j for j in range(1, model.njoints) if model.names[j] not in robot.actuated]
    heavy = {link.joint_id for link in robot.links}
    chains: dict[int, list[int]] = {}
    for joint in passive:
        parent = model.parents[joint]
        follows = parent in chains and parent not in heavy and list(model.parents).count(parent) == 1
        chains[joint] = [*(chains.pop(parent) if follows else []), joint]
    return list(chains.values())


def _turns(model: pin.Model, chain: list[int]) -> bool:
    """Return whether a chain only turns: hinges and balls."""
    kinds = [model.joints[j].shortname() for j in chain]
    return all(kind.startswith(("JointModelR", "JointModelSpherical")) for kind in kinds)


def _of_chain(model: pin.Model, chain: list[int]) -> BearingPair:
    weights = np.zeros(model.nv)
    for j in chain:
        weights[model.joints[j].idx_v :][: model.joints[j].nv] = 1.0
    only = model.joints[chain[0]] if len(chain) == 1 else None
    hinge = only.idx_v if only is not None and only.nv == 1 else None
    return BearingPair("+".join(model.names[j] for j in chain), weights, hinge)


def _carries(model: pin.Model, joint: int) -> np.ndarray:
    """Return 1 for each velocity that moves a joint's link (nv,)."""
    weights = np.zeros(model.nv)
    for j in model.supports[joint].tolist()[1:]:
        weights[model.joints[j].idx_v :][: model.joints[j].nv] = 1.0
    return weights
