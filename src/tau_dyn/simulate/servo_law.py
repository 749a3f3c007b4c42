"""How a servo turns a command and its position into torque: the law that its firmware and its motor follow, and its file.

    goal = profile(command(t - delay)),    e = goal - q, less the dead band
    u = clip(position_gain e + integral_gain int e dt - derivative_gain v, +-limit)          [share of the supply]
    x = u supply (1 - supply_sag |u|) - back_emf v,    tau = force_per_unit sign(x) |x|^drive_exponent
    friction = coulomb + load_friction |tau| + carried_friction |load| + stiction exp(-|v| / stiction_speed), and viscous v

The profile moves the goal with at most `speed_limit` and `acceleration_limit`, and brakes it to rest at the command. With
`steps_pass: 1` it acts on streamed goals only: commands that change within a tenth of a second of their last change, no faster
than 5 rad/s. A step then is the goal at once.

A cascade has an inner speed loop: with a `speed_gain`, the first line of u is a wanted speed w, at most `speed_limit`, and
`u = speed_gain (w - v) + speed_integral_gain int (w - v) dt`. `command` gives the kind of the commands: `position` (the default),
`speed` (commands are w), `current` (commands are u [A], force_per_unit is the torque of one ampere) or `pwm` (commands are u).

The output takes `torque_delay` to become torque. A delay of the position that the law uses is a `torque_delay` and a
`command_delay` of less; only the two delays can be estimated from a log. A spring of `joint_compliance` and `joint_damping`,
and a play of `backlash`, may be between the motor (its armature and friction) and the link; with `encoder: motor` the law uses
the motor's position (the default is `link`); `measured` names the one that the logs hold (by default the encoder's).

The output `u` is a share of the supply voltage, as a hobby servo's pulse width is. `force_per_unit` is then the stall torque at
the nominal supply, and `back_emf` the inverse of the speed without load. With `back_emf: 0` it is a torque or current servo.
Where x opposes u, the motor brakes with the share `braking` of this torque; a bridge that freewheels does not brake. A bridge
with much inductance and a slow pulse gives a torque that grows less than its pulse width, with an exponent below one. A law
file is a controller file (see `controllers`) whose first line is `law: servo`:

    law: servo
    position_gain: 2.65          # [1/rad], required
    force_per_unit: 2.94         # [N m], required
    back_emf: 0.2                # [s/rad]
    command_delay: {estimate: 0.02}   # a start value, to be estimated
    logs:                        # entries that differ in some logs, by a pattern of their names
      "kp800_*": {position_gain: 4.6}
    encoder: motor               # or link, the default
    command: position            # the default, or speed, current, pwm
    enabled: torque_enable       # the log's column that is zero where the motor is switched off
    supply: {column: input_volts, nominal: 7.4}

A number may also be a list in the order of the actuated joints, or a mapping from joint to number.
Reference: Duclusaud, Passault & Rouxel 2025 (BAM, extended friction models of servos).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml
from tau_dyn.robot import Robot


class ServoEntry(NamedTuple):
    """One number of a servo law: its unit, its default value, and its description."""

    unit: str
    default: float
    words: str


SERVO_ENTRIES = {
    "position_gain": ServoEntry("1/rad", np.nan, "share of the supply for a position error of one rad"),
    "integral_gain": ServoEntry("1/(rad s)", 0.0, "how fast the position error is integrated"),
    "derivative_gain": ServoEntry("s/rad", 0.0, "share of the supply that the measured speed takes off"),
    "speed_gain": ServoEntry(
        "s/rad", 0.0, "share of the supply for a speed error of one rad/s, of a cascade's inner loop"
    ),
    "speed_integral_gain": ServoEntry("1/rad", 0.0, "how fast that loop's speed error is integrated"),
    "limit": ServoEntry("1", 1.0, "largest share of the supply"),
    "force_per_unit": ServoEntry("N m", np.nan, "torque at standstill for the whole nominal supply"),
    "back_emf": ServoEntry("s/rad", 0.0, "share of the supply that the motor's own voltage takes off"),
    "supply_sag": ServoEntry("1", 0.0, "share of the supply lost at full output"),
    "drive_exponent": ServoEntry("1", 1.0, "power with which torque grows with the voltage"),
    "braking": ServoEntry("1", 1.0, "share of the torque while the motor's own voltage exceeds the output"),
    "dead_band": ServoEntry("rad", 0.0, "position error without answer"),
    "command_step": ServoEntry("rad", 0.0, "step to which commands are rounded"),
    "command_delay": ServoEntry("s", 0.0, "time from a command to the answer"),
    "speed_limit": ServoEntry("rad/s", np.inf, "largest speed of the goal profile"),
    "acceleration_limit": ServoEntry("rad/s^2", np.inf, "largest acceleration of the goal profile"),
    "steps_pass": ServoEntry("1", 0.0, "1 where the goal profile lets steps pass and acts on streamed goals only"),
    "load_friction": ServoEntry("1", 0.0, "friction for a motor torque of one"),
    "carried_friction": ServoEntry("1", 0.0, "friction for a load of one that the gear carries, the motor on or off"),
    "stiction": ServoEntry("N m", 0.0, "friction at rest beyond that of motion"),
    "stiction_speed": ServoEntry("rad/s", 0.05, "speed at which the friction of rest has fallen to a third"),
    "torque_delay": ServoEntry("s", 0.0, "time from the law's output to the motor's torque"),
    "joint_compliance": ServoEntry("rad/(N m)", 0.0, "twist between motor and link for a torque of one"),
    "joint_damping": ServoEntry("N m s/rad", 0.0, "damping of that twist"),
    "backlash": ServoEntry("rad", 0.0, "play between motor and link, from one stop to the other"),
}
"""The numbers of a servo law, each one a joint."""

REQUIRED = ("position_gain", "force_per_unit")
COMMANDS = ("position", "speed", "current", "pwm")
"""Kinds of commands; the first is the default."""
_NEEDED = {"position": REQUIRED, "speed": ("speed_gain", "force_per_unit")}
_OUTER = ("position_gain", "integral_gain", "derivative_gain", "dead_band")
_UNUSED = {"position": (), "speed": (*_OUTER, "acceleration_limit", "steps_pass"), "current": (*_OUTER, "speed_gain",
           "speed_integral_gain", "speed_limit", "acceleration_limit", "steps_pass", "back_emf", "supply_sag")}  # fmt: skip
_UNUSED["pwm"] = tuple(x for x in _UNUSED["current"] if x not in ("back_emf", "supply_sag"))
SIDES = ("link", "motor")
"""Side of an encoder; the first is the default, as on hobby servos, whose potentiometer or magnet is on the output."""
_OTHER_KEYS = ("law", "logs", "enabled", "supply", "encoder", "measured", "command")
_MAY_BE_INFINITE = ("limit", "speed_limit", "acceleration_limit")
_DELAYS = ("command_delay", "torque_delay")
MAX_DELAY_S = 1.0
"""Longest delay of a law file [s]; servos answer within tens of milliseconds, and more is a number of milliseconds or samples."""


@dataclass(frozen=True, eq=False)
class ServoLaw:
    """A servo's law for the joints of a robot.

    Attributes:
        joints: Actuated joints.
        values: One number a joint (na,) for each of `SERVO_ENTRIES`.
        estimated: Entries that are to be estimated, their values being a start.
        by_log: Pattern of a log's name -> entries (na,) that differ there.
        enabled: Column of a log that is zero where the motor is switched off; empty for always on.
        supply: Column of a log with the supply voltage; empty for the nominal one.
        nominal_supply: The voltage that `force_per_unit` holds for [V].
        given: Whether the user gave the law; a law that is estimated without start values has no torque scale.
        encoder: Side of the joint, of `SIDES`, whose position and speed the law uses.
        measured: Side whose position the logs hold.
        command: Kind of the commands, one of `COMMANDS`.
    """

    joints: tuple[str, ...]
    values: Mapping[str, np.ndarray]
    estimated: frozenset[str] = frozenset()
    by_log: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    enabled: str = ""
    supply: str = ""
    nominal_supply: float = 1.0
    given: bool = True
    encoder: str = SIDES[0]
    measured: str = SIDES[0]
    command: str = COMMANDS[0]

    @classmethod
    def of(
        cls,
        joints: tuple[str, ...],
        *,
        given: bool = True,
        encoder: str = SIDES[0],
        command: str = COMMANDS[0],
        **entries: float | np.ndarray,
    ) -> ServoLaw:
        """Build a law for joints; a single number holds for all of them, an entry that is not named has its default."""
        for key in entries:
            if key not in SERVO_ENTRIES:
                raise UnknownName("servo entry", key, SERVO_ENTRIES)
        full = {key: row.default for key, row in SERVO_ENTRIES.items()} | _list_defaults(command) | entries
        return cls(
            joints, {key: np.broadcast_to(np.asarray(x, float), len(joints)) for key, x in full.items()}, given=given,
            encoder=encoder, measured=encoder, command=command,
        )  # fmt: skip

    def with_values(self, **entries: np.ndarray) -> ServoLaw:
        """Return the law with some entries (na,) replaced."""
        return replace(self, values={**self.values, **entries})

    def in_log(self, name: str) -> Mapping[str, np.ndarray]:
        """Return the entries that hold in a log; the last pattern that its name fits counts."""
        found = dict(self.values)
        for pattern, entries in self.by_log.items():
            if fnmatchcase(Path(name).name, pattern):
                found |= entries
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the law as its file holds it; entries at their default are left out."""

        def plain(entries: Mapping[str, np.ndarray]) -> dict[str, Any]:
            out: dict[str, Any] = {}
            for key, values in entries.items():
                if not np.all(values == SERVO_ENTRIES[key].default):
                    rows = {j: float(x) for j, x in zip(self.joints, values, strict=True)}
                    if len(set(rows.values())) > 1 and np.isinf(SERVO_ENTRIES[key].default):
                        rows = {
                            j: x for j, x in rows.items() if np.isfinite(x)
                        }  # joints that are left out have no limit
                        out[key] = rows
                        continue
                    out[key] = next(iter(rows.values())) if len(set(rows.values())) == 1 else rows
            return out

        content: dict[str, Any] = {"law": "servo", **plain(self.values)}
        if self.command != COMMANDS[0]:
            content["command"] = self.command
            del content["position_gain"]
        if self.by_log:
            content["logs"] = {pattern: plain(entries) for pattern, entries in self.by_log.items()}
        if self.enabled:
            content["enabled"] = self.enabled
        if self.supply:
            content["supply"] = {"column": self.supply, "nominal": self.nominal_supply}
        if self.encoder != SIDES[0]:
            content["encoder"] = self.encoder
        if self.measured != self.encoder:
            content["measured"] = self.measured
        return content


