"""Five machines whose forces do not come from `tau_dyn`'s own dynamics.

Serial arms: Pinocchio's recursive Newton-Euler on bodies that differ from the robot file. Linear axis: `m a`. Gantry-Tau: the
sphere intersection of three rods and Lagrange's equations of carts, uniform rods and plate, written out here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import files
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.log import Log
from tau_dyn.robot import INERTIAL, Robot, load_robot

MACHINES = ("planar_2r", "ur5", "panda", "linear_axis", "gantry_tau")
GRAVITY = np.array([0.0, 0.0, -9.81])
RATE_HZ, DURATION_S = 250.0, 40.0

_LINK = """<link name="{name}"><inertial><origin xyz="{c} 0 0"/><mass value="{m}"/>
<inertia ixx="0.01" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
_JOINT = """<joint name="{name}" type="revolute"><parent link="{a}"/><child link="{b}"/><origin xyz="{x} 0 0"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" velocity="10" effort="500"/></joint>"""
PLANAR_2R = "\n".join(
    [
        '<robot name="planar_2r"><link name="base_link"/>',
        _LINK.format(name="upper_link", c=0.25, m=6.0, i=0.15),
        _LINK.format(name="fore_link", c=0.2, m=3.0, i=0.05),
        _JOINT.format(name="shoulder", a="base_link", b="upper_link", x=0),
        _JOINT.format(name="elbow", a="upper_link", b="fore_link", x=0.5),
        "</robot>",
    ]
)
"""Two links in a vertical plane."""


@lru_cache
def build_robot(name: str) -> Robot:
    """Return the robot file as a user has it."""
    if name == "planar_2r":
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "planar_2r.urdf"
            path.write_text(PLANAR_2R)
            return load_robot(path)
    ends = {"ur5": "ur_description/urdf/ur5_robot.urdf", "panda": "panda_description/urdf/panda.urdf"}
    if name not in ends:
        return load_robot(name)
    found = next(f for f in files("example-robot-data") or () if str(f).endswith(ends[name]))
    joints = [f"panda_joint{i}" for i in range(1, 8)] if name == "panda" else None
    return load_robot(Path(str(found.locate())), actuated=joints)


@dataclass(frozen=True, eq=False)
class Made:
    """A sound log, with its machine and what is true of it.

    Attributes:
        robot: The robot file.
        log: The log.
        truth: Parameters by name.
        position: Logged positions (N, na).
        force: Logged forces (N, na).
        motion: True positions, velocities and accelerations, each (N, na).
        bodies: Forces of the bodies, without rotors and friction (N, na).
    """

    robot: Robot
    log: Log
    truth: Mapping[str, float]
    position: np.ndarray
    force: np.ndarray
    motion: tuple[np.ndarray, np.ndarray, np.ndarray]
    bodies: np.ndarray


def make_log(
    name: str,
    seed: int,
    *,
    spread: float = 0.15,
    gravity: np.ndarray = GRAVITY,
    noise: float = 0.01,
    duration_s: float = DURATION_S,
) -> Made:
    """Return a log of a machine whose bodies differ from the file by up to `spread`, with its own friction and motion."""
    rng = np.random.default_rng([MACHINES.index(name), seed])
    robot = build_robot(name)
    t = np.arange(round(RATE_HZ * duration_s)) / RATE_HZ
    q, v, a = draw_motion(robot, t, rng)
    factors = {link.link: rng.uniform(1 - spread, 1 + spread) for link in robot.links}
    values = {p.name: p.value for p in robot.parameters}
    for link in robot.links:
        for k in link.own:
            values[f"{link.link}.{INERTIAL[k]}"] *= factors[link.link]
    armature = np.zeros(robot.na)
    if name in ("ur5", "panda"):
        armature = rng.uniform(0.05, 1.0, robot.na)
    if name == "gantry_tau":
        bodies = _gantry_forces(robot, values, q, v, a, gravity)
    elif name == "linear_axis":
        bodies = values["carriage_link.mass"] * (a - gravity[0])
    else:
        bodies = forces_of_bodies(robot, values, q, v, a, gravity)
    rigid = bodies + armature * a
    values |= {f"{j}.armature": x for j, x in zip(robot.actuated, armature, strict=True)}
    size = np.sqrt(np.mean(rigid**2, axis=0)) + 0.05 * np.abs(rigid).max()
    force = rigid.copy()
    for k, joint in enumerate(robot.actuated):
        speed = np.abs(v[:, k]).max()
        fc, fv = rng.uniform(0.1, 0.3, 2) * size[k], rng.uniform(0.05, 0.3, 2) * size[k] / speed
        positive = v[:, k] > 0
        force[:, k] += np.where(positive, fc[0] + fv[0] * v[:, k], -fc[1] + fv[1] * v[:, k])
        values |= {f"{joint}.coulomb_pos": fc[0], f"{joint}.coulomb_neg": fc[1]}
        values |= {f"{joint}.viscous_pos": fv[0], f"{joint}.viscous_neg": fv[1]}
    position = q + 5e-6 * rng.normal(size=q.shape)
    force = force + noise * np.sqrt(np.mean(force**2, axis=0)) * rng.normal(size=q.shape)
    return Made(
        robot, as_log(robot, t, position, force, f"{name}_{seed}.csv"), values, position, force, (q, v, a), bodies
    )


