"""List of all effects: those of this package in the contract's order, and those that a program adds by `register`.

    @tau_dyn.effects.register
    class Bellows(JointwiseEffect): ...

Model files, effect files, `simulate` and `diagnose` then know it by its name, like the built-in effects. No module is searched
for or run automatically: a program that loads a model with its own effect imports the module that registers it first.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from inspect import isabstract
from typing import TypeVar

from tau_dyn.effects.cogging import Cogging
from tau_dyn.effects.effect import Effect
from tau_dyn.effects.friction import (
    AsymmetricFriction,
    CoulombAsymmetry,
    QuadraticDrag,
    Stribeck,
    SymmetricFriction,
    TorqueOffset,
    ViscousAsymmetry,
    ViscousCurvature,
)
from tau_dyn.effects.gear_losses import DirectionalEfficiency, LoadFriction
from tau_dyn.effects.guideways import CartTilt, GuidewayCompliance, GuidewayNonparallel
from tau_dyn.effects.joint_zero import JointZero
from tau_dyn.effects.jointwise import DisplacementEffect, JointwiseEffect
from tau_dyn.effects.lost_motion import Backlash, JointCompliance
from tau_dyn.effects.motor_electrics import BackEmf, Inductance, SupplySag, WindingHeat
from tau_dyn.effects.periodic import CyclicRipple, TransmissionError
from tau_dyn.effects.presliding import Hysteresis, Lugre
from tau_dyn.effects.redundant_drives import (
    RedundantArmature,
    RedundantAsymmetricFriction,
    RedundantSymmetricFriction,
    RedundantTorqueOffset,
)
from tau_dyn.effects.robot_file import Armature, DriveGain, GravityDirection, PinionScale, ReducerCoupling
from tau_dyn.effects.static_friction import StaticFriction
from tau_dyn.effects.structural_compliance import StructuralCompliance
from tau_dyn.effects.timing import Delay, DriveLag
from tau_dyn.effects.torque_sensing import TorqueCrosstalk, TorqueSaturation
from tau_dyn.effects.torque_speed_limit import TorqueSpeedLimit
from tau_dyn.effects.varying_friction import (
    FrictionChange,
    PassiveJointFriction,
    PositionFriction,
    ThermalDrift,
)
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.robot import Robot

EFFECTS: dict[str, type[Effect]] = {}
"""Every effect by its name in model files, causes in the order in which they are listed."""

_SAID_BY_A_CAUSE = ("equation", "reveals")
E = TypeVar("E", bound=type[Effect])


def register(effect: E) -> E:
    """Register an effect under its name, and return it, so that the function can be used as a decorator.

    A user's class may be registered again under its name, as when a notebook's cell is run twice; the last one is used.

    Raises:
        InputError: It is not an effect that can be built, its name is invalid or another effect's, or it is a cause without the
            equation of its force or the motion that reveals it.
    """
    name = getattr(effect, "name", None)
    if not (isinstance(effect, type) and issubclass(effect, Effect)) or isabstract(effect):
        raise InputError(
            "invalid_value",
            f"{effect!r} is no effect: derive it from Effect or JointwiseEffect, with all that they leave open",
        )
    if not isinstance(name, str) or not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise InputError(
            "invalid_value", f"effect {effect.__name__} needs a name of small letters, digits and _, not {name!r}"
        )
    known = EFFECTS.get(name)
    if known is not None and not _again(known, effect):
        raise InputError(
            "unsupported",
            f"there is an effect '{name}' already, {known.__module__}.{known.__qualname__}; name yours otherwise",
        )
    missing = [key for key in _SAID_BY_A_CAUSE if effect.cause and not getattr(effect, key, "")]
    if missing:
        raise InputError(
            "invalid_value", f"effect {name} is a cause and has no {missing[0]}, which the answer tells people"
        )
    EFFECTS[name] = effect
    return effect


def _again(known: type[Effect], effect: type[Effect]) -> bool:
    """Whether a user's class is registered again, such as by a notebook's cell that is run twice."""
    ours = known.__module__.startswith("tau_dyn.")
    return known is effect or (known.__qualname__ == effect.__qualname__ and not ours)


# Friction models, then the causes in the contract's order.
_IN_ORDER: tuple[type[Effect], ...] = (
    SymmetricFriction, AsymmetricFriction,
    RedundantArmature, RedundantSymmetricFriction, RedundantAsymmetricFriction, RedundantTorqueOffset,
    CoulombAsymmetry, ViscousAsymmetry, Stribeck, LoadFriction, PositionFriction, ThermalDrift, PassiveJointFriction,
    QuadraticDrag, ViscousCurvature, TorqueOffset, DriveGain, CyclicRipple, Delay, DriveLag, Backlash, Hysteresis,
    TransmissionError, ReducerCoupling, PinionScale, GravityDirection, Armature, StructuralCompliance, JointCompliance,
    GuidewayNonparallel, GuidewayCompliance, CartTilt, FrictionChange,
    DirectionalEfficiency, Lugre, StaticFriction, TorqueSpeedLimit, Cogging,
    BackEmf, Inductance, WindingHeat, SupplySag,
    JointZero, TorqueSaturation, TorqueCrosstalk,
)  # fmt: skip

for _effect in _IN_ORDER:
    register(_effect)

FRICTION_MODELS: dict[str, tuple[type[Effect], ...]] = {
    "rigid": (),
    "symmetric": (SymmetricFriction, TorqueOffset),
    "asymmetric": (AsymmetricFriction,),
}
"""What `identify --model` offers by name."""


def build_friction_model(name: str, joints: Iterable[str], units: Iterable[str]) -> tuple[Effect, ...]:
    """Return the effects that a friction model's name denotes, acting on these joints.

    Raises:
        UnknownName: The name is not `rigid`, `symmetric` or `asymmetric`.
    """
    if name not in FRICTION_MODELS:
        raise UnknownName("friction model", name, FRICTION_MODELS)
    joints, units = tuple(joints), tuple(units)
    return tuple(effect(joints, units) for effect in FRICTION_MODELS[name])


def read_effects(rows: object, robot: Robot, where: str) -> tuple[Effect, ...]:
    """Build effects from a file's list of `{effect: NAME, joints: [...], settings: {...}, label: ""}`.

    Joints default to all actuated ones, settings to the effect's own defaults.

    Raises:
        InputError: `where`, the file, has an entry that is not an effect, or one that this robot cannot have.
    """
    if not isinstance(rows, list):
        raise InputError("file_format", f"{where}: 'effects' must be a list")
    return tuple(_read_effect(row, robot, where) for row in rows)


def _read_effect(row: object, robot: Robot, where: str) -> Effect:
    if not isinstance(row, dict):
        raise InputError(
            "file_format",
            f"{where}: an entry of 'effects' is written {{effect: NAME}}, with joints and settings, not {repr(row)[:60]}",
        )
    name = str(row.get("effect"))
    if name not in EFFECTS:
        raise UnknownName("effect", name, EFFECTS, where)
    joints, settings = row.get("joints", list(robot.actuated)), row.get("settings") or {}
    beside = [key for key in ("label", "joints", "units", "self") if isinstance(settings, dict) and key in settings]
    fault = ""
    if not isinstance(joints, list):
        fault = f"'joints' of effect {name} must be a list of names, not {joints!r}"
    elif not joints and issubclass(EFFECTS[name], JointwiseEffect):
        fault = f"'joints' of effect {name} is empty; name one, or leave it out for all of them"
    elif not isinstance(settings, dict):
        fault = f"'settings' of effect {name} must be a mapping from names to numbers"
    elif beside:
        fault = f"'{beside[0]}' is no setting of effect {name}; it stands beside its settings"
    if fault:
        raise InputError("file_format", f"{where}: {fault}")
    drives = (*robot.actuated, *robot.redundant_joints), (*robot.force_units, *robot.redundant_units)
    units, joints = dict(zip(*drives, strict=True)), [str(joint) for joint in joints]
    for joint in joints:
        if joint not in units:
            raise UnknownName("actuated joint", joint, units, where)
    own = {str(key): value for key, value in settings.items()}
    try:
        return EFFECTS[name](joints, [units[j] for j in joints], label=str(row.get("label") or ""), **own)
    except InputError as error:
        raise InputError(error.code, f"{where}: {error}") from error


def acts_on_recording(effect: Effect) -> bool:
    """Return whether an effect only distorts the recording, as a late force does, and does not change the robot's motion."""
    return effect.measured or (isinstance(effect, DisplacementEffect) and not isinstance(effect, Hysteresis))


def describe_missing_state(effect: Effect, given: Collection[str]) -> str:
    """Return the reason why a state `(q, v, a)` and the given signals do not determine an effect's force; empty if they do."""
    if acts_on_recording(effect):
        return "it distorts the recorded force and leaves the robot's force as it is"
    missing = [name for name in effect.needs if name not in given]
    return f"it feels {missing[0]}, which a single state does not give" if missing else ""
