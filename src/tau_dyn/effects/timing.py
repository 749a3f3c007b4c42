"""Effects of the force's recording in time, common to all drives or each drive's own: a delay, a low-pass.

    tau_log = D(tau) ~ tau + amplitude (D_about(F) - F) / about

with `F` the force of the model without the effect and `about` the setting near which the law is linear. At the solution setting
and amplitude agree, and diagnosis fits them as one number (`Effect.matched`). One clock or filter mostly serves all drives, so an
instance over all joints has one parameter, named after `drive`.

Delay, positive for forces logged late: up to 1 ms the difference is symmetric, `(F(t - about) - F(t + about)) / (2 about)`,
because its even part, a smoothed force less itself, resembles any mismatch of filters there. Beyond 1 ms, the even part
distinguishes a late force from a smoothed one, reliably from 5 ms up.

Low-pass, `T d tau_log / dt = tau - tau_log`: it shifts slow forces like a delay of the same length, and attenuates fast ones,
by (w T)^2 / (1 + (w T)^2) at w, which a delay does not. It starts in the steady state. Reference: Dressler 2012, 6.3; Ljung
1999, 13.3 (prefilters); Swevers, Verdonck & De Schutter 2007 (filters of actuator data in robot identification).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import Effect, PlausibleRange, format_amount
from tau_dyn.effects.motion import Motion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


class TimingEffect(Effect):
    """Forces that are logged with wrong timing."""

    amplitude: ClassVar[str]
    """The parameter's name after its owner."""
    kind: ClassVar[int]
    """Its index in `Scene.timing`: 0 for a delay, 1 for a time constant."""

    @abstractmethod
    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the difference between a logged force (N,) and the force, per second of the amplitude, at even times (N,)."""

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together, then each alone."""
        alone = [(joint,) for joint in scene.joints]
        return alone if len(alone) == 1 else [scene.joints, *alone]

    @classmethod
    def propose(cls, scene: Scene, joints: tuple[str, ...]) -> float | None:
        """Return the time that fits the baseline best, if it is the same for these joints and not zero."""
        found = {scene.timing.get(joint, (0.0, 0.0))[cls.kind] for joint in joints}
        return found.pop() if len(found) == 1 and any(found) else None

    @property
    def measured(self) -> bool:
        """The recording's, not the robot's."""
        return True

    @property
    def parameters(self) -> Parameters:
        """One time, named after `drive` for several joints."""
        owner = self.joints[0] if len(self.joints) == 1 else "drive"
        lower = 0.0 if self.nonnegative else -np.inf
        return Parameters([Parameter(f"{owner}.{self.amplitude}{self.label}", 0.0, "s", lower, origin=self.name)])

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per second of the amplitude (N, na, 1), at samples in the order of time."""
        if motion.t is None:
            raise InputError(
                "unsupported",
                f"effect {self.name} needs samples in the order of time; it acts on a recording, not on a single state",
            )
        force, out = motion.signal("force"), np.zeros((*motion.v.shape, 1))
        for k in self._indices(motion):
            out[:, k, 0] = self.difference(force[:, k], motion.t)
        return out


_ODD_MS = (0.5,)
"""Delays tried with the odd difference, which is the same for both signs."""
_FULL_MS = (2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 70.0, 100.0)
"""Delays tried with the full difference, in steps of a third of a period of 10 Hz if short; one search between neighbours does
the rest."""
MAX_ODD_S = 1e-3
"""Delay up to which only the odd part is used; for a motion at 5 Hz the even part is 2 % of it there."""
MAX_TWIN_S = 5e-3
"""Delay up to which a low-pass of the same length is indistinguishable; for a motion at 2 Hz the two differ by 3 %."""
_MAX_LEAD_S = 1e-2
"""Lead up to which a voltage's inductance is indistinguishable; for a motion at 2 Hz the two differ by 1 % of the force."""
_MAX_SHARE = 0.01
"""Largest delay, as a share of the recording: that much of its ends is unknown."""


