"""Feedforward forces from a model: `tau = f(q, v, a)`, with a sign of velocity that no drive chatters on.

A friction law jumps at zero velocity; a drive fed with that jump shakes. Two smooth laws are offered, both over a width `w`
[m/s or rad/s]. `ramp` joins the law at -w and at +w by a straight line, the piecewise-linear law of Dressler 2012, Figure
3.6; outside the width it is the identified law exactly. `tanh` mixes both directions by `s(v) = tanh(2 v / w)`. Inside the
width friction is under-compensated, never over-compensated, so the feedback is not asked to fight it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tau_dyn.effects import Motion
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.model import Model

SHAPES = ("ramp", "tanh")


class Feedforward:
    """Actuator forces of a model for a controller.

    Attributes:
        model: The model.
        width: Speed over which the sign changes, one a joint (na,) [m/s or rad/s].
        shape: 'ramp' or 'tanh'.
    """

    def __init__(self, model: Model, *, width: float | np.ndarray = 0.01, shape: str = "ramp") -> None:
        """Prepare a model for use.

        Args:
            model: The identified model.
            width: Half-width of the transition around zero velocity [m/s or rad/s]: a number or one a joint (na,).
            shape: 'ramp' (piecewise linear) or 'tanh'.

        Raises:
            UnknownName: The shape is neither.
            InputError: A width that is not positive.
        """
        if shape not in SHAPES:
            raise UnknownName("shape of the smoothed sign", shape, SHAPES)
        widths = np.asarray(width, float)
        if widths.shape not in ((), (model.robot.na,)):
            raise InputError(
                f"the width of the smoothed sign must be a number or ({model.robot.na},), not {widths.shape}"
            )
        widths = np.broadcast_to(widths, (model.robot.na,)).copy()
        if not np.all(np.isfinite(widths) & (widths > 0)):
            raise InputError(f"the width of the smoothed sign must be a positive speed, not {width}")
        self.model, self.width, self.shape = model, widths, shape

    @classmethod
    def load(cls, path: str | Path, *, width: float | np.ndarray = 0.01, shape: str = "ramp") -> Feedforward:
        """Load from a model file that `identify` wrote; see `__init__` for the rest."""
        return cls(Model.load(path), width=width, shape=shape)

    def __call__(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuator forces [N or N m].

        Args:
            q: Actuated positions (na,) or (N, na) [m or rad].
            v: Velocities, the same shape.
            a: Accelerations, the same shape.

        Returns:
            Forces in the shape of `q`.

        Raises:
            InputError: Shapes that do not fit the robot, or a position it cannot reach.
        """
        q, v, a = (np.asarray(x, float) for x in (q, v, a))
        if q.shape != v.shape or q.shape != a.shape or q.ndim not in (1, 2) or q.shape[-1] != self.model.robot.na:
            joints = ", ".join(self.model.robot.actuated)
            na = self.model.robot.na
            raise InputError(f"q, v and a must have one shape, ({na},) or (N, {na}) for {joints}")
        many = [np.atleast_2d(x) for x in (q, v, a)]
        rigid = self.model.mechanism.inverse_dynamics(*many)
        return (rigid + self._friction(*many)).reshape(q.shape)

    def _friction(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the effects' forces (N, na) with both directions' laws mixed around standstill."""
        sign, joints = self.smooth_sign(v), self.model.robot.actuated
        if self.shape == "tanh":
            return self.model.effect_force(Motion.of(joints, q, v, a, sign))
        slow, ones = np.abs(v) < self.width, np.ones_like(v)
        ahead = Motion.of(joints, q, np.where(slow, self.width, v), a, np.where(slow, ones, sign))
        back = Motion.of(joints, q, np.where(slow, -self.width, v), a, np.where(slow, -ones, sign))
        return (1 + sign) / 2 * self.model.effect_force(ahead) + (1 - sign) / 2 * self.model.effect_force(back)

    def smooth_sign(self, v: np.ndarray) -> np.ndarray:
        """Return the smoothed direction of motion (N, na), in [-1, 1]."""
        share = np.asarray(v, float) / self.width
        return np.clip(share, -1, 1) if self.shape == "ramp" else np.tanh(2 * share)
