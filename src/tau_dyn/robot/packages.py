"""Where ROS packages lie: what `$(find NAME)` and `package://NAME` mean on a machine with or without ROS.

Looked for in this order: folders given by hand; the folders around the file, up to a `package.xml` and beside it; those of
AMENT_PREFIX_PATH, CMAKE_PREFIX_PATH and ROS_PACKAGE_PATH; packages that pip installed. Nothing is imported and no program
is called.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping
from importlib.machinery import PathFinder
from pathlib import Path

from tau_dyn.exceptions import InputError

_MAX_FOLDERS_UP = 8  # from a robot file to its workspace's root
_MAX_LEVELS_DOWN = 3  # from a folder of ROS_PACKAGE_PATH to a package in it
_MANIFEST = "package.xml"


def find_package(name: str, near: Path, given: Mapping[str, str | Path] | None = None) -> Path:
    """Return a package's folder.

    Args:
        name: The package's name.
        near: The robot file that asks for it.
        given: Folders by package name, which count first.

    Raises:
        InputError: It is nowhere; the sentence says how to name its folder.
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
    """Return the file that a mesh's `filename` means, or None where it is not there.

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
        package, _, inside = rest.lstrip("/").partition("/")  # some files have a slash too many
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
