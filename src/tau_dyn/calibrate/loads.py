r"""What gravity loads in a standing robot: the carts of rods, the joints of an arm; and how an arm's joints yield to it.

Rods: the plate balances, `J_X' f = w`, with `J_X` the gaps' derivative by the plate's twist and `w` the wrench of its weight and
half of each rod's weight at its end (rods uniform, so the other half rests on the cart and never changes). Thesis, end of 5.3.

Arm: with `M_j` the mass that joint j carries, `A_j` its first moment about the joint, and `s_j = z_j x A_j` for a turn, `M_j z_j`
for a slide: `tau_j = -g . s_j`. Of a turn j its derivative by a joint k that it carries is `-(g x z_j) . s_k`, and by a turn k
that carries it, itself included, `-(g x z_k) . s_j`; all others are zero. A joint yields by `e = c tau(q) + d tau_1(q)`, `tau`
the torque of the file's masses and `tau_1` that of 1 kg at the tool, which stands for a load that the file does not have.
Reference: Khalil & Besnard 2002.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.mechanism import Poses, Rods, compute_frames, forward_kinematics, transform_point
from tau_dyn.parameters import Parameter, Parameters

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
    """

    bodies: tuple[str, ...]
    swept: np.ndarray
    axes: np.ndarray
    carries: np.ndarray

    def weights(self, errors: Mapping[str, float]) -> np.ndarray:
        """Return what sums bodies (b + 1, 2): all masses, off by shares where these are known, and 1 kg at the tool."""
        weights = np.zeros((len(self.bodies) + 1, 2))
        weights[:-1, 0], weights[-1, 1] = [1 + errors.get(body, 0.0) for body in self.bodies], 1.0
        return weights

    def torques(self, gravity: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Return holding torques (N, na, b + 1 or columns of the weights) [N m or N] in gravity (3,) [m/s^2]."""
        torques = -np.einsum("c,akcn->nak", gravity, self.swept)
        return torques if weights is None else torques @ weights

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
    masses = (carried * np.array([mass for _, mass, _ in bodies]))[:, :, None, None]  # by joint and body
    points = np.stack([transform_point(at, carrier, lever) for carrier, _, lever in bodies])
    origin, z = (np.stack([vectors[j.index] for j in joints]) for vectors in (at.origin, at.axis))
    slides = np.array([j.slides for j in joints])[:, None, None]
    turned = np.cross(z[:, None], masses * (points[None] - origin[:, None]), axis=2)
    carries = np.array([[a.index in model.supports[b.index].tolist() for b in joints] for a in joints])
    return GravityMoments(names, np.where(slides[:, None], masses * z[:, None], turned), z * ~slides, carries)


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
