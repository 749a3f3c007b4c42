"""Traced kinematics against Python over random states; a difference refuses the export."""

from __future__ import annotations

import numpy as np

from tau_dyn.control.export_check import draw_reachable_positions
from tau_dyn.control.export_kinematics import KinematicsProgram
from tau_dyn.control.export_tree_kinematics import TreeKinematics
from tau_dyn.control.expression_arrays import TracedFunction
from tau_dyn.control.graph import evaluate_graph
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import forward_kinematics, jacobian

_SEED, _STATES = 2, 15
AGREEMENT = 1e-9
"""Largest difference from Python [m, 1, rad]; loops are closed by Python to about 1e-11 m."""


def compare_with_python(program: KinematicsProgram) -> float:
    """Return the largest difference of poses, Jacobians, gaps and inverse positions from Python's.

    Raises:
        InputError: They disagree.
    """
    robot = program.robot
    source = robot if program.rods is None else program.rods
    q = draw_reachable_positions(source, _STATES, np.random.default_rng(_SEED))
    found = forward_kinematics(source, q)
    p, R, J = found.poses.position, found.poses.rotation.reshape(-1, 9), jacobian(source, q)
    differences = [0.0]
    if program.forward is not None:
        at = evaluate_traced(program.forward, {"q": q})
        differences += [_apart(at["p"], p), _apart(at["R"], R), _apart(at["J"], J.reshape(len(q), -1))]
    if program.inverse is not None:
        differences.append(_apart(evaluate_traced(program.inverse, {"p": p, "R": R})["q"], q))
    if program.forward is None:
        differences += _by_equations(program, q, found.plate, p, R, J)
    worst = max(differences)
    if not worst < AGREEMENT:
        raise InputError(
            "unsupported",
            f"{robot.source}: the traced kinematics differ from Python's by {worst:.2g}, so they are not exported",
        )
    return worst


def evaluate_traced(piece: TracedFunction, known: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a traced function's outputs (N, k) by name; nan where a guard does not hold."""
    flat = [x for outputs in piece.outputs.values() for x in outputs]
    found, fine = evaluate_graph(piece.graph, flat, known)
    found[~fine] = np.nan
    ends = np.cumsum([len(x) for x in piece.outputs.values()])[:-1]
    return dict(zip(piece.outputs, np.split(found, ends, axis=1), strict=True))


def _by_equations(program: KinematicsProgram, q, plate, p, R, J) -> list[float]:
    """Return differences where the configuration is solved for: no gap, the same tool, the same Jacobian."""
    na, nt = program.robot.na, program.freedoms
    known = {"q": q}
    if program.rods is not None:
        known["z"] = np.column_stack([plate.position, plate.rotation.reshape(-1, 9)])
    elif nt:
        tree = TreeKinematics(program.robot)
        assert tree.loops is not None
        known["z"] = np.array([tree.loops.closed(x) for x in q])[:, tree.passive]
    out, X = [], np.zeros((len(q), nt, na))
    if program.equations is not None:
        at = evaluate_traced(program.equations, known)
        G = at["G"].reshape(len(q), nt, na + nt)
        out.append(float(np.abs(at["gap"]).max()))
        X = -np.linalg.solve(G[:, :, na:], G[:, :, :na])
    if program.tool is not None:
        at = evaluate_traced(program.tool, known)
        T = at["T"].reshape(len(q), 6, na + nt)
        return [*out, _apart(at["p"], p), _apart(at["R"], R), _apart(T[:, :, :na] + T[:, :, na:] @ X, J)]
    arm = p - plate.position
    X[:, :3] += np.cross(X[:, 3:], arm[:, :, None], axis=1)
    return [*out, _apart(X, J)]


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest difference, relative where numbers are larger than 1; inf where one is missing."""
    worst = np.abs(a - b) / np.maximum(1.0, np.abs(b))
    return float(np.max(np.where(np.isfinite(worst), worst, np.inf)))
