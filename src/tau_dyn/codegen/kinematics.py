r"""A robot's kinematics as traced functions, ready to be written out: forward, inverse, Jacobian.

Three kinds. `closed`: three rods and a plate that only translates, without iteration. `rods`: a free plate on six rods,
its pose by Newton's method; drives that each move one rod still have a closed inverse. `tree`: serial arms and trees with
loops. The traced functions are compared with Python over random states before any code is written.

A robot of rods on expressions: `mechanism`'s own equations and closed forms, run on symbols.

With `gap_k = (|d_k|^2 - l_k^2) / 2 l0_k` and `l0_k` a rod's length at zero, `G` has the derivatives by the drives and the
plate's twist in world axes. Forward in closed form: three spheres. Inverse: chain by chain, home's root.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.codegen.forms import draw_reachable_positions
from tau_dyn.codegen.loops import Loops, spread_over_joints, trace_frames
from tau_dyn.equations import Node, TracedFunction, as_expression_array, trace_function
from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import (
    Frames,
    Plate,
    RodDimensions,
    Rods,
    RootChain,
    build_chains,
    compute_closure_by_q,
    compute_cross_product,
    compute_equation_rows,
    compute_points,
    compute_squared_lengths,
    forward_kinematics,
    get_robot,
    get_rods,
    get_solver,
    jacobian,
    remove_rounding,
)
from tau_dyn.robot import Robot


class RodEquations(NamedTuple):
    """Gaps (n,) [m], and their derivatives by drives and plate (n, na + 6)."""

    gap: np.ndarray
    by: np.ndarray


def compute_rod_gaps(numbers: RodDimensions, q: Any, p: Any, R: Any) -> RodEquations:
    """Return how far the rods are from closed with the plate at p (3,), R (3, 3)."""
    numbers, q = replace(numbers, on_plate=remove_rounding(numbers.on_plate)), q[:, None]
    points = compute_points(numbers.joints, numbers.carried, q)
    squares = compute_squared_lengths(numbers, q)
    at = compute_equation_rows(points, numbers.on_plate, squares, Plate(p[:, None], R[:, :, None]))
    by_q = compute_closure_by_q(numbers, q, points, at.d)[:, :, 0]
    d, moment = (as_expression_array(np.stack(rows)[:, :, 0]) for rows in (at.d, at.moment))
    scale = 1.0 / numbers.lengths
    by = np.concatenate([as_expression_array(by_q), -d, -moment], axis=1) * scale[:, None]
    return RodEquations(as_expression_array(np.stack(at.f)[:, 0]) * scale, by)


def is_closed(rods: Rods) -> bool:
    """Return whether forward kinematics has a closed form here: three rods and a plate that only translates."""
    return rods.translates and rods.n == 3 and rods.na == 3 and has_closed_inverse(rods)


def has_closed_inverse(rods: Rods) -> bool:
    """Return whether each drive moves one rod of its own and the pose determines them all."""
    whole = rods.translates or rods.na == 6
    return whole and rods.n == rods.na and all(isinstance(c, RootChain) for c in build_chains(rods))


def solve_forward(rods: Rods, q: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's place (3,) [m], rotation (3, 3) and Jacobian (3, 3) at positions (3,)."""
    p = as_expression_array(rods.engine.solve(q[:, None])[0][:, 0])  # type: ignore[union-attr]
    by = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation)).by
    J = np.linalg.inv(as_expression_array(-by[:, 3:6])) @ by[:, :3]
    place, turn = (remove_rounding(rods.rotation @ x) for x in (rods.tool.translation, rods.tool.rotation))
    return p + place, turn, np.asarray(J)


def solve_inverse(rods: Rods, p: Any, R: Any) -> list[Any]:
    """Return the drives' positions (na,) with the tool at p (3,), R (3, 3); a translating plate keeps its own rotation.

    Raises:
        InputError: The drives do not each move one rod of their own.
    """
    if not has_closed_inverse(rods):
        raise InputError("unsupported", f"{rods.robot.source}: its inverse kinematics has no closed form")
    R_plate: Any = remove_rounding(rods.rotation) if rods.translates else R @ remove_rounding(rods.tool.rotation.T)
    p_plate = p - remove_rounding(R_plate @ rods.tool.translation)
    q: list[Any] = [0.0] * rods.na
    for chain in build_chains(rods):
        assert isinstance(chain, RootChain)
        B = as_expression_array(p_plate + R_plate @ remove_rounding(rods.on_plate[chain.rods[0]]))
        q[chain.actuators[0]] = chain.solve(B[:, None], chain.home_sign)[0, 0]
    if rods.translates:
        _require_side(rods, as_expression_array(q), p_plate)
    return q


def _require_side(rods: Rods, q: Any, p: np.ndarray) -> None:
    """Ask that the plate is on home's side of a parallel singularity, so that the graph guards it."""
    at_home = rods.gap_by_pose(rods.robot.home[None], rods.home)[0, :, :3]
    D = compute_rod_gaps(rods.numbers, q, p, remove_rounding(rods.rotation)).by[:, 3:6]
    same = (D[0] @ compute_cross_product(D[1], D[2])) * float(np.sign(np.linalg.det(at_home))) > 0.0
    if isinstance(same, Node):
        bool(same)


