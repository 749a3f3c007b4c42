r"""Encoders of passive joints in loops: rows that measure a joint's position in addition to, or instead of, the tool.

An angle counts as the arc `r (psi + zero)`, with `r` the distance at which its joint moves the tool, so that errors of encoders
and of the tool are comparable. The zero of each encoder is unknown. Angles alone show no lengths, only their ratios. Reference:
Hollerbach, Khalil & Gautier 2016, 6.2 (self-calibration by redundant sensors).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.calibrate.geometry import Geometry, Predicted
from tau_dyn.calibrate.measured.pose_set import PoseSet
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Poses, compute_frames
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot

_MIN_RADIUS = 1e-3  # [m] of an arc, if all joints with encoders are at the tool
_READINGS = {
    "counts the other way than the robot file": -1.0,
    "is in degrees": np.pi / 180,
    "is in degrees and counts the other way than the robot file": -np.pi / 180,
}
_MIN_SCATTER_RATIO = 3.0
"""Ratio of the scatter about the nominal robot to that of another reading, above which the other reading is used."""


def predict_measured(
    geometry: Geometry, theta: np.ndarray, poses: PoseSet, q: np.ndarray, start: Poses | None = None
) -> Predicted:
    """Return tool poses at the positions `q` (N, na) of measured poses; for an encoder its arc or travel along x."""
    geometry, rows = geometry.under(poses.loads), poses.of_encoders
    found = geometry.forward(theta, q, start)
    if not rows.any():
        return found
    position, rotation, ok = found.poses.position.copy(), found.poses.rotation.copy(), found.ok.copy()
    joints, column = _list_encoders(poses)
    angle = geometry.passive(theta, q, joints)[rows, column]
    position[rows], rotation[rows] = 0.0, np.eye(3)
    position[rows, 0] = angle * poses.length_factors[rows]
    ok[rows] &= np.isfinite(angle)
    return Predicted(Poses(position, rotation), ok, found.reason)


def measured_by_parameter(
    geometry: Geometry, theta: np.ndarray, poses: PoseSet, q: np.ndarray, at: Poses
) -> np.ndarray:
    """Return the derivative of `predict_measured` as twists per parameter (N, 6, p)."""
    geometry = geometry.under(poses.loads)
    tool = geometry.tool_by_parameter(theta, q, at)
    return _replace_rows(tool, poses, lambda joints: geometry.passive_by_parameter(theta, q, joints))


def measured_by_joint(geometry: Geometry, theta: np.ndarray, poses: PoseSet, q: np.ndarray, at: Poses) -> np.ndarray:
    """Return the derivative of `predict_measured` as twists per actuated joint (N, 6, na)."""
    geometry = geometry.under(poses.loads)
    tool = geometry.tool_by_joint(theta, q, at)
    return _replace_rows(tool, poses, lambda joints: geometry.passive_by_joint(theta, q, joints))


def _replace_rows(tool: np.ndarray, poses: PoseSet, find: Callable[[list[str]], np.ndarray]) -> np.ndarray:
    """Return twists (N, 6, p) with those of encoders replaced by their joints' derivatives (N, k, p), along x."""
    rows = poses.of_encoders
    if not rows.any():
        return tool
    joints, column = _list_encoders(poses)
    out = tool.copy()
    out[rows] = 0.0
    out[rows, 0] = find(joints)[rows, column] * poses.length_factors[rows, None]
    return out


def _list_encoders(poses: PoseSet) -> tuple[list[str], np.ndarray]:
    """Return the joints that have encoders, and the index of the joint that each row measures (n,)."""
    device = poses.device[poses.of_encoders]
    numbers = np.unique(device)
    return [poses.devices[k] for k in numbers], np.searchsorted(numbers, device)


