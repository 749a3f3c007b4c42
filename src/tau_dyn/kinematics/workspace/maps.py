"""What a map shows and what a catalogue says: condition, distance to singularity, stiffness, worst speed and force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.kinematics.dexterity import (
    Rates,
    Softest,
    Springs,
    combine_in_series,
    compute_compliance,
    compute_dexterity,
    compute_worst_force,
    compute_worst_speed,
    find_softest,
)
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machine import WorkspaceModel
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.mechanism import Poses
from tau_dyn.robot import Robot

JOINT_STIFFNESS = 115e6
"""Stiffness of one ball joint [N/m]: the full-size Gantry-Tau prototypes' (thesis 2.3, 115 kN/mm)."""


class Quantity(NamedTuple):
    """What a map shows: its words and unit."""

    words: str
    unit: str


QUANTITIES: dict[str, Quantity] = {
    "condition": Quantity("condition number", "1"),
    "manipulability": Quantity("manipulability", "1"),
    "singularity": Quantity("distance to singularity", "1"),
    "stiffness": Quantity("stiffness, softest direction", "N/m"),
    "speed": Quantity("speed in every direction", "m/s"),
    "force": Quantity("force in every direction", "N"),
}


@dataclass(frozen=True, eq=False)
class Elasticity:
    """The springs of a robot and where their numbers come from.

    Attributes:
        springs: Stiffnesses, or None where nothing is known.
        origin: A sentence on where they come from.
        assumed: Whether something was assumed.
    """

    springs: Springs | None
    origin: str
    assumed: bool


def build_elasticity(
    machine: WorkspaceModel, rod: float | None = None, actuators: Mapping[str, float] | None = None
) -> Elasticity:
    """Return a robot's springs.

    Args:
        machine: The robot.
        rod: Stiffness of each rod with its joints [N/m]; by default the file's `<rod>_stretch` springs, else two ball joints.
        actuators: Stiffness by joint name, or '' for all [N/m or N m/rad]; by default rigid.

    Raises:
        UnknownName: A joint that is not actuated.
        InputError: A stiffness that is not above zero, or a rod's where there are no rods.
    """
    robot, rods = machine.robot, machine.rods
    drives = _drives(robot, actuators or {})
    if rod is not None and not rod > 0:
        raise InputError("invalid_value", f"a rod's stiffness must be above zero, not {rod}")
    if rods is None:
        if rod is not None:
            raise InputError("unsupported", f"{robot.source} has no rods; give --actuator-stiffness")
        known = bool(np.isfinite(drives).any())
        origin = "actuators as given, links rigid" if known else "no stiffness is known: give the actuators'"
        return Elasticity(Springs(np.full(6, np.inf), drives) if known else None, origin, False)
    given = {s.joint: s.stiffness for s in robot.springs}
    values = np.array([given.get(f"{name}_stretch", np.nan) for name in rods.names])
    rest = "actuators rigid" if np.isinf(drives).all() else "actuators as given"
    if rod is not None:
        return Elasticity(Springs(np.full(rods.n, float(rod)), drives), f"rods as given, {rest}", False)
    if np.isfinite(values).all():
        others = [s.joint for s in robot.springs if not s.joint.endswith("_stretch")]
        rest += f"; the file's springs on {', '.join(others[:6])} left out" if others else ""
        return Elasticity(Springs(values, drives), f"rods as the robot file, {rest}", False)
    two = combine_in_series(JOINT_STIFFNESS, JOINT_STIFFNESS)
    return Elasticity(
        Springs(np.full(rods.n, two), drives),
        f"each rod assumed as two ball joints of 115 kN/mm in series, its tube and the frame rigid, {rest}",
        True,
    )


def _drives(robot: Robot, given: Mapping[str, float]) -> np.ndarray:
    drives = np.full(robot.na, np.inf)
    for name, value in given.items():
        if not value > 0:
            raise InputError(
                "invalid_value", f"the stiffness of actuator '{name or 'all'}' must be above zero, not {value}"
            )
        if name and name not in robot.actuated:
            raise UnknownName("actuated joint", name, robot.actuated)
        drives[[robot.actuated.index(name)] if name else slice(None)] = value
    return drives


