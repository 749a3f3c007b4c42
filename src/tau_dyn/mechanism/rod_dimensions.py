r"""A plate's legs as equations and as named parameters; arrays have components first and samples last.

With `r_k = R b_k`, `d_k = A_k - T - r_k` the rods close where `f_k = (|d_k|^2 - L_k^2) / 2 = 0`. A small displacement `(x, w)`
of the plate, linear and angular in world axes, changes `f` by `-(d_k . x + (r_k x d_k) . w)`, so a Newton step on SE(3) solves

    [d_k, r_k x d_k] (x, w) = f,   T <- T + x,   R <- Exp(w) R

without angles and so without singular orientations (thesis (4.14), (4.33); Merlet 2006, ch. 4).

Parameters: `<rod>.length`, `<rod>.base_x` (A in the frame of the link that carries it), `<rod>.plate_x` (B in the plate's
frame), `<joint>.origin_x` and `<joint>.direction_x` of an actuated slide, `<joint>.axis_x` of an actuated turn, both in the
parent's frame; a direction's or axis' length is the drive's gain (thesis, section 5.4). A simplified Gantry-Tau has instead,
arm by arm, `<arm>.length`, `.origin_x`, `.direction_x`: the offsets of its plate and cart joints are part of the origin (thesis
(4.7)). A slide in a rod lengthens it: `length` is then the length with the slide at zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import UnknownName
from tau_dyn.mechanism.frames import (
    Carried,
    ChainJoint,
    JointFrame,
    combine_rotated,
    compute_cross_product,
    compute_joint_frames,
    compute_velocities,
    list_path,
)
from tau_dyn.mechanism.poses import rotate_by_vector
from tau_dyn.mechanism.small_systems import Elimination, Factor, solve_with_lapack
from tau_dyn.parameters import Parameter, Parameters

_TRUSTED = 1e-10  # relative residual of a solution by LU; worse ones are solved again by SVD


class Plate(NamedTuple):
    """Poses of the plate: positions (3, N) [m] and rotations (3, 3, N)."""

    position: np.ndarray
    rotation: np.ndarray

    def take(self, index: np.ndarray | slice) -> Plate:
        """Return some of the samples."""
        return Plate(self.position[:, index], self.rotation[:, :, index])

    def moved(self, twist: np.ndarray) -> Plate:
        """Return the poses after small displacements (6, N)."""
        return Plate(self.position + twist[:3], rotate_by_vector(twist[3:], self.rotation))


class Rows(NamedTuple):
    """The rods at a pose: `d` and `r x d`, each n times (3, N), and `f`, n times (N,)."""

    d: list[np.ndarray]
    moment: list[np.ndarray]
    f: list[np.ndarray]


def compute_equation_rows(points: np.ndarray, on_plate: np.ndarray, squares: np.ndarray, plate: Plate) -> Rows:
    """Return the rods' equations.

    Args:
        points: A (n, 3, N) [m].
        on_plate: B in the plate's frame (n, 3) [m].
        squares: Squared lengths (n, N or 1) [m^2].
        plate: Poses.
    """
    d, moment, f = [], [], []
    for k in range(len(on_plate)):
        r = combine_rotated(plate.rotation, on_plate[k])
        rod = points[k] - plate.position
        rod -= r
        d.append(rod)
        moment.append(compute_cross_product(r, rod))
        f.append(_half_square(rod, squares[k]))
    return Rows(d, moment, f)


def compute_residual(points: np.ndarray, on_plate: np.ndarray, squares: np.ndarray, plate: Plate) -> np.ndarray:
    """Return `f` (n, N) [m^2] alone."""
    out = np.empty((len(on_plate), plate.position.shape[1]))
    for k in range(len(on_plate)):
        rod = points[k] - plate.position
        rod -= combine_rotated(plate.rotation, on_plate[k])
        out[k] = _half_square(rod, squares[k])
    return out


def _half_square(rod: np.ndarray, square: np.ndarray) -> np.ndarray:
    total = rod[0] * rod[0]
    total += rod[1] * rod[1]
    total += rod[2] * rod[2]
    total -= square
    total *= 0.5
    return total


def build_dense(at: Rows) -> np.ndarray:
    """Return the matrices `[d, r x d]` (N, n, 6)."""
    return np.concatenate([np.stack(at.d), np.stack(at.moment)], axis=1).transpose(2, 0, 1)


class SixRods:
    """Solves `[d, r x d] x = b` of six rods by an elimination that suits the home pose."""

    def __init__(self, reference: np.ndarray) -> None:
        """Plan at a reference matrix (6, 6)."""
        pattern = {(k, c) for k in range(6) for c in range(6)}
        self._plan = Elimination.plan(pattern, reference) if np.linalg.cond(reference) < 1e8 else None

    def factor(self, at: Rows) -> Factor | None:
        """Return the factors, or None without a plan."""
        if self._plan is None:
            return None
        entries = {(k, c): (at.d[k][c] if c < 3 else at.moment[k][c - 3]) for k in range(6) for c in range(6)}
        return self._plan.factor(entries)

    def accurate(self, at: Rows, b: np.ndarray) -> np.ndarray:
        """Return the twists (6, ..., N), each sample checked for the residual of elimination."""
        factor = self.factor(at)
        if factor is None:
            return solve_with_lapack(build_dense(at), b)
        x = factor.solve(b)
        bad = np.flatnonzero(~(factor.residual(x, b) < _TRUSTED))
        if bad.size:
            x[..., bad] = solve_with_lapack(build_dense(take_samples(at, bad)), b[..., bad])
        return x


def take_samples(at: Rows, index: np.ndarray) -> Rows:
    """Return some of the samples."""
    return Rows([x[:, index] for x in at.d], [x[:, index] for x in at.moment], [x[index] for x in at.f])


AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False)
class RodDimensions:
    """A rod robot's geometry.

    Attributes:
        names: Names of the rods.
        joints: Actuated joints of the chains.
        carried: Points A.
        lengths: Lengths (n,) [m]; for a rod with a slide, at the slide's zero.
        on_plate: Points B in the plate's frame (n, 3) [m].
        slides: Actuator of the slide in each rod (n,), -1 without a slide.
        offsets: How far the slide's line misses A (n,) [m].
        gains: How much the slide lengthens the rod per reading of its drive (n,): 1, or -1 if it shortens it, times its scale.
        arms: Names of the arms of a simplified Gantry-Tau, in the rods' order, else empty.
    """

    names: tuple[str, ...]
    joints: tuple[ChainJoint, ...]
    carried: Carried
    lengths: np.ndarray
    on_plate: np.ndarray
    slides: np.ndarray
    offsets: np.ndarray
    gains: np.ndarray
    arms: tuple[str, ...] = ()


def build_parameters(numbers: RodDimensions) -> Parameters:
    """Return the geometry's parameters at these numbers."""
    rows: list[Parameter] = []
    if numbers.arms:
        for arm, length, carrier in zip(numbers.arms, numbers.lengths, numbers.carried.carrier, strict=True):
            joint = numbers.joints[carrier]
            rows += [Parameter(f"{arm}.length", float(length), "m"), *_vector(arm, "origin", joint.origin, "m")]
            rows += _vector(arm, "direction", joint.direction, "1")
        return Parameters(rows)
    for joint in numbers.joints:
        rows += _vector(joint.name, "origin", joint.origin, "m")
        rows += _vector(joint.name, "direction" if joint.slides else "axis", joint.direction, "1")
    for k, name in enumerate(numbers.names):
        rows += [Parameter(f"{name}.length", float(numbers.lengths[k]), "m")]
        rows += _vector(name, "base", numbers.carried.local[k], "m")
        rows += _vector(name, "plate", numbers.on_plate[k], "m")
    return Parameters(rows)


