"""Unknowns of a fit through the loop: values kind by kind and joint by joint, bounds, and the inertial directions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.servo.loads import InertialSpace
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw

JOINT_UNITS = {"armature": "kg m^2", "coulomb": "N m", "viscous": "N m s/rad", "offset": "N m"}
"""Parameters of a joint in addition to its servo's law, with units."""

FRICTION = ("coulomb", "viscous", "offset", "load_friction", "stiction")
"""Friction parameters of a joint that are estimated unless the model is rigid."""

LOWEST = {
    "offset": -np.inf,
    "position_gain": 1e-3,
    "speed_gain": 1e-4,
    "force_per_unit": 1e-4,
    "limit": 1e-4,
    "stiction_speed": 1e-3,
    "armature": 1e-7,
    "command_delay": -0.02,
    "drive_exponent": 0.2,
    "acceleration_limit": 1.0,
    "speed_limit": 0.05,
}
"""Lower bounds of kinds; zero for the others. A negative delay is a position that is read after its time stamp."""

HIGHEST = {
    "load_friction": 0.95,
    "carried_friction": 0.95,
    "command_delay": 0.2,
    "supply_sag": 0.95,
    "dead_band": 0.2,
    "drive_exponent": 2.0,
    "braking": 1.0,
    "torque_delay": 0.1,
    "backlash": 0.2,
    "acceleration_limit": 1000.0,
    "speed_limit": 50.0,
}
"""Upper bounds of kinds [1, s, rad]: friction that grows as fast as the torque would stop every motion; limits of goal profiles
that hardly change a goal between two commands."""

LIMITS = ("acceleration_limit", "speed_limit")
"""Kinds that act by their inverse: without a limit they are infinite."""


@dataclass(frozen=True, eq=False)
class LoopUnknowns:
    """Unknowns of a fit, kind by kind and joint by joint, and the inertial directions.

    Attributes:
        values: Value of every kind and law entry (na,), including fixed ones.
        kinds: Kinds that are free for at least one joint.
        free: Whether each kind is free at each joint (nk, na).
        lower: Lower bounds (nk, na).
        upper: Upper bounds (nk, na).
        prior: Standard deviations of prior knowledge about the start values (nk, na); infinite without prior knowledge.
        space: Inertial numbers.
    """

    values: Mapping[str, np.ndarray]
    kinds: tuple[str, ...]
    free: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    prior: np.ndarray
    space: InertialSpace

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return int(self.free.sum()) + self.space.n_unknowns

    @property
    def is_flexible(self) -> bool:
        """Whether a joint's compliance is an unknown."""
        return "joint_compliance" in self.kinds and bool(self.free[self.kinds.index("joint_compliance")].any())

    @property
    def joint_of(self) -> np.ndarray:
        """Joint of each unknown (n,); -1 for the inertial ones."""
        return np.append(np.nonzero(self.free)[1], np.full(self.space.n_unknowns, -1))

    def pack(self) -> np.ndarray:
        """Return the start (n,)."""
        first = np.array([self.values[kind] for kind in self.kinds]).reshape(self.free.shape)[self.free]
        return np.append(first, np.zeros(self.space.n_unknowns))

    def unpack(self, x: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return values by kind (na, C) and inertial unknowns (K, C) of vectors (n, C)."""
        m, c = int(self.free.sum()), x.shape[1]
        table = np.repeat(
            np.array([self.values[k] for k in self.kinds]).reshape(self.free.shape)[:, :, None], c, axis=2
        )
        table[self.free] = x[:m]
        values = {key: np.repeat(value[:, None], c, axis=1) for key, value in self.values.items()}
        return values | dict(zip(self.kinds, table, strict=True)), x[m:]

    def clip(self, x: np.ndarray) -> np.ndarray:
        """Return a vector (n,) within the bounds."""
        m = int(self.free.sum())
        inside = np.clip(x[:m], self.lower[self.free], self.upper[self.free])
        return np.append(inside, np.clip(x[m:], -5.0, 5.0))

    def with_values(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return every value by kind (na,) at a vector (n,)."""
        return {key: value[:, 0] for key, value in self.unpack(x[:, None])[0].items()}


def build_unknowns(
    law: ServoLaw,
    space: InertialSpace,
    start: Mapping[str, np.ndarray],
    kinds: Sequence[str],
    held: Mapping[str, np.ndarray] | None = None,
) -> LoopUnknowns:
    """Return unknowns of some kinds for all joints, at start values.

    Args:
        law: The law, for the values of its entries.
        space: Inertial numbers.
        start: Values by kind (na,) that replace the law's and the zeros of the rest.
        kinds: The free kinds.
        held: Kinds -> joints (na,) at which the kind is fixed.
    """
    na = len(law.joints)
    values = {**law.values, **{key: np.zeros(na) for key in JOINT_UNITS}, **start}
    values = {key: np.array(value, float) for key, value in values.items()}
    shape = (len(kinds), na)
    lower = np.array([np.full(na, LOWEST.get(k, 0.0)) for k in kinds]).reshape(shape)
    upper = np.array([np.full(na, HIGHEST.get(k, np.inf)) for k in kinds]).reshape(shape)
    free = np.array([~np.asarray((held or {}).get(k, np.zeros(na, bool)), bool) for k in kinds]).reshape(shape)
    return LoopUnknowns(values, tuple(kinds), free, lower, upper, np.full(shape, np.inf), space)


def compute_stiffness(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return each loop's torque per unit of position error (na,) [N m/rad], the measure of small changes of torque."""
    inner = np.where(values["speed_gain"] > 0, values["speed_gain"], 1.0)
    return values["position_gain"] * inner * values["force_per_unit"]


def measure_change(kind: str, value: np.ndarray, null: np.ndarray, stderr: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of values from their null, and their standard errors; for limits, the inverses are compared."""
    if kind not in LIMITS:
        return np.abs(value - null), stderr
    return np.abs(1 / value - 1 / null), stderr / np.square(value)


def get_unit(kind: str) -> str:
    """Return the unit of a kind."""
    return JOINT_UNITS[kind] if kind in JOINT_UNITS else SERVO_ENTRIES[kind].unit