def is_servo_law(path: str | Path) -> bool:
    """Tell whether a controller file holds a servo's law rather than a cascade."""
    content = read_yaml(path)
    return isinstance(content, dict) and content.get("law") == "servo"


def read_servo_law(path: str | Path, robot: Robot) -> ServoLaw:
    """Return the servo's law that a file describes, for a robot's actuated joints.

    Raises:
        InputError: The file is missing or no such file; an entry is unknown, missing, or not a number that can be.
    """
    return build_servo_law(read_yaml(path), robot, str(path))


def build_servo_law(content: object, robot: Robot, where: str) -> ServoLaw:
    """Return the law that a file's content describes; see `read_servo_law`."""
    if not isinstance(content, dict) or content.get("law") != "servo":
        raise InputError(
            "file_format", f"{where}: a servo's law begins with 'law: servo' and holds {', '.join(REQUIRED)}"
        )
    for key in content:
        if key not in SERVO_ENTRIES and key not in _OTHER_KEYS:
            raise UnknownName("servo entry", str(key), [*SERVO_ENTRIES, *_OTHER_KEYS], where)
    given, estimated = _split_estimated({k: v for k, v in content.items() if k in SERVO_ENTRIES}, where)
    by_log = _read_by_log(content.get("logs"), robot.actuated, where)
    command = content.get("command", COMMANDS[0])
    if command not in COMMANDS:
        raise InputError("file_format", f"{where}: command is {', '.join(COMMANDS)}, not {str(command)[:60]!r}")
    cascade = ("integral_gain", "derivative_gain") if "speed_gain" in given else ()
    for key in (*_UNUSED[command], *cascade):
        if key in given or any(key in row for row in by_log.values()):
            raise InputError("file_format", f"{where}: '{key}' has no effect in a law of {command} commands"
                             f"{' with a speed_gain' if cascade else ''}; leave it out")  # fmt: skip
    for key in _NEEDED.get(command, REQUIRED[1:]):
        if key not in given:
            raise InputError(
                "file_format",
                f"{where}: '{key}' is missing; give its value, or '{key}: {{estimate: START}}' where it is not known",
            )
    defaults = {key: row.default for key, row in SERVO_ENTRIES.items()} | _list_defaults(command)
    values = {key: np.full(robot.na, x) for key, x in defaults.items()}
    values |= {key: _read_numbers(key, value, robot.actuated, where) for key, value in given.items()}
    column, nominal = _read_supply(content.get("supply"), where)
    enabled = content.get("enabled", "")
    if not isinstance(enabled, str):
        raise InputError("file_format", f"{where}: enabled must be the name of a column, not {enabled!r}")
    encoder = _read_side(content, "encoder", SIDES[0], where)
    return ServoLaw(
        robot.actuated, values, estimated, by_log, enabled, column, nominal,
        encoder=encoder, measured=_read_side(content, "measured", encoder, where), command=command,
    )  # fmt: skip


