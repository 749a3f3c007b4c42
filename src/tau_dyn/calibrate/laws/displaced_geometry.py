"""A geometry whose joint positions differ from the encoder readings, for any reason: laws of encoders, elastic drives.

With `q_real(q, p)` the chain rule gives all derivatives: `dX/dp = dX/dq_real dq_real/dp`. Laws and mechanisms are therefore
independent of each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, Closure, Geometry, Predicted
from tau_dyn.mechanism import Poses, Rods
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot


class MovedJoints(NamedTuple):
    """Real positions of joints that differ from the encoder readings.

    Attributes:
        real: Positions (N, na) [m or rad].
        by_parameter: Their derivative by the parameters of the displacement (N, na, p).
        by_position: Returns their derivative by the encoder readings (N, na, na).
    """

    real: np.ndarray
    by_parameter: np.ndarray
    by_position: Callable[[], np.ndarray]


class JointDisplacement(Protocol):
    """Displacement of joints from their encoder readings: laws of encoders, elastic drives."""

    @property
    def parameters(self) -> Parameters:
        """Its parameters, at their nominal values."""
        ...

    @property
    def known_beforehand(self) -> np.ndarray:
        """Which parameters (p,) have prior knowledge."""
        ...

    @property
    def beyond_file(self) -> str:
        """The part of the displacement that no robot file can hold, '' if a file can hold everything."""
        ...

    def move(self, values: np.ndarray, q: np.ndarray, loads: np.ndarray | None) -> MovedJoints:
        """Return the real joint positions at encoder readings (N, na) under loads at the tool (N, 7), None without loads."""
        ...

    def list_springs(self, values: np.ndarray) -> dict[str, tuple[str, float]]:
        """Return the parameter and the compliance of each elastic joint."""
        ...


@dataclass(frozen=True, eq=False)
class DisplacedGeometry(Geometry):
    """A geometry whose joint positions differ from the encoder readings; see `Geometry` for the methods.

    Attributes:
        geometry: The geometry as a function of the joints' real positions.
        displacement: Displacement of the joints.
        loads: Loads at the tool (N, 7), None without loads.
    """

    geometry: Geometry
    displacement: JointDisplacement
    loads: np.ndarray | None = None

    @property
    def parameters(self) -> Parameters:
        """The geometry's parameters, then the displacement's."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        return Parameters([*self.geometry.parameters, *self.displacement.parameters])

    @property
    def robot(self) -> Robot:
        """The robot file."""
        return self.geometry.robot

    @property
    def orients(self) -> bool:
        """Whether the tool can turn."""
        return self.geometry.orients

    @property
    def priority(self) -> np.ndarray:
        """Priorities (p,): the geometry's, then a later one for the displacement; a dimension with the same effect is kept."""
        own, known = self.geometry.priority, self.displacement.known_beforehand
        last = int(own[own < KNOWN_BEFOREHAND].max(initial=0)) + 1
        return np.concatenate([own, np.where(known, KNOWN_BEFOREHAND, last)])

    @property
    def beyond_file(self) -> str:  # type: ignore[override]
        """The part of the displacement or the geometry that no robot file can hold."""
        return self.displacement.beyond_file or self.geometry.beyond_file

    def under(self, loads: np.ndarray) -> Geometry:
        """Return the geometry under loads at the tool (N, 7)."""
        if self.loads is None and not loads.any():
            return self
        return replace(self, geometry=self.geometry.under(loads), loads=loads)

    def split_springs(self, theta: np.ndarray) -> tuple[Geometry, np.ndarray, dict[str, tuple[str, float]]]:
        """Return the geometry of the real positions, its parameters and the drives' springs."""
        own, values = self._split(theta)
        geometry, own, springs = self.geometry.split_springs(own)
        return geometry, own, springs | self.displacement.list_springs(values)

    def rods_at(self, theta: np.ndarray) -> Rods | None:
        """Return the rods with these dimensions."""
        return self.geometry.rods_at(self._split(theta)[0])

    def list_turned_joints(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Return the geometry's joints whose frame's orientation is a parameter."""
        return self.geometry.list_turned_joints(self._split(theta)[0])

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses."""
        own, at = self._move(theta, q)
        return self.geometry.forward(own, at.real, start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        own, at = self._move(theta, q)
        by_joint = self.geometry.tool_by_joint(own, at.real, poses)
        return _append(self.geometry.tool_by_parameter(own, at.real, poses), by_joint, at)

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint's encoder (N, 6, na)."""
        own, at = self._move(theta, q)
        return self.geometry.tool_by_joint(own, at.real, poses) @ at.by_position()

    def passive(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return the positions of passive joints (N, k)."""
        own, at = self._move(theta, q)
        return self.geometry.passive(own, at.real, joints)

    def passive_by_parameter(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per parameter (N, k, p)."""
        own, at = self._move(theta, q)
        by_joint = self.geometry.passive_by_joint(own, at.real, joints)
        return _append(self.geometry.passive_by_parameter(own, at.real, joints), by_joint, at)

    def passive_by_joint(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per actuated joint's encoder (N, k, na)."""
        own, at = self._move(theta, q)
        return self.geometry.passive_by_joint(own, at.real, joints) @ at.by_position()

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> Closure | None:
        """Return the gaps of the loops at tool poses."""
        own, at = self._move(theta, q)
        found = self.geometry.closure(own, at.real, poses)
        if found is None:
            return None
        by_parameter = _append(found.by_parameter, found.by_joint, at)
        return found._replace(by_parameter=by_parameter, by_joint=found.by_joint @ at.by_position())

    def _split(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own, values = np.split(np.asarray(theta, float), [len(self.geometry.parameters)])
        return own, values

    def _move(self, theta: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, MovedJoints]:
        own, values = self._split(theta)
        return own, self.displacement.move(values, q, self.loads)


def _append(own: np.ndarray, by_joint: np.ndarray, at: MovedJoints) -> np.ndarray:
    """Return derivatives (N, d, p) by a geometry's own parameters, then by those of the displacement."""
    return np.concatenate([own, by_joint @ at.by_parameter], axis=2)