def as_log(robot: Robot, t: np.ndarray, q: np.ndarray, tau: np.ndarray, name: str) -> Log:
    """Return positions and forces (N, na) as a log."""
    columns = {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    return Log(t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}, name)


def draw_motion(robot: Robot, t: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a sum of sines (N, na) around home: positions, velocities, accelerations."""
    sizes = {"prismatic": 0.12 if robot.na == 1 else 0.08, "revolute": 0.5}
    q = np.tile(robot.home, (t.size, 1)).astype(float)
    v, a = np.zeros_like(q), np.zeros_like(q)
    middle = [0.3 * (-1) ** k if kind == "revolute" else 0.0 for k, kind in enumerate(robot.joint_kinds)]
    q += middle
    for k, kind in enumerate(robot.joint_kinds):
        for f in rng.uniform(0.1, 1.6, 5):
            size, phase = sizes[kind] * rng.uniform(0.5, 1.0) / (1 + 2 * f), rng.uniform(0, 2 * np.pi)
            w = 2 * np.pi * f
            q[:, k] += size * np.sin(w * t + phase)
            v[:, k] += size * w * np.cos(w * t + phase)
            a[:, k] -= size * w**2 * np.sin(w * t + phase)
    return q, v, a


def forces_of_bodies(
    robot: Robot, values: Mapping[str, float], q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    model = robot.model.copy()
    for link in robot.links:
        full = link.nominal.copy()
        full[list(link.own)] = [values[n] for n in link.names]
        model.inertias[link.joint_id] = pin.Inertia.FromDynamicParameters(full)
    model.gravity.linear = gravity
    model.armature = np.zeros(model.nv)
    data = model.createData()
    at_q, at_v = robot.active_q, robot.active_v
    out = np.zeros_like(q)
    neutral = pin.neutral(model)
    for n in range(len(q)):
        full_q, full_v, full_a = neutral.copy(), np.zeros(model.nv), np.zeros(model.nv)
        full_q[at_q], full_v[at_v], full_a[at_v] = q[n], v[n], a[n]
        out[n] = pin.rnea(model, data, full_q, full_v, full_a)[at_v]
    return out


def _gantry_forces(
    robot: Robot, values: Mapping[str, float], q: np.ndarray, v: np.ndarray, a: np.ndarray, gravity: np.ndarray
) -> np.ndarray:
    origins = np.array([[0.04, 0, 1.44], [0.25, -1.31, 1.46], [0, 0, 0]])
    lengths, x = np.array([2.05, 1.82, 1.81]), np.array([1.0, 0, 0])
    carts = [values[f"cart{k}_link.mass"] for k in (1, 2, 3)]
    rods = [values[f"rod{k}_link.mass"] for k in (1, 2, 3)]
    plate = values["plate_link.mass"]
    centres = origins + q[:, :, None] * x
    tool = _meet(centres, lengths)
    rod = tool[:, None, :] - centres  # (N, 3, 3)
    J = np.linalg.solve(rod, np.eye(3) * rod[:, :, 0][:, :, None])  # rod . (p' - x q') = 0
    speed = np.einsum("nij,nj->ni", J, v)
    relative = speed[:, None, :] - v[:, :, None] * x
    right = rod[:, :, 0] * a - np.sum(relative**2, axis=2)
    acceleration = np.linalg.solve(rod, right[:, :, None])[:, :, 0]
    at_tool = plate * (acceleration - gravity)
    out = np.zeros_like(q)
    for k in range(3):
        at_cart = a[:, k, None] * x
        at_tool = at_tool + rods[k] * (acceleration / 3 + at_cart / 6 - gravity / 2)
        along = at_cart / 3 + acceleration / 6 - gravity / 2
        out[:, k] = carts[k] * (a[:, k] - gravity[0]) + rods[k] * along[:, 0]
    return out + np.einsum("ni,nij->nj", at_tool, J)


def _meet(centres: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return where three spheres meet (N, 3), on the side of larger x (trilateration)."""
    c1, c2, c3 = centres.transpose(1, 0, 2)
    d = np.linalg.norm(c2 - c1, axis=1, keepdims=True)
    ex = (c2 - c1) / d
    i = np.sum(ex * (c3 - c1), axis=1, keepdims=True)
    ey = c3 - c1 - i * ex
    j = np.linalg.norm(ey, axis=1, keepdims=True)
    ey = ey / j
    ez = np.cross(ex, ey)
    r1, r2, r3 = lengths
    x = (r1**2 - r2**2 + d**2) / (2 * d)
    y = (r1**2 - r3**2 + i**2 + j**2 - 2 * i * x) / (2 * j)
    z = np.sqrt(r1**2 - x**2 - y**2)
    both = [c1 + x * ex + y * ey + side * z * ez for side in (1, -1)]
    return np.where((both[0][:, :1] > both[1][:, :1]), *both)
