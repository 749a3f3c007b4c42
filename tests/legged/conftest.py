"""A small walker with known forces: a trunk on four legs of three joints, whose feet come and go."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.legged import compute_contact_jacobian
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import Robot, load_robot

LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
RADIUS = 0.02  # [m] of the balls that are the feet
COULOMB, VISCOUS = 0.15, 0.05  # [N m, N m s/rad] of every joint
RATE = 200.0  # [Hz]


def write_walker(write) -> str:
    """Return a quadruped as URDF text; its root carries the trunk's mass."""
    parts = [write.link("trunk", 6.0, "0.02 0.005 0.01", "0.02 0.06 0.07")]
    for leg, (x, y) in LEGS.items():
        side = np.sign(y)
        parts += [
            write.link(f"{leg}_hip", 0.5, f"0 {0.02 * side} 0", "5e-4 5e-4 5e-4"),
            write.link(f"{leg}_thigh", 0.7, f"0 {0.01 * side} -0.05", "2e-3 2e-3 4e-4"),
            write.link(f"{leg}_shank", 0.2, "0.003 0 -0.09", "8e-4 8e-4 5e-5"),
            f'<link name="{leg}_foot"><collision><geometry><sphere radius="{RADIUS}"/></geometry></collision></link>',
            write.joint(f"{leg}_abduction", "revolute", "trunk", f"{leg}_hip", "1 0 0", f"{x} {y} 0"),
            write.joint(f"{leg}_swing", "revolute", f"{leg}_hip", f"{leg}_thigh", "0 1 0", f"0 {0.04 * side} 0"),
            write.joint(f"{leg}_knee", "revolute", f"{leg}_thigh", f"{leg}_shank", "0 1 0", "0 0 -0.2"),
            f'<joint name="{leg}_ankle" type="fixed"><parent link="{leg}_shank"/><child link="{leg}_foot"/>'
            '<origin xyz="0 0 -0.2"/></joint>',
            *(write.drive(f"{leg}_{joint}") for joint in ("abduction", "swing", "knee")),
        ]
    body = "".join(parts)
    return f'<robot name="walker" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn">{body}</robot>'


def move(
    robot: Robot, seconds: float, seed: int, rate_hz: float = RATE
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return time (N,) and smooth motion of all coordinates: positions, velocities, accelerations (N, n)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate_hz)
    middle = np.concatenate([[0.3, -0.2, 0.35, 0.4, 0.0, 0.0], np.tile([0.0, 0.6, -1.2], 4)])
    size = np.concatenate([[0.03] * 3, [0.12] * 3, [0.2] * 12])
    w = 2 * np.pi * rng.uniform(0.2, 1.6, (4, robot.na))
    phase, share = rng.uniform(0, 6, w.shape), size * rng.dirichlet(np.ones(4), robot.na).T
    angle = w * t[:, None, None] + phase
    parts = share * np.sin(angle), share * w * np.cos(angle), -share * w**2 * np.sin(angle)
    q, v, a = (x.sum(axis=1) for x in parts)
    return t, middle + q, v, a


def record(
    robot: Robot,
    seconds: float = 12.0,
    seed: int = 1,
    contacts: np.ndarray | None = None,
    rate_hz: float = RATE,
    with_forces: bool = False,
) -> Log:
    """Return an exact log of a motion on which the ground's forces, the least that carry the base, act at the feet.

    One foot after the other is lifted for half a second of every two, unless `contacts` (N, 4) says otherwise.
    """
    t, q, v, a = move(robot, seconds, seed, rate_hz)
    if contacts is None:
        contacts = np.ones((len(t), 4), bool)
        contacts[np.arange(len(t)), (t // 2).astype(int) % 4] = t % 2 > 0.5
    rigid = build_mechanism(robot).inverse_dynamics(q, v, a)
    J = compute_contact_jacobian(robot, q) * np.repeat(contacts, 3, axis=1)[:, :, None]
    ground = np.linalg.pinv(J[:, :, :6].swapaxes(1, 2)) @ rigid[:, :6, None]
    tau = rigid - (J.swapaxes(1, 2) @ ground)[:, :, 0]
    tau[:, 6:] += COULOMB * np.sign(v[:, 6:]) + VISCOUS * v[:, 6:]
    quaternion = Rotation.from_euler("ZYX", q[:, 3:6]).as_quat()
    columns = dict(zip(("q_base_x", "q_base_y", "q_base_z"), q[:, :3].T, strict=True))
    columns |= dict(zip(("q_base_qx", "q_base_qy", "q_base_qz", "q_base_qw"), quaternion.T, strict=True))
    for k, joint in enumerate(robot.driven, 6):
        columns |= {f"q_{joint}": q[:, k], f"tau_{joint}": tau[:, k]}
    columns |= {f"contact_{leg}_foot": contacts[:, k].astype(float) for k, leg in enumerate(LEGS)}
    if with_forces:
        places = [f"force_{leg}_foot_{axis}" for leg in LEGS for axis in "xyz"]
        columns |= dict(zip(places, ground[:, :, 0].T, strict=True))
    return Log(t, columns, f"walk{seed}")


@pytest.fixture(scope="session")
def walker_file(write, tmp_path_factory):
    """Return the walker's robot file."""
    path = tmp_path_factory.mktemp("walker") / "walker.urdf"
    path.write_text(write_walker(write))
    return path


@pytest.fixture(scope="session")
def walker(walker_file) -> Robot:
    """Return the walker with a floating base."""
    return load_robot(walker_file, base="floating", contacts=[f"{leg}_foot" for leg in LEGS])


@pytest.fixture(scope="session")
def walk() -> SimpleNamespace:
    """Return what makes motions and logs, and the friction in them."""
    return SimpleNamespace(move=move, record=record, coulomb=COULOMB, viscous=VISCOUS, radius=RADIUS)
