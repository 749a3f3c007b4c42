"""Small robots whose workspaces are known on paper, written as URDF text."""

from __future__ import annotations

import numpy as np

from tau_dyn.robot import Robot, load_robot_from_urdf

_SPACES = 'xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"'


def joint(
    name: str, kind: str, parent: str, child: str, axis: str, xyz: str = "0 0 0", lo: float = -3, hi: float = 3
) -> str:
    """Return a joint and its child link."""
    limit = f'<limit lower="{lo}" upper="{hi}" velocity="2" effort="100"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    place = f'<axis xyz="{axis}"/><origin xyz="{xyz}"/>'
    return f'<link name="{child}"/><joint name="{name}" type="{kind}">{ends}{place}{limit}</joint>'


def drive(name: str) -> str:
    """Return a transmission."""
    kind = "<type>transmission_interface/SimpleTransmission</type>"
    return (
        f'<transmission name="{name}_drive">{kind}<joint name="{name}"/><actuator name="{name}_motor"/></transmission>'
    )


def tool(parent: str, xyz: str = "0 0 0") -> str:
    """Return the tool frame."""
    ends = f'<parent link="{parent}"/><child link="tool_link"/>'
    return f'<link name="tool_link"/><joint name="tool" type="fixed">{ends}<origin xyz="{xyz}"/></joint>'


def robot(name: str, *parts: str) -> Robot:
    """Return the robot around the parts."""
    return load_robot_from_urdf(
        f'<robot name="{name}" {_SPACES}><link name="base_link"/>{"".join(parts)}</robot>', name
    )


def cartesian(
    x: tuple[float, float] = (0.0, 0.5), y: tuple[float, float] = (-0.2, 0.2), z: tuple[float, float] = (0.0, 0.3)
) -> Robot:
    """Return three slides along x, y and z: the workspace is the box of their limits."""
    slides = [
        joint(name, "prismatic", parent, f"{name}_link", axis, lo=lim[0], hi=lim[1])
        for name, parent, axis, lim in (
            ("x", "base_link", "1 0 0", x), ("y", "x_link", "0 1 0", y), ("z", "y_link", "0 0 1", z),
        )
    ]  # fmt: skip
    return robot("cartesian", *slides, tool("z_link"), drive("x"), drive("y"), drive("z"))


def planar(upper: float = 0.4, lower: float = 0.3) -> Robot:
    """Return two turns about z, elbow bent at home: the tool fills an annulus."""
    return robot(
        "planar",
        joint("shoulder", "revolute", "base_link", "upper_link", "0 0 1", lo=-np.pi, hi=np.pi),
        joint("elbow", "revolute", "upper_link", "lower_link", "0 0 1", f"{upper} 0 0", lo=0.0, hi=3.1),
        tool("lower_link", f"{lower} 0 0"),
        drive("shoulder"),
        drive("elbow"),
        '<tau_dyn:home joint="shoulder" value="0.3"/><tau_dyn:home joint="elbow" value="1.3"/>',
    )


ROD, RAIL = 1.0, 0.5


def gantry(travel: float = 0.8, offset: float = RAIL, more: str = "") -> Robot:
    """Return three carts along x on parallel guideways, one rod each, a plate that translates; symmetric in y.

    Guideways through (y, z) = (offset, 0), (-offset, 0) and (0, 0.6); rods of ROD reach from the carts towards +x.
    """
    rails = {"1": (offset, 0.0), "2": (-offset, 0.0), "3": (0.0, 0.6)}
    parts, place = [], np.array([0.0, 0.0, 0.2])
    for k, (y, z) in rails.items():
        along = -np.sqrt(ROD**2 - y**2 - (place[2] - z) ** 2)
        parts.append(
            joint(
                f"cart{k}",
                "prismatic",
                "base_link",
                f"cart{k}_link",
                "1 0 0",
                f"0 {y} {z}",
                along - travel,
                along + travel,
            )
        )
        way = place - [along, y, z]
        yaw, pitch = np.arctan2(way[1], way[0]), -np.arctan2(way[2], np.hypot(way[0], way[1]))
        turn = f'<parent link="cart{k}_link"/><child link="yaw{k}_link"/><axis xyz="0 0 1"/><origin rpy="0 0 {yaw}"/>'
        limit = '<limit lower="-3" upper="3" velocity="9" effort="9"/>'
        parts.append(f'<link name="yaw{k}_link"/><joint name="yaw{k}" type="revolute">{turn}{limit}</joint>')
        turn = f'<parent link="yaw{k}_link"/><child link="rod{k}_link"/><axis xyz="0 1 0"/><origin rpy="0 {pitch} 0"/>'
        parts.append(f'<link name="rod{k}_link"/><joint name="pitch{k}" type="revolute">{turn}{limit}</joint>')
        c = "drake:ball_constraint"
        bodies = f'<{c}_body_A name="rod{k}_link"/><{c}_body_B name="plate_link"/>'
        parts.append(f'<{c}>{bodies}<{c}_p_AP value="{ROD} 0 0"/><{c}_p_BQ value="0 0 0"/></{c}>')
        parts.append(drive(f"cart{k}") + f'<tau_dyn:home joint="cart{k}" value="{along}"/>')
    at = " ".join(str(float(x)) for x in place)
    parts.append(joint("plate_x", "prismatic", "base_link", "px_link", "1 0 0", at))
    parts.append(joint("plate_y", "prismatic", "px_link", "py_link", "0 1 0"))
    parts.append(joint("plate_z", "prismatic", "py_link", "plate_link", "0 0 1"))
    return robot("gantry", *parts, tool("plate_link"), more)


