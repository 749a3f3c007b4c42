"""Calibrated robots and compensations as YAML files that carry their own robot file: written whole, read without running code.

    save_calibration("l1_calibrated.yaml", found)
    robot = load_calibration("l1_calibrated.yaml")
    robot.forward(q).poses          # in the robot's base frame
    robot.rods                      # for fk, ik, Jacobians of `mechanism`, without effects of carts and drives

    save_compensation(compensation, "delta_compensation.yaml")
    q_corrected = load_compensation("delta_compensation.yaml")(q).q

Parameters are listed with the nominal and the calibrated value, so that a reader sees the corrections.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.compensation import Compensation, build_compensation
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry, Predicted, expand_constraints
from tau_dyn.calibrate.measured import ENCODERS, KINDS, PoseSet
from tau_dyn.calibrate.model_family import Spec
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.result import Calibration
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.mechanism import Poses, Rods, build_rods, forward_kinematics, state_springs
from tau_dyn.robot import Robot, load_robot_from_urdf

_MAX_MISFIT = 1e-9  # [m] between the written file's tool and the calibrated one: rounding
_FORMAT = 1  # version of both file formats


@dataclass(frozen=True, eq=False)
class CalibratedRobot:
    """A robot with its calibrated geometry.

    Attributes:
        robot: The robot as in its file.
        geometry: The calibrated model.
        theta: Its parameters (p,).
        frames: Frames of device and target.
        slack: Backlash of the actuated joints (na,) [m or rad].
        model: The model's name.
        stderr: Standard errors of the estimated parameters by name.
    """

    robot: Robot
    geometry: Geometry
    theta: np.ndarray
    frames: DeviceFrames
    slack: np.ndarray
    model: str
    stderr: Mapping[str, float] = field(default_factory=dict)

    def forward(self, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses in the robot's base frame at `q` (N, na), in the middle of the backlash."""
        return self.geometry.forward(self.theta, q, start)

    def seen(self, q: np.ndarray) -> Poses:
        """Return the predicted measurement of the device at `q` (N, na), first campaign."""
        return self.frames.measured(self.forward(q).poses, np.zeros(len(q), int))

    def build_robot(self, source: str = "") -> Robot:
        """Return a robot whose file has the calibrated dimensions and the drives' springs; `source` is its name in messages.

        Raises:
            InputError: A robot file cannot hold the parameters: laws of joints, gear ratios of rotary joints, sides of a triangle
                of rods, an unknown load at the tool.
        """
        source = source or self.robot.source
        geometry, (theta,) = expand_constraints(self.geometry, self.theta)
        if geometry.beyond_file:
            raise InputError(
                "unsupported",
                f"{source}: a robot file cannot hold this calibration, which has {geometry.beyond_file}; correct joint "
                "positions by calibrate --correct, or use load_calibration in Python",
            )
        try:
            geometry, theta, springs = geometry.split_springs(theta)
        except InputError as fault:
            raise InputError(fault.code, f"{source}: {fault}") from fault
        urdf = geometry.format_urdf(theta)
        found = load_robot_from_urdf(urdf, source, actuated=self.robot.actuated, tool=self.robot.tool or None)
        q = found.home[None]
        if geometry.rods_at(theta) is not None:
            off = np.abs(forward_kinematics(found, q).poses.position - geometry.forward(theta, q).poses.position).max()
            if not off < _MAX_MISFIT:
                raise InputError(
                    "unsupported",
                    f"{source}: the rods share joints in the robot file, which cannot hold each one's dimensions",
                )
        return self._state_springs(found, springs) if springs else found

    def _state_springs(self, robot: Robot, springs: Mapping[str, tuple[str, float]]) -> Robot:
        """Return a robot with the drives' springs in its file: stiffness `1 / c`, standard error `s_c / c^2`."""
        errors = {joint: self.stderr.get(name, 0.0) / c**2 for joint, (name, c) in springs.items()}
        return state_springs(robot, drives={joint: 1 / c for joint, (_, c) in springs.items()}, drive_stderrs=errors)

    @property
    def rods(self) -> Rods:
        """The rods with calibrated dimensions, for `forward_kinematics` and `inverse_kinematics`, without the laws.

        Raises:
            InputError: A robot of another kind.
        """
        geometry, (theta,) = expand_constraints(self.geometry, self.theta)
        rods = geometry.rods_at(theta)
        if rods is None:
            raise InputError(
                "unsupported", f"{self.robot.source} is no robot of rods between carts and a plate; use `forward`"
            )
        return rods


