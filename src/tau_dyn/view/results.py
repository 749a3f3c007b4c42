"""Results to show on the robot, read from the JSON of a command or from a table of points.

Data that the file lacks are recomputed from the robot: coarsely, and only on request.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.log import MAX_MAGNITUDE, read_table
from tau_dyn.modes import ShapesOnRobot
from tau_dyn.robot import Robot


@dataclass(frozen=True)
class ViewedFinding:
    """A finding about some parts of the robot.

    Attributes:
        title: The cause and its status.
        sentence: The finding in one sentence, or ''.
        parts: Names of the affected joints, links or rods.
    """

    title: str
    sentence: str
    parts: tuple[str, ...]


@dataclass(frozen=True)
class Findings:
    """All findings of a result, and the headline above them."""

    headline: str
    rows: tuple[ViewedFinding, ...]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in space, with values to colour them by.

    Attributes:
        name: Name of the cloud.
        points: (n, 3) [m].
        values: Values (n,) that may colour the points, by name with unit.
        note: A remark on the cloud, or ''.
        box: Two corners (2, 3) [m] of the bounding box, or None.
        flat: Whether the cloud is a section, whose points are drawn side by side.
    """

    name: str
    points: np.ndarray
    values: dict[str, np.ndarray] = field(default_factory=dict)
    note: str = ""
    box: np.ndarray | None = None
    flat: bool = False


@dataclass(frozen=True, eq=False)
class ErrorVectors:
    """Measured minus predicted positions of the tool.

    Attributes:
        points: Measured positions (n, 3) [m] in the robot's base frame.
        models: Error vectors (n, 3) [m] by model, from the one with the file's dimensions to the chosen one.
    """

    points: np.ndarray
    models: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Relative standard error of each link's mass; nan if the mass is not determined."""

    links: dict[str, float]


Content = Findings | Cloud | ErrorVectors | Uncertainty | ShapesOnRobot


_ACROSS = 16
"""Points along the longest side of a coarse workspace."""


