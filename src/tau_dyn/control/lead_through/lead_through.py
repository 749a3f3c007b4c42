r"""The lead-through controller of Dressler 2012, chapter 8: two force sensors in, one tool velocity out.

    V = P_h(V_h, c) + P_t(V_t, c),   V_h from the handle's impedance,   V_t = K (F - F_ref),   F_ref = press n.

Signs: both wrenches are forces on the robot, as its sensors read them, the hand's and the work's; n points from the work to
the tool. The thesis prints `V_t = K (F_ref - F_t)` (8.4) with `F_ref = 2 n` and n along F_t: that presses for K > 0 only if
F_t is the force of the tool on the work and n points into the work; taken as a force on the tool, the tool would flee a weak
contact and dive into a hard one. With F = -F_t it is the same law.

The handle's impedance is a mass and a damper without a spring, Dressler 2012, (8.5)-(8.7):

    A = M^-1 (F_h - D V),   V_h(k + 1) = P_h V_h(k) + T A(k).

The second equation is (8.7) multiplied out: its correction `(V_h - P_h V_h) / T` inside the sum resets the integrator to the
applied velocity in every sample. So it cannot wind up at a velocity limit or a projection: when the contact ends, a component
that P_h removed starts with one sample of acceleration, `T A`. (As printed, (8.5) combines the index k + 1 with
`T / (q - 1)`, which would add one sample of delay; the sum up to and including sample k is meant.) D acts on the velocity
that was applied, the force controller's share included, as in (8.6).

The impedance is passive: along one axis, with a = 1 - T D / M, the response from the hand's force F(k) to the next velocity
V(k + 1) is `(T / M) z / (z - a)`. Its real part has the sign of `1 - a cos(w T)`: above zero at every frequency while
`|a| < 1`, so no motion of the hand draws energy from the robot. With the additional sample of the printed index it would have
the sign of `cos(w T) - a`, below zero over most frequencies. `settings.py` refuses M that is not positive definite, D with a
negative part, and T M^-1 D of 1 or more. A projection and a velocity limit take energy away.

The projections P_h and P_t of Dressler 2012, (8.3), (8.8)-(8.11), select the part of each velocity reference for the robot.
Twists are (6,), linear first. The two linear parts are complementary: with contact, P_h keeps the component orthogonal to the
normal n, `(I - n n') v`, and P_t the component along it, `n n' v`; every direction is driven by exactly one sensor. Both are
orthogonal projections, so neither can add energy: `|P v| <= |v|`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from tau_dyn.codegen import LeadThroughNumbers
from tau_dyn.control.lead_through.sensing import (
    COHERENT,
    SLOW_M_S,
    STIFFNESS_SAMPLES,
    WEAK_N,
    ContactState,
    NormalEstimator,
    StiffnessWatch,
)
from tau_dyn.control.lead_through.settings import LeadThroughSettings
from tau_dyn.exceptions import InputError


class HandleImpedance:
    """Integrates (8.6) and (8.7)."""

    def __init__(self, mass: np.ndarray, damping: np.ndarray, sample_time: float) -> None:
        """Keep mass (6, 6) [kg, kg m^2] and damping (6, 6) [N s/m, N m s/rad], and start at rest."""
        self._inverse = np.linalg.inv(mass)
        self._damping, self._time = damping, sample_time
        self.held = np.zeros(6)

    def step(self, wrench: np.ndarray, applied: np.ndarray) -> np.ndarray:
        """Return the velocity (6,) requested by the handle.

        Args:
            wrench: The hand's force and torque on the handle (6,), world axes at the tool point.
            applied: The velocity applied to the robot over the last sample (6,).
        """
        return self.held + self._time * (self._inverse @ (wrench - self._damping @ applied))

    def hold(self, projected: np.ndarray) -> None:
        """Store the part of the velocity that was really applied (6,): the anti-windup of (8.7)."""
        self.held = projected


def handle_part(twist: np.ndarray, normal: np.ndarray, contact: bool) -> np.ndarray:
    """Return P_h (8.8): the handle moves the tool but never turns it; with contact, only along the surface.

    Args:
        twist: Velocity requested by the handle (6,) [m/s, rad/s].
        normal: Unit surface normal (3,).
        contact: Whether the tool touches the work.
    """
    out = np.zeros(6)
    out[:3] = twist[:3] - (normal @ twist[:3]) * normal if contact else twist[:3]
    return out


def compute_tool_part(
    twist: np.ndarray, normal: np.ndarray, contact: bool, turns: bool, locked_axis: np.ndarray | None = None
) -> np.ndarray:
    """Return P_t: the force along the normal (8.9) and, if the tool may turn, all torques (8.11); zero without contact.

    Args:
        twist: Velocity requested by the tool's force (6,) [m/s, rad/s].
        normal: Unit surface normal (3,).
        contact: Whether the tool touches the work.
        turns: False for (8.9), True for (8.11).
        locked_axis: Unit axis (3,) about which the tool must not turn; a round peg leaves its own axis to noise.
    """
    out = np.zeros(6)
    if not contact:
        return out
    out[:3] = (normal @ twist[:3]) * normal
    if turns:
        out[3:] = twist[3:]
        if locked_axis is not None:
            out[3:] -= (locked_axis @ out[3:]) * locked_axis
    return out


def limit_twist(twist: np.ndarray, speed: float, turning: float) -> float:
    """Return the share, up to 1, of a twist (6,) that is within a speed [m/s] and a rate of turning [rad/s]."""
    over = np.linalg.norm(twist[:3]) / speed, np.linalg.norm(twist[3:]) / turning
    return 1.0 / max(1.0, *map(float, over))


_LATE = 0.25  # of a sample time that a reading may be early or late
_CALM = 0.4  # of the stability limit: the gain is lowered to it if the contact is stiffer than stated


class ToolPose(Protocol):
    """Pose of the tool: any object with a position and a rotation."""

    @property
    def position(self) -> np.ndarray:
        """(3,) [m]."""
        ...

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3)."""
        ...