def save_calibration(path: str | Path, found: Calibration) -> None:
    """Write the chosen model of a calibration.

    Raises:
        InputError: The file cannot be written.
    """
    robot, fitted = found.robot, found.fit
    spec = found.chosen.spec
    errors = {p.name: p.stderr for p in fitted.parameters if p.stderr is not None}
    content = {
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
            | ({"stderr": errors[p.name]} if p.name in errors else {})
            for p, v in zip(fitted.geometry.parameters, fitted.theta, strict=True)
        ],
        "backlash": [float(x) for x in fitted.state.slack[:-1]],
        "frames": {
            "device": [_frame(f) for f in fitted.frames.device],
            "tool": [_frame(f) for f in fitted.frames.tool],
            "kinds": list(fitted.frames.kinds),
            "lengths": [float(x) for x in fitted.frames.lengths],
        },
        "noise": [float(x) for x in fitted.noise],
        "poses": {"source": found.poses.source, "sha256": found.poses.sha256, "n": found.poses.n},
    }
    _write(path, "tau_dyn_calibration", content, robot)


def load_calibration(path: str | Path) -> CalibratedRobot:
    """Read a calibrated robot.

    Raises:
        InputError: The file is missing, not YAML or not a calibration of ours; the message names the entry.
    """
    content = _read(path, "tau_dyn_calibration", "calibrated robot")
    try:
        return _built(content)
    except InputError as fault:
        raise InputError(fault.code, f"{path}: {fault}") from fault
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as fault:
        raise InputError(
            "file_format", f"{path}: an entry is missing or of the wrong kind ({fault}); save the calibration again"
        ) from fault


def _built(content: Mapping[str, Any]) -> CalibratedRobot:
    robot = _load_robot(content)
    travel = np.array(content["travel"], float).T
    additions = {str(k): tuple(str(j) for j in v) for k, v in content["model"]["additions"].items()}
    spec = Spec(str(content["model"]["structure"]), additions)
    kinds = tuple(str(kind) for kind in content["frames"].get("kinds", ()))
    known = tuple(kind for kind in kinds if kind in ENCODERS)[:1] or ("pose",)  # with encoders the robot is a tree
    family = get_family(robot, PoseSet(travel, np.zeros((2, 3)), kinds=known, approach=np.ones(travel.shape)))
    geometry = family.build(spec)
    given = {row["name"]: float(row["value"]) for row in content["parameters"]}
    missing = [name for name in geometry.parameters.names if name not in given]
    if missing:
        raise InputError("file_format", f"parameter {missing[0]} is missing")
    theta = np.array([given[name] for name in geometry.parameters.names])
    if not np.isfinite(theta).all():
        raise InputError("file_format", "a parameter is not a number")
    device, tool = (tuple(_read_frame(f) for f in content["frames"][key]) for key in ("device", "tool"))
    frames = DeviceFrames(device, tool)
    if not frames.device or not frames.tool:
        raise InputError("file_format", "frames needs a device and a tool at least")
    lengths = tuple(float(x) for x in content["frames"].get("lengths", ()))
    if set(kinds) - set(KINDS) or {len(kinds), len(lengths)} - {0, len(frames.device)}:
        raise InputError(
            "file_format", f"frames.kinds and frames.lengths need one of {', '.join(KINDS)} for each device"
        )
    frames = replace(frames, kinds=kinds, lengths=lengths)
    slack = np.array(content["backlash"], float)
    if slack.shape != (robot.na,) or not np.isfinite(slack).all():
        raise InputError("file_format", "backlash needs a number for each actuated joint")
    stderr = {row["name"]: float(row["stderr"]) for row in content["parameters"] if "stderr" in row}
    if not all(0 <= x < np.inf for x in stderr.values()):
        raise InputError("file_format", "a standard error is below zero or not a number")
    return CalibratedRobot(robot, geometry, theta, frames, slack, str(content["model"]["name"]), stderr)


def _frame(frame: Frame) -> dict[str, list[float]]:
    quaternion = Rotation.from_matrix(frame.rotation).as_quat(canonical=True)
    return {"translation": frame.translation.tolist(), "quaternion": quaternion.tolist()}


def _read_frame(row: Mapping[str, Any]) -> Frame:
    rotation, translation = Rotation.from_quat(row["quaternion"]).as_matrix(), np.array(row["translation"], float)
    if rotation.shape != (3, 3) or translation.shape != (3,) or not np.isfinite([*rotation, translation]).all():
        raise InputError("file_format", "a frame is no place and orientation")
    return Frame(rotation, translation)


