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
