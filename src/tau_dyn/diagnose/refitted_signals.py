"""Signals that a fitted model predicts for causes that change its weakly determined parameters.

A turned gravity, a wrong zero or a saturated drive depends on combinations of masses that no force under nominal gravity shows.
A fit without the cause changes weakly determined combinations to explain it. So the values are refitted together with the
cause, as near the nominal ones as the data permit, and the cause's forces are computed with these. A wrong zero is not a small
change of the positions: it is estimated together with all values by Gauss-Newton steps on the regression of the training logs
(Ljung 1999, 10.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.effects import compute_shifted_forces, interpolate_shifts
from tau_dyn.estimate import RegressionRun, scale_columns
from tau_dyn.evidence import MIN_UNABSORBED_SHARE
from tau_dyn.exceptions import LoopClosureError
from tau_dyn.identify import PreparedSegment
from tau_dyn.legged import compute_imu_turn
from tau_dyn.log import decimate
from tau_dyn.mechanism import Mechanism
from tau_dyn.model import Model

_MAX_ROWS = 8000
"""Samples from which values are estimated: many times the number of parameters."""
_MAX_SHIFTED_SAMPLES = 600
"""Samples of all joints from which zeros are estimated; the positions' shift is smooth, and the exact columns are made
afterwards."""
_MIN_RELATIVE_NORM = 1e-7
"""Size of a column, relative to the largest, below which it is a rounding of the robot file."""
_WEIGHING = ("mass", "mx", "my", "mz")
_STIFFNESS = 30.0
"""Factor by which masses and first moments absorb less of a misfit than inertias, if either can. An unknown drive inertia is
part of the bodies' inertia, and masses of the robot file are more accurate."""
_GAUSS_NEWTON_STEPS = 10
"""Steps of a zero's search; from 0.3 rad five of them reach its rounding."""
_MAX_STEP = 0.3
"""Largest step of a zero in multiples of one [m or rad]; the law is not linear beyond."""
_CONVERGED = 1e-6
"""Step of a zero below which its search ends [m or rad], far below what forces show."""
_SATURATION_PASSES = 3
"""Number of refits with a saturation; each of them reduces the error of the force by the share of the saturation."""


def interpolate_smooth(piece: PreparedSegment, compute: Callable[..., np.ndarray]) -> np.ndarray:
    """Return smooth signals computed from positions, speeds and accelerations; the regression's rate is enough for them.

    Steps of a walking robot's feet are no smooth motion.
    """
    m, t = piece.motion, piece.log.t
    if piece.contacts is not None:
        return compute(m.q, m.v, m.a)
    few = np.unique(np.append(np.arange(0, len(t), piece.factor), len(t) - 1))
    return np.asarray(CubicSpline(t[few], compute(m.q[few], m.v[few], m.a[few]))(t))


