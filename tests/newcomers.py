"""Five parallel robots as a newcomer writes them: plate and tool in the tree of the first leg, the others closed by balls."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.robot import Robot, load_robot_from_urdf

_SPACES = 'xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"'


def _numbers(values) -> str:
    return " ".join(f"{float(x):.15g}" for x in values)


def _link(name: str, mass: float = 1.0) -> str:
    inertia = f'<inertia ixx="{mass}e-2" iyy="{mass}e-2" izz="{mass}e-2" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    axis,
    xyz=(0, 0, 0),
    rpy=(0, 0, 0),
    travel: float = 3.0,
    mass: float = 1.0,
) -> str:
    limit = f'<limit lower="{-travel}" upper="{travel}" velocity="5" effort="500"/>'
    place = f'<origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/><axis xyz="{_numbers(axis)}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'{_link(child, mass)}<joint name="{name}" type="{kind}">{ends}{place}{limit}</joint>'


def _drive(name: str) -> str:
    kind = "<type>transmission_interface/SimpleTransmission</type>"
    return f'<transmission name="{name}_t">{kind}<joint name="{name}"/><actuator name="{name}_m"/></transmission>'


def _ball(a: str, b: str, at_a, at_b) -> str:
    return (
        f'<drake:ball_constraint><drake:ball_constraint_body_A name="{a}"/><drake:ball_constraint_body_B name="{b}"/>'
        f'<drake:ball_constraint_p_AP value="{_numbers(at_a)}"/><drake:ball_constraint_p_BQ value="{_numbers(at_b)}"/>'
        "</drake:ball_constraint>"
    )


def _home(joint: str, value: float) -> str:
    return f'<tau_dyn:home joint="{joint}" value="{value:.15g}"/>'


def _tool(parent: str, xyz=(0, 0, 0)) -> str:
    ends = f'<parent link="{parent}"/><child link="tool"/><origin xyz="{_numbers(xyz)}"/>'
    return f'<link name="tool"/><joint name="tool_mount" type="fixed">{ends}</joint>'


def _robot(name: str, parts: list[str]) -> Robot:
    return load_robot_from_urdf(f'<robot name="{name}" {_SPACES}><link name="base"/>{"".join(parts)}</robot>', name)


def _bend(shoulder: np.ndarray, tip: np.ndarray, upper: float, lower: float, sign: float) -> tuple[float, float]:
    """Return the angles of a planar arm of two links, the second relative to the first."""
    d = tip - shoulder
    elbow = sign * np.arccos((d @ d - upper**2 - lower**2) / (2 * upper * lower))
    return float(np.arctan2(d[1], d[0]) - np.arctan2(lower * np.sin(elbow), upper + lower * np.cos(elbow))), float(
        elbow
    )


UPPER, LOWER = 0.3, 0.45


def five_bar(mirrored: bool = False) -> Robot:
    """Return two arms of two links whose tips meet in the tool; mirrored: below the line between the elbows."""
    tip, parts, arms = np.array([0.15, 0.5]), [], []
    for x, sign in ((0.0, -1.0), (0.3, 1.0)):
        shoulder, _ = _bend(np.array([x, 0.0]), tip, UPPER, LOWER, sign)
        arms.append((x, shoulder, np.array([x + UPPER * np.cos(shoulder), UPPER * np.sin(shoulder)])))
    if mirrored:
        along = (arms[1][2] - arms[0][2]) / np.linalg.norm(arms[1][2] - arms[0][2])
        tip = arms[0][2] + 2 * along * (along @ (tip - arms[0][2])) - (tip - arms[0][2])
    for k, (x, shoulder, elbow) in enumerate(arms, 1):
        bend = float(np.arctan2(*(tip - elbow)[::-1])) - shoulder
        parts += [
            _joint(f"motor{k}", "revolute", "base", f"upper{k}", (0, 0, 1), (x, 0, 0)),
            _joint(f"elbow{k}", "revolute", f"upper{k}", f"lower{k}", (0, 0, 1), (UPPER, 0, 0), travel=6.0),
            _drive(f"motor{k}"), _home(f"motor{k}", shoulder), _home(f"elbow{k}", bend),
        ]  # fmt: skip
    ball = _ball("lower1", "lower2", (LOWER, 0, 0), (LOWER, 0, 0))
    return _robot("five_bar", [*parts, _tool("lower1", (LOWER, 0, 0)), ball])


def _planar_corners() -> tuple[np.ndarray, np.ndarray]:
    """Return base and plate corners (3, 2) of planar robots; the plate's about its middle."""
    angles = np.deg2rad([-150.0, -30.0, 90.0])
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return 0.5 * ring, 0.12 * ring


