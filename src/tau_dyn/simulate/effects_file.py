"""The file behind `simulate --effects`: which effects hide in the robot, and with which numbers.

    effects:
      - effect: asymmetric_friction
        joints: [cart1]                      # all actuated joints without this line
        settings: {}                         # what the effect is not linear in, such as stribeck's {speed: 0.02}
        label: ""                            # ends the parameters' names where one joint has the effect twice
        parameters: {coulomb_pos: 189.1}     # the quantity for each of these joints, or a full parameter name
    parameters: {plate_link.mass: 10.2}      # any parameter of the robot or of the effects

What the file does not mention keeps the robot's nominal value, or zero.
"""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Any

from tau_dyn.effects import Effect, read_effects
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

_KEYS = ("effect", "joints", "settings", "label", "parameters")


def read_effects_file(path: str | Path, robot: Robot) -> Model:
    """Return a robot's model with the effects and values of a file.

    Raises:
        InputError: The file is missing or not such a file; an effect, a joint, a parameter or a value is wrong.
    """
    where, content = str(path), read_yaml(path)
    if not isinstance(content, dict) or not content or not set(content) <= {"effects", "parameters"}:
        raise InputError(
            "file_format",
            f"{where}: an effects file holds 'effects', a list, and 'parameters', a mapping, and nothing else",
        )
    rows = content.get("effects") or []
    effects = _effects(rows, robot, where)
    _check_names(effects, where)
    model = Model.of(robot, effects)
    values: dict[str, Any] = {}
    for row, effect in zip(rows, model.effects, strict=True):
        given = _mapping(row.get("parameters"), f"{where}: parameters of {effect.name}")
        for key, value in given.items():
            values |= dict.fromkeys(_names(str(key), effect, f"{where}, {effect.name}"), value)
    for key, value in _mapping(content.get("parameters"), f"{where}: parameters").items():
        if key not in model.parameters:
            raise UnknownName("parameter", str(key), model.parameters.names, where)
        values[str(key)] = value
    return model.with_values({name: _number(value, name, model.parameters, where) for name, value in values.items()})


def _effects(rows: object, robot: Robot, where: str) -> tuple[Effect, ...]:
    for row in rows if isinstance(rows, list) else []:
        odd = sorted(set(map(str, row)) - set(_KEYS)) if isinstance(row, dict) else []
        if odd:
            known = ", ".join(f"'{key}'" for key in _KEYS)
            raise InputError("file_format", f"{where}: an effect has {known}, not '{odd[0]}'")
        if isinstance(row, dict) and not isinstance(row.get("joints", []), list):
            raise InputError(
                "file_format", f"{where}: joints of {row.get('effect')} must be a list, such as [{robot.actuated[0]}]"
            )
    return read_effects(rows, robot, where)


def _mapping(value: object, where: str) -> dict[Any, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError("file_format", f"{where} must be a mapping from names to numbers")
    return value


def _check_names(effects: tuple[Effect, ...], where: str) -> None:
    """Refuse two effects of one kind on one joint that nothing tells apart."""
    seen: set[str] = set()
    for effect in effects:
        for name in effect.parameters.names:
            if name in seen:
                raise InputError(
                    "file_format", f"{where}: two effects have a parameter {name}; give one {effect.name} a 'label'"
                )
            seen.add(name)


def _names(key: str, effect: Effect, where: str) -> list[str]:
    """Return the parameters that a key means: one by its full name, or one a joint by its quantity."""
    parameters = effect.parameters
    if key in parameters:
        return [key]
    found = [name for name in parameters.names if name.rsplit(".", 1)[-1] in (key, f"{key}{effect.label}")]
    if not found:
        raise UnknownName("parameter", key, parameters.names, where)
    return found


def _number(value: object, name: str, parameters: Parameters, where: str) -> float:
    parameter = parameters[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise InputError("file_format", f"{where}: {name} must be a finite number in {parameter.unit}, not {value!r}")
    if not parameter.lower <= value <= parameter.upper:
        raise InputError(
            "file_format",
            f"{where}: {name} = {value:g} {parameter.unit} is not between {parameter.lower:g} and {parameter.upper:g}",
        )
    return float(value)
