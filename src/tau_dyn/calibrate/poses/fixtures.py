r"""Distances, pins in holes, touched planes and balls in the place of a device: read from YAML, reached, and simulated.

A distance (wire, ball bar, interferometer) is measured wherever no obstacle is in between. A touch is a joint position at which
the target is on the fixture: Newton's method solves `|p(q)| = radius` of a ball, `z(q) = 0` of a plane, `p(q) = 0` of a hole, by
the shortest step of the joints. The robot approaches from outwards, and only the last move may come near the obstacle to which
the fixture belongs.

Files have lengths in m, approximate places in the robot's base frame, normals out of plane and hole, targets in the tool frame:

    target: [0, 0, 0.1]
    fixtures:
      - {kind: distance, name: wire, position: [1.5, 0.2, 0.4], noise: 20e-6}
      - {kind: hole, name: A, position: [0.6, 0.1, 0.2], normal: [0, 0, 1], noise: 30e-6, obstacle: table}
      - {kind: plane, name: plate, position: [0.5, 0.3, 0.2], normal: [0, 0, 1], noise: 20e-6}
      - {kind: sphere, name: ball, position: [0.4, -0.3, 0.3], radius: 0.0127, noise: 20e-6, target: [0.02, 0, 0.1]}
      - {kind: encoder, name: elbow, noise: 50e-6}

An encoder of a passive joint is read at any pose of the robot; its noise is in rad, or in m for a slide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import (
    ENCODERS,
    KINDS,
    TOUCHES,
    PassiveEncoders,
    PoseSet,
    find_directions,
    predict_measured,
)
from tau_dyn.calibrate.measured.kinds import project_columns
from tau_dyn.calibrate.poses.camera import FilePart, build_target_frame
from tau_dyn.calibrate.poses.devices import SEEN, move_joints, transform_to_base, transform_to_device
from tau_dyn.calibrate.poses.reachable import MeasurablePoses, Reachable, Safety
from tau_dyn.calibrate.poses.tour import PathCheck
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.files import read_yaml
from tau_dyn.kinematics.workspace import PoseRequirements, get_travel
from tau_dyn.log import format_names
from tau_dyn.mechanism import Poses
from tau_dyn.robot import Robot

PLANNED = ("distance", *TOUCHES, "encoder")
"""Kinds of fixtures in a file."""
_SMALL = 1e-3  # ratio of singular values below which a direction is left alone
_TOUCHES_M = 1e-9  # [m] gap at which the target touches
_BEHIND_M = 1e-6  # [m] by which the tool frame may be behind the surface: rounding
_MIN_DIFFERENCE = 1e-4  # [m or rad] below which two touches are one: three axes reach a hole in one way
_MAX_APPROACH = 0.5  # [m or rad] of a joint on the last move; longer moves approach from another direction
_MIN_RETRACT_M = 0.02
"""Least distance from which a fixture is approached [m]: nominal dimensions are off by about 10 mm."""


@dataclass(frozen=True, eq=False)
class Fixture:
    """A device that measures a distance, or an object that the target touches; a `MeasuringDevice`.

    Attributes:
        kind: A name of `PLANNED`, or `angle` or `travel` of an encoder whose joint is known.
        label: Name given by the user; for an encoder the name of its joint.
        pose: Its pose in the robot's base frame, z out of a plane or a hole.
        on_tool: The target in the tool frame.
        noise: Standard deviation of the distance, or of each coordinate in which a touching target deviates [m]; for an encoder
            [rad or m], or of its arc [m] if its joint is known.
        radius: Radius of a ball [m].
        obstacle: The obstacle to which it belongs, which its touches may come near.
    """

    kind: str
    label: str
    pose: Frame
    on_tool: Frame
    noise: float
    radius: float = 0.0
    obstacle: str = ""

    @property
    def name(self) -> str:
        """Its name as `read_poses` forms it."""
        return f"{self.kind} {self.label}" if self.kind in TOUCHES else self.label

    @property
    def frames(self) -> DeviceFrames:
        """The base in the fixture's frame, the target on the tool, the kind and the radius."""
        return DeviceFrames((self.pose.inverse,), (self.on_tool,), (self.kind,), (self.radius,))

    @property
    def turned(self) -> bool:
        """Whether it measures orientations, which is False."""
        return False

    def find_places(self, tool: Poses) -> np.ndarray | None:
        """Return from where a distance is measured (N, 3) [m]; a touch needs no line of sight."""
        if self.kind != "distance":
            return None
        return np.repeat(self.pose.translation[None], len(tool.position), axis=0)

    @property
    def cells(self) -> dict[str, str]:
        """Cells of a measurement file that name the fixture, by column."""
        if self.kind in ENCODERS:
            return {f"q_{self.label}": ""}
        return {"device" if self.kind == "distance" else self.kind: self.label}

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return '' for every pose (N,)."""
        return np.full(len(tool.position), SEEN, dtype=object)

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the target (N, 1, 3) [m] in the robot's base frame."""
        return transform_to_base(self.frames, tool).position[:, None]

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance (N, 3, 3) [m^2], which is equal along all axes."""
        return np.repeat(self.noise**2 * np.eye(3)[None], len(tool.position), axis=0)

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return the distance in the first coordinate, zeros of a touch, and the target's orientation."""
        at = transform_to_device(self.frames, tool)
        position = np.zeros_like(at.position)
        if self.kind == "distance":
            position[:, 0] = np.linalg.norm(at.position, axis=1) + self.noise * rng.standard_normal(len(position))
        return Poses(position, at.rotation)