def three_rrr() -> Robot:
    """Return a planar plate on three arms of two links, motors at the shoulders."""
    base, plate = _planar_corners()
    parts, place, turn = [], np.array([0.03, 0.02]), 0.1
    R = Rotation.from_euler("z", turn).as_matrix()[:2, :2]
    for k, (A, b) in enumerate(zip(base, plate, strict=True), 1):
        shoulder, elbow = _bend(A, place + R @ b, 0.3, 0.3, 1.0)
        parts += [
            _joint(f"motor{k}", "revolute", "base", f"upper{k}", (0, 0, 1), (*A, 0)),
            _joint(f"elbow{k}", "revolute", f"upper{k}", f"lower{k}", (0, 0, 1), (0.3, 0, 0)),
            _drive(f"motor{k}"), _home(f"motor{k}", shoulder), _home(f"elbow{k}", elbow),
        ]  # fmt: skip
        if k == 1:
            parts += [
                _joint("wrist1", "revolute", "lower1", "plate", (0, 0, 1), (0.3, 0, 0), mass=2.0),
                _home("wrist1", turn - shoulder - elbow), _tool("plate", (*-b, 0)),
            ]  # fmt: skip
        else:
            parts.append(_ball(f"lower{k}", "plate", (0.3, 0, 0), (*(b - plate[0]), 0)))
    return _robot("three_rrr", parts)


def three_rpr() -> Robot:
    """Return a planar plate on three telescopic legs, turned at home, where they do not meet in one point."""
    base, plate = _planar_corners()
    parts, place, turn = [], np.array([0.02, 0.03]), 0.8
    R = Rotation.from_euler("z", turn).as_matrix()[:2, :2]
    for k, (A, b) in enumerate(zip(base, plate, strict=True), 1):
        d = place + R @ b - A
        angle, length = float(np.arctan2(d[1], d[0])), float(np.linalg.norm(d))
        parts += [
            _joint(f"pivot{k}", "revolute", "base", f"sleeve{k}", (0, 0, 1), (*A, 0)),
            _joint(f"motor{k}", "prismatic", f"sleeve{k}", f"rod{k}", (1, 0, 0), (0.2, 0, 0), travel=0.5),
            _drive(f"motor{k}"), _home(f"motor{k}", length - 0.2), _home(f"pivot{k}", angle),
        ]  # fmt: skip
        if k == 1:
            parts += [_joint("wrist1", "revolute", "rod1", "plate", (0, 0, 1), mass=2.0), _home("wrist1", turn - angle),
                      _tool("plate", (*-b, 0))]  # fmt: skip
        else:
            parts.append(_ball(f"rod{k}", "plate", (0, 0, 0), (*(b - plate[0]), 0)))
    return _robot("three_rpr", parts)


def _aim(u: np.ndarray) -> tuple[float, float]:
    """Return turns about x and then y that bring z to a direction."""
    return float(np.arctan2(-u[1], u[2])), float(np.arcsin(u[0]))