def recompute_workspace(robot: Robot, resolution: float, box: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return points (n, 3) [m] inside the workspace, and their values by name: the condition number.

    Args:
        robot: The robot.
        resolution: Resolution of the result [m]; the recomputed points are not finer.
        box: Corners (2, 3) [m] of the workspace.
    """
    from tau_dyn.kinematics.workspace import build_points_table, study_workspace

    step = max(resolution, float(np.ptp(box, axis=0).max()) / _ACROSS)
    table = build_points_table(study_workspace(robot, resolution=step, maps=["condition"]))
    inside = table[table["inside"] == 1]
    points = inside[["x_tool", "y_tool", "z_tool"]].to_numpy(float)
    return points, {"condition number": inside["condition"].to_numpy(float)}


def recompute_calibration(content: dict[str, Any], robot: Robot, path: Path) -> dict[str, Any]:
    """Return the pose errors of the uncalibrated robot file at the measured poses, with the base frame that fits best.

    The poses are read from the path that the result names. The file must be unchanged.

    Raises:
        InputError: The result names no file of poses, or the file has changed.
    """
    from tau_dyn.calibrate import align, as_poses
    from tau_dyn.mechanism import forward_kinematics

    files = [i for i in content.get("inputs", []) if str(i["path"]).endswith(".csv")]
    if not files:
        raise InputError("mismatch", f"{path}: it names no file of measured poses")
    poses = as_poses(Path(files[0]["path"]), robot)
    if poses.sha256 != files[0]["sha256"]:
        raise InputError(
            "mismatch", f"{files[0]['path']}: changed since {path.name} was written; its errors would not be those"
        )
    found = forward_kinematics(robot, poses.q)
    at, seen = found.poses.position[found.ok], poses.position[found.ok]
    device = align(at, seen)  # places the measuring device such that its points fit best in the base frame
    points = seen @ np.asarray(device.rotation).T + device.translation
    return {"points": points, "models": {"robot file": points - at}}


_BEST = ("exact", "certified", "montecarlo", "ellipsoid", "parallelepiped", "linear")
_MAX_POINTS = 100_000  # points of a cloud drawn at most
_MAX_FILE_BYTES = 64 * 1024 * 1024
"""Largest file that is read [bytes]."""
_MAX_CLOUD_BYTES = 2**30  # bytes of a point file read at most


def read_result(path: Path, robot: Robot, *, compute: bool = False) -> list[Content]:
    """Return the contents of a result for this robot.

    Args:
        path: A file written by `--json` of diagnose, workspace, accuracy, calibrate, modes or identify.
        robot: The robot to show it on.
        compute: Compute data that the file lacks: coarse points of a workspace, errors of the uncalibrated robot.

    Raises:
        InputError: The file is not such a result, has no content to show, or belongs to another robot.
    """
    content = _content(path)
    command = content.get("command")
    reader = _READERS.get(command if isinstance(command, str) else "")
    if reader is None and "findings" in content:
        reader = _diagnose
    if reader is None:
        known = ", ".join(_READERS)
        raise InputError("file_format", f"{path}: not a result that can be shown; --json of {known} can")
    try:
        return reader(content, robot, path, compute)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError) as fault:
        raise InputError(
            "file_format", f"{path}: not a whole result of tau-dyn {command or 'diagnose'}: {fault!r}"
        ) from fault


def read_cloud(path: Path) -> Cloud:
    """Return the points of a table with x y z or x_tool y_tool z_tool; its other numeric columns are values to colour by.

    Points with 0 in a column `inside`, which `workspace --out` writes, are left out, and points with an empty coordinate.

    Raises:
        InputError: The file has no such columns, is too large, or holds text in a numeric column.
    """
    table = read_table(path, most=_MAX_CLOUD_BYTES)
    sets = (("x_tool", "y_tool", "z_tool"), ("x", "y", "z"))
    names = next((n for n in sets if set(n) <= set(table.cells)), None)
    if names is None:
        there = ", ".join(table.cells)
        raise InputError(
            "file_format", f"{path}: a cloud needs columns x y z or x_tool y_tool z_tool; there are {there}"
        )
    columns = {column: table.numbers_or_none(column) for column in table.cells}
    numbers = {column: values for column, values in columns.items() if values is not None}
    for name in names:
        if name not in numbers or np.any(np.abs(numbers[name]) >= MAX_MAGNITUDE):
            table.numbers(name)  # raises, with the row of the text or the excessive number
    shown = np.arange(len(table.places))
    if "inside" in numbers and set(numbers["inside"]) <= {0, 1}:
        shown = np.flatnonzero(numbers.pop("inside"))
    shown = shown[:: max(1, len(shown) // _MAX_POINTS)]
    shown = shown[np.isfinite([numbers[name][shown] for name in names]).all(axis=0)]
    points = np.column_stack([numbers.pop(name)[shown] for name in names])
    coloured = sorted(numbers, key=lambda column: column.startswith("q_"))  # maps first, then the pose
    return Cloud(path.name, points, {column: numbers[column][shown] for column in coloured})


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_bytes(path, _MAX_FILE_BYTES).decode("utf-8"))
    except InputError:
        raise
    except OSError as fault:
        raise InputError(
            "cannot_read", f"{path}: {fault.strerror or 'cannot be read'}; give what --json wrote"
        ) from fault
    except (ValueError, RecursionError) as fault:
        raise InputError("file_format", f"{path}: not a result of tau-dyn: no JSON; give what --json wrote") from fault
    if not isinstance(content, dict):
        raise InputError("file_format", f"{path}: not a result of tau-dyn: a JSON object is expected")
    return content


def _diagnose(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    rows = tuple(_finding(row, robot) for row in content["findings"])
    return [Findings(str(content.get("sentence") or ""), rows)]


def _finding(row: dict[str, Any], robot: Robot) -> ViewedFinding:
    """Return a finding; if it names no joints, its parts are the owners of its parameters."""
    joints = tuple(map(str, row["joints"]))
    if not joints:
        names = [str(p["name"]).partition(".")[0] for p in row.get("parameters", ())]
        joints = tuple(dict.fromkeys(part for name in names for part in _parts(name, robot)))
    title = f"{row['cause']} ({row['status']})"
    gain = row.get("gain") or {}
    said = str(row.get("sentence") or row.get("equation") or "")
    if "sentence" not in row and gain.get("reduction_percent") is not None:
        said += f"; explains {float(gain['reduction_percent']):.0f} % of the error"
    return ViewedFinding(title, said, joints)


def _parts(name: str, robot: Robot) -> list[str]:
    """Return the parts of a parameter's owner: `arm2` of a Gantry-Tau is its cart and its rods."""
    if not name.startswith("arm") or name in robot.model.names or not name[3:].isdigit():
        return [name]
    number = name[3:]
    rods = [str(n).partition("_")[0] for n in robot.model.names if n.startswith(f"rod{number}")]
    return [j for j in robot.actuated if j.endswith(number)] + list(dict.fromkeys(rods))


def _list_elastic_clouds(content: dict[str, Any]) -> list[Cloud]:
    """Return the points at which a workspace's springs were linearised, with stiffness, sag and resonances, if known."""
    found = content.get("elastic_map") or {}
    points = np.array(found.get("points", []), float).reshape(-1, 3)
    if not len(points) or "coordinates" in content:  # coordinates other than positions of the tool cannot be drawn
        return []
    units = {str(row["map"]): str(row["unit"]) for row in content.get("maps", [])}
    values = {
        f"{name} [{units[name]}]": np.array(value, float) for name, value in found["values"].items() if name in units
    }
    note = str(content.get("stiffness_from", ""))
    return [Cloud("stiffness, sag and resonances", points, values, note)]


def _workspace(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    size, box = content["size"], content["bounding_box"]
    low, high = float(size["low"]), float(size["high"])
    unit = {"m3": "m³", "m2": "m²"}.get(str(size["unit"]), str(size["unit"]))
    note = f"{size['name']} {float(size['value']):.3g} {unit} ({low:.3g} to {high:.3g})"
    corners = np.array([box["lower"], box["upper"]], float)
    if not np.all(np.isfinite(corners)):
        raise InputError("file_format", f"{path}: its bounding_box must hold finite numbers")
    if content.get("cloud"):
        points = np.array(content["cloud"]["points"], float).reshape(-1, 3)
        values = {str(k): np.array(v, float) for k, v in content["cloud"].get("values", {}).items()}
        return [Cloud("workspace", points, values, note, corners), *_list_elastic_clouds(content)]
    if compute:
        points, values = recompute_workspace(robot, float(content["resolution_m"]), corners)
        return [Cloud("workspace", points, values, note + "; points computed now, coarsely", corners)]
    return [Cloud("workspace", np.zeros((0, 3)), {}, note + "; its box. --compute adds points", corners)]


def _accuracy(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    methods = [m for m in _BEST if m in content.get("methods", {})]
    grid, section = content.get("map"), content.get("section")
    if not methods or grid is None or section is None:
        worst = [content["methods"][m]["worst_pose"]["tool"] for m in methods]
        if not worst:
            raise InputError(
                "file_format", f"{path}: no errors of the tool in it; give the errors with --actuator-error"
            )
        values = {f"largest error, {m} [mm]": np.array([1e3 * content["methods"][m]["max"]]) for m in methods[:1]}
        return [Cloud("accuracy: worst pose", np.array(worst[:1], float), values)]
    u, v = np.array(grid["u"], float), np.array(grid["v"], float)
    axis = "xyz".index(section["axis"])
    a, b = (k for k in range(3) if k != axis)
    points = np.zeros((len(v), len(u), 3))
    points[..., axis], points[..., a], points[..., b] = float(section["value"]), u[None, :], v[:, None]
    maps = {m: 1e3 * np.array(grid[m], dtype=float) for m in methods}
    there = np.isfinite(maps[methods[0]])
    values = {f"largest error, {m} [mm]": x[there] for m, x in maps.items()}
    note = f"section {section['axis']} = {float(section['value']):.4g} m"
    return [Cloud("accuracy", points[there], values, note, flat=True)]


def _calibrate(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    findings = _diagnose(content, robot, path, compute)
    at = content.get("errors_at_poses")
    if at is None and compute:
        at = recompute_calibration(content, robot, path)
    if at is None:
        return findings
    points = np.array(at["points"], float).reshape(-1, 3)
    models = {str(k): np.array(v, float).reshape(-1, 3) for k, v in at["models"].items()}
    if not models or any(x.shape != points.shape for x in models.values()):
        raise ValueError("errors_at_poses: points and vectors differ in number")
    return [*findings, ErrorVectors(points, models)]


def _modes(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    from tau_dyn.modes import Mode, project_shapes_on_robot

    outputs = [str(name) for name in content["outputs_used"]]
    modes = []
    for m in content["modes"]:
        shape = np.array([complex(m["shape"][o]["re"], m["shape"][o]["im"]) for o in outputs])
        f, zeta = float(m["frequency_hz"]), float(m["damping_ratio"])
        modes.append(Mode(f, zeta, float("nan"), float("nan"), shape, float("nan")))
    shapes = project_shapes_on_robot(robot, modes, outputs)
    if shapes is None:
        why = "no mode" if not modes else f"its outputs ({', '.join(outputs)}) name no place of {robot.name}"
        raise InputError("unsupported", f"{path}: no mode to show: {why}")
    return [shapes]


def _identify(content: dict[str, Any], robot: Robot, path: Path, compute: bool) -> list[Content]:
    known = {p["name"]: p for p in content["parameters"]}
    links = {}
    for link in robot.links:
        p = known.get(f"{link.link}.mass")
        if p is not None:
            error, value = p.get("stderr"), float(p["value"])
            links[link.link] = float("nan") if error is None or not value else abs(float(error) / value)
    if not links:
        raise InputError("unsupported", f"{path}: no parameter is the mass of a link of {robot.name}")
    return [Uncertainty(links)]


_READERS: dict[str, Callable[[dict[str, Any], Robot, Path, bool], list[Content]]] = {
    "diagnose": _diagnose,
    "workspace": _workspace,
    "accuracy": _accuracy,
    "calibrate": _calibrate,
    "modes": _modes,
    "identify": _identify,
}
