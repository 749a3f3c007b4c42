"""Plan a motion from rest to rest, in the shortest time or with less effort, that the drives can follow.

`MotionPlan` holds the planned motion, its cost and its active limits.

The plan is checked on a fine clock, by the model in Python instead of the solver's expressions. The solver enforces limits at
the nodes and half-way between; if friction changes its sign in between, a limit may be exceeded for a moment. If the fine clock
finds an excess, the limit nearby is tightened by the same amount for the next iteration. A few iterations are enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import (
    Actuated,
    Along,
    Coordinates,
    Free,
    JointPath,
    Nodes,
    PathShape,
    build_joint_line,
    build_node_motion,
    build_tool_path,
    compute_min_duration,
    compute_smoothing_width,
    compute_trapezoid,
    scale_unknowns,
    start_nodes,
)
from tau_dyn.control.motion.expressions import ForceLaw, build_force_law, import_casadi
from tau_dyn.control.motion.limits import MotionLimits, compute_end_positions
from tau_dyn.control.motion.transcription import Transcription, TranscriptionSolution
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.message_codes import CodedWarning
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import Trajectory

AT_LIMIT = 0.99
"""Share of a limit from which on it counts as reached."""


class Binding(NamedTuple):
    """A limit that the motion reaches: quantity, joint, and the share of the time it does."""

    quantity: str
    joint: str
    share: float


@dataclass(frozen=True, eq=False)
class MotionPlan:
    """A motion between two states of rest.

    Attributes:
        model: Robot and effects of the plan.
        t: Time (N,) [s], evenly spaced.
        q: Positions (N, na) [m or rad].
        v: Speeds (N, na).
        a: Accelerations (N, na).
        tau: Forces (N, na) [N or N m] that the model needs for it, with smoothed friction.
        tool: Tool positions (N, 3) [m], or None for a robot without a tool.
        duration: Duration found by the optimiser [s]; the clock ends up to one step later.
        energy: `sum_i int tau_i^2 dt` [N^2 s], the thesis' measure.
        work: `sum_i int |tau_i v_i| dt` [J], without recuperation.
        objective: Duration plus weight times energy [s].
        energy_weight: The weight [s per N^2 s].
        path: 'free', 'line' or 'points'.
        status: IPOPT's word for the solution.
        iterations: IPOPT's iterations, of all rounds.
        seconds: Wall time of the search [s].
        start_duration: Duration of the trapezoidal profile that it started from [s].
        binding: Active limits, the longest active one first.
        excess: Largest share by which a force, speed or acceleration exceeds its limit on the clock; 0 within the limits.
        limits: Limits of the motion.
        width: Speed within which friction's sign was smoothed (na,).
        warnings: Sentences.
    """

    model: Model
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    tool: np.ndarray | None
    duration: float
    energy: float
    work: float
    objective: float
    energy_weight: float
    path: str
    status: str
    iterations: int
    seconds: float
    start_duration: float
    binding: tuple[Binding, ...]
    excess: float
    limits: MotionLimits
    width: np.ndarray
    warnings: tuple[str, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the actuated joints."""
        return self.model.robot.actuated

    @property
    def tool_speed(self) -> np.ndarray | None:
        """Speed of the tool (N,) [m/s], or None without one."""
        if self.tool is None:
            return None
        J = self.model.mechanism.tool_jacobian(self.q)
        return np.linalg.norm(np.einsum("nij,nj->ni", J, self.v), axis=1)

    @property
    def exceeds(self) -> bool:
        """Whether the motion leaves a limit between the solver's nodes."""
        return self.excess > _TOLD

    @property
    def share_at_force_limit(self) -> float:
        """Share of the time at which at least one drive is at its force limit."""
        return float(np.mean((np.abs(self.tau) >= AT_LIMIT * self.limits.force).any(axis=1)))

    def trajectory(self) -> Trajectory:
        """Return the motion as `simulate` and controllers take it."""
        return Trajectory(self.joints, self.t, self.q, self.v, self.a, "planned motion")

    def to_csv(self, path: str | Path) -> None:
        """Write t, q_ref, v_ref, a_ref, the file that `simulate --motion` reads."""
        self.trajectory().to_csv(path)

    def peaks(self) -> list[dict[str, Any]]:
        """Return each joint's largest speed, acceleration and force, and the limits of speed and force."""
        robot, limits = self.model.robot, self.limits
        return [
            {
                "joint": joint,
                "travel": float(np.ptp(self.q[:, k])),
                "speed": float(np.abs(self.v[:, k]).max()),
                "speed_limit": float(limits.speed[k]),
                "acceleration": float(np.abs(self.a[:, k]).max()),
                "force": float(np.abs(self.tau[:, k]).max()),
                "force_limit": float(limits.force[k]),
                "at_force_limit": float(np.mean(np.abs(self.tau[:, k]) >= AT_LIMIT * limits.force[k])),
                "unit": robot.position_units[k],
                "force_unit": robot.force_units[k],
            }
            for k, joint in enumerate(self.joints)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the values for `--json`."""
        return {
            "robot": self.model.robot.name,
            "path": self.path,
            "duration_s": self.duration,
            "energy_N2s": self.energy,
            "work_J": self.work,
            "energy_weight": self.energy_weight,
            "objective_s": self.objective,
            "solver": {"name": "ipopt", "status": self.status, "iterations": self.iterations, "seconds": self.seconds},
            "start_profile": {"shape": "trapezoidal", "duration_s": self.start_duration},
            "samples": len(self.t),
            "rate_hz": (len(self.t) - 1) / float(self.t[-1]),
            "binding": [b._asdict() for b in self.binding],
            "excess": self.excess,
            "friction_width": self.width,
            "joints": self.peaks(),
            "from": {"q": self.q[0], "tool": None if self.tool is None else self.tool[0]},
            "to": {"q": self.q[-1], "tool": None if self.tool is None else self.tool[-1]},
        }


MAX_LIMIT_EXCESS = 1e-3
"""Share of a limit that the solver leaves unused, and by which a plan may leave the rest between the places it looks at."""

_FINE = 10  # looks an interval


def compute_limit_usage(feedforward: Feedforward, motion: Actuated, limits: MotionLimits, which: list) -> np.ndarray:
    """Return by how much of its limit each limited quantity is used (M, m) along a motion."""
    values = {"force": feedforward(*motion), "speed": motion.v, "acceleration": motion.a}
    columns = [np.abs(values[name][:, k]) / getattr(limits, name)[k] for name, k in which]
    return np.stack(columns, axis=1)


def tighten_limits(
    share: np.ndarray,
    nodes: Nodes,
    coordinates: Coordinates,
    feedforward: Feedforward,
    limits: MotionLimits,
    which: list,
) -> np.ndarray | None:
    """Return the shares of the limits (2 N + 1, m) for the next round, or None if this one keeps all limits."""
    looks = np.linspace(0, 1, _FINE * (len(nodes.x) - 1) + 1)
    used = compute_limit_usage(feedforward, build_node_motion(coordinates, nodes, looks, nodes.T), limits, which)
    if used.max(initial=0.0) <= 1 + MAX_LIMIT_EXCESS:
        return None
    step = _FINE // 2
    out = share.copy()
    for look, k in np.argwhere(used > 1 + MAX_LIMIT_EXCESS / 2):
        near = [look // step, min(look // step + 1, len(share) - 1)]
        out[near, k] = np.minimum(out[near, k], share[near, k] / used[look, k])
    return out


_MAX_ITERATIONS = 6  # solutions with enforced limits; each tightens the limits that the last one exceeded
_MIN_INTERVALS = 6  # of a motion that is shorter than so many periods
_FIRST_WIDTH = 0.02  # [m/s or rad/s] of friction's sign, until the motion's speeds are known
_MIN_DISTANCE = 1e-9  # m or rad; ends closer together are one place
_STROKE = 1e-5  # share of a joint's range that is kept at its ends
_TOLD = 1e-3  # share of a limit by which a plan may exceed it without a warning
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
        end: End of the motion, in the same form.
        limits: Limits of the motion; default: those of the robot file; see `MotionLimits.of`.
        energy_weight: `w` [s per N^2 s]; 0 for the shortest time.
        path: None for any path, 'line' for a straight line of the tool, or points (n, 3) [m] that its spline goes through.
        joints: Whether start and end are actuated positions.
        dt: Step of the result's clock [s].
        nodes: Intervals of the program; the acceleration is linear within each.
        period: Sample period of the controller for which the motion is planned [s]. Intervals are not shorter than a period. If
            this requires fewer intervals, the motion lasts a whole number of periods, so that the controller's samples
            contain all of it.

    Raises:
        InputError: An end or the path is out of reach, near a singularity, or too heavy to hold; settings out of range.
        CannotAnswer: The solver found no motion within the limits, on a fine clock as well as at its nodes.
    """
    import_casadi()
    model = model if isinstance(model, Model) else Model.of(model)
    limits = MotionLimits.of(model) if limits is None else limits
    _check_settings(energy_weight, dt, nodes)
    first = compute_end_positions(model, start, "start", limits, joints=joints)
    last = compute_end_positions(model, end, "end", limits, joints=joints, near=first)
    if np.abs(last - first).max() < _MIN_DISTANCE:
        raise InputError("invalid_value", "start and end are the same place; there is no motion to plan")
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
    """Return the tool's straight line, or that of the actuated joints if the tool cannot follow its line."""
    if model.robot.tool_frame is not None:
        try:
            return build_tool_path(model, first, last, "line", limits)
        except InputError:
            pass
    straight = build_joint_line(first, last)
    model.mechanism.condition(straight.q(np.linspace(0, 1, 50)))  # raises if the loops do not close
    return straight


def _search(model: Model, coordinates: Coordinates, limits: MotionLimits, weight: float, nodes: int) -> _Search:
    """Solve from a trapezoidal profile, and again while the fine clock finds exceeded limits."""
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
    """Refuse a motion that keeps its limits only at the solver's nodes and middles."""
    excess = float(used.max(initial=0.0)) - 1
    if excess > _WORST:
        raise CannotAnswer(
            "no_solution",
            f"no motion within the limits was found: the solver's leaves one by {100 * excess:.0f} % between its nodes",
            "the same plan with larger limits, or with more nodes",
        )


def _refuse_singular(model: Model, q: np.ndarray, limits: MotionLimits) -> None:
    """Refuse a motion on which the conditioning of the loops exceeds its limit."""
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
    said = f"between the nodes a limit is left by up to {100 * excess:.1f} %; more nodes, or a margin, keep it"
    return [CodedWarning("near_limit", said)]