def six_pus() -> Robot:
    """Return a plate on six rods of 0.7 m between vertical slides and balls: universal joints below."""
    parts = []
    angles = np.deg2rad([10, 110, 130, 230, 250, 350]), np.deg2rad([50, 70, 170, 190, 290, 310])
    base, plate = (
        r * np.stack([np.cos(a), np.sin(a), 0 * a], axis=1) for r, a in zip((0.6, 0.25), angles, strict=True)
    )
    place, rod = np.array([0.02, -0.03, 0.7]), 0.7
    turned = Rotation.from_euler("xyz", [0.05, -0.04, 0.1])
    for k, (A, b) in enumerate(zip(base, plate, strict=True), 1):
        B = place + turned.apply(b)
        height = B[2] - np.sqrt(rod**2 - np.sum((B - A)[:2] ** 2))
        u = (B - A - [0, 0, height]) / rod
        first, second = _aim(u)
        parts += [
            _joint(f"motor{k}", "prismatic", "base", f"cart{k}", (0, 0, 1), A, travel=0.6),
            _joint(f"cross{k}", "revolute", f"cart{k}", f"cross{k}_link", (1, 0, 0), mass=0.1),
            _joint(f"swing{k}", "revolute", f"cross{k}_link", f"rod{k}", (0, 1, 0)),
            _drive(f"motor{k}"), _home(f"motor{k}", float(height)), _home(f"cross{k}", first), _home(f"swing{k}", second),
        ]  # fmt: skip
        if k == 1:
            rest = Rotation.from_euler("XY", [first, second]).inv() * turned
            names = zip("xyz", np.eye(3), rest.as_euler("XYZ"), strict=True)
            parent, child = "rod1", ""
            for axis, way, value in names:
                child = "plate" if axis == "z" else f"ball_{axis}"
                start = (0, 0, rod) if axis == "x" else (0, 0, 0)
                parts += [_joint(f"ball1_{axis}", "revolute", parent, child, way, start, mass=3.0 if axis == "z" else 0.1),
                          _home(f"ball1_{axis}", float(value))]  # fmt: skip
                parent = child
            parts.append(_tool("plate", -b + [0, 0, 0.1]))
        else:
            parts.append(_ball(f"rod{k}", "plate", (0, 0, rod), b - plate[0]))
    return _robot("six_pus", parts)


def three_prs() -> Robot:
    """Return a plate on three rods of 0.6 m: vertical slides, hinges across the radius below, balls above."""
    parts, rod, height = [], 0.6, 0.65
    for k, angle in enumerate(np.deg2rad([0.0, 120.0, 240.0]), 1):
        lean = float(np.arcsin((0.45 - 0.25) / rod))
        parts += [
            _joint(f"motor{k}", "prismatic", "base", f"cart{k}", (0, 0, 1),
                   (0.45 * np.cos(angle), 0.45 * np.sin(angle), 0), (0, 0, angle), travel=0.6),
            _joint(f"hinge{k}", "revolute", f"cart{k}", f"rod{k}", (0, 1, 0)),
            _drive(f"motor{k}"), _home(f"motor{k}", height - rod * np.cos(lean)), _home(f"hinge{k}", -lean),
        ]  # fmt: skip
        b = 0.25 * np.array([np.cos(angle), np.sin(angle), 0])
        if k == 1:
            parts += [
                _joint("ball1_y", "revolute", "rod1", "ball_y", (0, 1, 0), (0, 0, rod), mass=0.1), _home("ball1_y", lean),
                _joint("ball1_x", "revolute", "ball_y", "ball_x", (1, 0, 0), mass=0.1),
                _joint("ball1_z", "revolute", "ball_x", "plate", (0, 0, 1), mass=3.0),
                _tool("plate", -b + [0, 0, 0.08]),
            ]  # fmt: skip
            first = b
        else:
            parts.append(_ball(f"rod{k}", "plate", (0, 0, rod), b - first))
    return _robot("three_prs", parts)


ROBOTS = {
    "five_bar": five_bar,
    "three_rrr": three_rrr,
    "three_rpr": three_rpr,
    "six_pus": six_pus,
    "three_prs": three_prs,
}
