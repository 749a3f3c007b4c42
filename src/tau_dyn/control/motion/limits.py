"""Limits of a planned motion, its start and end positions, and the margin that is left for the feedback.

The margin for the feedback covers the encoder noise, amplified by the feedback's gains, and the error of the model.

A cascade's speed is a difference of two positions over two samples. So white noise sigma of the positions becomes noise
`sigma sqrt((kp + 1 / 2 dt)^2 + (1 / 2 dt)^2)` of its speed error, times K of force (`simulate/controllers.py`; the plant hardly
answers at these frequencies, and the integral, which sums differences, adds little).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.control.interface import PerJoint, broadcast_limit
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import place_home_orientation
from tau_dyn.mechanism import inverse_kinematics
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import CascadeLaw, compute_condition_bound

_NONE = 1e8  # acceleration [m/s^2 or rad/s^2] above which a drive is as good as unlimited


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of a motion, one per joint (na,) unless stated otherwise; inf if unlimited.

    Attributes:
        force: Largest force, in either direction [N or N m].
        speed: Largest speed [m/s or rad/s].
        acceleration: Largest acceleration [m/s^2 or rad/s^2].
        jerk: Largest jerk [m/s^3 or rad/s^3].
        lower: Lowest position [m or rad].
        upper: Highest position.
        condition: Largest conditioning of the loops (a number).
    """

    force: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    condition: float

    @classmethod
    def of(
        cls,
        model: Model | Robot,
        *,
        force: PerJoint | None = None,
        speed: PerJoint | None = None,
        acceleration: PerJoint | None = None,
        jerk: PerJoint | None = None,
        margin: float = 0.0,
        condition: float | None = None,
    ) -> MotionLimits:
        """Return limits: the given ones; the rest from the robot file.

        Args:
            model: Robot or model.
            force: Replaces the drives' limits of the robot file.
            speed: Replaces the speed limits of the robot file.
            acceleration: None for no limit.
            jerk: None for no limit. (The acceleration is continuous and zero at both ends in any case.)
            margin: Share of the forces that stays unused, for the feedback that will run the motion; 0 to below 1.
            condition: Largest conditioning of the loops; by default five times home's, at least 20.

        Raises:
            InputError: A limit is not positive or of the wrong length, or a joint has no limit at all.
        """
        model = model if isinstance(model, Model) else Model.of(model)
        robot = model.robot
        if not 0 <= margin < 1:
            raise InputError(
                "invalid_value",
                f"margin is the share of the forces kept for feedback, from 0 to below 1, not {margin:g}",
            )
        found = cls(
            (1 - margin) * _limit(robot, "force", force, robot.effort_limit),
            _limit(robot, "speed", speed, robot.velocity_limit),
            _limit(robot, "acceleration", acceleration, np.inf),
            _limit(robot, "jerk", jerk, np.inf),
            robot.lower,
            robot.upper,
            compute_condition_bound(model) if condition is None else float(condition),
        )
        for joint, force_, most in zip(robot.actuated, found.force, found.acceleration, strict=True):
            if not np.isfinite(min(force_, most)):
                raise InputError(
                    "unsupported",
                    f"{robot.source}: joint {joint} has no force limit, so no shortest time; give a limit of its force or "
                    "acceleration",
                )
        if not found.condition >= 1:
            raise InputError(
                "invalid_value", f"the largest conditioning of the loops must be at least 1, not {found.condition:g}"
            )
        return found

    def inside(self, share: float) -> MotionLimits:
        """Return limits of force, speed, acceleration and jerk smaller by a share."""
        less = {name: (1 - share) * getattr(self, name) for name in ("force", "speed", "acceleration", "jerk")}
        return replace(self, **less)


def _limit(robot: Robot, name: str, given: PerJoint | None, default: PerJoint) -> np.ndarray:
    """Return one limit per joint (na,); inf for limits that no drive reaches."""
    values = broadcast_limit(robot, name, given, default)
    return np.where(values < _NONE, values, np.inf)


_SLACK = 1e-9  # m or rad; ends that equal a limit but for rounding are within it


def compute_end_positions(
    model: Model, place: np.ndarray, name: str, limits: MotionLimits, *, joints: bool, near: np.ndarray | None = None
) -> np.ndarray:
    """Return the actuated positions (na,) of one end, at which the robot can hold still.

    Args:
        model: The robot and its effects.
        place: Tool position (3,) [m], in home's orientation, or actuated positions (na,) [m or rad].
        name: 'start' or 'end', for messages.
        limits: Limits of the motion.
        joints: Whether `place` holds actuated positions.
        near: Positions (na,) near which to search if several solutions exist.

    Raises:
        InputError: The place is out of reach, outside a joint's range, near a singularity, or too heavy to hold.
    """
    robot = model.robot
    given = np.asarray(place, float).ravel()
    wanted = robot.na if joints else 3
    if given.shape != (wanted,) or not np.isfinite(given).all():
        what = f"{robot.na} positions of {', '.join(robot.actuated)}" if joints else "a tool position x, y, z in m"
        raise InputError("wrong_shape", f"the {name} must be {what}: {wanted} finite numbers, not {place}")
    q = given if joints else _reached(robot, given, name, near)
    where = _place(robot, given) if joints else f"the {name} ({', '.join(f'{x:.6g}' for x in given)}) m"
    for k, joint in enumerate(robot.actuated):
        if not robot.lower[k] - _SLACK <= q[k] <= robot.upper[k] + _SLACK:
            allowed = f"{robot.lower[k]:g} to {robot.upper[k]:g} {robot.position_units[k]}"
            raise InputError("unreachable", f"{where} asks {q[k]:.4g} of joint {joint}, whose range is {allowed}")
    _check_closure(model, q, where, limits)
    _check_hold(model, q, where, limits)
    return q