def _list_defaults(command: str) -> dict[str, float]:
    """Return the defaults of commands that are no positions: a position gain of no effect; no limit of currents."""
    if command == COMMANDS[0]:
        return {}
    return {"position_gain": 1.0} | ({"limit": np.inf} if command == "current" else {})


def _read_side(content: Mapping[str, Any], key: str, default: str, where: str) -> str:
    side = content.get(key, default)
    if side not in SIDES:
        raise InputError("file_format", f"{where}: {key} is {' or '.join(SIDES)}, not {str(side)[:60]!r}")
    return str(side)


def _split_estimated(content: Mapping[str, Any], where: str) -> tuple[dict[str, Any], frozenset[str]]:
    """Return the entries' values, and the names of those that are a start only."""
    plain, estimated = {}, set()
    for key, value in content.items():
        if isinstance(value, Mapping) and "estimate" in value:
            if set(value) != {"estimate"}:
                raise InputError("file_format", f"{where}: {key}: write {{estimate: START}} alone")
            estimated.add(key)
            plain[key] = value["estimate"]
        else:
            plain[key] = value
    return plain, frozenset(estimated)


def _read_by_log(content: object, joints: tuple[str, ...], where: str) -> dict[str, dict[str, np.ndarray]]:
    if content is None:
        return {}
    if not isinstance(content, dict) or not all(isinstance(row, dict) for row in content.values()):
        raise InputError("file_format", f"{where}: logs must map a pattern of log names to entries that differ there")
    found = {}
    for pattern, row in content.items():
        for key in row:
            if key not in SERVO_ENTRIES:
                raise UnknownName("servo entry", str(key), SERVO_ENTRIES, f"{where}: logs: {pattern}")
        found[str(pattern)] = {key: _read_numbers(key, value, joints, where) for key, value in row.items()}
    return found


