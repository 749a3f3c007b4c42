"""Input data of a fit through the loop, and the problem that it solves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from tau_dyn.model import Model
from tau_dyn.servo.fit import FINE_DIFFERENCES, LoopFit, LoopProblem, Slopes, fit_loop
from tau_dyn.servo.loads import InertialSpace, LoadWaves, compute_load_waves
from tau_dyn.servo.prediction import SimulatedMotion, differentiate_coupled, simulate_coupled
from tau_dyn.servo.records import LoopRecord, build_waves, split_pieces
from tau_dyn.servo.unknowns import LoopUnknowns
from tau_dyn.servo.waves import MAX_STEP_S, SPRING_STEP_S, Trials, Waves
from tau_dyn.simulate import COMMANDS, ServoLaw

BASELINE = ("armature", "coulomb", "viscous", "offset")
"""Entries of a simulation before any cause, which are fitted first."""
_ITERATIONS = 6  # from a solution of nearly the same problem
_FIRST_ITERATIONS = 10  # from a start, before it is compared with others
_LESS_FRICTION = 0.3  # share of Coulomb friction with which a fit also starts
EXACT_STEP_S = 5e-4
"""Shortest step of exact motions [s]."""
STEP_PER_ROOT = 0.022
"""Step of exact motions over the root of the residual [s / sqrt(rad)]: steps of 1 ms cause an error of about 0.02 mrad, which
grows with the square of the step, so that the error is a hundredth of the residual."""
STEP_RATIO = 4.0
"""Step of the fits over that of exact motions."""
LARGE_RESIDUAL_RAD = 1.6e-3
"""Median residual of the joints from which model errors outweigh the errors of long steps, of large differences and of loads
along the measured motion."""
MAX_SETTLINGS = 14
"""Largest number of fits, each corrected by exact motions of the previous solution; three are usual, ten for long chains."""
LOADS_ANEW = 2
"""Number of such fits that evaluate loads along the last exact motions; later ones change too little for their
sensitivities."""
STILL_FALLING = 0.05
"""Relative change of a joint's residual in the last such fit, from which later ones recompute their loads, too."""
MAX_JOINT_SECONDS = 1500.0
"""Unknowns times joints times seconds of logs up to which springs are fitted with sensitivities of all joints: minutes."""
SEARCH_S = 150.0
"""Duration of the logs in which causes are searched [s], in pieces of 10 s: a hundred blocks of 1.5 s."""
MIXED = 8
"""Largest number of solutions that are combined into the next start."""
RMS_TOLERANCE = 1e-4
"""Relative change of every joint's residual below which loads count as converged: with large model errors, unknowns drift."""
SETTLED = 0.1
"""Change of every unknown over its standard error below which its loads count as converged."""


class ExactMotions(NamedTuple):
    """Exact motions of all logs, and their trial."""

    motions: tuple[SimulatedMotion, ...]
    trials: Trials


class _Built(NamedTuple):
    """Waves, and the positions, commands, loads, law and wholeness from which they were built."""

    key: tuple[object, ...]
    waves: Waves


