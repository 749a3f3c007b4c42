"""The analysis of `tau-dyn workspace` in one call: workspace, sections with maps, catalogue, tilt.

Every point of a section is checked itself; points of the workspace have the quantities of the maps. The tool's tilt is the
angle by which its axis can lean in each direction at one place until a requirement is violated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pinocchio as pin
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.workspace.elastic_maps import ELASTIC_MAPS, STDERR, build_elasticity
from tau_dyn.kinematics.workspace.find import find_workspace, leave_singular_home
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.machine import build_machine
from tau_dyn.kinematics.workspace.maps import Catalogue, Quality, build_catalogue
from tau_dyn.kinematics.workspace.pose_check import PoseRequirements
from tau_dyn.kinematics.workspace.result import Workspace
from tau_dyn.mechanism import Poses
from tau_dyn.results import Shown
from tau_dyn.robot import Robot

_MAX_SECTION_POINTS = 220
"""Points along the longer side of a section."""
_MAX_ELASTIC_POINTS = 200
"""Points of a section at which springs are linearised; the others take the nearest. A pose of the flexible L1 takes 20 ms."""


@dataclass(frozen=True, eq=False)
class Section:
    """A plane through a workspace.

    Attributes:
        axis: Index of the axis orthogonal to it (0, 1, 2).
        at: Coordinate on that axis [m].
        across: Index of the axis drawn to the right.
        up: Index of the axis drawn upwards.
        u: Coordinates to the right (nu,) [m].
        v: Coordinates upwards (nv,) [m].
        code: Codes (nu, nv), 0 in the workspace.
        maps: Quantities by name (nu, nv), nan outside the workspace.
        area: Area of the part in the workspace [m^2].
        axes: Names of the three coordinates.
        units: Units of these coordinates, m or rad.
    """

    axis: int
    at: float
    across: int
    up: int
    u: np.ndarray
    v: np.ndarray
    code: np.ndarray
    area: float
    maps: dict[str, np.ndarray] = field(default_factory=dict)
    axes: tuple[str, ...] = ("x", "y", "z")
    units: tuple[str, ...] = ("m", "m", "m")

    @property
    def name(self) -> str:
        """Text such as `x = 1.75 m`."""
        at = round(self.at, 9) + 0.0  # a rounding error of home is zero
        return f"{self.axes[self.axis]} = {at:.4g} {self.units[self.axis]}"

    @property
    def inside(self) -> np.ndarray:
        """Whether each point is in the workspace (nu, nv)."""
        return self.code == INSIDE


def parse_section(text: str, axes: Sequence[str] = ("x", "y", "z")) -> tuple[int, float]:
    """Return axis and place of a section such as `x=1.75`, by the names of the axes.

    Raises:
        InputError: The text has another form.
    """
    axis, equals, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if axis.strip().lower() not in axes or not equals or not abs(value) < 1e6:
        raise InputError("invalid_value", f"a section is an axis and a place, such as x=1.75, not '{text}'")
    return list(axes).index(axis.strip().lower()), value


def judge_section(found: Workspace, axis: int, at: float, quality: Quality, names: Sequence[str] = ()) -> Section:
    """Check the points of a plane across an axis.

    Args:
        found: The workspace.
        axis: Index of the axis.
        at: Coordinate on that axis [m].
        quality: Evaluates the maps.
        names: Names of the maps.

    Raises:
        InputError: The plane misses the searched box, or the tool does not move in it.
    """
    across, up = [k for k in range(3) if k != axis]
    machine, name = found.machine, found.machine.axes[axis]
    low, high = found.lattice.low, found.lattice.points(np.array(found.lattice.shape) - 1)
    place, scale = at * machine.scale[axis], machine.scale[[across, up]]
    if not low[axis] - 1e-9 <= place <= high[axis] + 1e-9:
        raise InputError(
            "unreachable",
            f"section {name}={at:g} misses the searched box, {low[axis] / machine.scale[axis]:.3g} to "
            f"{high[axis] / machine.scale[axis]:.3g} {machine.units[axis]}",
        )
    if found.lattice.shape[across] < 2 or found.lattice.shape[up] < 2:
        raise InputError("unsupported", f"the tool does not move along both axes of a section across {name}")
    step = max(found.lattice.step, max(high[across] - low[across], high[up] - low[up]) / _MAX_SECTION_POINTS)
    u, v = (_along(low[k], high[k], step) for k in (across, up))
    places = np.zeros((len(u), len(v), 3))
    places[..., axis], places[..., across], places[..., up] = place, u[:, None], v[None, :]
    places = places.reshape(-1, 3)
    judged = found.judge.judge(found.poses(places))
    code = _also_of_lattice(found, places, judged.code)
    inside = code == INSIDE
    rigid = [name for name in names if name not in ELASTIC_MAPS]
    maps = _spread(quality.compute_maps(rigid, judged.q[inside], found.poses(places[inside])), inside)
    if len(rigid) < len(names):
        elastic = [name for name in names if name in ELASTIC_MAPS]
        chosen, nearest = _thin_out(inside.reshape(len(u), len(v)))
        values = quality.compute_maps(elastic, judged.q[chosen], found.poses(places[chosen]))
        maps |= _spread({name: value[nearest] for name, value in values.items()}, inside)
    shape = (len(u), len(v))
    return Section(
        axis, at, across, up, u / scale[0], v / scale[1], code.reshape(shape), float(inside.sum() * step**2 / scale.prod()),
        {name: value.reshape(shape) for name, value in maps.items()}, machine.axes, machine.units,
    )  # fmt: skip


def _spread(values: Mapping[str, np.ndarray], inside: np.ndarray) -> dict[str, np.ndarray]:
    """Return values of the places inside over all places (n,), nan elsewhere."""
    out = {name: np.full(len(inside), np.nan) for name in values}
    for name, value in values.items():
        out[name][inside] = value
    return out


def _thin_out(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a section (nu, nv) at which springs are linearised, and which of them is nearest to each inside.

    Args:
        inside: Whether each point is in the workspace (nu, nv).

    Returns:
        Flat indices of the chosen points (m,), and for each point inside the position of the nearest in that list.
    """
    index = np.argwhere(inside)
    stride = max(1, int(np.ceil(np.sqrt(len(index) / _MAX_ELASTIC_POINTS))))
    kept = index[(index % stride == stride // 2).all(axis=1)]
    kept = kept if len(kept) else index[:1]
    nearest = cKDTree(kept).query(index)[1] if len(index) else np.zeros(0, int)
    return kept[:, 0] * inside.shape[1] + kept[:, 1], nearest


def _along(low: float, high: float, step: float) -> np.ndarray:
    return low + step * np.arange(int(np.floor((high - low) / step + 1e-9)) + 1)


def _also_of_lattice(found: Workspace, places: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Return codes that include the properties of the whole lattice: connection with home, distance from the border."""
    index = np.rint((places - found.lattice.low) / found.lattice.step).astype(int)
    index = np.clip(index, 0, np.array(found.lattice.shape) - 1)
    near = found.code[tuple(index.T)]
    wider = {c for c, kind, _ in found.reasons.items() if kind in ("not connected to home", "too close to the border")}
    return np.where((code == INSIDE) & np.isin(near, list(wider)), near, code)


def choose_usual_sections(found: Workspace) -> list[tuple[int, float]]:
    """Return the planes through home across x, y and z, of those in which the tool moves."""
    wide = [n > 1 for n in found.lattice.shape]
    home = found.machine.home_place / found.machine.scale
    return [(k, float(home[k])) for k in range(3) if all(wide[i] for i in range(3) if i != k)]


_SIDES = 24  # directions of leaning, every 15 degrees
_MAX_TILT_RAD = np.deg2rad(120.0)
_STEP = np.deg2rad(1.0)


class Tilt(NamedTuple):
    """Reachable orientations at a place.

    Attributes:
        place: The place (3,) [m].
        towards: Directions in the tool's xy plane into which its z axis leans (m,) [rad].
        angle: Largest angle in each direction (m,) [rad].
        reason: Reason of each limit (m words).
    """

    place: np.ndarray
    towards: np.ndarray
    angle: np.ndarray
    reason: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return a plain mapping, angles in degrees."""
        return {
            "place": self.place,
            "towards_deg": np.rad2deg(self.towards),
            "tilt_deg": np.rad2deg(self.angle),
            "every_way_deg": float(np.rad2deg(self.angle.min())),
            "best_way_deg": float(np.rad2deg(self.angle.max())),
            "limited_by": self.reason,
        }


_POSITION_FREEDOMS = 3  # with more drives, a tool leans in some directions


def turns_freely(found: Workspace) -> bool:
    """Return whether the tool's orientation can be chosen: six freedoms, six actuators."""
    machine = found.machine
    if machine.robot.na < 6:
        return False
    return machine.rods is None or not machine.rods.translates


def measure_tilt(found: Workspace, place: np.ndarray) -> Tilt:
    """Return the range of tilt of the tool at a place, relative to the workspace's orientation.

    Raises:
        InputError: The robot's tool does not turn freely, or the place is not in the workspace.
    """
    if not turns_freely(found):
        raise InputError(
            "unsupported", f"{found.machine.robot.source}: the tool does not turn freely, so it has no range of tilt"
        )
    place = np.asarray(place, float)
    judged = found.judge.judge(found.poses(place[None]))
    if judged.code[0] != INSIDE:
        words = found.reasons.words(int(judged.code[0]))
        raise InputError(
            "unreachable",
            f"the place {', '.join(f'{x:.4g}' for x in place)} m does not belong to the workspace ({words})",
        )
    towards = np.arange(_SIDES) * 2 * np.pi / _SIDES
    angles = np.arange(1, round(_MAX_TILT_RAD / _STEP) + 1) * _STEP
    axes = np.stack([-np.sin(towards), np.cos(towards), np.zeros(_SIDES)], axis=1)
    alive, reach, reason = np.ones(_SIDES, bool), np.full(_SIDES, angles[-1]), [""] * _SIDES
    for block in np.array_split(angles, 8):  # outwards, so that inverse kinematics has neighbours to start from
        sides = np.flatnonzero(alive)
        if not len(sides):
            break
        turn = Rotation.from_rotvec((axes[sides, None] * block[:, None]).reshape(-1, 3)).as_matrix()
        poses = Poses(np.tile(place, (len(turn), 1)), found.rotation @ turn)
        code = found.judge.judge(poses).code.reshape(len(sides), len(block))
        for k, row in zip(sides, code, strict=True):
            if (row != INSIDE).any():
                first = int(np.argmax(row != INSIDE))
                reach[k], alive[k] = block[first] - _STEP, False
                reason[k] = found.reasons.words(int(row[first]))
    return Tilt(place, towards, np.maximum(reach, 0.0), tuple(reason))


_MAX_PLACES = 2000
"""Largest number of places in a result file."""


@dataclass(frozen=True, eq=False)
class Study(Shown):
    """A workspace and its analysis.

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
            "tilt": self.tilt,
            "cloud": self._cloud(),
            **({"elastic_map": self._list_elastic()} if any(name in ELASTIC_MAPS for name in self.maps) else {}),
        }

    def _list_elastic(self) -> dict[str, Any]:
        """Return the places [m] at which springs were linearised, with the maps there and their standard errors."""
        figures = self.catalogue
        kept = {name for name in self.maps if name in ELASTIC_MAPS}
        kept |= {name + STDERR for name in kept}
        values = {name: value[figures.evaluated] for name, value in figures.values.items() if name in kept}
        return {"points": figures.places[figures.evaluated] / self.workspace.machine.scale, "values": values}

    def _cloud(self) -> dict[str, Any]:
        """Return places inside [m], thinned, with the maps there, for a viewer."""
        space = self.workspace
        inside = np.flatnonzero(space.place_codes == INSIDE)
        chosen = inside[:: max(1, -(-len(inside) // _MAX_PLACES))]
        rigid = [name for name in self.maps if name not in ELASTIC_MAPS]
        values = self.quality.compute_maps(rigid, space.q[chosen], space.poses(space.places[chosen]))
        points = space.places[chosen]
        if not space.machine.by_position:
            points = space.machine.kinematics.forward(space.q[chosen]).poses.position
        return {"points": points, "values": values}

    def _section(self, s: Section) -> dict[str, Any]:
        kinds = {code: kind for code, kind, _ in self.workspace.reasons.items()}
        solved = ~np.isin(s.code, [c for c, kind in kinds.items() if kind == "out of reach"])
        cell = float(np.diff(s.u[:2])[0] * np.diff(s.v[:2])[0]) if min(s.code.shape) > 1 else 0.0
        extents = s.u[s.inside.any(axis=1)], s.v[s.inside.any(axis=0)]
        ends = [[float(x[0]), float(x[-1])] if len(x) else None for x in extents]
        return {
            "across": s.name,
            "area_m2": s.area,
            "area_with_inverse_kinematics_m2": float(solved.sum()) * cell,
            "extent": dict(zip((s.axes[s.across], s.axes[s.up]), ends, strict=True)),
            "points": int(s.code.size),
        }


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
    load: float | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Study:
    """Find a robot's workspace and its figures.

    Args:
        robot: The robot.
        demands: Requirements for a pose.
        resolution: Finest distance of points [m].
        turn_deg: Roll, pitch and yaw of the tool from home, about the world's axes [deg].
        sections: Planes such as `x=1.75`; by default those through home.
        maps: Names of quantities, or `stiffness`, `sag`, `resonance` for all maps of that kind; by default all that are known
            and the stiffness of a robot with rods.
        tilt_at: Place at which the range of tilt is computed (3,) [m]; by default home.
        rod_stiffness: Stiffness of each rod with its joints [N/m], inf for rigid.
        actuator_stiffness: Stiffness by joint, '' for all [N/m or N m/rad], inf for rigid.
        load: Weight of a load at the tool [N].
        seed: Seed of the random points of the refinement.
        progress: Called with the current step.

    Raises:
        InputError: An argument is invalid.
    """
    machine = leave_singular_home(build_machine(robot), demands)
    planes = [parse_section(text, machine.axes) for text in sections]
    quality = Quality(machine, build_elasticity(machine, rod_stiffness, actuator_stiffness, load))
    names = quality.expand(maps) or quality.choose_usual()
    rotation = None if turn_deg is None else _turned(turn_deg) @ np.asarray(machine.home.rotation)[0]
    found = find_workspace(
        machine, demands=demands, resolution=resolution, rotation=rotation, seed=seed, progress=progress
    )
    cuts, planes = [], planes or choose_usual_sections(found)
    for k, (axis, at) in enumerate(planes, start=1):
        progress(f"judging section {k} of {len(planes)}")
        cuts.append(judge_section(found, axis, at, quality, names))
    progress("maps over the workspace")
    figures = build_catalogue(found, quality, names)
    if tilt_at is not None and not np.isfinite(tilt_at).all():
        raise InputError("invalid_value", "the place of --tilt must hold three finite numbers")
    lean = (
        measure_tilt(found, np.asarray(tilt_at if tilt_at is not None else machine.home.position[0]))
        if tilt_at is not None or turns_freely(found)
        else None
    )
    warnings = [*found.warnings]
    if lean is None and found.machine.robot.na > _POSITION_FREEDOMS:
        warnings.append(
            f"{robot.source}: {found.machine.robot.na} drives do not turn the tool freely, so no range of tilt is computed"
        )
    if not np.array_equal(machine.robot.home, robot.home):
        posture = ", ".join(f"{joint} {x:.4g}" for joint, x in zip(robot.actuated, machine.robot.home, strict=True))
        warnings.append(f"{robot.source}: home is singular; the workspace is that around {posture}")
    if any(name in ELASTIC_MAPS for name in names):
        warnings += quality.elasticity.warnings()
        warnings += _list_lost_poses(figures, names)
    elif load is not None:
        warnings.append(f"the load of {load:g} N has no effect: sag is {quality.elasticity.origin}")
    return Study(found, quality, names, cuts, figures, lean, tuple(warnings))


def _list_lost_poses(figures: Catalogue, names: Sequence[str]) -> list[str]:
    """Return a sentence if the springs do not hold the robot at some poses."""
    name = next(name for name in names if name in ELASTIC_MAPS)
    lost = int(np.isnan(figures.values[name][figures.evaluated]).sum())
    if not 0 < lost < figures.evaluated.sum():
        return []
    return [
        f"at {lost} of {int(figures.evaluated.sum())} places the springs do not hold the robot's weight, or a loop does not "
        "close; no stiffness, sag or resonance is given there"
    ]


def _turned(degrees: Sequence[float]) -> np.ndarray:
    angles = np.deg2rad(np.asarray(degrees, float))
    if angles.shape != (3,) or not np.isfinite(angles).all():
        raise InputError("invalid_value", "an orientation is roll, pitch and yaw, three finite numbers of degrees")
    return pin.rpy.rpyToMatrix(angles)


def build_points_table(found: Study) -> pd.DataFrame:
    """Return one row a judged point, columns as a log's: `x_tool`.., `q_<joint>`, then `inside`, `reason` and the maps."""
    space = found.workspace
    index = np.rint((space.places - space.lattice.low) / space.lattice.step).astype(int)
    _, first = np.unique(index, axis=0, return_index=True)
    places, q, codes = space.places[first], space.q[first], space.place_codes[first]
    machine, values = space.machine, places / space.machine.scale
    columns: dict[str, np.ndarray] = {f"{axis}_tool": values[:, k] for k, axis in enumerate(machine.axes) if axis}
    columns |= {f"q_{name}": q[:, k] for k, name in enumerate(machine.robot.actuated)}
    inside = codes == INSIDE
    columns["inside"] = inside.astype(int)
    words = {int(code): space.reasons.words(int(code)) for code in np.unique(codes)}
    columns["reason"] = np.array([words[int(code)] for code in codes], dtype=object)
    rigid = [name for name in found.maps if name not in ELASTIC_MAPS]
    columns |= _spread(found.quality.compute_maps(rigid, q[inside], space.poses(places[inside])), inside)
    return pd.DataFrame(columns | _list_elastic_columns(found, places))


def _list_elastic_columns(found: Study, places: np.ndarray) -> dict[str, np.ndarray]:
    """Return the maps of the springs and their standard errors at places (N, 3), nan where the robot was not linearised."""
    figures, wanted = found.catalogue, [name for name in found.maps if name in ELASTIC_MAPS]
    if not wanted:
        return {}
    at = figures.places[figures.evaluated]
    if not len(at):
        return {name: np.full(len(places), np.nan) for name in wanted}
    away, nearest = cKDTree(at).query(places)
    same = away < 1e-6 * found.workspace.lattice.step
    out = {}
    for name in (n for base in wanted for n in (base, base + STDERR) if n in figures.values):
        out[name] = np.where(same, figures.values[name][figures.evaluated][nearest], np.nan)
    return out
