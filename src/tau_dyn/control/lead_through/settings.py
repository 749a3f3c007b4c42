"""Settings of a lead-through controller, checked before any motion."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from tau_dyn.control.lead_through.sensing import ForceSensor
from tau_dyn.control.lead_through.stability import ForceLoop
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.message_codes import CodedWarning

_POSITIVE = {"contact_on", "contact_off", "torque_on", "release_force", "speed_limit", "turning_limit", "force_limit"}
_POSITIVE |= {"contact_stiffness", "hand_stiffness", "turning_stiffness", "normal_hz"}
_NOT_NEGATIVE = {"press", "contact_wait", "contact_damping", "correction_range"}


def expand_matrix(name: str, value: float | np.ndarray) -> np.ndarray:
    """Return a 6 x 6 matrix from a number, three or six diagonal entries, or the matrix itself.

    Raises:
        InputError: Another shape, nan, or a matrix that makes its part of the loop active: M must be symmetric and positive
            definite, D must have no negative part, K must be symmetric without negative eigenvalues.
    """
    given = np.asarray(value, float)
    if given.shape not in ((), (1,), (3,), (6,), (6, 6)):
        raise InputError(
            "wrong_shape", f"{name} must be a number, 3 or 6 of them or a 6 x 6 matrix, not of shape {given.shape}"
        )
    if not np.isfinite(given).all():
        raise InputError("invalid_value", f"{name} holds nan or inf; every entry must be a finite number")
    if given.ndim < 2:
        given = np.diag(np.concatenate([given, given]) if given.shape == (3,) else np.broadcast_to(given, 6))
    least = _least(given)
    if name == "mass" and not (least > 0 and np.allclose(given, given.T)):
        raise InputError(
            "invalid_value", f"mass must be symmetric and positive definite; its least eigenvalue is {least:.3g}"
        )
    if name == "damping" and least < 0:
        raise InputError(
            "invalid_value", f"damping has a negative part ({least:.3g}): the handle would push the hand and run away"
        )
    if name == "force_gain" and (least < 0 or not np.allclose(given, given.T)):
        raise InputError(
            "invalid_value",
            f"force_gain must be symmetric and not negative ({least:.3g}): the tool would press ever harder",
        )
    given = given.copy()
    given.setflags(write=False)
    return given


def normalise_axis(name: str, value: np.ndarray) -> np.ndarray:
    """Return a unit vector (3,); raises `InputError` for anything without a direction."""
    given = np.asarray(value, float)
    if given.shape != (3,) or not np.isfinite(given).all() or np.linalg.norm(given) < 1e-9:
        raise InputError("invalid_value", f"{name} must be three finite numbers with a direction, not {value}")
    return given / np.linalg.norm(given)


def require_valid_scalar(name: str, value: object) -> None:
    """Refuse a scalar setting that is no number, or on the wrong side of zero."""
    if name not in _POSITIVE | _NOT_NEGATIVE or value is None:
        return
    number = float(np.asarray(value, float)) if np.ndim(np.asarray(value, float)) == 0 else np.nan
    if not np.isfinite(number):
        raise InputError("invalid_value", f"{name} must be a finite number, not {value}")
    if number < 0 or (name in _POSITIVE and number == 0):
        raise InputError(
            "invalid_value", f"{name} must {'be above' if name in _POSITIVE else 'not be below'} zero, not {number:g}"
        )


def refuse_unstable(s: LeadThroughSettings) -> None:
    """Refuse gains that oscillate in the stated contact, turn the tool unstably, or shake a stated hand.

    Raises:
        InputError: Names the gain, its limit and the frequency at which it would oscillate.
    """
    gain, mass, damping = (np.asarray(m) for m in (s.force_gain, s.mass, s.damping))
    most = float(np.linalg.eigvalsh(gain[:3, :3])[-1])
    _below("force_gain", most, s, s.contact_stiffness, s.contact_damping, "m/s per N", "N/m")
    if s.turns:
        if s.turning_stiffness is None:
            raise InputError(
                "invalid_value",
                "task 'peg' turns the tool: turning_stiffness [N m/rad], the stiffest to expect, is needed",
            )
        most = float(np.linalg.eigvalsh(gain[3:, 3:])[-1])
        _below("force_gain against turning", most, s, s.turning_stiffness, 0.0, "rad/s per N m", "N m/rad")
    decay = s.loop.sample_time * np.abs(np.linalg.eigvals(np.linalg.solve(mass, damping))).max()
    if decay >= 1:
        raise InputError(
            "unstable",
            f"damping / mass is too fast for the sampling: T D / M is {decay:.3g} and must be below 1; "
            f"take a heavier handle, less damping or a shorter sample than {s.loop.sample_time:g} s",
        )
    light, least = float(np.linalg.eigvalsh(mass[:3, :3])[0]), _least(damping[:3, :3])
    limit = s.loop.hand_limit(light, least)
    if s.hand_stiffness >= limit.gain:
        raise InputError(
            "unstable",
            f"a hand of {s.hand_stiffness:g} N/m on a handle of {light:g} kg and {least:g} N s/m oscillates "
            f"at {limit.hz:.1f} Hz; this handle allows {limit.gain:.3g} N/m: more mass or damping is needed",
        )


def _below(what: str, gain: float, s: LeadThroughSettings, stiffness: float, c: float, unit: str, of: str) -> None:
    limit = s.loop.limit(stiffness, c)
    if gain >= limit.gain:
        raise InputError(
            "unstable",
            f"{what} is {gain:.4g} {unit}, but at the stated contact stiffness of {stiffness:g} {of} the loop with a servo of "
            f"{s.loop.servo_hz:g} Hz and {s.loop.delay} sample(s) of delay at {s.loop.sample_time * 1e3:g} ms oscillates "
            f"at {limit.hz:.0f} Hz from {limit.gain:.4g} on; take at most half of that",
        )


def _least(matrix: np.ndarray) -> float:
    """Return the least eigenvalue of a matrix' symmetric part."""
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


