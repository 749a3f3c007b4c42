"""Everything that a fit through the loop starts from, and the problem that it solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.model import Model
from tau_dyn.servo.fit import LoopFit, LoopProblem, LoopUnknowns, fit_loop
from tau_dyn.servo.records import InertialSpace, LoadWaves, LoopRecord, build_waves, split_pieces
from tau_dyn.simulate import ServoLaw

BASELINE = ("armature", "coulomb", "viscous", "offset")
"""What a simulation has before any cause, and is fitted first."""
_ITERATIONS = 6  # from a solution with twice the step


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


def refit_finer(problem: LoopProblem, fit: LoopFit, progress: Callable[[str], None]) -> LoopFit:
    """Return a fit again with half the step; what that moves counts as uncertain, as halving again moves it by no more."""
    step = 0.5 * min(fit.step, float(problem.waves.dt.max()))
    fine = fit_loop(problem.with_finer_differences(), progress, _ITERATIONS, step, fit.x)
    shift = (fine.x - fit.x) * (np.diag(fine.covariance) > 0)
    return replace(fine, covariance=fine.covariance + np.outer(shift, shift))


def keep_kinds(data: LoopData, kept: Sequence[str]) -> LoopUnknowns:
    """Return the unknowns of some kinds, the others at the law's values."""
    u = data.unknowns
    rows = [k for k, kind in enumerate(u.kinds) if kind in kept]
    values = {key: np.array(value) for key, value in u.values.items()}
    for kind in u.kinds:
        if kind not in kept:
            values[kind] = np.array(data.law.values[kind])
    return replace(
        u, values=values, kinds=tuple(u.kinds[k] for k in rows), free=u.free[rows], lower=u.lower[rows], upper=u.upper[rows],
        prior=u.prior[rows],
    )  # fmt: skip
