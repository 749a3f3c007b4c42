r"""Laws of joints and carts, deviations from the encoder readings: a law adds a few parameters, zero in the nominal robot.

A `Law` of a joint changes its real position, `q_real = q + sum of e`:

- periodic errors of pinions, racks and resolvers, `e = s sin(2 pi q / T) + c cos(2 pi q / T)`;
- eccentricity of an encoder disc, `e = s sin q + c cos q`;
- coupling, `e = k q_other`: another joint's drive turns this joint too;
- compliance of drives is in `elastic_drives.py`.

A law of a guideway displaces the rod ends that its slide carries, `A = A_0 + d(q)`, in base axes. Laws depend only on `q`, so
that forward kinematics remains a function of `q`; a load-dependent law takes its loads from the nominal robot, whose geometry
errors change them by parts in a thousand. References: thesis 4.2, 5.3, figures 4.3, 5.2; Whitney, Lozinski & Rourke 1986.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.laws.displaced_geometry import MovedJoints
from tau_dyn.mechanism import AXES, Rods, list_path
from tau_dyn.parameters import Parameter, Parameters

_COUPLING_STDERR = 0.1
"""Share of another joint's motion that may be coupled in, one standard deviation."""
Loads = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""`q` (N, na) and loads at the tool (N, 7) -> force of the rods on each actuated slide (N, na, 3) [N], in base axes."""


class Shift(NamedTuple):
    """A displacement (N, d) [m or rad], its slope by all positions (N, d, na) and by the law's parameters (N, d, p).

    `d` is 1 of a joint's own position, 3 of rod ends.
    """

    value: np.ndarray
    by_position: np.ndarray
    by_parameter: np.ndarray


class Law(Protocol):
    """A displacement of one joint's position, or of rod ends that its link carries."""

    @property
    def actuator(self) -> int:
        """Index of the joint in `q`."""
        ...

    @property
    def rods(self) -> tuple[int, ...]:
        """Rods whose ends are displaced; empty if the joint's own position is displaced."""
        ...

    @property
    def parameters(self) -> Parameters:
        """Its parameters, at their nominal values."""
        ...

    def shift(self, values: np.ndarray, q: np.ndarray) -> Shift:
        """Return the displacement at `q` (N, na)."""
        ...


class Displaced(NamedTuple):
    """Real positions of joints and rod ends.

    Attributes:
        real: Positions (N, na).
        by_encoder: Their derivative by the encoder readings (N, na, na).
        ends: Displacements of rod ends (N, rods, 3) [m].
        ends_by_encoder: Their derivative (N, rods, 3, na).
        columns: Each law and the derivative of its displacement by its parameters (N, d, p).
    """

    real: np.ndarray
    by_encoder: np.ndarray
    ends: np.ndarray
    ends_by_encoder: np.ndarray
    columns: tuple[tuple[Law, np.ndarray], ...]


def displace(laws: Sequence[Law], values: Sequence[np.ndarray], q: np.ndarray, n_rods: int = 0) -> Displaced:
    """Return the real positions of joints and rod ends at encoder readings `q` (N, na), each law at its values."""
    real, by_encoder, columns = np.array(q, float), np.tile(np.eye(q.shape[1]), (len(q), 1, 1)), []
    ends, ends_by_encoder = np.zeros((len(q), n_rods, 3)), np.zeros((len(q), n_rods, 3, q.shape[1]))
    for law, own in zip(laws, values, strict=True):
        shift = law.shift(own, q)
        if law.rods:
            ends[:, law.rods] += shift.value[:, None]
            ends_by_encoder[:, law.rods] += shift.by_position[:, None]
        else:
            real[:, law.actuator] += shift.value[:, 0]
            by_encoder[:, law.actuator] += shift.by_position[:, 0]
        columns.append((law, shift.by_parameter))
    return Displaced(real, by_encoder, ends, ends_by_encoder, tuple(columns))


