"""Shapes of a robot file: boxes, cylinders, spheres and triangles, each in the frame of the joint that carries it.

A link without `<visual>` is drawn by its `<collision>`. Meshes are read by Coal, which comes with Pinocchio and reads STL, OBJ
and Collada (.dae) with Assimp. If a mesh is missing or cannot be read, only the picture lacks it; results do not change.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import coal
import numpy as np
import pinocchio as pin
from defusedxml.ElementTree import fromstring, tostring

from tau_dyn.exceptions import TauDynError
from tau_dyn.robot.expand import find_robot
from tau_dyn.robot.numbers import parse_numbers
from tau_dyn.robot.packages import resolve_mesh
from tau_dyn.robot.robot import Robot

_UNIT = re.compile(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]+)[\"']")
_HEAD_BYTES = 2**16  # part of a Collada file that contains its <asset>
MESH_SUFFIXES = (".stl", ".obj", ".dae")
_MAX_LISTED = 3  # names of meshes in one sentence
MAX_MESH_BYTES = 64 * 2**20
"""Largest size of one mesh file [bytes]; a link of a commercial arm has up to 2 MiB."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Attributes:
        path: The file.
        vertices: Vertices (n, 3) [m], scaled as given in the robot file.
        faces: Indices of vertices (m, 3), in order about the outward normal.
    """

    path: Path
    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class Visual:
    """A solid shape of the file.

    Attributes:
        name: Name of its link, with its number among the link's shapes.
        joint: Pinocchio's index of the joint that carries it; 0 for the world.
        placement: Pose in that joint's frame.
        shape: Coal's box, cylinder or sphere, or triangles.
        colour: Red, green, blue and opacity (4,) from 0 to 1; None if the file has no colour.
    """

    name: str
    joint: int
    placement: pin.SE3
    shape: Any
    colour: np.ndarray | None


def read_visuals(robot: Robot) -> tuple[list[Visual], list[str]]:
    """Return the shapes of the file, and the names of meshes that are missing or cannot be read."""
    root = fromstring(robot.urdf, forbid_dtd=True)
    for link in root.findall("link"):
        if link.find("visual") is None:
            for element in link.findall("collision"):
                element.tag = "visual"
    meshes, missing = _take_meshes(root, robot)
    geometry = pin.buildGeomFromUrdfString(robot.model, tostring(root, encoding="unicode"), pin.GeometryType.VISUAL)
    found = []
    for item in geometry.geometryObjects.tolist():
        shape = meshes[item.name] if item.name in meshes else item.geometry
        if shape is not None:
            # a copy: its memory is freed with the geometry
            colour = np.array(item.meshColor, float) if item.overrideMaterial else None
            found.append(Visual(item.name, int(item.parentJoint), item.placement.copy(), shape, colour))
    return found, missing


def _take_meshes(root: Element, robot: Robot) -> tuple[dict[str, Mesh | None], list[str]]:
    """Replace each mesh by a small box, so that Pinocchio opens no file; return the meshes by Pinocchio's names."""
    found: dict[str, Mesh | None] = {}
    missing: list[str] = []
    read: dict[tuple[str, str], Mesh | None] = {}
    near = _find_file(robot)
    for link in root.findall("link"):
        for k, visual in enumerate(link.findall("visual")):
            geometry = visual.find("geometry")
            mesh = None if geometry is None else geometry.find("mesh")
            if geometry is None or mesh is None:
                continue
            key = mesh.get("filename", ""), mesh.get("scale", "1 1 1")
            if key not in read:
                read[key] = read_mesh(resolve_mesh(key[0], near, robot.packages), key[1])
                missing += [key[0]] if read[key] is None else []
            found[f"{link.get('name', '')}_{k}"] = read[key]
            geometry.remove(mesh)
            geometry.append(geometry.makeelement("box", {"size": "1 1 1"}))
    return found, missing


def _find_file(robot: Robot) -> Path:
    try:
        return find_robot(robot.source)
    except TauDynError:  # a saved model's robot file may no longer exist
        return Path(robot.source)


def list_missing_meshes(names: Sequence[str]) -> list[str]:
    """Return a list with a sentence about missing meshes; empty if all exist."""
    if not names:
        return []
    listed = ", ".join(names[:_MAX_LISTED]) + (" and more" if len(names) > _MAX_LISTED else "")
    several = "meshes are" if len(names) > 1 else "mesh is"
    return [
        f"{len(names)} {several} not drawn, not found or not readable: {listed}; --package NAME=DIR gives its folder"
    ]


def read_mesh(path: Path | None, scale: str = "1 1 1") -> Mesh | None:
    """Return a mesh, or None if no mesh can be read."""
    factors = parse_numbers(scale) or []
    if path is None or path.suffix.lower() not in MESH_SUFFIXES or len(factors) not in (1, 3):
        return None
    try:
        if path.stat().st_size > MAX_MESH_BYTES:
            return None
        size = np.broadcast_to(np.array(factors, float), 3) * _read_unit(path)
        model = coal.MeshLoader().load(str(path), size)
    except (OSError, ValueError, RuntimeError):
        return None
    vertices = np.array(model.vertices(), float).reshape(-1, 3)
    faces = np.array([[f[0], f[1], f[2]] for f in map(model.tri_indices, range(model.num_tris))], int).reshape(-1, 3)
    if not len(faces) or not np.isfinite(vertices).all():
        return None
    return Mesh(path, vertices, faces[:, ::-1] if np.prod(factors) < 0 else faces)


def _read_unit(path: Path) -> float:
    """Return the unit [m] of a mesh's numbers: Collada files state it, Assimp does not apply it; elsewhere it is the metre."""
    if path.suffix.lower() != ".dae":
        return 1.0
    with path.open("rb") as file:
        found = _UNIT.search(file.read(_HEAD_BYTES))
    return float(found.group(1)) if found else 1.0
