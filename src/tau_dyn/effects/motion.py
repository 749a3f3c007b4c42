"""Actuated motion as effects see it: of all joints, or of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of all actuated joints.

    Attributes:
        joints: Names of the actuated joints, in order.
        q: Positions (N, na) [m or rad].
        v: Velocities (N, na).
        a: Accelerations (N, na).
        sign: Direction of motion (N, na), in [-1, 1]; `sign(v)` unless the caller says otherwise.
        t: Time (N,) [s] of samples in order, evenly spaced; None for samples in no order, as in a single simulator step.
        signals: What else some effects feel, by name: `load` (N, na) [N, N m] across each joint's axis, `passive`
            (N, n, 3, na) angular velocity of each passive joint per actuated speed, `inertia` (N, na, na) mass matrix,
            `damping` (N, na) growth of friction with speed, `weight_gradient` (N, na, na) change of the weights with the
            positions, `rigid_force` (N, na) force of the rigid bodies, `force` (N, na) force of the model without the effect,
            `temperature` (N, na) [degC], `reversal` (N, na) distance since each joint's last reversal [m or rad], `campaign`
            (N,) number of the log, `gravity_turn` (N, na, 2) forces at rest per turn of gravity.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        joints: tuple[str, ...],
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray | None = None,
        *,
        t: np.ndarray | None = None,
        signals: Mapping[str, np.ndarray] | None = None,
    ) -> Motion:
        """Build a motion; the sign defaults to that of the velocity."""
        return cls(joints, q, v, a, np.sign(v) if sign is None else sign, t, dict(signals or {}))

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or say that it is missing."""
        return _signal(self.signals, name)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """One joint's part of a motion, each (N,)."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, motion: Motion, index: int) -> JointMotion:
        """Look at the joint of this index; signals (N,) that belong to no joint stay as they are."""
        signals = {key: x[:, index] if x.ndim == 2 else x for key, x in motion.signals.items() if x.ndim < 3}
        q, v, a, sign = (x[:, index] for x in (motion.q, motion.v, motion.a, motion.sign))
        return cls(q, v, a, sign, motion.t, signals)

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or say that it is missing."""
        return _signal(self.signals, name)


def _signal(signals: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return a signal; which effect misses it is said by `effect.naming`."""
    if name not in signals:
        raise InputError("unsupported", f"this effect feels {name}, which the motion does not give")
    return signals[name]