class Delay(TimingEffect):
    """Forces logged late or early."""

    name = "delay"
    cause = True
    shared_by_joints = True
    equation = "tau_log(t) = tau(t - delay)"
    reference = "Dressler 2012, 6.3"
    reveals = "quick reversals and accelerations that change fast, such as a multisine"
    mistaken_for = ("clock_offset", "drive_lag", "link_mass", "payload", "joint_compliance")
    equivalent: tuple[str, ...] = ("clock_offset",)
    # Drives, buses and loggers; a longer delay means another recording
    plausible = (PlausibleRange("delay", -0.1, 0.1, "s"),)
    needs = ("force",)
    amplitude = "delay"
    kind = 0
    defaults = {"about": 5e-4}
    setting_units = {"about": "s"}
    matched = {"about": "delay"}
    open_ends = {"about": "both"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Delay the forces of these joints equally; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["about"] == 0:
            raise InputError("invalid_value", "setting about of effect delay must not be zero; its sign is the delay's")
        if abs(self.settings["about"]) <= MAX_TWIN_S:
            self.equivalent = (*type(self).equivalent, "drive_lag")
        if -_MAX_LEAD_S <= self.settings["about"] < 0:
            self.equivalent = (*self.equivalent, "inductance")

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return delays of both signs, at most a hundredth of the recording."""
        odd, full = ([x for x in ms if 1e-3 * x <= _MAX_SHARE * scene.duration] for ms in (_ODD_MS, _FULL_MS))
        return [{"about": 1e-3 * x} for x in (*(-x for x in reversed(full)), *odd, *full)]

    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the force `about` earlier minus the present one, or minus that `about` later, per second (N,)."""
        about = self.settings["about"]
        before = np.interp(t - about, t, force)
        if abs(about) > MAX_ODD_S:
            return (before - force) / about
        return (before - np.interp(t + about, t, force)) / (2 * about)

    def describe(self, parameters: Parameters) -> str:
        """Return the delay or lead of forces."""
        p = parameters[self.parameters.names[0]]
        which = "forces" if len(self.joints) == 1 else f"forces of {', '.join(self.joints)}"
        return f"{which} logged {format_amount(p)} after the positions" + (
            " (negative: before them)" if p.value < 0 else ""
        )


_LAGS_MS = (5.0, 10.0, 20.0, 45.0, 100.0)
"""Time constants tried, in steps of a factor 2 to 3; one search between neighbours does the rest. A shorter low-pass is
reported as a delay of the same length: the remaining difference resembles encoder noise in the predicted force."""
_MAX_TWIN_LAG_S = 7e-3
"""Time constant up to which a delay is indistinguishable; a little above the end of the grid, at which a shorter one would
end."""
_MAX_LAG_SHARE = 0.01
"""Largest time constant, as a share of the recording: the low-pass needs five of them at the start to settle."""


class DriveLag(TimingEffect):
    """Forces logged after a low-pass."""

    name = "drive_lag"
    cause = True
    equation = "time_constant d tau_log / dt = tau - tau_log"
    reference = "Swevers, Verdonck & De Schutter 2007; Ljung 1999, 13.3"
    reveals = "forces that change within the time constant: quick reversals, a multisine up to 20 Hz"
    mistaken_for = ("delay", "clock_offset", "joint_compliance", "lugre")
    # Current filters of drives are set from 0.1 ms to some tens of ms; a display's filter reaches 100 ms
    plausible = (PlausibleRange("time_constant", 0.0, 0.1, "s"),)
    needs = ("force",)
    nonnegative = True
    amplitude = "time_constant"
    kind = 1
    defaults = {"about": 1e-2}
    setting_units = {"about": "s"}
    positive = ("about",)
    matched = {"about": "time_constant"}
    open_ends = {"about": "high"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Low-pass the forces of these joints equally; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["about"] <= _MAX_TWIN_LAG_S:
            self.equivalent = ("delay", "clock_offset")

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return time constants from 5 to 100 ms, at most a hundredth of the recording."""
        return [{"about": 1e-3 * x} for x in _LAGS_MS if 1e-3 * x <= _MAX_LAG_SHARE * scene.duration]

    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the low-passed force minus the force, per second of the time constant (N,)."""
        return (apply_first_order_lowpass(force, t, self.settings["about"]) - force) / self.settings["about"]

    def describe(self, parameters: Parameters) -> str:
        """Return the time constant."""
        p = parameters[self.parameters.names[0]]
        which = "forces" if len(self.joints) == 1 else f"forces of {', '.join(self.joints)}"
        return f"{which} logged behind a low-pass with a time constant of {format_amount(p)}"


def apply_first_order_lowpass(x: np.ndarray, t: np.ndarray, time_constant: float) -> np.ndarray:
    """Return a signal (N,) after a first-order low-pass [s], in steady state at the first sample of an even clock (N,) [s].

    Exact for a signal that is linear between samples (first-order hold; Franklin, Powell & Workman 1998, 6.3).
    """
    if len(t) < 2 or time_constant <= 0:
        return x
    from scipy.signal import lfilter

    dt = float(t[-1] - t[0]) / (len(t) - 1)
    keep, ratio = np.exp(-dt / time_constant), time_constant / dt
    now, before = 1 - ratio * (1 - keep), ratio * (1 - keep) - keep
    return x[0] + lfilter([now, before], [1, -keep], x - x[0])
