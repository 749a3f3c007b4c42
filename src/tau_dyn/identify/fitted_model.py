"""The fitted model from the user's choices: friction by name, fixed and free parameters, and its structural base parameters.

--fix plate_link.mass=9.13          taken as exact
--fix plate_link.mass=9.13+-0.05    known with a standard deviation: enters as a measurement of its own
--fix '*_link.mass'                 stays at its nominal value
--fix cart1.drive_gain=0.98+-0.01   the logged force times 0.98; the uncertainty is carried into every result
--free '*.armature'                 estimated although fixed by default
--bound cart1.viscous=0:400         kept within

A drive adds `armature * a_J` to its own joint's force. If this column is in the span of the bodies' columns (a prismatic
direct drive, the first joint of an arm), no data can separate it: it is part of a body's parameter. Otherwise it is a parameter
of its own, free unless the robot file or `--fix` gives it. Reference: Gautier & Khalil 1990, on grouping `Ia` with inertias.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from tau_dyn.effects import FRICTION_MODELS, build_friction_model, build_redundant_effects, compute_travel
from tau_dyn.estimate import BaseParameters, InertialBody, PhysicalConstraints, Regression, find_base
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.log import differentiate
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import NOT_GIVEN, Robot


@dataclass(frozen=True)
class Choices:
    """Requests by name or pattern, in the form of the command line, including motor constants.

    Attributes:
        fix: `NAME`, `NAME=VALUE` or `NAME=VALUE+-SIGMA`.
        free: `NAME`.
        bound: `NAME=LO:HI`.

    Example:
        >>> model = td.Model.of(td.load_robot("linear_axis"))
        >>> fixed = td.Choices(fix=("carriage_link.mass=91.5",)).apply(model).parameters["carriage_link.mass"]
        >>> fixed.value, fixed.free
        (91.5, False)
    """

    fix: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    bound: tuple[str, ...] = ()

    def apply(self, model: Model) -> Model:
        """Return the model with these requests carried out.

        Raises:
            UnknownName: A name or pattern that no parameter has.
            InputError: A value that is not a finite number, or bounds in the wrong order.
        """
        named = [*self.free, *(text.partition("=")[0] for text in (*self.fix, *self.bound))]
        exact = [n for n in named if not set(n) & set("*?[") and n not in model.effect_parameters and not _is_gain(n)]
        model = replace(model, robot=model.robot.untied(exact))
        changes: dict[str, dict] = {}
        for text in self.free:
            for name in model.parameters.match(text):
                changes.setdefault(name, {}).update(free=True)
        for text in self.fix:
            if not _is_gain(text.partition("=")[0]):
                pattern, value, sigma = read_fixed(text)
                for name in model.parameters.match(pattern):
                    given = {"value": value, "origin": "given"}
                    if value is None:
                        given = {"origin": "held"} if model.parameters[name].origin == NOT_GIVEN else {}
                    changes.setdefault(name, {}).update(given, free=sigma is not None, prior_stderr=sigma)
        for text in self.bound:
            pattern, lower, upper = read_bound(text)
            for name in model.parameters.match(pattern):
                given = changes.setdefault(name, {})
                given.update(lower=lower, upper=upper)
                if "origin" not in given:  # a nominal value follows its bounds, a given one has to lie within
                    given["value"] = min(max(model.parameters[name].value, lower), upper)
        model = model.with_parameters(model.parameters.update(changes))
        _refuse_outside(model.parameters.select(changes))
        return model

    def gains(self, joints: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Return the given drive gains: joint -> (factor, relative standard deviation)."""
        joints = tuple(joints)
        found = {}
        for text in self.fix:
            name = text.partition("=")[0]
            if not _is_gain(name):
                continue
            pattern = name.rsplit(".", 1)[0]
            chosen = [j for j in joints if fnmatchcase(j, pattern)]
            if not chosen:
                raise UnknownName("actuated joint", pattern, joints)
            _, value, sigma = read_fixed(text)
            if value is None or value <= 0:
                raise InputError("bad_option", f"--fix {text}: a drive gain is a positive factor, such as 1+-0.02")
            found.update({j: (value, (sigma or 0.0) / value) for j in chosen})
        return found


def scale_outputs(regression: Regression, factors: Mapping[str, float]) -> Regression:
    """Return the regression with each output multiplied by its factor (1 by default)."""
    scale = [factors.get(output, 1.0) for output in regression.outputs]
    return replace(
        regression, runs=tuple(replace(run, y=run.y * scale, y_all=run.y_all * scale) for run in regression.runs)
    )


