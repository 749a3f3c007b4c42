"""Measurements with a residual that physical effects may explain, in the form that the selection of causes uses.

A channel turns any effect into columns of the baseline's regression. Forces, tool positions and deflections differ only here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tau_dyn.effects import Effect, Motion, Scene, StructuralCompliance
from tau_dyn.estimate import Autoregression, Whitener
from tau_dyn.evidence.measurements import Measurements


@dataclass(frozen=True, eq=False)
class Channel(Measurements, ABC):
    """One kind of measurement of one robot.

    Attributes:
        scene: The range of the motion, which bounds the settings of effects.
        causes: Effects that may be found here.
    """

    has_unnamed_structures: ClassVar[bool] = True
    """Whether a residual is searched for structure without a known cause."""

    scene: Scene
    causes: tuple[type[Effect], ...]

    def report(self) -> Channel:
        """Return the same measurements in the band of reported errors; by default in the band of the search."""
        return self

    @abstractmethod
    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run, filtered and masked as the measurements are."""

    def run_columns_together(self, effects: Sequence[Effect], run: int) -> list[np.ndarray]:
        """Return the columns (n, m, k) of several effects of one run; see `Channel.run_columns`."""
        return [self.run_columns(effect, run) for effect in effects]

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's columns (n, m, k) of each run."""
        return [self.run_columns(effect, k) for k in range(len(self.runs))]

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns of all samples, for drawing."""
        return self.columns(effect)

    def quick_columns(self, effect: Effect) -> Sequence[np.ndarray] | None:
        """Return columns (n, m, k) of each run that are computed faster than the exact ones and are equally good, or None."""
        return None

    def scan(self, effects: Sequence[Effect], whiten: Whitener, both: np.ndarray) -> np.ndarray | None:
        """Return the statistics (g, d) of thousands of settings of a dense effect on white residuals (R, d).

        Settings without a fast method are nan; None if there is no fast method.
        """
        return None

    @property
    def poses(self) -> bool:
        """Whether some of the logs are static poses, for which several periods of a cyclic error may fit equally."""
        return False

    def list_known_columns(self) -> list[Sequence[np.ndarray]]:
        """Return the columns (n, m, k) of each run that are not noise: the baseline's, and the proposed resonances."""
        scene = self.scene
        ringing = [StructuralCompliance.of_resonances(scene, scene.joints)] if scene.resonances else []
        return [*super().list_known_columns(), *(self.columns(effect) for effect in ringing)]


_FASTEST = 0.98  # quantile of the speed that counts as fast
_RARE = 0.01
"""Share of the training samples beyond each end of the range that a joint visits often."""


def build_scene(
    motions: Sequence[Motion],
    joints: tuple[str, ...],
    units: tuple[str, ...],
    *,
    slow: np.ndarray,
    cutoff_hz: float,
    duration: float,
    signals: frozenset[str],
    campaigns: int = 1,
    trained: Sequence[np.ndarray] | None = None,
    coupled: tuple[tuple[str, str], ...] = (),
) -> Scene:
    """Return the properties of all motions together.

    Args:
        motions: The motions.
        joints: Their joints.
        units: The joints' force units, 'N' or 'N m'.
        slow: Slowest speed with a certain sign (na,) [m/s or rad/s].
        cutoff_hz: Upper limit of the pass band [Hz].
        duration: Length of all of them [s].
        signals: Signals that are available to effects; see `find_shared_signals`.
        campaigns: Number of logs that are distinguished.
        trained: Which samples of each motion causes are fitted to (n,); by default all.
        coupled: Pairs of joints that a shared motor may drive.
    """
    q, v = (np.concatenate([getattr(motion, key) for motion in motions]) for key in ("q", "v"))
    seen = q if trained is None else q[np.concatenate(trained)]
    often = np.quantile(seen, (_RARE, 1 - _RARE), axis=0)
    ends = q.min(axis=0), q.max(axis=0)
    return Scene(
        joints,
        units,
        *ends,
        slow,
        compute_fast_speeds(v),
        cutoff_hz,
        duration,
        signals,
        campaigns,
        often=often,
        coupled=coupled,
    )


def find_shared_signals(motions: Sequence[Motion]) -> frozenset[str]:
    """Return the names of the signals that all motions give."""
    return frozenset.intersection(*(frozenset(motion.signals) for motion in motions))


def compute_fast_speeds(v: np.ndarray) -> np.ndarray:
    """Return the speed that each joint exceeds in 2 % of the samples (na,), of speeds (n, na)."""
    return np.quantile(np.abs(v), _FASTEST, axis=0)


class EffectColumns(Sequence[np.ndarray]):
    """An effect's columns (n, m, k) of each run, made when first requested: most are tested on the training logs alone."""

    def __init__(self, channel: Channel, effect: Effect) -> None:
        """Start without columns."""
        self._channel, self.effect = channel, effect
        self.made: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self._channel.runs)

    def __getitem__(self, run: int) -> np.ndarray:  # type: ignore[override]  # slices are of no use here
        """Return the columns of one run."""
        if run >= len(self):
            raise IndexError(run)
        if run not in self.made:
            self.made[run] = self._channel.run_columns(self.effect, run)
        return self.made[run]


class ColumnCache:
    """Columns of effects on one channel, made once."""

    def __init__(self, channel: Channel) -> None:
        """Start empty."""
        self.channel = channel
        self._made: dict[tuple, EffectColumns] = {}
        self._white: dict[tuple, tuple[Whitener, np.ndarray, np.ndarray]] = {}

    def columns(self, effect: Effect) -> EffectColumns:
        """Return an effect's exact columns."""
        key = (effect.name, effect.joints, tuple(sorted(effect.settings.items())), effect.label)
        return self._made.setdefault(key, EffectColumns(self.channel, effect))

    def make_together(self, effects: Sequence[Effect], runs: Sequence[int]) -> list[EffectColumns]:
        """Return the exact columns of several effects together, made for the given runs."""
        found = [self.columns(effect) for effect in effects]
        for run in runs:
            new = [one for one in dict.fromkeys(found) if run not in one.made]
            together = self.channel.run_columns_together([one.effect for one in new], run) if new else []
            for one, columns in zip(new, together, strict=True):
                one.made[run] = columns
        return found

    def whiten_baseline(
        self, parts: tuple[int, ...], noise: tuple[Autoregression, ...]
    ) -> tuple[Whitener, np.ndarray, np.ndarray]:
        """Return the whitener of these parts under a noise model of each output, the baseline's white columns and measurements.

        The last result is kept: many effects are tested with the same baseline.
        """
        if (parts, noise) not in self._white:
            whiten = Whitener.of(self.channel.runs, self.channel.masks(*parts), noise)
            self._white = {(parts, noise): (whiten, whiten(self.channel.free_columns), whiten(self.channel.target))}
        return self._white[parts, noise]