@dataclass(frozen=True, eq=False)
class LoopData:
    """All data from which a fit starts.

    Attributes:
        model: Robot and friction, at start values.
        law: The servo's law.
        space: Inertial numbers, with the directions that are unknowns.
        records: Training logs.
        loads: Loads along them.
        unknowns: The unknowns of the fit.
        settled: Exact motions at one solution, with which a problem is corrected; None before a first fit.
        whole: Whether logs are simulated from start to end rather than in pieces: behind a spring no measured position gives
            the initial state of a piece, and a loop without a position error never forgets it.
        step: Longest step of the simulated loops [s].
        built: The waves that were built last, which all problems with the same motions and loads share.
    """

    model: Model
    law: ServoLaw
    space: InertialSpace
    records: Sequence[LoopRecord]
    loads: Sequence[LoadWaves]
    unknowns: LoopUnknowns
    settled: ExactMotions | None = None
    whole: bool = False
    step: float = MAX_STEP_S
    built: dict[str, _Built] = field(default_factory=dict)

    def build_problem(
        self, unknowns: LoopUnknowns | None = None, records: Sequence[LoopRecord] | None = None
    ) -> LoopProblem:
        """Return the fit's problem, with other unknowns or other masks if given."""
        records = records or self.records
        pieces, loads = (records, self.loads) if self.whole else split_pieces(records, self.loads)
        key = (*(r.q for r in records), *(r.command for r in records), *self.loads, self.law, self.whole)
        last = self.built.get("last")
        if last is None or len(last.key) != len(key) or any(x is not y for x, y in zip(last.key, key, strict=True)):
            self.built["last"] = last = _Built(key, build_waves(pieces, loads, self.law))
        problem = LoopProblem(unknowns or self.unknowns, last.waves, pieces).with_step(self.step)
        if self.settled is None:
            return problem
        exact = [replace(r, q=m.q) for r, m in zip(records, self.settled.motions, strict=True)]
        exact = exact if self.whole else split_pieces(exact, self.loads)[0]
        return problem.correct([r.q for r in exact], self.settled.trials)

    def pick(self, chosen: Sequence[int]) -> LoopData:
        """Return the data of some logs."""
        settled = self.settled and self.settled._replace(motions=tuple(self.settled.motions[k] for k in chosen))
        records, loads = ([rows[k] for k in chosen] for rows in (self.records, self.loads))
        return replace(self, records=records, loads=loads, settled=settled)

    def shorten(self) -> LoopData:
        """Return the data of pieces spread evenly over long logs; all data if a loop never forgets its initial state."""
        total = sum(len(r.t) * r.dt for r in self.records)
        if self.law.command != COMMANDS[0] or total <= SEARCH_S:
            return self
        pieces, loads = split_pieces(self.records, self.loads, np.inf)
        count = round(len(pieces) * SEARCH_S / total)
        chosen = np.round(np.linspace(0, len(pieces) - 1, count)).astype(int)
        return replace(self, records=[pieces[k] for k in chosen], loads=[loads[k] for k in chosen])

    @property
    def is_shaken(self) -> bool:
        """Whether links on springs excite each other, in logs short enough to fit all joints' sensitivities."""
        seconds = sum(len(r.t) * r.dt for r in self.records)
        na = len(self.law.joints)
        return self.unknowns.is_flexible and na > 1 and self.unknowns.n * na * seconds < MAX_JOINT_SECONDS

    def compute_exact_step(self, fit: LoopFit) -> float:
        """Return the longest step of exact motions near a solution [s]."""
        return float(np.clip(STEP_PER_ROOT * np.sqrt(np.median(fit.sigma)), EXACT_STEP_S, self.step / STEP_RATIO))

    def with_fine_steps(self, fit: LoopFit) -> LoopData:
        """Return the data with steps as short as the residual of a fit requires if springs are possible, never longer."""
        step = float(np.clip(STEP_RATIO * STEP_PER_ROOT * np.sqrt(np.median(fit.sigma)), SPRING_STEP_S, self.step))
        many, few = (np.ceil(max(r.dt for r in self.records) / x - 1e-9) for x in (step, self.step))
        return replace(self, step=step) if many > few else self

    def with_exact_motions(self, fit: LoopFit, with_loads: bool = True) -> LoopData:
        """Return the data with the motions of a solution, and with loads along them or the old ones."""
        u, space = self.unknowns, self.space
        inertial, values = fit.x[u.n - space.n_unknowns :], u.with_values(fit.x)
        step = self.compute_exact_step(fit)
        motions = simulate_coupled(space, inertial, values, self.law, self.records, step)
        loads = self.loads
        if with_loads:
            loads = [
                replace(compute_load_waves(space, m.link, m.v, m.a, r.dt), speed=m.v)
                for m, r in zip(motions, self.records, strict=True)
            ]
        trials = Trials({key: value[:, None] for key, value in values.items()}, inertial[:, None])
        return replace(
            self, loads=loads, settled=ExactMotions(tuple(motions), trials), step=min(self.step, STEP_RATIO * step)
        )


