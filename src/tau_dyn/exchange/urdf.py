"""A model's robot as URDF: its source file, with the model's inertias, drive inertia and friction.

The inertia of links that are fixed to a moving link is added to that link, since data determine only the sum. Friction is
written to `<dynamics>`, drive inertia to Drake's `<drake:rotor_inertia>` (which our loader reads too), and mass on which only
gravity acts to our own element.
`<ros2_control>` lists each drive with an effort command within its limit, and position and velocity as states.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from defusedxml.ElementTree import fromstring

from tau_dyn.exchange.content import (
    BodyInertia,
    Exported,
    build_body,
    build_carried_model,
    format_header,
    list_nominal_parameters,
    list_omissions,
    read_joint_law,
    split,
)
from tau_dyn.model import Model
from tau_dyn.robot import remove_base_coordinates, resolve_mesh, write_gazebo_mimics

_DRAKE, _OURS = "http://drake.mit.edu", "urn:tau_dyn"
_HARDWARE = "mock_components/GenericSystem"  # mock hardware of ros2_control; a real drive has its own plugin
_ENTRIES = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))


def build_urdf(model: Model, folder: Path | None = None) -> Exported:
    """Return the model's robot as URDF text, which gives the same rigid-body forces when it is read again.

    The root of a robot with a floating base is its base link.

    Args:
        model: The model.
        folder: Folder of the file to be written, to which mesh paths are relative; None for the robot file's folder.
    """
    carried = build_carried_model(model, drives=False)
    left_out = list_omissions(model, drives=False)
    root = fromstring(model.robot.urdf, forbid_dtd=True)
    write_gazebo_mimics(root)
    if model.robot.base_coordinates:
        remove_base_coordinates(root)
    links = {e.get("name", ""): e for e in root.findall("link")}
    for link in model.robot.links:
        for name in _fixed_to(root, link.link):
            _remove(links[name], "inertial")
        _write_inertial(links[link.link], build_body(link, model))
    joints = {e.get("name", ""): e for e in root.findall("joint")}
    for joint in model.robot.mimics:  # their friction is included in that of the joint that they follow
        _remove(joints[joint], "dynamics")
    for joint in model.robot.driven:
        law = read_joint_law(carried, joint)
        _remove(joints[joint], "dynamics")
        _remove(joints[joint], "mimic")  # it does not count where the joint has a motor of its own
        SubElement(joints[joint], "dynamics", damping=_text(law.viscous), friction=_text(law.coulomb))
    _write_drives(root, carried)
    _write_ros2_control(root, model)
    _write_gravity_mass(root, model)
    if folder is not None:
        _move_meshes(root, Path(model.robot.source), folder)
    _remove(root, f"{{{_OURS}}}estimated_inertias")
    SubElement(
        root, f"{{{_OURS}}}estimated_inertias"
    )  # estimates fit forces and need not be consistent bodies: a loader should not check them
    for prefix, space in (("drake", _DRAKE), ("tau_dyn", _OURS)):
        ElementTree.register_namespace(prefix, space)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    text = f'<?xml version="1.0"?>\n<!-- {format_header(model, left_out)} -->\n{body}\n'
    return Exported(text, left_out, carried, list_nominal_parameters(model), split(model))


def _move_meshes(root: Element, source: Path, folder: Path) -> None:
    """Change relative mesh paths from the robot file's folder to another folder."""
    if source.parent.resolve() == folder.resolve():
        return
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        path = resolve_mesh(name, source)
        if "://" not in name and not Path(name).is_absolute() and path is not None:
            mesh.set("filename", Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def _fixed_to(root: Element, link: str) -> list[str]:
    """Return the links that are fixed to a link, directly or through others."""
    found, open_links = [], [link]
    while open_links:
        here = open_links.pop()
        for joint in root.findall("joint"):
            parent, child = joint.find("parent"), joint.find("child")
            if joint.get("type") == "fixed" and parent is not None and child is not None and parent.get("link") == here:
                found.append(child.get("link", ""))
                open_links.append(found[-1])
    return found


def _write_inertial(link: Element, body: BodyInertia) -> None:
    _remove(link, "inertial")
    inertial = Element("inertial")
    SubElement(inertial, "origin", xyz=" ".join(map(_text, body.centre)), rpy="0 0 0")
    SubElement(inertial, "mass", value=_text(body.mass))
    SubElement(inertial, "inertia", {name: _text(body.inertia[i, j]) for name, i, j in _ENTRIES})
    link.insert(0, inertial)


def _write_drives(root: Element, model: Model) -> None:
    """Add a transmission with the drive inertia to each actuated joint, and remove the transmissions of other joints."""
    kept: dict[str, Element] = {}
    for element in root.findall("transmission"):
        joint = element.find("joint")
        name = joint.get("name", "") if joint is not None else ""
        if name in model.robot.driven and name not in kept:
            kept[name] = element
        else:
            root.remove(element)
    for joint in model.robot.driven:
        actuator = _actuator(root, kept.get(joint), joint)
        for space in (_DRAKE, "https://drake.mit.edu"):
            for tag in ("rotor_inertia", "gear_ratio"):
                _remove(actuator, f"{{{space}}}{tag}")
        armature = read_joint_law(model, joint).armature
        if armature:
            SubElement(actuator, f"{{{_DRAKE}}}rotor_inertia", value=_text(armature))
            SubElement(actuator, f"{{{_DRAKE}}}gear_ratio", value="1")


def _actuator(root: Element, transmission: Element | None, joint: str) -> Element:
    """Return the actuator of a transmission; create it if it does not exist."""
    if transmission is None:
        transmission = SubElement(root, "transmission", name=f"{joint}_transmission")
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        SubElement(transmission, "joint", name=joint)
    actuators = transmission.findall("actuator")
    for extra in actuators[1:]:
        transmission.remove(extra)
    return actuators[0] if actuators else SubElement(transmission, "actuator", name=f"{joint}_motor")


def _write_ros2_control(root: Element, model: Model) -> None:
    """Add effort commands and states of each drive as `<ros2_control>`; a file that has this element is not changed."""
    if root.find("ros2_control") is not None:
        return
    system = SubElement(root, "ros2_control", name=f"{model.robot.name}_drives", type="system")
    SubElement(SubElement(system, "hardware"), "plugin").text = _HARDWARE
    limits = dict(zip(model.robot.actuated, model.robot.effort_limit, strict=True))
    for joint in model.robot.driven:
        limit = limits[joint]
        drive = SubElement(system, "joint", name=joint)
        command = SubElement(drive, "command_interface", name="effort")
        if np.isfinite(limit):
            for name, value in (("min", -limit), ("max", limit)):
                SubElement(command, "param", name=name).text = _text(value)
        for name in ("position", "velocity"):
            SubElement(drive, "state_interface", name=name)


def _write_gravity_mass(root: Element, model: Model) -> None:
    for element in root.findall(f"{{{_OURS}}}gravity_mass"):
        element.set("value", _text(model.robot.parameters[f"{element.get('link')}.gravity_mass"].value))


def _remove(parent: Element, tag: str) -> None:
    for element in parent.findall(tag):
        parent.remove(element)


def _text(x: float | np.floating) -> str:
    return repr(float(x))
