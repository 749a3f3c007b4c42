r"""Forces of all drives of a robot with more drives than freedoms, such as carts with two motors, from a model and a motion.

Rigid forces Q of the actuated joints are shared over all n drives, `B' tau = Q`, `B = [1; B_redundant]`. Of all solutions the one
with the smallest sum of squared shares of the force limits L is taken, plus a preload p along the forces that move nothing:

    tau = W B (B' W B)^-1 Q + N p + friction of each drive,   W = diag(L^2),   N = [-B_redundant'; 1]

Two motors on one cart that push against each other by p keep their pinions on opposite flanks, so the cart has no backlash
(thesis 2.3, 4.2). A pinion changes its flank where its force without its own friction, shared part plus preload, has another sign
than its preload. The smallest preload of a motion that avoids this is `max |shared part|` over the drives that are relieved.
A drive on which N changes its sign along the motion, as in mechanisms that turn, is kept on its flank by no constant preload.
Reference: Mueller 2005, on internal preload of redundantly actuated robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.effects import (
    REDUNDANT,
    Armature,
    DisplacementEffect,
    JointMotion,
    JointwiseEffect,
    RedundantArmature,
    read_redundant_motion,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.simulate import Trajectory

_LEAST_SHARE = 0.1  # of a preload's largest force at a drive, below which it turns around there
_RESERVE = 0.1  # of the smallest preload, that a chosen one has in addition


@dataclass(frozen=True, eq=False)
class DriveForces:
    """Forces of all drives along a motion.

    Attributes:
        joints: All n drives, the actuated ones first.
        units: 'N' or 'N m' for each.
        t: Times (N,) [s].
        shared: Shared rigid-body forces (N, n) [N or N m].
        inside: Forces of the preload, which move nothing (N, n).
        friction: Each drive's own friction (N, n).
        limit: Force limits (n,); inf without one.
        preload: Preload of each redundant drive (r,).
        smallest: Smallest preload (r,) with which no drive changes its flank.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    t: np.ndarray
    shared: np.ndarray
    inside: np.ndarray
    friction: np.ndarray
    limit: np.ndarray
    preload: np.ndarray
    smallest: np.ndarray

    @property
    def force(self) -> np.ndarray:
        """Commanded forces (N, n)."""
        return self.shared + self.inside + self.friction

    @property
    def relieved(self) -> np.ndarray:
        """Whether a drive that a preload can keep on its flank pushes against the preload's direction (N, n)."""
        return self.held & ((self.shared + self.inside) * np.sign(self.inside) < 0)

    @property
    def held(self) -> np.ndarray:
        """Whether the preload acts on a drive in one direction throughout (n,)."""
        return find_held_drives(self.inside)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Drives that change their flank."""
        share = self.relieved.mean(axis=0)
        turning = tuple(
            CodedWarning(
                "preload_low",
                f"{joint}: the preload's force changes its direction there along the motion, so none keeps "
                "its gear on one flank",
                (joint,),
            )
            for joint, held, x in zip(self.joints, self.held, np.abs(self.inside).max(axis=0), strict=True)
            if not held and x > 0
        )
        return turning + tuple(
            CodedWarning(
                "preload_low",
                f"{joint}: its force turns against its preload in {100 * x:.2g} % of the motion, so its gear passes backlash; "
                f"{np.abs(self.smallest).max():.4g} {self.units[-1]} of preload avoid it",
                (joint,),
            )
            for joint, x in zip(self.joints, share, strict=True)
            if x > 0
        )

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one row a drive."""
        size = np.abs(self.force).max(axis=0)
        return [
            {
                "joint": joint, "unit": self.units[k], "force_max": float(size[k]), "force_limit": float(self.limit[k]),
                "preload": float(np.mean(self.inside[:, k])), "share_relieved": float(np.mean(self.relieved[:, k])),
            }
            for k, joint in enumerate(self.joints)
        ]  # fmt: skip

    def to_csv(self) -> str:
        """Return a table of t and tau_ff_J of all drives."""
        import pandas as pd

        columns = {"t": self.t} | {f"tau_ff_{joint}": x for joint, x in zip(self.joints, self.force.T, strict=True)}
        return pd.DataFrame(columns).to_csv(index=False, float_format="%.12g", lineterminator="\n")