_SEED, _CHECK_SEED, _STATES = 3, 2, 15  # any; states that are drawn once decide about ranks, others are compared
AGREEMENT = 1e-9
"""Largest difference from Python [m, 1, rad]; loops are closed by Python to about 1e-11 m."""
_RANK = 1e-6  # singular values relative to the Jacobian's size; less counts as zero


@dataclass(frozen=True, eq=False)
class KinematicsProgram:
    """Kinematics as traced functions.

    Attributes:
        robot: The robot.
        rods: Its rods, None for a tree.
        kind: 'closed', 'rods' or 'tree'.
        forward: For a closed form or a serial arm: `q` -> `p` (3), `R` (9), `J`.
        inverse: With a closed form: `p`, `R` -> `q`.
        equations: Else: `q`, `z` -> `gap` and its derivative `G` by drives and the freedoms of `z`.
        tool: For a tree: `q`, `z` -> `p`, `R`, and its twist `T` by drives and `z`.
        home: Drives and `z` at home (na + nz,); `z` is the plate's position and rotation for rods, the passive joints for a
            tree.
        freedoms: Degrees of freedom of `z`: 6 for a plate, else the number of passive joints that are solved for.
        rank: Number of degrees of freedom that the drives give the tool, 6 at most.
        idle: Whether drives can move without the tool.
        no_inverse: Reason for missing inverse kinematics, '' if it exists.
        difference: Largest difference from Python over random states [m, 1, or rad].
    """

    robot: Robot
    rods: Rods | None
    kind: str
    home: np.ndarray
    forward: TracedFunction | None = None
    inverse: TracedFunction | None = None
    equations: TracedFunction | None = None
    tool: TracedFunction | None = None
    freedoms: int = 0
    rank: int = 6
    idle: bool = False
    no_inverse: str = ""
    difference: float = 0.0

    @property
    def rows(self) -> int:
        """Rows of the Jacobian: 3 of a plate that only translates, else 6."""
        return 3 if self.kind == "closed" else 6


def build_kinematics(robot: Robot | Rods) -> KinematicsProgram:
    """Return a robot's kinematics as traced functions, compared with Python over random states.

    Args:
        robot: A robot, or its rods (perhaps calibrated).

    Raises:
        InputError: It has no tool frame, or code generation does not support its kinematics.
        LoopClosureError: It cannot be closed at home.
    """
    rods, owner = get_rods(robot), get_robot(robot)
    if rods is None:
        program = _trace_tree(owner)
    elif is_closed(rods):
        program = _trace_closed(rods)
    else:
        program = _trace_rods(rods)
    return replace(program, difference=compare_with_python(program))


def _trace_closed(rods: Rods) -> KinematicsProgram:
    robot = rods.robot

    def forward(q: Any) -> dict[str, Any]:
        return dict(zip(("p", "R", "J"), solve_forward(rods, np.asarray(q)), strict=True))

    return KinematicsProgram(
        robot,
        rods,
        "closed",
        robot.home,
        forward=trace_function({"q": robot.home}, forward),
        inverse=_trace_inverse(rods),
        rank=3,
    )


def _trace_inverse(rods: Rods) -> TracedFunction:
    home = forward_kinematics(rods, rods.robot.home[None]).poses
    values = {"p": home.position[0], "R": home.rotation[0].ravel()}
    return trace_function(values, lambda p, R: {"q": solve_inverse(rods, np.asarray(p), np.asarray(R).reshape(3, 3))})


def _trace_rods(rods: Rods) -> KinematicsProgram:
    robot = rods.robot
    if rods.translates or rods.n != 6:
        raise InputError(
            "unsupported",
            f"{robot.source}: a plate that {'only translates' if rods.translates else 'is free'} on {rods.n} rods is not written "
            "out; three rods of a translating plate and six of a free one are",
        )
    z = np.concatenate([rods.home.position[0], rods.home.rotation[0].ravel()])

    def equations(q: Any, z: Any) -> dict[str, Any]:
        at = compute_rod_gaps(rods.numbers, np.asarray(q), np.asarray(z[:3]), np.asarray(z[3:]).reshape(3, 3))
        return {"gap": at.gap, "G": at.by}

    rank, idle = _count_freedoms(rods)
    program = KinematicsProgram(
        robot,
        rods,
        "rods",
        np.concatenate([robot.home, z]),
        equations=trace_function({"q": robot.home, "z": z}, equations),
        inverse=_trace_inverse(rods) if has_closed_inverse(rods) else None,
        freedoms=6,
        rank=rank,
        idle=idle,
    )
    return replace(program, no_inverse=_explain_no_inverse(program))


