"""Inertial numbers of a robot file with their unknowns, and the loads of the robot along a motion, for the loop.

The inertial numbers have an uncertainty, a quarter of each body's size unless the file or `--fix` states another; only the
directions in which logs inform more than that are unknowns (a likelihood-informed subspace), so that a fit cannot drift in
directions without information.
Reference: Cui, Martin, Marzouk, Solonen & Spantini 2014.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import interp1d

from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import BodyPrior
from tau_dyn.servo.consistent_bodies import ConsistentBodies
from tau_dyn.servo.waves import LoadRows

SLOW_S = 0.04
"""Time over which own inertia and stiffness may be interpolated [s]: positions change by less than 0.1 rad."""
LOAD_S = 2e-3
"""Time between the loads of coupled joints [s]: speeds change by a few per cent of their peaks in it."""
ROWS = 20_000
"""Number of samples whose regressors are computed at once: 60 MB for an arm of six joints."""


@dataclass(frozen=True, eq=False)
class InertialSpace:
    """Inertial numbers of the robot file, and the directions in which they may differ.

    Attributes:
        model: The model; drive inertias are not included.
        nominal: Its parameters, drive inertias at zero (p,).
        directions: Changes of the parameters (p, K) for one unit of each unknown, one standard deviation of prior knowledge.
        prior: Standard deviations of the parameters (p,) before the fit; zero for fixed ones.
    """

    model: Model
    nominal: np.ndarray
    directions: np.ndarray
    prior: np.ndarray

    @classmethod
    def of(cls, model: Model) -> InertialSpace:
        """Return the space of a model, without unknowns."""
        parameters, known = model.robot.parameters, BodyPrior.of(model.robot).rough
        nominal, prior = np.zeros((2, len(parameters)))
        for k, p in enumerate(parameters):
            if not p.name.endswith(".armature"):
                nominal[k] = p.value
                given = p.prior_stderr if p.prior_stderr is not None else known.get(p.name, 0.0)
                prior[k] = given if p.free or p.prior_stderr is not None else 0.0
        return cls(model, nominal, np.zeros((len(parameters), 0)), prior)

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return self.directions.shape[1]

    @property
    def basis(self) -> np.ndarray:
        """The nominal values and the directions (p, 1 + K)."""
        return np.column_stack([self.nominal, self.directions])

    @cached_property
    def bodies(self) -> ConsistentBodies:
        """The constraint that keeps bodies physically consistent."""
        robot = self.model.robot
        return ConsistentBodies(robot.links, robot.parameters.names, self.nominal, self.prior, self.directions)

    def at(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the parameters (p,) at unknowns (K,); directions without information keep the bodies consistent."""
        theta = self.nominal + self.directions @ unknowns
        found = self.bodies.find(unknowns) if len(unknowns) else None
        return theta if found is None else theta + self.bodies.within @ found.w

    def build_mechanism(self, unknowns: np.ndarray | None = None) -> Mechanism:
        """Return the robot's dynamics at unknowns (K,), or at the nominal values, without drive inertias."""
        robot, values = self.model.robot, self.nominal if unknowns is None else self.at(unknowns)
        return build_mechanism(robot.with_parameters(robot.parameters.with_values(values)))


@dataclass(frozen=True, eq=False)
class LoadWaves:
    """Loads of a robot along one motion, per column of a basis (p, m) of its inertial parameters: see `Waves`.

    Attributes:
        load: Torque besides the own inertia (N, na, m) [N m per unit].
        inertia: Own inertia (N, na, m) [kg m^2 per unit].
        stiffness: Growth of the load with the own position (N, na) at the nominal values [N m/rad].
        along: The motion's positions (N, na) [rad].
        speed: The motion's speeds (N, na) [rad/s], if it is simulated.
    """

    load: np.ndarray
    inertia: np.ndarray
    stiffness: np.ndarray
    along: np.ndarray
    speed: np.ndarray | None = None

    def cut(self, part: slice) -> LoadWaves:
        """Return a part of the waves."""
        speed = None if self.speed is None else self.speed[part]
        return LoadWaves(self.load[part], self.inertia[part], self.stiffness[part], self.along[part], speed)


