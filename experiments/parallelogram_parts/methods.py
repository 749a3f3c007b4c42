"""The five ways to treat the paper's parallelogram, each from 19 measured poses to corrected actuator positions."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from parallelogram_parts.explicit import ERRORS, NAMES, NOMINAL, forward
from tau_dyn.calibrate import GeometryFit, PoseSet, build_compensation, fit_geometry_to_poses
from tau_dyn.calibrate.geometry import ConstrainedGeometry
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot, load_robot

FILE = Path(__file__).resolve().parents[2] / "urdf" / "parallelogram.urdf.xacro"
NOISE = (3e-6, float(np.radians(0.003)))  # m, rad
PRIOR = {
    "q0": float(np.radians(0.1)),
    "*": 2e-3,
}  # rad, m: what machining and assembly leave; as large as Table 2's errors
MEASURED = np.radians(np.arange(-45.0, 46.0, 5.0))
CHECKED = np.radians(np.arange(-45.0, 46.0, 1.0))
BASE = ("q0", "a2x", "a2y", "b1x", "l1", "l2")
"""The paper's choice of identifiable parameters, equation (73)."""

_TIES = {
    "q0": {"crank.offset": 1},
    "a1x": {"crank.origin_x": -1},
    "a2x": {"rod2_turn.origin_x": 1},
    "a2y": {"rod2_turn.origin_z": 1},
    "b1x": {"plate_link.anchor_x": 1, "tool.origin_x": 1},
    "b2x": {"plate_link.anchor_x": 1},
    "b2y": {"plate_link.anchor_z": 1},
    "l1": {"plate_turn.origin_z": -1},
    "l2": {"rod2.length": 1},
}
"""The paper's parameters in the robot file's; the platform's frame sits at B_1 there, at O_p in the paper."""


@cache
def machine(h: float) -> tuple[Robot, ConstrainedGeometry]:
    """Return the robot file with tool length `h` [m] and its geometry in the paper's nine parameters."""
    robot = load_robot(FILE, h=h)
    tree: TreeGeometry = build_tree_geometry(robot)
    matrix = np.zeros((len(tree.knobs), len(NAMES)))
    for column, name in enumerate(NAMES):
        for own, factor in _TIES[name].items():
            matrix[tree.parameters.names.index(own), column] = factor
    units = ["rad"] + ["m"] * 8
    rows = Parameters([Parameter(n, float(v), u) for n, v, u in zip(NAMES, NOMINAL, units, strict=True)])
    priority = np.array([0 if name in BASE else 1 for name in NAMES])
    return robot, ConstrainedGeometry(tree, rows, matrix, priority)


def measure(rng: np.random.Generator, k: np.ndarray = NOMINAL + ERRORS, h: float = 0.1) -> PoseSet:
    """Return the 19 poses of the real mechanism, from the closed form, with noise."""
    at = forward(MEASURED, k, h)
    turn = -at.alpha + rng.normal(0, NOISE[1], len(MEASURED))  # from x_b to y_b is about -y_world
    position = np.stack([at.x, np.zeros_like(at.x), at.y], axis=1) + rng.normal(0, NOISE[0], (len(MEASURED), 3))
    rotation = np.zeros((len(turn), 3, 3))
    rotation[:, 0, 0] = rotation[:, 2, 2] = np.cos(turn)
    rotation[:, 0, 2], rotation[:, 2, 0], rotation[:, 1, 1] = np.sin(turn), -np.sin(turn), 1.0
    return PoseSet(MEASURED[:, None], position, rotation, source="simulated poses")


def classical(poses: PoseSet) -> tuple[float, float]:
    """Return q0 and l of the simplified model from measured x, equation (38) repeated until it rests."""
    q0, length = 0.0, NOMINAL[7]
    for _ in range(20):
        s = poses.q[:, 0] + q0
        columns = np.stack([length * np.cos(s), np.sin(s)], axis=1)
        step = np.linalg.lstsq(columns, poses.position[:, 0] - length * np.sin(s), rcond=None)[0]
        q0, length = q0 + step[0], length + step[1]
    return q0, length


def linear(geometry: ConstrainedGeometry, poses: PoseSet, weights: tuple[float, float]) -> np.ndarray:
    """Return the nine parameters by (23) to (26): one linear least squares at the nominal mechanism, base parameters alone."""
    columns = geometry.tool_by_parameter(NOMINAL, poses.q, poses.poses)[:, [0, 2, 4]]
    nominal = geometry.forward(NOMINAL, poses.q).poses
    miss = poses.position - nominal.position
    turn = np.arctan2(poses.rotation[:, 0, 2], poses.rotation[:, 0, 0])  # type: ignore[index]
    rest = np.stack([miss[:, 0], miss[:, 2], turn], axis=1)
    w = np.array([weights[0], weights[0], weights[1]])
    index = [NAMES.index(name) for name in BASE]
    a = (columns[:, :, index] * w[:, None]).reshape(-1, len(index))
    k = NOMINAL.copy()
    k[index] += np.linalg.lstsq(a, (rest * w).ravel(), rcond=None)[0]
    return k


def six(geometry: ConstrainedGeometry, poses: PoseSet) -> GeometryFit:
    """Return the nonlinear fit of the six base parameters."""
    others = [name for name in NAMES if name not in BASE]
    return fit_geometry_to_poses(geometry, poses, fix=others, device=False, tool=False, noise=NOISE)


def nine(geometry: ConstrainedGeometry, poses: PoseSet, prior: dict[str, float] | None = None) -> GeometryFit:
    """Return the nonlinear fit of all nine, held by the fit's own prior (10 mm, 10 mrad) or by a closer one."""
    if prior is not None:
        known = {p.name: {"prior_stderr": prior.get(p.name, prior["*"])} for p in geometry.parameters}
        geometry = replace(geometry, parameters=geometry.parameters.update(known))
    return fit_geometry_to_poses(geometry, poses, device=False, tool=False, noise=NOISE)


def tcp_error(h: float, corrected: np.ndarray, k: np.ndarray = NOMINAL + ERRORS) -> np.ndarray:
    """Return how far the real TCP's x is from the asked one (N,) [m] at corrected positions for `CHECKED`."""
    return forward(corrected, k, h).x - forward(CHECKED, NOMINAL, h).x


def compensated(h: float, k: np.ndarray, method: str) -> np.ndarray:
    """Return corrected positions (N,) [rad] for `CHECKED`, tool length `h` [m]."""
    robot, geometry = machine(h)
    found = build_compensation(robot, geometry, k, method=method, limits=False)(CHECKED[:, None])
    return found.q[:, 0]
