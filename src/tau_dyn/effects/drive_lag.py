"""A drive that logs its force behind a first-order low-pass.

    T d tau_log / dt = tau - tau_log,   tau_log ~ tau + time_constant (LP(F) - F) / about

with F the force of the model without this effect and LP the low-pass of time constant `about`, a setting that agrees with the
amplitude at the solution. The low-pass starts settled. It turns slow forces like a delay of the same length, and makes fast ones
smaller, which a delay does not: (w T)^2 / (1 + (w T)^2) of a force at w tells them apart. One filter setting mostly serves all
drives: `drive.time_constant`; each joint alone has its own. Reference: Ljung 1999, 13.3 (prefilters of measured signals);
Swevers, Verdonck & De Schutter 2007 (filters of actuator data in robot identification).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.signal import lfilter

from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.timing import TimingEffect
from tau_dyn.effects.words import format_amount
from tau_dyn.parameters import Parameters

_ABOUT_MS = (5.0, 10.0, 20.0, 45.0, 100.0)
"""Time constants tried, a factor 2 to 3 apart; one search between neighbours does the rest. A shorter low-pass is called a
delay of the same length: what is left of the difference is what noise of the encoders in the predicted force looks like, too."""
_MAX_TWIN_S = 7e-3
"""Time constant up to which a delay is its twin; a little above the end of the grid, at which a shorter one would end."""
_MAX_SHARE = 0.01
"""Share of the recording that a time constant may take: five of them pass at its begin until the low-pass has settled."""


class DriveLag(TimingEffect):
    """Forces logged behind a low-pass."""

    name = "drive_lag"
    cause = True
    equation = "time_constant d tau_log / dt = tau - tau_log"
    reference = "Swevers, Verdonck & De Schutter 2007; Ljung 1999, 13.3"
    reveals = "forces that change within the time constant: quick reversals, a multisine up to 20 Hz"
    mistaken_for = ("delay", "clock_offset", "joint_compliance", "hysteresis")
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
        """Low-pass the forces of these joints alike; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["about"] <= _MAX_TWIN_S:
            self.equivalent = ("delay", "clock_offset")

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return time constants from 5 to 100 ms, none longer than a hundredth of the recording."""
        return [{"about": 1e-3 * x} for x in _ABOUT_MS if 1e-3 * x <= _MAX_SHARE * scene.duration]

    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the low-passed force less the force, per second of the time constant (N,)."""
        return (apply_first_order_lowpass(force, t, self.settings["about"]) - force) / self.settings["about"]

    def describe(self, parameters: Parameters) -> str:
        """Return the time constant."""
        p = parameters[self.parameters.names[0]]
        which = "forces" if len(self.joints) == 1 else f"forces of {', '.join(self.joints)}"
        return f"{which} logged behind a low-pass with a time constant of {format_amount(p)}"


def apply_first_order_lowpass(x: np.ndarray, t: np.ndarray, time_constant: float) -> np.ndarray:
    """Return a signal (N,) behind a first-order low-pass [s], settled at the first sample of an even clock (N,) [s].

    Exact for a signal that is straight between samples (first-order hold; Franklin, Powell & Workman 1998, 6.3).
    """
    if len(t) < 2 or time_constant <= 0:
        return x
    dt = float(t[-1] - t[0]) / (len(t) - 1)
    keep, ratio = np.exp(-dt / time_constant), time_constant / dt
    now, before = 1 - ratio * (1 - keep), ratio * (1 - keep) - keep
    return x[0] + lfilter([now, before], [1, -keep], x - x[0])
