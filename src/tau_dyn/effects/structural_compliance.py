r"""A drive or structure that yields and swings: the load stays behind the encoder, and rings at its own frequency.

    encoder - load = compliance d,     d'' + 2 damping w d' + w^2 d = w^2 F,     w = 2 pi frequency

with F the force of the rigid bodies, which the spring carries. Far above the motion's band it is the quasi-static
`joint_compliance`; far below it is a mass more. One mode a joint: for several, and for shapes, `modes` takes a vibration log.
Reference: Spong 1987; Dressler 2012, 6.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import signal

from tau_dyn.effects.effect import JointMotion, Scene
from tau_dyn.effects.jointwise_displacement import JointwiseDisplacement
from tau_dyn.effects.words import amount
from tau_dyn.parameters import Parameter

_SLOWEST_HZ = 3.0
_REACH = 2.5
"""Frequency of the stiffest spring tried, in those that can be seen: above it, it cannot be told from one without a mode."""
_STEP = 1.15
_DAMPING = (0.03, 0.1)


class StructuralCompliance(JointwiseDisplacement):
    """A spring between encoder and load that rings."""

    name = "structural_compliance"
    cause = True
    equation = "encoder - load = compliance d, d'' + 2 damping w d' + w^2 d = w^2 F, w = 2 pi frequency"
    reference = "Spong 1987; Dressler 2012, 6.3"
    reveals = "a multisine around the suspected resonance, riding on a stroke of constant speed"
    mistaken_for = ("joint_compliance", "delay", "payload", "drive_gain")
    plausible = "from zero to 1e-6 m/N or 1e-4 rad/(N m); 3 to 100 Hz, damping 0.005 to 0.3"
    needs = (*JointwiseDisplacement.needs, "rigid_force")
    nonnegative = True
    quantities = (("structural_compliance", "Q/F"),)
    defaults = {"frequency": 10.0, "damping": 0.03}
    setting_units = {"frequency": "Hz"}
    positive = ("frequency", "damping")
    refined = ("frequency", "damping")

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the swinging response to the force; at rest, the force itself."""
        F = joint.signal("rigid_force")
        if joint.t is None or len(joint.t) < 2:
            return [F]
        dt = float(joint.t[-1] - joint.t[0]) / (len(joint.t) - 1)
        w, damping = 2 * np.pi * self.settings["frequency"], self.settings["damping"]
        sampled: Any = signal.cont2discrete(([w**2], [1.0, 2 * damping * w, w**2]), dt, method="foh")
        b, a = np.ravel(sampled[0]), np.ravel(sampled[1])
        response, _ = signal.lfilter(b, a, F, zi=signal.lfilter_zi(b, a) * F[0])
        return [np.asarray(response)]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return compliance, frequency and damping."""
        p = values["structural_compliance"]
        return (
            f"a resonance at {self.setting('frequency', joint)}, damping {100 * self.settings['damping']:.2g} %, "
            f"of a part that yields by {amount(p)}"
        )

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return frequencies in steps that a refinement bridges, with little and with much damping; none for poses held still."""
        highest = _REACH * scene.cutoff_hz
        if not np.isfinite(highest):
            return []
        steps = int(np.ceil(np.log(max(highest / _SLOWEST_HZ, 1.0)) / np.log(_STEP)))
        found = np.geomspace(_SLOWEST_HZ, highest, steps) if steps > 1 else []
        return [{"frequency": float(f), "damping": d} for d in _DAMPING for f in found]
