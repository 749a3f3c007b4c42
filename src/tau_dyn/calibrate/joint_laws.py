r"""What an arm's joints do beside turning as their encoders say: each law is a few more parameters, zero in the nominal robot.

    q_real = q + sum of laws e

- eccentricity: an encoder disc off its axis, `e = s sin q + c cos q`;
- gravity: joint and gear yield to the gravity torque, `e = c tau(q) + d tau_1(q)`, with `tau` the torque of the file's masses
  and `tau_1` that of 1 kg at the tool, which stands for a load that the file does not have;
- coupling: another joint's drive turns this one along, `e = k q_other`.

The file's masses are known to `BODY_STDERR` only, so `tau = sum_k (1 + m_k) tau_k` over the bodies k that such joints carry, and
the base is level within the prior of all angles, as the device's frame takes its tilt `t` up: gravity is `g + t x g`. The shares
`m_k` and `t` are unknowns with these priors; what poses do not tell of them widens the intervals of compliances and of poses.

Torques are those of the nominal arm at the joints' positions before they yield. Calibrated placements would make the direction of
a link's centre of mass a parameter: an offset and the next joint's place turn a link in its own frame without moving the tool.

References: Whitney, Lozinski & Rourke 1986 (gears' errors, coupling, compliance); Khalil & Besnard 2002 (gravity).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, Predicted, WithoutClosure
from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.mechanism import Poses, compute_frames, transform_point
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot.robot import BODY_STDERR

MAX_DEFLECTION = 0.01
"""Deflection by gravity that a machine is taken to have before its poses are known (one standard deviation) [rad or m]."""
_COUPLING_STDERR = 0.1
"""Share of another joint's motion that may be coupled in, one standard deviation."""
_TRIED = 50
"""Positions at which it is looked whether a joint carries gravity."""
_TILTS = ("base.tilt_x", "base.tilt_y", "base.tilt_z")
"""Rotation vector by which gravity is turned in the base frame [rad]; the one along gravity does nothing and is left out."""
_LEVEL = 1e-6
"""Share of gravity across an axis that is rounding."""
_NO_TORQUE = 1e-9
"""Torque relative to the largest one, or to 1 N m, that is rounding."""


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


@dataclass(frozen=True, eq=False)
class GravityLaw:
    """A joint that yields to the gravity torque it carries.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        unit: Of the joint.
        sizes: Largest torques of the masses and of 1 kg at the tool on this joint [N m or N].
        bodies: Joints whose bodies' masses load this joint.
    """

    joint: str
    actuator: int
    unit: str
    sizes: tuple[float, float]
    bodies: tuple[str, ...]

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

    def select(self, torques: np.ndarray) -> np.ndarray:
        """Return the joint's columns (N, p, ..) of torques or their slopes (N, na, 2, ..)."""
        return torques[:, self.actuator][:, np.array(self.sizes) > 0]


JointLaw = EccentricityLaw | CouplingLaw | GravityLaw
"""An error of one actuated joint's position."""


