r"""What joints and carts do beside moving as their encoders say: a law is a few more parameters, zero in the nominal robot.

A `JointLaw` changes the position that a joint really has, `q_real = q + sum of e`:

- periodic errors of pinions, racks and resolvers, `e = s sin(2 pi q / T) + c cos(2 pi q / T)`;
- eccentricity of an encoder disc, `e = s sin q + c cos q`;
- coupling, `e = k q_other`: another joint's drive turns this one along;
- compliance of a drive, `e = c F . n`, `F` the rods' pull; what an arm's joints yield to gravity stands in `gravity.py`.

A `GuideLaw` displaces all rod ends that a slide carries, `A = A_0 + d(q)`, in base axes. Laws are given `q` alone, so that
forward kinematics stays a function of `q`; a load-dependent law takes its loads from the nominal robot, whose errors change them
by parts in a thousand. References: thesis 4.2, 5.3, figures 4.3, 5.2; Whitney, Lozinski & Rourke 1986.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from tau_dyn.mechanism import Rods, list_path
from tau_dyn.parameters import Parameter, Parameters

AXES = ("x", "y", "z")
_COUPLING_STDERR = 0.1
"""Share of another joint's motion that may be coupled in, one standard deviation."""
Loads = Callable[[np.ndarray], np.ndarray]
"""`q` (N, na) -> force of the rods on each actuated slide (N, na, 3) [N], in base axes."""


class JointShift(NamedTuple):
    """A joint's error (N,), its slope by all positions (N, na) and by the law's parameters (N, p)."""

    error: np.ndarray
    slope: np.ndarray
    columns: np.ndarray


class GuideShift(NamedTuple):
    """Displacements (N, rods, 3) [m] of rods' ends, their slope by the slide's `q` and by parameters (N, rods, 3, p)."""

    shift: np.ndarray
    slope: np.ndarray
    columns: np.ndarray


class JointLaw(Protocol):
    """An error of one joint's position."""

    @property
    def actuator(self) -> int:
        """Index of the joint in `q`."""
        ...

    @property
    def parameters(self) -> Parameters:
        """Its parameters, at their nominal values."""
        ...

    def shift(self, values: np.ndarray, q: np.ndarray) -> JointShift:
        """Return the error at `q` (N, na)."""
        ...


class GuideLaw(Protocol):
    """A displacement of the rod ends that one slide carries."""

    @property
    def actuator(self) -> int:
        """Index of the slide in `q`."""
        ...

    @property
    def parameters(self) -> Parameters:
        """Its parameters, at their nominal values."""
        ...

    def displace(self, values: np.ndarray, q: np.ndarray) -> GuideShift:
        """Return the displacements at `q` (N, na)."""
        ...


class MovedJoints(NamedTuple):
    """Where joints really are.

    Attributes:
        real: Positions (N, na).
        by_encoder: Their derivative by what the encoders say (N, na, na).
        columns: Each law's joint, and the derivative of its position by the law's parameters (N, p).
    """

    real: np.ndarray
    by_encoder: np.ndarray
    columns: tuple[tuple[int, np.ndarray], ...]


def move_joints(laws: Sequence[JointLaw], values: Sequence[np.ndarray], q: np.ndarray) -> MovedJoints:
    """Return where joints really are when their encoders say `q` (N, na), each law at its values."""
    real, by_encoder, columns = np.array(q, float), np.tile(np.eye(q.shape[1]), (len(q), 1, 1)), []
    for law, own in zip(laws, values, strict=True):
        shift = law.shift(own, q)
        real[:, law.actuator] += shift.error
        by_encoder[:, law.actuator] += shift.slope
        columns.append((law.actuator, shift.columns))
    return MovedJoints(real, by_encoder, tuple(columns))


