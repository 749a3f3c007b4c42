"""Effects of the force's recording in time, common to all drives or each drive's own: a delay, a low-pass.

    tau_log = D(tau) ~ tau + amplitude (D_about(F) - F) / about

with `F` the force of the model without the effect and `about` the setting near which the law is linear. At the solution setting
and amplitude agree, and diagnosis fits them as one number (`Effect.matched`).
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from tau_dyn.effects.effect import Effect
from tau_dyn.effects.motion import Motion
from tau_dyn.effects.scene import Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


class TimingEffect(Effect):
    """Forces that are logged with their time changed."""

    amplitude: ClassVar[str]
    """What the parameter's name says after its owner."""
    kind: ClassVar[int]
    """Its place in `Scene.timing`: 0 a delay, 1 a time constant."""

    @abstractmethod
    def difference(self, force: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return by how much a logged force (N,) differs from the force, per second of the amplitude, at even times (N,)."""

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return all joints together, then each alone."""
        alone = [(joint,) for joint in scene.joints]
        return alone if len(alone) == 1 else [scene.joints, *alone]

    @classmethod
    def propose(cls, scene: Scene, joints: tuple[str, ...]) -> float | None:
        """Return the time that fits the baseline best, where it is the same for these joints and not zero."""
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
