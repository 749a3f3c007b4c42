"""Forces and positions that were not logged at the same instant.

    tau_log(t) = tau(t - delay) ~ tau(t) + delay (F(t - about) - F(t + about)) / (2 about)

with F the force of the model without this effect. The law is linear in `delay` near `about`, a setting; the best setting and
the amplitude agree. The difference is taken to both sides because its even part, a smoothed force less itself, is what any
mismatch of filters looks like. Positive: forces were logged late. One clock mostly serves all drives,
so an instance over all joints has one parameter, `drive.delay`; each joint alone has its own. A clock that is off
between forces and positions is the same thing. Reference: Dressler 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tau_dyn.effects.effect import Effect
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene
from tau_dyn.effects.words import amount
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters

_ABOUT_MS = (0.5, 2.0, 5.0, 10.0, 20.0)
_LONGEST_SHARE = 0.01
"""Share of the recording that a delay may take: so much of its ends is not known."""


class Delay(Effect):
    """Forces logged late or early."""

    name = "delay"
    cause = True
    shared_by_joints = True
    equation = "tau_log(t) = tau(t - delay)"
    reference = "Dressler 2012, 6.3"
    reveals = "quick reversals and accelerations that change fast, such as a multisine"
    mistaken_for = ("clock_offset", "link_mass", "payload", "joint_compliance")
    equivalent = ("clock_offset",)
    # Drives, buses and loggers; more is another recording
    plausible = (PlausibleRange("delay", -0.1, 0.1, "s"),)
    needs = ("force",)
    defaults = {"about": 5e-4}
    setting_units = {"about": "s"}

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Delay the forces of these joints alike; see `Effect.__init__`."""
        super().__init__(joints, units, label=label, **settings)
        if self.settings["about"] == 0:
            raise InputError("setting about of effect delay must not be zero; its sign is the delay's")

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together, then each alone."""
        alone = [(joint,) for joint in scene.joints]
        return alone if len(alone) == 1 else [scene.joints, *alone]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return delays of both signs, none longer than a hundredth of the recording."""
        ms = [x for x in _ABOUT_MS if 1e-3 * x <= _LONGEST_SHARE * scene.duration]
        return [{"about": 1e-3 * x} for x in (*(-x for x in reversed(ms)), *ms)]

    @property
    def measured(self) -> bool:
        """A delay is the recording's."""
        return True

    @property
    def parameters(self) -> Parameters:
        """The delay, `drive.delay` for several joints."""
        owner = self.joints[0] if len(self.joints) == 1 else "drive"
        return Parameters([Parameter(f"{owner}.delay{self.label}", 0.0, "s", origin=self.name)])

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per second of delay (N, na, 1), at samples in the order of time."""
        if motion.t is None:
            raise InputError(
                "effect delay needs samples in the order of time; it acts on a recording, not on a single state"
            )
        force, about, out = motion.signal("force"), self.settings["about"], np.zeros((*motion.v.shape, 1))
        for k in self._indices(motion):
            before, after = (np.interp(motion.t + x, motion.t, force[:, k]) for x in (-about, about))
            out[:, k, 0] = (before - after) / (2 * about)
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return by how much forces are late or early."""
        p = parameters[self.parameters.names[0]]
        which = "forces" if len(self.joints) == 1 else f"forces of {', '.join(self.joints)}"
        return f"{which} logged {amount(p)} after the positions" + (" (negative: before them)" if p.value < 0 else "")