@dataclass(frozen=True, eq=False)
class PeriodicDriveLaw:
    """A periodic drive error: `e = error_sin sin(2 pi q / error_period) + error_cos cos(..)`, pinions, racks, resolvers.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        period: Starting value [m or rad].
        label: What tells a second wave of the same joint apart, such as `2`.
        unit: Of the joint.
    """

    joint: str
    actuator: int
    period: float
    label: str = ""
    unit: str = "m"

    @property
    def parameters(self) -> Parameters:
        """Two amplitudes and the period."""
        n, u, k = self.joint, self.unit, self.label
        return Parameters(
            [
                Parameter(f"{n}.error{k}_sin", 0.0, u, origin="law"),
                Parameter(f"{n}.error{k}_cos", 0.0, u, origin="law"),
                Parameter(f"{n}.error{k}_period", self.period, u, origin="law"),
            ]
        )

    def shift(self, values: np.ndarray, q: np.ndarray) -> JointShift:
        """Return the error."""
        a, b, period = values
        x = q[:, self.actuator]
        w = 2 * np.pi / period
        s, c = np.sin(w * x), np.cos(w * x)
        slope = w * (a * c - b * s)
        return JointShift(a * s + b * c, _by_own(q, self.actuator, slope), np.column_stack([s, c, -slope * x / period]))


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

    def shift(self, values: np.ndarray, q: np.ndarray) -> JointShift:
        """Return the error."""
        x = q[:, self.actuator]
        columns, slope = np.column_stack([np.sin(x), np.cos(x)]), np.column_stack([np.cos(x), -np.sin(x)]) @ values
        return JointShift(columns @ values, _by_own(q, self.actuator, slope), columns)


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

    def shift(self, values: np.ndarray, q: np.ndarray) -> JointShift:
        """Return the error."""
        other = q[:, self.source]
        return JointShift(values[0] * other, _by_own(q, self.source, np.full(len(q), values[0])), other[:, None])


@dataclass(frozen=True, eq=False)
class DriveComplianceLaw:
    """A drive that yields to its rods' pull: `e = drive_compliance F . n` along its guideway.

    Attributes:
        joint: Slide's name.
        actuator: Its index.
        direction: Unit vector of the guideway (3,).
        loads: The rods' pull.
    """

    joint: str
    actuator: int
    direction: np.ndarray
    loads: Loads

    @property
    def parameters(self) -> Parameters:
        """One compliance."""
        return Parameters([Parameter(f"{self.joint}.drive_compliance", 0.0, "m/N", origin="law")])

    def shift(self, values: np.ndarray, q: np.ndarray) -> JointShift:
        """Return the error."""
        along = self.loads(q)[:, self.actuator] @ self.direction
        return JointShift(values[0] * along, np.zeros(q.shape), along[:, None])


@dataclass(frozen=True, eq=False)
class GuideBendLaw:
    """A crooked guideway: displacement linear between knots along it, zero at the first and the last one.

    Attributes:
        joint: Slide's name.
        actuator: Its index.
        rods: Rods it carries.
        n_rods: Number of all rods.
        knots: Positions along the guideway (k,) [m].
        base: Displacements that are known beforehand (k, 3) [m], from a measured guideway; the parameters come on top.
    """

    joint: str
    actuator: int
    rods: tuple[int, ...]
    n_rods: int
    knots: np.ndarray
    base: np.ndarray | None = None

    @property
    def parameters(self) -> Parameters:
        """Three displacements for every inner knot."""
        inner = range(1, len(self.knots) - 1)
        return Parameters(Parameter(f"{self.joint}.bend_{k}_{a}", 0.0, "m", origin="law") for k in inner for a in AXES)

    def displace(self, values: np.ndarray, q: np.ndarray) -> GuideShift:
        """Return the displacements."""
        x, knots = q[:, self.actuator], self.knots
        k = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
        width = knots[k + 1] - knots[k]
        share = np.clip((x - knots[k]) / width, 0.0, 1.0)
        inside = ((x >= knots[0]) & (x <= knots[-1])).astype(float)
        hat, by_q = np.zeros((len(x), len(knots))), np.zeros((len(x), len(knots)))
        row = np.arange(len(x))
        hat[row, k], hat[row, k + 1] = 1 - share, share
        by_q[row, k], by_q[row, k + 1] = -inside / width, inside / width
        at = np.zeros((len(knots), 3))
        at[1:-1] = values.reshape(-1, 3)
        if self.base is not None:
            at = at + self.base
        columns = np.einsum("nk,ab->nakb", hat[:, 1:-1], np.eye(3)).reshape(len(x), 3, -1)
        return _on_rods(hat @ at, by_q @ at, columns, self.rods, self.n_rods)


