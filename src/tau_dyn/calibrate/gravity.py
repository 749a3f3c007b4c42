r"""What gravity loads in a standing robot, the carts of rods and the joints of an arm, and an arm whose joints yield to it.

Rods: the plate balances, `J_X' f = w`, with `J_X` the gaps' derivative by the plate's twist and `w` the wrench of its weight and
half of each rod's weight at its end (rods uniform, so the other half rests on the cart and never changes). Thesis, end of 5.3.

Arm: with `M_j` the mass that joint j carries, `A_j` its first moment about the joint, and `s_j = z_j x A_j` for a turn, `M_j z_j`
for a slide: `tau_j = -g . s_j`. Of a turn j its derivative by a joint k that it carries is `-(g x z_j) . s_k`, and by a turn k
that carries it, itself included, `-(g x z_k) . s_j`; all others are zero. A joint yields by `e = c tau(q) + d tau_1(q)`, `tau`
the torque of the file's masses and `tau_1` that of 1 kg at the tool, which stands for a load that the file does not have.

The file's masses are known to `BodyPrior.rough` only, so `tau = sum_k (1 + m_k) tau_k` over the bodies k that yielding joints
carry, and the base is level within the prior of all angles, as the device's frame takes its tilt `t` up: gravity is `g + t x
g`. The shares `m_k` and `t` are unknowns with these priors; what poses do not tell of them widens intervals of compliances and
of poses.

Torques are those of the nominal arm at the joints' positions before they yield. Calibrated placements would make the direction of
a link's centre of mass a parameter: an offset and the next joint's place turn a link in its own frame without moving the tool.
Reference: Khalil & Besnard 2002.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, Geometry, Predicted
from tau_dyn.calibrate.joint_laws import Displaced, Law, displace
from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.mechanism import Poses, Rods, compute_frames, forward_kinematics, transform_point
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import ROUGH_FILE, BodyPrior, Robot

MAX_DEFLECTION = 0.01
"""Deflection by gravity that a machine is taken to have before its poses are known (one standard deviation) [rad or m]."""
_TRIED = 50
"""Positions at which it is looked whether a joint carries gravity."""
_NO_TORQUE = 1e-9
"""Torque relative to the largest one, or to 1 N m, that is rounding."""


class RodLoads:
    """Loads of one nominal robot; remembers the last positions asked for."""

    def __init__(self, rods: Rods) -> None:
        """Read masses and gravity from the robot."""
        self.rods = rods
        masses = {link.link: link.nominal for link in rods.robot.links}
        plate = masses.get(rods.plate, np.zeros(10))
        self.plate_mass = float(plate[0])
        self.centre = plate[1:4] / plate[0] if plate[0] > 0 else np.zeros(3)
        self.half = np.array([0.5 * _mass(n, rods.names, masses) for n in rods.names])
        self.gravity = rods.robot.model.gravity.linear
        self._remembered: tuple[bytes, np.ndarray] | None = None

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return the force of the rods on each slide (N, na, 3) [N], zero where the nominal robot cannot stand."""
        key = q.tobytes()
        if self._remembered is None or self._remembered[0] != key:
            self._remembered = (key, self._force(q))
        return self._remembered[1]

    def _force(self, q: np.ndarray) -> np.ndarray:
        plate = self.rods.plate_poses(forward_kinematics(self.rods, q).poses)
        out = np.zeros((*q.shape, 3))
        ok = np.asarray(np.isfinite(plate.position).all(axis=1))
        at, where = plate.take(ok), q[ok]
        f, unit = self._axial(where, at), self.rods.rod_directions(where, at)
        for k, carrier in enumerate(self.rods.numbers.carried.carrier):
            joints = self.rods.numbers.joints
            while carrier >= 0:
                out[ok, joints[carrier].actuator] += -f[:, k, None] * unit[:, k]
                carrier = joints[carrier].parent
        return out

    def _axial(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the rods' tensions (N, n) [N]."""
        by_pose = self.rods.gap_by_pose(q, plate)
        wrench = np.zeros((len(q), 6))
        weight = self.gravity * self.plate_mass
        wrench[:, :3] = weight + self.gravity * self.half.sum()
        arms = self.rods.plate_points(plate) - plate.position[:, None]
        wrench[:, 3:] = np.cross(plate.rotation @ self.centre, weight)
        wrench[:, 3:] += np.cross(arms, self.half[:, None] * self.gravity).sum(axis=1)
        rows = 3 if self.rods.translates else 6
        j = np.swapaxes(by_pose[:, :, :rows], 1, 2)  # a rod's pull at the plate is f u = -f d gap / d X
        return np.einsum("nij,nj->ni", np.linalg.pinv(j), wrench[:, :rows])


def _mass(rod: str, rods: Sequence[str], masses: Mapping[str, np.ndarray]) -> float:
    """Return a rod's mass [kg]; a link with several balls is several numbered rods, which share its mass alike."""
    link, number = f"{rod}_link", 1
    stem, _, index = rod.rpartition("_")
    if link not in masses and index.isdigit():
        link, number = f"{stem}_link", sum(other.rpartition("_")[0] == stem for other in rods)
    return float(masses[link][0]) / number if link in masses else 0.0


class GravityMoments(NamedTuple):
    """What a direction of gravity is to be multiplied by, for each body's mass, then for 1 kg at the tool.

    Attributes:
        bodies: Joints that move the bodies with mass (b).
        swept: `s` of each joint and body (na, b + 1, 3, N).
        axes: Directions of the joints that turn, zero of slides (na, 3, N).
        carries: Whether one joint carries another or is it (na, na).
        placed: Mass times place of each body in the robot's base frame (b + 1, 3, N).
    """

    bodies: tuple[str, ...]
    swept: np.ndarray
    axes: np.ndarray
    carries: np.ndarray
    placed: np.ndarray

    def weights(self, errors: Mapping[str, float]) -> np.ndarray:
        """Return what sums bodies (b + 1, 2): all masses, off by shares where these are known, and 1 kg at the tool."""
        weights = np.zeros((len(self.bodies) + 1, 2))
        weights[:-1, 0], weights[-1, 1] = [1 + errors.get(body, 0.0) for body in self.bodies], 1.0
        return weights

    def torques(self, gravity: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Return holding torques (N, na, b + 1 or columns of the weights) [N m or N] in gravity (3,) [m/s^2]."""
        torques = -np.einsum("c,akcn->nak", gravity, self.swept)
        return torques if weights is None else torques @ weights

    def base_moments(self, gravity: np.ndarray) -> np.ndarray:
        """Return the moments of all masses, and of 1 kg at the tool, about the base's origin in gravity (3,) (N, 3, 2) [N m]."""
        moments = np.cross(self.placed, gravity, axisa=1)  # (b + 1, N, 3)
        return np.stack([moments[:-1].sum(axis=0), moments[-1]], axis=2)

    def slopes(self, gravity: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return their derivative by the actuated positions (N, na, columns of the weights, na)."""
        swept = np.einsum("bkcn,kw->bwcn", self.swept, weights)
        by_carried = -np.einsum("acn,bwcn->nawb", np.cross(gravity, self.axes, axisb=1, axisc=1), swept)
        by_carrier = np.swapaxes(by_carried, 1, 3)
        carries = self.carries[:, None]
        return np.where(self.carries.T[:, None], by_carrier, np.where(carries, by_carried, 0.0))


def compute_gravity_moments(tree: TreeGeometry, q: np.ndarray) -> GravityMoments:
    """Return the moments of a tree without loops at its nominal dimensions and joints' positions `q` (N, na)."""
    shape, model = tree.shape, tree.shape.robot.model
    numbers, x = tree.place(tree.parameters.values, q)
    at = compute_frames(numbers.joints, x)
    joints = [next(j for j in numbers.joints if j.v == v) for v in shape.active]
    bodies = [(k, body.mass, body.lever) for k, body in enumerate(model.inertias) if k and body.mass > 0]
    names = tuple(model.names[k] for k, _, _ in bodies)
    bodies.append((shape.tool.joint, 1.0, numbers.tool))
    carried = np.array([[j.index in model.supports[k].tolist() for k, _, _ in bodies] for j in joints])
    weights = np.array([mass for _, mass, _ in bodies])
    masses = (carried * weights)[:, :, None, None]  # by joint and body
    points = np.stack([transform_point(at, carrier, lever) for carrier, _, lever in bodies])
    origin, z = (np.stack([vectors[j.index] for j in joints]) for vectors in (at.origin, at.axis))
    slides = np.array([j.slides for j in joints])[:, None, None]
    turned = np.cross(z[:, None], masses * (points[None] - origin[:, None]), axis=2)
    carries = np.array([[a.index in model.supports[b.index].tolist() for b in joints] for a in joints])
    swept = np.where(slides[:, None], masses * z[:, None], turned)
    return GravityMoments(names, swept, z * ~slides, carries, weights[:, None, None] * points)


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
        """Return the joint's columns (N, p, ..) of torques or their slopes (N, na, 2, ..).

        The torques are those that hold the arm; it yields to gravity, the other way, so that a compliance is positive.
        """
        return -torques[:, self.actuator][:, np.array(self.sizes) > 0]


def build_gravity_laws(
    tree: TreeGeometry, joints: Iterable[str], low: np.ndarray, high: np.ndarray
) -> list[GravityLaw]:
    """Return the laws of those joints that carry gravity somewhere between two positions (na,); the tree has no loops."""
    robot = tree.shape.robot
    q = low + (high - low) * np.random.default_rng(0).random((_TRIED, robot.na))
    moments, gravity = compute_gravity_moments(tree, q), robot.model.gravity.linear
    sizes = np.abs(moments.torques(gravity, moments.weights({}))).max(axis=0)
    threshold = _NO_TORQUE * max(float(sizes.max()), 1.0)
    sizes[sizes < threshold] = 0.0
    loading = np.abs(moments.torques(gravity)[:, :, :-1]).max(axis=0) >= threshold
    found = []
    for joint in joints:
        a = robot.actuated.index(joint)
        if sizes[a].any():
            bodies = tuple(name for name, loads_it in zip(moments.bodies, loading[a], strict=True) if loads_it)
            found.append(GravityLaw(joint, a, robot.position_units[a], (sizes[a, 0], sizes[a, 1]), bodies))
    return found


_TILTS = ("base.tilt_x", "base.tilt_y", "base.tilt_z")
"""Rotation vector by which gravity is turned in the base frame [rad]; the one along gravity does nothing and is left out."""
_LEVEL = 1e-6
"""Share of gravity across an axis that is rounding."""


class _PlacedArm(NamedTuple):
    own: np.ndarray  # the tree's parameters
    yielding: tuple[tuple[GravityLaw, np.ndarray], ...]  # laws of gravity and their values
    moved: Displaced  # by the encoders' laws
    real: np.ndarray  # joints' positions (N, na)
    moments: GravityMoments | None
    gravity: np.ndarray
    weights: np.ndarray  # of the bodies
    torques: np.ndarray  # of all masses and of 1 kg at the tool (N, na, 2)


@dataclass(frozen=True, eq=False)
class ArmGeometry(Geometry):
    """A tree whose joints follow laws beside their encoders; see `geometry.Geometry` for what each method returns.

    Attributes:
        tree: The tree.
        laws: What its joints do besides.
    """

    tree: TreeGeometry
    laws: tuple[Law | GravityLaw, ...]

    @property
    def parameters(self) -> Parameters:
        """The tree's parameters, then the laws', then by what share masses are off that matter to them, and the base's tilt."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        masses = [
            Parameter(f"{body}.mass_error", 0.0, "1", prior_stderr=share, origin="law")
            for body, share in self._mass_shares.items()
        ]
        tilts = [Parameter(_TILTS[axis], 0.0, "rad", origin="law") for axis in self._tilts]
        return Parameters([*self.tree.parameters, *(p for law in self.laws for p in law.parameters), *masses, *tilts])

    @cached_property
    def _bodies(self) -> tuple[str, ...]:
        """Joints whose bodies load a joint that yields, each once."""
        return tuple(dict.fromkeys(b for law in self._gravity_laws for b in law.bodies))

    @property
    def _mass_shares(self) -> dict[str, float]:
        """Standard deviation of the mass of each of these bodies, relative to the robot file's."""
        robot, known = self.robot, BodyPrior.of(self.robot).rough
        stated = {
            str(robot.model.names[link.joint_id]): known[f"{link.link}.mass"] / float(link.nominal[0])
            for link in robot.links
            if f"{link.link}.mass" in known and link.nominal[0] > 0
        }
        return {body: stated.get(body, ROUGH_FILE) for body in self._bodies}

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
    def robot(self) -> Robot:
        """The robot file."""
        return self.tree.robot

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
        at = self._place(theta, q)
        return self.tree.forward(at.own, at.real, start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        at = self._place(theta, q)
        return self._chain(at, self.tree.tool_by_parameter(at.own, at.real), self.tree.tool_by_joint(at.own, at.real))

    def passive(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return the positions of passive joints (N, k)."""
        at = self._place(theta, q)
        return self.tree.passive(at.own, at.real, joints)

    def passive_by_parameter(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per parameter (N, k, p)."""
        at = self._place(theta, q)
        own = self.tree.passive_by_parameter(at.own, at.real, joints)
        return self._chain(at, own, self.tree.passive_by_joint(at.own, at.real, joints))

    def passive_by_joint(self, theta: np.ndarray, q: np.ndarray, joints: Sequence[str]) -> np.ndarray:
        """Return how passive joints move per actuated joint's encoder (N, k, na)."""
        at = self._place(theta, q)
        return self.tree.passive_by_joint(at.own, at.real, joints) @ self._by_position(at) @ at.moved.by_encoder

    def _chain(self, at: _PlacedArm, own: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """Return derivatives per parameter (N, d, p) from those by the tree's (N, d, t) and by joints' positions (N, d, na)."""
        columns = [own]
        through, encoders = slopes @ self._by_position(at), iter(at.moved.columns)
        for law in self.laws:
            if isinstance(law, GravityLaw):
                columns.append(slopes[:, :, [law.actuator]] * law.select(at.torques)[:, None])
            else:
                columns.append(through[:, :, [law.actuator]] * next(encoders)[1])
        return np.concatenate([*columns, slopes @ self._by_load(at)], axis=2)

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint's encoder (N, 6, na)."""
        at = self._place(theta, q)
        return self.tree.tool_by_joint(at.own, at.real) @ self._by_position(at) @ at.moved.by_encoder

    def _place(self, theta: np.ndarray, q: np.ndarray) -> _PlacedArm:
        """Return where the joints really are when their encoders say `q` (N, na)."""
        ends = np.cumsum([len(self.tree.parameters), *(len(law.parameters) for law in self.laws)])
        own, *values, off = np.split(np.asarray(theta, float), ends)
        pairs = [(law, v) for law, v in zip(self.laws, values, strict=True) if not isinstance(law, GravityLaw)]
        moved = displace([law for law, _ in pairs], [v for _, v in pairs], q)
        yielding = [(law, v) for law, v in zip(self.laws, values, strict=True) if isinstance(law, GravityLaw)]
        if not yielding:
            return _PlacedArm(own, (), moved, moved.real, None, np.zeros(3), np.zeros((0, 2)), np.zeros((*q.shape, 2)))
        tilt = np.zeros(3)
        tilt[list(self._tilts)] = off[len(self._bodies) :]
        moments, gravity = compute_gravity_moments(self.tree, moved.real), self._gravity + np.cross(tilt, self._gravity)
        weights = moments.weights(dict(zip(self._bodies, off[: len(self._bodies)].tolist(), strict=True)))
        torques, real = moments.torques(gravity, weights), moved.real.copy()
        for law, v in yielding:
            real[:, law.actuator] += law.select(torques) @ v
        return _PlacedArm(own, tuple(yielding), moved, real, moments, gravity, weights, torques)

    def _by_position(self, at: _PlacedArm) -> np.ndarray:
        """Return the derivative of the joints' positions by those before they yield (N, na, na)."""
        out = np.tile(np.eye(at.real.shape[1]), (len(at.real), 1, 1))
        if at.moments is not None:
            slopes = at.moments.slopes(at.gravity, at.weights)
            for law, v in at.yielding:
                out[:, law.actuator] += np.einsum("npa,p->na", law.select(slopes), v)
        return out

    def _by_load(self, at: _PlacedArm) -> np.ndarray:
        """Return the derivative of the joints' positions by what is off in loads (N, na, o): masses, then the tilt."""
        many = len(self._bodies)
        out = np.zeros((*at.real.shape, many + len(self._tilts)))
        if at.moments is None:
            return out
        own = at.moments.torques(at.gravity)[:, :, [at.moments.bodies.index(body) for body in self._bodies]]
        tilted = [at.moments.torques(np.cross(np.eye(3)[axis], self._gravity), at.weights) for axis in self._tilts]
        for law, v in at.yielding:
            if law.sizes[0] > 0:
                out[:, law.actuator, :many] -= v[0] * own[:, law.actuator]
            for k, torques in enumerate(tilted):
                out[:, law.actuator, many + k] += law.select(torques) @ v
        return out
