"""Readings of a log: the ways in which its columns may deviate from the conventions of the robot file.

A reading changes one property at a time: signs, exchanged joints, scales and clocks of the columns, the direction of gravity, or
forces without a part that a controller or a filter subtracted. Scales are starting values of a number that is estimated. A
reading also gives the lines of the column map that mends the log, one for each column.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np

from tau_dyn.robot import Robot

SCALES = (1e-3, 1e-2, np.pi / 180, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 180 / np.pi, 100.0, 1000.0)
"""Scales of a column at which the search for its number starts: gear ratios, percent, degrees, mm, torque constants."""

MAX_PLAUSIBLE_SCALE = 3.0
"""Largest factor by which positions within the joint's limits may be in larger units."""

CLOCKS = (1e-3, 0.1, 0.5, 2.0, 10.0, 1e3)
"""Factors of a clock at which the search starts: another unit, or another rate than the logger assumes."""

UNITS = {"q": (180 / np.pi, 1000.0, 100.0), "tau": (1000.0,), "t": (1e3, 1e6, 1e9)}
"""Conversions of units: degrees, mm and mrad, cm; mN m; ms, us, ns. Their inverses count as well."""

Number = tuple[str, tuple[int, ...]]
"""A factor that a reading estimates, and the joints that share it: `tau`, `q`, `t`, or `gear` (q times and tau over it)."""

LACKING = {
    "gravity": (
        "gravity_subtracted",
        "lack{s} gravity: the controller subtracted it, or {balanced}. Log the motor torque, or add the nominal gravity of "
        "the robot file back",
    ),
    "model": (
        "model_subtracted",
        "lack{s} the forces of the bodies, and only friction is left: the controller subtracted its rigid-body model. Log the "
        "motor torque, or add the nominal force of the robot file back",
    ),
    "mean": (
        "mean_removed",
        "lack{s} {their} mean, which was removed although gravity gives one. Log the force without this processing",
    ),
}
"""Code and sentence of forces that lack a part."""


@dataclass(frozen=True)
class Rewiring:
    """One way in which the columns of a log are read wrongly: the log's column is `scale` times the truth.

    Attributes:
        code: Warning code.
        q_from: For each joint the joint whose position column holds its position (na,).
        tau_from: The same for forces.
        q_scale: Factor of the position columns against the truth (na,).
        tau_scale: Factor of the force columns against the truth (na,).
        gravity: Direction of gravity in the robot's base (3,); empty for the robot file's direction.
        t_scale: Factor of the clock against the truth.
        lacks: The part that each force lacks (na,): `gravity`, `model` or `mean`; `file_` if the file's bodies were subtracted.
        numbers: Factors that are estimated.
        joints: Indices of the joints concerned.
        words: Description of the fault; `{number}` is replaced by the estimate.
    """

    code: str
    q_from: tuple[int, ...]
    tau_from: tuple[int, ...]
    q_scale: tuple[float, ...]
    tau_scale: tuple[float, ...]
    gravity: tuple[float, ...] = ()
    t_scale: float = 1.0
    lacks: tuple[str, ...] = ()
    numbers: tuple[Number, ...] = ()
    joints: tuple[int, ...] = ()
    words: str = ""

    @classmethod
    def none(cls, na: int) -> Rewiring:
        """Return the reading without any change of the log."""
        return cls("", tuple(range(na)), tuple(range(na)), (1.0,) * na, (1.0,) * na)

    def moves_as(self, other: Rewiring) -> bool:
        """Return whether two readings have the same motion and gravity."""
        ours, theirs = ((x.q_from, x.q_scale, x.t_scale, x.gravity) for x in (self, other))
        return ours == theirs

    def times(self, number: Number, factor: float) -> Rewiring:
        """Return the reading with the columns of a number multiplied."""
        signal, joints = number
        if signal == "t":
            return replace(self, t_scale=self.t_scale * factor)
        q = _times(self.q_scale, joints, factor) if signal in ("q", "gear") else self.q_scale
        inverse = 1 / factor if signal == "gear" else factor
        tau = _times(self.tau_scale, joints, inverse) if signal in ("tau", "gear") else self.tau_scale
        return replace(self, q_scale=q, tau_scale=tau)

    def get(self, number: Number) -> float:
        """Return the value of a number."""
        signal, joints = number
        return {"t": (self.t_scale,), "tau": self.tau_scale}.get(signal, self.q_scale)[joints[0] if joints else 0]