def _reached(robot: Robot, position: np.ndarray, name: str, near: np.ndarray | None) -> np.ndarray:
    if robot.tool_frame is None:
        raise InputError(
            "unsupported",
            f"{robot.source}: there is no evident tool frame; name one with --tool FRAME, or give start and end as positions "
            "of the actuated joints",
        )
    found = inverse_kinematics(
        robot, place_home_orientation(robot, position[None]), start=None if near is None else near[None]
    )
    if not found.ok[0]:
        joint = f" at {found.culprit[0]}" if found.culprit[0] else ""
        at = ", ".join(f"{x:.6g}" for x in position)
        raise InputError(
            "unreachable", f"{robot.source}: the tool cannot reach the {name} ({at}) m: {found.reason[0]}{joint}"
        )
    return found.q[0]


def _check_closure(model: Model, q: np.ndarray, where: str, limits: MotionLimits) -> None:
    condition = float(model.mechanism.condition(q[None])[0])  # raises LoopClosureError if the loops do not close
    if condition > limits.condition:
        raise InputError(
            "unreachable",
            f"{where} is near a singularity of the loops: conditioning {condition:.3g}, the limit is {limits.condition:.3g}",
        )


def _check_hold(model: Model, q: np.ndarray, where: str, limits: MotionLimits) -> None:
    """Refuse a place at which the weight exceeds the drives' limits."""
    rest = np.zeros((1, len(q)))
    weight = model.mechanism.inverse_dynamics(q[None], rest, rest)[0]
    k = int(np.argmax(np.abs(weight) / limits.force))
    if abs(weight[k]) >= limits.force[k]:
        unit = model.robot.force_units[k]
        raise InputError(
            "unreachable",
            f"joint {model.robot.actuated[k]} needs {abs(weight[k]):.4g} {unit} to hold still at {where}, and may use "
            f"{limits.force[k]:.4g} {unit}",
        )


def _place(robot: Robot, q: np.ndarray) -> str:
    return ", ".join(f"{j} = {x:.4g}" for j, x in zip(robot.actuated, q, strict=True))


PEAK = 4.0
"""Standard deviations that a second's samples of white noise hardly leave."""


def estimate_feedback_noise(law: CascadeLaw, q: np.ndarray, encoder_noise: PerJoint, dt: float = 1e-3) -> np.ndarray:
    """Return the largest standard deviation (na,) of the feedback's forces [N or N m] at rest, over the positions.

    Args:
        law: The gains.
        q: Actuated positions (N, na) at which the mass matrix is evaluated.
        encoder_noise: Standard deviation of the positions' noise [m or rad].
        dt: The controller's step [s].
    """
    if not dt > 0 or not np.all(np.asarray(encoder_noise) >= 0):
        raise InputError(
            "invalid_value", "the noise of the feedback needs a step above zero and encoder noise not below zero"
        )
    error = np.asarray(encoder_noise) * np.hypot(law.position_gain + 0.5 / dt, 0.5 / dt)
    size = law.force_per_unit * law.velocity_gain
    if law.inertia is None:
        return size * error
    forces = [np.sqrt((law.inertia(x) ** 2) @ (law.velocity_gain * error) ** 2) for x in q]
    return law.force_per_unit * np.max(forces, axis=0)


def compute_feedback_margin(
    limits: MotionLimits,
    law: CascadeLaw,
    q: np.ndarray,
    encoder_noise: PerJoint,
    *,
    unknown: float = 0.05,
    dt: float = 1e-3,
) -> float:
    """Return the margin that a plan should keep for the feedback, for `MotionLimits.of(..., margin=...)`.

    With it, `(1 - margin) force (1 + unknown) + PEAK noise` stays within every drive's limit.

    Args:
        limits: Limits without a margin.
        law: The gains of the feedback.
        q: Actuated positions (N, na) on the way, such as both ends.
        encoder_noise: Standard deviation of the positions' noise [m or rad].
        unknown: Share by which the needed forces may differ from the model's.
        dt: The controller's step [s].

    Raises:
        InputError: The noise alone fills a drive's limit.
    """
    if not 0 <= unknown < 1:
        raise InputError("invalid_value", f"the unknown share of the forces must be from 0 to below 1, not {unknown:g}")
    share = PEAK * estimate_feedback_noise(law, q, encoder_noise, dt) / limits.force
    if not np.all(share < 1):
        raise InputError(
            "invalid_value",
            f"the feedback makes of the encoders' noise {100 * share.max():.0f} % of a drive's limit; lower its gains",
        )
    return float(1 - (1 - share.max()) / (1 + unknown))
