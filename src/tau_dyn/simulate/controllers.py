"""Feedback that follows a reference: a position loop around a velocity loop, as drives have it; and the file that sets it.

    e_k = kp (q_ref - q)_k + speed_feedforward v_ref_{k-1} - (q_k - q_{k-2}) / (2 dt),
    u_k = K (e_k + integral_rate * int e dt) + u_ff,   tau_k = force_per_unit * clip(u_k, -limit, limit).

K is `diag(kv)`, or, if the law has the mass matrix, `M(q_ref) diag(kv)`: then an error of one joint accelerates that joint
alone. Gains of the mass matrix' diagonal make a serial arm swing between its force limits, because an arm that gives way at the
other joints has far less inertia than its diagonal entry.

The speed is the one that a drive can compute: the difference of positions averaged over two samples. It is one sample old, so
the reference speed is taken of the sample before. The integral stops where the limit holds (anti-windup). `CascadeLaw.emps`
gives the law of the EMPS drive: `vir = kp kv (qg - q) - kv dq` within 10 V (Janot, Gautier & Brunot 2019). A controller sees
references and measured positions, never the plant's state. A law file holds its gains:

    position_gain: 160.18        # [1/s]
    velocity_gain: 243.45        # [unit per m/s or rad/s], the unit being the drive's own, here volts
    integral_rate: 0             # [1/s], how fast the velocity loop integrates
    speed_feedforward: 0         # share of the reference speed added to the command
    force_per_unit: 35.150652    # [N or N m per unit]; 1 where the drive's unit is the force
    limit: 10                    # [unit], largest output; by default the robot's effort limits

A number may also be a list in the order of the actuated joints, or a mapping from joint to number. The gains are required.
A file that begins with `law: servo` holds a servo's law instead; see `servo_law`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import isfinite
from pathlib import Path
from typing import Protocol

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate.servo_law import spread_over_joints
from tau_dyn.simulate.trajectory import Trajectory

Feedforward = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Forces (N, na) [N or N m] along positions, speeds and accelerations (N, na), such as a `tau_dyn.control.Feedforward`."""

PerJoint = float | Sequence[float]
"""A number for all joints, or one a joint."""

INERTIA_EVERY_S = 0.01
"""Time after which a law that knows the robot looks the mass matrix up again [s]."""


class Controller(Protocol):
    """Turns a reference and measured positions into forces, sample by sample."""

    def reset(self, reference: Trajectory) -> None:
        """Forget the past and get ready for this reference, which is sampled at the control rate."""
        ...

    def force(
        self, k: int, t: float, q_ref: np.ndarray, v_ref: np.ndarray, a_ref: np.ndarray, q_measured: np.ndarray
    ) -> np.ndarray:
        """Return the forces (na,) [N or N m] of sample k at time t [s], from references and positions (na,)."""
        ...


