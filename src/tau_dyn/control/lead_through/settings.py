"""What a lead-through controller is built from, checked before anything moves."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from tau_dyn.control.lead_through.checks import expand_matrix, normalise_axis, refuse_unstable, require_valid_scalar
from tau_dyn.control.lead_through.sensor import ForceSensor
from tau_dyn.control.lead_through.stability import ForceLoop
from tau_dyn.exceptions import InputError, UnknownName

TASKS = ("surface", "peg")


@dataclass(frozen=True, eq=False)
class LeadThroughSettings:
    """Gains, limits and what is known of the contact; Dressler 2012, 8.3. World axes at the tool point throughout.

    For a peg take the tool point at its root: a side force at the tip then turns the peg along the wall. About its tip it would
    have no lever, and stay pressed.

    Diagonals may be given as a number, three or six of them; they are kept as 6 x 6 matrices, linear first.

    Attributes:
        mass: M of the handle (8.6) [kg, kg m^2].
        damping: D of the handle [N s/m, N m s/rad].
        force_gain: K of the tool force (8.4) [m/s per N, rad/s per N m].
        tool_force: False leads by the handle alone, as with one sensor, for comparison; the force limit then protects nothing.
        task: 'surface' keeps a force along the normal (8.9); 'peg' lets the torques turn the tool too (8.11).
        press: Force along the normal that contact is kept at, 2 in the thesis' surface, 0 for its peg [N].
        normal: Nominal unit normal, from the work to the tool (3,).
        correction_range: How far the normal may be corrected [rad].
        normal_hz: Corner of the filter on the force that gives the normal [Hz]; None takes (8.10) as printed.
        contact_on: Force at which contact begins [N].
        contact_off: Force below which it ends [N].
        torque_on: Torque that counts as `contact_on` where the tool may turn [N m].
        contact_wait: Time below `contact_off` before contact ends [s].
        release_force: Pull of the hand along the normal that ends contact [N].
        speed_limit: Largest speed of the tool [m/s].
        turning_limit: Largest rate of turning [rad/s].
        force_limit: Force on the tool above which no command presses further and the tool gives way [N].
        contact_stiffness: The stiffest contact to expect, tool, sensor and work in series [N/m].
        contact_damping: Its damping [N s/m].
        watch: Whether the gain is lowered where the contact proves stiffer than it bears (`stiffness.py`).
        turning_stiffness: The same against turning about the tool point [N m/rad]; needed where the tool may turn.
        hand_stiffness: The stiffest hand to expect [N/m].
        locked_axis: Axis in the tool's frame (3,) about which the tool must not turn, or None.
        loop: Sampling, servo and delay between a force and the motion that it causes.
        handle_sensor: Where the handle's sensor sits.
        tool_sensor: Where the tool's sensor sits.
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
        """Check everything.

        Raises:
            InputError: A value that makes no sense or a loop that would be unstable; the sentence says which and why.
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
            f"force_gain is {share:.0%} of the stability limit {limit.gain:.3g} m/s per N at {self.contact_stiffness:g} N/m: "
            f"noise will swing the force near {limit.hz:.0f} Hz; half the limit or less is calm",
        )

    def _in_order(self) -> None:
        pairs = (("contact_off", "contact_on"), ("press", "force_limit"), ("contact_on", "force_limit"))
        for low, high in pairs:
            if not getattr(self, low) < getattr(self, high):
                raise InputError(
                    "invalid_value",
                    f"{low} ({getattr(self, low):g} N) must be below {high} ({getattr(self, high):g} N)",
                )
        if 0 < self.press <= self.contact_on:
            raise InputError(
                "invalid_value",
                f"press ({self.press:g} N) must be zero or above contact_on ({self.contact_on:g} N), or contact is lost",
            )
