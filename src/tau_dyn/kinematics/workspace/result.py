"""A workspace: its points, its size with bounds, the reasons of excluded points, the robot's footprint, and warnings.

The footprint is the floor area of the robot's frame and its carts' travel, seen from above. No source defines the ratio of
workspace and footprint, so two ratios are reported: workspace volume per floor area [m], and per volume of the upright box around
frame and carts (the installation). Rods and plate, which reach beyond, belong to the workspace and do not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.kinematics.obstacles import PlacedSolid
from tau_dyn.kinematics.workspace.lattice import INSIDE, Lattice, Size
from tau_dyn.kinematics.workspace.machine import WorkspaceModel, get_travel
from tau_dyn.kinematics.workspace.pose_check import KINDS, PoseChecker, Reasons
from tau_dyn.mechanism import Poses
from tau_dyn.results import Brief

_MEASURES = {1: ("length", "m"), 2: ("area", "m2"), 3: ("volume", "m3")}


@dataclass(frozen=True, eq=False)
class Footprint:
    """Footprint of a robot: the rectangle, parallel to x and y, around its frame and its actuators' travel.

    Attributes:
        lower: Corner (2,) [m].
        upper: Opposite corner (2,) [m].
        height: Distance from its lowest to its highest point [m].
        what: Parts of the robot that it contains.
    """

    lower: np.ndarray
    upper: np.ndarray
    height: float
    what: str

    @property
    def area(self) -> float:
        """Area [m^2]."""
        return float(np.prod(self.upper - self.lower))


@dataclass(frozen=True, eq=False)
class Workspace(Brief):
    """Workspace of the tool at one orientation.

    Attributes:
        machine: The robot.
        judge: Checker of the poses.
        rotation: Rotation (3, 3) of the tool.
        lattice: The points that were classified.
        code: Code of every point (lattice shape), `INSIDE` in the workspace.
        asked: Whether a point was checked itself, not filled from its neighbours (lattice shape).
        size: Volume with bounds [m^3]; area or length if the tool moves in a plane or on a line.
        lower: Lowest coordinates of the set (3,) [m], [rad] for turns.
        upper: Highest coordinates (3,) [m], [rad] for turns.
        footprint: Footprint of the robot.
        reasons: Meaning of the codes.
        places: The checked points that have positions (M, 3) [m].
        q: Their actuated positions (M, na).
        place_codes: Their codes (M,).
        warnings: Sentences.
    """

    machine: WorkspaceModel
    judge: PoseChecker
    rotation: np.ndarray
    lattice: Lattice
    code: np.ndarray
    asked: np.ndarray
    size: Size
    lower: np.ndarray
    upper: np.ndarray
    footprint: Footprint
    reasons: Reasons
    places: np.ndarray
    q: np.ndarray
    place_codes: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def inside(self) -> np.ndarray:
        """Whether each point is in the workspace (lattice shape)."""
        return self.code == INSIDE

    @property
    def dimension(self) -> int:
        """3 for a volume, 2 for a plane, 1 for a line."""
        return self.lattice.dimension

    @property
    def measure(self) -> tuple[str, str]:
        """Name of its size, and the unit."""
        name, unit = _MEASURES.get(self.dimension, ("points", "1"))
        wide = [u for u, n in zip(self.machine.units, self.lattice.shape, strict=True) if n > 1]
        if self.machine.by_position:
            return name, unit
        return name, " ".join(u + (str(wide.count(u)) if wide.count(u) > 1 else "") for u in dict.fromkeys(wide))

    def poses(self, points: np.ndarray) -> Poses:
        """Return poses of the tool at places (N, 3)."""
        return self.machine.place(points, self.rotation)

    def counts(self) -> list[dict[str, Any]]:
        """Return how many points each reason excludes, by kind, then by culprit; shares are relative to the searched box."""
        found = []
        total = self.code.size
        number = np.bincount(self.code.ravel(), minlength=max((c for c, _, _ in self.reasons.items()), default=0) + 1)
        for kind in KINDS:
            rows = [(culprit, int(number[code])) for code, k, culprit in self.reasons.items() if k == kind]
            points = sum(n for _, n in rows)
            if points:
                culprits = {c: n for c, n in sorted(rows, key=lambda r: -r[1]) if c and n}
                found.append({"reason": kind, "points": points, "share": points / total, "culprits": culprits})
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the workspace's part of the JSON result."""
        name, unit = self.measure
        by_position, frame = self.machine.by_position, self.footprint
        value, low, high = self.size
        solid, last = self.dimension == 3 and by_position, np.array(self.lattice.shape) - 1
        return {
            "dimension": self.dimension,
            "volume_m3": value if solid else None,
            "volume_bound_m3": [low, high] if solid else None,
            "size": {"name": name, "unit": unit, "value": value, "low": low, "high": high},
            "resolution_m": self.lattice.step,
            "points": {"inside": int(self.inside.sum()), "lattice": int(self.code.size), "judged": self.judge.n_judged},
            "bounding_box": {"lower": self.lower, "upper": self.upper},
            "searched": {
                "lower": self.lattice.low / self.machine.scale,
                "upper": self.lattice.points(last) / self.machine.scale,
            },
            "orientation": self.rotation,
            "footprint": {
                "area_m2": frame.area,
                "lower": frame.lower,
                "upper": frame.upper,
                "height_m": frame.height,
                "what": frame.what,
                "workspace_to_footprint_m": value / frame.area if solid and frame.area > 0 else None,
                "workspace_to_installation": value / (frame.area * frame.height)
                if solid and frame.area * frame.height > 0
                else None,
            },
            "excluded": self.counts(),
        } | ({} if by_position else {"coordinates": list(self.machine.axes)})


def build_footprint(machine: WorkspaceModel) -> Footprint:
    """Return a robot's footprint."""
    solids = machine.solids(machine.robot.home[None], machine.home)
    fixed = [_corners(s) for s, body in zip(solids, machine.bodies, strict=True) if body.joint == 0]
    what = ["frame"] if fixed else []
    if machine.rods is not None:
        lower, upper = get_travel(machine.robot)
        share = np.random.default_rng(0).random((400, machine.robot.na))
        q = np.concatenate([[lower, upper, machine.robot.home], lower + share * (upper - lower)])
        fixed.append(machine.rods.base_points(q).reshape(-1, 3))
        what.append("rods' joints over the actuators' travel")
    if not fixed:
        return Footprint(np.zeros(2), np.zeros(2), 0.0, "unknown: the file draws no frame in simple shapes")
    points = np.concatenate(fixed)
    low, high = points.min(axis=0), points.max(axis=0)
    return Footprint(low[:2], high[:2], float(high[2] - low[2]), " and ".join(what))


def _corners(solid: PlacedSolid) -> np.ndarray:
    """Return the corners (8, 3) of a box around a solid at its first pose."""
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return solid.position[0] + (signs * solid.shape.half_size) @ solid.rotation[0].T
