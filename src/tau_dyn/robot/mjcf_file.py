"""An MJCF file as MuJoCo reads it: included files inserted, defaults of classes filled in, angles in radians.

MuJoCo itself is not needed. Reference: MuJoCo's documentation, chapters "Modeling" and "XML reference".
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.robot.mesh_inertia import FORMS
from tau_dyn.robot.numbers import MAX_LEVELS, MAX_NUMBER, build_rotation, parse_numbers

_MAX_BYTES = 32 * 2**20  # largest size of an included file, as of any robot file
_MAX_INCLUDED = 100  # files
_MOTORS = "motor position velocity intvelocity damper cylinder muscle adhesion plugin dcmotor pid orientation".split()
_TURNS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_MAIN = "main"


class Transform(NamedTuple):
    """A frame in another one: rotation (3, 3) and origin (3,) [m]."""

    rotation: np.ndarray
    origin: np.ndarray

    def __matmul__(self, other: Transform) -> Transform:
        """Return the frame that is placed at `other` in this one."""
        return Transform(self.rotation @ other.rotation, self.rotation @ other.origin + self.origin)

    def place(self, point: np.ndarray) -> np.ndarray:
        """Return a point (3,) of this frame in the outer one."""
        return self.rotation @ point + self.origin

    def invert(self) -> Transform:
        """Return the outer frame in this one."""
        return Transform(self.rotation.T, -self.rotation.T @ self.origin)


class MeshAsset(NamedTuple):
    """A mesh's path from the file's folder, its scale (3,), and the way in which its volume is summed."""

    path: str
    scale: np.ndarray
    inertia: str


STILL = Transform(np.eye(3), np.zeros(3))
"""The identity transform."""


@dataclass(frozen=True)
class Item:
    """An element with its class's defaults filled in; `where` is the beginning of messages about it."""

    tag: str
    values: Mapping[str, str]
    where: str
    compiler: Mapping[str, str]

    def get(self, key: str, default: str = "") -> str:
        """Return an attribute's text."""
        return self.values.get(key, default)

    def numbers(self, key: str, default: str, count: int | None = None) -> np.ndarray:
        """Return an attribute's numbers; a fixed count, or at least one.

        Raises:
            InputError: It has another count or is not numeric.
        """
        text = self.values.get(key, default)
        found = parse_numbers(text)
        if not found or (count is not None and len(found) != count) or not all(abs(x) <= MAX_NUMBER for x in found):
            wanted = "numbers" if count is None else f"{count} finite number(s)"
            raise InputError("robot_structure", f"{self.where}: {key}='{text}' must hold {wanted}")
        return np.array(found)

    def number(self, key: str, default: float) -> float:
        """Return an attribute's one number."""
        return float(self.numbers(key, repr(default), 1)[0])

    def angle(self, value: float) -> float:
        """Return an angle of the file in radians."""
        return value if self.compiler.get("angle", "degree") == "radian" else float(np.deg2rad(value))

    def limits(self, key: str, switch: str) -> np.ndarray | None:
        """Return a range (2,), or None if it is not in use."""
        said = self.get(switch, "auto")
        by_itself = self.compiler.get("autolimits", "true") != "false"
        if said == "false" or key not in self.values or (said != "true" and not by_itself):
            return None
        found = self.numbers(key, "0 0", 2)
        return found if found[0] < found[1] else None

    def pose(self) -> Transform:
        """Return the pose of the element in the file."""
        return Transform(self._rotation(), self.numbers("pos", "0 0 0", 3))

    def _rotation(self) -> np.ndarray:
        key = next((key for key in _TURNS if key in self.values), "")
        if not key:
            return np.eye(3)
        n = {"quat": 4, "axisangle": 4, "xyaxes": 6}.get(key, 3)
        x = self.numbers(key, "", n)
        if key == "euler":
            return self._turn_by_euler(x)
        size = np.linalg.norm(x[:3] if key in ("axisangle", "xyaxes") else x)
        if size < 1e-12:  # MuJoCo reads such a quaternion as the identity
            if key == "quat":
                return np.eye(3)
            raise InputError("robot_structure", f"{self.where}: {key}='{self.get(key)}' has no direction")
        if key == "quat":
            return turn_by_quaternion(x / size)
        if key == "axisangle":
            return turn_about(x[:3] / size, self.angle(x[3]))
        if key == "xyaxes":
            first = x[:3] / size
            second = x[3:] - (x[3:] @ first) * first
            second = second / np.linalg.norm(second)
            return np.stack([first, second, np.cross(first, second)], axis=1)
        return turn_z_to(x / size)

    def _turn_by_euler(self, angles: np.ndarray) -> np.ndarray:
        order, out = self.compiler.get("eulerseq", "xyz"), np.eye(3)
        if len(order) != 3 or not set(order.lower()) <= set("xyz"):
            raise InputError("robot_structure", f"{self.where}: eulerseq='{order}' must name three axes")
        for letter, angle in zip(order, angles, strict=True):
            turn = turn_about(np.eye(3)["xyz".index(letter.lower())], self.angle(angle))
            out = out @ turn if letter.islower() else turn @ out
        return out


