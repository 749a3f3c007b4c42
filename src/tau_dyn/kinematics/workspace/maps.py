"""Maps and catalogue of a robot: condition, distance to singularity, worst speed and force, springs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import UnknownName
from tau_dyn.kinematics.dexterity import (
    Rates,
    compute_dexterity,
    compute_worst_force,
    compute_worst_speed,
    find_softest,
)
from tau_dyn.kinematics.workspace.elastic_maps import ELASTIC, ELASTIC_MAPS, STDERR, Elasticity
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machine import WorkspaceModel
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.mechanism import Poses


class Quantity(NamedTuple):
    """Quantity of a map: its description and unit."""

    words: str
    unit: str


QUANTITIES: dict[str, Quantity] = {
    "condition": Quantity("condition number", "1"),
    "manipulability": Quantity("manipulability", "1"),
    "singularity": Quantity("distance to singularity", "1"),
    "stiffness": Quantity("stiffness, softest direction", "N/m"),
    "stiffness_x": Quantity("stiffness along x", "N/m"),
    "stiffness_y": Quantity("stiffness along y", "N/m"),
    "stiffness_z": Quantity("stiffness along z", "N/m"),
    "sag": Quantity("sag under the robot's weight", "m"),
    "sag_load": Quantity("sag under the load", "m"),
    "resonance": Quantity("first resonance", "Hz"),
    "resonance_2": Quantity("second resonance", "Hz"),
    "speed": Quantity("speed in every direction", "m/s"),
    "force": Quantity("force in every direction", "N"),
}


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
        """Return the names of the quantities that are known of this robot."""
        there = set(self.list_names())
        elastic = set(ELASTIC_MAPS) if not self.elasticity.known else set()
        return [name for name in QUANTITIES if name in there - elastic]

    def choose_usual(self) -> list[str]:
        """Return the default maps: all known ones, and the stiffness if the robot has rods."""
        known = self.available()
        asked = ["stiffness"] if self.machine.rods is not None and "stiffness" not in known else []
        return [*known, *asked]

    def list_names(self) -> list[str]:
        """Return the names of the quantities that can be requested, unknown ones included."""
        robot = self.machine.robot
        missing = {
            "sag_load": self.elasticity.load is None,
            "speed": not np.isfinite(robot.velocity_limit).all(),
            "force": not np.isfinite(robot.effort_limit).all(),
        }
        return [name for name in QUANTITIES if not missing.get(name, False)]

    def expand(self, words: Iterable[str]) -> list[str]:
        """Return the names of the maps requested by words: `stiffness`, `sag` and `resonance` request several.

        Raises:
            UnknownName: A quantity that does not exist, or that this robot lacks.
        """
        there, found = self.list_names(), []
        for word in words:
            named = [name for name in ELASTIC.get(word, (word,)) if name in there]
            if not named:
                raise UnknownName("map of this robot", word, there)
            found += named
        return list(dict.fromkeys(found))

    def compute_maps(self, names: Sequence[str], q: np.ndarray, poses: Poses) -> dict[str, np.ndarray]:
        """Return quantities by name, each (N,) in SI; those of the springs with `<name>_stderr` if the springs have some.

        Raises:
            UnknownName: A quantity that does not exist, or that this robot lacks.
        """
        there = self.list_names()
        for name in names:
            if name not in there:
                raise UnknownName("map of this robot", name, there)
        rigid = [name for name in names if name not in ELASTIC_MAPS]
        found = {name: np.zeros(len(q)) for name in rigid}
        if len(q) and rigid:
            found = dict(self._all(self.machine.rates(q, poses), rigid))
        elastic = self.elasticity.compute_maps(q) if len(rigid) < len(names) else {}
        kept = {*names, *(name + STDERR for name in names)}
        return found | {name: value for name, value in elastic.items() if name in kept}

    def _all(self, rates: Rates, names: list[str]):
        robot, found = self.machine.robot, compute_dexterity(rates)
        for name in names:
            if name == "speed":
                yield name, compute_worst_speed(rates, robot.velocity_limit)
            elif name == "force":
                yield name, compute_worst_force(rates, robot.effort_limit)
            else:
                yield name, getattr(found, name)


class Statistics(NamedTuple):
    """Least, middle and largest of finite values."""

    least: float
    median: float
    largest: float


def compute_statistics(values: np.ndarray) -> Statistics:
    """Return least, median and largest of the finite values; nan without finite values."""
    values = values[np.isfinite(values)]
    if not len(values):
        return Statistics(np.nan, np.nan, np.nan)
    return Statistics(float(values.min()), float(np.median(values)), float(values.max()))


_Z95 = 1.959964  # standard normal quantile of a 95 % interval
_MAX_ELASTIC_PLACES = 400
"""Places of a catalogue at which springs are linearised; a pose of the flexible L1 takes 20 ms."""


class Extreme(NamedTuple):
    """Place where a quantity is least or largest.

    Attributes:
        place: Position of the tool (3,) [m], or its commanded coordinates.
        ci95: 95 % interval of the value there from the springs' standard errors; None without standard errors.
    """

    place: np.ndarray
    ci95: tuple[float, float] | None


class CatalogueRow(NamedTuple):
    """One quantity over the workspace, in SI; nan if it is unknown.

    Attributes:
        spread: Least, median and largest value.
        home: Value at home.
        least: Place of the least value, or None.
        largest: Place of the largest value, or None.
        home_ci95: 95 % interval of the value at home, or None.
    """

    spread: Statistics
    home: float
    least: Extreme | None = None
    largest: Extreme | None = None
    home_ci95: tuple[float, float] | None = None

    def to_dict(self, name: str) -> dict[str, Any]:
        """Return a line of the catalogue; `name` is the quantity's."""
        quantity = QUANTITIES[name]
        found = {
            "map": name,
            "what": quantity.words,
            "unit": quantity.unit,
            "min": self.spread.least,
            "median": self.spread.median,
            "max": self.spread.largest,
            "home": self.home,
            "min_at": None if self.least is None else self.least.place,
            "max_at": None if self.largest is None else self.largest.place,
        }
        if name not in ELASTIC_MAPS:
            return found
        return found | {
            "min_ci95": None if self.least is None else self.least.ci95,
            "max_ci95": None if self.largest is None else self.largest.ci95,
            "home_ci95": self.home_ci95,
        }


