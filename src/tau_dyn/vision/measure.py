"""Measured poses from images: read, detect, adjust, match robot positions; a table with standard errors for calibrate."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import format_names
from tau_dyn.message_codes import CodedWarning
from tau_dyn.vision.album import Album, Images, check_cameras, check_some, read_album
from tau_dyn.vision.bundle import Views
from tau_dyn.vision.cameras import Cameras, check_lens
from tau_dyn.vision.images import Detection
from tau_dyn.vision.motion import (
    ImageTimes,
    LogOffset,
    compute_velocity,
    estimate_clock_offset,
    list_uncovered,
)
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.quarter_turns import follow_turns
from tau_dyn.vision.robot_positions import Positions, match_rows
from tau_dyn.vision.solution import CameraSolution, solve

POSE = ("x_tool", "y_tool", "z_tool", "qx_tool", "qy_tool", "qz_tool", "qw_tool")
STDERR = ("x_tool_stderr", "y_tool_stderr", "z_tool_stderr", "rx_tool_stderr", "ry_tool_stderr", "rz_tool_stderr")


def escape_formula(text: str) -> str:
    """Return text for a spreadsheet: an apostrophe precedes text that begins like a formula."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


@dataclass(frozen=True, eq=False)
class CameraPoseTable:
    """Poses of the pattern's centre in the first camera's frame.

    Attributes:
        names: The image of each pose (N,), of the first camera if it saw the plate.
        position: Positions (N, 3) [m].
        rotation: Rotations (N, 3, 3).
        covariance: Covariance (N, 6, 6) of position [m] and rotation vector about the camera's axes [rad].
        own: The part of `covariance` from the pose's own corners; the rest is common to all poses, through cameras and clock.
        seen_by: Number of cameras that saw each pose (N,).
        joints: Names of actuated joints, if robot positions were given.
        q: Robot positions (N, na).
        cameras: The cameras, with uncertainty.
        rms: RMS of all corners' residuals in each camera (c,) [px].
        refused: Image -> reason why it was not used.
        warnings: Doubtful results.
        inputs: Files read.
        time: Time of each pose (N,) [s], by the clock of the log of robot positions if one was given, else of the images; nan
            without times.
        velocity: Velocity of the pattern's centre (N, 3) [m/s]; nan without times.
        joint_velocity: Joint velocities (N, na), if a log of robot positions was given.
        clock: The offset between images and log, if it was estimated.
    """

    names: tuple[str, ...]
    position: np.ndarray
    rotation: np.ndarray
    covariance: np.ndarray
    own: np.ndarray
    seen_by: np.ndarray
    joints: tuple[str, ...]
    q: np.ndarray
    cameras: Cameras
    rms: np.ndarray
    refused: dict[str, str]
    warnings: tuple[str, ...] = ()
    inputs: tuple[Path, ...] = ()
    time: np.ndarray | None = None
    velocity: np.ndarray | None = None
    joint_velocity: np.ndarray | None = None
    clock: LogOffset | None = None

    @property
    def n(self) -> int:
        """Number of poses."""
        return len(self.names)

    @property
    def quaternion(self) -> np.ndarray:
        """Orientation x y z w (N, 4), w >= 0."""
        return Rotation.from_matrix(self.rotation).as_quat(canonical=True)

    @property
    def stderr(self) -> np.ndarray:
        """Standard errors (N, 6) of position [m] and rotation vector [rad]."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @property
    def speed(self) -> np.ndarray | None:
        """Speed of the pattern's centre (N,) [m/s]; None without times."""
        return None if self.velocity is None else np.linalg.norm(self.velocity, axis=1)

    @property
    def common_stderr(self) -> np.ndarray:
        """Standard errors of positions (N,) [m] from cameras and clock, which are common to all poses."""
        common = np.diagonal(self.covariance - self.own, axis1=1, axis2=2)[:, :3]
        return np.sqrt(common.sum(axis=1).clip(0))

    def to_csv(self) -> str:
        """Return the table as text: image, time, q_J, v_J, pose, standard errors, speed; without columns for unknown values."""
        columns = {f"q_{j}": self.q[:, k] for k, j in enumerate(self.joints)}
        if self.joint_velocity is not None:
            columns |= {f"v_{j}": self.joint_velocity[:, k] for k, j in enumerate(self.joints)}
        rows = np.hstack([self.position, self.quaternion, self.stderr])
        columns |= dict(zip((*POSE, *STDERR), rows.T, strict=True))
        if self.time is not None and self.speed is not None:
            columns = {"t": self.time} | columns | {"speed_tool": self.speed}
        out = io.StringIO()
        write = csv.writer(out, lineterminator="\n")
        write.writerow(["image", *columns])
        for name, *row in zip(self.names, *columns.values(), strict=True):
            write.writerow([escape_formula(name), *(f"{v:.9g}" if np.isfinite(v) else "" for v in row)])
        return out.getvalue()

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a result file."""
        return {
            **self.cameras.to_dict(),
            "rms_px": self.rms,
            "n_poses": self.n,
            "position_stderr": {"median": float(np.median(np.linalg.norm(self.stderr[:, :3], axis=1))), "unit": "m"},
            "position_stderr_common": {"median": float(np.median(self.common_stderr)), "unit": "m"},
            "rotation_stderr": {"median": float(np.median(np.linalg.norm(self.stderr[:, 3:], axis=1))), "unit": "rad"},
            "refused": [{"image": name, "why": why} for name, why in self.refused.items()],
            **(
                {"clock_offset": {"value": self.clock.value, "stderr": self.clock.stderr, "unit": "s"}}
                if self.clock is not None
                else {}
            ),
            "poses": [self._describe(k) for k in range(self.n)],
        }

    def _describe(self, k: int) -> dict[str, Any]:
        """Return the content of a result file for one pose."""
        moving = {}
        if self.time is not None and self.speed is not None:
            moving = {
                "time": float(self.time[k]),
                "speed": float(self.speed[k]) if np.isfinite(self.speed[k]) else None,
            }
        return {
            "image": self.names[k],
            "position": self.position[k],
            "quaternion": self.quaternion[k],
            "stderr": self.stderr[k],
            "cameras": int(self.seen_by[k]),
            **moving,
        }


def measure_poses_from_images(
    images: Images,
    pattern: Pattern,
    *,
    second: Images | None = None,
    cameras: Cameras | None = None,
    extra: Images | None = None,
    second_extra: Images | None = None,
    positions: Positions | None = None,
    times: ImageTimes | None = None,
    lens: str = "brown",
    progress: Callable[[str], None] = lambda step: None,
) -> CameraPoseTable:
    """Measure poses of a plate with one camera or two.

    Args:
        images: The (first) camera's images, or a folder.
        pattern: The pattern on the plate.
        second: The second camera's images of the same moments.
        cameras: Known cameras with covariance; without them the images also determine the cameras.
        extra: Images of the (first) camera that are used only to calibrate the cameras, such as with the plate held by hand.
        second_extra: Such images of the second camera.
        positions: The robot's positions, by image name or order, or a log of them with its own clock.
        times: Times of the (first) camera's images, taken while the robot moved.
        lens: `brown` (k1 k2 p1 p2), `radial` (k1 k2), `brown3` (and k3) or `none`; unused if cameras are given.
        progress: Function that is called with a description of each step.

    Raises:
        InputError: Files are not images or have mixed sizes, or no image shows the pattern.
        CannotAnswer: Too few images, or images that do not determine the cameras or the clock of the log.
    """
    check_lens(lens)
    seen = read_album(images, second, extra, second_extra, pattern, progress)
    if times is not None:
        seen = _refuse_blurred(seen)
    check_some(seen, pattern)
    if cameras is not None:
        check_cameras(cameras, seen)
    stamps = _list_times(seen, times)
    views, labels = _views(seen, weigh=times is not None or pattern.turns > 1)
    progress("adjusting the bundle")
    solved = solve(views, pattern, seen.sizes, lens=lens, known=cameras)
    return _build_table(seen, solved, labels, pattern, positions, stamps)


def _list_times(seen: Album, times: ImageTimes | None) -> dict[int, float]:
    """Return the time of each moment [s]; empty without times."""
    if times is None:
        return {}
    t = match_rows(times.t[:, None], times.images, _list_usual(seen), times.source)[:, 0]
    return {moment: float(value) for moment, value in zip(seen.moments[0], t, strict=False) if np.isfinite(value)}


def _list_usual(seen: Album) -> list[str]:
    """Return the names of the first camera's images without the extra ones."""
    return [path.name for path, aside in zip(seen.paths[0], seen.extra[0], strict=True) if not aside]