class CoupledProblem(LoopProblem):
    """Residuals of exact motions, and sensitivities of every joint to every unknown: links on springs excite each other."""

    def __init__(self, data: LoopData, step: float) -> None:
        """Prepare, with the longest step of the loops [s]."""
        super().__init__(data.unknowns, build_waves(data.records, data.loads, data.law), data.records)
        self.waves = replace(self.waves, step=step)
        self._data, self.share_of_steps = data, FINE_DIFFERENCES

    def simulate(self, x: np.ndarray) -> np.ndarray:
        """Return positions (M, na, C, S) at vectors (n, C)."""
        d, (values, inertial), found = self._data, self.unknowns.unpack(x), []
        for c in range(x.shape[1]):
            one = {key: value[:, c] for key, value in values.items()}
            motions = simulate_coupled(d.space, inertial[:, c], one, d.law, d.records, self.waves.step)
            found.append(self.pick([m.q for m in motions]))
        return np.stack(found, axis=2)

    def differentiate(self, x: np.ndarray) -> tuple[np.ndarray, Slopes]:
        """Return the residual (M, na, S) and the sensitivities at a vector (n,)."""
        d, steps = self._data, self.list_steps(x)
        values, inertial = self.unknowns.unpack(np.column_stack([x, x[:, None] + np.diag(steps)]))
        moved = differentiate_coupled(d.space, Trials(values, inertial), d.law, d.records, self.waves.step)
        change = np.stack([self.pick([m[:, :, c] for m in moved]) for c in range(1, len(x) + 1)], axis=0)
        change = np.where(self.used[None, :, None, :], change, 0.0) / -steps[:, None, None, None]
        rows = [change[:, :, j].transpose(0, 2, 1).reshape(len(x), -1) for j in range(change.shape[2])]
        self.slopes = Slopes(x, rows, [np.arange(len(x))] * len(rows))
        return self.residuals(x[:, None])[:, :, 0], self.slopes


class Mixing:
    """Anderson mixing: iterates of a search for a fixed point of a map, combined into the next point as if the map were linear.

    Joints of a long chain influence each other over many fits; the slopes found in one search are valid for the next.
    Reference: Anderson 1965; Walker & Ni 2011.
    """

    def __init__(self) -> None:
        """Start without iterates."""
        self._gaps: list[np.ndarray] = []
        self._ways: list[np.ndarray] = []

    def mix(self, points: Sequence[np.ndarray], answers: Sequence[np.ndarray], scale: np.ndarray) -> np.ndarray:
        """Return the next point (n,) after the last ones (n,) and their images under the map, in units of a scale (n,)."""
        gap = answers[-1] - points[-1]
        if len(points) > 1:
            self._gaps = [*self._gaps[1 - MIXED :], gap - (answers[-2] - points[-2])]
            self._ways = [*self._ways[1 - MIXED :], answers[-1] - answers[-2]]
        if not self._gaps:
            return answers[-1]
        weight = np.divide(1.0, scale, out=np.zeros(len(scale)), where=scale > 0)
        share = np.linalg.lstsq((np.array(self._gaps) * weight).T, gap * weight, rcond=1e-8)[0]
        return answers[-1] - share @ np.array(self._ways)


def is_large(fit: LoopFit) -> bool:
    """Return whether model errors outweigh the errors of long steps, large differences and measured loads."""
    return float(np.median(fit.sigma)) > LARGE_RESIDUAL_RAD