def compute_interval(value: float, stderr: float | None) -> tuple[float, float] | None:
    """Return the 95 % interval of a value; None without a standard error."""
    if stderr is None or not np.isfinite([value, stderr]).all():
        return None
    return float(value - _Z95 * stderr), float(value + _Z95 * stderr)


def _find_extreme(values: np.ndarray, stderr: np.ndarray | None, places: np.ndarray, pick: Any) -> Extreme | None:
    if not np.isfinite(values).any():
        return None
    k = int(pick(np.where(np.isinf(values), np.nan, values)))
    return Extreme(places[k], compute_interval(float(values[k]), None if stderr is None else float(stderr[k])))


class Catalogue(NamedTuple):
    """Figures of a robot.

    Attributes:
        rows: Statistics over the workspace with the places of the extremes, and the value at home, by quantity.
        places: Evenly spaced places of the workspace (M, 3) [m] for the statistics.
        values: Quantities there (M,) by name, standard errors included; those of the springs are nan if not evaluated.
        evaluated: Whether the springs were linearised (M,).
        stiffness_at_home: Main stiffnesses (3,) [N/m] and directions (3, 3) at home, or None.
        elasticity: Source of the stiffness.
        length: Characteristic length [m].
    """

    rows: dict[str, CatalogueRow]
    places: np.ndarray
    values: dict[str, np.ndarray]
    evaluated: np.ndarray
    stiffness_at_home: tuple[np.ndarray, np.ndarray] | None
    elasticity: str
    length: float | None

    def __repr__(self) -> str:
        """Return the names of the quantities and the number of places, without their arrays."""
        return f"Catalogue({', '.join(self.rows)}; {len(self.places)} places, {int(self.evaluated.sum())} with springs)"

    def to_dict(self) -> dict[str, Any]:
        """Return a plain mapping."""
        home = self.stiffness_at_home
        return {
            "maps": [row.to_dict(name) for name, row in self.rows.items()],
            "map_points": len(self.places),
            "elastic_points": int(self.evaluated.sum()),
            "characteristic_length_m": self.length,
            "stiffness_from": self.elasticity,
            "stiffness_ellipsoid_at_home": None
            if home is None
            else {"stiffness_N_per_m": home[0], "directions": home[1].T},
        }


