"""Whether a robot can follow a motion: positions, speeds, loops that close well, forces.

A motion is within limits where every joint keeps its range, speed and force, and where the loops' conditioning stays below
a bound (by default five times that at home, at least 20). Forces are the model's, friction included. Checks of loops and
forces look at about 400 even samples and at every joint's peaks of acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.model import Model
from tau_dyn.simulate.trajectory import Trajectory

CHECKED_SAMPLES = 400  # samples checked, spread over the motion, in addition to its peaks
_MAX_SLOWING = 10.0
"""Largest factor by which a motion is slowed; the limits that it still exceeds are ranges and weights."""
_SLACK = 1e-9  # relative; values that equal a limit but for rounding are within it


def compute_condition_bound(model: Model) -> float:
    """Return the conditioning of the loops that a motion should not exceed: five times home's, at least 20."""
    return max(20.0, 5 * float(model.mechanism.condition(model.robot.home[None])[0]))


def describe_exceeded_limit(
    model: Model, motion: Trajectory, *, margin: float = 0.0, condition: float | None = None, forces: bool = True
) -> str | None:
    """Return the limit or singularity that a motion meets, as half a sentence, or None.

    Args:
        model: Robot and friction.
        motion: The motion.
        margin: Share of each limit that must stay unused.
        condition: Largest conditioning of the loops; by default `compute_condition_bound`.
        forces: Whether to check forces.
    """
    robot, share = model.robot, 1 - margin
    low, high = robot.lower, robot.upper
    inset = margin / 2 * np.where(np.isfinite(high - low), high - low, 0.0)
    for excess, values, unit, limit in (
        (np.maximum(low + inset - motion.q, motion.q - high + inset), motion.q, "", (low, high)),
        (np.abs(motion.v) - share * robot.velocity_limit, motion.v, "/s", robot.velocity_limit),
    ):
        if np.max(excess) > _SLACK:
            return _sentence(model, motion, excess, values, unit, limit)
    few = _telling(motion)
    loops = _broken_loops(model, few, compute_condition_bound(model) if condition is None else condition)
    if loops or not forces:
        return loops
    tau = model.steady().torque(few.q, few.v, few.a)
    excess = np.abs(tau) - share * robot.effort_limit
    return _sentence(model, few, excess, tau, "force", robot.effort_limit) if np.max(excess) > _SLACK else None


def describe_slowing(model: Model, motion: Trajectory) -> str:
    """Return a clause that reports how much slower a motion keeps the robot's limits, and options for it; '' if no speed does."""

    def is_within(factor: float) -> bool:
        slow = replace(motion, t=motion.t * factor, v=motion.v / factor, a=motion.a / factor**2)
        return describe_exceeded_limit(model, slow, condition=np.inf) is None

    if not is_within(_MAX_SLOWING):
        return ""
    low, high = 1.0, _MAX_SLOWING
    while high - low > 0.005:
        middle = (low + high) / 2
        low, high = (low, middle) if is_within(middle) else (middle, high)
    factor = np.ceil(20 * high) / 20
    speed, acceleration = np.abs(motion.v).max() / factor, np.abs(motion.a).max() / factor**2
    return (
        f"; {factor:.3g} times slower it would keep its limits: excite --speed {speed:.2g} --acceleration {acceleration:.2g} "
        "designs such a motion"
    )


def scale_to_limits(model: Model, build: Callable[[float], Trajectory], name: str) -> Trajectory:
    """Return the largest motion that keeps 5 % from all limits: `build(share)` for share = 1, 0.9, 0.81, ...

    Raises:
        InputError: Even a motion of 1 % is outside; the message names the limit.
    """
    bound, broken = compute_condition_bound(model), None
    for share in 0.9 ** np.arange(44):
        motion = build(float(share))
        fault = describe_exceeded_limit(model, motion, margin=0.05, condition=bound)
        if fault is None:
            return motion if share == 1 else _noted(motion, float(share), str(broken))
        broken = broken or fault
    raise InputError(
        "unreachable", f"{model.robot.source}: no {name} motion around home is within the robot's limits: {broken}"
    )


def _noted(motion: Trajectory, share: float, broken: str) -> Trajectory:
    note = f"the {motion.name} motion was reduced to {100 * share:.0f} % of its amplitude about home: {broken}"
    return replace(motion, notes=(*motion.notes, note))


def _telling(motion: Trajectory) -> Trajectory:
    """Return samples at which loops and forces are worst, near enough: even ones, and peaks of acceleration."""
    size = np.abs(motion.a)
    peak = np.zeros(motion.n_samples, dtype=bool)
    peak[1:-1] = np.any((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:]), axis=1)
    peak[:: max(1, motion.n_samples // CHECKED_SAMPLES)] = True
    return replace(motion, t=motion.t[peak], q=motion.q[peak], v=motion.v[peak], a=motion.a[peak])


def _broken_loops(model: Model, motion: Trajectory, bound: float) -> str | None:
    try:
        condition = model.mechanism.condition(motion.q)
    except LoopClosureError as fault:
        return str(fault).removeprefix(f"{model.robot.source}: ")
    worst = int(np.argmax(condition))
    if condition[worst] <= bound:
        return None
    return f"its loops come near a singularity at t = {motion.t[worst]:.4g} s (condition {condition[worst]:.3g} > {bound:.3g})"


def _sentence(
    model: Model, motion: Trajectory, excess: np.ndarray, values: np.ndarray, unit: str, limit: np.ndarray | tuple
) -> str:
    k, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
    robot = model.robot
    length = robot.force_units[j] if unit == "force" else robot.position_units[j] + unit
    verb = {"": "reaches", "/s": "moves at", "force": "needs"}[unit]
    if isinstance(limit, tuple):
        allowed = f"its range is {limit[0][j]:g} to {limit[1][j]:g} {length}"
    else:
        allowed = f"its limit is {limit[j]:g} {length}"
    return f"joint {motion.joints[j]} {verb} {values[k, j]:.4g} {length} at t = {motion.t[k]:.4g} s and {allowed}"
