"""Forces and positions that were not logged at the same instant.

    tau_log(t) = tau(t - delay) ~ tau(t) + delay (F(t - about) - F(t)) / about

with F the force of the model without this effect. The law is linear in `delay` near `about`, a setting; the best setting and
the amplitude agree. Up to 1 ms the difference is taken to both sides, `(F(t - about) - F(t + about)) / (2 about)`, because its
even part, a smoothed force less itself, is there what any mismatch of filters looks like. Beyond, the even part tells a late
force from a smoothed one (`drive_lag`), surely from 5 ms up. Positive: forces were logged late. One clock mostly serves all
drives, so an instance over all joints has one parameter, `drive.delay`; each joint alone has its own. A clock that is off
between forces and positions is the same thing. Reference: Dressler 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.timing import TimingEffect
from tau_dyn.effects.words import format_amount
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameters

_ODD_MS = (0.5,)
"""Delays tried with the odd difference, which is the same for both signs."""
_FULL_MS = (2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 70.0, 100.0)
"""Delays tried with the full difference, a third of a turn of 10 Hz apart where they are short; one search between neighbours
does the rest."""
MAX_ODD_S = 1e-3
"""Delay up to which only the odd part counts; of a motion at 5 Hz the even part is 2 % of it there."""
MAX_TWIN_S = 5e-3
"""Delay up to which a low-pass of the same length is its twin; of a motion at 2 Hz they differ by 3 % of themselves."""
_MAX_SHARE = 0.01
"""Share of the recording that a delay may take: so much of its ends is not known."""


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
    # Drives, buses and loggers; more is another recording
    plausible = (PlausibleRange("delay", -0.1, 0.1, "s"),)
    needs = ("force",)
    amplitude = "delay"
    kind = 0
    defaults = {"about": 5e-4}
    setting_units = {"about": "s"}
    matched = {"about": "delay"}
    open_ends = {"about": "both"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Delay the forces of these joints alike; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["about"] == 0:
            raise InputError("invalid_value", "setting about of effect delay must not be zero; its sign is the delay's")
        if abs(self.settings["about"]) <= MAX_TWIN_S:
            self.equivalent = (*type(self).equivalent, "drive_lag")

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return delays of both signs, none longer than a hundredth of the recording."""
        odd, full = ([x for x in ms if 1e-3 * x <= _MAX_SHARE * scene.duration] for ms in (_ODD_MS, _FULL_MS))
        return [{"about": 1e-3 * x} for x in (*(-x for x in reversed(full)), *odd, *full)]

    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the force of `about` ago less the force now, or than that of `about` ahead, per second (N,)."""
        about = self.settings["about"]
        before = np.interp(t - about, t, force)
        if abs(about) > MAX_ODD_S:
            return (before - force) / about
        return (before - np.interp(t + about, t, force)) / (2 * about)

    def describe(self, parameters: Parameters) -> str:
        """Return by how much forces are late or early."""
        p = parameters[self.parameters.names[0]]
        which = "forces" if len(self.joints) == 1 else f"forces of {', '.join(self.joints)}"
        return f"{which} logged {format_amount(p)} after the positions" + (
            " (negative: before them)" if p.value < 0 else ""
        )
