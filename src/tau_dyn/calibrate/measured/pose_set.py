"""Measured poses: actuated positions and the measurement of the tool there by a device or a fixture, in its own frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tau_dyn.calibrate.measured.kinds import (
    ENCODERS,
    KINDS,
    TOUCHES,
    compute_position_residuals,
    invert_columns,
    invert_poses,
    project_columns,
)
from tau_dyn.exceptions import InputError
from tau_dyn.log import format_names
from tau_dyn.mechanism import Poses
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import Brief

_MAX_JOINT_DIFFERENCE = 1e-6  # [rad or m]; encoders of a robot at rest repeat far better


def measure_spread(position: np.ndarray) -> float:
    """Return the rms distance of positions (N, 3) from their middle [m]."""
    return float(np.sqrt(np.sum(np.var(position, axis=0))))


@dataclass(frozen=True, eq=False)
class PoseSet(Brief):
    """Measured poses.

    Attributes:
        q: Actuated positions (N, na) [m or rad].
        position: Position of the tool or target in the device's frame (N, 3) [m]; a distance, or an encoder's arc or travel, is
            in the first coordinate, and a touching target is at zero.
        rotation: Rotation matrices (N, 3, 3), None if only positions were measured; the identity for an encoder.
        names: Name of each pose in messages (N,), such as `poses.csv, line 12`.
        campaign: Which measuring campaign each pose belongs to (N,), from 0; frames may have moved in between.
        campaigns: Names of the campaigns.
        target: Which target on the tool each pose was measured at (N,), from 0.
        targets: Names of the targets.
        device: Which device or fixture each pose was measured by (N,), from 0.
        devices: Names of the devices and fixtures; an encoder has the name of its joint.
        kinds: Kind of measurement of each device or fixture, a name of `KINDS`.
        device_errors: Standard error of each of them over that of all (devices,); ones unless estimated.
        approach: Side from which each actuated joint came (N, na): +1, -1, or 0 if unknown.
        speed: Speed of each actuated joint at the pose (N, na) [m/s or rad/s]; zero if it did not move or the speed is unknown.
        acceleration: The same (N, na) [m/s^2 or rad/s^2].
        jerk: The same (N, na) [m/s^3 or rad/s^3]; known with the acceleration, of a recording.
        loads: Weight that hangs at the tool [kg], force [N] and moment [N m] on it in the robot's base axes (N, 7).
        position_stderr: Standard errors of the measured coordinates (N, 3) [m], None if not stated.
        rotation_stderr: Standard error of the measured orientation about each axis (N,) [rad], None if not stated.
        angles: Three numbers of the orientation as written (N, 3), which `rotation` takes for rotation vectors; None if four
            numbers or no orientations are given.
        arc_radius: Radius at which angles of passive joints count as arcs [m].
        source: File, for messages.
        sha256: Hash of the file, '' if there is no file.
        warnings: Warnings about doubtful data.
    """

    q: np.ndarray
    position: np.ndarray
    rotation: np.ndarray | None = None
    names: tuple[str, ...] = ()
    campaign: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    campaigns: tuple[str, ...] = ("1",)
    target: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    targets: tuple[str, ...] = ("1",)
    device: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    devices: tuple[str, ...] = ("1",)
    kinds: tuple[str, ...] = ("pose",)
    device_errors: tuple[float, ...] = ()
    approach: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    speed: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    jerk: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    loads: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))
    position_stderr: np.ndarray | None = None
    rotation_stderr: np.ndarray | None = None
    angles: np.ndarray | None = None
    arc_radius: float = 1.0
    source: str = "poses"
    sha256: str = ""
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Fill in missing fields and refuse fields that do not fit together."""
        n = len(self.q)
        if np.ndim(self.q) != 2 or np.shape(self.position) != (n, 3):
            raise InputError(
                "wrong_shape",
                f"poses need q (N, na) and positions (N, 3), not {np.shape(self.q)} and {np.shape(self.position)}",
            )
        if self.rotation is not None and np.shape(self.rotation) != (n, 3, 3):
            raise InputError("wrong_shape", f"rotations of poses must be ({n}, 3, 3), not {np.shape(self.rotation)}")
        if not self.names:
            object.__setattr__(self, "names", tuple(f"pose {k + 1}" for k in range(n)))
        if len(self.campaign) != n:
            object.__setattr__(self, "campaign", np.zeros(n, int))
        if len(self.target) != n:
            object.__setattr__(self, "target", np.zeros(n, int))
        if len(self.device) != n:
            object.__setattr__(self, "device", np.zeros(n, int))
        if len(self.loads) != n:
            object.__setattr__(self, "loads", np.zeros((n, 7)))
        for name in ("approach", "speed", "acceleration", "jerk"):
            if getattr(self, name).shape != np.shape(self.q):
                object.__setattr__(self, name, np.zeros(np.shape(self.q)))

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.q)

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return self.q.shape[1]

    @property
    def spread(self) -> float:
        """Rms distance of the positions from their middle [m]."""
        return measure_spread(self.position)

    @property
    def configuration(self) -> np.ndarray:
        """Which poses have the same joint positions, such as several targets seen from one or repeats (N,), from 0.

        Numbered by the positions, so that parts drawn of them do not depend on the order of rows.
        """
        return np.unique(np.round(self.q / _MAX_JOINT_DIFFERENCE), axis=0, return_inverse=True)[1].ravel()

    @property
    def setup(self) -> np.ndarray:
        """Which device frame and which target frame each pose has (N, 2).

        One target may move between campaigns. Several devices each have a frame of their own in every campaign.
        """
        if len(self.devices) > 1:
            return np.column_stack([self.device * len(self.campaigns) + self.campaign, self.target])
        return np.column_stack([self.campaign, self.target if len(self.targets) > 1 else self.campaign])

    @property
    def frame_kinds(self) -> tuple[str, ...]:
        """Kind of each device frame: one of every device, or one of several devices in every campaign."""
        n = len(self.campaigns) if len(self.devices) > 1 else 1
        return tuple(kind for kind in self.kinds for _ in range(n))

    @property
    def measures_poses(self) -> bool:
        """Whether all measurements are poses or positions."""
        return all(kind == "pose" for kind in self.kinds)

    @property
    def shows_frames(self) -> bool:
        """Whether one device measures poses or positions, in a frame of its own that they show; on the tool or off it."""
        return set(self.kinds) <= {"pose", "hand_eye"} and len(self.devices) == 1

    @property
    def touches(self) -> np.ndarray:
        """Whether each measurement is a touch of the target (N,)."""
        return np.array([kind in TOUCHES for kind in self.kinds])[self.device]

    @property
    def numbers(self) -> np.ndarray:
        """Independent numbers of each measured position (N,): 3, or 1 of a distance, a plane or a ball."""
        return np.array([KINDS[kind].numbers for kind in self.kinds])[self.device]

    @property
    def of_encoders(self) -> np.ndarray:
        """Whether each row (N,) is a measurement by an encoder of a passive joint, not of the tool."""
        return np.array([kind in ENCODERS for kind in self.kinds])[self.device]

    def hides_size(self, position_units: Sequence[str]) -> bool:
        """Return whether no measurement shows the robot's size: touches, or angles between drives that turn.

        Args:
            position_units: Units of the actuated joints, `m` or `rad` each.
        """
        turns = set(position_units) == {"rad"}
        sizeless = [kind in TOUCHES or (kind == "angle" and turns) for kind in self.kinds]
        return bool(np.all(np.array(sizeless)[self.device]))

    @property
    def length_factors(self) -> np.ndarray:
        """Effect of a unit of the device's length in each measurement (N,) [m]: the radius of an angle's arc, or 1."""
        return np.array([self.arc_radius if kind == "angle" else 1.0 for kind in self.kinds])[self.device]

    def count_numbers(self, m: int) -> np.ndarray:
        """Return the independent numbers of each pose (N,) of `m` coordinates, 3 or 6."""
        return self.numbers + np.where(self.of_encoders, 0, m - 3)

    @property
    def from_tool(self) -> np.ndarray:
        """Whether a camera on the tool measured each pose (N,)."""
        return np.array([kind == "hand_eye" for kind in self.kinds])[self.device]

    def as_poses(self) -> PoseSet:
        """Return the set with the observations of cameras on the tool as poses of the target in a stationary frame."""
        if not self.from_tool.any() or self.rotation is None:
            return self
        position, rotation = self._invert(Poses(self.position, self.rotation))
        kinds = tuple("pose" if kind == "hand_eye" else kind for kind in self.kinds)
        return replace(self, position=position, rotation=rotation, kinds=kinds)

    def as_seen_from_tool(self) -> PoseSet:
        """Return poses as a camera on the tool measures them."""
        known = replace(self, kinds=tuple("hand_eye" if kind == "pose" else kind for kind in self.kinds))
        assert self.rotation is not None
        position, rotation = known._invert(Poses(self.position, self.rotation))
        return replace(known, position=position, rotation=rotation)

    def expect(self, seen: Poses) -> Poses:
        """Return the predicted measurements from the target's predicted poses in the frames of the devices (N)."""
        return Poses(*self._invert(seen)) if self.from_tool.any() else seen

    def compute_position_residuals(self, seen: Poses, lengths: np.ndarray) -> np.ndarray:
        """Return measured minus predicted positions (N, 3) [m], along the measured direction.

        Args:
            seen: The target's predicted poses in the frames of the devices (N).
            lengths: Offset or radius of each measurement (N,) [m], or the zero of an encoder [rad or m].
        """
        seen, lengths = self.expect(seen), lengths * self.length_factors
        return compute_position_residuals(self.kinds, self.device, self.position, seen.position, lengths)

    def project_columns(self, seen: Poses, columns: np.ndarray) -> np.ndarray:
        """Return derivatives (N, 6, p) of the measurements from those of the target's pose, predicted at `seen` (N)."""
        if self.from_tool.any():
            columns = np.where(self.from_tool[:, None, None], invert_columns(seen, columns), columns)
        return project_columns(self.kinds, self.device, seen.position, columns)

    def _invert(self, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and rotations, inverted where a camera on the tool measures."""
        back = invert_poses(poses)
        position = np.where(self.from_tool[:, None], back.position, poses.position)
        return position, np.where(self.from_tool[:, None, None], back.rotation, poses.rotation)

    @property
    def poses(self) -> Poses:
        """Position and rotation; without measured orientation the rotations are nan."""
        rotation = np.full((self.n, 3, 3), np.nan) if self.rotation is None else self.rotation
        return Poses(self.position, rotation)

    def take(self, index: np.ndarray) -> PoseSet:
        """Return the poses at an index (n,) or a mask (N,)."""
        index = np.arange(self.n)[index]
        return replace(
            self,
            q=self.q[index],
            position=self.position[index],
            rotation=None if self.rotation is None else self.rotation[index],
            names=tuple(self.names[k] for k in index),
            campaign=self.campaign[index],
            target=self.target[index],
            device=self.device[index],
            approach=self.approach[index],
            speed=self.speed[index],
            acceleration=self.acceleration[index],
            jerk=self.jerk[index],
            loads=self.loads[index],
            position_stderr=None if self.position_stderr is None else self.position_stderr[index],
            rotation_stderr=None if self.rotation_stderr is None else self.rotation_stderr[index],
            angles=None if self.angles is None else self.angles[index],
        )

    def relative_errors(self, m: int, over: PoseSet | None = None) -> np.ndarray:
        """Return standard errors (N, m) over their median, position before orientation, as stated and by device.

        Args:
            m: Numbers of a pose, 3 or 6.
            over: Poses that give the median, such as those from which a noise was estimated; this set by default.
        """
        out, known = np.ones((self.n, m)), self if over is None else over
        if self.position_stderr is not None and known.position_stderr is not None:
            out[:, :3] = self.position_stderr / np.median(known.position_stderr)
        if self.rotation_stderr is not None and known.rotation_stderr is not None and m > 3:
            out[:, 3:] = (self.rotation_stderr / np.median(known.rotation_stderr))[:, None]
        if self.device_errors:
            out *= np.array(self.device_errors)[self.device, None]
        return out

    def split_encoders(self) -> tuple[PoseSet | None, PoseSet]:
        """Return the measurements of the tool (None if it was not measured) and those of encoders of passive joints."""
        rows = self.of_encoders
        if rows.all():
            return None, self
        own = np.array([kind not in ENCODERS for kind in self.kinds])
        tool = self.take(~rows)
        tool = replace(
            tool,
            device=np.cumsum(own)[tool.device] - 1,
            devices=tuple(name for name, keep in zip(self.devices, own, strict=True) if keep),
            kinds=tuple(kind for kind, keep in zip(self.kinds, own, strict=True) if keep),
        )
        return tool, replace(self.take(rows), warnings=())

    def with_devices_of(self, known: PoseSet) -> PoseSet:
        """Return the set with the devices and their standard errors of another set, whose numbering it follows.

        Devices that the other set lacks have the standard error of its devices of their kind, or else of all.
        """
        more = self.devices[len(known.devices) :] if self.device.max(initial=0) >= len(known.devices) else ()
        kinds, errors = (*known.kinds, *self.kinds[len(known.kinds) :]), known.device_errors
        if errors and more:
            by_kind = {kind: error for kind, error in zip(known.kinds, errors, strict=True)}
            errors = (*errors, *(by_kind.get(kind, 1.0) for kind in kinds[len(errors) :]))
        return replace(
            self, devices=(*known.devices, *more), kinds=kinds[: len(known.kinds) + len(more)], device_errors=errors
        )

    def without_rotation(self) -> PoseSet:
        """Return the set without orientations."""
        return replace(self, rotation=None)


def number_alike(poses: PoseSet, holdout: PoseSet) -> PoseSet:
    """Return held-out poses with the training poses' numbering of campaigns, targets and devices.

    A distance or a touch at a place that the training poses do not contain becomes a further device, with a warning.

    Raises:
        InputError: A campaign, a target or a tracker is unknown, or a device measures another quantity.
    """
    campaign = _renumber(holdout, "campaign", holdout.campaign, holdout.campaigns, poses.campaigns)
    target = _renumber(holdout, "target", holdout.target, holdout.targets, poses.targets)
    alone = (
        len(poses.devices) == len(holdout.devices) == 1
        and poses.kinds == holdout.kinds
        and not _can_be_placed(poses.kinds[0])
    )
    names = poses.devices if alone else holdout.devices  # a single tracker matches whatever it is called
    for name, kind in zip(names, holdout.kinds, strict=True):
        known = dict(zip(poses.devices, poses.kinds, strict=True))
        if known.get(name, kind) != kind:
            raise InputError(
                "mismatch", f"{holdout.source}: device {name} measures {kind}, {known[name]} in the training poses"
            )
    new = [(n, kind) for n, kind in zip(names, holdout.kinds, strict=True) if n not in poses.devices]
    for name, kind in new:
        if not _can_be_placed(kind):
            raise _unknown(holdout, "device", name, poses.devices)
    devices = (*poses.devices, *(name for name, _ in new))
    said = [CodedWarning("new_place", _describe_new_places([name for name, _ in new], holdout.source))] if new else []
    numbered = replace(
        holdout,
        campaign=campaign,
        campaigns=poses.campaigns,
        target=target,
        targets=poses.targets,
        device=np.array([devices.index(name) for name in names])[holdout.device],
        devices=devices,
        kinds=(*poses.kinds, *(kind for _, kind in new)),
        warnings=(*holdout.warnings, *said),
    )
    return numbered.with_devices_of(poses)


def _can_be_placed(kind: str) -> bool:
    """Return whether measurements of one kind alone determine the place of its device or fixture."""
    return kind == "distance" or kind in TOUCHES


def _describe_new_places(names: Sequence[str], source: str) -> str:
    verb, owner = ("is", "its") if len(names) == 1 else ("are", "their")
    return (
        f"{source}: {format_names(names)} {verb} not among the training poses; each held-out row there is judged by the place "
        f"that {owner} other rows show, so an error common to them all is not seen"
    )


def _renumber(
    holdout: PoseSet, kind: str, number: np.ndarray, names: tuple[str, ...], known: tuple[str, ...]
) -> np.ndarray:
    """Return the index (N,) of each name among the known ones; a single name matches a single known one whatever it is called."""
    if len(known) == 1 and len(names) == 1:
        return number
    for name in names:
        if name not in known:
            raise _unknown(holdout, kind, name, known)
    return np.array([known.index(name) for name in names])[number]


def _unknown(holdout: PoseSet, kind: str, name: str, known: Sequence[str]) -> InputError:
    return InputError(
        "mismatch",
        f"{holdout.source}: {kind} {name} is not among the training poses' {kind}s ({', '.join(known)}), "
        "so its place is unknown; add some poses of it to the training poses, or calibrate with all poses and without --holdout",
    )


def join_pose_sets(sets: Sequence[PoseSet]) -> PoseSet:
    """Return the poses of several files as one set; campaigns of one name are one campaign, and so are targets and devices.

    Raises:
        InputError: Some have orientations, others not; or a device measures different quantities.
    """
    if len(sets) == 1:
        return sets[0]
    turned = [s.rotation is not None for s in sets]
    if any(turned) and not all(turned):
        raise InputError(
            "mismatch",
            f"{sets[turned.index(False)].source} has no orientations, {sets[turned.index(True)].source} has; give one kind",
        )
    campaign, campaigns = _join_words([(s.campaign, s.campaigns) for s in sets])
    target, targets = _join_words([(s.target, s.targets) for s in sets])
    device, devices = _join_words([(s.device, s.devices) for s in sets])
    kinds = {name: kind for s in sets for name, kind in zip(s.devices, s.kinds, strict=True)}
    for s in sets:
        for name, kind in zip(s.devices, s.kinds, strict=True):
            if kinds[name] != kind:
                raise InputError(
                    "mismatch", f"{s.source}: device {name} measures {kind}, in another file {kinds[name]}"
                )
    return PoseSet(
        q=np.concatenate([s.q for s in sets]),
        position=np.concatenate([s.position for s in sets]),
        rotation=np.concatenate([s.rotation for s in sets if s.rotation is not None]) if all(turned) else None,
        names=tuple(name for s in sets for name in s.names),
        campaign=campaign,
        campaigns=campaigns,
        target=target,
        targets=targets,
        device=device,
        devices=devices,
        kinds=tuple(kinds[name] for name in devices),
        approach=np.concatenate([s.approach for s in sets]),
        speed=np.concatenate([s.speed for s in sets]),
        acceleration=np.concatenate([s.acceleration for s in sets]),
        jerk=np.concatenate([s.jerk for s in sets]),
        loads=np.concatenate([s.loads for s in sets]),
        position_stderr=_join_stated(sets, "position_stderr"),
        rotation_stderr=_join_stated(sets, "rotation_stderr"),
        angles=_join_stated(sets, "angles"),
        arc_radius=next((s.arc_radius for s in sets if s.of_encoders.any()), 1.0),
        source=", ".join(s.source for s in sets),
        warnings=tuple(w for s in sets for w in s.warnings),
    )


def _join_words(parts: Sequence[tuple[np.ndarray, tuple[str, ...]]]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a common numbering of names that each file numbers separately, and the names."""
    names = tuple(dict.fromkeys(name for _, words in parts for name in words))
    return np.concatenate([np.array([names.index(name) for name in words])[number] for number, words in parts]), names


def _join_stated(sets: Sequence[PoseSet], name: str) -> np.ndarray | None:
    """Return numbers that files state for each row; None unless all do. Encoders count as the median."""
    parts = [getattr(one, name) for one in sets]
    known = [part for part in parts if part is not None]
    if not known or any(part is None and not one.of_encoders.all() for part, one in zip(parts, sets, strict=True)):
        return None
    middle = np.median(np.concatenate(known), axis=0)
    rows = [
        np.broadcast_to(middle, (one.n, *middle.shape)) if part is None else part
        for part, one in zip(parts, sets, strict=True)
    ]
    return np.concatenate(rows)