def gantry_volume(travel: float, offset: float = RAIL, n: int = 400) -> float:
    """Return the volume on paper [m^3]: over y and z, the x that all carts reach; rods stay ahead of their carts."""
    y, z = (np.linspace(-1.7, 1.7, n), np.linspace(-1.2, 1.8, n))
    Y, Z = np.meshgrid(y, z, indexing="ij")
    low, high = np.full(Y.shape, -np.inf), np.full(Y.shape, np.inf)
    for rail_y, rail_z in ((offset, 0.0), (-offset, 0.0), (0.0, 0.6)):
        left = ROD**2 - (Y - rail_y) ** 2 - (Z - rail_z) ** 2
        home = -np.sqrt(ROD**2 - rail_y**2 - (0.2 - rail_z) ** 2)
        reach = np.sqrt(np.maximum(left, 0.0))
        low = np.where(left >= 0, np.maximum(low, home - travel + reach), 9.0)
        high = np.where(left >= 0, np.minimum(high, home + travel + reach), -9.0)
    return float(np.sum(np.maximum(high - low, 0.0)) * (y[1] - y[0]) * (z[1] - z[0]))


PRS_BASE, PRS_PLATE, PRS_ROD = 0.5, 0.3, 0.6
"""Radii of slides and plate joints, length of the rods [m]."""


def three_prs(travel: float = 0.12) -> Robot:
    """Return a 3-PRS: three slides along z, a hinge and a rod each, a plate on ball joints that the tree hangs on leg 1."""
    away, height = PRS_BASE - PRS_PLATE, np.sqrt(PRS_ROD**2 - (PRS_BASE - PRS_PLATE) ** 2)
    pitch, parts = float(np.arctan2(-height, -away)), []
    for k, turn in enumerate((0.0, 2 * np.pi / 3, -2 * np.pi / 3), 1):
        x, y = PRS_BASE * np.cos(turn), PRS_BASE * np.sin(turn)
        slide = f'<limit lower="{-travel}" upper="{travel}" velocity="1" effort="100"/><axis xyz="0 0 1"/>'
        ends = f'<parent link="base_link"/><child link="cart{k}_link"/><origin xyz="{x} {y} 0" rpy="0 0 {turn}"/>'
        parts.append(f'<link name="cart{k}_link"/><joint name="slide{k}" type="prismatic">{ends}{slide}</joint>')
        ends = f'<parent link="cart{k}_link"/><child link="rod{k}_link"/><origin rpy="0 {pitch} 0"/>'
        hinge = '<limit lower="-3" upper="3" velocity="9" effort="9"/><axis xyz="0 1 0"/>'
        parts.append(f'<link name="rod{k}_link"/><joint name="hinge{k}" type="revolute">{ends}{hinge}</joint>')
        if k > 1:
            c, at = "drake:ball_constraint", f"{PRS_PLATE * (np.cos(turn) - 1)} {PRS_PLATE * np.sin(turn)} 0"
            bodies = f'<{c}_body_A name="rod{k}_link"/><{c}_body_B name="plate_link"/>'
            parts.append(f'<{c}>{bodies}<{c}_p_AP value="{PRS_ROD} 0 0"/><{c}_p_BQ value="{at}"/></{c}>')
        parts.append(drive(f"slide{k}"))
    parent = "rod1_link"
    for axis, child in (("1 0 0", "ball_x_link"), ("0 1 0", "ball_y_link"), ("0 0 1", "plate_link")):
        place = f'<origin xyz="{PRS_ROD} 0 0" rpy="0 {-pitch} 0"/>' if parent == "rod1_link" else ""
        limit = f'<limit lower="-3" upper="3" velocity="9" effort="9"/><axis xyz="{axis}"/>'
        ends = f'<parent link="{parent}"/><child link="{child}"/>{place}'
        parts.append(f'<link name="{child}"/><joint name="to_{child}" type="revolute">{ends}{limit}</joint>')
        parent = child
    return robot("three_prs", *parts, tool("plate_link", f"{-PRS_PLATE} 0 0"))


def scara() -> Robot:
    """Return a SCARA of two turns about z, a slide along z and a turn about z at the tool."""
    return robot(
        "scara",
        joint("shoulder", "revolute", "base_link", "upper_link", "0 0 1", "0 0 0.4", lo=-2.0, hi=2.0),
        joint("elbow", "revolute", "upper_link", "lower_link", "0 0 1", "0.4 0 0", lo=0.2, hi=2.5),
        joint("lift", "prismatic", "lower_link", "quill_link", "0 0 -1", "0.3 0 0", lo=0.0, hi=0.2),
        joint("wrist", "revolute", "quill_link", "hand_link", "0 0 1", lo=-3.1, hi=3.1),
        tool("hand_link"),
        *(drive(name) for name in ("shoulder", "elbow", "lift", "wrist")),
        '<tau_dyn:home joint="elbow" value="1.2"/><tau_dyn:home joint="lift" value="0.1"/>',
    )
