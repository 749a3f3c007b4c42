"""The ways in which the columns of a log may be read wrongly, each with what to write into a column map.

Signs, exchanged joints, scales and clocks of the columns, and where gravity comes from: one thing at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from tau_dyn.robot import Robot

SCALES = (1e-3, 1e-2, np.pi / 180, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 180 / np.pi, 100.0, 1000.0)
"""Scales of a column: gear ratios, percent, degrees, mm, torque constants."""

MAX_PLAUSIBLE_SCALE = 3.0
"""Positions within the joint's limits are not taken for larger units than by this factor."""

CLOCKS = (1e-3, 0.1, 0.5, 2.0, 10.0, 1e3)
"""Factors of a clock in another unit, or at another rate than the logger believes."""

_IN_MAP = "into a column map (--columns)"


@dataclass(frozen=True)
class Rewiring:
    """One way in which the columns of a log are read wrongly: the log's column is `scale` times the truth.

    Attributes:
        code: Warning code.
        q_from: For each joint the joint whose position column holds its position (na,).
        tau_from: The same for forces.
        q_scale: Factor of the position columns against the truth (na,).
        tau_scale: Factor of the force columns against the truth (na,).
        gravity: Direction of gravity in the robot's base (3,); empty for the file's.
        t_scale: Factor of the clock against the truth.
        joints: Indices of the joints concerned.
        words: What is wrong, and the mend.
    """

    code: str
    q_from: tuple[int, ...]
    tau_from: tuple[int, ...]
    q_scale: tuple[float, ...]
    tau_scale: tuple[float, ...]
    gravity: tuple[float, ...] = ()
    t_scale: float = 1.0
    joints: tuple[int, ...] = ()
    words: str = ""

    @classmethod
    def none(cls, na: int) -> Rewiring:
        """Return the reading as the log says."""
        return cls("", tuple(range(na)), tuple(range(na)), (1.0,) * na, (1.0,) * na)

    def moves_as(self, other: Rewiring) -> bool:
        """Return whether two wirings differ in the signs and scales of forces only."""
        ours, theirs = (replace(x, tau_scale=(), code="", joints=(), words="") for x in (self, other))
        return ours == theirs


def list_alternatives(robot: Robot, now: Rewiring, q: np.ndarray) -> Iterator[Rewiring]:
    """Yield the wirings that differ from one in a single thing; `q` are the logged positions (n, na)."""
    yield from _sign_changes(robot, now)
    yield from _exchanges(robot, now)
    yield from _scale_changes(robot, now, q)
    if not now.gravity:
        yield from _mountings(robot, now)
    for factor in CLOCKS if now.t_scale == 1 else ():
        words = (
            f"the clock runs about {factor:g} times as fast as the robot moves; write "
            f"`t: {{column: t, scale: {1 / factor:g}}}` {_IN_MAP}, or give the true rate"
        )
        yield replace(now, code="scale_wrong", t_scale=factor, joints=tuple(range(robot.na)), words=words)


def _sign_changes(robot: Robot, now: Rewiring) -> Iterator[Rewiring]:
    for j, joint in enumerate(robot.actuated):
        tau, q = _times(now.tau_scale, [j], -1.0), _times(now.q_scale, [j], -1.0)
        line = f"`tau_{joint}: {{column: tau_{joint}, scale: -1}}`", f"`q_{joint}: {{column: q_{joint}, scale: -1}}`"
        turned = partial(replace, now, code="sign_reversed", joints=(j,))
        yield turned(tau_scale=tau, words=f"the force of {joint} has the wrong sign; write {line[0]} {_IN_MAP}")
        yield turned(q_scale=q, words=f"the position of {joint} has the wrong sign; write {line[1]} {_IN_MAP}")
        both = (
            f"position and force of {joint} both have the wrong sign (its axis points the other way); write {line[1]} and "
            f"{line[0]} {_IN_MAP}, or turn the axis in the robot file"
        )
        yield turned(q_scale=q, tau_scale=tau, words=both)
    everyone = tuple(range(robot.na))
    if robot.na > 1:
        words = f"the forces of all joints have the wrong sign; write `scale: -1` for each tau {_IN_MAP}"
        tau = _times(now.tau_scale, everyone, -1.0)
        yield replace(now, code="sign_reversed", tau_scale=tau, joints=everyone, words=words)


