"""Everything that a fit through the loop starts from, and the problem that it solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tau_dyn.model import Model
from tau_dyn.servo.fit import LoopFit, LoopProblem, LoopUnknowns, fit_loop
from tau_dyn.servo.records import InertialSpace, LoadWaves, LoopRecord, build_waves, split_pieces
from tau_dyn.simulate import ServoLaw


@dataclass(frozen=True, eq=False)
class LoopData:
    """Everything that a fit starts from.

    Attributes:
        model: Robot and friction, at start values.
        law: The servo's law.
        space: Inertial numbers, with the directions that are unknowns.
        records: Training logs.
        loads: Loads along them.
        unknowns: What may change.
        whole: Whether logs are simulated from start to end rather than in pieces: behind a spring no measured position
            tells the state that a piece would begin with.
    """

    model: Model
    law: ServoLaw
    space: InertialSpace
    records: Sequence[LoopRecord]
    loads: Sequence[LoadWaves]
    unknowns: LoopUnknowns
    whole: bool = False

    def build_problem(
        self, unknowns: LoopUnknowns | None = None, records: Sequence[LoopRecord] | None = None
    ) -> LoopProblem:
        """Return the fit's problem, loads along the measured motions, with other unknowns or masks where they are given."""
        records, loads = records or self.records, self.loads
        if not self.whole:
            records, loads = split_pieces(records, loads)
        return LoopProblem(unknowns or self.unknowns, build_waves(self.space, records, loads, self.law), records)


def fit_precisely(problem: LoopProblem, progress: Callable[[str], None], step: float) -> LoopFit:
    """Return a fit with a given longest step [s] whose last part takes small differences."""
    near = fit_loop(problem, progress, step=step)
    return fit_loop(problem.with_finer_differences(), progress, step=step, first=near.x)
