"""A compensation as a YAML file that carries its own robot, so that a controller's program needs nothing else.

    save_compensation(compensation, "delta_compensation.yaml")
    correct = load_compensation("delta_compensation.yaml")
    q_corrected = correct(q).q

No code runs on loading. Parameters are listed with the nominal and the calibrated value, so that a person can read what
was corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tau_dyn.calibrate.compensation import Compensation, build_compensation
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.mechanism import build_rods
from tau_dyn.robot import Robot, load_robot_from_urdf

_FORMAT = 1  # version of the file format


def _tree(robot: Robot, options: Mapping[str, Any]) -> Geometry:
    tool = options.get("tool")
    if tool is not None and not isinstance(tool, str):
        raise InputError("file_format", f"{robot.source}: geometry.tool must be a frame's name, not {tool!r}")
    return build_tree_geometry(robot, tool=tool)


def _rods(robot: Robot, options: Mapping[str, Any]) -> Geometry:
    return RodGeometry(build_rods(robot))


_KINDS: dict[str, Callable[[Robot, Mapping[str, Any]], Geometry]] = {"tree": _tree, "rods": _rods}
"""How to build a geometry again, by the word in the file."""


def save_compensation(compensation: Compensation, path: str | Path) -> None:
    """Write a compensation; the file appears whole or not at all.

    Raises:
        InputError: A geometry that cannot be told in words, or a place that cannot be written.
    """
    robot, p = compensation.robot, compensation.geometry.parameters
    changed = [
        {"name": row.name, "unit": row.unit, "nominal": float(a), "value": float(b)}
        for row, a, b in zip(p, compensation.nominal, compensation.theta, strict=True)
        if a != row.value or b != row.value
    ]
    content = {
        "tau_dyn_compensation": _FORMAT,
        "method": compensation.method,
        "axes": list(compensation.axes),
        "limits": compensation.limits,
        "geometry": _told(compensation.geometry),
        "robot": {
            "source": robot.source,
            "arguments": dict(robot.arguments),
            "actuated": list(robot.actuated),
            "sha256": robot.sha256,
        },
        "parameters": changed,
        "urdf": robot.urdf,
    }
    write_whole(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))


def load_compensation(path: str | Path) -> Compensation:
    """Read a compensation.

    Raises:
        InputError: The file is missing, not YAML or not a compensation of ours; the message names the entry.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or content.get("tau_dyn_compensation") != _FORMAT:
        raise InputError(
            "file_format", f"{path}: not a compensation (its first key is 'tau_dyn_compensation: {_FORMAT}')"
        )
    kinds = (("robot", dict), ("geometry", dict), ("parameters", list), ("axes", list), ("urdf", str), ("method", str))
    for key, kind in kinds:
        if not isinstance(content.get(key), kind):
            raise InputError("file_format", f"{path}: '{key}' is missing or not a {kind.__name__}")
    robot = _robot(content, path)
    word = content["geometry"].get("kind")
    if not isinstance(word, str) or word not in _KINDS:
        raise InputError("file_format", f"{path}: no geometry of kind '{word}'; there are {', '.join(_KINDS)}")
    geometry = _KINDS[word](robot, content["geometry"])
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


def _told(geometry: Geometry) -> dict[str, Any]:
    if isinstance(geometry, TreeGeometry):
        return {"kind": "tree", "tool": geometry.shape.tool.link}
    if isinstance(geometry, RodGeometry) and not geometry.drives and not geometry.guides:
        return {"kind": "rods"}
    raise InputError(
        "unsupported",
        f"a compensation of {type(geometry).__name__} with laws of drives or guideways cannot be saved; use it from Python",
    )


def _robot(content: Mapping[str, Any], path: str | Path) -> Robot:
    about = content["robot"]
    actuated = about.get("actuated")
    if not isinstance(actuated, list) or not all(isinstance(name, str) for name in actuated):
        raise InputError("file_format", f"{path}: robot.actuated must be a list of joints")
    arguments = about.get("arguments") or {}
    if not isinstance(arguments, dict):
        raise InputError("file_format", f"{path}: robot.arguments must be names and values")
    source = str(about.get("source", path))
    return load_robot_from_urdf(
        content["urdf"], source, actuated=actuated, arguments=arguments, sha256=str(about.get("sha256", ""))
    )


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
