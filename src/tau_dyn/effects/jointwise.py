"""Effects that act on each of their joints by its own motion: their columns laid out, and their words, joint by joint."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import Effect
from tau_dyn.effects.motion import JointMotion, Motion
from tau_dyn.effects.words import format_amount, format_percent, format_quantity, spell_unit
from tau_dyn.parameters import Parameter, Parameters


class JointParameters(Effect):
    """An effect with the same parameters for each of its joints, and words for each."""

    quantities: ClassVar[tuple[tuple[str, str], ...]]
    """Name and unit, with F for the force unit, V for the speed unit and Q for the position's."""
    sentence: ClassVar[str] = ""
    """What is said of a joint, with its quantities in braces, shares in per cent; empty for their names and amounts."""

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """Its quantities and their units; a subclass whose settings say how many there are answers for itself."""
        return self.quantities

    @property
    def parameters(self) -> Parameters:
        """Its parameters, joint by joint, at zero."""
        rows = []
        for joint in self.joints:
            for term, unit in self.terms:
                text = spell_unit(unit, self.units[joint])
                name = f"{joint}.{term}{self.label}"
                rows.append(Parameter(name, 0.0, text, self.lower(term), origin=self.name))
        return Parameters(rows)

    def lower(self, quantity: str) -> float:
        """Return the smallest admissible value; zero where only amplitudes from zero up make sense."""
        return 0.0 if self.nonnegative else -np.inf

    def describe(self, parameters: Parameters) -> str:
        """Return the effect at these values in words, joint by joint where there are several."""
        said = []
        for joint in self.joints:
            values = {name: parameters[f"{joint}.{name}{self.label}"] for name, _ in self.terms}
            said.append(self.words(joint, values) + (f" at {joint}" if len(self.joints) > 1 else ""))
        return "; ".join(said)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return what `describe` says of one joint, whose parameters are given by quantity."""
        if not self.sentence:
            return " and ".join(f"{name.replace('_', ' ')} of {format_amount(p)}" for name, p in values.items())
        said = {name: format_percent(p) if p.unit == "1" else format_amount(p) for name, p in values.items()}
        return self.sentence.format(**said)

    def setting(self, key: str, joint: str) -> str:
        """Return a setting in words, such as `20.9 mm`."""
        return format_quantity(self.settings[key], spell_unit(self.setting_units.get(key, ""), self.units[joint]))


class JointwiseEffect(JointParameters):
    """An effect that acts on each of its joints by that joint's own motion.

    A subclass says its quantities and their force per unit parameter; this class lays the columns out joint by joint.
    """

    @abstractmethod
    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force per unit of each quantity (N,), for one joint's motion."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        n = len(self.terms)
        out = np.zeros_like(motion.v, shape=(*motion.v.shape, n * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            for m, column in enumerate(self.per_joint(JointMotion.of(motion, index))):
                out[:, index, n * k + m] = column
        return out