TASKS = ("surface", "peg")


@dataclass(frozen=True, eq=False)
class LeadThroughSettings:
    """Gains, limits and properties of the contact; Dressler 2012, 8.3. World axes at the tool point throughout.

    For a peg choose the tool point at its root: a side force at the tip then turns the peg along the wall. With the tool point
    at the tip the force would have no lever, and the peg would stay pressed.

    Diagonals may be given as a number, three or six of them; they are kept as 6 x 6 matrices, linear first.

    Attributes:
        mass: M of the handle (8.6) [kg, kg m^2].
        damping: D of the handle [N s/m, N m s/rad].
        force_gain: K of the tool force (8.4) [m/s per N, rad/s per N m].
        tool_force: False leads by the handle alone, as with one sensor, for comparison; the force limit then has no effect.
        task: 'surface' keeps a force along the normal (8.9); 'peg' lets the torques turn the tool too (8.11).
        press: Force along the normal in contact [N]; the thesis uses 2 for a surface and 0 for a peg.
        normal: Nominal unit normal, from the work to the tool (3,).
        correction_range: How far the normal may be corrected [rad].
        normal_hz: Corner of the filter on the force that gives the normal [Hz]; None takes (8.10) as printed.
        contact_on: Force at which contact begins [N].
        contact_off: Force below which it ends [N].
        torque_on: Torque that counts as `contact_on` if the tool may turn [N m].
        contact_wait: Time below `contact_off` before contact ends [s].
        release_force: Pull of the hand along the normal that ends contact [N].
        speed_limit: Largest speed of the tool [m/s].
        turning_limit: Largest rate of turning [rad/s].
        force_limit: Force on the tool above which no command presses further and the tool gives way [N].
        contact_stiffness: The stiffest contact to expect, tool, sensor and work in series [N/m].
        contact_damping: Its damping [N s/m].
        watch: Whether the gain is lowered if the contact is too stiff for it (`sensing.py`).
        turning_stiffness: Largest stiffness against turning about the tool point [N m/rad]; needed if the tool may turn.
        hand_stiffness: The stiffest hand to expect [N/m].
        locked_axis: Axis in the tool's frame (3,) about which the tool must not turn, or None.
        loop: Sampling, servo and delay between a force and the motion that it causes.
        handle_sensor: Mounting of the handle's sensor.
        tool_sensor: Mounting of the tool's sensor.
    """

    contact_stiffness: float
    mass: float | np.ndarray = 3.0
    damping: float | np.ndarray = 40.0
    force_gain: float | np.ndarray = 0.002
    tool_force: bool = True
    task: str = "surface"
    press: float = 2.0
    normal: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    correction_range: float = np.radians(10.0)
    normal_hz: float | None = 2.0
    contact_on: float = 0.5
    contact_off: float = 0.2
    torque_on: float = 0.02
    contact_wait: float = 0.2
    release_force: float = 6.0
    speed_limit: float = 0.1
    turning_limit: float = 0.3
    force_limit: float = 10.0
    contact_damping: float = 0.0
    watch: bool = True
    turning_stiffness: float | None = None
    hand_stiffness: float = 1000.0
    locked_axis: np.ndarray | None = None
    loop: ForceLoop = field(default_factory=ForceLoop)
    handle_sensor: ForceSensor = field(default_factory=ForceSensor)
    tool_sensor: ForceSensor = field(default_factory=ForceSensor)

    def __post_init__(self) -> None:
        """Check all settings.

        Raises:
            InputError: A value is out of range or a loop would be unstable; the sentence names it with the reason.
        """
        if self.task not in TASKS:
            raise UnknownName("task of lead-through", self.task, TASKS)
        for name in ("mass", "damping", "force_gain"):
            object.__setattr__(self, name, expand_matrix(name, getattr(self, name)))
        for name in (f.name for f in fields(self)):
            require_valid_scalar(name, getattr(self, name))
        object.__setattr__(self, "normal", normalise_axis("normal", self.normal))
        if self.locked_axis is not None:
            object.__setattr__(self, "locked_axis", normalise_axis("locked_axis", self.locked_axis))
        self._in_order()
        refuse_unstable(self)

    @property
    def inertia(self) -> np.ndarray:
        """M as a matrix (6, 6)."""
        return np.asarray(self.mass)

    @property
    def drag(self) -> np.ndarray:
        """D as a matrix (6, 6)."""
        return np.asarray(self.damping)

    @property
    def gain(self) -> np.ndarray:
        """K as a matrix (6, 6)."""
        return np.asarray(self.force_gain)

    @property
    def turns(self) -> bool:
        """Whether the tool's torques turn it."""
        return self.task == "peg"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about gains that are stable with less than a factor of two to spare."""
        limit = self.loop.limit(self.contact_stiffness, self.contact_damping)
        share = float(np.linalg.eigvalsh(self.gain[:3, :3])[-1]) / limit.gain
        if share <= 0.5:
            return ()
        return (
            CodedWarning(
                "near_limit",
                f"force_gain is {share:.0%} of the stability limit {limit.gain:.3g} m/s per N at {self.contact_stiffness:g} N/m: "
                f"noise will swing the force near {limit.hz:.0f} Hz; half the limit or less is calm",
            ),
        )

    def _in_order(self) -> None:
        pairs = (("contact_off", "contact_on"), ("press", "force_limit"), ("contact_on", "force_limit"))
        for low, high in pairs:
            if not getattr(self, low) < getattr(self, high):
                raise InputError(
                    "invalid_value",
                    f"{low} ({getattr(self, low):g} N) must be below {high} ({getattr(self, high):g} N)",
                )
        if self.tool_force and not self.tool_sensor.largest_force > self.force_limit:
            raise InputError(
                "invalid_value",
                f"the tool's sensor saturates at {self.tool_sensor.largest_force:g} N, where the force is not known; "
                f"force_limit ({self.force_limit:g} N) must be below, so that the tool gives way before",
            )
        if 0 < self.press <= self.contact_on:
            raise InputError(
                "invalid_value",
                f"press ({self.press:g} N) must be zero or above contact_on ({self.contact_on:g} N), or contact is lost",
            )