def _refuse_outside(parameters: Parameters) -> None:
    for p in parameters:
        if p.origin == "given" and not p.lower <= p.value <= p.upper:
            raise InputError(
                "invalid_value", f"{p.name}={p.value:g} {p.unit} is outside its bounds, {p.lower:g} to {p.upper:g}"
            )


def _is_gain(name: str) -> bool:
    return name.endswith(".drive_gain")


def read_fixed(text: str) -> tuple[str, float | None, float | None]:
    """Return pattern, value and deviation of `NAME[=VALUE[+-SIGMA]]`."""
    pattern, equals, rest = text.partition("=")
    if not equals:
        return pattern, None, None
    value, uncertain, sigma = rest.replace("±", "+-").partition("+-")
    deviation = _number(sigma, text) if uncertain else None
    if deviation is not None and deviation <= 0:
        raise InputError("bad_option", f"--fix {text}: the uncertainty after +- must be positive")
    return pattern, _number(value, text), deviation


def read_bound(text: str) -> tuple[str, float, float]:
    """Return pattern and both ends of `NAME=LO:HI`."""
    pattern, _, rest = text.partition("=")
    low, colon, high = rest.partition(":")
    if not colon:
        raise InputError("bad_option", f"--bound {text}: write NAME=LO:HI, either may be empty")
    lower = _number(low, text) if low else float("-inf")
    upper = _number(high, text) if high else float("inf")
    if lower > upper:
        raise InputError("bad_option", f"--bound {text}: the lower bound is above the upper one")
    return pattern, lower, upper