class MjcfFile:
    """A file with its included ones.

    Attributes:
        where: The file's name in messages.
        folder: Its folder.
        root: Its `<mujoco>` element, with included files inserted.
        compiler: Settings of all `<compiler>` elements, the last of each name.
        defaults: Attributes by class and element.
        meshes: Meshes in separate files, by name.
    """

    def __init__(self, text: str, path: Path) -> None:
        """Read a file's text and its included files.

        Raises:
            InputError: An included file does not exist, is included twice, or is not XML without entities.
        """
        self.where, self.folder, self.root = str(path), path.parent, _parse(text, str(path))
        _include(self.root, path, self.where)
        self.compiler: dict[str, str] = {}
        self.defaults: dict[str, dict[str, dict[str, str]]] = {_MAIN: {}}
        for element in self.root.findall("compiler"):
            self.compiler |= dict(element.attrib)
        for element in self.root.findall("default"):
            self._read_defaults(element, element.get("class", _MAIN), {})
        self.meshes = {name: mesh for name, mesh in map(self._read_mesh, self.sections("asset")) if mesh is not None}
        self._colours = {
            item.get("name"): item.numbers("rgba", "1 1 1 1", 4)
            for item in (self.item(element) for element in self.sections("asset") if element.tag == "material")
        }

    def find_colour(self, geom: Item) -> np.ndarray | None:
        """Return a geom's colour (4,), its own or its material's, or None."""
        return geom.numbers("rgba", "", 4) if "rgba" in geom.values else self._colours.get(geom.get("material"))

    def _read_mesh(self, element: Element) -> tuple[str, MeshAsset | None]:
        """Return a mesh's name and asset; None if it is not a mesh, is given in the file itself, or is moved in its frame."""
        item = self.item(element)
        path = PurePosixPath(item.get("file").replace("\\", "/"))
        if element.tag != "mesh" or not path.name or {"refpos", "refquat"} & set(item.values):
            return "", None
        stripped = self.compiler.get("strippath", "false") == "true"
        folder = self.compiler.get("meshdir") or self.compiler.get("assetdir", "")
        where = PurePosixPath(folder) / (path.name if stripped else path)
        scale, form = item.numbers("scale", "1 1 1", 3), item.get("inertia", FORMS[0])
        return item.get("name") or path.stem, MeshAsset(str(where), scale, form)

    def item(self, element: Element, child_class: str = "") -> Item:
        """Return an element with the defaults of its class, or otherwise of the class that its body gives its children."""
        own = dict(element.attrib)
        name = own.get("class") or child_class or _MAIN
        where = f"{self.where}: <{element.tag} name='{own.get('name', '')}'>"
        if name not in self.defaults:
            raise InputError("robot_structure", f"{where}: there is no default class '{name}'")
        inherited = self.defaults[name].get("general" if element.tag in _MOTORS else element.tag, {})
        if any(key in own for key in _TURNS):
            inherited = {key: value for key, value in inherited.items() if key not in _TURNS}
        return Item(element.tag, {**inherited, **own}, where, self.compiler)

    def sections(self, tag: str) -> Iterator[Element]:
        """Yield the elements inside all sections of a name."""
        for section in self.root.findall(tag):
            yield from section

    def _read_defaults(self, element: Element, name: str, inherited: Mapping[str, Mapping[str, str]]) -> None:
        table = self.defaults.setdefault(name, {})
        for tag, values in inherited.items():
            table[tag] = {**values, **table.get(tag, {})}
        for child in element:
            if child.tag != "default":
                tag = "general" if child.tag in _MOTORS else child.tag
                table[tag] = {**table.get(tag, {}), **child.attrib}
        for child in element.findall("default"):
            if not child.get("class"):
                raise InputError("robot_structure", f"{self.where}: a <default> inside '{name}' lacks its class")
            self._read_defaults(child, child.get("class", ""), table)


def turn_by_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion, scalar first."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle [rad] about a unit vector."""
    return turn_by_quaternion(np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)]))


def turn_z_to(direction: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) of z to a unit direction; half a turn about x for -z."""
    axis, cosine = np.cross([0.0, 0.0, 1.0], direction), direction[2]
    size = np.linalg.norm(axis)
    if size < 1e-12:
        return np.eye(3) if cosine > 0 else build_rotation((np.pi, 0.0, 0.0))
    return turn_about(axis / size, float(np.arctan2(size, cosine)))


def _include(root: Element, file: Path, where: str) -> None:
    """Replace each `<include>` by the contents of its file, with paths relative to the outermost file."""
    seen, left = [file.resolve()], [(root, 0)]
    while left:
        element, level = left.pop()
        if level > MAX_LEVELS:
            raise InputError(
                "robot_structure", f"{where}: elements are nested more than {MAX_LEVELS} deep inside each other"
            )
        k = 0
        while k < len(element):
            child = element[k]
            if child.tag == "include":
                name = child.get("file", "")
                element[k : k + 1] = _read_included(file.parent, name, seen, where)
                seen.append((file.parent / name).resolve())
            else:
                left.append((child, level + 1))
                k += 1


def _read_included(folder: Path, name: str, seen: list[Path], where: str) -> list[Element]:
    path = folder / name
    if path.resolve() in seen:
        raise InputError("file_format", f"{where}: includes {path} twice, or itself")
    if len(seen) > _MAX_INCLUDED:
        raise InputError("file_too_large", f"{where}: includes more than {_MAX_INCLUDED} files")
    try:
        text = read_bytes(path, _MAX_BYTES)
    except OSError as fault:
        raise InputError("cannot_read", f"{where}: <include file='{name}'> cannot be read") from fault
    return list(_parse(text, str(path)))


def _parse(text: str | bytes, where: str) -> Element:
    try:
        return fromstring(text, forbid_dtd=True)
    except DefusedXmlException as fault:
        raise InputError("file_format", f"{where}: a robot file may not declare a document type or entities") from fault
    except ParseError as fault:
        raise InputError("file_format", f"{where}: not well-formed XML ({fault})") from fault