def list_alternatives(robot: Robot, now: Rewiring, q: np.ndarray) -> Iterator[Rewiring]:
    """Yield the readings that differ from one in a single property of the columns; `q` are the logged positions (n, na)."""
    yield from _sign_changes(robot, now)
    yield from _exchanges(robot, now)
    yield from _scale_changes(robot, now, q)
    if not now.gravity:
        yield from _mountings(robot, now)
    if now.t_scale == 1:
        words = "the clock runs {number} times as fast as the robot moves"
        clock = replace(now, code="scale_wrong", joints=tuple(range(robot.na)), words=words)
        for factor in CLOCKS:
            yield _with_number(clock, ("t", ()), factor)


def list_lacking(robot: Robot, now: Rewiring, weighs: np.ndarray, is_centred: np.ndarray) -> Iterator[Rewiring]:
    """Yield the readings in which forces lack a part.

    Args:
        robot: The robot.
        now: The current reading.
        weighs: Whether gravity is a considerable part of each joint's force in the robot file (na,).
        is_centred: Whether each force has zero mean (na,).
    """
    everyone = tuple(range(robot.na))
    heavy, centred = np.flatnonzero(weighs).tolist(), np.flatnonzero(is_centred).tolist()
    if heavy:
        for kind in ("gravity", "file_gravity"):
            groups = [everyone, *((j,) for j in heavy)] if robot.na > 1 else [everyone]
            yield from (_lacking(robot, now, kind, group) for group in groups)
    yield from (_lacking(robot, now, kind, everyone) for kind in ("model", "file_model"))
    if len(centred) == robot.na > 1:
        yield _lacking(robot, now, "mean", everyone)
    yield from (_lacking(robot, now, "mean", (j,)) for j in centred)


def _lacking(robot: Robot, now: Rewiring, kind: str, group: Sequence[int]) -> Rewiring:
    code, text = LACKING[kind.removeprefix("file_")]
    one = len(group) == 1
    who = f"the force of {robot.actuated[group[0]]}" if one else "the forces of all joints"
    balanced = (
        "a spring or counterweight balances the joint" if one else "the bodies are balanced, unlike the robot file's"
    )
    words = f"{who} {text}".format(s="s" if one else "", their="its" if one else "their", balanced=balanced)
    lacks = now.lacks or ("",) * robot.na
    lacks = tuple(kind if j in group else x for j, x in enumerate(lacks))
    return replace(now, code=code, lacks=lacks, joints=tuple(group), words=words)


def build_unit_reading(robot: Robot, now: Rewiring, q: np.ndarray) -> Rewiring:
    """Return the reading in which positions (n, na) far outside their joints' limits are in degrees or mm, where that fits."""
    for j, kind in enumerate(robot.joint_kinds):
        unit = 180 / np.pi if kind == "revolute" else 1000.0
        if not is_within_reach(robot, j, q[:, j]) and is_within_reach(robot, j, q[:, j] / unit):
            now = now.times(("q", (j,)), unit)
    return now


def move_to_motor_side(robot: Robot, now: Rewiring, ratios: Sequence[tuple[int, float]], with_force: bool) -> Rewiring:
    """Return the reading with positions, and forces if `with_force`, of some joints at the motor's side of their gears."""
    for j, ratio in ratios:
        now = _with_number(now, ("gear" if with_force else "q", (j,)), ratio)
    joints = tuple(j for j, _ in ratios)
    names = ", ".join(robot.actuated[j] for j in joints)
    words = (
        f"positions and forces of {names} are at the motor's side of the gear, with ratios of {{number}}"
        if with_force
        else f"the positions of {names} are {{number}} times those of the robot file (gear ratio or unit)"
    )
    return replace(now, code="scale_wrong", joints=joints, words=words)