def _refuse_blurred(seen: Album) -> Album:
    """Return the album without images with an unfitted corner: in these the plate moved too far during the exposure."""

    def judge(found: Detection) -> Detection:
        lost = 0 if found.stderr is None else int(np.isnan(found.stderr).sum())
        if not lost:
            return found
        return Detection(None, f"{lost} corners are not sharp enough to be fitted; shorten the exposure or move slower")

    return replace(seen, found=[[judge(d) for d in of] for of in seen.found])


def _views(seen: Album, weigh: bool) -> tuple[Views, list[tuple[int, int]]]:
    """Return all corners found, with weights from their grey values or equal ones, and each view's camera and image."""
    labels = [(c, k) for c, of in enumerate(seen.found) for k, d in enumerate(of) if d.corners is not None]
    corners = np.array([seen.found[c][k].corners for c, k in labels])
    moment = np.array([seen.moments[c][k] for c, k in labels])
    camera = np.array([c for c, _ in labels])
    views = Views(corners, camera, np.unique(moment, return_inverse=True)[1])
    if weigh:
        stderr = np.array([seen.found[c][k].stderr for c, k in labels])
        usual = np.array(
            [np.median(stderr[camera == c]) if np.any(camera == c) else 1.0 for c in range(len(seen.found))]
        )
        views = views._replace(spread=stderr / usual[camera][:, None])
    return views, labels


