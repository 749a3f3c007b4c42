"""A model predicts actuated forces: a robot, its additional effects, and a value for every parameter.

Identification writes a model, diagnosis extends it, simulation and feedforward use it. A model file is YAML that contains its
robot (the expanded URDF), so it needs neither the xacro nor its includes, and no code runs on loading.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tau_dyn.effects import (
    DELIVERED,
    REDUNDANT,
    SHIFTED_FORCE,
    Effect,
    Motion,
    compute_shifted_forces,
    describe_missing_state,
    get_measured_signals,
    name_effect_in_errors,
    read_effects,
)
from tau_dyn.exceptions import InputError, UnknownName, require_kind
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    LogSource,
    as_log,
    choose_force_cutoff,
    compute_rest_speed,
    differentiate,
    find_motion_band,
    lowpass,
    resample_segments,
)
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.parameters import Parameters
from tau_dyn.results import Shown
from tau_dyn.robot import INERTIAL, Robot, as_robot, load_robot_from_urdf

_FORMAT = 1  # version of the model file's layout


def _compute_shifted_forces(mechanism: Mechanism, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the change (N, na, na, 4) of the rigid body's forces at displaced positions; see `effects/joint_zero.py`."""
    units = mechanism.robot.force_units
    made = [compute_shifted_forces(lambda x: mechanism.inverse_dynamics(x, v, a), q, k, u) for k, u in enumerate(units)]
    return np.stack(made, axis=2)


COMPUTED: dict[str, Callable[[Mechanism, np.ndarray, np.ndarray, np.ndarray], np.ndarray]] = {
    "load": lambda mechanism, q, v, a: mechanism.guide_load(q, v, a),
    "reducer_torque": lambda mechanism, q, v, a: mechanism.reducer_torque(q, v, a),
    "passive": lambda mechanism, q, v, a: mechanism.passive_rates(q)[1],
    REDUNDANT: lambda mechanism, q, v, a: mechanism.redundant_motion(q, v, a),
    "inertia": lambda mechanism, q, v, a: mechanism.inertia(q),
    "weight_gradient": lambda mechanism, q, v, a: mechanism.weight_gradient(q),
    "gravity_turn": lambda mechanism, q, v, a: mechanism.gravity_turn(q),
    "rigid_force": lambda mechanism, q, v, a: mechanism.inverse_dynamics(q, v, a),
    SHIFTED_FORCE: _compute_shifted_forces,
}
"""Signals of a motion that the mechanism computes."""

_FORCES = frozenset({"force", DELIVERED})
"""Signals that are the force of the model without the effects that depend on it."""
BY_STATE = frozenset({*COMPUTED, *_FORCES, "damping"})
"""Signals that a single state determines."""

_SMALL = 1e-6
"""Step of a speed for the slope of friction, as a share of one and the speed [m/s or rad/s]."""


