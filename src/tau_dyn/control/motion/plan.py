"""Plan a motion from rest to rest, in the shortest time or with less effort, that the drives can follow."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import (
    Along,
    Coordinates,
    Free,
    JointPath,
    PathShape,
    build_joint_line,
    build_tool_path,
)
from tau_dyn.control.motion.expressions import ForceLaw, build_force_law, import_casadi
from tau_dyn.control.motion.limits import MotionLimits, compute_end_positions
from tau_dyn.control.motion.nodes import (
    build_node_motion,
    compute_min_duration,
    compute_smoothing_width,
    compute_trapezoid,
    scale_unknowns,
    start_nodes,
)
from tau_dyn.control.motion.result import (
    AT_LIMIT,
    MAX_LIMIT_EXCESS,
    Binding,
    MotionPlan,
    compute_limit_usage,
    tighten_limits,
)
from tau_dyn.control.motion.transcription import Transcription, TranscriptionSolution
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.model import Model
from tau_dyn.robot import Robot

_MAX_ITERATIONS = 6  # rounds of solving with enforced limits; each tightens what the last exceeded
_MIN_INTERVALS = 6  # of a motion that is shorter than so many periods
_FIRST_WIDTH = 0.02  # [m/s or rad/s] of friction's sign, until the motion's speeds are known
_MIN_DISTANCE = 1e-9  # m or rad; ends closer together are one place
_STROKE = 1e-5  # share of a joint's range that is kept at its ends
_TOLD = 1e-3  # share of a limit from which on leaving it is told
_WORST = 0.02  # share of a limit by which no plan may leave it


def plan_motion(
    model: Model | Robot,
    start: np.ndarray,
    end: np.ndarray,
    *,
    limits: MotionLimits | None = None,
    energy_weight: float = 0.0,
    path: PathShape | None = None,
    joints: bool = False,
    dt: float = 1e-3,
    nodes: int = 80,
    period: float | None = None,
) -> MotionPlan:
    """Return the motion from rest to rest that minimises `T + w sum_i int tau_i^2 dt` within limits.

    Args:
        model: A robot, or a model with friction and other effects.
        start: Tool position (3,) [m], in home's orientation; with `joints` actuated positions (na,) [m or rad].
        end: Where it ends, likewise.
        limits: What it may use, by default the robot file's limits; see `MotionLimits.of`.
        energy_weight: `w` [s per N^2 s]; 0 for the shortest time.
        path: None for any path, 'line' for a straight line of the tool, or points (n, 3) [m] that its spline goes through.
        joints: Whether start and end are actuated positions.
        dt: Step of the result's clock [s].
        nodes: Intervals of the program; the acceleration is linear within each.
        period: Of the controller that will be given the motion [s]: intervals are no shorter than it, and a motion that needs
            fewer intervals for that lasts a whole number of periods, so that the controller's samples hold all of it.

    Raises:
        InputError: An end or the path out of reach, near a singularity, or too heavy to hold; settings out of range.
        CannotAnswer: The solver found no motion within the limits, on a fine clock as well as at its nodes.
    """
    import_casadi()
    model = model if isinstance(model, Model) else Model.of(model)
    limits = MotionLimits.of(model) if limits is None else limits
    _check_settings(energy_weight, dt, nodes)
    first = compute_end_positions(model, start, "start", limits, joints=joints)
    last = compute_end_positions(model, end, "end", limits, joints=joints, near=first)
    if np.abs(last - first).max() < _MIN_DISTANCE:
        raise InputError("invalid_value", "start and end are one place; there is nothing to move")
    coordinates = _coordinates(model, first, last, path, limits)
    inside = limits.inside(MAX_LIMIT_EXCESS)
    search = _search(model, coordinates, inside, energy_weight, nodes)
    if period is not None and search.solution.nodes.T < nodes * period:
        search = _search_on_periods(model, coordinates, inside, energy_weight, search.solution.nodes.T, period)
    name = "free" if path is None else "line" if isinstance(path, str) else "points"
    return _sampled(model, coordinates, search, limits, energy_weight, name, dt)


@dataclass(frozen=True, eq=False)
class _Search:
    law: ForceLaw
    solution: TranscriptionSolution
    start_duration: float
    width: np.ndarray
    iterations: int
    seconds: float
    which: list[tuple[str, int]]


def _check_settings(weight: float, dt: float, nodes: int) -> None:
    if not (np.isfinite(weight) and weight >= 0):
        raise InputError(
            "invalid_value", f"the energy weight must be zero or a positive number [s per N^2 s], not {weight}"
        )
    if not (np.isfinite(dt) and 0 < dt <= 0.1):
        raise InputError("invalid_value", f"the clock's step must be above zero and at most 0.1 s, not {dt}")
    if not 10 <= nodes <= 2000:
        raise InputError("invalid_value", f"the number of intervals must be from 10 to 2000, not {nodes}")


def _coordinates(
    model: Model, first: np.ndarray, last: np.ndarray, path: PathShape | None, limits: MotionLimits
) -> Coordinates:
    if path is not None:
        return Along(build_tool_path(model, first, last, path, limits))
    room = np.where(np.isfinite(limits.upper - limits.lower), _STROKE * (limits.upper - limits.lower), 0.0)
    lower, upper = np.minimum(limits.lower + room, np.minimum(first, last)), np.maximum(first, last)
    return Free(_starting_path(model, first, last, limits), lower, np.maximum(limits.upper - room, upper))


def _starting_path(model: Model, first: np.ndarray, last: np.ndarray, limits: MotionLimits) -> JointPath:
    """Return the tool's straight line, or the actuated joints' where the tool cannot take its own."""
    if model.robot.tool_frame is not None:
        try:
            return build_tool_path(model, first, last, "line", limits)
        except InputError:
            pass
    straight = build_joint_line(first, last)
    model.mechanism.condition(straight.q(np.linspace(0, 1, 50)))  # raises where the loops do not close
    return straight


def _search(model: Model, coordinates: Coordinates, limits: MotionLimits, weight: float, nodes: int) -> _Search:
    """Solve from a trapezoidal profile, and again while the fine clock finds something to tighten."""
    profile = compute_trapezoid(nodes)
    rough = Feedforward(model.steady(), width=_FIRST_WIDTH, shape="tanh")
    T = compute_min_duration(coordinates, rough, limits, profile)
    width = compute_smoothing_width(coordinates, profile, T, nodes)
    law = build_force_law(model, width)
    law, start = scale_unknowns(law, start_nodes(law, coordinates, profile, T))
    program = Transcription(law, coordinates, limits, nodes, weight)
    found = program.solve(start)
    best, share = found, program.loose()
    iterations, seconds = found.iterations, found.seconds
    for _ in range(_MAX_ITERATIONS):
        if not found.ok:
            break
        best = found
        share = tighten_limits(share, found.nodes, coordinates, law.feedforward, limits, program.limited)
        if share is None:
            break
        found = program.again(found, share)
        iterations, seconds = iterations + found.iterations, seconds + found.seconds
    if not best.ok:
        _refuse(best, coordinates)
    return _Search(law, best, T, width, iterations, seconds, program.limited)


def _search_on_periods(
    model: Model, coordinates: Coordinates, limits: MotionLimits, weight: float, shortest: float, period: float
) -> _Search:
    """Return the motion in the fewest whole periods [s], an interval each; `shortest` is the duration without them [s]."""
    count = max(_MIN_INTERVALS, int(np.ceil(shortest / period)))
    for _ in range(_MAX_ITERATIONS):
        found = _search(model, coordinates, limits, weight, count)
        nodes = found.solution.nodes
        if nodes.T <= count * period * (1 + 1e-9):
            break
        count = int(np.ceil(nodes.T / period))
    slower = max(nodes.T, count * period)
    return replace(found, solution=replace(found.solution, nodes=replace(nodes, T=slower)))


def _refuse(found: TranscriptionSolution, coordinates: Coordinates) -> NoReturn:
    where = "along this path" if coordinates.forward else "between these ends"
    raise CannotAnswer(
        "no_solution",
        f"no motion {where} was found within the limits (IPOPT: {found.status.replace('_', ' ').lower()} after "
        f"{found.iterations} iterations, {found.seconds:.0f} s)",
        "the same plan along a line or by way of points, with simplified arms where the robot file has them (--set "
        "arms=simplified), with another number of nodes, or with larger limits of force",
    )


def _sampled(
    model: Model,
    coordinates: Coordinates,
    search: _Search,
    limits: MotionLimits,
    weight: float,
    path: str,
    dt: float,
) -> MotionPlan:
    """Return the plan on an even clock; it is stretched to a whole number of steps."""
    nodes, feedforward = search.solution.nodes, search.law.feedforward
    steps = max(2, int(np.ceil(nodes.T / dt - 1e-9)))
    t = np.arange(steps + 1) * dt
    q, v, a = motion = build_node_motion(coordinates, nodes, np.arange(steps + 1) / steps, float(t[-1]))
    tau = feedforward(q, v, a)
    used = compute_limit_usage(feedforward, motion, limits, search.which)
    _refuse_between_nodes(used)
    _refuse_singular(model, q, limits)
    energy = float(np.trapezoid((tau**2).sum(axis=1), t))
    excess = max(0.0, float(used.max(initial=0.0)) - 1)
    warnings = [*search.law.warnings, *_excess_words(excess), *model.mechanism.singularity_warnings(q)]
    return MotionPlan(
        model, t, q, v, a, tau,
        None if model.robot.tool_frame is None else model.mechanism.tool_position(q),
        nodes.T, energy, float(np.trapezoid(np.abs(tau * v).sum(axis=1), t)), nodes.T + weight * energy, weight, path,
        search.solution.status, search.iterations, search.seconds, search.start_duration,
        _binding(model.robot, used, search.which), excess, limits, search.width, tuple(warnings),
    )  # fmt: skip


def _binding(robot: Robot, used: np.ndarray, which: list[tuple[str, int]]) -> tuple[Binding, ...]:
    share = np.mean(used >= AT_LIMIT, axis=0)
    found = [Binding(name, robot.actuated[k], float(x)) for (name, k), x in zip(which, share, strict=True) if x > 0]
    return tuple(sorted(found, key=lambda b: -b.share))


def _refuse_between_nodes(used: np.ndarray) -> None:
    """Refuse a motion that keeps its limits only where the solver looked."""
    excess = float(used.max(initial=0.0)) - 1
    if excess > _WORST:
        raise CannotAnswer(
            "no_solution",
            f"no motion within the limits was found: the solver's leaves one by {100 * excess:.0f} % between its nodes",
            "the same plan with larger limits, or with more nodes",
        )


def _refuse_singular(model: Model, q: np.ndarray, limits: MotionLimits) -> None:
    """Refuse a motion whose loops close worse than they may."""
    condition = float(model.mechanism.condition(q).max())
    if condition > (1 + _WORST) * limits.condition:
        raise CannotAnswer(
            "no_solution",
            f"no motion was found that keeps clear of a singularity of the loops: conditioning {condition:.3g}, the limit is "
            f"{limits.condition:.3g}",
            "the same plan along a path that leads around it, or with a larger limit of the conditioning",
        )


def _excess_words(excess: float) -> list[str]:
    if excess <= _TOLD:
        return []
    return [f"between the nodes a limit is left by up to {100 * excess:.1f} %; more nodes, or a margin, keep it"]