def replace_values(numbers: RodDimensions, parameters: Parameters) -> RodDimensions:
    """Return the geometry at other values of some or all of its parameters.

    Raises:
        UnknownName: A parameter that this geometry does not have.
    """
    known = build_parameters(numbers)
    for name in parameters.names:
        if name not in known:
            raise UnknownName("geometry parameter", name, known.names)
    return set_dimensions(numbers, {p.name: p.value for p in known} | {p.name: p.value for p in parameters})


def set_dimensions(numbers: RodDimensions, values: Mapping[str, float]) -> RodDimensions:
    """Return the geometry at values of all its parameters, by name."""

    def vector(owner: str, what: str) -> np.ndarray:
        return np.array([values[f"{owner}.{what}_{axis}"] for axis in AXES])

    if numbers.arms:
        joints = list(numbers.joints)
        for arm, carrier in zip(numbers.arms, numbers.carried.carrier, strict=True):
            joints[carrier] = joints[carrier]._replace(origin=vector(arm, "origin"), direction=vector(arm, "direction"))
        lengths = np.array([values[f"{arm}.length"] for arm in numbers.arms])
        return replace(numbers, joints=tuple(joints), lengths=lengths)
    return replace(
        numbers,
        joints=tuple(
            j._replace(origin=vector(j.name, "origin"), direction=vector(j.name, "direction" if j.slides else "axis"))
            for j in numbers.joints
        ),
        carried=Carried(numbers.carried.carrier, np.array([vector(n, "base") for n in numbers.names])),
        lengths=np.array([values[f"{n}.length"] for n in numbers.names]),
        on_plate=np.array([vector(n, "plate") for n in numbers.names]),
    )