def _read_supply(content: object, where: str) -> tuple[str, float]:
    if content is None:
        return "", 1.0
    nominal = content.get("nominal") if isinstance(content, dict) else None
    if (
        not isinstance(content, dict)
        or set(content) != {"column", "nominal"}
        or not _is_number(nominal)
        or not 0 < nominal < np.inf
    ):
        raise InputError("file_format", f"{where}: write supply: {{column: NAME, nominal: VOLTS}}")
    return str(content["column"]), float(nominal)


def spread_over_joints(
    key: str, value: object, joints: tuple[str, ...], where: str, default: float = np.nan
) -> list[Any]:
    """Return an entry of a law file joint by joint: one for all, a list in the joints' order, or a mapping by name.

    Args:
        key: Name of the entry.
        value: Value in the file.
        joints: Actuated joints.
        where: Begins sentences about the file.
        default: Value for joints that a mapping leaves out; nan if each must be named.

    Raises:
        InputError: A joint is unknown or has no entry, or the list has another length.
    """
    if isinstance(value, Mapping):
        for joint in value:
            if joint not in joints:
                raise UnknownName("actuated joint", str(joint), joints, f"{where}: {key}")
        missing = [joint for joint in joints if joint not in value]
        if missing and np.isnan(default):
            raise InputError("file_format", f"{where}: {key} has no number for joint {missing[0]}")
        return [value.get(joint, default) for joint in joints]
    if not isinstance(value, list):
        return [value] * len(joints)
    if len(value) != len(joints):
        raise InputError(
            "wrong_shape",
            f"{where}: {key} has {len(value)} number(s) for {len(joints)} joint(s); give one, or one a joint in the "
            f"order {', '.join(joints)}",
        )
    return value


def _read_numbers(key: str, value: object, joints: tuple[str, ...], where: str) -> np.ndarray:
    """Return one number a joint (na,)."""
    row = spread_over_joints(key, value, joints, where, SERVO_ENTRIES[key].default)
    for x in row:
        least = (
            "above zero"
            if key in (*REQUIRED, *_MAY_BE_INFINITE, "speed_gain", "stiction_speed", "drive_exponent")
            else "zero or more"
        )
        fits = (
            _is_number(x)
            and (x > 0 if least == "above zero" else x >= 0 or key == "command_delay")
            and (isfinite(x) or key in _MAY_BE_INFINITE)
        )
        if not fits:
            hint = "; YAML reads a number such as 1.0e-3 only with a point and a sign" if isinstance(x, str) else ""
            raise InputError("file_format", f"{where}: {key} must be a number {least}, not {str(x)[:60]!r}{hint}")
        if key == "steps_pass" and x not in (0, 1):
            raise InputError("file_format", f"{where}: steps_pass is 0 or 1, not {x:g}")
        if key in _DELAYS and _is_number(x) and abs(x) > MAX_DELAY_S:
            raise InputError("file_format", f"{where}: {key} is in seconds, {MAX_DELAY_S:g} at most, not {x:g}")
    return np.array(row, dtype=float)


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)