def list_map_lines(robot: Robot, reading: Rewiring) -> list[str]:
    """Return the lines of the column map that mends a log: one for each column that changes."""
    lines = []
    for signal, source, scale in (("q", reading.q_from, reading.q_scale), ("tau", reading.tau_from, reading.tau_scale)):
        for j, joint in enumerate(robot.actuated):
            column = f"{signal}_{robot.actuated[source[j]]}"
            if scale[j] != 1:
                lines.append(f"`{signal}_{joint}: {{column: {column}, scale: {1 / scale[j]:.6g}}}`")
            elif source[j] != j:
                lines.append(f"`{signal}_{joint}: {column}`")
    if reading.t_scale != 1:
        lines.append(f"`t: {{column: t, scale: {1 / reading.t_scale:.6g}}}`")
    return lines


def _with_number(now: Rewiring, number: Number, factor: float) -> Rewiring:
    numbers = now.numbers if number in now.numbers else (*now.numbers, number)
    return replace(now.times(number, factor), numbers=numbers)


def _sign_changes(robot: Robot, now: Rewiring) -> Iterator[Rewiring]:
    for j, joint in enumerate(robot.actuated):
        tau, q = _times(now.tau_scale, [j], -1.0), _times(now.q_scale, [j], -1.0)
        turned = partial(replace, now, code="sign_reversed", joints=(j,))
        yield turned(tau_scale=tau, words=f"the force of {joint} has the wrong sign")
        yield turned(q_scale=q, words=f"the position of {joint} has the wrong sign")
        both = (
            f"position and force of {joint} both have the wrong sign: its axis points the other way in the robot file"
        )
        yield turned(q_scale=q, tau_scale=tau, words=both)
    everyone = tuple(range(robot.na))
    if robot.na > 1:
        tau = _times(now.tau_scale, everyone, -1.0)
        words = "the forces of all joints have the wrong sign"
        yield replace(now, code="sign_reversed", tau_scale=tau, joints=everyone, words=words)


def _exchanges(robot: Robot, now: Rewiring) -> Iterator[Rewiring]:
    for i in range(robot.na):
        for j in range(i + 1, robot.na):
            for kinds in (("q",), ("tau",), ("q", "tau")):
                named = " and ".join({"q": "positions", "tau": "forces"}[k] for k in kinds)
                yield replace(
                    now,
                    code="joints_exchanged",
                    q_from=_swap(now.q_from, i, j) if "q" in kinds else now.q_from,
                    tau_from=_swap(now.tau_from, i, j) if "tau" in kinds else now.tau_from,
                    joints=(i, j),
                    words=f"the {named} of {robot.actuated[i]} and {robot.actuated[j]} are exchanged",
                )


def _scale_changes(robot: Robot, now: Rewiring, q: np.ndarray) -> Iterator[Rewiring]:
    groups = [(j,) for j in range(robot.na)] + ([tuple(range(robot.na))] if robot.na > 1 else [])
    for group in groups:
        who = robot.actuated[group[0]] if len(group) == 1 else "all joints"
        for signal, what in (("tau", "force"), ("q", "position")):
            words = (
                f"the {what} of {who} is {{number}} times that of the robot file (gear ratio, torque constant or unit)"
            )
            scaled = replace(now, code="scale_wrong", joints=group, words=words)
            for factor in SCALES:
                if signal == "tau" or _may_be_scaled(robot, now, q, group, factor):
                    yield _with_number(scaled, (signal, group), factor)


def _may_be_scaled(robot: Robot, now: Rewiring, q: np.ndarray, group: Sequence[int], factor: float) -> bool:
    """Return whether positions may be `factor` times the truth, by the joints' limits."""
    for j in group:
        x = q[:, now.q_from[j]] / now.q_scale[j]
        inside = [is_within_reach(robot, j, y) for y in (x, x / factor)]
        if not inside[1] or (inside[0] and factor > MAX_PLAUSIBLE_SCALE):
            return False
    return True


def is_within_reach(robot: Robot, j: int, x: np.ndarray) -> bool:
    """Return whether positions (n,) of a joint are within its limits, or half their width beyond."""
    low, high = robot.lower[j], robot.upper[j]
    slack = 0.5 * (high - low) if np.isfinite(high - low) else 4 * np.pi
    low, high = (low, high) if np.isfinite(high - low) else (-2 * np.pi, 2 * np.pi)
    return bool(np.all((x > low - slack) & (x < high + slack)))


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
