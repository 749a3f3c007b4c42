"""Two joints that share a reducer: a motor turns with the sum of two joints' motion and loads both.

    tau_i += F,  tau_j += F,   F = inertia (a_i + a_j) + viscous (v_i + v_j) + coulomb sign(v_i + v_j)

Robot wrists are often built so (joints 5 and 6 of the Staubli TX40). Reference: Gautier & Venture 2013; the motor's own
drive terms stand beside each joint's.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tau_dyn.effects.effect import Effect
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.plausible import PlausibleRange
from tau_dyn.effects.scene import Scene, list_joint_pairs
from tau_dyn.effects.words import format_amount, spell_unit
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


class ReducerCoupling(Effect):
    """Drive inertia and friction of a motor that turns with the sum of two joints."""

    name = "reducer_coupling"
    equation = "tau_i, tau_j += inertia (a_i + a_j) + viscous (v_i + v_j) + coulomb sign(v_i + v_j)"
    cause = True
    reference = "Gautier & Venture 2013"
    reveals = "motion in which the two joints turn together, against each other, and each alone"
    mistaken_for = ("link_mass", "passive_joint_friction")
    # The shared motor is of the size of the joints' own motors
    plausible = (
        PlausibleRange("inertia", 0.0, 1.0, of="inertia"),
        PlausibleRange("viscous", 0.0, 2.0, of="viscous"),
        PlausibleRange("coulomb", 0.0, 2.0, of="coulomb"),
    )
    nonnegative = True

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all pairs of joints with one force unit."""
        return list_joint_pairs(scene)

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return that no motor can drive two joints, where none are neighbours."""
        return (
            super().untestable(scene) if list_joint_pairs(scene) else ("no two joints can share a motor", cls.reveals)
        )

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Couple exactly two joints, whose forces are in these units."""
        super().__init__(joints, units, label=label, **settings)
        if len(self.joints) != 2:
            raise InputError("invalid_value", f"reducer_coupling joins two joints, not {len(self.joints)}")

    @property
    def parameters(self) -> Parameters:
        """Return inertia, viscous and Coulomb friction of the shared motor, named after both joints."""
        owner = "+".join(self.joints)
        unit = self.units[self.joints[0]]
        place = spell_unit("Q", unit)
        return Parameters(
            Parameter(f"{owner}.{quantity}{self.label}", 0.0, text, 0.0, origin=self.name)
            for quantity, text in (
                ("inertia", f"{unit} s^2/{place}"),
                ("viscous", f"{unit}/({place}/s)"),
                ("coulomb", unit),
            )
        )

    def describe(self, parameters: Parameters) -> str:
        """Return the shared motor's inertia and friction."""
        inertia, viscous, coulomb = (format_amount(p) for p in parameters.select(self.parameters.names))
        return (
            f"a motor shared by {' and '.join(self.joints)}, with inertia {inertia}, viscous friction {viscous} and "
            f"Coulomb friction {coulomb}"
        )

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return the shared motor's speed, whose sign its friction follows."""
        i, j = self._indices(motion)
        return [(motion.v[:, i] + motion.v[:, j], [i, j])]

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, 3)."""
        i, j = self._indices(motion)
        v = motion.v[:, i] + motion.v[:, j]
        # a given (smoothed) sign is each joint's own; the motor's is that of the summed speed
        force = np.stack([motion.a[:, i] + motion.a[:, j], v, np.sign(v)], axis=1)
        out = np.zeros_like(motion.v, shape=(*motion.v.shape, 3))
        out[:, i], out[:, j] = force, force
        return out
