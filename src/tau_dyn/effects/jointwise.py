"""Effects with separate columns for each joint, and effects between an encoder and its load, which change the reading.

    deflection = encoder - load = displacement @ parameters,     q_load = q - deflection

A positive deflection: the load lags behind, as on a spring under a positive force. In the force channel the load moves by
`a - deflection''`, `v - deflection'` and its weight acts at `q_load`, so the actuator adds
`tau = -M(q) deflection'' - D deflection' - dg/dq deflection` with `D` the growth of friction with speed; in the tool channel the
tool is at `T(q_load) = T(q) - J deflection`. Both are first order in a deflection of micrometres; the change of `M` over it is
neglected. The second derivative is numerical, on a motion's even clock: without one (a single simulator step, static poses) there
is no force. The simulator adds errors of the encoder's reading to the recorded position.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import Effect, format_amount, format_percent, format_quantity, spell_unit
from tau_dyn.effects.motion import JointMotion, Motion, Scene
from tau_dyn.parameters import Parameter, Parameters


class JointParameters(Effect):
    """An effect with the same parameters, and the same description, for each of its joints."""

    quantities: ClassVar[tuple[tuple[str, str], ...]]
    """Name and unit, with F for the force unit, V for the speed unit and Q for the position's."""
    sentence: ClassVar[str] = ""
    """Description for a joint, with its quantities in braces, shares in per cent; empty for their names and amounts."""

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """Its quantities and their units; a subclass whose settings determine their number overrides this property."""
        return self.quantities

    @property
    def parameters(self) -> Parameters:
        """Its parameters, joint by joint, at zero."""
        rows = []
        for joint in self.joints:
            for term, unit in self.terms:
                text = spell_unit(unit, self.units[joint])
                name = f"{joint}.{term}{self.label}"
                rows.append(Parameter(name, 0.0, text, self.lower(term), origin=self.name))
        return Parameters(rows)

    def lower(self, quantity: str) -> float:
        """Return the smallest admissible value; zero if only amplitudes from zero up are meaningful."""
        return 0.0 if self.nonnegative else -np.inf

    def describe(self, parameters: Parameters) -> str:
        """Return the effect at these values in words, joint by joint if there are several."""
        said = []
        for joint in self.joints:
            values = {name: parameters[f"{joint}.{name}{self.label}"] for name, _ in self.terms}
            said.append(self.words(joint, values) + (f" at {joint}" if len(self.joints) > 1 else ""))
        return "; ".join(said)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return the text of `describe` for one joint, whose parameters are given by quantity."""
        if not self.sentence:
            return " and ".join(f"{name.replace('_', ' ')} of {format_amount(p)}" for name, p in values.items())
        said = {name: format_percent(p) if p.unit == "1" else format_amount(p) for name, p in values.items()}
        return self.sentence.format(**said)

    def setting(self, key: str, joint: str) -> str:
        """Return a setting in words, such as `20.9 mm`."""
        return format_quantity(self.settings[key], spell_unit(self.setting_units.get(key, ""), self.units[joint]))


class JointwiseEffect(JointParameters):
    """An effect that acts on each of its joints by that joint's own motion.

    A subclass defines its quantities and their force per unit parameter; this class arranges the columns joint by joint.
    """

    @abstractmethod
    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force per unit of each quantity (N,), for one joint's motion."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        n, (N, na) = len(self.terms), motion.v.shape
        out = np.zeros_like(motion.v, shape=(na, n * len(self.joints), N))  # samples last, for fast filters
        for k, index in enumerate(self._indices(motion)):
            for m, column in enumerate(self.per_joint(JointMotion.of(motion, index))):
                out[index, n * k + m] = column
        return out.transpose(2, 0, 1)


_MIN_SAMPLES = 5  # samples of a fourth-order derivative


class DisplacementEffect(Effect):
    """An effect given as the encoder's reading minus the load's position, linear in its parameters."""

    needs = ("inertia", "damping", "weight_gradient")

    @abstractmethod
    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad] along a motion."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p); zero without a clock."""
        made = self.displacement(motion)
        N, na, p = made.shape
        force = np.zeros((na, p, N))  # samples last, for fast sums and filters
        speeds = [differentiate_columns(made[:, k], motion.t) for k in self._indices(motion)]
        if any(speed.any() for speed in speeds):
            for k, speed in zip(self._indices(motion), speeds, strict=True):
                subtract_load_force(force, motion, k, made[:, k], speed, differentiate_columns(speed, motion.t))
        return force.transpose(2, 0, 1)

    def tool_columns(self, motion: Motion, tool_jacobian: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per unit parameter (N, 3, p) [m], in base axes.

        Args:
            motion: Motion of the encoders.
            tool_jacobian: Tool velocity per actuated speed (N, 3, na).
        """
        made, jacobian = self.displacement(motion).transpose(1, 2, 0), tool_jacobian.transpose(1, 2, 0)
        out = np.zeros((3, made.shape[1], made.shape[2]))  # samples last: products along them are long
        for k in self._indices(motion):  # the others are zero
            out -= jacobian[:, k, None] * made[k]
        return out.transpose(2, 0, 1)


def subtract_load_force(
    force: np.ndarray, motion: Motion, k: int, displacement: np.ndarray, speed: np.ndarray, acceleration: np.ndarray
) -> None:
    """Subtract from forces (na, p, N) those for the displacement, speed and acceleration (N, p) of the load of joint `k`."""
    inertia, gradient, damping = (motion.signal(name) for name in ("inertia", "weight_gradient", "damping"))
    made, moved = np.ascontiguousarray(displacement.T), np.ascontiguousarray(acceleration.T)
    force[k] -= damping[:, k] * speed.T
    for i, row in enumerate(force):
        row -= inertia[:, i, k] * moved + gradient[:, i, k] * made


def differentiate_columns(x: np.ndarray, t: np.ndarray | None) -> np.ndarray:
    """Return the time derivative of (N, ...) on an even clock (N,) [s], by the same rule as for positions.

    Zero without a clock or for too few samples.
    """
    if t is None or len(t) < _MIN_SAMPLES or not np.any(x):
        return np.zeros(x.shape)
    from tau_dyn.log import differentiate

    return differentiate(x, float(t[-1] - t[0]) / (len(t) - 1), accuracy=4)


SEEN_DIRECTLY = frozenset({"tool", "load_side"})
"""Signals that measure the load's position: a measured tool, an encoder behind the drive."""


class JointwiseDisplacement(DisplacementEffect, JointwiseEffect):
    """An encoder's reading minus the load's position, joint by joint; `per_joint` is a displacement [m or rad].

    Attributes:
        hidden: The reason why forces alone cannot show it; empty if they can.
    """

    hidden: ClassVar[str] = ""

    @property
    def measured(self) -> bool:
        """The encoder's reading is off, and not the robot."""
        return True

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad]."""
        return JointwiseEffect.columns(self, motion)

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the signals that the logs lack; if the load is measured directly, it need not explain forces."""
        direct = bool(SEEN_DIRECTLY & scene.signals)
        if cls.hidden and not direct:
            return cls.hidden, cls.reveals
        missing = [s for s in cls.needs if s not in scene.signals and not (direct and s in DisplacementEffect.needs)]
        return (f"the logs give no {missing[0]}", cls.reveals) if missing else None
