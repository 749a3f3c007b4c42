"""From a force sensor's reading to the force at the tool point, in world axes, without the weight that hangs on the sensor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tau_dyn.exceptions import InputError

GRAVITY = np.array([0.0, 0.0, -9.81])
"""Gravity in the world [m/s^2]."""


@dataclass(frozen=True, eq=False)
class ForceSensor:
    """Where a six-axis sensor sits and what hangs on it; a bare default reads at the tool point in the tool's axes.

    Attributes:
        position: The sensor's origin in the tool's frame (3,) [m].
        rotation: Its axes in the tool's frame (3, 3).
        mass: What hangs on it, past the sensor [kg].
        centre: That mass' centre in the sensor's frame (3,) [m].
        offset: What it reads without any load (6,) [N, N m].
    """

    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    mass: float = 0.0
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def __post_init__(self) -> None:
        """Refuse what is no sensor."""
        shapes = {"position": (3,), "rotation": (3, 3), "centre": (3,), "offset": (6,)}
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), float)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError("wrong_shape", f"a force sensor's {name} must be {shape} finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if np.abs(self.rotation.T @ self.rotation - np.eye(3)).max() > 1e-6 or np.linalg.det(self.rotation) < 0:
            raise InputError("mismatch", "a force sensor's rotation must be a rotation matrix")
        if not (np.isfinite(self.mass) and self.mass >= 0):
            raise InputError(
                "invalid_value", f"the mass on a force sensor must not be below zero, but it is {self.mass}"
            )

    def at_tool(self, reading: np.ndarray, tool_rotation: np.ndarray) -> np.ndarray:
        """Return the wrench (6,) at the tool point in world axes, the weight taken off.

        Args:
            reading: Force and torque on what hangs on the sensor (6,) [N, N m], in the sensor's axes at its origin.
            tool_rotation: The tool's axes in the world (3, 3).
        """
        turn = tool_rotation @ self.rotation
        force, torque = turn @ (reading[:3] - self.offset[:3]), turn @ (reading[3:] - self.offset[3:])
        weight = self.mass * GRAVITY
        force, torque = force - weight, torque - _cross(turn @ self.centre, weight)
        return np.concatenate([force, torque + _cross(tool_rotation @ self.position, force)])

    def reading(self, wrench: np.ndarray, tool_rotation: np.ndarray) -> np.ndarray:
        """Return what the sensor shows (6,) under a wrench (6,) at the tool point in world axes: `at_tool` reversed."""
        turn = tool_rotation @ self.rotation
        weight = self.mass * GRAVITY
        torque = wrench[3:] - _cross(tool_rotation @ self.position, wrench[:3]) + _cross(turn @ self.centre, weight)
        return np.concatenate([turn.T @ (wrench[:3] + weight), turn.T @ torque]) + self.offset


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
