"""Everything that a fit through the loop starts from, and the problem that it solves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tau_dyn.model import Model
from tau_dyn.servo.fit import LoopProblem, LoopUnknowns
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
    """

    model: Model
    law: ServoLaw
    space: InertialSpace
    records: Sequence[LoopRecord]
    loads: Sequence[LoadWaves]
    unknowns: LoopUnknowns

    def build_problem(
        self, unknowns: LoopUnknowns | None = None, records: Sequence[LoopRecord] | None = None
    ) -> LoopProblem:
        """Return the fit's problem, with other unknowns or other masks where they are given."""
        records = records or self.records
        return build_problem(self.space, self.law, unknowns or self.unknowns, records, self.loads)


def build_problem(
    space: InertialSpace,
    law: ServoLaw,
    unknowns: LoopUnknowns,
    records: Sequence[LoopRecord],
    loads: Sequence[LoadWaves],
) -> LoopProblem:
    """Return a fit's problem, the logs in pieces, loads along the measured motions."""
    pieces, waves = split_pieces(records, loads)
    return LoopProblem(unknowns, build_waves(space, pieces, waves, law), pieces)
