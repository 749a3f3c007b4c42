"""Dimensions of a parallel robot at parameter values: turning joints by a rotation vector after their nominal orientation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism import AXES, Carried, RodDimensions, frames

TURN = "turn"


@dataclass(frozen=True, eq=False)
class TurnedNumbers(RodDimensions):
    """Dimensions that remember the rotation vectors of turning joints."""

    turns: dict[str, np.ndarray] | None = None

    def turn(self, joint: str) -> np.ndarray:
        """Return a turning joint's rotation vector (3,) [rad]."""
        return (self.turns or {}).get(joint, np.zeros(3))


def compute_dimensions_at(nominal: RodDimensions, values: dict[str, float]) -> RodDimensions:
    """Return a robot's dimensions at parameter values, those of `kinematics.geometry` with `turn` in place of an axis."""

    def vector(owner: str, what: str) -> np.ndarray:
        return np.array([values[f"{owner}.{what}_{a}"] for a in AXES])

    joints, turns = list(nominal.joints), {}
    if nominal.arms:
        for arm, carrier in zip(nominal.arms, nominal.carried.carrier, strict=True):
            joints[carrier] = joints[carrier]._replace(origin=vector(arm, "origin"), direction=vector(arm, "direction"))
        lengths = np.array([values[f"{arm}.length"] for arm in nominal.arms])
        return replace(nominal, joints=tuple(joints), lengths=lengths)
    for k, joint in enumerate(joints):
        if joint.slides:
            joints[k] = joint._replace(origin=vector(joint.name, "origin"), direction=vector(joint.name, "direction"))
            continue
        turn = turns[joint.name] = vector(joint.name, TURN)
        own = joint.rotation.T @ joint.direction  # the axis in the joint's own frame
        rotation = joint.rotation @ Rotation.from_rotvec(turn).as_matrix()
        joints[k] = joint._replace(origin=vector(joint.name, "origin"), direction=rotation @ own, rotation=rotation)
    return TurnedNumbers(
        **{
            **{f: getattr(nominal, f) for f in RodDimensions.__dataclass_fields__},
            "joints": tuple(joints),
            "carried": Carried(nominal.carried.carrier, np.array([vector(n, "base") for n in nominal.names])),
            "lengths": np.array([values[f"{n}.length"] for n in nominal.names]),
            "on_plate": np.array([vector(n, "plate") for n in nominal.names]),
        },
        turns=turns,
    )


def right_jacobian(t: np.ndarray) -> np.ndarray:
    """Return `J_r(t)` (3, 3): `Exp(t + dt) = Exp(t) Exp(J_r dt)` (Chirikjian 2012)."""
    angle = float(np.linalg.norm(t))
    k = frames.skew(t)
    if angle < 1e-6:
        return np.eye(3) - 0.5 * k + k @ k / 6
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * (k @ k)
