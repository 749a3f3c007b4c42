r"""Interface of a mechanism for calibration: its dimensions as parameters, and the derivatives of the tool pose by them.

Everything else (frames, weights, uncertainty, identifiability, choice of poses) is written once against `Geometry`.
Values travel separately as a vector `theta` (p,), so that a geometry is frozen; poses are in the robot's base frame,
twists in world axes, linear first, at the tool frame's origin. With loops `c(theta, q, X) = 0` kept closed, `dX =
-(dc/dX)^-1 (dc/dtheta dtheta + dc/dq dq)`.
Reference: Khalil & Dombre 2002, ch. 11; Hollerbach, Khalil & Gautier 2016.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import Poses, Rods
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Brief
from tau_dyn.robot import Robot

KNOWN_BEFOREHAND = 1000
"""Priority of a parameter with prior knowledge (`prior_stderr`): it is never dropped, and its uncertainty always counts."""


class Predicted(NamedTuple):
    """Tool poses predicted by a model.

    Attributes:
        poses: Tool poses (N) in the robot's base frame; nan where not `ok`.
        ok: Whether a pose was found (N,).
        reason: Why no pose was found (N,), '' if one was found.
    """

    poses: Poses
    ok: np.ndarray
    reason: np.ndarray


class Closure(NamedTuple):
    """Gaps of the loops at given tool poses, and their derivatives.

    Attributes:
        gap: Gaps (N, m) [m].
        by_parameter: Derivative by the parameters (N, m, p).
        by_pose: Derivative by the tool's twist (N, m, 6).
        by_joint: Derivative by the actuated joints (N, m, na).
    """

    gap: np.ndarray
    by_parameter: np.ndarray
    by_pose: np.ndarray
    by_joint: np.ndarray


class Geometry(Brief, ABC):
    """A mechanism whose dimensions are parameters.

    The defaults are those of a mechanism without a closure residual (a tree's loops involve passive joints, which are not
    measured) and without a robot file or a compensation file that could hold it.

    Attributes:
        parameters: Nominal values; units m, rad, 1. Parameters that are not `free` are fixed at their value.
        priority: Whole numbers (p,): among dependent parameters those with smaller numbers are kept.
        beyond_file: The part of the geometry that no robot file can hold, '' if a file can hold everything.
    """

    parameters: Parameters
    priority: np.ndarray
    beyond_file: str = "laws of its joints"

    @property
    @abstractmethod
    def robot(self) -> Robot:
        """The robot file."""

    @property
    @abstractmethod
    def orients(self) -> bool:
        """Whether the tool's orientation is predicted (False: a plate that only translates)."""

    @abstractmethod
    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses at `q` (N, na), searched from `start` if given."""

    @abstractmethod
    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p), loops kept closed."""

    @abstractmethod
    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na), loops kept closed."""

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints, in the order of `q`."""
        return self.robot.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`: `m` of a slide, `rad` of a turn."""
        return self.robot.position_units

    def under(self, loads: np.ndarray) -> Geometry:
        """Return the geometry itself: it has no elastic parts."""
        return self

    def split_springs(self, theta: np.ndarray) -> tuple[Geometry, np.ndarray, dict[str, tuple[str, float]]]:
        """Return the geometry itself and no springs."""
        return self, theta, {}

    def passive(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return the positions (N, k) of passive joints that close the loops, nan where they cannot be closed.

        Raises:
            InputError: The robot is not a tree with loops.
        """
        raise InputError(
            "unsupported", f"{', '.join(joints)}: encoders of passive joints need a robot as a tree with loops"
        )

    def passive_by_parameter(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per parameter (N, k, p), loops kept closed; see `passive`."""
        return self.passive(theta, q, joints)

    def passive_by_joint(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per actuated joint (N, k, na), loops kept closed; see `passive`."""
        return self.passive(theta, q, joints)

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> Closure | None:
        """Return the gaps of the loops at tool poses (N) (thesis (5.1)), None if the mechanism has no closure residual."""
        return None

    @property
    def description(self) -> dict[str, Any] | None:
        """Description of the geometry in a compensation file (`build_described_geometry`), None if there is none."""
        return None

    def rods_at(self, theta: np.ndarray) -> Rods | None:
        """Return the rods with these dimensions, without the laws, for kinematics; None for a robot without rods."""
        return None

    def format_urdf(self, theta: np.ndarray) -> str:
        """Return the robot file with these dimensions.

        Raises:
            InputError: A robot file cannot hold them.
        """
        raise InputError("unsupported", f"a robot file cannot hold {self.beyond_file}")

    def list_turned_joints(self, theta: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """Return joints whose frame's orientation is a parameter, with that orientation (3, 3) in the parent's frame."""
        return []


@dataclass(frozen=True, eq=False)
class ConstrainedGeometry(Geometry):
    """A geometry with fewer parameters: several of the original ones move together, or not at all.

    `theta = theta_0 + Z (y - y_0)`: equal rods, parallel guideways and other simplifications are such constraints.

    Attributes:
        geometry: The original.
        parameters: The remaining parameters at their nominal values `y_0`.
        matrix: `Z` (p, r).
        priority: As in `Geometry` (r,).
    """

    geometry: Geometry
    parameters: Parameters
    matrix: np.ndarray
    priority: np.ndarray

    @property
    def robot(self) -> Robot:
        """The robot file."""
        return self.geometry.robot

    @property
    def orients(self) -> bool:
        """Whether the tool's orientation is predicted."""
        return self.geometry.orients

    def full(self, theta: np.ndarray) -> np.ndarray:
        """Return the original's parameters (p,)."""
        return self.geometry.parameters.values + self.matrix @ (theta - self.parameters.values)

    def under(self, loads: np.ndarray) -> Geometry:
        """Return the geometry under loads at the tool (N, 7)."""
        inner = self.geometry.under(loads)
        return self if inner is self.geometry else replace(self, geometry=inner)

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses."""
        return self.geometry.forward(self.full(theta), q, start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, r)."""
        return self.geometry.tool_by_parameter(self.full(theta), q, poses) @ self.matrix

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's twist per actuated joint (N, 6, na)."""
        return self.geometry.tool_by_joint(self.full(theta), q, poses)

    def passive(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return the positions of passive joints (N, k)."""
        return self.geometry.passive(self.full(theta), q, joints)

    def passive_by_parameter(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per parameter (N, k, r)."""
        return self.geometry.passive_by_parameter(self.full(theta), q, joints) @ self.matrix

    def passive_by_joint(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per actuated joint (N, k, na)."""
        return self.geometry.passive_by_joint(self.full(theta), q, joints)

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> Closure | None:
        """Return the gaps of the loops at tool poses."""
        found = self.geometry.closure(self.full(theta), q, poses)
        return None if found is None else found._replace(by_parameter=found.by_parameter @ self.matrix)


def constrain_parameters(
    geometry: Geometry, together: Mapping[str, Sequence[str]], left_out: Sequence[str] = ()
) -> ConstrainedGeometry:
    """Return a geometry in which parameters move together or stay at their nominal values.

    Args:
        geometry: The original.
        together: New name -> names of the parameters that change by the same amount; its nominal value is their mean.
        left_out: Parameters that are fixed.

    Raises:
        UnknownName: A parameter that the geometry does not have.
    """
    old = geometry.parameters
    for name in [*(n for names in together.values() for n in names), *left_out]:
        if name not in old:
            raise UnknownName("geometry parameter", name, old.names)
    owner = {name: new for new, names in together.items() for name in names}
    rows: dict[str, Parameter] = {}
    columns: dict[str, list[int]] = {}
    for k, p in enumerate(old):
        if p.name in left_out:
            continue
        new = owner.get(p.name, p.name)
        columns.setdefault(new, []).append(k)
        rows.setdefault(new, replace(p, name=new))
    matrix = np.zeros((len(old), len(rows)))
    for r, indices in enumerate(columns.values()):
        matrix[indices, r] = 1.0
    means = [float(np.mean(old.values[indices])) for indices in columns.values()]
    parameters = Parameters(replace(p, value=v) for p, v in zip(rows.values(), means, strict=True))
    priority = np.array([geometry.priority[indices].min() for indices in columns.values()], int)
    return ConstrainedGeometry(geometry, parameters, matrix, priority)


def expand_constraints(geometry: Geometry, *thetas: np.ndarray) -> tuple[Geometry, tuple[np.ndarray, ...]]:
    """Return the unconstrained geometry, and vectors of parameters (each (r,)) as the original's (p,)."""
    while isinstance(geometry, ConstrainedGeometry):
        thetas, geometry = tuple(geometry.full(theta) for theta in thetas), geometry.geometry
    return geometry, thetas
