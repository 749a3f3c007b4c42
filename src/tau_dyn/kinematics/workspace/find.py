"""Find a robot's workspace: classify a coarse lattice over its reach, refine the border, keep the part connected to home."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.kinematics.workspace.lattice import (
    INSIDE,
    ClassifiedLattice,
    Lattice,
    Size,
    bound_missed_size,
    build_lattice,
    classify_lattice,
    compute_bounding_box,
    erode_by_margin,
    find_connected,
    measure_size,
)
from tau_dyn.kinematics.workspace.machine import WorkspaceModel, build_machine
from tau_dyn.kinematics.workspace.pose_check import PoseChecker, PoseRequirements
from tau_dyn.kinematics.workspace.result import Workspace, build_footprint
from tau_dyn.mechanism import Poses, require_poses
from tau_dyn.robot import Robot

_CELLS = 60
"""Default number of cells along the workspace's longest side."""
_FIRST = 24
"""Cells along the longest side of the box in the first pass, which estimates the size of the workspace."""
_GROWTH = 4
"""Largest number of enlargements of a box that the workspace touches."""


def find_workspace(
    robot: Robot | WorkspaceModel,
    *,
    demands: PoseRequirements | None = None,
    resolution: float | None = None,
    rotation: np.ndarray | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Workspace:
    """Find the workspace of a robot's tool at one orientation.

    Args:
        robot: The robot, or its workspace model if that exists.
        demands: Requirements for a pose.
        resolution: Distance of neighbouring points [m]; by default about a 60th of the workspace's longest side.
        rotation: Rotation of the tool (3, 3); by default home's.
        seed: Seed of the random points that search for parts missed by the coarse lattice.
        progress: Called with the current step.

    Raises:
        InputError: Limits are missing or inverted, the resolution is too fine or too coarse, or home is not in the workspace.
        CannotAnswer: The tool moves in a plane or on a line that is not parallel to the axes.
    """
    machine = robot if isinstance(robot, WorkspaceModel) else build_machine(robot)
    judge = PoseChecker(machine, demands if demands is not None else PoseRequirements())
    turn = np.asarray(machine.home.rotation)[0]
    if rotation is not None:
        if not machine.by_position:
            names = ", ".join(machine.kinematics.commanded.names)
            raise InputError("unsupported", f"{machine.robot.source}: its workspace is over {names}, at no orientation")
        turn = np.asarray(require_poses(Poses(machine.home.position, np.asarray(rotation, float)[None])).rotation)[0]
    _check_home(machine, judge, turn)
    progress("judging the coarse lattice, then its border")
    found, recorder = _explored(machine, judge, turn, resolution, seed)
    return _result(machine, judge, turn, found, recorder)


class _Recorder:
    """Classifies places at one orientation and stores the positions found."""

    def __init__(self, judge: PoseChecker, turn: np.ndarray) -> None:
        self.judge, self.turn = judge, turn
        self.places: list[np.ndarray] = []
        self.q: list[np.ndarray] = []

    def __call__(self, places: np.ndarray) -> np.ndarray:
        judged = self.judge.judge(self.judge.machine.place(places, self.turn))
        self.places.append(places)
        self.q.append(judged.q)
        return judged.code


def _explored(
    machine: WorkspaceModel, judge: PoseChecker, turn: np.ndarray, resolution: float | None, seed: int
) -> tuple[ClassifiedLattice, _Recorder]:
    """Explore the box; enlarge it if the workspace touches a side that is only an estimate."""
    lower, upper = _box(machine, judge.demands)
    step = _resolution(resolution, lower, upper)
    if step is None:
        step = _suitable(machine, judge, turn, lower, upper)
    for _ in range(_GROWTH):
        recorder = _Recorder(judge, turn)
        # half a step off home, so that limits at round distances from home are between points
        beside = machine.home_place + np.where(upper > lower, step / 2, 0.0)
        found = classify_lattice(build_lattice(lower, upper, beside, step), recorder, seed=seed)
        below, above = _touched(found.inside)
        if machine.by_position:
            below &= lower > judge.demands.surroundings.lower
            above &= upper < judge.demands.surroundings.upper
        if machine.rods is not None or not (below.any() or above.any()):
            break
        room = 0.25 * (upper - lower)
        lower, upper = lower - room * below, upper + room * above
    return found, recorder


def _touched(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return at which ends of the axes (3,), (3,) the set touches the lattice's edge."""
    sides = [(inside.take(0, k).any(), inside.take(-1, k).any(), n > 1) for k, n in enumerate(inside.shape)]
    return np.array([low and wide for low, _, wide in sides]), np.array([high and wide for _, high, wide in sides])


def leave_singular_home(machine: WorkspaceModel, demands: PoseRequirements | None = None) -> WorkspaceModel:
    """Return an arm whose home is singular with a regular home; return any other mechanism unchanged.

    Robot files of arms often have no home, and the middle of their limits is often the stretched arm. The new home has quarter
    turns of the fewest joints that give a well-conditioned Jacobian.
    """
    robot = machine.robot
    judge = PoseChecker(machine, demands if demands is not None else PoseRequirements())
    code = int(judge.judge(machine.place(machine.home_place[None], np.asarray(machine.home.rotation)[0])).code[0])
    if robot.loops or code == INSIDE or "singularity" not in judge.reasons.words(code) or robot.na > _MAX_BENT:
        return machine
    turns = np.array([kind == "revolute" for kind in robot.joint_kinds])
    signs = np.array(list(product((0, 1, -1), repeat=robot.na)), float)
    signs = signs[(np.abs(signs)[:, ~turns] == 0).all(axis=1)]
    q = robot.home + signs * np.minimum(np.pi / 2, 0.4 * (robot.upper - robot.lower))
    J = machine.kinematics.jacobian(q).copy()
    J[:, 3:] *= machine.length
    values = np.linalg.svd(J, compute_uv=False)
    condition = values[:, 0] / np.maximum(values[:, -1], np.finfo(float).tiny)
    good = condition <= _GOOD_CONDITION
    if not good.any():
        return machine
    bends = np.abs(signs).sum(axis=1)
    few = np.flatnonzero(good & (bends == bends[good].min()))
    return build_machine(replace(robot, home=q[few[np.argmin(condition[few])]]))


_MAX_BENT = 8  # joints; 3^8 postures are evaluated in a tenth of a second
_GOOD_CONDITION = 30.0  # of a Jacobian with lengths in the robot's own; below it the tool moves and turns everywhere


def _check_home(machine: WorkspaceModel, judge: PoseChecker, turn: np.ndarray) -> None:
    judged = judge.judge(machine.place(machine.home_place[None], turn))
    if judged.code[0] == INSIDE:
        return
    home = ", ".join(f"{x:.4g}" for x in machine.home.position[0])
    why = judge.reasons.words(int(judged.code[0]))
    at = "" if np.allclose(turn, np.asarray(machine.home.rotation)[0]) else " in this orientation"
    raise InputError(
        "unreachable",
        f"{machine.robot.source}: the tool's home ({home} m){at} does not belong itself ({why}); a workspace is what "
        "is connected to home, so loosen that demand",
    )


def _box(machine: WorkspaceModel, demands: PoseRequirements) -> tuple[np.ndarray, np.ndarray]:
    """Return the box to search, cut by the tool's limits; an axis in which the tool does not move has no width."""
    lower, upper = machine.reach()
    home, around = machine.home_place, demands.surroundings
    J = machine.rates(machine.robot.home[None], machine.home)
    flat = upper - lower < 1e-6 * max(float((upper - lower).max()), 1e-9)
    lower, upper = np.where(flat, home, lower), np.where(flat, home, upper)
    if J.actuators.shape[2] < 3 and machine.rods is None and (~flat).sum() > J.actuators.shape[2]:
        raise CannotAnswer(
            "unsupported",
            f"{machine.robot.source}: its tool moves in a plane or on a line that is not parallel to the axes",
            "a robot file whose base is turned so that it is",
        )
    if not machine.by_position:
        return lower, upper
    lower, upper = np.maximum(lower, around.lower), np.minimum(upper, around.upper)
    if (lower > upper).any():
        axis = "xyz"[int(np.argmax(lower > upper))]
        raise InputError(
            "invalid_value", f"the tool's limits in {axis} leave no part of the reach of {machine.robot.source}"
        )
    return lower, upper


def _resolution(wanted: float | None, lower: np.ndarray, upper: np.ndarray) -> float | None:
    if wanted is None:
        return None
    longest = float((upper - lower).max())
    if not 0 < wanted < np.inf:
        raise InputError("invalid_value", f"the resolution must be a length above zero, not {wanted}")
    if wanted > longest / 4:
        raise InputError(
            "invalid_value",
            f"a resolution of {wanted:g} m is too coarse for a reach of {longest:.3g} m; take a tenth or less",
        )
    return float(wanted)


def _suitable(
    machine: WorkspaceModel, judge: PoseChecker, turn: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> float:
    """Return a round step that gives the workspace, not the box around it, some dozens of cells."""
    coarse = float((upper - lower).max()) / _FIRST
    look = _Recorder(judge, turn)
    lattice = build_lattice(lower, upper, machine.home_place, coarse, 1)
    inside = classify_lattice(lattice, look, probes=0).inside
    low, high = compute_bounding_box(inside, lattice.low, coarse)
    raw = (float((high - low).max()) + coarse) / _CELLS
    power = 10.0 ** np.floor(np.log10(raw))
    return power * max(m for m in (1.0, 2.0, 2.5, 5.0) if m * power <= raw * (1 + 1e-9))


def _result(
    machine: WorkspaceModel, judge: PoseChecker, turn: np.ndarray, found: ClassifiedLattice, recorder: _Recorder
) -> Workspace:
    lattice, demands = found.lattice, judge.demands
    code = found.code.copy()
    belongs = find_connected(code == INSIDE, _start(lattice, code == INSIDE, machine.home_place))
    code[(code == INSIDE) & ~belongs] = judge.reasons.code("not connected to home")
    if demands.border > 0:
        kept = erode_by_margin(belongs, lattice.step, demands.border)
        code[belongs & ~kept] = judge.reasons.code("too close to the border")
        belongs = kept
        if not belongs.any():
            raise InputError("invalid_value", f"no pose keeps {demands.border:g} m from the border; ask for less")
    places, q = np.concatenate(recorder.places), np.concatenate(recorder.q)
    index = np.rint((places - lattice.low) / lattice.step).astype(int)
    unit = float(np.prod(machine.scale[np.array(lattice.shape) > 1]))
    size = Size(*(x / unit for x in measure_size(belongs, lattice.step, bound_missed_size(found))))
    lower, upper = (x / machine.scale for x in compute_bounding_box(belongs, lattice.low, lattice.step))
    return Workspace(
        machine=machine,
        judge=judge,
        rotation=turn,
        lattice=lattice,
        code=code,
        asked=found.asked,
        size=size,
        lower=lower,
        upper=upper,
        footprint=build_footprint(machine),
        reasons=judge.reasons,
        places=places,
        q=q,
        place_codes=code[tuple(index.T)],
        warnings=tuple(_warnings(machine, judge, found, size)),
    )


def _start(lattice: Lattice, inside: np.ndarray, home: np.ndarray) -> tuple[int, ...]:
    """Return the index of a point around home in the workspace.

    Raises:
        InputError: No such point exists: the resolution is too coarse.
    """
    index = np.argwhere(inside)
    away = np.abs(lattice.points(index) - home).max(axis=1, initial=0.0)
    if not len(index) or away.min() > 1.01 * lattice.step:
        raise InputError(
            "invalid_value", f"no point around home belongs at a resolution of {lattice.step:g} m; take a finer one"
        )
    return tuple(index[int(np.argmin(np.linalg.norm(lattice.points(index) - home, axis=1)))].tolist())


def _warnings(machine: WorkspaceModel, judge: PoseChecker, found: ClassifiedLattice, size: Size) -> list[str]:
    said = []
    coarse = found.lattice.step * found.lattice.stride
    for obstacle in judge.demands.surroundings.obstacles:
        if 2 * (obstacle.shape.half_size.min() + obstacle.margin) < coarse:
            said.append(
                f"obstacle '{obstacle.name}' is thinner than the coarse lattice of {coarse:.3g} m and may be missed in parts; "
                "take a finer resolution"
            )
    if judge.demands.collisions and machine.meshes:
        listed = ", ".join(machine.meshes[:6]) + (" and more" if len(machine.meshes) > 6 else "")
        said.append(f"{listed} are drawn by meshes alone; their collisions are not checked")
    if judge.touching:
        said.append(f"these touch at home already and are not checked against each other: {'; '.join(judge.touching)}")
    if judge.balls is not None and not judge.balls.given.all():
        said.append(
            "the axes of ball joints are taken as the rods' directions at home, where the robot file does not give them"
        )
    if judge.turned > 1e-6:
        degrees = np.rad2deg(judge.turned)
        said.append(
            "the robot has too few freedoms to keep the tool's orientation, which follows the position, "
            f"by up to {degrees:.3g} degrees"
        )
    below, above = _touched(found.inside)
    if machine.rods is None and (below.any() or above.any()):
        said.append("the workspace touches the box that was searched; it may go on beyond")
    if size.value > 0 and size.high - size.low > 0.5 * size.value:
        said.append("the size is uncertain by more than a quarter; take a finer resolution")
    return said
