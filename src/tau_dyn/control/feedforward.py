"""Feedforward forces from a model: `tau = f(q, v, a)`, with a sign of velocity that no drive chatters on.

A friction law jumps at zero velocity; a drive fed with that jump shakes. Two smooth laws are offered, both over a width `w`
[m/s or rad/s]. `ramp` joins the law at -w and at +w by a straight line, the piecewise-linear law of Dressler 2012, Figure
3.6; outside the width it is the identified law exactly. `tanh` mixes both directions by `s(v) = tanh(2 v / w)`. Inside the
width friction is under-compensated, never over-compensated, so the feedback does not have to act against it. Friction whose
direction is not its joint's (a motor shared by two joints, a passive bearing) fades in the same way with its own speed.

The force is in the drive's own scale, as logs hold it: a `drive_gain` enters, since a drive that reports
`(1 + gain_error) tau` for the force tau needs that value as its command. (If the logged force comes from a separate force
sensor and the sensor has the gain error, leave the effect out of the model.) Effects that a single state does not determine
are left out and named once, in `warnings`.

With `compiled=True` a single state is computed by compiled code (`compiled_feedforward.py`), where there is a C compiler: the
same force to rounding, in a few microseconds. Arrays of states, and states that the code refuses, are computed in Python.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.effects import Effect, Motion, describe_missing_state
from tau_dyn.exceptions import InputError, UnknownName, require_kind
from tau_dyn.model import BY_STATE, Model
from tau_dyn.parameters import as_numbers

if TYPE_CHECKING:
    from tau_dyn.control.compiled_feedforward import CompiledFeedforward

SHAPES = ("ramp", "tanh")


class Feedforward:
    """Actuator forces of a model for a controller.

    Attributes:
        model: The model.
        width: Speed over which the sign changes, one per joint (na,) [m/s or rad/s].
        shape: 'ramp' or 'tanh'.
        left_out: Effects that a single state does not determine; a call with their input signals includes them.
        compiled: Compiled code for single states, or None.
        warnings: A sentence for each effect that is left out, and one if the code that was asked for cannot be compiled.

    Example:
        >>> feedforward = td.Feedforward(td.Model.of(td.load_robot("linear_axis")))
        >>> feedforward(np.array([0.0]), np.array([0.0]), np.array([1.0]))
        array([95.])
    """

    def __init__(
        self, model: Model, *, width: float | np.ndarray = 0.01, shape: str = "ramp", compiled: bool = False
    ) -> None:
        """Prepare a model for use.

        Args:
            model: The identified model.
            width: Half-width of the transition around zero velocity [m/s or rad/s]: a number or one per joint (na,).
            shape: 'ramp' (piecewise linear) or 'tanh'.
            compiled: Compile the law for single states; takes seconds once, and a library is kept for the next time.

        Raises:
            UnknownName: The shape is neither.
            InputError: The model is no `Model`, or a width is not positive.
        """
        if shape not in SHAPES:
            raise UnknownName("shape of the smoothed sign", shape, SHAPES)
        require_kind(model, Model, "model", "a Model; Feedforward.load takes the path of its file")
        widths = as_numbers(width, "the width of the smoothed sign")
        if widths.shape not in ((), (model.robot.na,)):
            raise InputError(
                "wrong_shape",
                f"the width of the smoothed sign must be a number or ({model.robot.na},), not {widths.shape}",
            )
        widths = np.broadcast_to(widths, (model.robot.na,)).copy()
        if not np.all(np.isfinite(widths) & (widths > 0)):
            raise InputError("invalid_value", f"the width of the smoothed sign must be a positive speed, not {width}")
        self.model: Model = model
        self.width: np.ndarray = widths
        self.shape: str = shape
        why = {effect: describe_missing_state(effect, BY_STATE) for effect in model.effects}
        self.left_out: tuple[Effect, ...] = tuple(effect for effect, reason in why.items() if reason)
        self.warnings: tuple[str, ...] = tuple(f"the feedforward leaves out {e.name}: {why[e]}" for e in self.left_out)
        self._parts = {frozenset(): self._sorted(frozenset())}
        self.compiled: CompiledFeedforward | None = None
        if compiled:
            self._compile()

    def _compile(self) -> None:
        """Compile the law without the effects that are left out, or add a warning with the reason."""
        from tau_dyn.control.compiled_feedforward import CompiledFeedforward

        try:
            self.compiled = CompiledFeedforward.build(self.with_model(self.model.steady()))
        except InputError as fault:
            self.warnings = (*self.warnings, f"the feedforward is not compiled: {fault}")

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling; compiled code is built again where it is loaded."""
        return {**self.__dict__, "compiled": self.compiled is not None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take a pickled state."""
        self.__dict__.update(state)
        self.compiled = None
        if state["compiled"]:
            self._compile()

    def __repr__(self) -> str:
        """Return a line: whose forces."""
        return f"Feedforward of {self.model.robot.name} ({', '.join(self.model.robot.actuated)}), {self.shape}"

    @classmethod
    def load(
        cls, path: str | Path, *, width: float | np.ndarray = 0.01, shape: str = "ramp", compiled: bool = True
    ) -> Feedforward:
        """Load from a model file that `identify` wrote, compiled by default; see `__init__` for the rest."""
        return cls(Model.load(path), width=width, shape=shape, compiled=compiled)

    def with_model(self, model: Model) -> Feedforward:
        """Return the same law, width and shape, of another model."""
        return Feedforward(model, width=self.width, shape=self.shape)

    def __call__(
        self,
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        *,
        signals: Mapping[str, float | np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return actuator forces [N or N m].

        Args:
            q: Actuated positions (na,) or (N, na) [m or rad].
            v: Velocities, the same shape.
            a: Accelerations, the same shape.
            signals: Inputs of some effects that the state does not contain: `temperature` [degC] (after the lag of its
                `thermal_drift`), `campaign`, `reversal` [m or rad]; each a number, (na,), or the shape of `q`.

        Returns:
            Forces in the shape of `q`.

        Raises:
            InputError: Shapes that do not fit the robot, or a position it cannot reach.
        """
        q, v, a = np.asarray(q, float), np.asarray(v, float), np.asarray(a, float)
        if q.shape != v.shape or q.shape != a.shape or q.ndim not in (1, 2) or q.shape[-1] != self.model.robot.na:
            joints = ", ".join(self.model.robot.actuated)
            na = self.model.robot.na
            raise InputError("wrong_shape", f"q, v and a must have one shape, ({na},) or (N, {na}) for {joints}")
        if self.compiled is not None and q.ndim == 1 and not signals:
            force = self.compiled(q, v, a)
            if force is not None:
                return force
        felt = {name: np.atleast_2d(_shaped(name, x, q.shape)) for name, x in (signals or {}).items()}
        return self.forces(np.atleast_2d(q), np.atleast_2d(v), np.atleast_2d(a), felt).reshape(q.shape)

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, felt: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return forces (N, na) at states and signals (N, na) without checks; `__call__` checks them first."""
        by_joint, turning, scaling = self._parts_with(frozenset(felt))
        needs = {name for e in turning.effects for name in e.needs}
        motion = by_joint.motion(q, v, a, signals=felt, needs=needs)
        force = self.model.mechanism.inverse_dynamics(q, v, a) + self._by_joint(by_joint, motion)
        force = force + self._turning(turning, motion)
        if scaling.effects:
            force = force + scaling.effect_force(replace(motion, signals={**motion.signals, "force": force}))
        return force

    def _parts_with(self, given: frozenset[str]) -> tuple[Model, Model, Model]:
        if given not in self._parts:
            self._parts[given] = self._sorted(given)
        return self._parts[given]

    def _sorted(self, given: frozenset[str]) -> tuple[Model, Model, Model]:
        """Return the model with its effects by direction: the joints' own, another, and those that scale the whole force."""
        model = self.model.steady(given)
        scaling = [e for e in model.effects if "force" in e.needs and "force" not in given]
        turning = [e for e in model.effects if e not in scaling and type(e).other_speeds is not Effect.other_speeds]
        by_joint = [e for e in model.effects if e not in scaling and e not in turning]
        return model.only(by_joint), model.only(turning), model.only(scaling)

    def _by_joint(self, model: Model, motion: Motion) -> np.ndarray:
        """Return forces (N, na) with both directions' laws mixed around each joint's standstill."""
        v, sign = motion.v, self.smooth_sign(motion.v)
        if self.shape == "tanh":
            return model.effect_force(replace(motion, sign=sign))
        slow, ones = np.abs(v) < self.width, np.ones_like(v)
        ahead = replace(motion, v=np.where(slow, self.width, v), sign=np.where(slow, ones, sign))
        back = replace(motion, v=np.where(slow, -self.width, v), sign=np.where(slow, -ones, sign))
        return (1 + sign) / 2 * model.effect_force(ahead) + (1 - sign) / 2 * model.effect_force(back)

    def _turning(self, model: Model, motion: Motion) -> np.ndarray:
        """Return forces (N, na) whose dry part fades with the slowest of the speeds that give it its direction.

        The dry part stays constant if all speeds double: `2 F(v) - F(2 v) - F(0)`; the rest of the law is linear.
        """
        force = np.zeros_like(motion.v)
        for effect in model.effects:
            one = model.only([effect])
            still, plain, fast = (
                one.effect_force(replace(motion, v=k * motion.v, sign=np.sign(motion.v))) for k in (0, 1, 2)
            )
            shares = [speed / np.hypot.reduce(self.width[index]) for speed, index in effect.other_speeds(motion)]
            fade = np.min(np.abs(self._smooth(np.stack(shares))), axis=0)[:, None] if shares else 1.0
            force = force + plain - (1 - fade) * (2 * plain - fast - still)
        return force

    def smooth_sign(self, v: np.ndarray) -> np.ndarray:
        """Return the smoothed direction of motion (N, na), in [-1, 1]."""
        return self._smooth(np.asanyarray(v) / self.width)

    def _smooth(self, share: np.ndarray) -> np.ndarray:
        """Return the smoothed sign of speeds in widths."""
        return np.clip(share, -1, 1) if self.shape == "ramp" else np.tanh(2 * share)


def _shaped(name: str, value: float | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a signal in the shape of the positions."""
    try:
        return np.broadcast_to(np.asarray(value, float), shape)
    except ValueError as fault:
        raise InputError(
            "wrong_shape", f"signal {name} must be a number, one a joint, or of the positions' shape {shape}"
        ) from fault
