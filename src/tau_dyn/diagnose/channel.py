"""What one kind of measurement gives to the search for causes, and nothing about how it is searched.

A channel holds a baseline's regression (measured outputs and the columns that the baseline may refit), which samples serve
training, confirmation and measurement, and turns any effect into columns of the same regression. Forces, tool positions and
deflections differ only here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from tau_dyn.diagnose.data_split import TEST, TRAIN, VALIDATION
from tau_dyn.effects import Effect, Scene, StructuralCompliance
from tau_dyn.estimate import RegressionRun, Whitener
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.parameters import Parameters

_USES = {TRAIN: "train on", VALIDATION: "confirm on", TEST: "measure the gain on"}


@dataclass(frozen=True, eq=False)
class Channel(ABC):
    """One kind of measurement of one robot.

    Attributes:
        name: `force`, `tool` or `deflection`.
        outputs: What is measured (m).
        units: Units of the outputs.
        parameters: Parameters of the baseline's columns (p).
        runs: Baseline columns and measurements.
        parts: Part of each sample (n,) of each run, as `data_split.py` numbers them.
        scene: What the motion offers.
        causes: Effects that may be found here.
    """

    has_unnamed_structures: ClassVar[bool] = True
    """Whether a residual is searched for structure without a name."""

    name: str
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    parameters: Parameters
    runs: tuple[RegressionRun, ...]
    parts: tuple[np.ndarray, ...]
    scene: Scene
    causes: tuple[type[Effect], ...]

    @abstractmethod
    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, m, k) of one run, filtered and masked as the measurements are."""

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's columns (n, m, k) of each run."""
        return [self.run_columns(effect, k) for k in range(len(self.runs))]

    def whole_columns(self, effect: Effect) -> list[np.ndarray]:
        """Return the columns without any sample left out, for drawing."""
        return self.columns(effect)

    def quick_columns(self, effect: Effect) -> Sequence[np.ndarray] | None:
        """Return columns (n, m, k) of each run quicker made than the exact ones and as good; None where there are none."""
        return None

    def scan(self, effects: Sequence[Effect], whiten: Whitener, both: np.ndarray) -> np.ndarray | None:
        """Return what thousands of settings explain of white residuals (R, d), as (g, d).

        Settings without a short cut are nan; without any at all the answer is None.
        """
        return None

    @abstractmethod
    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return what an unknown force might depend on: for each run, name -> (n,), such as `v_cart1` or `t`."""

    def masks(self, *parts: int) -> list[np.ndarray]:
        """Return which samples (n, m) of each run are usable and belong to these parts."""
        return [run.usable & np.isin(part, parts)[:, None] for run, part in zip(self.runs, self.parts, strict=True)]

    @cached_property
    def free_columns(self) -> list[np.ndarray]:
        """Columns that the baseline may refit (n, m, p'), of each run."""
        return [run.W[:, :, self.parameters.free] for run in self.runs]

    @cached_property
    def resonance_columns(self) -> list[np.ndarray]:
        """Columns (n, m, k) of each run of the modes that the scene proposes; k is 0 where there are none."""
        if not self.scene.resonances:
            return [np.zeros((*run.y.shape, 0)) for run in self.runs]
        joints = self.scene.joints
        proposal = StructuralCompliance.proposal(self.scene, joints)
        return self.columns(StructuralCompliance(joints, self.scene.units).with_settings(**proposal))

    @cached_property
    def target(self) -> list[np.ndarray]:
        """Measurements less what fixed parameters predict (n, m), of each run."""
        fixed = ~self.parameters.free
        return [run.y - run.W[:, :, fixed] @ self.parameters.values[fixed] for run in self.runs]

    @cached_property
    def prior(self) -> tuple[np.ndarray, np.ndarray]:
        """What was known beforehand as rows of unit noise: (k, p') and (k,)."""
        free = [p for p in self.parameters if p.free]
        known = [(k, p) for k, p in enumerate(free) if p.prior_stderr]
        rows = np.zeros((len(known), len(free)))
        for row, (k, p) in zip(rows, known, strict=True):
            row[k] = 1 / float(p.prior_stderr or 1.0)
        return rows, np.array([p.value / float(p.prior_stderr or 1.0) for _, p in known])


def refuse_scarce(channel: Channel, least: int | Mapping[int, int], short: str, have: str, wanted: str) -> None:
    """Refuse measurements that leave one of the three parts too little.

    Args:
        channel: The measurements.
        least: Usable values that each part needs, one number for all or one for each part.
        short: What is missing, such as `too little is left`; for what is added.
        have: What there is.
        wanted: What to record instead.

    Raises:
        CannotAnswer: A part has fewer.
    """
    for part, use in _USES.items():
        needed = least if isinstance(least, int) else least[part]
        if sum(int(mask.sum()) for mask in channel.masks(part)) < needed:
            raise CannotAnswer("too_little_data", f"{short} to {use}: {have}", wanted)