def build_catalogue(found: Workspace, quality: Quality, asked: Sequence[str] = ()) -> Catalogue:
    """Return the figures of a robot over its workspace.

    Args:
        found: The workspace.
        quality: Evaluates maps.
        asked: Names of maps; those that follow from springs are evaluated if named here, all others always.
    """
    machine = found.machine
    rigid = [name for name in quality.available() if name not in ELASTIC_MAPS]
    elastic = [name for name in asked if name in ELASTIC_MAPS]
    places, q = _evenly(found)
    values = quality.compute_maps(rigid, q, found.poses(places))
    evaluated = np.zeros(len(places), bool)
    if elastic:
        evaluated[:: max(1, -(-len(places) // _MAX_ELASTIC_PLACES))] = True
        for name, value in quality.compute_maps(elastic, q[evaluated], found.poses(places[evaluated])).items():
            values[name] = np.full(len(places), np.nan)
            values[name][evaluated] = value
        evaluated &= quality.elasticity.known
    home = found.poses(machine.home_place[None])
    q_home = found.judge.judge(home).q
    at_home = quality.compute_maps([*rigid, *elastic], q_home, home)
    rates = machine.rates(q_home, home)
    turning = rates.tool.shape[2] > rates.linear or bool(rates.turns.any())
    rows = {}
    for name in (name for name in QUANTITIES if name in values):
        stderr, home_stderr = values.get(name + STDERR), at_home.get(name + STDERR)
        rows[name] = CatalogueRow(
            compute_statistics(values[name]),
            float(at_home[name][0]),
            _find_extreme(values[name], stderr, places / machine.scale, np.nanargmin),
            _find_extreme(values[name], stderr, places / machine.scale, np.nanargmax),
            compute_interval(float(at_home[name][0]), None if home_stderr is None else float(home_stderr[0])),
        )
    return Catalogue(
        rows,
        places,
        values,
        evaluated,
        _find_main_stiffness(quality.elasticity, q_home[0]) if elastic else None,
        quality.elasticity.origin,
        rates.length if turning else None,
    )


def _find_main_stiffness(elasticity: Elasticity, q: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return main stiffnesses (3,) [N/m] and directions (3, 3) at a pose (na,); None if they are unknown."""
    near = elasticity.linearise(q)
    if near is None:
        return None
    C = near.compliance()
    main = find_softest((C + C.T)[None] / 2)
    return main.stiffness[0], main.directions[0]


def _evenly(found: Workspace) -> tuple[np.ndarray, np.ndarray]:
    """Return places of the workspace on its coarse lattice, and the positions there."""
    lattice = found.lattice
    index = np.rint((found.places - lattice.low) / lattice.step).astype(int)
    even = (index % lattice.stride == 0).all(axis=1) & (found.place_codes == INSIDE)
    even |= np.all(index == np.array(lattice.nearest(found.machine.home_place)), axis=1)
    _, first = np.unique(index[even], axis=0, return_index=True)
    kept = np.flatnonzero(even)[first]
    return found.places[kept], found.q[kept]