@dataclass(frozen=True)
class PassiveEncoders:
    """Passive joints of a robot that have encoders.

    Attributes:
        kinds: `angle` or `travel` by the joint's name.
        arc_radius: Radius at which angles count as arcs [m]: the rms distance of these joints from the tool at home.
    """

    kinds: dict[str, str]
    arc_radius: float

    @classmethod
    def of(cls, robot: Robot, joints: Sequence[str]) -> PassiveEncoders:
        """Return the encoders of some passive joints.

        Raises:
            InputError: The robot has no loops, or a joint is driven.
            UnknownName: The robot has no passive joint of that name.
        """
        driven = [joint for joint in joints if joint in robot.actuated]
        if driven:
            raise InputError("bad_option", f"{driven[0]} is driven, and its positions q_{driven[0]} are read anyway")
        tree = build_tree_geometry(robot)
        if not tree.shape.n_loops:
            raise InputError("unsupported", f"{robot.source} has no loops, so that no joint is passive")
        theta, home = tree.parameters.values, robot.home[None]
        tree.passive(theta, home, joints)  # refuses unknown ones
        numbers, x = tree.place(theta, home)
        origins, tool = compute_frames(numbers.joints, x).origin, tree.forward(theta, home).poses.position[0]
        of = {name: j for j, name in zip(tree.shape.joints, tree.shape.names, strict=True)}
        away = [np.linalg.norm(origins[of[name].index][:, 0] - tool) for name in joints if not of[name].slides]
        radius = float(np.sqrt(np.mean(np.square(away)))) if away else 1.0
        return cls({name: "travel" if of[name].slides else "angle" for name in joints}, max(radius, _MIN_RADIUS))

    def measure(self, joint: str, values: np.ndarray, rows: PoseSet) -> PoseSet:
        """Return the readings of a joint's encoder.

        Args:
            joint: Its name.
            values: Its positions (N,) [rad or m]; nan where it was not read.
            rows: Actuated positions, names and campaigns of the same rows (N).
        """
        read = np.isfinite(values)
        some, kind = rows.take(read), self.kinds[joint]
        position = np.zeros((some.n, 3))
        position[:, 0] = values[read] * (self.arc_radius if kind == "angle" else 1.0)
        return replace(
            some,
            position=position,
            device=np.zeros(some.n, int),
            devices=(joint,),
            kinds=(kind,),
            arc_radius=self.arc_radius,
        )


def read_encoders_as_meant(robot: Robot, poses: PoseSet) -> tuple[PoseSet, tuple[str, ...]]:
    """Return poses with encoders in the convention of the robot file, and a warning for each whose reading was changed.

    The sign, unit and whole turns are those with the least scatter of the encoder about the robot file's positions.
    """
    rows = poses.of_encoders
    if not rows.any():
        return poses, ()
    tree = build_tree_geometry(robot)
    seen = predict_measured(tree, tree.parameters.values, poses, poses.q)
    position, said = poses.position.copy(), []
    for number in np.unique(poses.device[rows]).tolist():
        own = poses.device == number
        expected, written = seen.poses.position[own & seen.ok, 0], position[own & seen.ok, 0]
        turn = 2 * np.pi * poses.arc_radius if poses.kinds[number] == "angle" else np.inf
        scatter = {words: _measure_scatter(factor * written - expected, turn) for words, factor in _READINGS.items()}
        words = min(scatter, key=lambda one: scatter[one])
        factor = 1.0
        if _MIN_SCATTER_RATIO * scatter[words] < _measure_scatter(written - expected, turn):
            factor = _READINGS[words]
            sentence = f"{poses.source}: the encoder of {poses.devices[number]} {words}, and is read so"
            said.append(CodedWarning("poses_reread", sentence))
        position[own, 0] *= factor
        if np.isfinite(turn):
            off = np.where(seen.ok, position[:, 0] - seen.poses.position[:, 0], 0.0)[own]
            position[own, 0] -= turn * np.round((off - _find_middle(off, turn)) / turn)
    return replace(poses, position=position), tuple(said)


def _find_middle(off: np.ndarray, turn: float) -> float:
    """Return the mean of differences (n,) that repeat every turn."""
    return (
        0.0 if not np.isfinite(turn) else float(np.angle(np.mean(np.exp(2j * np.pi * off / turn)))) * turn / (2 * np.pi)
    )


def _measure_scatter(off: np.ndarray, turn: float) -> float:
    """Return the median distance of differences (n,) from their middle, modulo whole turns."""
    if not np.isfinite(turn):
        return float(np.median(np.abs(off - np.median(off))))
    off = off - _find_middle(off, turn)
    return float(np.median(np.abs(off - turn * np.round(off / turn))))
