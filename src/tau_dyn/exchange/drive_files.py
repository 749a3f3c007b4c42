"""Drives of a model in the formats of programs that train controllers: BAM, mjlab, Isaac Lab.

    friction = coulomb sign(v) + viscous v [+ stribeck sign(v) exp(-(|v| / speed)^power)],   armature a

with the means of both directions. BAM has the Stribeck term (its model m2; without it m1). Isaac Lab has breakaway friction, the
sum of Coulomb and Stribeck, without a speed. Forces and speeds have the robot's limits; delays come from fitted actuators.
Values that these data do not determine are left out and reported: BAM's motor (`actuator`, `kt`, `R`), gains of position
control, stall torques. Load-dependent friction is not exported to BAM: there it depends on the torques of motor and load, here
on the torque that the reducer transmits.
Reference: Duclusaud, Passault et al. 2025 (BAM); formats of Rhoban/bam, mjlab 1.6 and Isaac Lab 2.3 (`viscous_friction`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tau_dyn.effects import Stribeck
from tau_dyn.exceptions import InputError
from tau_dyn.exchange.content import (
    Exported,
    build_carried_model,
    list_nominal_parameters,
    list_omissions,
    read_joint_law,
    split,
)
from tau_dyn.model import Model
from tau_dyn.version import __version__

DriveTarget = Literal["bam", "mjlab", "isaaclab"]


@dataclass(frozen=True)
class Drive:
    """Known values of one drive in SI units; unknown ones are None.

    Attributes:
        friction: Coulomb friction [N or N m].
        viscous: Viscous friction [N s/m or N m s/rad].
        armature: Drive inertia [kg or kg m^2].
        effort: Largest force [N or N m].
        speed: Largest speed [m/s or rad/s].
        delay: Delay of commands [s].
        stribeck: Stribeck peak, its speed and its power, or None.
    """

    friction: float | None
    viscous: float | None
    armature: float | None
    effort: float | None
    speed: float | None
    delay: float | None
    stribeck: tuple[float, float, float] | None


def build_drive_files(
    model: Model, target: DriveTarget, delays: Mapping[str, float] | None = None
) -> dict[str, Exported]:
    """Return a target's files of a model's drives: one for all, named '', or one per joint for BAM.

    Args:
        model: The model.
        target: The program.
        delays: Delay of each joint's commands [s], as `tau-dyn actuators` fits it.

    Raises:
        InputError: The target does not support such joints.
    """
    known = tuple(e for e in model.effects if isinstance(e, Stribeck) and target != "mjlab")
    carried = build_carried_model(model, drives=False, more=known)
    drives, odd = _read_drives(model, carried, delays or {}, known)
    said = [s for s in list_omissions(model, drives=False) if not any(f"effect {e.name} " in s for e in known)]
    said += odd
    if target == "isaaclab":
        said += [
            f"{j}: the Stribeck peak is breakaway friction, its speed is left out"
            for j, d in drives.items()
            if d.stribeck
        ]
    about = (list_nominal_parameters(model), split(model))
    if target == "bam":
        turning = dict(zip(model.robot.actuated, model.robot.force_units, strict=True))
        slides = [j for j in drives if turning[j] == "N"]
        if len(slides) == len(drives):
            raise InputError(
                "unsupported", f"{model.robot.source}: BAM describes turning joints, and all of these slide"
            )
        said += [f"{joint} slides, and BAM describes turning joints" for joint in slides]
        said.append(
            "BAM's actuator, kt and R are those of the motor, which the model does not know: add them to its files"
        )
        return {
            joint: Exported(_write_bam(drive), tuple(said), carried, *about)
            for joint, drive in drives.items()
            if joint not in slides
        }
    if delays is None:
        said.append("delays are unknown; --actuators FILE.yaml has them")
    write = _write_mjlab if target == "mjlab" else _write_isaaclab
    text = write(
        drives, " ".join([f"Written by tau_dyn {__version__} from {model.robot.source}.", *(f"{x}." for x in said)])
    )
    return {"": Exported(text, tuple(said), carried, *about)}


def _read_drives(
    model: Model, carried: Model, delays: Mapping[str, float], peaks: tuple[Stribeck, ...]
) -> tuple[dict[str, Drive], list[str]]:
    """Return each joint's drive, and sentences about values that are negative or unknown."""
    robot, found, odd = model.robot, {}, []
    n = len(robot.base_coordinates)
    for joint, effort, speed in zip(robot.driven, robot.effort_limit[n:], robot.velocity_limit[n:], strict=True):
        law = read_joint_law(carried, joint)
        values = {"friction": law.coulomb, "viscous": law.viscous, "armature": law.armature}
        odd += [f"{joint}: {_WORDS[name]} is negative and left out" for name, x in values.items() if x < 0]
        kept: dict[str, float | None] = {name: x if x > 0 else None for name, x in values.items()}
        own = [e for e in peaks if joint in e.joints]
        sizes = [carried.effect_parameters[f"{joint}.stribeck{e.label}"].value for e in own]
        peak = next(
            ((x, e.settings["speed"], e.settings["power"]) for x, e in zip(sizes, own, strict=True) if x > 0), None
        )
        found[joint] = Drive(
            **kept,
            effort=float(effort) if np.isfinite(effort) else None,
            speed=float(speed) if np.isfinite(speed) else None,
            delay=delays.get(joint),
            stribeck=peak,
        )
    for name, words in _WORDS.items():
        lacking = [j for j, drive in found.items() if getattr(drive, name) is None]
        which = "all drives" if len(lacking) == len(found) else ", ".join(lacking)
        odd += [f"{words} of {which} is unknown"] if lacking else []
    return found, odd