@dataclass(frozen=True, eq=False)
class Model(Shown):
    """A robot with effects and values.

    Attributes:
        robot: The robot; its `parameters` hold the rigid-body values.
        effects: The effects beyond the rigid body.
        effect_parameters: Values of the effects' parameters, in the effects' order.
        provenance: Source of the values: logs and hashes, versions, seed.
        controller: Servo law of the identification, in the form of a controller file; empty without a servo law.

    Example:
        >>> model = td.Model.of(td.load_robot("linear_axis")).with_values({"carriage_link.mass": 90.0})
        >>> model.torque(np.array([[0.0]]), np.array([[0.0]]), np.array([[2.0]]))
        array([[180.]])
        >>> model.save("axis.yaml")
        >>> td.Model.load("axis.yaml").parameters["carriage_link.mass"].value
        90.0
    """

    robot: Robot
    effects: tuple[Effect, ...]
    effect_parameters: Parameters
    provenance: Mapping[str, Any]
    controller: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls, robot: Robot | str | Path, effects: Iterable[Effect] = (), provenance: Mapping[str, Any] | None = None
    ) -> Model:
        """Build a model of a robot, its file or short name, with every effect at zero."""
        require_kind(effects, Iterable, "list of effects", "effects, as build_friction_model returns them")
        effects = tuple(effects)
        for effect in effects:
            require_kind(effect, Effect, "effect", "effects, as build_friction_model returns them")
        parameters = Parameters([p for effect in effects for p in effect.parameters])
        return cls(as_robot(robot), effects, parameters, dict(provenance or {}))

    @property
    def parameters(self) -> Parameters:
        """All parameters: the robot's, then the effects'; the regressor's column order."""
        return self.robot.parameters + self.effect_parameters

    @cached_property
    def mechanism(self) -> Mechanism:
        """The rigid-body dynamics at the robot's values."""
        return build_mechanism(self.robot)

    def with_parameters(self, parameters: Parameters) -> Model:
        """Return the model with other values; names must be the same."""
        n = len(self.robot.parameters)
        items = list(parameters)
        robot = self.robot.with_parameters(Parameters(items[:n]))
        effect_parameters = Parameters(items[n:])
        if effect_parameters.names != self.effect_parameters.names:
            raise UnknownName("parameter", str(effect_parameters.names), self.effect_parameters.names)
        return replace(self, robot=robot, effect_parameters=effect_parameters)

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Return the model with some values replaced, by name."""
        return self.with_parameters(self.parameters.with_values(values))

    def on(self, robot: Robot) -> Model:
        """Return this model's effects and values on another robot's geometry.

        Raises:
            InputError: The robots' parameters differ.
        """
        untied = robot.untied(n for n in self.robot.parameters.names if n not in robot.parameters and _is_inertial(n))
        if untied.parameters.names != self.robot.parameters.names:
            odd = min(set(untied.parameters.names) ^ set(self.robot.parameters.names))
            raise InputError(
                "mismatch", f"{robot.source}: parameter '{odd}' is of the model or of the robot, but not of both"
            )
        return replace(self, robot=untied.with_parameters(self.robot.parameters))

    def only(self, effects: Iterable[Effect]) -> Model:
        """Return the model with some of its effects, at their values."""
        kept = tuple(effects)
        names = [name for effect in kept for name in effect.parameters.names]
        return replace(self, effects=kept, effect_parameters=self.effect_parameters.select(names))

    def steady(self, signals: Iterable[str] = ()) -> Model:
        """Return the model with those of its effects whose force a single state determines, and the signals given with it.

        Effects that distort a recording (a delay, an encoder's error) or need a history are left out.
        """
        given = BY_STATE | set(signals)
        return self.only(effect for effect in self.effects if not describe_missing_state(effect, given))

    def regressor(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray | None = None,
        *,
        t: np.ndarray | None = None,
        signals: Mapping[str, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return all columns (N, na, p) along a motion; see `torque`."""
        self._refuse_states(t)
        return self.columns(self.motion(q, v, a, sign, t=t, signals=signals))

    def torque(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray | None = None,
        *,
        t: np.ndarray | None = None,
        signals: Mapping[str, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return actuated forces (N, na) [N or N m] along a motion, as the log would hold them.

        Args:
            q: Positions (N, na) [m or rad].
            v: Velocities (N, na).
            a: Accelerations (N, na).
            sign: Replaces `sign(v)` in friction (N, na).
            t: Time (N,) [s] of samples in order, evenly spaced; None for single states, in no order.
            signals: Inputs of the effects that the model cannot compute, such as `temperature` (N, na) [degC].

        Raises:
            InputError: An effect needs a signal that is not given, or acts on a recording while these are single states;
                `model.steady()` is the model without such effects.
        """
        self._refuse_states(t)
        motion = self.motion(q, v, a, sign, t=t, signals=signals)
        return self.mechanism.inverse_dynamics(motion.q, motion.v, motion.a) + self.effect_force(motion)

    def predict(self, log: LogSource) -> np.ndarray:
        """Return the forces (N, na) [N or N m] that the model predicts at a log's samples.

        Positions pass a zero-phase low-pass above the motion's band and are differentiated, so that near a log's ends (a few
        periods of the low-pass) speeds and accelerations are rough. A joint below the speed at which its direction is sure has
        no Coulomb friction here: at rest the force may be anything between both values. Parts between gaps with too few samples
        are nan.

        Args:
            log: A log, its path, or a table with `t` and `q_J` of every actuated joint.

        Raises:
            InputError: The log lacks a column that the robot or an effect needs.
        """
        self.robot.require_fixed_base("a prediction of forces from motion alone")
        read, joints = as_log(log), self.robot.actuated
        found = np.full((read.n_samples, len(joints)), np.nan)
        for piece in resample_segments(read):
            raw, rate = piece.joint("q", joints), piece.rate_hz
            if piece.n_samples < MIN_SEGMENT_SAMPLES:
                continue
            cutoff = choose_force_cutoff([find_motion_band(raw, rate)], rate) or 0.16 * rate
            q = lowpass(raw, cutoff, rate)
            v = differentiate(q, 1 / rate, accuracy=4)
            a = differentiate(v, 1 / rate, accuracy=4)
            rest = compute_rest_speed(raw, rate, cutoff)
            sign = np.where(np.abs(v) > rest, np.sign(v), 0.0)
            signals = get_measured_signals(piece, joints, q, v, rest)
            force = self.torque(q, v, a, sign, t=piece.t, signals=signals)
            here = (read.t >= piece.t[0]) & (read.t <= piece.t[-1])
            found[here] = np.column_stack([np.interp(read.t[here], piece.t, x) for x in force.T])
        return found

    def residuals(self, log: LogSource) -> np.ndarray:
        """Return measured minus predicted forces (N, na) [N or N m] at a log's samples; see `predict`.

        Raises:
            InputError: The robot has more drives than freedoms, so that the log's forces are not the predicted ones.
        """
        if self.robot.redundant_joints:
            raise InputError(
                "unsupported",
                f"{self.robot.source}: predicted forces are generalised ones of all drives; compare_fit projects the log's",
            )
        read = as_log(log)
        return read.joint("tau", self.robot.actuated) - self.predict(read)

    def columns(self, motion: Motion) -> np.ndarray:
        """Return all columns (N, na, p) along a motion that has the signals its effects need."""
        parts = [self.mechanism.regressor(motion.q, motion.v, motion.a)]
        for effect in self.effects:
            with name_effect_in_errors(effect):
                parts.append(effect.columns(motion))
        return np.concatenate(parts, axis=2)

    def motion(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray | None = None,
        *,
        t: np.ndarray | None = None,
        signals: Mapping[str, np.ndarray] | None = None,
        needs: Iterable[str] = (),
    ) -> Motion:
        """Return a motion (N, na) with the signals that this model's effects need, as far as they can be computed.

        Args:
            q: Positions (N, na) [m or rad].
            v: Velocities (N, na).
            a: Accelerations (N, na).
            sign: Replaces `sign(v)` in friction.
            t: Time (N,) [s] of samples in order.
            signals: Signals that were measured.
            needs: Names of further signals wanted.
        """
        q, v, a = (np.atleast_2d(x) for x in (q, v, a))
        found = dict(signals or {})
        wanted = {name for effect in self.effects for name in effect.needs} | set(needs)
        for name in sorted(wanted - set(found)):
            if name in COMPUTED:
                found[name] = COMPUTED[name](self.mechanism, q, v, a)
        if "damping" in wanted and "damping" not in found:  # before the force, which may depend on it
            found["damping"] = self.damping(Motion.of(self.robot.actuated, q, v, a, sign, t=t, signals=found))
        if missing := (wanted & _FORCES) - set(found):
            plain = self.only(e for e in self.effects if not _FORCES & set(e.needs))
            force = plain.mechanism.inverse_dynamics(q, v, a) + plain.effect_force(
                Motion.of(self.robot.actuated, q, v, a, sign, t=t, signals=found)
            )
            found |= dict.fromkeys(missing, force)
        return Motion.of(self.robot.actuated, q, v, a, sign, t=t, signals=found)

    def damping(self, motion: Motion) -> np.ndarray:
        """Return the slope of each joint's friction over its speed (N, na), with the direction of motion fixed."""
        kept = self.only(e for e in self.effects if not {*_FORCES, "damping"} & set(e.needs))
        step = _SMALL * (1.0 + np.abs(motion.v))
        ahead, behind = (kept.effect_force(replace(motion, v=motion.v + d)) for d in (step, -step))
        return (ahead - behind) / (2 * step)

    def effect_force(self, motion: Motion) -> np.ndarray:
        """Return the effects' share of the force (N, na) [N or N m]."""
        force = np.zeros(motion.v.shape)
        for effect in self.effects:
            with name_effect_in_errors(effect):
                force += effect.force(motion, self.effect_parameters)
        return force

    def _refuse_states(self, t: np.ndarray | None) -> None:
        """Refuse single states if an effect acts on a recording."""
        odd = [effect.name for effect in self.effects if effect.measured] if t is None else []
        if odd:
            raise InputError(
                "unsupported",
                f"effect {odd[0]} needs samples in the order of time; it acts on a recording, not on a single state",
            )

    def save(self, path: str | Path) -> None:
        """Write the model file atomically."""
        content = {
            "tau_dyn_model": _FORMAT,
            "provenance": dict(self.provenance),
            "robot": {
                "source": self.robot.source,
                "arguments": dict(self.robot.arguments),
                "actuated": [*self.robot.actuated, *self.robot.redundant_joints],
                "tool": self.robot.tool,
                "sha256": self.robot.sha256,
            },
            "effects": [effect.to_dict() for effect in self.effects],
            "untied": [n for n in self.robot.parameters.names if n not in _tied_names(self.robot)],
            "parameters": self.parameters.to_list(),
            **({"controller": dict(self.controller)} if self.controller else {}),
            "urdf": self.robot.urdf,
        }
        write_whole(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))

    @classmethod
    def load(cls, path: str | Path) -> Model:
        """Read a model file.

        Raises:
            InputError: The file is missing, not YAML, or not a model of this package; the message names the entry.
        """
        content = read_yaml(path)
        if not isinstance(content, dict) or content.get("tau_dyn_model") != _FORMAT:
            raise InputError(
                "file_format",
                f"{path}: not a tau_dyn model file (its first key is 'tau_dyn_model: {_FORMAT}'), as identify --out and "
                "diagnose --out write it",
            )
        for key, kind in (("robot", dict), ("effects", list), ("parameters", list), ("urdf", str)):
            _expect(content, key, kind, str(path))
        for key, kind in (("untied", list), ("provenance", dict), ("controller", dict)):
            _expect({key: kind(), **content}, key, kind, str(path))
        about = content["robot"]
        for key, kind in (("actuated", list), ("arguments", dict), ("tool", str)):
            _expect({key: kind(), **about}, key, kind, f"{path}: robot")
        robot = load_robot_from_urdf(
            content["urdf"],
            _find_source(str(about.get("source", path)), Path(path)),
            actuated=about.get("actuated"),
            tool=about.get("tool") or None,
            arguments=about.get("arguments"),
            sha256=str(about.get("sha256", "")),
            hold_passive=False,
        ).untied(str(name) for name in content.get("untied", []))
        model = cls.of(robot, read_effects(content["effects"], robot, str(path)), content.get("provenance"))
        saved = Parameters.from_list(content["parameters"], str(path))
        if set(saved.names) != set(model.parameters.names):
            odd = min(set(saved.names) ^ set(model.parameters.names))
            raise InputError("mismatch", f"{path}: parameter '{odd}' does not belong to this robot and these effects")
        return replace(
            model.with_parameters(saved.select(model.parameters.names)), controller=content.get("controller", {})
        )


def _expect(content: Mapping[str, Any], key: str, kind: type, where: str) -> None:
    if not isinstance(content.get(key), kind):
        raise InputError("file_format", f"{where}: '{key}' is missing or not a {kind.__name__}")


def _find_source(source: str, model: Path) -> str:
    """Return the path of a saved model's robot file: as saved, or relative to the model file if only that one exists."""
    near = [model.parent / source, model.parent / Path(source).name]
    found = (str(path) for path in near if Path(source).suffix and not Path(source).is_file() and path.is_file())
    return next(found, source)


def _tied_names(robot: Robot) -> set[str]:
    """Return the parameter names that the robot has without untying anything."""
    plain = load_robot_from_urdf(robot.urdf, robot.source, actuated=robot.actuated)
    return set(plain.parameters.names)


def _is_inertial(name: str) -> bool:
    return name.rsplit(".", 1)[-1] in INERTIAL