@dataclass(frozen=True, eq=False)
class Quality:
    """Evaluates maps of one robot.

    Attributes:
        machine: The robot.
        elasticity: Its springs.
    """

    machine: WorkspaceModel
    elasticity: Elasticity

    def available(self) -> list[str]:
        """Return the names of the quantities that this robot has."""
        robot = self.machine.robot
        missing = {
            "stiffness": self.elasticity.springs is None,
            "speed": not np.isfinite(robot.velocity_limit).all(),
            "force": not np.isfinite(robot.effort_limit).all(),
        }
        return [name for name in QUANTITIES if not missing.get(name, False)]

    def values(self, names: list[str], q: np.ndarray, poses: Poses) -> dict[str, np.ndarray]:
        """Return quantities by name, each (N,) in SI.

        Raises:
            UnknownName: A quantity that does not exist, or that this robot lacks.
        """
        there = self.available()
        for name in names:
            if name not in there:
                raise UnknownName("map of this robot", name, there)
        if not len(q):
            return {name: np.zeros(0) for name in names}
        rates = self.machine.rates(q, poses)
        return {name: value for name, value in self._all(rates, names)}

    def _all(self, rates: Rates, names: list[str]):
        robot, found = self.machine.robot, compute_dexterity(rates)
        for name in names:
            if name == "stiffness":
                yield name, self.softest(rates).stiffness[:, 0]
            elif name == "speed":
                yield name, compute_worst_speed(rates, robot.velocity_limit)
            elif name == "force":
                yield name, compute_worst_force(rates, robot.effort_limit)
            else:
                yield name, getattr(found, name)

    def softest(self, rates: Rates) -> Softest:
        """Return main stiffnesses and directions at the poses of these rates."""
        if self.elasticity.springs is None:
            raise InputError("unsupported", f"{self.machine.robot.source}: {self.elasticity.origin}")
        C = compute_compliance(rates, self.elasticity.springs)
        linear = min(rates.linear, C.shape[1])
        if linear < 3:  # a planar arm: what does not move is rigid
            wide = np.zeros((len(C), 3, 3))
            wide[:, :linear, :linear] = C[:, :linear, :linear]
            C = wide
        return find_softest(C)


class Statistics(NamedTuple):
    """Least, middle and largest of finite values."""

    least: float
    median: float
    largest: float


def compute_statistics(values: np.ndarray) -> Statistics:
    """Return least, median and largest of the finite values; nan where there are none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return Statistics(np.nan, np.nan, np.nan)
    return Statistics(float(values.min()), float(np.median(values)), float(values.max()))


def build_catalogue_row(name: str, found: Statistics) -> dict[str, Any]:
    """Return a line of the catalogue."""
    quantity = QUANTITIES[name]
    return {
        "map": name,
        "what": quantity.words,
        "unit": quantity.unit,
        "min": found.least,
        "median": found.median,
        "max": found.largest,
    }


class Catalogue(NamedTuple):
    """Figures of a robot.

    Attributes:
        rows: By quantity: statistics over the workspace and the value at home.
        places: Evenly spaced places of the workspace (M, 3) [m] that the statistics are taken over.
        values: Quantities there (M,) by name.
        stiffness_at_home: Main stiffnesses (3,) [N/m] and directions (3, 3) at home, or None.
        elasticity: Where the stiffness comes from.
        length: Characteristic length [m].
    """

    rows: dict[str, tuple[Statistics, float]]
    places: np.ndarray
    values: dict[str, np.ndarray]
    stiffness_at_home: tuple[np.ndarray, np.ndarray] | None
    elasticity: str
    length: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return a plain mapping."""
        home = self.stiffness_at_home
        return {
            "maps": [build_catalogue_row(name, s) | {"home": at_home} for name, (s, at_home) in self.rows.items()],
            "map_points": len(self.places),
            "characteristic_length_m": self.length,
            "stiffness_from": self.elasticity,
            "stiffness_ellipsoid_at_home": None
            if home is None
            else {"stiffness_N_per_m": home[0], "directions": home[1].T},
        }


def build_catalogue(found: Workspace, quality: Quality) -> Catalogue:
    """Return the figures of a robot over its workspace."""
    names, machine = quality.available(), found.machine
    places, q = _evenly(found)
    values = quality.values(names, q, found.poses(places))
    home = found.poses(machine.home_place[None])
    q_home = found.judge.judge(home).q
    at_home = quality.values(names, q_home, home)
    rates = machine.rates(q_home, home)
    main = quality.softest(rates) if "stiffness" in names else None
    turning = rates.tool.shape[2] > rates.linear or bool(rates.turns.any())
    return Catalogue(
        {name: (compute_statistics(values[name]), float(at_home[name][0])) for name in names if name in QUANTITIES},
        places,
        values,
        None if main is None else (main.stiffness[0], main.directions[0]),
        quality.elasticity.origin,
        rates.length if turning else None,
    )


def _evenly(found: Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Return places of the workspace on its coarse lattice, and the positions there."""
    lattice = found.lattice
    index = np.rint((found.places - lattice.low) / lattice.step).astype(int)
    even = (index % lattice.stride == 0).all(axis=1) & (found.place_codes == INSIDE)
    even |= np.all(index == np.array(lattice.nearest(found.machine.home_place)), axis=1)
    _, first = np.unique(index[even], axis=0, return_index=True)
    kept = np.flatnonzero(even)[first]
    return found.places[kept], found.q[kept]