class LeadThrough:
    """Turns two wrenches and a pose into a tool velocity, once a sample.

    Attributes:
        settings: Settings of the controller.
        in_contact: The contact state c after the last call.
        normal: The normal after the last call (3,), world axes.
        velocity: The last command (6,).
        stiffness: Estimated stiffness of the contact along the normal [N/m]; 0 while unknown.
        tool_force: The work's force and torque on the tool after the last call (6,), world axes, filtered.
    """

    def __init__(self, settings: LeadThroughSettings) -> None:
        """Start at rest, without contact."""
        self.settings = settings
        self.reset()

    @property
    def sample_time(self) -> float:
        """Time between calls [s]."""
        return self.settings.loop.sample_time

    def reset(self) -> None:
        """Forget everything measured."""
        s = self.settings
        self._handle = HandleImpedance(s.inertia, s.drag, self.sample_time)
        self._normal_smoothing = float(-np.expm1(-2 * np.pi * (s.normal_hz or np.inf) * self.sample_time))
        calm = s.normal_hz is not None
        self._normals = NormalEstimator(s.normal, s.correction_range, self._normal_smoothing, calm, s.contact_on)
        self._wait = max(1, round(s.contact_wait / self.sample_time))
        self._contact = ContactState(1.0, s.contact_off / s.contact_on, s.release_force, self._wait)
        self._watch = StiffnessWatch(s.contact_on, self.sample_time)
        self._bearable = _CALM * s.loop.limit(1.0).gain  # gain times stiffness
        self._gain = float(s.normal @ s.gain[:3, :3] @ s.normal)
        self.in_contact, self.normal = False, s.normal
        self.velocity, self.tool_force = np.zeros(6), np.zeros(6)
        self._last: float | None = None

    def __call__(
        self, handle_wrench: np.ndarray, tool_wrench: np.ndarray, pose: ToolPose, time: float | None = None
    ) -> np.ndarray:
        """Return the tool velocity to command until the next call (6,), linear first, world axes at the tool point.

        Args:
            handle_wrench: Reading of the handle's sensor (6,) [N, N m], force and torque on the handle.
            tool_wrench: Reading of the tool's sensor (6,), force and torque on the tool.
            pose: The tool's pose, with `position` (3,) and `rotation` (3, 3).
            time: When the readings were taken [s]; given, a gap that is not the sample time is refused.

        Raises:
            InputError: A reading is not finite, or the sample time differs from the settings.
        """
        rotation = np.asarray(pose.rotation, float)
        if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
            raise InputError("wrong_shape", "the pose's rotation must be a 3 x 3 matrix of finite numbers")
        self._check_time(time)
        hand = self.settings.handle_sensor.at_tool(_sound("handle", handle_wrench), rotation)
        work = self.settings.tool_sensor.at_tool(_sound("tool", tool_wrench), rotation)
        self.tool_force = self.tool_force + self.settings.loop.smoothing * (work - self.tool_force)
        self._look(hand, work, np.asarray(pose.position, float))
        self.velocity = self._command(hand, rotation)
        return self.velocity.copy()

    @property
    def stiffness(self) -> float:
        """See the class."""
        return self._watch.stiffness

    def list_numbers(self) -> LeadThroughNumbers:
        """Return the controller's constants, from which `codegen.write_lead_through_source` writes C."""
        s, loop = self.settings, self.settings.loop
        values = {
            "SAMPLE_TIME": loop.sample_time, "SMOOTHING": loop.smoothing, "PRESS": s.press, "REACH": s.correction_range,
            "NORMAL_SMOOTHING": self._normal_smoothing, "CONTACT_ON": s.contact_on, "CONTACT_OFF": s.contact_off,
            "TORQUE_ON": s.torque_on, "END_LOAD": s.contact_off / s.contact_on, "RELEASE_FORCE": s.release_force,
            "WAIT": self._wait, "SPEED_LIMIT": s.speed_limit, "TURNING_LIMIT": s.turning_limit,
            "FORCE_LIMIT": s.force_limit, "BEARABLE": self._bearable, "GAIN_ALONG": self._gain,
            "FADE": self._watch.fade, "SAMPLES": STIFFNESS_SAMPLES, "COHERENT": COHERENT, "SLOW": SLOW_M_S, "WEAK": WEAK_N,
        }  # fmt: skip
        switches = {
            "TURNS": s.turns, "TOOL_FORCE": s.tool_force, "WATCH": s.watch, "CALM": s.normal_hz is not None,
            "LOCKED": s.locked_axis is not None,
        }  # fmt: skip
        locked = np.zeros(3) if s.locked_axis is None else s.locked_axis
        sensors = (s.handle_sensor.to_numbers(), s.tool_sensor.to_numbers())
        return LeadThroughNumbers(
            np.linalg.inv(s.inertia), s.drag, s.gain, s.normal, locked, *sensors, switches, values
        )

    def _look(self, hand: np.ndarray, raw: np.ndarray, place: np.ndarray) -> None:
        """Update contact state, stiffness and normal."""
        s, work = self.settings, self.tool_force
        if not s.tool_force:
            return
        size = abs(float(s.normal @ work[:3])) if s.turns else float(np.linalg.norm(work[:3]))
        load = size / s.contact_on
        if s.turns:
            load = max(load, float(np.linalg.norm(work[3:])) / s.torque_on)
        self.in_contact = self._contact.update(load, float(self.normal @ hand[:3]))
        along = float(s.normal @ raw[:3])
        if along > s.contact_off:
            self._watch.update(along, -float(s.normal @ place))
        else:
            self._watch.reset()
        if self.in_contact:
            self.normal = self._normals.update(work[:3], self.velocity[:3])
        else:
            self._normals.reset()
            self.normal = s.normal

    def _command(self, hand: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Return (8.3) within all limits, and pass the applied velocity to the impedance (8.7)."""
        s, n = self.settings, self.normal
        target = np.concatenate([s.press * n, np.zeros(3)])
        locked = None if s.locked_axis is None else rotation @ s.locked_axis
        by_hand = handle_part(self._handle.step(hand, self.velocity), n, self.in_contact)
        wish = s.gain @ (self.tool_force - target)
        wish[:3] *= self._borne()
        by_force = compute_tool_part(wish, n, self.in_contact, s.turns, locked)
        by_hand = self._relieved(by_hand)
        share = limit_twist(by_hand + by_force, s.speed_limit, s.turning_limit)
        self._handle.hold(share * by_hand)
        return share * (by_hand + by_force)

    def _borne(self) -> float:
        """Return the share of the gain that is stable in the contact."""
        product = self._gain * self.stiffness
        return min(1.0, self._bearable / product) if self.settings.watch and product > 0 else 1.0

    def _relieved(self, twist: np.ndarray) -> np.ndarray:
        """Return the hand's twist; above the force limit without its pressing component and with a retreat."""
        force = self.tool_force[:3]
        size = float(np.linalg.norm(force))
        if size < self.settings.force_limit or not self.settings.tool_force:
            return twist
        away = force / size
        out = twist.copy()
        retreat = float(away @ self.settings.gain[:3, :3] @ away) * (size - self.settings.force_limit)
        out[:3] += (max(0.0, -float(away @ twist[:3])) + retreat) * away
        return out

    def _check_time(self, time: float | None) -> None:
        if time is None:
            return
        gap = None if self._last is None else time - self._last
        if not np.isfinite(time) or (gap is not None and abs(gap - self.sample_time) > _LATE * self.sample_time):
            raise InputError(
                "mismatch",
                f"readings came {'at no time' if gap is None else f'{gap * 1e3:.4g} ms'} after the last ones, but the settings' "
                f"loop is for {self.sample_time * 1e3:g} ms; its stability limits hold for that alone",
            )
        self._last = time


def _sound(which: str, wrench: np.ndarray) -> np.ndarray:
    wrench = np.asarray(wrench, float)
    if wrench.shape != (6,) or not np.isfinite(wrench).all():
        raise InputError(
            "bad_sample", f"the {which} wrench must be six finite numbers, force then torque; the sensor gave {wrench}"
        )
    return wrench