@dataclass(frozen=True, eq=False)
class RodPathLaw:
    """A rod's own path: its end leaves the cart's line by `drift` per metre of travel, as on a cart that turns while it travels.

    Attributes:
        rod: Name of the rod.
        index: Its index.
        actuator: Index of the slide.
        n_rods: Number of all rods.
    """

    rod: str
    index: int
    actuator: int
    n_rods: int

    @property
    def parameters(self) -> Parameters:
        """Three drifts."""
        return Parameters(Parameter(f"{self.rod}.drift_{a}", 0.0, "1", origin="law") for a in AXES)

    def displace(self, values: np.ndarray, q: np.ndarray) -> GuideShift:
        """Return the displacements."""
        x = q[:, self.actuator]
        columns = x[:, None, None] * np.eye(3)
        slope = np.broadcast_to(values, (len(x), 3))
        return _on_rods(x[:, None] * values, slope, columns, (self.index,), self.n_rods)


@dataclass(frozen=True, eq=False)
class CartComplianceLaw:
    """A cart that yields to its rods' pull: `d = guideway_compliance F` across its guideway.

    Attributes:
        joint: Slide's name.
        actuator: Its index.
        rods: Rods it carries.
        n_rods: Number of all rods.
        direction: Unit vector of the guideway (3,).
        loads: The rods' pull.
    """

    joint: str
    actuator: int
    rods: tuple[int, ...]
    n_rods: int
    direction: np.ndarray
    loads: Loads

    @property
    def parameters(self) -> Parameters:
        """One compliance."""
        return Parameters([Parameter(f"{self.joint}.guideway_compliance", 0.0, "m/N", origin="law")])

    def displace(self, values: np.ndarray, q: np.ndarray) -> GuideShift:
        """Return the displacements."""
        force = self.loads(q)[:, self.actuator]
        across = force - (force @ self.direction)[:, None] * self.direction
        return _on_rods(values[0] * across, np.zeros_like(across), across[:, :, None], self.rods, self.n_rods)


def find_carried_rods(rods: Rods, actuator: int) -> tuple[int, ...]:
    """Return the rods that hang on a joint, directly or through others."""
    joints, carrier = rods.numbers.joints, rods.numbers.carried.carrier
    return tuple(k for k, c in enumerate(carrier) if any(joints[j].actuator == actuator for j in list_path(joints, c)))


def find_guideways(rods: Rods) -> tuple[int, ...]:
    """Return the indices in `q` of slides that stand on the base and carry rods."""
    return tuple(j.actuator for j in rods.numbers.joints if j.slides and j.parent < 0)


def _on_rods(shift: np.ndarray, slope: np.ndarray, columns: np.ndarray, rods: Sequence[int], n_rods: int) -> GuideShift:
    out = np.zeros((len(shift), n_rods, 3))
    by_q = np.zeros((len(shift), n_rods, 3))
    by = np.zeros((len(shift), n_rods, 3, columns.shape[2]))
    for k in rods:
        out[:, k], by_q[:, k], by[:, k] = shift, slope, columns
    return GuideShift(out, by_q, by)


def _by_own(q: np.ndarray, joint: int, slope: np.ndarray) -> np.ndarray:
    """Return a slope (N,) by one joint as one by all (N, na)."""
    out = np.zeros(q.shape)
    out[:, joint] = slope
    return out
