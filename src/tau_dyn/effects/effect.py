"""What every effect answers: its force per unit parameter along a motion.

An effect is written once and used three times. Identification asks for its columns at `sign(v)`, feedforward at a
smoothed sign, and the simulator at +1 and -1, choosing between the two by whether the plant moves, sticks or reverses.
An effect's force is what the *actuator* must add: `tau = rigid body + sum of effects`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


@dataclass(frozen=True, eq=False)
class Motion:
    """Actuated motion as effects see it.

    Attributes:
        joints: Names of the actuated joints, in order.
        q: Positions (N, na) [m or rad].
        v: Velocities (N, na).
        a: Accelerations (N, na).
        sign: Direction of motion (N, na), in [-1, 1]; `sign(v)` unless the caller says otherwise.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray

    @classmethod
    def of(
        cls, joints: tuple[str, ...], q: np.ndarray, v: np.ndarray, a: np.ndarray, sign: np.ndarray | None = None
    ) -> Motion:
        """Build a motion; the sign defaults to that of the velocity."""
        return cls(joints, q, v, a, np.sign(v) if sign is None else sign)


class Effect(ABC):
    """A force that the rigid model leaves out, linear in its parameters.

    Attributes:
        name: How model files call it.
        equation: The law in one line, for people.
        joints: The actuated joints it acts on.
        units: The joints' force units, 'N' or 'N m', by joint.
    """

    name: ClassVar[str]
    equation: ClassVar[str]

    def __init__(self, joints: Iterable[str], units: Iterable[str]) -> None:
        """Let the effect act on these joints, whose forces are in these units ('N' or 'N m')."""
        self.joints = tuple(joints)
        self.units = dict(zip(self.joints, units, strict=True))

    @property
    @abstractmethod
    def parameters(self) -> Parameters:
        """Its parameters at their nominal values (zero: the effect is absent)."""

    @abstractmethod
    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p) along a motion."""

    def force(self, motion: Motion, parameters: Parameters) -> np.ndarray:
        """Return its force (N, na) [N or N m] at these parameter values."""
        return self.columns(motion) @ parameters.select(self.parameters.names).values

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return speeds (N,) beyond the joints' own whose sign it uses, each with the joints' indices it acts on."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """Return what a model file keeps: name and joints; values stand with the parameters."""
        return {"effect": self.name, "joints": list(self.joints)}

    def _indices(self, motion: Motion) -> list[int]:
        missing = [j for j in self.joints if j not in motion.joints]
        if missing:
            raise InputError(f"effect {self.name} acts on joint '{missing[0]}'; there are {', '.join(motion.joints)}")
        return [motion.joints.index(j) for j in self.joints]


class JointwiseEffect(Effect):
    """An effect that acts on each of its joints by that joint's own motion.

    A subclass says its quantities and their force per unit parameter; this class lays the columns out joint by joint.
    """

    quantities: ClassVar[tuple[tuple[str, str], ...]]  # (name, unit with F for the force unit and V for the speed unit)

    @property
    def parameters(self) -> Parameters:
        """Its parameters, joint by joint, at zero."""
        rows = []
        for joint in self.joints:
            speed = "m/s" if self.units[joint] == "N" else "rad/s"
            for quantity, unit in self.quantities:
                text = unit.replace("F", self.units[joint]).replace("V", speed)
                rows.append(Parameter(f"{joint}.{quantity}", 0.0, text, self.lower(quantity), origin=f"{self.name}"))
        return Parameters(rows)

    @staticmethod
    def lower(quantity: str) -> float:
        """Return the smallest admissible value; friction dissipates, so its coefficients are not negative."""
        return -np.inf if quantity == "offset" else 0.0

    @abstractmethod
    def per_joint(self, v: np.ndarray, sign: np.ndarray) -> list[np.ndarray]:
        """Return the force per unit of each quantity (N,), for one joint's velocity and direction (N,)."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        n = len(self.quantities)
        out = np.zeros((*motion.v.shape, n * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            for m, column in enumerate(self.per_joint(motion.v[:, index], motion.sign[:, index])):
                out[:, index, n * k + m] = column
        return out