def _trace_tree(robot: Robot) -> KinematicsProgram:
    engine: Any = get_solver(robot)
    carriers = {robot.model.names[joint.index] for joint in engine.carriers}
    if following := [joint for joint in robot.mimics if joint in carriers]:
        raise InputError(
            "unsupported", f"{robot.source}: {', '.join(following)} follows another joint and carries the tool"
        )
    loops = Loops(robot) if robot.loops else None
    order = robot.active_v.tolist() + ([] if loops is None else loops.passive)
    z = np.zeros(0) if loops is None else loops.home[loops.passive]
    state = {"q": robot.home, "z": z} if len(z) else {"q": robot.home}

    def locate(q: Any, z: Any) -> Frames:
        if loops is not None:
            return loops.frames(q, z)
        return trace_frames(engine.joints, spread_over_joints([0.0] * robot.model.nv, (order, q)))

    def tool(q: Any, z: Any = ()) -> dict[str, Any]:
        at = locate(q, z)
        pose = engine.pose_of(at)
        return {"p": pose.position, "R": pose.rotation, "T": engine.twist(at)[0][:, order]}

    def equations(q: Any, z: Any) -> dict[str, Any]:
        assert loops is not None
        gap, G = loops.closure(loops.frames(q, z))
        return {"gap": gap[loops.rows], "G": G[np.ix_(loops.rows, order)]}

    rank, idle = _count_freedoms(robot)
    program = KinematicsProgram(
        robot,
        None,
        "tree",
        np.concatenate([robot.home, z]),
        equations=trace_function(state, equations) if len(z) else None,
        tool=trace_function(state, tool),
        freedoms=len(z),
        rank=rank,
        idle=idle,
    )
    return replace(program, no_inverse=_explain_no_inverse(program))


def _count_freedoms(robot: Robot | Rods) -> tuple[int, bool]:
    """Return the number of degrees of freedom that the drives give the tool, and whether the drives can move without the tool."""
    q = draw_reachable_positions(robot, 8, np.random.default_rng(_SEED))
    ranks = [int(np.linalg.matrix_rank(J, tol=_RANK * max(1.0, np.abs(J).max()))) for J in jacobian(robot, q)]
    return max(ranks), get_robot(robot).na > max(ranks)


def _explain_no_inverse(program: KinematicsProgram) -> str:
    if program.inverse is not None or program.rank == 6 or (program.rank >= 3 and not program.idle):
        return ""
    if program.rank < 3:
        return f"the drives give the tool {program.rank} freedom(s), too few to hold its position"
    return f"{program.robot.na} drives give the tool {program.rank} freedoms, and which positions are best is not written out"


def compare_with_python(program: KinematicsProgram) -> float:
    """Return the largest difference of poses, Jacobians, gaps and inverse positions from Python's.

    Raises:
        InputError: They disagree.
    """
    robot = program.robot
    source = robot if program.rods is None else program.rods
    q = draw_reachable_positions(source, _STATES, np.random.default_rng(_CHECK_SEED))
    found = forward_kinematics(source, q)
    p, R, J = found.poses.position, found.poses.rotation.reshape(-1, 9), jacobian(source, q)
    differences = [0.0]
    if program.forward is not None:
        at = program.forward.evaluate({"q": q})
        differences += [_apart(at["p"], p), _apart(at["R"], R), _apart(at["J"], J.reshape(len(q), -1))]
    if program.inverse is not None:
        differences.append(_apart(program.inverse.evaluate({"p": p, "R": R})["q"], q))
    if program.forward is None:
        differences += _by_equations(program, q, found.plate, p, R, J)
    worst = max(differences)
    if not worst < AGREEMENT:
        raise InputError(
            "unsupported",
            f"{robot.source}: the traced kinematics differ from Python's by {worst:.2g}, so they are not exported",
        )
    return worst


def _by_equations(program: KinematicsProgram, q, plate, p, R, J) -> list[float]:
    """Return differences where the configuration is solved for: no gap, the same tool, the same Jacobian."""
    na, nt = program.robot.na, program.freedoms
    known = {"q": q}
    if program.rods is not None:
        known["z"] = np.column_stack([plate.position, plate.rotation.reshape(-1, 9)])
    elif nt:
        loops = Loops(program.robot)
        known["z"] = np.array([loops.closed(x) for x in q])[:, loops.passive]
    out, X = [], np.zeros((len(q), nt, na))
    if program.equations is not None:
        at = program.equations.evaluate(known)
        G = at["G"].reshape(len(q), nt, na + nt)
        out.append(float(np.abs(at["gap"]).max()))
        X = -np.linalg.solve(G[:, :, na:], G[:, :, :na])
    if program.tool is not None:
        at = program.tool.evaluate(known)
        T = at["T"].reshape(len(q), 6, na + nt)
        return [*out, _apart(at["p"], p), _apart(at["R"], R), _apart(T[:, :, :na] + T[:, :, na:] @ X, J)]
    arm = p - plate.position
    X[:, :3] += np.cross(X[:, 3:], arm[:, :, None], axis=1)
    return [*out, _apart(X, J)]


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest difference, relative for numbers larger than 1; inf if a number is missing."""
    worst = np.abs(a - b) / np.maximum(1.0, np.abs(b))
    return float(np.max(np.where(np.isfinite(worst), worst, np.inf)))
