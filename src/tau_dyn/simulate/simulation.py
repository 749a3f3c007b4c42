"""Simulate a `Log` from a model, a motion, a controller and sensors; it has the form of a log of a real robot.

The file of `simulate --effects` lists the effects of the simulated robot and their numbers:

    effects:
      - effect: asymmetric_friction
        joints: [cart1]                      # all actuated joints without this line
        settings: {}                         # nonlinear settings of the effect, such as stribeck's {speed: 0.02}
        label: ""                            # ends the parameters' names where one joint has the effect twice
        parameters: {coulomb_pos: 189.1}     # the quantity for each of these joints, or a full parameter name
    parameters: {plate_link.mass: 10.2}      # any parameter of the robot or of the effects

A parameter that the file does not mention keeps the robot's nominal value, or zero.
"""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tau_dyn.effects import Effect, read_effects
from tau_dyn.estimate import pseudo_inertia
from tau_dyn.exceptions import InputError, UnknownName, require_kind
from tau_dyn.files import read_yaml
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot
from tau_dyn.simulate.controllers import CascadeController, CascadeLaw, Controller
from tau_dyn.simulate.limits import describe_exceeded_limit, describe_slowing
from tau_dyn.simulate.plant import run_plant
from tau_dyn.simulate.plant_run import PlantRun, Progress
from tau_dyn.simulate.sensors import EncoderReadings, Sensors, measure, record_run
from tau_dyn.simulate.trajectory import Trajectory

Feedback = Literal["encoder", "ideal"]


def simulate(
    model: Model,
    motion: Trajectory,
    controller: Controller | None = None,
    sensors: Sensors | None = None,
    *,
    seed: int = 0,
    rate_hz: float = 1000.0,
    feedback: Feedback = "encoder",
    name: str = "simulated",
    progress: Progress | None = None,
) -> Log:
    """Simulate a recording.

    Args:
        model: The true robot, with all its effects.
        motion: Reference; it is resampled to the control rate.
        controller: Feedback; by default a cascade with the robot's own gains, limited by its drives.
        sensors: Sensors; by default perfect ones at the control rate.
        seed: Seed of all noise; the same seed gives the same log.
        rate_hz: Control rate, which is the plant's step [Hz].
        feedback: 'encoder' closes the loop through the encoders' noise and rounding, 'ideal' through true positions.
        name: Name of the log.
        progress: Called with the share that is done.

    Returns:
        A log with `q_J`, `tau_J`, `q_ref_J` and the tool's position; its warnings are the motion's notes and
        a sentence for each joint that was often at its force limit.

    Raises:
        InputError: The motion leaves the robot's limits, the log rate does not fit, or the feedback is unstable.

    Example:
        >>> from tau_dyn.simulate import Trajectory
        >>> robot, t = td.load_robot("linear_axis"), np.linspace(0.0, 1.0, 101)
        >>> motion = Trajectory.through(robot.actuated, t, 0.05 * np.sin(np.pi * t[:, None]) ** 4)
        >>> td.simulate(td.Model.of(robot), motion)
        Log: simulated
          1 s at 1000 Hz, 1001 samples; axis.
    """
    sensors = sensors or Sensors()
    sensors.step(1 / rate_hz)
    rng = np.random.default_rng(seed)
    run = simulate_drive(model, motion, controller, sensors, rng, rate_hz=rate_hz, feedback=feedback, progress=progress)
    return measure(run, sensors, rng, name)


def simulate_drive(
    model: Model,
    motion: Trajectory,
    controller: Controller | None,
    sensors: Sensors,
    rng: np.random.Generator,
    *,
    rate_hz: float = 1000.0,
    feedback: Feedback = "encoder",
    progress: Progress | None = None,
) -> PlantRun:
    """Return the true run, for `measure`, several times if needed (`feedback='ideal'`)."""
    require_kind(model, Model, "model", "a Model, such as Model.of(robot)")
    require_kind(motion, Trajectory, "motion", "a Trajectory, such as build_named_motion returns")
    if motion.joints != model.robot.actuated:
        expected, got = ", ".join(model.robot.actuated), ", ".join(motion.joints)
        raise InputError(
            "mismatch", f"{motion.name} moves joints {got}; {model.robot.source} has {expected}, in this order"
        )
    _refuse_impossible_bodies(model)
    reference = motion.resampled(rate_hz)
    fault = describe_exceeded_limit(model, reference, condition=np.inf)
    if fault:
        raise InputError("unreachable", f"{motion.name}: {fault}{describe_slowing(model, reference)}")
    controller = controller or CascadeController(CascadeLaw.for_model(model), start=model.steady())
    if feedback == "ideal":
        return record_run(run_plant(model, reference, controller, progress=progress))
    if feedback != "encoder":
        raise InputError("invalid_value", f"feedback is 'encoder' or 'ideal', not '{feedback}'")
    encoder = EncoderReadings(model, sensors, reference.n_samples, rng)
    return record_run(run_plant(model, reference, controller, encoder=encoder, progress=progress))


def _refuse_impossible_bodies(model: Model) -> None:
    """Refuse inertial parameters that no mass distribution can have: such a plant can create energy."""
    for link in model.robot.links:
        J = pseudo_inertia(link.map @ model.robot.parameters.select(link.names).values)
        if np.linalg.eigvalsh(J)[0] < -1e-9 * max(float(np.trace(J)), 1e-12):
            raise InputError(
                "unsupported", f"{model.robot.source}: no body has the mass, centre and inertia given for {link.link}"
            )


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
            f"{where}: an effects file holds 'effects', a list, and 'parameters', a mapping, only",
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
    """Refuse two effects of one kind on one joint that cannot be distinguished."""
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
