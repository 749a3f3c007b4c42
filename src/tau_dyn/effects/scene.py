"""What a motion offers, for choosing which settings of an effect are worth trying, and on which joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tau_dyn.effects.plausible import JointScales


@dataclass(frozen=True, eq=False)
class Scene:
    """A motion, or several together, as diagnosis looks at it.

    Attributes:
        joints: Actuated joints.
        units: Their force units, 'N' or 'N m'.
        low: Smallest position (na,) [m or rad].
        high: Largest position (na,).
        slow: Slowest speed with a sure sign (na,) [m/s or rad/s].
        fast: A speed that the joint exceeds in 2 % of the samples (na,).
        cutoff_hz: Frequency above which nothing is seen [Hz].
        duration: Length of all runs together [s].
        signals: Signals that the motions give.
        campaigns: Number of logs, which `campaign` counts from zero.
        resonances: Frequency [Hz] and damping ratio of modes that a black-box fit proposes, strongest first.
        structure: Whether these modes are the structure's as a whole, and no single joint's.
        hard: An acceleration that the joint exceeds in 2 % of the samples (na,); None where it is not known.
        scales: Each joint's own forces, of which plausible amplitudes are shares.
        coupled: Pairs of joints that a shared motor may drive: neighbours in the chain, or declared by the robot file.
        timing: Joint -> delay and time constant [s] of its logged force that fit the baseline best; empty where none is long.
        step_s: Time between samples of the logs, as they were recorded [s].
        often: Positions below and above which the joints are rarely trained on (2, na); None where all of it counts.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    slow: np.ndarray
    fast: np.ndarray
    cutoff_hz: float
    duration: float
    signals: frozenset[str] = frozenset()
    campaigns: int = 1
    resonances: tuple[tuple[float, float], ...] = ()
    structure: bool = False
    often: np.ndarray | None = None
    hard: np.ndarray | None = None
    scales: JointScales = field(default_factory=dict)
    coupled: tuple[tuple[str, str], ...] = ()
    timing: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    step_s: float = 0.0

    def index(self, joint: str) -> int:
        """Return a joint's place."""
        return self.joints.index(joint)

    def range_of(self, joint: str) -> tuple[float, float]:
        """Return the range of positions in which a joint is trained on often."""
        k = self.index(joint)
        low, high = (self.low, self.high) if self.often is None else self.often
        return float(low[k]), float(high[k])


def list_joint_pairs(scene: Scene) -> list[tuple[str, ...]]:
    """Return the pairs of joints with the same force unit that a shared motor may drive."""
    same = {joint: unit for joint, unit in zip(scene.joints, scene.units, strict=True)}
    return [(i, j) for i, j in scene.coupled if same[i] == same[j]]
