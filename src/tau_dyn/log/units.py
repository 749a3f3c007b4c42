"""Positions that read like millimetres or degrees: the likeliest mistake in a foreign log.

Inside the library everything is SI (m, rad). A robot's joint limits tell a wrong unit with certainty enough for a
warning; without a robot only a number that no joint reaches does. Nothing is converted here: the remedy is a `scale` in
the column map.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.log.log import Log

MAX_AXIS_LENGTH_M = 20.0
"""No prismatic joint without limits travels further [m]."""

WIDEST_TURN = 16 * np.pi
"""No revolute joint without limits turns further [rad]: eight turns."""

SUSPECT = 100.0
"""Without a robot, a position beyond this is in doubt [m or rad]."""


class JointLimits(Protocol):
    """A robot's actuated joints: names, kinds (`prismatic` or `revolute`) and limits (na,) [m or rad]."""

    @property
    def actuated(self) -> Sequence[str]: ...  # noqa: D102

    @property
    def joint_kinds(self) -> Sequence[str]: ...  # noqa: D102

    @property
    def lower(self) -> NDArray[np.float64]: ...  # noqa: D102

    @property
    def upper(self) -> NDArray[np.float64]: ...  # noqa: D102


def list_unit_warnings(log: Log, robot: JointLimits | None = None) -> tuple[str, ...]:
    """Return a sentence for every joint whose positions do not look like m or rad.

    Args:
        log: The log, as read.
        robot: Its robot, or None if unknown: then only positions beyond 100 are doubted.

    Returns:
        Sentences, empty where all is plausible. With limits, a joint is doubted if it leaves them by more than half
        their width.
    """
    if robot is None:
        return tuple(_doubt_without_robot(log))
    sentences = []
    limits = zip(robot.actuated, robot.joint_kinds, robot.lower, robot.upper, strict=True)
    for joint, kind, lower, upper in limits:
        if log.has("q", [joint]):
            sentences.append(_doubt(log, joint, kind, float(lower), float(upper)))
    return tuple(CodedWarning("scale_wrong", sentence) for sentence in sentences if sentence)


def _doubt(log: Log, joint: str, kind: str, lower: float, upper: float) -> str:
    """Return a sentence if a joint's positions are far outside its limits, naming the unit that explains it."""
    low, high = _extent(log, joint)
    prismatic = kind == "prismatic"
    unit, foreign, scale = ("m", "mm", 1e-3) if prismatic else ("rad", "degrees", np.pi / 180)
    reach = MAX_AXIS_LENGTH_M if prismatic else WIDEST_TURN
    lower, upper = max(lower, -reach), min(upper, reach)
    margin = (upper - lower) / 2
    if low >= lower - margin and high <= upper + margin:
        return ""
    where = f"{log.name}: q_{joint} runs from {low:.4g} to {high:.4g}, far outside {lower:.4g} to {upper:.4g} {unit}"
    slack = 0.1 * margin
    if low * scale >= lower - slack and high * scale <= upper + slack:
        line = f"q_{joint}: {{column: q_{joint}, scale: {scale:.9g}}}"
        return f"{where}; the unit is probably {foreign}: write `{line}` into a column map."
    return f"{where}; is it this joint, at its own side of the gear, in {unit}?"


def _doubt_without_robot(log: Log) -> list[str]:
    sentences: list[str] = []
    for joint in log.joints("q"):
        low, high = _extent(log, joint)
        if max(abs(low), abs(high)) > SUSPECT:
            sentence = (
                f"{log.name}: q_{joint} runs from {low:.4g} to {high:.4g}, probably in mm or degrees; "
                "positions are in m or rad (scale 0.001 or 0.0174532925 in a column map)."
            )
            sentences.append(CodedWarning("scale_wrong", sentence))
    return sentences


def _extent(log: Log, joint: str) -> tuple[float, float]:
    q = log.joint("q", [joint])
    return float(q.min()), float(q.max())
