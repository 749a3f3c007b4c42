"""Robots of other people's packages by name: `example-robot-data` (`ur5`) and `robot_descriptions` (`ur5e_description`).

The second clones repositories when one of its modules is imported. Here none is: a module's text says which file of which
repository it means, and the robot is there where that repository is in the cache.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, files as files_of
from pathlib import Path

_PATHS = ("URDF_PATH", "XACRO_PATH", "MJCF_PATH")
"""Names by which a description's module gives its robot file, the first that it has counts."""


@dataclass(frozen=True)
class StockRobot:
    """A robot file and the xacro arguments and package folders that it needs."""

    path: Path
    arguments: Mapping[str, str] = field(default_factory=dict)
    packages: Mapping[str, Path] = field(default_factory=dict)


@cache
def list_stock_robots() -> dict[str, Path]:
    """Return the robots of the installed package `example-robot-data`: name -> file; empty where it is not installed."""
    found: dict[str, Path] = {}
    try:
        listed = files_of("example-robot-data") or ()
    except PackageNotFoundError:
        return found
    urdfs = [file for file in listed if file.suffix == ".urdf" and "robots" in file.parts]
    for file in sorted(
        urdfs, key=lambda file: not file.stem.endswith("_robot")
    ):  # ur3.urdf beside ur3_robot.urdf is a part
        found.setdefault(file.stem.removesuffix("_robot"), Path(str(file.locate())))
    return found


def find_described_robot(name: str) -> StockRobot | None:
    """Return a robot of `robot_descriptions`, or None where that or its cache does not hold one of this name."""
    if not re.fullmatch(r"\w+_description", name):
        return None
    package = PathFinder.find_spec("robot_descriptions")
    folders = [] if package is None else list(package.submodule_search_locations or ())
    for folder in map(Path, folders):
        values = _read_module(folder / f"{name}.py", _list_caches(folder / "_repositories.py"))
        path = next((values[key] for key in _PATHS if isinstance(values.get(key), str)), None)
        if path is not None and Path(str(path)).is_file():
            arguments, packages = values.get("XACRO_ARGS"), values.get("XACRO_PACKAGE_PATHS")
            return StockRobot(
                Path(str(path)),
                {str(k): str(v) for k, v in arguments.items()} if isinstance(arguments, dict) else {},
                {str(k): Path(str(v)) for k, v in packages.items()} if isinstance(packages, dict) else {},
            )
    return None


def _list_caches(repositories: Path) -> dict[str, str]:
    """Return each repository's folder in the cache, by its name."""
    root = os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")
    text = repositories.read_text(encoding="utf-8") if repositories.is_file() else ""
    rows = re.findall(r'"([^"]+)": Repository\((.*?)\)', text, re.DOTALL)
    inside = {name: re.search(r'cache_path="([^"]+)"', body) for name, body in rows}
    return {name: os.path.join(os.path.expanduser(root), found.group(1)) for name, found in inside.items() if found}


def _read_module(module: Path, caches: Mapping[str, str]) -> dict[str, object]:
    """Return the values that a description's module assigns: texts, joined paths, and tables of them."""
    values: dict[str, object] = {}
    if not module.is_file():
        return values
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(target, ast.Name) and node.value is not None:
            values[target.id] = _evaluate(node.value, values, caches)
    return values


def _evaluate(node: ast.expr, values: Mapping[str, object], caches: Mapping[str, str]) -> object:
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name):
        return values.get(node.id)
    if isinstance(node, ast.Dict):
        keys = [None if key is None else _evaluate(key, values, caches) for key in node.keys]
        return dict(zip(keys, (_evaluate(value, values, caches) for value in node.values), strict=True))
    if isinstance(node, ast.Call):
        called = ast.unparse(node.func)
        parts = [_evaluate(argument, values, caches) for argument in node.args]
        if called.endswith("clone_to_cache") and parts:
            return caches.get(str(parts[0]))
        if called.endswith("path.join") and all(isinstance(part, str) for part in parts):
            return os.path.join(*map(str, parts))
    return None
