"""Candidate poses: a grid over the workspace or positions spread over the joints' travel, and which of them a device sees.

The machine's dimensions are only approximately known, so candidates keep a safety distance from obstacles, from the workspace's
border and from the ends of the joints' travel, and a safety angle from the ball joints' limits (thesis 5.6).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from tau_dyn.calibrate.poses.devices import SEEN, MeasuringDevice
from tau_dyn.calibrate.poses.tour import PathCheck
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.kinematics import Obstacle, PlacedSolid, Surroundings, build_capsule, build_standing_solid, find_collisions
from tau_dyn.kinematics.workspace import (
    INSIDE,
    PoseChecker,
    PoseRequirements,
    WorkspaceModel,
    find_workspace,
    get_travel,
)
from tau_dyn.mechanism import DEFAULT_ANGLE, Poses

WANTED = 1000
"""Number of candidates that is sufficient for a choice of a hundred poses."""
TILT = float(np.deg2rad(10.0))
_CELLS = 24  # coarse cells along the longest side of the workspace
_DRAWN = 4
"""Positions drawn for each candidate wanted."""


@dataclass(frozen=True)
class Safety:
    """Safety margins of candidates, because the robot's dimensions are only approximately known.

    Attributes:
        distance: Distance from obstacles and the workspace's border [m].
        angle: Distance from the ball joints' limits [rad].
        travel: Distance from each end of a joint's travel, as a share of it.
    """

    distance: float = 0.05
    angle: float = float(np.deg2rad(5.0))
    travel: float = 0.02

    def __post_init__(self) -> None:
        """Refuse margins out of range."""
        if not (0 <= self.distance < 1e3 and 0 <= self.angle < np.pi / 2 and 0 <= self.travel < 0.5):
            raise InputError(
                "invalid_value",
                "safety distances are a length and an angle (below 90 degrees) from zero up and a "
                "share of the travel below a half, not "
                f"{self.distance} m, {np.rad2deg(self.angle):.3g} degrees and {self.travel}",
            )

    def apply(self, demands: PoseRequirements, touched: Collection[str] = ()) -> PoseRequirements:
        """Return demands with these margins; obstacles that are `touched` keep their own."""
        around = demands.surroundings
        walls = tuple(o if o.name in touched else _wider(o, self.distance) for o in around.obstacles)
        limit = demands.ball_angle if demands.ball_angle is not None else DEFAULT_ANGLE
        if self.angle > 0 and limit - self.angle <= 0:
            raise InputError(
                "invalid_value",
                f"a safety angle of {np.rad2deg(self.angle):.3g} degrees leaves no part of the ball "
                f"joints' {np.rad2deg(limit):.3g}",
            )
        return replace(
            demands,
            ball_angle=limit - self.angle if self.angle > 0 or demands.ball_angle is not None else None,
            surroundings=replace(around, obstacles=walls),
        )


@dataclass(frozen=True, eq=False)
class Reachable:
    """Poses that the robot may take.

    Attributes:
        q: Actuated positions (N, na).
        tool: Tool poses (N).
        check: Check of further positions and moves, with the same margins except for the border.
        warnings: Sentences.
    """

    q: np.ndarray
    tool: Poses
    check: PathCheck
    warnings: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.q)


def find_reachable(
    machine: WorkspaceModel,
    demands: PoseRequirements | None = None,
    safety: Safety | None = None,
    *,
    wanted: int = WANTED,
    tilt: float = TILT,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Reachable:
    """Find poses that a robot may take.

    Args:
        machine: The robot.
        demands: Conditions that they must satisfy.
        safety: Additional margins.
        wanted: Approximate number of poses; it determines the grid.
        tilt: Angle by which a plate that can turn is tilted and turned about each axis [rad].
        seed: Seed of random samples.
        progress: Called with a description of each step.

    Raises:
        CannotAnswer: No pose satisfies the demands.
    """
    safety = safety if safety is not None else Safety()
    strict = safety.apply(demands if demands is not None else PoseRequirements())
    progress("looking for poses in reach")
    check = PathCheck(machine, strict)
    if machine.rods is not None:
        plain = replace(demands if demands is not None else PoseRequirements(), collisions=False)
        border = PoseChecker(machine, plain), safety.distance
        q, tool, said = _on_grid(machine, strict, border, wanted, 0.0 if machine.rods.translates else tilt, progress)
    else:
        q, tool, said = _over_travel(machine, check, wanted, seed)
    low, high = get_travel(machine.robot)
    room = safety.travel * (high - low)
    inside = ((q >= low + room) & (q <= high - room)).all(axis=1)
    if not inside.any():
        raise CannotAnswer(
            "no_solution",
            f"{machine.robot.source}: no pose keeps the safety distances ({1e3 * safety.distance:.0f} mm, "
            f"{np.rad2deg(safety.angle):.0f} degrees, {100 * safety.travel:.0f} % of the travel)",
            "smaller safety distances, after the dimensions were measured better, or fewer obstacles",
        )
    return Reachable(q[inside], tool.take(np.flatnonzero(inside)), check, said)


def _on_grid(
    machine: WorkspaceModel,
    demands: PoseRequirements,
    border: tuple[PoseChecker, float],
    wanted: int,
    tilt: float,
    progress: Callable[[str], None],
) -> tuple[np.ndarray, Poses, tuple[str, ...]]:
    lower, upper = machine.reach()
    coarse = float(np.max(upper - lower)) / _CELLS
    space = find_workspace(machine, demands=demands, resolution=coarse)
    turns = _turns(tilt)
    cells = max(1.0, wanted / len(turns))
    step = min(coarse, (space.size.value / cells) ** (1 / max(space.dimension, 1)))
    grid = _grid(space.lower, space.upper, step)
    places = grid[[bool(space.inside[space.lattice.nearest(p)]) for p in grid]]
    if len(places) * len(turns) > 2 * wanted:  # a coarse grid of a small workspace, turned many ways
        every = np.linspace(0, len(places) - 1, max(1, int(np.ceil(2 * wanted / len(turns)))))
        places = places[np.unique(every.astype(int))]
    found_q, positions, rotations = [], [], []
    for k, turn in enumerate(turns, start=1):
        progress(f"orientation {k} of {len(turns)}")
        rotation = np.broadcast_to(turn @ space.rotation, (len(places), 3, 3))
        judged = space.judge.judge(Poses(places, rotation))
        good = np.flatnonzero(judged.code == INSIDE)
        good = good[_within(places[good], rotation[good], space.lattice.shape, *border)]
        found_q.append(judged.q[good])
        positions.append(places[good])
        rotations.append(rotation[good])
    said = tuple(w for w in space.warnings if "resolution" not in w)  # every candidate was checked by itself
    return np.concatenate(found_q), Poses(np.concatenate(positions), np.concatenate(rotations)), said


def _within(
    places: np.ndarray, rotation: np.ndarray, shape: tuple[int, ...], judge: PoseChecker, distance: float
) -> np.ndarray:
    """Return whether the tool (N,) can also move by a distance to all sides, so that it is not near the workspace's border."""
    good = np.ones(len(places), bool)
    if distance <= 0:
        return good
    for axis in (k for k, n in enumerate(shape) if n > 1):
        for sign in (-1, 1):
            left = np.flatnonzero(good)
            beside = places[left] + sign * distance * np.eye(3)[axis]
            good[left] = judge.judge(Poses(beside, rotation[left])).code == INSIDE
    return good