@dataclass(frozen=True, eq=False)
class FixtureSet:
    """Devices and fixtures of one campaign.

    Attributes:
        fixtures: All of them.
        arc_radius: Radius at which angles of passive joints count as arcs [m].
    """

    fixtures: tuple[Fixture, ...]
    arc_radius: float = 1.0

    def find_joints(self, robot: Robot) -> FixtureSet:
        """Return the set with the encoders on joints of a robot.

        Raises:
            InputError: A joint is driven, or the robot has no loops; or UnknownName, there is no such joint.
        """
        names = [fixture.label for fixture in self.fixtures if fixture.kind == "encoder"]
        if not names:
            return self
        known = PassiveEncoders.of(robot, names)
        target = next((one.on_tool for one in self.fixtures if one.kind != "encoder"), IDENTITY)

        def find_joint(one: Fixture) -> Fixture:
            kind = known.kinds[one.label]
            arc = known.arc_radius if kind == "angle" else 1.0
            return replace(
                one, kind=kind, noise=arc * one.noise, on_tool=target
            )  # a target more would be one unknown more

        found = (find_joint(one) if one.kind == "encoder" else one for one in self.fixtures)
        return FixtureSet(tuple(found), known.arc_radius)

    @property
    def name(self) -> str:
        """Names of the devices and fixtures."""
        return format_names([fixture.name for fixture in self.fixtures])

    @property
    def has_encoders(self) -> bool:
        """Whether passive joints have encoders."""
        return any(fixture.kind in ENCODERS for fixture in self.fixtures)

    @cached_property
    def _targets(self) -> tuple[list[Frame], np.ndarray]:
        """Different targets, and which of them each fixture has."""
        places = np.array([fixture.on_tool.translation for fixture in self.fixtures])
        _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))
        return [self.fixtures[k].on_tool for k in np.sort(first)], rank[number.ravel()]

    @property
    def frames(self) -> DeviceFrames:
        """All devices and targets."""
        device = tuple(fixture.pose.inverse for fixture in self.fixtures)
        kinds, lengths = tuple(f.kind for f in self.fixtures), tuple(f.radius for f in self.fixtures)
        return DeviceFrames(device, tuple(self._targets[0]), kinds, lengths)

    def build_pose_set(self, q: np.ndarray, number: np.ndarray) -> PoseSet:
        """Return poses at positions (N, na) of the devices or fixtures numbered (N,), without measured values."""
        targets, own = self._targets
        return PoseSet(
            q,
            np.zeros((len(q), 3)),
            target=own[number],
            targets=tuple(str(k + 1) for k in range(len(targets))),
            device=number,
            devices=tuple(fixture.name for fixture in self.fixtures),
            kinds=tuple(fixture.kind for fixture in self.fixtures),
            arc_radius=self.arc_radius,
        )

    def get_cells(self, poses: PoseSet) -> list[dict[str, str]]:
        """Return the cells of a measurement file that name the fixture and the target of each pose."""
        target = [{"target": poses.targets[k]} if len(poses.targets) > 1 else {} for k in poses.target]
        return [self.fixtures[k].cells | more for k, more in zip(poses.device, target, strict=True)]

    def simulate(self, geometry: Geometry, theta: np.ndarray, poses: PoseSet, rng: np.random.Generator) -> PoseSet:
        """Return measurements of a robot with parameters `theta` (p,) at planned poses; touches are reached by jogging.

        Raises:
            CannotAnswer: The robot does not reach a fixture from its planned place.
        """
        noise = np.array([fixture.noise for fixture in self.fixtures])
        off = noise[poses.device, None] * rng.standard_normal((poses.n, 3))
        touched = np.flatnonzero(poses.touches)
        q = poses.q.copy()
        if len(touched):
            q[touched], ok = reach_fixtures(geometry, theta, self.frames, poses.take(touched), off[touched])
            if not ok.all():
                name = poses.devices[poses.device[touched[int(np.argmin(ok))]]]
                raise CannotAnswer(
                    "no_solution",
                    f"a robot whose dimensions are off by their usual size does not reach {name} from a chosen pose",
                    f"another place for {name}, or dimensions that are known better",
                )
        seen = self.frames.measured(predict_measured(geometry, theta, poses, q).poses, poses.setup).position
        read = ~poses.touches
        position = np.zeros((poses.n, 3))
        told = np.where(poses.of_encoders, seen[:, 0], np.linalg.norm(seen, axis=1))
        position[read, 0] = told[read] + off[read, 0]
        errors = tuple(float(x) for x in noise / noise[0]) if len(noise) > 1 else ()
        return replace(poses, q=q, position=position, device_errors=errors, source="simulated measurement")


