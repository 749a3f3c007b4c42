r"""What an arm's joints do beside turning as their encoders say: each law is a few more parameters, zero in the nominal robot.

    q_real = q + sum of laws e

- eccentricity: an encoder disc off its axis, `e = s sin q + c cos q`;
- gravity: joint and gear yield to the gravity torque, `e = c tau(q) + d tau_1(q)`, with `tau` the torque of the file's masses
  and `tau_1` that of 1 kg at the tool, which stands for a load that the file does not have;
- coupling: another joint's drive turns this one along, `e = k q_other`.

Gravity torques are those of the nominal arm, its couplings included; the calibrated arm's differ by parts in a thousand.

References: Whitney, Lozinski & Rourke 1986 (gears' errors, coupling, compliance); Khalil & Besnard 2002 (gravity).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import pinocchio as pin

from tau_dyn.calibrate.geometry import Predicted
from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.calibrate.tree_shape import compute_tool_frame
from tau_dyn.kinematics.poses import Poses
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

MAX_DEFLECTION = 0.01
"""Deflection by gravity that a machine is taken to have before its poses are known (one standard deviation) [rad or m]."""
_COUPLING_STDERR = 0.1
"""Share of another joint's motion that may be coupled in, one standard deviation."""
_STEP = 1e-6
"""Step of the differences of gravity torques [rad or m]; rounding and curvature stay below 1e-8 of the torque."""

_TRIED = 50
"""Positions at which it is looked whether a joint carries gravity."""
_NO_TORQUE = 1e-9
"""Torque relative to the largest one, or to 1 N m, that is rounding."""


class JointLaw(Protocol):
    """An error of one actuated joint's position."""

    @property
    def actuator(self) -> int:
        """Index of the joint in `q`."""
        ...

    @property
    def parameters(self) -> Parameters:
        """Its parameters (p,), at their nominal values."""
        ...

    def compute_columns(self, q: np.ndarray) -> np.ndarray:
        """Return the error per unit parameter (N, p) at `q` (N, na); the error is linear in the parameters."""
        ...

    def compute_slopes(self, q: np.ndarray) -> np.ndarray:
        """Return the columns' derivative by the actuated positions (N, p, na)."""
        ...


@dataclass(frozen=True)
class EccentricityLaw:
    """An encoder disc or gear that turns off its axis.

    Attributes:
        joint: Joint name.
        actuator: Its index.
    """

    joint: str
    actuator: int

    @property
    def parameters(self) -> Parameters:
        """Two amplitudes."""
        return Parameters(Parameter(f"{self.joint}.eccentricity_{x}", 0.0, "rad", origin="law") for x in ("sin", "cos"))

    def compute_columns(self, q: np.ndarray) -> np.ndarray:
        """Return sine and cosine of the joint's angle (N, 2)."""
        x = q[:, self.actuator]
        return np.column_stack([np.sin(x), np.cos(x)])

    def compute_slopes(self, q: np.ndarray) -> np.ndarray:
        """Return their derivative (N, 2, na)."""
        x, out = q[:, self.actuator], np.zeros((len(q), 2, q.shape[1]))
        out[:, 0, self.actuator], out[:, 1, self.actuator] = np.cos(x), -np.sin(x)
        return out


@dataclass(frozen=True)
class CouplingLaw:
    """Motion that another joint's drive passes on, by a gear train in the arm or an encoder against the ground.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        other: Name of the joint that moves it along.
        source: That joint's index.
        ratio: Nominal share: 0, or 1 or -1 where all of the other joint's motion is added.
    """

    joint: str
    actuator: int
    other: str
    source: int
    ratio: float = 0.0

    @property
    def parameters(self) -> Parameters:
        """The share."""
        name = f"{self.joint}.coupling_{self.other}"
        return Parameters([Parameter(name, self.ratio, "1", prior_stderr=_COUPLING_STDERR, origin="law")])

    def compute_columns(self, q: np.ndarray) -> np.ndarray:
        """Return the other joint's position (N, 1)."""
        return q[:, [self.source]]

    def compute_slopes(self, q: np.ndarray) -> np.ndarray:
        """Return the derivative, one for the other joint (N, 1, na)."""
        out = np.zeros((len(q), 1, q.shape[1]))
        out[:, 0, self.source] = 1.0
        return out