def compute_gap_columns(
    numbers: RodDimensions,
    at: Sequence[JointFrame],
    q: np.ndarray,
    places: np.ndarray,
    unit: np.ndarray,
    plate_rotation: np.ndarray,
) -> dict[tuple[int, str], np.ndarray]:
    """Return the gaps' derivatives by the parameters: those of `(rod, parameter)` that are not zero, each (N,).

    Args:
        numbers: The geometry.
        at: Frames of its joints.
        q: Actuated positions (na, N).
        places: Points A (n, 3, N) [m].
        unit: Directions from B to A (n, 3, N).
        plate_rotation: Rotation of the plate (3, 3, N).
    """
    found: dict[tuple[int, str], np.ndarray] = {}
    for k, name in enumerate(numbers.names):
        carrier = numbers.carried.carrier[k]
        owner = numbers.arms[k] if numbers.arms else name
        found[k, f"{owner}.length"] = -_stretch(numbers, k, q)
        for index in list_path(numbers.joints, carrier):
            joint = numbers.joints[index]
            parent = at[joint.parent].rotation if joint.parent >= 0 else np.eye(3)[:, :, None]
            pushed = _into(parent, unit[k])
            owner = numbers.arms[k] if numbers.arms else joint.name
            _put(found, k, f"{owner}.origin", pushed)
            if joint.slides:
                _put(found, k, f"{owner}.direction", pushed * q[joint.actuator])
            else:
                _put(
                    found, k, f"{owner}.axis", _by_axis(joint, q[joint.actuator], pushed, places[k], at[index], parent)
                )
        if not numbers.arms:
            carried_by = at[carrier].rotation if carrier >= 0 else np.eye(3)[:, :, None]
            _put(found, k, f"{name}.base", _into(carried_by, unit[k]))
            _put(found, k, f"{name}.plate", -_into(plate_rotation, unit[k]))
    return found


def compute_leg_lengths(numbers: RodDimensions, q: np.ndarray) -> np.ndarray:
    """Return the rods' lengths (n, N or 1) [m] at `q` (na, N)."""
    if not np.any(numbers.slides >= 0):
        return numbers.lengths[:, None]
    out = np.repeat(numbers.lengths[:, None], q.shape[1], axis=1)
    for k in np.flatnonzero(numbers.slides >= 0).tolist():
        reach = _reach(numbers, k, q)
        out[k] = np.hypot(reach, numbers.offsets[k]) if numbers.offsets[k] else reach
    return out


def compute_squared_lengths(numbers: RodDimensions, q: np.ndarray) -> np.ndarray:
    """Return the rods' squared lengths (n, N or 1) [m^2] at `q` (na, N)."""
    if not np.any(numbers.slides >= 0):
        return numbers.lengths[:, None] ** 2
    out = np.zeros_like(q, shape=(len(numbers.names), q.shape[1]))
    out += numbers.lengths[:, None] ** 2
    for k in np.flatnonzero(numbers.slides >= 0).tolist():
        out[k] = _reach(numbers, k, q) ** 2 + numbers.offsets[k] ** 2
    return out


