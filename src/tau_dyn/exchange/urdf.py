"""A model's robot as URDF: the file it came from, with the model's inertias, drive inertia and friction put in.

Links that are fixed to a moving link lose their own inertia to it, since data see only their sum. Friction goes to `<dynamics>`,
drive inertia to Drake's `<drake:rotor_inertia>` (which our loader reads too), mass that only gravity feels to our own element.
"""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from defusedxml.ElementTree import fromstring

from tau_dyn.exchange.content import (
    BodyInertia,
    Exported,
    build_body,
    compute_friction,
    format_header,
    list_nominal_parameters,
    list_omitted_effects,
    split,
)
from tau_dyn.model import Model

_DRAKE, _OURS = "http://drake.mit.edu", "urn:tau_dyn"
_ENTRIES = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))


def build_urdf(model: Model) -> Exported:
    """Return the model's robot as URDF text, which reads back with the same rigid-body forces."""
    root = fromstring(model.robot.urdf, forbid_dtd=True)
    links = {e.get("name", ""): e for e in root.findall("link")}
    for link in model.robot.links:
        for name in _fixed_to(root, link.link):
            _remove(links[name], "inertial")
        _write_inertial(links[link.link], build_body(link, model))
    joints = {e.get("name", ""): e for e in root.findall("joint")}
    for joint in model.robot.mimics:  # their friction is within that of the joint that they follow
        _remove(joints[joint], "dynamics")
    for joint in model.robot.actuated:
        friction = compute_friction(model, joint)
        _remove(joints[joint], "dynamics")
        SubElement(joints[joint], "dynamics", damping=_text(friction["viscous"]), friction=_text(friction["coulomb"]))
    _write_drives(root, model)
    _write_gravity_mass(root, model)
    _remove(root, f"{{{_OURS}}}estimated_inertias")
    SubElement(
        root, f"{{{_OURS}}}estimated_inertias"
    )  # data fit forces, not bodies: a loader should not ask for sound ones
    for prefix, space in (("drake", _DRAKE), ("tau_dyn", _OURS)):
        ElementTree.register_namespace(prefix, space)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    text = f'<?xml version="1.0"?>\n<!-- {format_header(model)} -->\n{body}\n'
    return Exported(text, list_omitted_effects(model), list_nominal_parameters(model), split(model))


def _fixed_to(root: Element, link: str) -> list[str]:
    """Return the links that are fixed to a link, directly or over others."""
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
    """Give each actuated joint, and no other, a transmission with its drive inertia."""
    kept: dict[str, Element] = {}
    for element in root.findall("transmission"):
        joint = element.find("joint")
        name = joint.get("name", "") if joint is not None else ""
        if name in model.robot.actuated and name not in kept:
            kept[name] = element
        else:
            root.remove(element)
    for joint in model.robot.actuated:
        actuator = _actuator(root, kept.get(joint), joint)
        for space in (_DRAKE, "https://drake.mit.edu"):
            for tag in ("rotor_inertia", "gear_ratio"):
                _remove(actuator, f"{{{space}}}{tag}")
        armature = model.robot.parameters[f"{joint}.armature"].value
        if armature:
            SubElement(actuator, f"{{{_DRAKE}}}rotor_inertia", value=_text(armature))
            SubElement(actuator, f"{{{_DRAKE}}}gear_ratio", value="1")


def _actuator(root: Element, transmission: Element | None, joint: str) -> Element:
    """Return the one actuator of a transmission, which is made where there is none."""
    if transmission is None:
        transmission = SubElement(root, "transmission", name=f"{joint}_transmission")
        SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
        SubElement(transmission, "joint", name=joint)
    actuators = transmission.findall("actuator")
    for extra in actuators[1:]:
        transmission.remove(extra)
    return actuators[0] if actuators else SubElement(transmission, "actuator", name=f"{joint}_motor")


def _write_gravity_mass(root: Element, model: Model) -> None:
    for element in root.findall(f"{{{_OURS}}}gravity_mass"):
        element.set("value", _text(model.robot.parameters[f"{element.get('link')}.gravity_mass"].value))


def _remove(parent: Element, tag: str) -> None:
    for element in parent.findall(tag):
        parent.remove(element)


def _text(x: float | np.floating) -> str:
    return repr(float(x))