def _grid(lower: np.ndarray, upper: np.ndarray, step: float) -> np.ndarray:
    axes = []
    for low, high in zip(lower, upper, strict=True):
        n = int(np.floor((high - low) / step + 1e-9)) + 1
        axes.append(0.5 * (low + high) + step * (np.arange(n) - (n - 1) / 2))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _turns(tilt: float) -> list[np.ndarray]:
    """Return rotations by -tilt, 0 and tilt about each axis, as the thesis' grid (5.4)."""
    if tilt <= 0:
        return [np.eye(3)]
    return [Rotation.from_rotvec(tilt * np.array(v)).as_matrix() for v in product((-1.0, 0.0, 1.0), repeat=3)]


def _over_travel(
    machine: WorkspaceModel, check: PathCheck, wanted: int, seed: int
) -> tuple[np.ndarray, Poses, tuple[str, ...]]:
    low, high = get_travel(machine.robot)
    power = int(np.ceil(np.log2(_DRAWN * wanted)))
    even = qmc.Sobol(machine.robot.na, scramble=False).random_base2(power)
    share = (even + np.random.default_rng(seed).random(machine.robot.na)) % 1.0  # Cranley & Patterson 1976
    q = low + share * (high - low)
    good = np.flatnonzero(check.reasons(q) == "")[:wanted]
    poses, _ = check.poses(q[good]) if len(good) else (machine.home.take(np.zeros(0, int)), None)
    return q[good], poses, ()


def _wider(obstacle: Obstacle, distance: float) -> Obstacle:
    return replace(obstacle, margin=max(obstacle.margin, distance))


_BEAM = 1e-4  # [m] radius of a line of sight
_FREE = 0.02  # [m] before the mark that may be hidden: the target's own mount


def find_blocking(device: MeasuringDevice, tool: Poses, around: Surroundings) -> np.ndarray:
    """Return the obstacle that contains the device at each tool pose (N,), '' if no obstacle does."""
    out, places = np.full(len(tool.position), SEEN, dtype=object), device.find_places(tool)
    if places is None:
        return out
    for solid in around.obstacles:
        if solid.blocks == "robot":
            out[(solid.distance(places) < 0) & (out == SEEN)] = solid.name
    return out


