"""What `<gazebo>` elements add to the tree of a robot file: loops, which are refused, and joints that follow others.

Gazebo closes loops by joints and plugins (`DetachableJoint`) outside the tree, and couples joints by the plugin
`gazebo_mimic_joint_plugin` of roboticsgroup, as old versions ignored `<mimic>`.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement

from tau_dyn.exceptions import InputError

_LINK_PAIRS = (("parent_link", "child_link"), ("parentLink", "childLink"), ("parent", "child"))
"""Names of the two links that a Gazebo joint or a plugin connects."""
_WORLD = "world"


def refuse_gazebo_loops(root: Element, where: str) -> None:
    """Reject loops that Gazebo closes outside of the tree: without them, the passive joints would count as fixed.

    Raises:
        InputError: A joint or a plugin of a `<gazebo>` element connects two links of the tree, or the world and a link that
            moves in it.
    """
    ends = {e.get("name", "") for e in root.findall("link")}
    still = _find_base(root)
    for kind, a, b in _list_connections(root):
        if a not in ends or b not in ends:
            moving = ({a, b} & ends) - still
            if _WORLD not in {a, b} or not moving:
                continue
            a, b = moving.pop(), min(still)
        name = kind.get("name", "") or kind.get("filename", "")
        raise InputError(
            "robot_structure",
            f"{where}: the <gazebo> {kind.tag} '{name}' closes a kinematic loop between {a} and {b}, which "
            "the tree does not have; write the loop as <drake:ball_constraint> with "
            f"<drake:ball_constraint_body_A name='{a}'/>, <drake:ball_constraint_body_B name='{b}'/> and "
            "their points, or as <constraint type='ball'>, and remove this element",
        )


def _list_connections(root: Element) -> Iterator[tuple[Element, str, str]]:
    """Yield the joints and plugins of `<gazebo>` elements with the names of the two links that they connect."""
    for element in root.findall("gazebo"):
        for kind in (*element.findall("plugin"), *element.findall("joint")):
            for names in _LINK_PAIRS:
                a, b = (_read_text(kind, name).split("::")[-1] for name in names)
                if a and b:
                    yield kind, a, b


def _find_base(root: Element) -> set[str]:
    """Return the links that do not move: the root of the tree, and those fixed to it."""
    parent_of = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parent_of[child.get("link", "")] = (parent.get("link", ""), joint.get("type") == "fixed")
    still = {name for e in root.findall("link") if (name := e.get("name", "")) not in parent_of}
    grown = True
    while grown:
        more = {child for child, (parent, fixed) in parent_of.items() if fixed and parent in still} - still
        still |= more
        grown = bool(more)
    return still


def write_gazebo_mimics(root: Element) -> None:
    """Write each mimic plugin of Gazebo as the `<mimic>` of its follower, where that has none, and remove the plugin.

    The plugin's position is `multiplier * position of joint + offset` [m or rad], that of URDF.
    """
    movable = {e.get("name", ""): e for e in root.findall("joint") if e.get("type") != "fixed"}
    for element in root.findall("gazebo"):
        for plugin in element.findall("plugin"):
            leader, follower = (_read_text(plugin, tag).split("::")[-1] for tag in ("joint", "mimicJoint"))
            if not leader or not follower:
                continue
            element.remove(plugin)
            if follower in movable and movable[follower].find("mimic") is None:
                law = {key: text for key in ("multiplier", "offset") if (text := _read_text(plugin, key))}
                SubElement(movable[follower], "mimic", {"joint": leader, **law})


def _read_text(element: Element, tag: str) -> str:
    """Return the text of a child element, or its attribute `link`, as some exporters write it; empty without one."""
    child = element.find(tag)
    return "" if child is None else ((child.text or "").strip() or child.get("link", ""))