@dataclass(frozen=True, eq=False)
class _Robot:
    """State of the robot and time at each plate.

    Attributes:
        joints: Names of actuated joints.
        q: Positions (k, na); nan if unknown.
        v: Velocities (k, na), if positions are a log.
        time: Times (k,) [s]; nan if unknown.
        velocity: Velocities of the plates (k, 3) [m/s].
        clock: The offset between images and log.
        refused: Image -> reason why it has no position.
        warnings: Doubtful results.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    v: np.ndarray | None
    time: np.ndarray
    velocity: np.ndarray
    clock: LogOffset | None
    refused: dict[str, str]
    warnings: tuple[str, ...]


def _build_table(
    seen: Album,
    solved: CameraSolution,
    labels: list[tuple[int, int]],
    pattern: Pattern,
    positions: Positions | None,
    stamps: dict[int, float],
) -> CameraPoseTable:
    refused = {
        seen.name(c, k): d.reason for c, of in enumerate(seen.found) for k, d in enumerate(of) if d.corners is None
    }
    refused |= {seen.name(*labels[v]): why for v, why in solved.left_out.items()}
    kept = [labels[v] for v in solved.used]
    plates, names, extra, seen_by = _plates(seen, solved, kept)
    moments = [seen.moments[kept[v][0]][kept[v][1]] for v in plates]
    robot = _find_robot(seen, positions, moments, names, extra, stamps, solved)
    refused |= robot.refused
    known = np.isfinite(robot.q).all(axis=1) if robot.joints else np.ones(len(names), bool)
    keep = np.flatnonzero(~extra & known & (np.isfinite(robot.time) if stamps else True))
    if not len(keep):
        raise CannotAnswer(
            "not_visible",
            "no image of a robot position shows the pattern",
            "take images in which the whole plate can be seen",
        )
    bundle, rotation, turned = solved.bundle, solved.bundle.plates.rotation.copy(), []
    if pattern.turns > 1:
        rotation[keep], clear = follow_turns(rotation[keep], robot.q[keep])
        turned = _describe_turns([names[k] for k in keep], clear, bool(robot.joints))
        refused |= {names[k]: "the quarter turn of the plate cannot be determined" for k in keep[~clear]}
        keep = keep[clear]
    rms = np.array(
        [np.sqrt((bundle.residuals[solved.views.camera == c] ** 2).sum(-1).mean()) for c in range(bundle.cameras.n)]
    )
    covariance = bundle.covariance.copy()
    if robot.clock is not None:
        delay = robot.clock.stderr * robot.velocity[keep]
        covariance[keep, :3, :3] += delay[:, :, None] * delay[:, None, :]
    return CameraPoseTable(
        names=tuple(names[k] for k in keep),
        position=bundle.plates.position[keep],
        rotation=rotation[keep],
        covariance=covariance[keep],
        own=bundle.own[keep],
        seen_by=seen_by[keep],
        joints=robot.joints,
        q=robot.q[keep],
        cameras=bundle.cameras,
        rms=rms,
        refused=refused,
        warnings=(*_doubts(seen, refused, solved, names, keep), *turned, *robot.warnings),
        inputs=tuple(path for of in seen.paths for path in of),
        time=robot.time[keep] if stamps else None,
        velocity=robot.velocity[keep] if stamps else None,
        joint_velocity=None if robot.v is None else robot.v[keep],
        clock=robot.clock,
    )


def _describe_turns(names: list[str], clear: np.ndarray, by_joints: bool) -> list[str]:
    """Return sentences about the convention of the orientations."""
    first = names[int(np.argmax(clear))]
    steps = "neighbouring robot positions" if by_joints else "one image to the next"
    said = (
        f"the plate looks the same after a quarter turn: x is to the right in {first}, and the plate is taken to turn by less "
        f"than 45 degrees between {steps}; positions do not depend on it, and orientations depend on it by one common "
        "quarter turn about the plate's normal"
    )
    return [CodedWarning("quarter_turn", said)]


def _plates(
    seen: Album, solved: CameraSolution, kept: list[tuple[int, int]]
) -> tuple[np.ndarray, list[str], np.ndarray, np.ndarray]:
    """Return each plate's first view, its image's name, whether it only calibrates the cameras, and how many cameras saw it."""
    n = len(solved.bundle.plates.position)
    first = np.array([int(np.flatnonzero(solved.views.plate == k)[0]) for k in range(n)])
    names = [seen.name(*kept[v]) for v in first]
    extra = np.array([seen.extra[kept[v][0]][kept[v][1]] for v in first])
    return first, names, extra, np.bincount(solved.views.plate, minlength=n)


def _find_robot(
    seen: Album,
    positions: Positions | None,
    moments: list[int],
    names: list[str],
    extra: np.ndarray,
    stamps: dict[int, float],
    solved: CameraSolution,
) -> _Robot:
    """Return the robot's positions and the time of each plate (k)."""
    place, own = solved.bundle.plates.position, solved.bundle.own
    time = np.array([np.nan if aside else stamps.get(m, np.nan) for m, aside in zip(moments, extra, strict=True)])
    timed, velocity = np.isfinite(time), np.full((len(names), 3), np.nan)
    refused = {}
    if stamps:
        refused = {names[k]: "it has no time" for k in np.flatnonzero(~timed & ~extra)}
    if positions is not None and positions.log is not None and stamps:
        weight = 1 / np.sqrt(np.trace(own[timed, :3, :3], axis1=1, axis2=2))
        clock = estimate_clock_offset(time[timed], place[timed], weight, positions.log)
        time = time + clock.value
        refused |= list_uncovered(positions.log, time[timed], [names[k] for k in np.flatnonzero(timed)])
        covered = timed.copy()
        covered[timed] = positions.log.is_covered(time[timed])
        q, v = (np.full((len(names), len(positions.joints)), np.nan) for _ in range(2))
        q[covered], v[covered] = positions.log.curve(time[covered]), positions.log.curve(time[covered], 1)
        velocity[timed] = clock.velocity
        return _Robot(positions.joints, q, v, time, velocity, clock, refused, ())
    velocity[timed] = compute_velocity(time[timed], place[timed])
    if positions is None:
        return _Robot((), np.zeros((len(names), 0)), None, time, velocity, None, refused, ())
    usual = _list_usual(seen)
    row_of = dict(zip(seen.moments[0], positions.of(usual), strict=False))
    nothing = np.full(positions.q.shape[1], np.nan)
    q = np.array([nothing if aside else row_of.get(m, nothing) for m, aside in zip(moments, extra, strict=True)])
    lacking = [
        name for name, row, aside in zip(names, q, extra, strict=True) if not aside and not np.isfinite(row).all()
    ]
    said = f"{len(lacking)} images have no robot position in {positions.source} and served the cameras only: "
    said += format_names(lacking[:5])
    warned = (said,) if lacking else ()
    return _Robot(positions.joints, q, None, time, velocity, None, refused, warned)


def _doubts(
    seen: Album, refused: dict[str, str], solved: CameraSolution, names: list[str], keep: np.ndarray
) -> list[str]:
    said = []
    total = sum(len(of) for of in seen.paths)
    if refused:
        some = "; ".join(f"{name}: {why}" for name, why in list(refused.items())[:3])
        said.append(f"{len(refused)} of {total} images were not used. {some}{' ...' if len(refused) > 3 else ''}")
    unsure = [names[k] for k in keep if solved.unsure[k]]
    if unsure:
        said.append(
            f"the tilt of {len(unsure)} plates has two answers of nearly the same picture ({format_names(unsure[:5])}); "
            "their orientations are unsure: tilt the plate by 20 degrees or more, come closer, or use two cameras"
        )
    for c, noise in enumerate(solved.bundle.noise):
        if noise > 0.5:
            said.append(
                f"corners of camera {c + 1} scatter by {noise:.2f} px about the model, which is more than detection does; "
                "a lens model is missing, the plate is not flat, or images are blurred"
            )
    return said