def compute_load_waves(space: InertialSpace, q: np.ndarray, v: np.ndarray, a: np.ndarray, dt: float) -> LoadWaves:
    """Return loads along a motion (N, na): a column of the nominal values, and one for each unknown."""
    mechanism, basis, (n, na) = space.model.mechanism, space.basis, q.shape
    some = np.unique(np.append(np.arange(0, n, count_slow(dt)), n - 1))
    qs, zero = q[some], np.zeros((len(some), na))
    still = mechanism.regressor(qs, zero, zero)
    columns = [(mechanism.regressor(qs, zero, zero + unit) - still)[:, j] @ basis for j, unit in enumerate(np.eye(na))]
    full, stiffness = (
        _fill_between(some, x, n)
        for x in (np.stack(columns, axis=1), np.einsum("njj->nj", space.build_mechanism().weight_gradient(qs)))
    )
    load = np.empty_like(full)
    for k in range(0, n, ROWS):
        part = slice(k, k + ROWS)
        load[part] = mechanism.regressor(q[part], v[part], a[part]) @ basis - full[part] * a[part, :, None]
    return LoadWaves(load, full, stiffness, q)


def _fill_between(some: np.ndarray, x: np.ndarray, n: int) -> np.ndarray:
    return interp1d(some, x, axis=0, assume_sorted=True)(np.arange(n)) if len(some) > 1 else x[[0] * n]


def fill_coupled_matrices(mechanism: Mechanism, rows: LoadRows, log: int, part: slice, every: int) -> None:
    """Compute a log's mass matrix and slopes of gravity along its motion from one sample to another, inclusive."""
    q = rows.motion[0, part, :, log]
    n, na = len(q) - 1, q.shape[1]
    some = np.minimum(np.arange(0, n + every, every), n)
    mass, slope = mechanism.inertia(q[some]), mechanism.weight_gradient(q[some])
    share = (np.arange(every) / every)[:, None]

    def fill(x: np.ndarray) -> np.ndarray:
        own = np.einsum("njj->nj", x)
        return (own[:-1, None] + share * np.diff(own, axis=0)[:, None]).reshape(-1, na)[:n]

    steps, first = slice(part.start, part.start + n), part.start // every
    rows.inertia[steps, :, log], rows.stiffness[steps, :, log] = fill(mass), fill(slope)
    rows.mass[log, first : first + len(some)], rows.slope[log, first : first + len(some)] = mass, slope


def fill_coupled_loads(mechanism: Mechanism, rows: LoadRows, log: int, part: slice, every: int, dt: float) -> None:
    """Compute a log's loads along its motion from one sample to another, inclusive; accelerations are differences of speed.

    They hold from each sample to the next, and are evaluated at the middle. The force minus that of the interpolated mass
    matrix changes as smoothly as speeds do, so that it is computed every `LOAD_S`.
    """
    q, v = rows.motion[:, part, :, log]
    n = len(q) - 1
    stride = max(1, round(LOAD_S / dt))
    at = np.unique(np.append(np.arange(0, n, stride), n - 1))
    a = (v[at + 1] - v[at]) / dt
    tau = mechanism.inverse_dynamics(0.5 * (q[at + 1] + q[at]), (q[at + 1] - q[at]) / dt, a)
    row, share = part.start // every + at // every, ((at % every) / every)[:, None, None]
    M = (1 - share) * rows.mass[log, row] + share * rows.mass[log, row + 1]
    rows.along[part, :, log] = q
    rows.load[part.start : part.start + n, :, log] = _fill_between(at, tau - np.einsum("nij,nj->ni", M, a), n)


def count_slow(dt: float) -> int:
    """Return the samples over which inertias and stiffness may be interpolated."""
    return max(1, round(SLOW_S / dt))