def compute_leg_rates(numbers: RodDimensions, q: np.ndarray) -> np.ndarray:
    """Return how fast each rod grows with its own slide (n, N or 1), zero for rods without one."""
    out = np.zeros((len(numbers.names), q.shape[1] if np.any(numbers.offsets) else 1))
    for k in np.flatnonzero(numbers.slides >= 0).tolist():
        out[k] = numbers.gains[k]
        if numbers.offsets[k]:
            reach = _reach(numbers, k, q)
            out[k] = numbers.gains[k] * reach / np.hypot(reach, numbers.offsets[k])
    return out


def compute_closure_by_q(
    numbers: RodDimensions, q: np.ndarray, points: np.ndarray, d: Sequence[np.ndarray] | np.ndarray
) -> np.ndarray:
    """Return the derivative of `(|d|^2 - L^2) / 2` by the positions, `d . dA/dq - L dL/dq` (n, na, N).

    Args:
        numbers: The geometry.
        q: Actuated positions (na, N).
        points: Points A (n, 3, N) [m].
        d: From B to A, n times (3, N) [m].
    """
    out = np.zeros_like(q, shape=(len(numbers.names), *q.shape))
    at = compute_joint_frames(numbers.joints, q)
    for (k, actuator), column in compute_velocities(numbers.joints, numbers.carried, at, points).items():
        out[k, actuator] += column[0] * d[k][0] + column[1] * d[k][1] + column[2] * d[k][2]
    for k in np.flatnonzero(numbers.slides >= 0).tolist():
        out[k, numbers.slides[k]] -= numbers.gains[k] * _reach(numbers, k, q)
    return out


def _along(numbers: RodDimensions, k: int) -> float:
    return float(np.sqrt(numbers.lengths[k] ** 2 - numbers.offsets[k] ** 2))


def _reach(numbers: RodDimensions, k: int, q: np.ndarray) -> np.ndarray:
    """Return the extent along the slide of a rod that contains a slide (N,) [m]."""
    return _along(numbers, k) + numbers.gains[k] * q[numbers.slides[k]]


def _stretch(numbers: RodDimensions, k: int, q: np.ndarray) -> np.ndarray:
    """Return the derivative (N,) of a rod's length by its length with the slide at zero."""
    if numbers.slides[k] < 0 or not numbers.offsets[k]:
        return np.ones(q.shape[1])
    reach = _reach(numbers, k, q)
    return reach / np.hypot(reach, numbers.offsets[k]) * numbers.lengths[k] / _along(numbers, k)


def _by_axis(
    joint: ChainJoint, q: np.ndarray, pushed: np.ndarray, place: np.ndarray, here: JointFrame, parent: np.ndarray
) -> np.ndarray:
    r"""Return the gap's derivative (3, N) by a turn's axis `d`: `u . (J_l(q d) q e_k x (A - o))`.

    `J_l` is the left Jacobian of the rotation group (Chirikjian 2012); all in the parent's frame.
    """
    arm = _into(parent, place - here.origin)
    torque = np.cross(arm, pushed, axis=0)  # u . (w x arm) = w . (arm x u)
    gain = float(np.linalg.norm(joint.direction))
    n = joint.direction / gain
    angle = gain * q
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.where(np.abs(angle) < 1e-4, 1 - angle**2 / 6, np.sin(angle) / angle)
        c = np.where(np.abs(angle) < 1e-4, angle / 2, (1 - np.cos(angle)) / angle)
    along = n @ torque
    # J_l' t = s t + (1 - s) n (n . t) - c n x t
    turned_back = s * torque + (1 - s) * np.outer(n, along).reshape(3, -1) - c * np.cross(n, torque, axisa=0, axisb=0).T
    return turned_back * q


def _into(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return `R' x` (3, N)."""
    if rotation.shape[2] == 1:
        return rotation[:, :, 0].T @ vector
    return np.einsum("ijn,in->jn", rotation, vector)


def _put(found: dict[tuple[int, str], np.ndarray], rod: int, stem: str, rows: np.ndarray) -> None:
    for axis, row in zip(AXES, rows, strict=True):
        found[rod, f"{stem}_{axis}"] = row


def _vector(owner: str, what: str, value: np.ndarray, unit: str) -> list[Parameter]:
    return [Parameter(f"{owner}.{what}_{axis}", float(x), unit) for axis, x in zip(AXES, value, strict=True)]