class GravityTorques:
    """Gravity torques of a nominal arm without loops, from the robot file's masses and from 1 kg at the tool."""

    def __init__(self, robot: Robot) -> None:
        """Read masses and gravity from the robot."""
        self._robot = robot
        self._tool = compute_tool_frame(robot)
        self._remembered: tuple[bytes, np.ndarray] | None = None

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return torques (N, na, 2) [N m or N] of the masses and of 1 kg at the tool at `q` (N, na)."""
        key = q.tobytes()
        if self._remembered is None or self._remembered[0] != key:
            data = self._robot.model.createData()
            self._remembered = (key, np.array([self._compute(row, data) for row in q]).reshape(len(q), q.shape[1], 2))
        return self._remembered[1]

    def _compute(self, q: np.ndarray, data: pin.Data) -> np.ndarray:
        model, moved = self._robot.model, np.zeros(self._robot.model.nv)
        moved[self._robot.active_v] = q
        full = pin.integrate(model, pin.neutral(model), moved)
        of_masses = pin.computeGeneralizedGravity(model, data, full)
        jacobian = pin.computeFrameJacobian(model, data, full, self._tool, pin.LOCAL_WORLD_ALIGNED)
        of_load = -jacobian[:3].T @ model.gravity.linear
        return np.column_stack([of_masses, of_load])[self._robot.active_v]


@dataclass(frozen=True, eq=False)
class GravityLaw:
    """A joint that yields to the gravity torque it carries.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        unit: Of the joint.
        torques: Of the nominal arm.
        sizes: Largest torques of the masses and of 1 kg at the tool on this joint [N m or N].
    """

    joint: str
    actuator: int
    unit: str
    torques: GravityTorques
    sizes: tuple[float, float]

    @property
    def parameters(self) -> Parameters:
        """The compliance where the robot file has masses, and the deflection by a load at the tool."""
        force = "N" if self.unit == "m" else "N m"
        names = (("gravity_compliance", f"{self.unit}/({force})"), ("load_deflection", f"{self.unit} kg/({force})"))
        return Parameters(
            Parameter(f"{self.joint}.{name}", 0.0, unit, prior_stderr=MAX_DEFLECTION / size, origin="law")
            for (name, unit), size in zip(names, self.sizes, strict=True)
            if size > 0
        )

    def compute_columns(self, q: np.ndarray) -> np.ndarray:
        """Return the torques (N, p)."""
        return self.torques(q)[:, self.actuator][:, np.array(self.sizes) > 0]

    def compute_slopes(self, q: np.ndarray) -> np.ndarray:
        """Return their derivative (N, p, na) by central differences."""
        steps = _STEP * np.eye(q.shape[1])
        return np.stack(
            [(self.compute_columns(q + s) - self.compute_columns(q - s)) / (2 * _STEP) for s in steps], axis=2
        )


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """A tree whose joints follow laws beside their encoders; see `geometry.Geometry` for what each method returns.

    Attributes:
        tree: The tree.
        laws: What its joints do besides; those of gravity take the joints' nominal positions, the others what encoders show.
    """

    tree: TreeGeometry
    laws: tuple[JointLaw, ...]

    @property
    def parameters(self) -> Parameters:
        """The tree's parameters, then the laws'."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        return Parameters([*self.tree.parameters, *(p for law in self.laws for p in law.parameters)])

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints."""
        return self.tree.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`."""
        return self.tree.position_units

    @property
    def orients(self) -> bool:
        """Whether the tool can turn."""
        return self.tree.orients

    @property
    def priority(self) -> np.ndarray:
        """The tree's, and one more for the laws: what a dimension does as well stays with the dimension (p,)."""
        n = len(self.parameters) - len(self.tree.parameters)
        return np.concatenate([self.tree.priority, np.full(n, int(self.tree.priority.max(initial=0)) + 1)])

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses."""
        own, of_laws = self._split(theta)
        return self.tree.forward(own, self._move(of_laws, q), start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        own, of_laws = self._split(theta)
        moved = self._move(of_laws, q)
        slopes, columns = self.tree.tool_by_joint(own, moved), [self.tree.tool_by_parameter(own, moved)]
        for law in self.laws:
            columns.append(slopes[:, :, [law.actuator]] * law.compute_columns(self._where(law, q))[:, None, :])
        return np.concatenate(columns, axis=2)

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint's encoder (N, 6, na)."""
        own, of_laws = self._split(theta)
        moving = np.broadcast_to(np.eye(q.shape[1]), (len(q), q.shape[1], q.shape[1])).copy()
        for law, values in zip(self.laws, of_laws, strict=True):
            slope = np.einsum("npa,p->na", law.compute_slopes(self._where(law, q)), values)
            moving[:, law.actuator] += slope @ self._nominal if isinstance(law, GravityLaw) else slope
        return self.tree.tool_by_joint(own, self._move(of_laws, q)) @ moving

    def closure(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        """Return None, as the tree does."""
        return None

    def closure_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        """Return None, as the tree does."""
        return None

    def closure_by_pose(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        """Return None, as the tree does."""
        return None

    def closure_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses) -> None:
        """Return None, as the tree does."""
        return None

    def _split(self, theta: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the tree's parameters and each law's."""
        ends = np.cumsum([len(self.tree.parameters), *(len(law.parameters) for law in self.laws)])
        own, *of_laws = np.split(np.asarray(theta, float), ends[:-1])
        return own, of_laws

    def _move(self, of_laws: Sequence[np.ndarray], q: np.ndarray) -> np.ndarray:
        """Return where the joints really are (N, na)."""
        moved = np.array(q, float)
        for law, values in zip(self.laws, of_laws, strict=True):
            moved[:, law.actuator] += law.compute_columns(self._where(law, q)) @ values
        return moved

    @cached_property
    def _nominal(self) -> np.ndarray:
        """The joints' nominal positions by what their encoders show (na, na)."""
        out = np.eye(len(self.actuated))
        for law in self.laws:
            if isinstance(law, CouplingLaw):
                out[law.actuator, law.source] += law.ratio
        return out

    def _where(self, law: JointLaw, q: np.ndarray) -> np.ndarray:
        """Return the positions that a law takes (N, na)."""
        return q @ self._nominal.T if isinstance(law, GravityLaw) else q


def build_gravity_laws(robot: Robot, joints: Iterable[str], low: np.ndarray, high: np.ndarray) -> list[GravityLaw]:
    """Return the laws of those joints that carry gravity somewhere between two positions (na,)."""
    torques = GravityTorques(robot)
    spread = np.random.default_rng(0).random((_TRIED, robot.na))
    sizes = np.abs(torques(low + (high - low) * spread)).max(axis=0)
    sizes[sizes < _NO_TORQUE * max(float(sizes.max()), 1.0)] = 0.0
    found = []
    for joint in joints:
        a = robot.actuated.index(joint)
        if sizes[a].any():
            found.append(GravityLaw(joint, a, robot.position_units[a], torques, (sizes[a, 0], sizes[a, 1])))
    return found