def find_occlusions(
    device: MeasuringDevice, tool: Poses, q: np.ndarray, around: Surroundings, machine: WorkspaceModel | None
) -> np.ndarray:
    """Return the reason why the target is hidden at each pose (N,), `hidden by` and the solid; '' if it is not hidden.

    Args:
        device: The measuring device.
        tool: Tool poses (N).
        q: Actuated positions there (N, na).
        around: Obstacles; zones that only the tool must keep out of do not block the view.
        machine: The robot, whose own solids may hide the target; None leaves them out.
    """
    out, places = np.full(len(q), SEEN, dtype=object), device.find_places(tool)
    if places is None or not len(q):
        return out
    solids = [(o.name, build_standing_solid(o.shape, o.placement)) for o in around.obstacles if o.blocks == "robot"]
    if machine is not None:
        bodies = zip(machine.bodies, machine.solids(q, tool), strict=True)
        solids += [
            (f"the robot's own {body.name}", solid) for body, solid in bodies if not _carries(body.joint, machine)
        ]
    marks = device.marks(tool)
    for k in range(marks.shape[1]):
        beam = _beam(places, marks[:, k])
        for name, solid in solids:
            left = np.flatnonzero(out == SEEN)
            if len(left):
                hit = np.broadcast_to(find_collisions(beam.take(left), solid.take(left)), len(left))
                out[left[hit]] = f"hidden by {name}"
    return out


def _beam(places: np.ndarray, marks: np.ndarray) -> PlacedSolid:
    along = marks - places
    size = np.linalg.norm(along, axis=1, keepdims=True)
    end = places + along * np.maximum(1 - _FREE / np.maximum(size, 1e-9), 0.0)
    return build_capsule(_BEAM, float(size.max(initial=1e-6)), places, end)


def _carries(joint: int, machine: WorkspaceModel) -> bool:
    """Return whether a body is the tool's own link, which holds the target."""
    robot = machine.robot
    frame = robot.tool_frame if robot.tool_frame is not None else robot.model.nframes - 1
    return robot.model.frames[frame].parentJoint == joint


_HELP = {
    "nearer": "a device farther away",
    "farther": "a device nearer to the robot",
    "pattern not wholly": "a wider lens, a smaller pattern, or a camera farther away",
    "pattern seen from behind": "a pattern that faces the camera",
    "pattern seen at": "a pattern that faces the camera",
    "behind": "a camera that looks at the robot",
    "reflector": "a reflector that faces the tracker",
    "below": "a tracker at a lower or farther place",
    "above": "a tracker at a higher or farther place",
    "hidden": "another place for the device, or fewer obstacles",
}


@dataclass(frozen=True, eq=False)
class MeasurablePoses:
    """Poses that one device or fixture may measure.

    Attributes:
        q: Actuated positions (N, na).
        start: Position from which each is approached (N, na): itself, unless it is a touch.
        tool: Tool poses (N).
        noise: Covariance of the measurements (N, m, m).
        index: Index of each among the poses in reach, or of the pose from which its search started (N,).
        reasons: Reasons why other poses are excluded, with their number, most frequent first.
    """

    q: np.ndarray
    start: np.ndarray
    tool: Poses
    noise: np.ndarray
    index: np.ndarray
    reasons: dict[str, int]


@dataclass(frozen=True, eq=False)
class Visible:
    """Candidates that a device sees.

    Attributes:
        index: Indices of the reachable poses that the device sees (n,).
        reasons: Reasons why the others are not seen, with their number, most frequent first.
    """

    index: np.ndarray
    reasons: dict[str, int]


def find_visible(
    device: MeasuringDevice, poses: Reachable, around: Surroundings, machine: WorkspaceModel | None
) -> Visible:
    """Return which poses a device sees.

    Args:
        device: The device.
        poses: Poses that the robot may take.
        around: Obstacles that may block the view.
        machine: The robot, whose own solids may hide the target; None leaves them out.

    Raises:
        InputError: The device is inside an obstacle.
        CannotAnswer: It sees no pose; the message names the most frequent reason.
    """
    blocking = find_blocking(device, poses.tool, around)
    if (blocking != SEEN).all():
        place = ", ".join(f"{x:g}" for x in np.asarray(device.find_places(poses.tool))[0])
        raise InputError(
            "invalid_value",
            f"the {device.name} at ({place}) m is inside the obstacle '{blocking[0]}'; move one of them",
        )
    why = device.reasons(poses.tool)
    why = np.where((why == SEEN) & (blocking != SEEN), "in " + blocking, why)
    left = np.flatnonzero(why == SEEN)
    why[left] = find_occlusions(device, poses.tool.take(left), poses.q[left], around, machine)
    index = np.flatnonzero(why == SEEN)
    reasons = dict(Counter(why[why != SEEN].tolist()).most_common())
    if not len(index):
        word = next(iter(reasons))
        remedy = next((text for start, text in _HELP.items() if word.startswith(start)), "another place for the device")
        raise CannotAnswer(
            "not_visible",
            f"the {device.name} sees none of the {poses.n} poses in reach (mostly: {word}, {reasons[word]} of them)",
            remedy,
        )
    return Visible(index, reasons)
