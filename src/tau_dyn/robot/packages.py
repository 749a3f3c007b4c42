"""Folders of ROS packages: the meaning of `$(find NAME)` and `package://NAME` on a machine with or without ROS.

Packages are searched in this order: folders given by the user; the parent folders of the file, up to a `package.xml`, and the
folders next to that; those of AMENT_PREFIX_PATH, CMAKE_PREFIX_PATH and ROS_PACKAGE_PATH; packages that pip installed. Nothing
is imported and no program is called.

Robots of other packages are found by name: `example-robot-data` (`ur5`) and `robot_descriptions` (`ur5e_description`).

`robot_descriptions` clones repositories when one of its modules is imported, so it is not imported here: the module's text
names the repository and the file, and the robot is available if that repository is in the cache.
"""

from __future__ import annotations

import ast
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, files as files_of
from pathlib import Path

from tau_dyn.exceptions import InputError

_MAX_FOLDERS_UP = 8  # from a robot file to its workspace's root
_MAX_LEVELS_DOWN = 3  # from a folder of ROS_PACKAGE_PATH to a package in it
_MANIFEST = "package.xml"


def find_package(name: str, near: Path, given: Mapping[str, str | Path] | None = None) -> Path:
    """Return a package's folder.

    Args:
        name: The package's name.
        near: The robot file that refers to it.
        given: Folders by package name, which are searched first.

    Raises:
        InputError: It is not found; the message explains how to give its folder.
    """
    if given and name in given:
        folder = Path(given[name])
        if not folder.is_dir():
            raise InputError("file_not_found", f"--package {name}={folder}: no such folder")
        return folder.resolve()
    if re.fullmatch(r"[\w.-]+", name) and name.strip("."):
        found = next((folder for folder in _iterate_candidates(name, near) if folder.is_dir()), None)
        if found is not None:
            return found
    raise InputError(
        "file_not_found",
        f"{near}: the ROS package '{name}' is not around the file, in AMENT_PREFIX_PATH, in ROS_PACKAGE_PATH or among pip's; "
        f"name its folder with --package {name}=DIR",
    )


def resolve_mesh(name: str, near: Path, given: Mapping[str, str | Path] | None = None) -> Path | None:
    """Return the file that a mesh's `filename` denotes, or None if it does not exist.

    Args:
        name: A path, `file://...`, `package://NAME/...` or `model://NAME/...`.
        near: The robot file; relative paths start at its folder.
        given: Folders by package name.
    """
    scheme, separator, rest = name.partition("://")
    if not separator:
        path = near.parent / name
    elif scheme == "file":
        path = Path(rest)
    else:
        package, _, inside = rest.lstrip("/").partition("/")  # some files have an extra slash
        try:
            path = find_package(package, near, given) / inside
        except InputError:
            return None
    return path if path.is_file() else None


def _iterate_candidates(name: str, near: Path) -> Iterator[Path]:
    for folder in list(near.resolve().parents)[:_MAX_FOLDERS_UP]:
        if folder.name == name or _read_name(folder / _MANIFEST) == name:
            yield folder
        yield from (inside for inside in (folder / name, folder / "src" / name) if (inside / _MANIFEST).is_file())
    for variable in ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"):
        yield from (folder / "share" / name for folder in _list_folders(variable))
    for folder in _list_folders("ROS_PACKAGE_PATH"):
        yield from _search(folder, name)
    installed = [Path(folder) for folder in sys.path if folder]
    for share in [Path(sys.prefix) / "share", *(folder / "cmeel.prefix" / "share" for folder in installed)]:
        yield from (share / name, share / "example-robot-data" / "robots" / name)
    if name.isidentifier() and (spec := PathFinder.find_spec(name)) and spec.submodule_search_locations:
        yield from map(Path, spec.submodule_search_locations)


def _list_folders(variable: str) -> list[Path]:
    return [Path(text) for text in os.environ.get(variable, "").split(os.pathsep) if text]


def _search(root: Path, name: str) -> Iterator[Path]:
    """Yield the folders of a package of this name in a workspace."""
    level = [root]
    for _ in range(_MAX_LEVELS_DOWN + 1):
        inside: list[Path] = []
        for folder in level:
            if (folder / _MANIFEST).is_file():
                if folder.name == name or _read_name(folder / _MANIFEST) == name:
                    yield folder
            else:
                inside += _list_inside(folder)
        level = inside


def _list_inside(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError:
        return []


def _read_name(manifest: Path) -> str:
    try:
        found = re.search(r"<name>\s*([^<\s]+)\s*</name>", manifest.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return ""
    return found.group(1) if found else ""


_PATHS = ("URDF_PATH", "XACRO_PATH", "MJCF_PATH")
"""Names of a description module's variables for its robot file; the first existing one is used."""


@dataclass(frozen=True)
class StockRobot:
    """A robot file with the xacro arguments and package folders that it needs."""

    path: Path
    arguments: Mapping[str, str] = field(default_factory=dict)
    packages: Mapping[str, Path] = field(default_factory=dict)


@cache
def list_stock_robots() -> dict[str, Path]:
    """Return the robots of the installed package `example-robot-data`: name -> file; empty if it is not installed."""
    found: dict[str, Path] = {}
    try:
        listed = files_of("example-robot-data") or ()
    except PackageNotFoundError:
        return found
    urdfs = [file for file in listed if file.suffix == ".urdf" and "robots" in file.parts]
    for file in sorted(
        urdfs, key=lambda file: not file.stem.endswith("_robot")
    ):  # ur3.urdf next to ur3_robot.urdf is a part
        found.setdefault(file.stem.removesuffix("_robot"), Path(str(file.locate())))
    return found


def find_described_robot(name: str) -> StockRobot | None:
    """Return a robot of `robot_descriptions`, or None if the package or its cache has no robot of this name."""
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