@dataclass(frozen=True, eq=False)
class RefittedModel:
    """A fitted model and the training logs to which it is refitted together with a cause.

    Attributes:
        model: The model at fitted values.
        nominal: Values before any fit (p,).
        prepared: All pieces.
        runs: Their regressions.
        trained: Whether a piece belongs to a training log.
        source: The refits whose values are used if an effect was fitted to other pieces; None to refit to these.
    """

    model: Model
    nominal: np.ndarray
    prepared: tuple[PreparedSegment, ...]
    runs: tuple[RegressionRun, ...]
    trained: tuple[bool, ...]
    source: RefittedModel | None = None

    @cached_property
    def gravity_turns(self) -> list[np.ndarray]:
        """Forces at rest (N, na, 2) of each piece per turn of gravity."""
        near = self._at_turned_values()
        return [interpolate_smooth(p, lambda q, v, a: near.gravity_turn(q)) for p in self.prepared]

    @cached_property
    def imu_turns(self) -> list[np.ndarray]:
        """Change of forces (N, na, 2) of each piece per turn of a floating base against its logged axes."""
        near = self._at_turned_values()
        return [interpolate_smooth(p, lambda q, v, a: compute_imu_turn(near, q, v, a)) for p in self.prepared]

    def _at_turned_values(self) -> Mechanism:
        return self.model.with_parameters(self.model.parameters.with_values(self.turned_values)).mechanism

    @cached_property
    def turned_values(self) -> np.ndarray:
        """Values (p,) of a refit that includes a turn of gravity."""
        if self.source is not None:
            return self.source.turned_values
        turns = [interpolate_smooth(p, lambda q, v, a: self.model.mechanism.gravity_turn(q)) for p in self.prepared]
        columns = [p.columns(turn, gated=False) for p, turn in zip(self.prepared, turns, strict=True)]
        return self._refit_beside(columns)

    def _refit_beside(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        """Return the values (p,) nearest the nominal ones in a fit together with columns (n, na, k) of each piece."""
        parts = zip(self.runs, columns, self.trained, strict=True)
        rows = [
            (np.concatenate([run.W_all, more], axis=2)[run.usable], (run.y_all - run.W_all @ self.nominal)[run.usable])
            for run, more, mine in parts
            if mine
        ]
        W, e = (np.concatenate(x) for x in zip(*rows, strict=True))
        every = 1 + len(W) // _MAX_ROWS
        return self.nominal + self._solve_near(W[::every], e[::every])

    def _solve_near(self, W: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the smallest change of the values (p,) that explains rows `e` (R,); columns (R, p + k) beyond them are free."""
        p = len(self.nominal)
        free = np.append(self.model.parameters.free, np.ones(W.shape[1] - p, bool))
        norm = np.linalg.norm(W, axis=0) * free
        unit = np.where(norm > _MIN_RELATIVE_NORM * norm.max(initial=0.0), norm, np.inf)
        names = self.model.parameters.names
        unit[:p] *= np.where([n.rsplit(".", 1)[-1] in _WEIGHING for n in names], _STIFFNESS, 1.0)
        return (np.linalg.lstsq(W / unit, e, rcond=1e-4)[0] / unit)[:p]

    @cached_property
    def delivered(self) -> np.ndarray:
        """Change of the fitted values (p,) by a refit with a saturation of every drive."""
        if self.source is not None:
            return self.source.delivered
        values = fitted = self.model.parameters.values
        for _ in range(_SATURATION_PASSES):
            forces = [run.W_all @ values for run in self.runs]
            largest = self.find_largest(forces)
            cubes = [[_lay_by_joint(f * (f / largest) ** 2)] for f in forces]
            values = self._refit_beside([made for (made,) in cubes])
        return values - fitted

    def find_largest(self, forces: Sequence[np.ndarray]) -> np.ndarray:
        """Return the largest force (na,) of the training pieces from forces (n, na) of all."""
        sizes = [np.abs(f).max(axis=0) for f, mine in zip(forces, self.trained, strict=True) if mine]
        return np.maximum(np.max(sizes, axis=0), 1e-300)

    @cached_property
    def largest(self) -> np.ndarray:
        """The largest force (na,) of the drives in the training logs."""
        if self.source is not None:
            return self.source.largest
        values = self.model.parameters.values + self.delivered
        return self.find_largest([run.W_all @ values for run in self.runs])

    @cached_property
    def zeros(self) -> np.ndarray:
        """Best-fitting position error of each joint (na,), values refitted; zero if forces cannot separate it from them."""
        return np.array([search.find_zero() for search in self._searches])

    @cached_property
    def _searches(self) -> list[_ZeroSearch]:
        units = self.model.robot.force_units
        return [_ZeroSearch.of(self, k, unit) for k, unit in enumerate(units)]

    @cached_property
    def shifted_forces(self) -> list[np.ndarray]:
        """Change (N, na, na, 4) of each piece's forces at displaced positions, each joint's by values refitted at its zero."""
        values = self.shifted_values
        return [interpolate_smooth(p, lambda q, v, a: self._shift_all(q, v, a, values)) for p in self.prepared]

    @cached_property
    def shifted_values(self) -> list[np.ndarray]:
        """Values (p,) refitted at the zero of each joint."""
        if self.source is not None:
            return self.source.shifted_values
        return [
            self.nominal + self._solve_near(*search.residual_rows(zero, self.nominal))
            for search, zero in zip(self._searches, self.zeros, strict=True)
        ]

    def _shift_all(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, values: Sequence[np.ndarray]) -> np.ndarray:
        """Return the change (N, na, na, 4) of the forces at positions displaced joint by joint, at values (p,) for each joint."""
        found = []
        for k, unit in enumerate(self.model.robot.force_units):
            rigid = values[k][: len(self.model.robot.parameters)]
            found.append(shift_safely(lambda x, pi=rigid: self.model.mechanism.regressor(x, v, a) @ pi, q, k, unit))
        return np.stack(found, axis=2)


def shift_safely(force: Callable[[np.ndarray], np.ndarray], q: np.ndarray, joint: int, unit: str) -> np.ndarray:
    """Return the change of a function at displaced positions; zero if a loop does not close there or the change is rounding."""
    here = force(q)
    try:
        found = compute_shifted_forces(force, q, joint, unit)
    except LoopClosureError:
        return np.zeros((*here.shape, 4))
    is_felt = np.abs(found).max(initial=0.0) > _MIN_RELATIVE_NORM * np.abs(here).max(initial=0.0)
    return found if is_felt else np.zeros_like(found)


def _lay_by_joint(x: np.ndarray) -> np.ndarray:
    """Return values (n, na) as columns (n, na, na), each of which acts on its own joint."""
    return x[:, :, None] * np.eye(x.shape[1])


@dataclass(frozen=True, eq=False)
class _ZeroSearch:
    """Rows from which the zero of one joint is estimated.

    Attributes:
        W: Weighted columns (R, p).
        changes: Their change at the four shifts (R, p, 4).
        y: Weighted forces (R,).
        free: Which parameters are refitted (p,).
        values: Values of the others (p,).
        unit: The joint's force unit.
    """

    W: np.ndarray
    changes: np.ndarray
    y: np.ndarray
    free: np.ndarray
    values: np.ndarray
    unit: str

    @classmethod
    def of(cls, refitted: RefittedModel, joint: int, unit: str) -> _ZeroSearch:
        """Collect decimated rows of the training pieces, each output divided by the rms of its baseline residual."""
        model = refitted.model
        total = sum(len(run.t) for run, mine in zip(refitted.runs, refitted.trained, strict=True) if mine)
        every, rows = 1 + total // _MAX_SHIFTED_SAMPLES, []
        values = model.parameters.values
        for piece, run, mine in zip(refitted.prepared, refitted.runs, refitted.trained, strict=True):
            if not mine:
                continue
            few = slice(None, None, every)
            q, v, a = (decimate(x, piece.factor)[few] for x in (piece.motion.q, piece.motion.v, piece.motion.a))
            changes = np.zeros((*run.W_all[few].shape, 4))
            rigid = len(model.robot.parameters)
            changes[:, :, :rigid] = shift_safely(lambda x, v=v, a=a: model.mechanism.regressor(x, v, a), q, joint, unit)
            left = run.y_all - run.W_all @ values
            size = np.sqrt(
                [np.mean(e[m] ** 2) if m.any() else np.inf for e, m in zip(left.T, run.usable.T, strict=True)]
            )
            weight = 1 / np.maximum(size, 1e-12 * np.abs(run.y_all).max(initial=1e-300))
            usable = run.usable[few]
            scale = np.broadcast_to(weight, usable.shape)[usable]
            rows.append(
                (
                    run.W_all[few][usable] * scale[:, None],
                    changes[usable] * scale[:, None, None],
                    run.y_all[few][usable] * scale,
                )
            )
        W, changes, y = (np.concatenate(x) for x in zip(*rows, strict=True))
        return cls(W, changes, y, np.asarray(model.parameters.free), values, unit)

    def residual_rows(self, zero: float, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return columns (R, p) at a zero and the residual (R,) of values (p,) there."""
        W = self._columns(zero)
        return W, self.y - W @ values

    def _columns(self, zero: float) -> np.ndarray:
        return self.W + self.changes @ (zero * interpolate_shifts(zero, self.unit))

    def find_zero(self) -> float:
        """Return the zero error of least misfit near zero, by Gauss-Newton steps that are halved until the misfit falls."""
        zero, (cost, step) = 0.0, self._step(0.0)
        for _ in range(_GAUSS_NEWTON_STEPS):
            if abs(step) < _CONVERGED:
                break
            lower, following = self._step(zero + step)
            if lower < cost:
                zero, cost, step = zero + step, lower, following
            else:
                step /= 2
        return zero

    def _step(self, zero: float) -> tuple[float, float]:
        """Return the misfit at a zero error, values refitted, and the Gauss-Newton step; it is zero where bodies are an alias."""
        W = self._columns(zero)
        unit, norm = scale_columns(W[:, self.free])
        theta = np.array(self.values)
        y = self.y - W[:, ~self.free] @ theta[~self.free]
        theta[self.free] = np.linalg.lstsq(unit, y, rcond=1e-9)[0] / norm
        e, h = self.y - W @ theta, 1e-4
        ends = [(zero + x) * interpolate_shifts(zero + x, self.unit) for x in (h, -h)]
        slope = self.changes @ ((ends[0] - ends[1]) / (2 * h)) @ theta
        left = slope - unit @ np.linalg.lstsq(unit, slope, rcond=1e-9)[0]
        square = float(left @ left)
        if not square > MIN_UNABSORBED_SHARE * float(slope @ slope):
            return float(e @ e), 0.0
        return float(e @ e), float(np.clip(left @ e / square, -_MAX_STEP, _MAX_STEP))
