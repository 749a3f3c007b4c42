"""All that `tau-dyn workspace` asks of a robot in one call: workspace, sections with maps, catalogue, tilt."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.kinematics.workspace.catalogue import Catalogue, build_catalogue
from tau_dyn.kinematics.workspace.find import find_workspace
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machines import build_machine
from tau_dyn.kinematics.workspace.maps import Quality, build_elasticity
from tau_dyn.kinematics.workspace.orientations import Tilt, measure_tilt, turns_freely
from tau_dyn.kinematics.workspace.pose_requirements import PoseRequirements
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.kinematics.workspace.sections import Section, choose_usual_sections, judge_section, parse_section
from tau_dyn.results import Shown
from tau_dyn.robot import Robot

_MAX_PLACES = 2000
"""Places of a result file at most."""


@dataclass(frozen=True, eq=False)
class Study(Shown):
    """A workspace and what was asked about it.

    Attributes:
        workspace: The workspace.
        quality: Evaluates maps.
        maps: Names of the maps.
        sections: Cross-sections.
        catalogue: Figures over the whole workspace.
        tilt: Range of tilt, or None for a tool that does not turn freely.
        warnings: Sentences.
    """

    workspace: Workspace
    quality: Quality
    maps: list[str]
    sections: list[Section]
    catalogue: Catalogue
    tilt: Tilt | None
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the command's JSON result."""
        return {
            **self.workspace.to_dict(),
            **self.catalogue.to_dict(),
            "sections": [self._section(s) for s in self.sections],
            "tilt": None if self.tilt is None else self.tilt.to_dict(),
            "cloud": self._cloud(),
        }

    def _cloud(self) -> dict[str, Any]:
        """Return places inside [m], thinned, with the maps there: what a viewer draws."""
        space = self.workspace
        inside = np.flatnonzero(space.place_codes == INSIDE)
        chosen = inside[:: max(1, -(-len(inside) // _MAX_PLACES))]
        values = self.quality.values(self.maps, space.q[chosen], space.poses(space.places[chosen]))
        return {"points": space.places[chosen], "values": values}

    def _section(self, s: Section) -> dict[str, Any]:
        kinds = {code: kind for code, kind, _ in self.workspace.reasons.items()}
        solved = ~np.isin(s.code, [c for c, kind in kinds.items() if kind == "out of reach"])
        cell = float(np.diff(s.u[:2])[0]) ** 2 if len(s.u) > 1 else 0.0
        ends = [[float(x[0]), float(x[-1])] if len(x) else None for x in _extents(s)]
        return {
            "across": s.name,
            "area_m2": s.area,
            "area_with_inverse_kinematics_m2": float(solved.sum()) * cell,
            "extent": dict(zip(("xyz"[s.across], "xyz"[s.up]), ends, strict=True)),
            "points": int(s.code.size),
        }


def _extents(s: Section) -> list[np.ndarray]:
    return [s.u[s.inside.any(axis=1)], s.v[s.inside.any(axis=0)]]


def study_workspace(
    robot: Robot,
    *,
    demands: PoseRequirements | None = None,
    resolution: float | None = None,
    turn_deg: Sequence[float] | None = None,
    sections: Sequence[str] = (),
    maps: Sequence[str] = (),
    tilt_at: Sequence[float] | np.ndarray | None = None,
    rod_stiffness: float | None = None,
    actuator_stiffness: Mapping[str, float] | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Study:
    """Find a robot's workspace and its figures.

    Args:
        robot: The robot.
        demands: What a pose must satisfy.
        resolution: Finest distance of points [m].
        turn_deg: Roll, pitch and yaw of the tool from home, about the world's axes [deg].
        sections: Planes such as `x=1.75`; by default those through home.
        maps: Names of quantities; by default all that the robot has.
        tilt_at: Place at which the range of tilt is asked (3,) [m]; by default home.
        rod_stiffness: [N/m] of each rod with its joints.
        actuator_stiffness: By joint, '' for all [N/m or N m/rad].
        seed: Of the random points of the refinement.
        progress: Told what is being done.

    Raises:
        InputError: Some of it is at fault.
    """
    planes = [parse_section(text) for text in sections]
    machine = build_machine(robot)
    quality = Quality(machine, build_elasticity(machine, rod_stiffness, actuator_stiffness))
    names = list(dict.fromkeys(maps)) or quality.available()
    unknown = next((n for n in names if n not in quality.available()), None)
    if unknown is not None:
        raise UnknownName("map of this robot", unknown, quality.available())
    rotation = None if turn_deg is None else _turned(turn_deg) @ np.asarray(machine.home.rotation)[0]
    found = find_workspace(
        machine, demands=demands, resolution=resolution, rotation=rotation, seed=seed, progress=progress
    )
    progress("judging sections")
    cuts = [judge_section(found, axis, at, quality, names) for axis, at in planes or choose_usual_sections(found)]
    progress("maps over the workspace")
    figures = build_catalogue(found, quality)
    if tilt_at is not None and not np.isfinite(tilt_at).all():
        raise InputError("invalid_value", "the place of --tilt must hold three finite numbers")
    lean = (
        measure_tilt(found, np.asarray(tilt_at if tilt_at is not None else machine.home.position[0]))
        if tilt_at is not None or turns_freely(found)
        else None
    )
    warnings = [*found.warnings]
    if quality.elasticity.assumed:
        warnings.append(f"stiffness: {quality.elasticity.origin}")
    return Study(found, quality, names, cuts, figures, lean, tuple(warnings))


def _turned(degrees: Sequence[float]) -> np.ndarray:
    angles = np.deg2rad(np.asarray(degrees, float))
    if angles.shape != (3,) or not np.isfinite(angles).all():
        raise InputError("invalid_value", "an orientation is roll, pitch and yaw, three finite numbers of degrees")
    return pin.rpy.rpyToMatrix(angles)