@dataclass(frozen=True, eq=False)
class ModelInertia:
    """The mass matrix of a model, as a law looks it up."""

    model: Model

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return it (na, na) at positions (na,)."""
        return self.model.mechanism.mass_and_bias(q, np.zeros(len(q)))[0]

    def along(self, q: np.ndarray) -> np.ndarray:
        """Return it (N, na, na) at positions (N, na)."""
        return self.model.mechanism.inertia(q)


@dataclass(frozen=True, eq=False)
class CascadeLaw:
    """Gains of a cascade, one number a joint (na,).

    Attributes:
        position_gain: `kp` [1/s].
        velocity_gain: `kv` [unit per m/s or rad/s], the unit being the drive's own, volts for EMPS; [1/s] with `inertia`.
        integral_rate: How fast the velocity loop integrates [1/s]; 0 for no integral.
        speed_feedforward: Share of the reference speed that is added to the command.
        force_per_unit: Force of one unit of the drive [N or N m per unit]; 1 if the unit is the force.
        limit: Largest output [unit].
        inertia: Gives the mass matrix (na, na) at positions (na,), a factor of the velocity loop; or None.
    """

    position_gain: np.ndarray
    velocity_gain: np.ndarray
    integral_rate: np.ndarray
    speed_feedforward: np.ndarray
    force_per_unit: np.ndarray
    limit: np.ndarray
    inertia: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        """Refuse gains of different lengths or of the wrong sign."""
        n = np.size(self.position_gain)
        for key in (f.name for f in fields(self) if f.name != "inertia"):
            values = np.array(np.atleast_1d(getattr(self, key)), dtype=float)
            if values.shape != (n,) or np.any(np.isnan(values)) or np.any(values < 0):
                raise InputError(
                    "file_format", f"a controller's {key} must be {n} number(s) not below zero, one a joint"
                )
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    @classmethod
    def of(
        cls,
        position_gain: PerJoint,
        velocity_gain: PerJoint,
        *,
        na: int,
        integral_rate: PerJoint = 0.0,
        speed_feedforward: PerJoint = 0.0,
        force_per_unit: PerJoint = 1.0,
        limit: PerJoint = np.inf,
    ) -> CascadeLaw:
        """Build a law for `na` joints; a single number holds for all of them. See the attributes."""
        given = (position_gain, velocity_gain, integral_rate, speed_feedforward, force_per_unit, limit)
        kp, kv, rate, share, unit, most = (np.full(na, x) if np.ndim(x) == 0 else np.asarray(x) for x in given)
        return cls(kp, kv, rate, share, unit, most)

    @classmethod
    def for_model(cls, model: Model, *, velocity_hz: float = 40.0, position_hz: float = 8.0) -> CascadeLaw:
        """Return a law for a robot: loop bandwidths [Hz], multiplied by the mass matrix along the reference.

        The velocity loop also integrates, at a fifth of its bandwidth, and the output stays within the drives' limits.
        """
        na, fast, slow = model.robot.na, 2 * np.pi * velocity_hz, 2 * np.pi * position_hz
        law = cls.of(
            slow, fast, na=na, integral_rate=fast / 5, speed_feedforward=1.0, limit=model.robot.effort_limit.tolist()
        )
        return replace(law, inertia=ModelInertia(model))

    @classmethod
    def emps(cls) -> CascadeLaw:
        """Return the published law of the EMPS drive."""
        return cls.of(160.18, 243.45, na=1, force_per_unit=35.150652, limit=10.0)


@dataclass(frozen=True, eq=False)
class Servo:
    """A cascade and its references as numbers, for compiled code.

    Attributes:
        law: Its gains; `inertia` is looked up in the array of that name.
        period: Its period [s].
        q_ref: Reference positions (N, na); also `v_ref`.
        v_ref: Reference speeds (N, na).
        forward: Output added to the law's (N, na), in the drive's unit.
        before: The two positions read before the start (2, na).
        v_before: The reference speed before the start (na,).
        integral: Integral of the velocity loop at the start (na,), in the drive's unit.
        inertia: Mass matrices (m, na, na), one every `inertia_every` samples, or None.
        inertia_every: Samples for which a mass matrix is kept.
        noise: Added to the encoders' readings (N, na), or None.
        resolution: Step that readings are rounded to (na,), or None; 0 for no rounding.
    """

    law: CascadeLaw
    period: float
    q_ref: np.ndarray
    v_ref: np.ndarray
    forward: np.ndarray
    before: np.ndarray
    v_before: np.ndarray
    integral: np.ndarray
    inertia: np.ndarray | None = None
    inertia_every: int = 1
    noise: np.ndarray | None = None
    resolution: np.ndarray | None = None


class CascadeController:
    """A cascade of a position and a velocity loop for all joints, with optional force feedforward."""

    def __init__(self, law: CascadeLaw, *, start: Model | None = None, feedforward: Feedforward | None = None) -> None:
        """Prepare a controller.

        Args:
            law: Its gains.
            start: A model whose holding force the integral starts with, as drives do when they release their brakes.
            feedforward: Gives forces along the whole reference, which are added.
        """
        self.law, self._start, self._feedforward = law, start, feedforward
        self._forces = np.zeros((0, 0))
        self._integral, self._inertia = np.zeros(0), np.zeros((0, 0))
        self._dt, self._before, self._v_ref = 1.0, (np.zeros(0), np.zeros(0)), np.zeros(0)

    def reset(self, reference: Trajectory) -> None:
        """Forget the past and compute the feedforward along the whole reference."""
        na = len(reference.joints)
        if len(self.law.position_gain) != na:
            raise InputError(
                "mismatch", f"the controller is for {len(self.law.position_gain)} joint(s), {reference.name} moves {na}"
            )
        self._dt = reference.duration / (reference.n_samples - 1)
        self._before = (np.array(reference.q[0]), np.array(reference.q[0]))
        self._v_ref = np.array(reference.v[0])
        self._integral = np.zeros(na)
        self._forces = np.zeros_like(reference.q)
        if self._feedforward is not None:
            self._forces = self._feedforward(reference.q, reference.v, reference.a) / self.law.force_per_unit
        elif self._start is not None:
            rest = np.zeros((1, na))
            self._integral = self._start.torque(reference.q[:1], rest, rest, rest)[0] / self.law.force_per_unit

    def describe(
        self, reference: Trajectory, look_up: Callable[[Model, np.ndarray], np.ndarray | None] | None = None
    ) -> Servo:
        """Return the controller as `reset` left it, with all that it will need along the reference.

        Args:
            reference: The reference.
            look_up: Gives a model's mass matrices (N, na, na) along positions faster than the model itself, or None.
        """
        inertia, every = self.law.inertia, max(1, round(INERTIA_EVERY_S / self._dt))
        matrices, q = None, reference.q[::every]
        if isinstance(inertia, ModelInertia):
            matrices = None if look_up is None else look_up(inertia.model, q)
            matrices = inertia.along(q) if matrices is None else matrices
        elif inertia is not None:
            matrices = np.array([inertia(x) for x in q])
        return Servo(
            self.law, self._dt, reference.q, reference.v, self._forces, np.array(self._before), self._v_ref,
            self._integral, matrices, every,
        )  # fmt: skip

    def force(
        self, k: int, t: float, q_ref: np.ndarray, v_ref: np.ndarray, a_ref: np.ndarray, q_measured: np.ndarray
    ) -> np.ndarray:
        """Return the forces (na,) of sample k; see `Controller.force`."""
        law = self.law
        speed = (q_measured - self._before[0]) * (0.5 / self._dt)
        error = law.position_gain * (q_ref - q_measured) + law.speed_feedforward * self._v_ref - speed
        self._before, self._v_ref = (self._before[1], q_measured), v_ref
        push = law.velocity_gain * error
        if law.inertia is not None:
            if k % max(1, round(INERTIA_EVERY_S / self._dt)) == 0:
                self._inertia = law.inertia(q_ref)
            push = self._inertia @ push
        wanted = push + self._integral + self._forces[k]
        output = np.minimum(np.maximum(wanted, -law.limit), law.limit)
        winding_up = (wanted != output) & (wanted * push > 0)
        self._integral = self._integral + np.where(winding_up, 0.0, law.integral_rate * push * self._dt)
        return law.force_per_unit * output


_DEFAULTS = {
    "position_gain": None,
    "velocity_gain": None,
    "integral_rate": 0.0,
    "speed_feedforward": 0.0,
    "force_per_unit": 1.0,
    "limit": None,
}
_MAY_BE_ZERO = ("integral_rate", "speed_feedforward")


def read_law_file(path: str | Path, robot: Robot) -> CascadeLaw:
    """Return the controller that a file describes, for a robot's actuated joints.

    Raises:
        InputError: The file is missing or not such a file; an entry is unknown, missing, or not a number that can be.
    """
    where, content = str(path), read_yaml(path)
    if not isinstance(content, dict) or not content:
        raise InputError("file_format", f"{where}: a controller file is a mapping with {', '.join(_DEFAULTS)}")
    if content.get("law", "cascade") != "cascade":
        raise InputError("file_format", f"{where}: a cascade is wanted here, not 'law: {content['law']}'")
    for key in content:
        if key not in (*_DEFAULTS, "law"):
            raise UnknownName("controller entry", str(key), _DEFAULTS, where)
    for key in ("position_gain", "velocity_gain"):
        if content.get(key) is None:
            raise InputError(
                "file_format", f"{where}: '{key}' is missing; a controller needs a position gain and a velocity gain"
            )
    given = {**_DEFAULTS, **{key: content[key] for key in _DEFAULTS if content.get(key) is not None}}
    found = {key: _numbers(key, value, robot, where) for key, value in given.items() if value is not None}
    if "limit" not in found:
        found["limit"] = robot.effort_limit / found["force_per_unit"]
    return CascadeLaw(
        found["position_gain"],
        found["velocity_gain"],
        found["integral_rate"],
        found["speed_feedforward"],
        found["force_per_unit"],
        found["limit"],
    )


def _numbers(key: str, value: object, robot: Robot, where: str) -> np.ndarray:
    """Return one number a joint (na,)."""
    return np.array([_number(key, x, where) for x in spread_over_joints(key, value, robot.actuated, where)])


def _number(key: str, value: object, where: str) -> float:
    """Return a number that this entry can be."""
    least = "zero or more" if key in _MAY_BE_ZERO else "above zero"
    wanted = f"{where}: {key} must be a {'' if key == 'limit' else 'finite '}number {least}"
    if isinstance(value, bool) or not isinstance(value, int | float):
        hint = "; YAML reads a number such as 1.0e+5 only with a point and a sign" if isinstance(value, str) else ""
        raise InputError("file_format", f"{wanted}, not {_short(value)}{hint}")
    number = float(value)
    fits = number >= 0 if key in _MAY_BE_ZERO else number > 0
    if not fits or not (isfinite(number) or key == "limit"):
        raise InputError("file_format", f"{wanted}, not {_short(value)}")
    return number


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
