"""Two encoders of one joint that were not read at the same instant.

    encoder - load = clock_offset (v + v_load) / 2

A load-side encoder whose reading is `clock_offset` old says `q(t - clock_offset)`; the difference follows the speed, whatever
the force. Negative: the motor side is the older one. It belongs to the recording, and not to the robot. With the mean of both
sides' speeds, `v(t)` and `v(t - clock_offset)`, the law is the trapezoidal rule, exact up to the offset's third power.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tau_dyn.effects import JointMotion, JointwiseDisplacement, PlausibleRange, format_amount
from tau_dyn.parameters import Parameter

LOAD_SPEED = "load_speed"
"""Signal (N, na): speed of the load-side encoders."""


class ClockOffset(JointwiseDisplacement):
    """A load-side encoder that is read late, or early."""

    name = "clock_offset"
    cause = True
    equation = "encoder - load = clock_offset (v + v_load) / 2"
    reference = "Dressler 2012, 6.3 (delays between channels)"
    reveals = "the same stroke at several constant speeds without a change of load, both encoders logged"
    mistaken_for = ("hysteresis", "joint_compliance", "backlash")
    # Two encoders read by two devices on one bus
    plausible = (PlausibleRange("clock_offset", -0.1, 0.1, "s"),)
    quantities = (("clock_offset", "s"),)
    needs = (LOAD_SPEED,)

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the mean speed of both sides."""
        return [0.5 * (joint.v + joint.signal(LOAD_SPEED))]

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return which side is late, and by how much."""
        p = values["clock_offset"]
        later, sooner = ("load", "motor") if p.value >= 0 else ("motor", "load")
        size = Parameter(p.name, abs(p.value), p.unit, stderr=p.stderr)
        return f"the {later}-side encoder's reading is {format_amount(size)} older than the {sooner} side's"