def compute_drive_forces(
    model: Model, motion: Trajectory, preload: Sequence[float] = (), *, width: float = 0.01
) -> DriveForces:
    """Return the forces of all drives along a motion.

    Args:
        model: Model of a robot with more drives than freedoms.
        motion: Motion of the actuated joints.
        preload: Of each redundant drive [N or N m], in the robot's order; empty for the same for all, a tenth above the smallest
            that keeps every gear on its flank.
        width: Speed within which the sign of friction is smoothed [m/s or rad/s].

    Raises:
        InputError: The robot has no redundant drives, or their number is another one.
        CannotAnswer: A drive would exceed its force limit.
    """
    robot = model.robot
    n_more = len(robot.redundant_joints)
    if not n_more:
        raise InputError("unsupported", f"{robot.source}: it has no more drives than freedoms, so no force is shared")
    if len(preload) not in (0, n_more):
        raise InputError(
            "bad_option", f"{', '.join(robot.redundant_joints)}: give one preload for each, not {len(preload)}"
        )
    q, v, a = motion.q, motion.v, motion.a
    own = [e for e in model.effects if _is_own_friction(e)]
    rigid = Feedforward(model.only([e for e in model.effects if e not in own]), width=width)(q, v, a)
    sign = np.clip(v / width, -1, 1)
    followed = model.only(own).motion(q, v, a, sign, t=motion.t, needs={REDUNDANT})
    rates, followers = read_redundant_motion(followed)
    followers = [replace(d, sign=np.clip(d.v / width, -1, 1)) for d in followers]
    drives = [*(JointMotion.of(followed, k) for k in range(robot.na)), *followers]
    joints = (*robot.actuated, *robot.redundant_joints)
    limit = _read_limits(model)
    shared = _share(rigid, rates, limit)
    unit = np.concatenate(
        [-rates.transpose(0, 2, 1), np.broadcast_to(np.eye(n_more), (len(q), n_more, n_more))], axis=1
    )
    asked = np.array(preload, float) if len(preload) else np.ones(n_more)
    smallest = asked * _scale_smallest(shared, unit @ asked)
    chosen = asked if len(preload) else (1 + _RESERVE) * smallest
    found = DriveForces(
        joints, (*robot.force_units, *robot.redundant_units), motion.t, shared, unit @ chosen,
        _compute_own_friction(model, own, joints, drives), limit, chosen, smallest,
    )  # fmt: skip
    _require_limits(found)
    return found


def _is_own_friction(effect: Any) -> bool:
    """Return whether an effect is a force of each drive by its own motion, without rotors, which share rigid-body forces."""
    return isinstance(effect, JointwiseEffect) and not isinstance(
        effect, DisplacementEffect | Armature | RedundantArmature
    )


def _share(rigid: np.ndarray, rates: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Return forces of all drives (N, n) for generalised ones (N, na), by least squares in shares of the limits."""
    na = rigid.shape[1]
    B = np.concatenate([np.broadcast_to(np.eye(na), (len(rates), na, na)), rates], axis=1)
    weight = np.where(np.isfinite(limit).all(), limit, np.ones_like(limit)) ** 2
    WB = weight[:, None] * B
    return np.einsum("nkj,nj->nk", WB, np.linalg.solve(B.transpose(0, 2, 1) @ WB, rigid[:, :, None])[:, :, 0])


def find_held_drives(inside: np.ndarray) -> np.ndarray:
    """Return the drives (n,) on which forces of a preload (N, n) act in one direction and never become small."""
    size = np.abs(inside)
    return (size.min(axis=0) > _LEAST_SHARE * size.max(axis=0)) & (np.abs(np.sign(inside).sum(axis=0)) == len(inside))


def _scale_smallest(shared: np.ndarray, inside: np.ndarray) -> float:
    """Return the factor of preload forces (N, n) from which on no drive is relieved of them."""
    pushes = find_held_drives(inside) & (inside != 0)
    against = np.where(pushes, -shared * np.sign(inside), 0.0)
    return float(np.max(against / np.where(pushes, np.abs(inside), 1.0), initial=0.0))


def _compute_own_friction(
    model: Model, effects: Sequence[Any], joints: Sequence[str], drives: Sequence[JointMotion]
) -> np.ndarray:
    """Return the friction of each drive (N, n)."""
    values = model.parameters
    out = np.zeros((len(drives[0].v), len(joints)))
    for effect in effects:
        for joint in effect.joints:
            k = joints.index(joint)
            for (term, _), x in zip(effect.terms, effect.per_joint(drives[k]), strict=True):
                out[:, k] += values[f"{joint}.{term}{effect.label}"].value * x
    return out


def _read_limits(model: Model) -> np.ndarray:
    """Return the force limits of all drives (n,); inf without one."""
    tree = model.robot.model
    drives = (*model.robot.actuated, *model.robot.redundant_joints)
    found = tree.upperEffortLimit[[tree.joints[tree.getJointId(joint)].idx_v for joint in drives]]
    return np.where(found > 0, found, np.inf)


def _require_limits(found: DriveForces) -> None:
    """Refuse forces beyond a limit.

    Raises:
        CannotAnswer: A drive exceeds its limit.
    """
    size = np.abs(found.force).max(axis=0)
    over = next((k for k in range(len(size)) if size[k] > found.limit[k]), None)
    if over is not None:
        raise CannotAnswer(
            "no_solution",
            f"{found.joints[over]} needs {size[over]:.4g} {found.units[over]}, its limit is {found.limit[over]:.4g}; "
            f"{np.abs(found.inside[:, over]).max():.4g} of it are preload",
            "a slower motion, or a smaller preload",
        )