class GravityTorques(NamedTuple):
    """Torques that hold a tree against gravity, those of each body's mass first, then those of 1 kg at the tool.

    Attributes:
        bodies: Joints that move the bodies with mass (b).
        torques: (N, na, b + 1) [N m or N].
        slopes: Their derivative by the actuated positions (N, na, b + 1, na).
    """

    bodies: tuple[str, ...]
    torques: np.ndarray
    slopes: np.ndarray

    def sum_bodies(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return torques (N, na, 2) and slopes (N, na, 2, na) of all masses, off by shares (b,), and of 1 kg at the tool."""
        weights = np.zeros((len(self.bodies) + 1, 2))
        weights[:-1, 0], weights[-1, 1] = 1 + errors, 1.0
        return self.torques @ weights, np.einsum("nakb,kw->nawb", self.slopes, weights)


def compute_gravity_torques(
    tree: TreeGeometry, theta: np.ndarray, q: np.ndarray, gravity: np.ndarray | None = None
) -> GravityTorques:
    """Return the torques of a tree without loops, its geometry at `theta` (p,), its joints at `q` (N, na), gravity (3,) [m/s^2].

    With `M_j` the mass that joint j carries, `A_j` its first moment about the joint, and `s_j = z_j x A_j` for a turn, `M_j z_j`
    for a slide: `tau_j = -g . s_j`. Of a turn j its derivative by a joint k that it carries is `-(g x z_j) . s_k`, and by a turn
    k that carries it, itself included, `-(g x z_k) . s_j`; all others are zero.
    """
    shape, model = tree.shape, tree.shape.robot.model
    numbers, x = tree.place(theta, q)
    at, gravity = compute_frames(numbers.joints, x), model.gravity.linear if gravity is None else gravity
    joints = [next(j for j in numbers.joints if j.v == v) for v in shape.active]
    bodies = [(k, body.mass, body.lever) for k, body in enumerate(model.inertias) if k and body.mass > 0]
    names = tuple(model.names[k] for k, _, _ in bodies)
    bodies.append((shape.tool.joint, 1.0, numbers.tool))
    carried = np.array([[j.index in model.supports[k].tolist() for k, _, _ in bodies] for j in joints])
    masses = carried * np.array([mass for _, mass, _ in bodies])  # by joint and body
    points = np.stack([transform_point(at, carrier, lever) for carrier, _, lever in bodies])
    origin, z = (np.stack([vectors[j.index] for j in joints]) for vectors in (at.origin, at.axis))
    slides = np.array([j.slides for j in joints])
    moment = masses[:, :, None, None] * (points[None] - origin[:, None])
    swept = np.where(
        slides[:, None, None, None], masses[:, :, None, None] * z[:, None], np.cross(z[:, None], moment, axis=2)
    )
    torques = -np.einsum("c,akcn->nak", gravity, swept)
    turning = np.cross(gravity, z, axisb=1, axisc=1) * ~slides[:, None, None]
    products = -np.einsum("acn,bkcn->nakb", turning, swept)
    carries = np.array([[a.index in model.supports[b.index].tolist() for b in joints] for a in joints])
    by_carried, by_carrier = products, np.swapaxes(products, 1, 3)
    slopes = np.where(carries.T[:, None], by_carrier, np.where(carries[:, None], by_carried, 0.0))
    return GravityTorques(names, torques, slopes)


class _Deflected(NamedTuple):
    real: np.ndarray  # joints' positions (N, na)
    by_position: np.ndarray  # their derivative by the positions without loads (N, na, na)
    torques: np.ndarray  # of all masses and of 1 kg at the tool (N, na, 2)
    bodies: np.ndarray  # of each mass that counts (N, na, m)


@dataclass(frozen=True, eq=False)
class ArmGeometry(WithoutClosure):
    """A tree whose joints follow laws beside their encoders; see `geometry.Geometry` for what each method returns.

    Attributes:
        tree: The tree.
        laws: What its joints do besides.
    """

    tree: TreeGeometry
    laws: tuple[JointLaw, ...]

    @property
    def parameters(self) -> Parameters:
        """The tree's parameters, then the laws', then by what share masses are off that matter to them, and the base's tilt."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        masses = [
            Parameter(f"{body}.mass_error", 0.0, "1", prior_stderr=BODY_STDERR, origin="law") for body in self._bodies
        ]
        tilts = [Parameter(_TILTS[axis], 0.0, "rad", origin="law") for axis in self._tilts]
        return Parameters([*self.tree.parameters, *(p for law in self.laws for p in law.parameters), *masses, *tilts])

    @cached_property
    def _bodies(self) -> tuple[str, ...]:
        """Joints whose bodies load a joint that yields, each once."""
        return tuple(dict.fromkeys(b for law in self._gravity_laws for b in law.bodies))

    @cached_property
    def _gravity_laws(self) -> tuple[GravityLaw, ...]:
        return tuple(law for law in self.laws if isinstance(law, GravityLaw))

    @property
    def _gravity(self) -> np.ndarray:
        return np.asarray(self.tree.shape.robot.model.gravity.linear)

    @cached_property
    def _tilts(self) -> tuple[int, ...]:
        """Axes about which a tilt of the base turns gravity, where a joint yields to it."""
        across = np.linalg.norm(np.cross(np.eye(3), self._gravity), axis=1)
        return (
            tuple(np.flatnonzero(across > _LEVEL * np.linalg.norm(self._gravity)).tolist())
            if self._gravity_laws
            else ()
        )

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
        own, loads = self.tree.priority, len(self._bodies) + len(self._tilts)
        laws = np.full(len(self.parameters) - len(own) - loads, int(own.max(initial=0)) + 1)
        return np.concatenate([own, laws, np.full(loads, KNOWN_BEFOREHAND)])

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses."""
        own, of_laws, off = self._split(theta)
        return self.tree.forward(own, self._deflect(of_laws, off, self._move(of_laws, q)).real, start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        own, of_laws, off = self._split(theta)
        moved = self._move(of_laws, q)
        at = self._deflect(of_laws, off, moved)
        slopes, columns = self.tree.tool_by_joint(own, at.real), [self.tree.tool_by_parameter(own, at.real)]
        through = slopes @ at.by_position
        for law in self.laws:
            if isinstance(law, GravityLaw):
                columns.append(slopes[:, :, [law.actuator]] * law.select(at.torques)[:, None, :])
            else:
                columns.append(through[:, :, [law.actuator]] * law.compute_columns(q)[:, None, :])
        return np.concatenate([*columns, slopes @ self._by_load(of_laws, off, moved, at)], axis=2)

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint's encoder (N, 6, na)."""
        own, of_laws, off = self._split(theta)
        at = self._deflect(of_laws, off, self._move(of_laws, q))
        moving = np.broadcast_to(np.eye(q.shape[1]), (len(q), q.shape[1], q.shape[1])).copy()
        for law, values in zip(self.laws, of_laws, strict=True):
            if not isinstance(law, GravityLaw):
                moving[:, law.actuator] += np.einsum("npa,p->na", law.compute_slopes(q), values)
        return self.tree.tool_by_joint(own, at.real) @ at.by_position @ moving

    def _split(self, theta: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
        """Return the tree's parameters, each law's, and what is off in loads: masses, then the tilt."""
        ends = np.cumsum([len(self.tree.parameters), *(len(law.parameters) for law in self.laws)])
        own, *of_laws, off = np.split(np.asarray(theta, float), ends)
        return own, of_laws, off

    def _move(self, of_laws: Sequence[np.ndarray], q: np.ndarray) -> np.ndarray:
        """Return where the joints are (N, na) by their encoders' laws, before they yield."""
        moved = np.array(q, float)
        for law, values in zip(self.laws, of_laws, strict=True):
            if not isinstance(law, GravityLaw):
                moved[:, law.actuator] += law.compute_columns(q) @ values
        return moved

    def _deflect(self, of_laws: Sequence[np.ndarray], off: np.ndarray, moved: np.ndarray) -> _Deflected:
        """Return where the joints really are, from where they would be without loads (N, na)."""
        real, by_position = moved.copy(), np.broadcast_to(np.eye(moved.shape[1]), (*moved.shape, moved.shape[1])).copy()
        if not self._gravity_laws:
            return _Deflected(real, by_position, np.zeros((*moved.shape, 2)), np.zeros((*moved.shape, 0)))
        tilt = np.zeros(3)
        tilt[list(self._tilts)] = off[len(self._bodies) :]
        loads = self._load(moved, self._gravity + np.cross(tilt, self._gravity))
        torques, slopes = loads.sum_bodies(self._of_bodies(loads, off))
        for law, values in zip(self.laws, of_laws, strict=True):
            if isinstance(law, GravityLaw):
                real[:, law.actuator] += law.select(torques) @ values
                by_position[:, law.actuator] += np.einsum("npa,p->na", law.select(slopes), values)
        places = [loads.bodies.index(body) for body in self._bodies]
        return _Deflected(real, by_position, torques, loads.torques[:, :, places])

    def _by_load(self, of_laws: Sequence[np.ndarray], off: np.ndarray, moved: np.ndarray, at: _Deflected) -> np.ndarray:
        """Return the derivative of the joints' positions by what is off in loads (N, na, o)."""
        tilted = [self._load(moved, np.cross(np.eye(3)[axis], self._gravity)) for axis in self._tilts]
        sums = [loads.sum_bodies(self._of_bodies(loads, off))[0] for loads in tilted]
        out, many = np.zeros((*moved.shape, len(off))), len(self._bodies)
        for law, values in zip(self.laws, of_laws, strict=True):
            if isinstance(law, GravityLaw):
                if law.sizes[0] > 0:
                    out[:, law.actuator, :many] += values[0] * at.bodies[:, law.actuator]
                for k, torques in enumerate(sums):
                    out[:, law.actuator, many + k] += law.select(torques) @ values
        return out

    def _load(self, moved: np.ndarray, gravity: np.ndarray) -> GravityTorques:
        return compute_gravity_torques(self.tree, self.tree.parameters.values, moved, gravity)

    def _of_bodies(self, loads: GravityTorques, off: np.ndarray) -> np.ndarray:
        """Return by what share each body's mass is off (b,), zero where it does not count."""
        known = dict(zip(self._bodies, off[: len(self._bodies)].tolist(), strict=True))
        return np.array([known.get(body, 0.0) for body in loads.bodies])


def build_gravity_laws(
    tree: TreeGeometry, joints: Iterable[str], low: np.ndarray, high: np.ndarray
) -> list[GravityLaw]:
    """Return the laws of those joints that carry gravity somewhere between two positions (na,); the tree has no loops."""
    robot = tree.shape.robot
    q = low + (high - low) * np.random.default_rng(0).random((_TRIED, robot.na))
    loads = compute_gravity_torques(tree, tree.parameters.values, q)
    sizes = np.abs(loads.sum_bodies(np.zeros(len(loads.bodies)))[0]).max(axis=0)
    threshold = _NO_TORQUE * max(float(sizes.max()), 1.0)
    sizes[sizes < threshold] = 0.0
    loading = np.abs(loads.torques[:, :, :-1]).max(axis=0) >= threshold
    found = []
    for joint in joints:
        a = robot.actuated.index(joint)
        if sizes[a].any():
            bodies = tuple(name for name, loads_it in zip(loads.bodies, loading[a], strict=True) if loads_it)
            found.append(GravityLaw(joint, a, robot.position_units[a], (sizes[a, 0], sizes[a, 1]), bodies))
    return found