def reach_fixtures(
    geometry: Geometry, theta: np.ndarray, frames: DeviceFrames, poses: PoseSet, off: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions (N, na) nearest to those of poses at which the target touches, and whether it does (N,).

    Args:
        geometry: The mechanism.
        theta: Its parameters (p,).
        frames: Fixtures and targets.
        poses: Start poses, and the fixture that each touches.
        off: Displacement of the target from its touching position (N, 3) [m]: the first number outwards of a plane or a ball,
            three in a hole's frame.
    """
    one = poses.numbers == 1

    def find_gap(q: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own = poses.take(k)
        found = geometry.forward(theta, q)
        seen = frames.measured(found.poses, own.setup)
        outwards = find_directions(own.kinds, own.device, seen.position)
        miss = own.compute_position_residuals(seen, frames.lengths_of(own.setup))
        miss += np.where(one[k, None], outwards * off[k, :1], off[k])
        twist = frames.carried(found.poses, geometry.tool_by_joint(theta, q, found.poses), own.setup)[:, :3]
        return np.where(found.ok[:, None], miss, np.nan), project_columns(own.kinds, own.device, seen.position, twist)

    return move_joints(poses.q, find_gap, _TOUCHES_M, _SMALL)


def find_touches(
    fixture: Fixture,
    geometry: Geometry,
    reach: Reachable,
    check: PathCheck,
    demands: PoseRequirements,
    safety: Safety,
) -> MeasurablePoses:
    """Return joint positions at which the nominal robot touches a fixture and may do so, from those in reach.

    Args:
        fixture: The fixture to be touched.
        geometry: The mechanism at its nominal parameters.
        reach: Poses from which the search starts.
        check: Check of the place from which the fixture is approached, and of the tour.
        demands: Conditions that touches themselves must satisfy, without the obstacle to which the fixture belongs.
        safety: Margins of the travel, and how far outwards the approach starts.

    Raises:
        CannotAnswer: The fixture cannot be touched; the message names the most frequent reason.
    """
    theta, frames = geometry.parameters.values, fixture.frames
    start = PoseSet(reach.q, np.zeros((reach.n, 3)), devices=(fixture.name,), kinds=(fixture.kind,))
    q, ok = reach_fixtures(geometry, theta, frames, start, np.zeros((reach.n, 3)))
    away = max(safety.distance, _MIN_RETRACT_M) * (np.eye(3)[2] if KINDS[fixture.kind].numbers == 3 else np.eye(3)[0])
    before, free = reach_fixtures(geometry, theta, frames, replace(start, q=q), np.repeat(away[None], reach.n, axis=0))
    low, high = get_travel(check.machine.robot)
    room = safety.travel * (high - low)
    tool = geometry.forward(theta, q).poses
    near = PathCheck(check.machine, demands)
    why = np.full(reach.n, SEEN, dtype=object)
    rules = (
        ("out of reach", lambda left: ~ok[left]),
        ("actuator limit", lambda left: ~((q[left] >= low + room) & (q[left] <= high - room)).all(axis=1)),
        ("tool behind the surface", lambda left: _is_behind(fixture, tool.position[left])),
        ("no way back from it", lambda left: ~(free & (np.abs(before - q).max(axis=1) < _MAX_APPROACH))[left]),
        ("", lambda left: near.reasons(q[left])),
        ("", lambda left: check.reasons(before[left])),
        ("", lambda left: np.array(near.blocked(before[left], q[left]), dtype=object)),
    )
    for word, find in rules:
        left = np.flatnonzero(why == SEEN)
        if len(left):
            found = find(left)
            why[left] = np.where(found, word, SEEN) if word else found
    good = np.flatnonzero(why == SEEN)
    good = good[np.unique(np.round(q[good] / _MIN_DIFFERENCE), axis=0, return_index=True)[1]]
    reasons = dict(Counter(why[why != SEEN].tolist()).most_common())
    if not len(good):
        place, word = ", ".join(f"{x:g}" for x in fixture.pose.translation), next(iter(reasons))
        raise CannotAnswer(
            "no_solution",
            f"the robot cannot touch {fixture.name} at ({place}) m from any of {reach.n} positions (mostly: {word}, "
            f"{reasons[word]} of them)",
            f"another place for {fixture.name}, its right normal and target, or smaller safety distances",
        )
    return MeasurablePoses(q[good], before[good], tool.take(good), fixture.covariance(tool.take(good)), good, reasons)


def _is_behind(fixture: Fixture, tool: np.ndarray) -> np.ndarray:
    """Return whether the tool frame (N, 3) [m] is on the far side of a plane, inside a ball, or under a hole."""
    at = tool @ fixture.pose.rotation - fixture.pose.translation @ fixture.pose.rotation
    return (np.linalg.norm(at, axis=1) - fixture.radius if fixture.kind == "sphere" else at[:, 2]) < -_BEHIND_M


def read_fixtures(path: str | Path) -> FixtureSet:
    """Read devices that measure distances, fixtures that the target touches, and encoders of passive joints.

    Raises:
        InputError: Something is missing or no number; the message names the place.
    """
    root = FilePart(read_yaml(path), str(path), {"fixtures", "target"})
    listed: Any = root.content.get("fixtures")
    if not isinstance(listed, list) or not listed:
        root.fault(
            f"'fixtures' must be a list, each with a kind ({', '.join(PLANNED)}), a name, a position and a noise"
        )
    target = root.numbers("target", 3, default=(0.0, 0.0, 0.0))
    found = tuple(_read_fixture(row, f"{path}: fixture {k}", target) for k, row in enumerate(listed, start=1))
    names = [fixture.name for fixture in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        root.fault(f"two fixtures are called '{twice}'; give each its own name")
    return FixtureSet(found)


_KEYS = {
    "distance": (),
    "hole": ("normal", "obstacle"),
    "plane": ("normal", "obstacle"),
    "sphere": ("radius", "obstacle"),
    "encoder": (),
}
"""Keys of each kind in addition to kind, name, position, noise and target."""


def _read_fixture(content: Any, where: str, target: np.ndarray) -> Fixture:
    kind = str(content.get("kind")) if isinstance(content, Mapping) else ""
    placed = set() if kind == "encoder" else {"position", "target"}
    part = FilePart(content, where, {"kind", "name", "noise", *placed, *_KEYS.get(kind, ())})
    if kind not in PLANNED:
        part.fault(f"kind must be one of {', '.join(PLANNED)}, not '{kind}'")
    label = str(part.content.get("name", ""))
    if not label.strip() or any(letter in label for letter in ',"\n\r'):
        part.fault("name must be a word without commas and quotes, by which the file of measurements calls it")
    needed = {"plane": ("noise", "normal"), "sphere": ("noise", "radius")}
    for key in needed.get(kind, ("noise",)):
        if key not in part.content:
            part.fault(f"'{key}' is missing")
    if kind == "encoder":
        return Fixture(kind, label, IDENTITY, IDENTITY, part.number("noise", 0.0, low=1e-9))
    place, rotation = part.numbers("position", 3), np.eye(3)
    if kind in ("plane", "hole"):
        rotation = _turn_outwards(part, part.numbers("normal", 3, default=(0.0, 0.0, 1.0)))
    on_tool = Frame(np.eye(3), part.numbers("target", 3, default=(target[0], target[1], target[2])))
    radius = part.number("radius", 0.0, low=1e-6) if kind == "sphere" else 0.0
    noise, obstacle = part.number("noise", 0.0, low=1e-9), str(part.content.get("obstacle", label))
    return Fixture(kind, label, Frame(rotation, place), on_tool, noise, radius, obstacle)


def _turn_outwards(part: FilePart, normal: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) whose z is a normal."""
    if np.linalg.norm(normal) < 1e-9:
        part.fault(f"normal must have a direction, not {normal.tolist()}")
    return build_target_frame(np.zeros(3), normal, np.eye(3)[np.argmin(np.abs(normal))]).rotation