def _number(word: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e15:
        raise InputError(
            "bad_option",
            f"'{text}': '{word}' is not a finite number of sensible size; write NAME=VALUE, such as plate_link.mass=9.13",
        )
    return value


WITHIN_BODIES = "within "
"""Prefix of the `origin` of a drive inertia that is part of bodies' parameters; their names follow."""
N_STATES = 60
"""Random states; each gives a row a joint, several times as many as bodies have parameters."""
_SAMPLES = 2000  # of the random motion


def build_model(robot: Robot, model: str | Path | Model) -> Model:
    """Return a model of this robot: friction by name, or the effects and values of a model file.

    Drive inertias without a given value are free if data can separate them from the bodies' inertia (`fitted_model.py`).

    Raises:
        InputError: The model file is of a robot with other actuated joints or parameters.
    """
    if isinstance(model, str) and model in FRICTION_MODELS:
        effects = build_friction_model(model, robot.driven, robot.driven_units)
        plain = Model.of(robot, (*effects, *build_redundant_effects(model, robot)))
        rotors = {p.name: {"value": p.value, "free": False, "origin": p.origin} for p in robot.redundant}
        plain = plain.with_parameters(plain.parameters.update(rotors))
        return free_drive_inertias(_with_friction_of_file(plain))
    if not isinstance(model, Model):
        if isinstance(model, str) and not Path(model).suffix:
            build_friction_model(model, robot.driven, robot.driven_units)  # raises an error that lists the names
        model = Model.load(model)
    if model.robot.actuated != robot.actuated:
        theirs = ", ".join(model.robot.actuated)
        raise InputError(
            "mismatch", f"the model is of a robot with joints {theirs}; this one has {', '.join(robot.actuated)}"
        )
    return free_drive_inertias(model.on(robot))


def _with_friction_of_file(model: Model) -> Model:
    """Return the model with the friction of the robot file as nominal values, the same in both directions."""
    said = {
        f"{joint}.{part}{side}": getattr(friction, part)
        for joint, friction in model.robot.friction.items()
        for part in ("viscous", "coulomb")
        for side in ("", "_pos", "_neg")
    }
    return model.with_values({name: value for name, value in said.items() if name in model.effect_parameters})


def free_drive_inertias(model: Model, seed: int = 0) -> Model:
    """Return the model with every drive inertia free that has no given value and is separable from the bodies' inertia.

    A drive inertia that is not separable stays at zero; its `origin` names the parameters that contain it.

    Args:
        model: Any model; drive inertias that its file or its user gave are kept.
        seed: Seed of the random states at which columns are compared.
    """
    robot, parameters = model.robot, model.parameters
    unknown = [j for j in robot.actuated if parameters[f"{j}.armature"].origin == NOT_GIVEN]
    if not unknown:
        return model
    rng = np.random.default_rng(seed)
    q = draw_random_positions(model, N_STATES, rng)
    v, a = rng.normal(size=(2, *q.shape))
    W = model.mechanism.regressor(q, v, a).reshape(-1, len(robot.parameters))
    names = robot.parameters.names
    bodies = [k for k, name in enumerate(names) if not name.endswith(".armature")]
    changes: dict[str, dict] = {}
    for joint in unknown:
        columns = [*bodies, names.index(f"{joint}.armature")]
        base = find_base(W[:, columns], tuple(names[k] for k in columns))
        free = len(bodies) in base.kept
        changes[f"{joint}.armature"] = {"free": True} if free else {"origin": _describe_holders(base)}
    return replace(model, robot=robot.with_parameters(robot.parameters.update(changes)))


def _describe_holders(base: BaseParameters) -> str:
    """Return the body parameters that contain the drive inertia of the last column, in words."""
    share = base.K[:, -1]
    names = [base.names[base.kept[k]] for k in np.argsort(-np.abs(share)) if share[k]]
    if len(names) == 1:
        return f"{WITHIN_BODIES}{names[0]}"
    links = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return f"{WITHIN_BODIES}the inertia of {', '.join(links)}"


def find_structural_base(model: Model, seed: int = 0) -> BaseParameters:
    """Return the base parameters of the free columns over random motion around home.

    Positions are drawn as far from home as the limits and the loops allow; speeds and accelerations are of order one.
    Effects that a single state does not determine are evaluated along a smooth random motion instead.
    """
    rng = np.random.default_rng(seed)
    q = draw_random_positions(model, N_STATES, rng)
    if len(model.steady().effects) == len(model.effects):
        v, a = rng.normal(size=(2, *q.shape))
        W = model.regressor(q, v, a)
    else:
        W = _along_a_motion(model, q, rng)
    known = [k for k, p in enumerate(model.parameters) if p.free and p.prior_stderr]
    rows = np.zeros((len(known), W.shape[2]))
    rows[range(len(known)), known] = np.abs(W).max()
    stacked = np.concatenate([W.reshape(-1, W.shape[2]), rows])
    free = model.parameters.free
    names = tuple(n for n, f in zip(model.parameters.names, free, strict=True) if f)
    units = [p.unit for p in model.parameters if p.free]
    return find_base(stacked[:, free], names, units=units)


def _along_a_motion(model: Model, reached: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return columns (n, na, p) along sums of sines within the box around home that random positions (N, na) span.

    Speeds and accelerations are differentiated as effects differentiate displacements, so that equivalent
    columns are equal. Temperatures, and the number of the log, change along the way.
    """
    robot, dt = model.robot, 0.005
    t = dt * np.arange(_SAMPLES)
    waves = np.sin(
        2 * np.pi * rng.uniform(0.1, 1.5, (5, robot.na)) * t[:, None, None] + rng.uniform(0, 6, (5, robot.na))
    )
    share = rng.dirichlet(np.ones(5), robot.na).T
    path, reach = np.sum(share * waves, axis=1), np.max(np.abs(reached - robot.home), axis=0)
    while not all(model.mechanism.reachable(q) for q in robot.home + reach * path[:: _SAMPLES // N_STATES]):
        reach = 0.9 * reach
    q = robot.home + reach * path
    v = differentiate(q, dt, accuracy=4)
    a = differentiate(v, dt, accuracy=4)
    numbers = np.array(sorted({0.0, *(e.settings["number"] for e in model.effects if "campaign" in e.needs)}))
    signals = {
        "temperature": 30 + 10 * np.sin(0.4 * t[:, None] + np.arange(robot.na)),
        "reversal": np.column_stack([compute_travel(x, y, 0.0) for x, y in zip(q.T, v.T, strict=True)]),
        "campaign": numbers[np.arange(_SAMPLES) % len(numbers)],
    }
    return model.regressor(q, v, a, t=t, signals=signals)[20:-20:5]


def draw_random_positions(model: Model, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw actuated positions (count, na) within limits at which the loops close, nearer home if necessary."""
    robot = model.robot
    low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - 1.0)
    high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + 1.0)
    found: list[np.ndarray] = []
    reach = 0.8
    while len(found) < count:
        q = robot.home + reach * (rng.uniform(low, high) - robot.home)
        if model.mechanism.reachable(q):
            found.append(q)
        else:
            reach *= 0.9
    return np.array(found)


def build_physical_constraints(model: Model) -> PhysicalConstraints:
    """Return the bodies whose inertial parameters must be physically consistent, and the rotors that they may contain."""
    rotors = tuple(p.name for p in model.robot.parameters if not p.free and p.origin.startswith(WITHIN_BODIES))
    return PhysicalConstraints(
        tuple(InertialBody(link.link, link.names, link.map) for link in model.robot.links), rotors
    )