def _exchanges(robot: Robot, now: Rewiring) -> Iterator[Rewiring]:
    for i in range(robot.na):
        for j in range(i + 1, robot.na):
            one, other = robot.actuated[i], robot.actuated[j]
            for kinds in (("q",), ("tau",), ("q", "tau")):
                lines = " and ".join(f"`{k}_{one}: {k}_{other}`, `{k}_{other}: {k}_{one}`" for k in kinds)
                what = {"q": "positions", "tau": "forces"}
                named = " and ".join(what[k] for k in kinds)
                words = f"the {named} of {one} and {other} are exchanged; write {lines} {_IN_MAP}"
                yield replace(
                    now,
                    code="joints_exchanged",
                    q_from=_swap(now.q_from, i, j) if "q" in kinds else now.q_from,
                    tau_from=_swap(now.tau_from, i, j) if "tau" in kinds else now.tau_from,
                    joints=(i, j),
                    words=words,
                )


def _scale_changes(robot: Robot, now: Rewiring, q: np.ndarray) -> Iterator[Rewiring]:
    groups = [(j,) for j in range(robot.na)] + ([tuple(range(robot.na))] if robot.na > 1 else [])
    for group in groups:
        who = robot.actuated[group[0]] if len(group) == 1 else "all joints"
        column = robot.actuated[group[0]] if len(group) == 1 else "JOINT"
        for factor in SCALES:
            mend = f"`{{0}}_{column}: {{{{column: {{0}}_{column}, scale: {1 / factor:.4g}}}}}`"
            words = (
                "the {1} of {2} is about {3:.3g} times what the robot file says (gear ratio, torque constant or unit); write {0} "
                + _IN_MAP
            )
            for signal, what in (("tau", "force"), ("q", "position")):
                if signal == "q" and not _may_be_scaled(robot, now, q, group, factor):
                    continue
                text = words.format(mend.format(signal), what, who, factor)
                changed = _times(getattr(now, f"{signal}_scale"), group, factor)
                change: Callable[..., Rewiring] = partial(replace, now, code="scale_wrong", joints=group, words=text)
                yield change(**{f"{signal}_scale": changed})


def _may_be_scaled(robot: Robot, now: Rewiring, q: np.ndarray, group: Sequence[int], factor: float) -> bool:
    """Return whether positions may be `factor` times the truth, by the joints' limits."""
    for j in group:
        x = q[:, now.q_from[j]] / now.q_scale[j]
        low, high = robot.lower[j], robot.upper[j]
        slack = 0.5 * (high - low) if np.isfinite(high - low) else 4 * np.pi
        low, high = (low, high) if np.isfinite(high - low) else (-2 * np.pi, 2 * np.pi)
        inside = [bool(np.all((y > low - slack) & (y < high + slack))) for y in (x, x / factor)]
        if not inside[1] or (inside[0] and factor > MAX_PLAUSIBLE_SCALE):
            return False
    return True


def _mountings(robot: Robot, now: Rewiring) -> Iterator[Rewiring]:
    down = np.array(robot.model.gravity.linear)
    if not np.linalg.norm(down):
        return
    down = down / np.linalg.norm(down)
    for cell in product((-1.0, 0.0, 1.0), repeat=3):  # axes, face diagonals and space diagonals of a cube
        direction = np.array(cell) / max(float(np.linalg.norm(cell)), 1.0)
        if not any(cell) or direction @ down > 0.99:
            continue
        shown = ", ".join(f"{x:.2g}" for x in direction + 0.0)
        place = "the ceiling" if direction @ down < -0.99 else ("a wall" if abs(direction @ down) < 0.01 else "a slope")
        usual = ", ".join(f"{x:.2g}" for x in down + 0.0)
        words = (
            f"gravity acts along ({shown}) of the robot's base instead of ({usual}): the robot stands on {place}; "
            "turn the base in the robot file (the origin of its first fixed joint)"
        )  # fmt: skip
        yield replace(
            now, code="gravity_direction", gravity=tuple(direction), joints=tuple(range(robot.na)), words=words
        )


def _times(values: tuple[float, ...], group: Sequence[int], factor: float) -> tuple[float, ...]:
    return tuple(x * factor if k in group else x for k, x in enumerate(values))


def _swap(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    out = list(order)
    out[i], out[j] = out[j], out[i]
    return tuple(out)