_WORDS = {
    "friction": "friction",
    "viscous": "viscous friction",
    "armature": "drive inertia",
    "effort": "the largest force",
    "speed": "the largest speed",
}


def _write_bam(drive: Drive) -> str:
    values = {"armature": drive.armature, "friction_base": drive.friction, "friction_viscous": drive.viscous}
    if drive.stribeck is not None:
        values |= dict(zip(("friction_stribeck", "dtheta_stribeck", "alpha"), drive.stribeck, strict=True))
    known = {name: x for name, x in values.items() if x is not None}
    return json.dumps({**known, "model": "m1" if drive.stribeck is None else "m2"}, indent=4) + "\n"


def _write_mjlab(drives: Mapping[str, Drive], about: str) -> str:
    rows = []
    for joint, drive in drives.items():
        values = {
            "effort_limit": drive.effort,
            "velocity_limit": drive.speed,
            "armature": drive.armature,
            "frictionloss": drive.friction,
            "viscous_damping": drive.viscous,
        }
        said = [f"{name!r}: {x!r}" for name, x in values.items() if x is not None]
        if drive.delay is not None:
            said += [f"'delay_{end}_lag': round({drive.delay!r} / TIMESTEP)" for end in ("min", "max")]
        rows.append(f"    {re.escape(joint)!r}: {{{', '.join(said)}}},")
    return _MJLAB.format(about=_wrap(about), rows="\n".join(rows))


def _write_isaaclab(drives: Mapping[str, Drive], about: str) -> str:
    groups: dict[float | None, list[str]] = {}
    for joint, drive in drives.items():
        groups.setdefault(drive.delay, []).append(joint)
    kinds = {delay: "ImplicitActuatorCfg" if delay is None else "DelayedPDActuatorCfg" for delay in groups}
    rows = [
        _format_group(f"drives_{k}", kinds[delay], delay, {j: drives[j] for j in joints})
        for k, (delay, joints) in enumerate(groups.items(), start=1)
    ]
    return _ISAACLAB.format(about=_wrap(about), imported=", ".join(sorted(set(kinds.values()))), rows="\n".join(rows))


def _format_group(name: str, kind: str, delay: float | None, drives: Mapping[str, Drive]) -> str:
    """Return one configuration of drives with a common delay; values are given by joint if they are known."""
    columns = {
        "effort_limit_sim": {j: d.effort for j, d in drives.items()},
        "velocity_limit_sim": {j: d.speed for j, d in drives.items()},
        "armature": {j: d.armature for j, d in drives.items()},
        "friction": {
            j: None if d.friction is None else d.friction + (d.stribeck or (0,))[0] for j, d in drives.items()
        },
        "dynamic_friction": {j: d.friction for j, d in drives.items()},
        "viscous_friction": {j: d.viscous for j, d in drives.items()},
    }
    known = {key: {re.escape(j): x for j, x in column.items() if x is not None} for key, column in columns.items()}
    said = [f"joint_names_expr={[re.escape(j) for j in drives]!r}", "stiffness=0.0", "damping=0.0"]
    said += [f"{key}={column!r}" for key, column in known.items() if column]
    said += [] if delay is None else [f"{end}_delay=round({delay!r} / TIMESTEP)" for end in ("min", "max")]
    body = "".join(f"        {line},\n" for line in said)
    return f"    {name!r}: {kind}(\n{body}    ),"


def _wrap(text: str) -> str:
    """Return sentences as the lines of a docstring, in printable characters."""
    plain = "".join(c if c.isprintable() else "?" for c in text)
    return plain.replace("\\", "/").replace('"""', "'''").replace(". ", ".\n")


_MJLAB = '''\
"""Drives for mjlab, as motors that take efforts.

{about}

DRIVES serves another configuration, too, such as BuiltinPositionActuatorCfg with your gains.
"""

from mjlab.actuator import BuiltinMotorActuatorCfg

TIMESTEP = 0.005  # s, of your simulation's physics; delays count in it

DRIVES = {{
{rows}
}}

ACTUATORS = tuple(BuiltinMotorActuatorCfg(target_names_expr=(name,), **values) for name, values in DRIVES.items())
'''

_ISAACLAB = '''\
"""Drives for Isaac Lab, for `ArticulationCfg.actuators`; stiffness and damping are your controller's, zero takes efforts.

{about}
"""

from isaaclab.actuators import {imported}

TIMESTEP = 0.005  # s, of your simulation's physics; delays count in it

ACTUATORS = {{
{rows}
}}
'''