def fit_coupled(
    data: LoopData,
    progress: Callable[[str], None] = lambda step: None,
    fit: LoopFit | None = None,
    settled: float = SETTLED,
    mixing: Mixing | None = None,
) -> tuple[LoopData, LoopFit]:
    """Return the data and the end of a search whose loads and steps are exact where it ends (defect correction).

    The first fit, unless one is given, takes the loads between joints along the measured motion, whose accelerations are
    filtered and noisy. Each following fit adds the corrections from finer steps and from loads along the motion that the last
    one simulates. If model errors are much larger than these corrections, the first fit is the last, except with springs:
    filters remove the accelerations of an oscillating link. Two such fits follow in that case, and they are kept if every
    joint's residual is smaller. Links on springs excite each other, so that a last fit (Gauss-Newton) takes sensitivities of
    all joints.
    Reference: Stetter 1978.
    """
    last = None
    if fit is None:
        last = data.build_problem()
        fit = fit_from_starts(last, progress)
    large = is_large(fit)
    if large and not data.unknowns.is_flexible:
        return data, fit
    measured, before = (data, fit), fit
    mixing = mixing or Mixing()
    points, answers, x = [], [], fit.x
    for k in range(LOADS_ANEW if data.is_shaken else MAX_SETTLINGS):
        data = data.with_exact_motions(
            replace(fit, x=x), with_loads=k < LOADS_ANEW or not _is_alike(fit.sigma, before.sigma, STILL_FALLING)
        )
        problem = data.build_problem()
        problem = problem.with_finer_differences() if data.whole else problem
        last = problem.take_slopes(last)
        before, fit = fit, fit_loop(last, progress, _ITERATIONS, x)
        sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
        if np.all(np.abs(fit.x - x) <= settled * sigma + 1e-12) or _is_alike(fit.sigma, before.sigma, RMS_TOLERANCE):
            break
        if k + 1 == LOADS_ANEW and is_large(fit):
            break
        points, answers = [*points, x], [*answers, fit.x]
        x = last.unknowns.clip(mixing.mix(points, answers, sigma))
    if data.is_shaken:
        whole = fit_loop(CoupledProblem(data, data.compute_exact_step(fit)), progress, first=fit.x)
        if np.log(whole.sigma / fit.sigma).sum() <= 0:
            data, fit = data.with_exact_motions(whole), whole
    return measured if large and np.any(fit.sigma > measured[1].sigma) else (data, fit)


def fit_from_starts(problem: LoopProblem, progress: Callable[[str], None]) -> LoopFit:
    """Return the fit of smallest residual from several starts, if the residual of the first one is large.

    A joint that static friction holds in the simulation, or that moves at another time than in the log, has no slope towards
    the solution: fits start again with less Coulomb friction and without the screened delay.
    """
    fit, u = fit_loop(problem, progress), problem.unknowns
    if not is_large(fit):
        return fit
    lower: dict[str, list[float]] = {"coulomb": [1.0, _LESS_FRICTION], "command_delay": [1.0, 0.0]}
    shares = [lower.get(kind, [1.0]) for kind in u.kinds]
    start, fits = u.pack(), [fit]
    for row in list(product(*shares))[1:]:
        values = {
            kind: np.where(free, share * u.values[kind], u.values[kind])
            for kind, share, free in zip(u.kinds, row, u.free, strict=True)
        }
        other = copy(problem)
        other.unknowns = replace(u, values={**u.values, **values})
        if np.any(other.unknowns.pack() != start):
            near = fit_loop(other, progress, _FIRST_ITERATIONS)
            fits.append(fit_loop(problem, progress, first=near.x))
    return min(fits, key=lambda one: float(np.log(one.sigma).sum()))


def _is_alike(sigma: np.ndarray, before: np.ndarray, share: float) -> bool:
    return bool(np.all(np.abs(sigma - before) < share * before))


def fit_precisely(
    problem: LoopProblem, progress: Callable[[str], None], is_enough: Callable[[LoopFit], bool] = lambda near: False
) -> LoopFit:
    """Return a fit whose last part uses small differences, unless the first part is sufficient because its residual is large."""
    near = fit_loop(problem, progress)
    if is_large(near) and is_enough(near):
        return near
    return fit_loop(problem.with_finer_differences(), progress, first=near.x)


def refit_again(problem: LoopProblem, fit: LoopFit, progress: Callable[[str], None]) -> LoopFit:
    """Return a repeated fit of a better problem; its change is added to the uncertainty."""
    fine = fit_loop(problem.with_finer_differences(), progress, _ITERATIONS, fit.x)
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