def save_compensation(compensation: Compensation, path: str | Path) -> None:
    """Write a compensation; the file appears whole or not at all.

    Raises:
        InputError: The geometry cannot be written as text, or the file cannot be written.
    """
    description = compensation.geometry.description
    if description is None:
        raise InputError(
            "unsupported",
            f"a compensation of {type(compensation.geometry).__name__} with laws of drives or guideways cannot be saved; use it "
            "from Python",
        )
    robot, p = compensation.robot, compensation.geometry.parameters
    changed = [
        {"name": row.name, "unit": row.unit, "nominal": float(a), "value": float(b)}
        for row, a, b in zip(p, compensation.nominal, compensation.theta, strict=True)
        if a != row.value or b != row.value
    ]
    content = {
        "method": compensation.method,
        "axes": list(compensation.axes),
        "limits": compensation.limits,
        "geometry": description,
        "parameters": changed,
    }
    _write(path, "tau_dyn_compensation", content, robot)


def load_compensation(path: str | Path) -> Compensation:
    """Read a compensation.

    Raises:
        InputError: The file is missing, not YAML or not a compensation of ours; the message names the entry.
    """
    content = _read(path, "tau_dyn_compensation", "compensation")
    kinds = (("robot", dict), ("geometry", dict), ("parameters", list), ("axes", list), ("urdf", str), ("method", str))
    for key, kind in kinds:
        if not isinstance(content.get(key), kind):
            raise InputError("file_format", f"{path}: '{key}' is missing or not a {kind.__name__}")
    try:
        robot = _load_robot(content)
        geometry = _build_described_geometry(robot, content["geometry"])
    except InputError as fault:
        raise InputError(fault.code, f"{path}: {fault}") from fault
    nominal, theta = _values(content["parameters"], geometry, path)
    return build_compensation(
        robot,
        geometry,
        theta,
        nominal=nominal,
        method=content["method"],
        axes=[str(axis) for axis in content["axes"]],
        limits=content.get("limits") is not False,
    )


def _build_described_geometry(robot: Robot, description: Mapping[str, Any]) -> Geometry:
    """Return the geometry that a file describes."""
    kind, tool = description.get("kind"), description.get("tool")
    if kind == "rods":
        return RodGeometry(build_rods(robot))
    if kind != "tree":
        raise InputError("file_format", f"no geometry of kind '{kind}'; there are tree, rods")
    if tool is not None and not isinstance(tool, str):
        raise InputError("file_format", f"geometry.tool must be a frame's name, not {tool!r}")
    return build_tree_geometry(robot, tool=tool)


def _values(rows: list[Any], geometry: Geometry, path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    names = geometry.parameters.names
    nominal, theta = geometry.parameters.values.copy(), geometry.parameters.values.copy()
    for k, row in enumerate(rows):
        if not isinstance(row, dict) or not {"name", "nominal", "value"} <= set(row):
            raise InputError("file_format", f"{path}: parameters: entry {k + 1} must have name, nominal and value")
        if row["name"] not in names:
            raise InputError("mismatch", f"{path}: parameter '{row['name']}' does not belong to this robot")
        for key, target in (("nominal", nominal), ("value", theta)):
            x = row[key]
            if isinstance(x, bool) or not isinstance(x, int | float) or not abs(x) < 1e300:
                raise InputError("file_format", f"{path}: {row['name']}.{key} must be a finite number, not {x!r}")
            target[names.index(row["name"])] = float(x)
    return nominal, theta


def _write(path: str | Path, kind: str, content: dict[str, Any], robot: Robot) -> None:
    """Write a file of a kind with its robot; it appears whole or not at all."""
    about = {
        "source": robot.source,
        "arguments": {k: str(v) for k, v in robot.arguments.items()},
        "actuated": list(robot.actuated),
        "tool": robot.tool,
        "sha256": robot.sha256,
    }
    content = {kind: _FORMAT, **content, "robot": about, "urdf": robot.urdf}
    write_whole(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))


def _read(path: str | Path, kind: str, what: str) -> dict[str, Any]:
    content = read_yaml(path)
    if not isinstance(content, dict) or content.get(kind) != _FORMAT:
        raise InputError("file_format", f"{path}: not a {what} (its first key is '{kind}: {_FORMAT}')")
    return content


def _load_robot(content: Mapping[str, Any]) -> Robot:
    """Return the robot of a file."""
    about = content["robot"]
    actuated, arguments = about.get("actuated"), about.get("arguments") or {}
    if not isinstance(actuated, list) or not all(isinstance(name, str) for name in actuated):
        raise InputError("file_format", "robot.actuated must be a list of joints")
    if not isinstance(arguments, dict):
        raise InputError("file_format", "robot.arguments must be names and values")
    return load_robot_from_urdf(
        content["urdf"],
        str(about.get("source", "robot")),
        actuated=actuated,
        tool=str(about.get("tool") or "") or None,
        arguments=arguments,
        sha256=str(about.get("sha256", "")),
        hold_passive=False,
    )