@dataclass(frozen=True, eq=False)
class EncoderLaws:
    """Laws of joints' own positions, as `JointDisplacement`.

    Attributes:
        laws: The laws.
    """

    laws: tuple[Law, ...]

    beyond_file = Geometry.beyond_file

    @property
    def parameters(self) -> Parameters:
        """The laws' parameters."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        return Parameters([p for law in self.laws for p in law.parameters])

    @property
    def known_beforehand(self) -> np.ndarray:
        """None of the parameters (p,)."""
        return np.zeros(len(self.parameters), bool)

    def move(self, values: np.ndarray, q: np.ndarray, loads: np.ndarray | None) -> MovedJoints:
        """Return the real joint positions at encoder readings (N, na)."""
        moved = displace(self.laws, np.split(values, np.cumsum([len(law.parameters) for law in self.laws])[:-1]), q)
        columns = np.zeros((*q.shape, len(self.parameters)))
        first = 0
        for law, own in moved.columns:
            last = first + own.shape[2]
            columns[:, law.actuator, first:last], first = own[:, 0], last
        return MovedJoints(moved.real, columns, lambda: moved.by_encoder)

    def list_springs(self, values: np.ndarray) -> dict[str, tuple[str, float]]:
        """Return no springs."""
        return {}


def _by_joint(q: np.ndarray, joint: int, slope: np.ndarray) -> np.ndarray:
    """Return a slope (N, d) by one joint as one by all (N, d, na)."""
    out = np.zeros((*slope.shape, q.shape[1]))
    out[:, :, joint] = slope
    return out


class _JointLaw:
    """A law of a joint's own position."""

    @property
    def rods(self) -> tuple[int, ...]:
        """No rod ends."""
        return ()


@dataclass(frozen=True, eq=False)
class PeriodicDriveLaw(_JointLaw):
    """A periodic drive error: `e = error_sin sin(2 pi q / error_period) + error_cos cos(..)`, pinions, racks, resolvers.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        period: Starting value [m or rad].
        label: Label of a second wave of the same joint, such as `2`.
        unit: Unit of the joint.
    """

    joint: str
    actuator: int
    period: float
    label: str = ""
    unit: str = "m"

    @property
    def parameters(self) -> Parameters:
        """Two amplitudes and the period."""
        rows = (("sin", 0.0), ("cos", 0.0), ("period", self.period))
        return Parameters(
            Parameter(f"{self.joint}.error{self.label}_{x}", value, self.unit, origin="law") for x, value in rows
        )

    def shift(self, values: np.ndarray, q: np.ndarray) -> Shift:
        """Return the error."""
        a, b, period = values
        x = q[:, [self.actuator]]
        w = 2 * np.pi / period
        s, c = np.sin(w * x), np.cos(w * x)
        slope = w * (a * c - b * s)
        return Shift(a * s + b * c, _by_joint(q, self.actuator, slope), np.stack([s, c, -slope * x / period], axis=2))


