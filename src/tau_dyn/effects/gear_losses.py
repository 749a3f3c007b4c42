"""Friction proportional to the force that a gear or a guide transmits, equal or not in both directions of power.

For a cart, `load` is the force that its rod puts across the guideway; for a hinge, the rigid-body torque that its reducer
transmits (`Mechanism.guide_load`); the model's masses give it, not the data. With that torque's sign (`reducer_torque`) a gear
drives while `torque v > 0` and is driven while `torque v < 0`. With an efficiency e it loses `1/e - 1` of the load when driving
and `1 - e` when driven; a worm gear loses far more. With `|torque| sign(v)` and `torque` as columns,

    driving |torque| sign(v) [torque v > 0] + driven |torque| sign(v) [torque v < 0]
        = (driving + driven) / 2 |torque| sign(v) + (driving - driven) / 2 torque:

one mechanism, whose mean is `load_friction`. The difference scales the torque as heavier bodies do. If the refit of the masses
absorbs that, as on a single joint, the two causes are indistinguishable, and a weighed payload separates them. Reference:
Hamon, Gautier & Garrec 2010; Abba & Sardain 2003; Duclusaud et al. 2025 (BAM, models M5 and M6).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.effects.effect import NO_EXPERIMENT, PlausibleRange
from tau_dyn.effects.jointwise import JointwiseEffect
from tau_dyn.effects.motion import JointMotion, Scene


class LoadFriction(JointwiseEffect):
    """Coulomb friction proportional to the load."""

    name = "load_friction"
    cause = True
    equation = "tau += load_friction |load| sign(v)"
    reference = "Hamon, Gautier & Garrec 2010"
    reveals = "the same strokes in both directions at places and accelerations where the load differs much"
    mistaken_for = ("directional_efficiency", "position_friction", "coulomb_asymmetry", "payload")
    # 0.1 to 1 % in rolling guides, 20 % in sliding ones; a reducer of 65 % efficiency loses half of the transmitted force
    plausible = (PlausibleRange("load_friction", 0.0, 0.5),)
    needs = ("load",)
    quantities = (("load_friction", "1"),)
    sentence = "friction of {load_friction} of the load that its guide or reducer carries"
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the load's size against the motion."""
        return [np.abs(joint.signal("load")) * joint.sign]


class DirectionalEfficiency(JointwiseEffect):
    """Friction proportional to the load, with one coefficient while a gear drives and another while it is driven."""

    name = "directional_efficiency"
    cause = True
    equation = "tau += |load| sign(v) (loss_driving where the torque drives, loss_driven where it is driven)"
    reference = "Abba & Sardain 2003; Duclusaud et al. 2025"
    reveals = "lifting and lowering of a weighed payload, its mass fixed by --fix, on a joint whose load differs much"
    mistaken_for = ("load_friction", "drive_gain", "payload", "link_mass")
    # From spur gears to worms that nearly hold their load by themselves
    plausible = (PlausibleRange("loss_driving", 0.0, 1.0), PlausibleRange("loss_driven", 0.0, 1.0))
    needs = ("load", "reducer_torque")
    special = "load_friction"
    quantities = (("loss_driving", "1"), ("loss_driven", "1"))
    sentence = "a gear that loses {loss_driving} of its load when it drives and {loss_driven} when it is driven"
    nonnegative = True

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the load's magnitude against the motion, for samples that drive and for those that are driven."""
        load = joint.signal("reducer_torque")
        against, along = np.abs(load) * joint.sign, load * np.abs(joint.sign)
        return [(against + along) / 2, (against - along) / 2]

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return each hinge; a slide's load acts across its guideway and has no sign."""
        return [(joint,) for joint, unit in zip(scene.joints, scene.units, strict=True) if unit == "N m"]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the missing signal: a torque that a hinge's gear transmits."""
        return super().untestable(scene) if cls.groups(scene) else ("no joint is a hinge with a gear", NO_EXPERIMENT)
