"""Loops, motors and joints of several freedoms from a YAML file next to a URDF, in the format of `example-parallel-robots`.

    closed_loop: [[frame_A, frame_B], ...]     links or joints, whose frames coincide
    type: ["3d", "6d", ...]                    their origins only, or their axes as well
    name_mot: [joint, ...]                     joints with a motor
    joint_name: [joint, ...]                   joints that the URDF draws as hinges
    joint_type: [SPHERICAL, UJOINT_XY, FIXED]  their true type: about x, y, z; about two axes; fixed

All of it is written into the URDF text, so that every later step reads one file. Source: Gepetto/example-parallel-robots,
`loader_tools.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, SubElement, register_namespace, tostring

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml

_NAMESPACES = {"drake": "http://drake.mit.edu", "tau_dyn": "urn:tau_dyn"}
_TIES = {"3d": "ball", "6d": "fixed"}
_AXES = {"X": "1 0 0", "Y": "0 1 0", "Z": "0 0 1"}
_KEYS = ("closed_loop", "type", "name_mot", "joint_name", "joint_type")


def find_loop_file(robot: Path) -> Path | None:
    """Return the YAML file of the same name next to a plain URDF, if it lists loops."""
    path = robot.with_suffix(".yaml")
    if robot.suffix != ".urdf" or not path.is_file():
        return None
    content = read_yaml(path)
    return path if isinstance(content, Mapping) and "closed_loop" in content else None


def add_loops(urdf: str, path: Path) -> str:
    """Return URDF text completed by the contents of a loop file.

    Args:
        urdf: Text of a plain URDF.
        path: The loop file.

    Raises:
        InputError: The file or the URDF cannot be understood.
        UnknownName: A frame or a joint is not in the URDF.
    """
    for prefix, uri in _NAMESPACES.items():
        register_namespace(prefix, uri)
    try:
        root = fromstring(urdf, forbid_dtd=True)
    except (ParseError, DefusedXmlException):
        return urdf  # refused with its reason by the next step
    content = _read(path)
    joints = {e.get("name", ""): e for e in root.findall("joint")}
    links = [e.get("name", "") for e in root.findall("link")]
    for joint, kind in zip(content["joint_name"], content["joint_type"], strict=True):
        _retype(root, _find(joints, joint, "joint", path), kind, path)
    for k, (pair, kind) in enumerate(zip(content["closed_loop"], content["type"], strict=True)):
        tie = SubElement(root, "constraint", name=f"loop{k + 1}", type=_TIES[kind.lower()])
        for side, frame in zip(("parent", "child"), pair, strict=True):
            SubElement(tie, side, link=frame if frame in links else _get_child(_find(joints, frame, "frame", path)))
    if root.find("transmission") is None:
        for joint in content["name_mot"]:
            _find(joints, joint, "joint", path)
            drive = SubElement(root, "transmission", name=f"drive_of_{joint}")
            SubElement(drive, "joint", name=joint)
    return tostring(root, encoding="unicode")


def _read(path: Path) -> dict[str, list[Any]]:
    """Return the lists of a loop file, after a check of their lengths."""
    content = read_yaml(path)
    found = {key: content.get(key) or [] for key in _KEYS}
    unknown = [key for key in content if key not in _KEYS]
    if unknown:
        raise InputError(
            "unsupported", f"{path}: {unknown[0]} is not read; a file with closed_loop has {', '.join(_KEYS)}"
        )
    names = (*found["name_mot"], *found["joint_name"], *found["joint_type"], *found["type"])
    pairs = [
        p for p in found["closed_loop"] if isinstance(p, list) and len(p) == 2 and all(isinstance(x, str) for x in p)
    ]
    sound = all(isinstance(value, list) for value in found.values()) and all(isinstance(name, str) for name in names)
    if not sound or len(pairs) != len(found["closed_loop"]):
        raise InputError(
            "file_format", f"{path}: closed_loop is a list of pairs of frames, the other keys are lists of names"
        )
    for one, other in (("closed_loop", "type"), ("joint_name", "joint_type")):
        if len(found[one]) != len(found[other]):
            raise InputError(
                "file_format", f"{path}: {one} has {len(found[one])} entries, {other} has {len(found[other])}"
            )
    odd = next((kind for kind in found["type"] if kind.lower() not in _TIES), None)
    if odd is not None:
        raise InputError("unsupported", f"{path}: a loop of type {odd}; 3d and 6d are read")
    return found


def _find(joints: Mapping[str, Element], name: str, what: str, path: Path) -> Element:
    if name not in joints:
        raise UnknownName(what, name, list(joints), str(path))
    return joints[name]


def _get_child(joint: Element) -> str:
    """Return the link whose frame is the joint's."""
    child = joint.find("child")
    return "" if child is None else child.get("link", "")


def _retype(root: Element, joint: Element, kind: str, path: Path) -> None:
    """Write a joint as its hinges, one after the other, the last one with its name."""
    axes = "XYZ" if kind == "SPHERICAL" else kind.removeprefix("UJOINT_")
    if kind == "FIXED":
        joint.set("type", "fixed")
        return
    if len(axes) not in (2, 3) or any(axis not in _AXES for axis in axes):
        raise InputError("unsupported", f"{path}: a joint of type {kind}; SPHERICAL, UJOINT_XY and FIXED are read")
    name, child, origin = joint.get("name", ""), _get_child(joint), joint.find("origin")
    parent = joint.find("parent")
    before, place = "" if parent is None else parent.get("link", ""), {} if origin is None else dict(origin.attrib)
    root.remove(joint)
    for k, axis in enumerate(axes):
        last = k == len(axes) - 1
        link = child if last else f"{name}_{axis.lower()}_link"
        if not last:
            SubElement(root, "link", name=link)
        hinge = SubElement(root, "joint", name=name if last else f"{name}_{axis.lower()}", type="continuous")
        SubElement(hinge, "parent", link=before)
        SubElement(hinge, "child", link=link)
        SubElement(hinge, "origin", place if k == 0 else {})
        SubElement(hinge, "axis", xyz=_AXES[axis])
        before = link