class _LinearLaw(ABC):
    """A law `columns(q) @ values`."""

    @abstractmethod
    def columns(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return displacements per parameter (N, d, p), their slopes by one joint (N, d, p), and which joint that is."""

    def shift(self, values: np.ndarray, q: np.ndarray) -> Shift:
        """Return the displacement."""
        columns, slopes, joint = self.columns(q)
        return Shift(columns @ values, _by_joint(q, joint, slopes @ values), columns)


@dataclass(frozen=True)
class EccentricityLaw(_LinearLaw, _JointLaw):
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

    def columns(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return sine and cosine."""
        s, c = np.sin(q[:, [self.actuator]]), np.cos(q[:, [self.actuator]])
        return np.stack([s, c], axis=2), np.stack([c, -s], axis=2), self.actuator


@dataclass(frozen=True)
class CouplingLaw(_LinearLaw, _JointLaw):
    """Motion that another joint's drive passes on, by a gear train in the arm or an encoder against the ground.

    Attributes:
        joint: Joint name.
        actuator: Its index.
        other: Name of the joint that moves it too.
        source: That joint's index.
        ratio: Nominal share: 0, or 1 or -1 if all of the other joint's motion is added.
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

    def columns(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the other joint's position."""
        return q[:, self.source, None, None], np.ones((len(q), 1, 1)), self.source


@dataclass(frozen=True, eq=False)
class GuideBendLaw:
    """A crooked guideway: displacement linear between knots along it, zero at the first and the last one.

    Attributes:
        joint: Slide's name.
        actuator: Its index.
        rods: Rods it carries.
        knots: Positions along the guideway (k,) [m].
        base: Displacements that are known beforehand (k, 3) [m], from a measured guideway; the parameters are added to them.
    """

    joint: str
    actuator: int
    rods: tuple[int, ...]
    knots: np.ndarray
    base: np.ndarray | None = None

    @property
    def parameters(self) -> Parameters:
        """Three displacements for every inner knot."""
        inner = range(1, len(self.knots) - 1)
        return Parameters(Parameter(f"{self.joint}.bend_{k}_{a}", 0.0, "m", origin="law") for k in inner for a in AXES)

    def shift(self, values: np.ndarray, q: np.ndarray) -> Shift:
        """Return the displacements."""
        x, knots = q[:, self.actuator], self.knots
        k = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
        width = knots[k + 1] - knots[k]
        share = np.clip((x - knots[k]) / width, 0.0, 1.0)
        inside = ((x >= knots[0]) & (x <= knots[-1])).astype(float)
        hat, slope = np.zeros((len(x), len(knots))), np.zeros((len(x), len(knots)))
        row = np.arange(len(x))
        hat[row, k], hat[row, k + 1] = 1 - share, share
        slope[row, k], slope[row, k + 1] = -inside / width, inside / width
        at = np.zeros((len(knots), 3)) if self.base is None else np.array(self.base, float)
        at[1:-1] += values.reshape(-1, 3)
        columns = np.einsum("nk,ab->nakb", hat[:, 1:-1], np.eye(3)).reshape(len(x), 3, -1)
        return Shift(hat @ at, _by_joint(q, self.actuator, slope @ at), columns)


@dataclass(frozen=True, eq=False)
class RodPathLaw(_LinearLaw):
    """A rod's own path: its end leaves the cart's line by `drift` per metre of travel, as on a cart that turns while it travels.

    Attributes:
        rod: Name of the rod.
        rods: Its index alone.
        actuator: Index of the slide.
    """

    rod: str
    rods: tuple[int, ...]
    actuator: int

    @property
    def parameters(self) -> Parameters:
        """Three drifts."""
        return Parameters(Parameter(f"{self.rod}.drift_{a}", 0.0, "1", origin="law") for a in AXES)

    def columns(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the travel along each axis."""
        one = np.broadcast_to(np.eye(3), (len(q), 3, 3))
        return q[:, self.actuator, None, None] * one, one, self.actuator


@dataclass(frozen=True, eq=False)
class CartComplianceLaw(_LinearLaw):
    """A cart that is elastic under its rods' pull: `d = guideway_compliance F` across its guideway.

    Attributes:
        joint: Slide's name.
        actuator: Its index.
        rods: Rods it carries.
        direction: Unit vector of the guideway (3,).
        loads: The rods' pull.
        at_tool: Loads at the tool (N, 7), None without loads.
    """

    joint: str
    actuator: int
    rods: tuple[int, ...]
    direction: np.ndarray
    loads: Loads
    at_tool: np.ndarray | None = None

    @property
    def parameters(self) -> Parameters:
        """One compliance."""
        return Parameters([Parameter(f"{self.joint}.guideway_compliance", 0.0, "m/N", origin="law")])

    def columns(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the pull across the guideway, taken as constant near `q`."""
        force = self.loads(q, self.at_tool)[:, self.actuator]
        across = (force - (force @ self.direction)[:, None] * self.direction)[:, :, None]
        return across, np.zeros_like(across), self.actuator


def find_carried_rods(rods: Rods, actuator: int) -> tuple[int, ...]:
    """Return the rods that hang on a joint, directly or through others."""
    joints, carrier = rods.numbers.joints, rods.numbers.carried.carrier
    return tuple(k for k, c in enumerate(carrier) if any(joints[j].actuator == actuator for j in list_path(joints, c)))


def find_guideways(rods: Rods) -> tuple[int, ...]:
    """Return the indices in `q` of slides that are mounted on the base and carry rods."""
    return tuple(j.actuator for j in rods.numbers.joints if j.slides and j.parent < 0)
