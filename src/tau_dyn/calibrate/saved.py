"""A calibrated robot as a YAML file that carries its own robot file: written whole, read without running code.

save_calibration("l1_calibrated.yaml", found)
robot = load_calibration("l1_calibrated.yaml")
robot.forward(q).poses          # in the robot's base frame
robot.rods                      # for fk, ik, Jacobians of `kinematics`, without what carts and drives do besides
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.corrected_urdf import format_corrected_urdf
from tau_dyn.calibrate.families import get_family
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry, Predicted, expand_constraints
from tau_dyn.calibrate.models import Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.result import Calibration
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.mechanism import Poses, Rods
from tau_dyn.robot import Robot, load_robot_from_urdf

FORMAT = 1  # version of the file format


@dataclass(frozen=True, eq=False)
class CalibratedRobot:
    """A robot with its calibrated geometry.

    Attributes:
        robot: The robot as its file has it.
        geometry: The calibrated model.
        theta: Its parameters (p,).
        frames: Device and target.
        slack: Backlash of the actuated joints (na,) [m or rad].
        model: The model's name.
    """

    robot: Robot
    geometry: Geometry
    theta: np.ndarray
    frames: DeviceFrames
    slack: np.ndarray
    model: str

    def forward(self, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses in the robot's base frame at `q` (N, na), in the middle of the backlash."""
        return self.geometry.forward(self.theta, q, start)

    def seen(self, q: np.ndarray) -> Poses:
        """Return what the measuring device should see at `q` (N, na), first campaign."""
        return self.frames.measured(self.forward(q).poses, np.zeros(len(q), int))

    def build_robot(self, source: str = "") -> Robot:
        """Return a robot whose file has the calibrated placements; `source` is how messages call it.

        Raises:
            InputError: A robot of rods between carts and a plate, or what a robot file cannot say: laws of joints, gear ratios.
        """
        source = source or self.robot.source
        geometry, (theta,) = expand_constraints(self.geometry, self.theta)
        if not isinstance(geometry, TreeGeometry):
            what = "rods between carts and a plate" if isinstance(geometry, RodGeometry) else "laws of its joints"
            raise InputError(
                "unsupported",
                f"{source}: a robot file cannot hold this calibration, which has {what}; correct joint positions by "
                "calibrate --correct, or use load_calibration in Python",
            )
        urdf = format_corrected_urdf(geometry, theta)
        return load_robot_from_urdf(urdf, source, actuated=self.robot.actuated, tool=self.robot.tool)

    @property
    def rods(self) -> Rods:
        """The rods with calibrated dimensions, for `forward_kinematics` and `inverse_kinematics`, without the laws.

        Raises:
            InputError: A robot of another kind.
        """
        geometry, (theta,) = expand_constraints(self.geometry, self.theta)
        if not isinstance(geometry, RodGeometry):
            raise InputError(
                "unsupported", f"{self.robot.source} is no robot of rods between carts and a plate; use `forward`"
            )
        return geometry.rods_at(theta)


def save_calibration(path: str | Path, found: Calibration) -> None:
    """Write the chosen model of a calibration.

    Raises:
        InputError: A place that cannot be written.
    """
    robot, fitted = found.robot, found.fit
    spec = found.chosen.spec
    content = {
        "tau_dyn_calibration": FORMAT,
        "model": {
            "name": found.chosen.name,
            "structure": spec.structure,
            "additions": {k: list(v) for k, v in spec.additions.items()},
        },
        "travel": [
            [float(a), float(b)] for a, b in zip(found.poses.q.min(axis=0), found.poses.q.max(axis=0), strict=True)
        ],
        "parameters": [
            {"name": p.name, "value": float(v), "unit": p.unit, "nominal": p.value}
            for p, v in zip(fitted.geometry.parameters, fitted.theta, strict=True)
        ],
        "backlash": [float(x) for x in fitted.state.slack],
        "frames": {
            "device": [_frame(f) for f in fitted.frames.device],
            "tool": [_frame(f) for f in fitted.frames.tool],
        },
        "noise": [float(x) for x in fitted.noise],
        "poses": {"source": found.poses.source, "sha256": found.poses.sha256, "n": found.poses.n},
        "robot": {
            "source": robot.source,
            "arguments": {k: str(v) for k, v in robot.arguments.items()},
            "actuated": list(robot.actuated),
            "sha256": robot.sha256,
        },
        "urdf": robot.urdf,
    }
    write_whole(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))


def load_calibration(path: str | Path) -> CalibratedRobot:
    """Read a calibrated robot.

    Raises:
        InputError: The file is missing, not YAML or not a calibration of ours; the message names the entry.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or content.get("tau_dyn_calibration") != FORMAT:
        raise InputError(
            "file_format", f"{path}: not a calibrated robot (its first key is 'tau_dyn_calibration: {FORMAT}')"
        )
    try:
        return _built(content)
    except InputError as fault:
        raise InputError(fault.code, f"{path}: {fault}") from fault
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as fault:
        raise InputError(
            "file_format", f"{path}: an entry is missing or of the wrong kind ({fault}); save the calibration again"
        ) from fault


def _built(content: Mapping[str, Any]) -> CalibratedRobot:
    about = content["robot"]
    robot = load_robot_from_urdf(
        content["urdf"],
        str(about["source"]),
        actuated=[str(j) for j in about["actuated"]],
        arguments=dict(about["arguments"]),
        sha256=str(about["sha256"]),
    )
    travel = np.array(content["travel"], float).T
    additions = {str(k): tuple(str(j) for j in v) for k, v in content["model"]["additions"].items()}
    spec = Spec(str(content["model"]["structure"]), additions)
    family = get_family(robot, PoseSet(travel, np.zeros((2, 3)), approach=np.ones(travel.shape)))
    geometry = family.build(spec)
    given = {row["name"]: float(row["value"]) for row in content["parameters"]}
    missing = [name for name in geometry.parameters.names if name not in given]
    if missing:
        raise InputError("file_format", f"parameter {missing[0]} is missing")
    theta = np.array([given[name] for name in geometry.parameters.names])
    if not np.isfinite(theta).all():
        raise InputError("file_format", "a parameter is not a number")
    frames = DeviceFrames(*(tuple(_read_frame(f) for f in content["frames"][key]) for key in ("device", "tool")))
    if not frames.device or not frames.tool:
        raise InputError("file_format", "frames needs a device and a tool at least")
    slack = np.array(content["backlash"], float)
    if slack.shape != (robot.na,) or not np.isfinite(slack).all():
        raise InputError("file_format", "backlash needs a number for each actuated joint")
    return CalibratedRobot(robot, geometry, theta, frames, slack, str(content["model"]["name"]))


def _frame(frame: Frame) -> dict[str, list[float]]:
    quaternion = Rotation.from_matrix(frame.rotation).as_quat(canonical=True)
    return {"translation": frame.translation.tolist(), "quaternion": quaternion.tolist()}


def _read_frame(row: Mapping[str, Any]) -> Frame:
    rotation, translation = Rotation.from_quat(row["quaternion"]).as_matrix(), np.array(row["translation"], float)
    if rotation.shape != (3, 3) or translation.shape != (3,) or not np.isfinite([*rotation, translation]).all():
        raise InputError("file_format", "a frame is no place and orientation")
    return Frame(rotation, translation)
