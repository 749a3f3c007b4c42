"""What a catalogue says of a robot: size, reach, stiffness and capability, over the whole workspace and at home."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.maps import QUANTITIES, Quality, Statistics, build_catalogue_row, compute_statistics
from tau_dyn.kinematics.workspace.result import Workspace


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
    home = found.poses(machine.home.position)
    q_home = found.judge.judge(home).q
    at_home = quality.values(names, q_home, home)
    rates = machine.rates(q_home, home)
    main = quality.softest(rates) if "stiffness" in names else None
    turning = rates.tool.shape[2] == 6 or bool(rates.turns.any())
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
    even |= np.all(index == np.array(lattice.nearest(found.machine.home.position[0])), axis=1)
    _, first = np.unique(index[even], axis=0, return_index=True)
    kept = np.flatnonzero(even)[first]
    return found.places[kept], found.q[kept]
