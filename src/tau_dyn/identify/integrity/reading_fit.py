"""The whole-robot fit of a log under one reading of its columns: samples, regressors, prior, and the log marginal likelihood.

Unknowns are the bodies, with the robot file as a prior (`BodyPrior.rough`), drive inertia and friction not below zero, and an
offset of each drive. Friction is `offset + coulomb sign(v) + viscous_pos v (v > 0) + viscous_neg v (v < 0)`: the sum of both
directions' Coulomb friction is positive, while a current sensor's offset may exceed it. The residual's standard deviation of
each joint is a free scale, at least a share of the joint's force. The evidence rule is in `evidence/readings.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb

import numpy as np
from scipy.optimize import lsq_linear

from tau_dyn.evidence import NATS_PER_NUMBER, ReadingFit, ReadingTest, compute_zero_mean_nats
from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.identify.integrity.excerpt import Excerpt, compute_clipped_power
from tau_dyn.identify.integrity.wiring_alternatives import Rewiring, is_within_reach
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.robot import LENGTH_POWERS, BodyPrior, Robot, compute_body_radius, find_placeholders

MODEL_ERROR = 0.05
"""Least residual of a joint, as a share of its force: the effect of compliance, cables and heat in sound robots."""

PAYLOAD_SHARE = 0.2
"""Standard deviation of the mass that the last bodies carry beyond the file, as a share of the robot's mass."""

PAYLOAD_REACH_M = 0.15
"""Distance of a payload's centre from its link's origin, for the size of its moments [m]."""

ROTOR_INERTIA_KG_M2 = 5.0
"""Standard deviation of a geared arm's reflected rotor inertia [kg m^2]; large arms reach 10."""

MIN_MASS_SHARE = 0.3
"""Least mass of a body, as a share of the robot file's; a smaller mass means another unit."""

ZERO_RAD, ZERO_M = 0.1, 0.02
"""Standard deviation of a joint's zero: a coarse homing [rad, m]."""
ZERO_STEP = 1e-3
"""Step of differences by a zero, as a share of it."""

OFFSET_SHARE = 1.0
"""Standard deviation of a drive's constant offset (current sensor, balancing spring), as a share of its force: no mean exceeds
the root mean square."""

FRICTION_SHARE = 3.0
"""Standard deviation of each friction force, as a share of the joint's force: wide, and finite for the marginal likelihood."""

N_COMPARED = 700
"""Samples on which readings are compared."""

MIN_ROWS = 5
"""Least number of samples of a joint that count as evidence."""

SCREENING_STEP = 5
"""All readings are first compared on every fifth of these samples; the best are fitted to all."""

N_DRIVE = 4
"""Columns of a drive: offset, Coulomb friction, viscous friction forward and backward."""


@dataclass(frozen=True, eq=False)
class Design:
    """The columns of every joint for one motion of the robot.

    Attributes:
        speed: Velocities as read (n, na), for friction.
        full: Regressor (n, na, p).
        static: Its part from gravity (n, na, p).
        subtracted: Share of a part that a reading takes as subtracted from forces.
        zeros: Change of the file's force (n, na, na) by a usual error of each joint's zero; None where zeros are right.
    """

    speed: np.ndarray
    full: np.ndarray
    static: np.ndarray
    subtracted: float = 1.0
    zeros: np.ndarray | None = None

    def by_clock(self, factor: float) -> Design:
        """Return the columns where the robot moves `factor` times as fast: forces of motion grow with its square."""
        return Design(factor * self.speed, self.static + factor**2 * (self.full - self.static), self.static)


@dataclass(frozen=True, eq=False)
class LogModel:
    """Samples, prior and effective counts by which readings of one log are compared."""

    robot: Robot
    mechanism: Mechanism
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    used: np.ndarray
    counts: np.ndarray
    mean: np.ndarray
    test: ReadingTest
    is_bare: bool = False

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt, mean: np.ndarray) -> LogModel:
        """Take every n-th sample; `mean` is the mean force of the whole log (na,)."""
        every = max(1, len(excerpt.q) // N_COMPARED)
        used = excerpt.used[::every]
        q, v, a, tau = (x[::every] for x in (excerpt.q, excerpt.v, excerpt.a, excerpt.tau))
        used = used & (used.sum(axis=0) >= MIN_ROWS)
        squares = np.where(used, tau**2, 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
        size = np.sqrt(np.where(squares > 0, squares, 1.0))
        counts = used.sum(axis=0) / 2.0
        return cls(robot, build_mechanism(robot), q, v, a, tau, used, counts, mean, ReadingTest(size, MODEL_ERROR))

    @property
    def size(self) -> np.ndarray:
        """Root mean square force of each column (na,)."""
        return self.test.size

    @cached_property
    def prior(self) -> np.ndarray:
        """Map from independent unknowns of unit variance to parameters (p, n)."""
        return _prior(self.robot, self.is_bare)

    def counted(self, fit: ReadingFit) -> LogModel:
        """Return the model with the effective number of samples that the residual's autocorrelation leaves."""
        counts = [count_independent(fit.residual[self.used[:, k], k]) for k in range(self.robot.na)]
        return replace(self, counts=np.array(counts))

    def estimate_noise(self, fit: ReadingFit) -> np.ndarray:
        """Return the power of white noise in each joint's residual (na,), from its third differences.

        Third differences remove a parabola and multiply the power of white noise by 20. Gaps are left out, and jumps are clipped.
        """
        noise, order = np.zeros(self.robot.na), 3
        growth = comb(2 * order, order)
        for j, used in enumerate(self.used.T):
            whole = np.all(np.lib.stride_tricks.sliding_window_view(used, order + 1), axis=1)
            if np.count_nonzero(whole) >= MIN_ROWS:
                noise[j] = compute_clipped_power(np.diff(fit.residual[:, j], order)[whole], 3.0) / growth
        return noise

    def thinned(self) -> LogModel:
        """Return the model with fewer samples and the same effective number of samples."""
        return self._taking(slice(None, None, SCREENING_STEP), 1.0)

    def bare(self, test: ReadingTest) -> LogModel:
        """Return the model without a payload, to estimate numbers: a payload resembles an error of the torque constant."""
        return replace(self, is_bare=True, test=test)

    def halves(self) -> tuple[LogModel, LogModel]:
        """Return the models of both halves of the log."""
        middle = len(self.q) // 2
        return self._taking(slice(None, middle), 0.5), self._taking(slice(middle, None), 0.5)

    def _taking(self, rows: slice, share: float) -> LogModel:
        q, v, a, tau, used = (x[rows] for x in (self.q, self.v, self.a, self.tau, self.used))
        return replace(self, q=q, v=v, a=a, tau=tau, used=used, counts=share * self.counts)

    def motion(self, reading: Rewiring) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations (n, na) under a reading."""
        q_from = list(reading.q_from)
        q, v, a = (x[:, q_from] / np.array(reading.q_scale) for x in (self.q, self.v, self.a))
        return q, v * reading.t_scale, a * reading.t_scale**2

    def design(self, reading: Rewiring) -> Design | None:
        """Return the columns of a reading's motion; None if the robot cannot move like this.

        A loop is not searched for a closure far beyond a drive's limits: that takes seconds a reading.
        """
        q, v, a = self.motion(reading)
        if self.robot.loops and not all(is_within_reach(self.robot, j, q[:, j]) for j in range(self.robot.na)):
            return None
        rest = np.zeros_like(q)
        try:
            full = self._rigid(reading.gravity, q, v, a)
            static = self._rigid(reading.gravity, q, rest, rest)
        except (LoopClosureError, InputError, np.linalg.LinAlgError):
            return None
        finite = np.all(np.isfinite(full)) and np.all(np.isfinite(static))
        return Design(v, full, static) if finite else None

    def free_zeros(self, design: Design, reading: Rewiring) -> Design | None:
        """Return the columns with the zeros of all joints free, linear about the zeros as read; None if they cannot be moved."""
        usual = [ZERO_RAD if kind == "revolute" else ZERO_M for kind in self.robot.joint_kinds]
        zeros = []
        for j, size in enumerate(usual):
            q = np.array(self.q)
            q[:, reading.q_from[j]] += ZERO_STEP * size * reading.q_scale[j]
            other = replace(self, q=q).design(reading)
            if other is None:
                return None
            zeros.append((other.full - design.full) @ self.robot.parameters.values / ZERO_STEP)
        return replace(design, zeros=np.stack(zeros, axis=2))

    def designs_by_gravity(self, reading: Rewiring, usual: Design) -> Callable[[tuple[float, ...]], Design]:
        """Return the designs by the direction of gravity, in which the regressor is linear."""
        q, _, _ = self.motion(reading)
        rest = np.zeros_like(q)
        moving = usual.full - usual.static
        axes = np.stack([self._rigid(tuple(axis), q, rest, rest) for axis in np.eye(3)])

        def build(gravity: tuple[float, ...]) -> Design:
            static = np.tensordot(np.array(gravity), axes, axes=1)
            return Design(usual.speed, moving + static, static)

        return build

    def fit(self, reading: Rewiring, design: Design | None = None) -> ReadingFit | None:
        """Return the fit of the robot to the log under a reading; None if the robot cannot move like this."""
        design = self.design(reading) if design is None else design
        return None if design is None else self.solve(design, reading)

    def solve(self, design: Design, reading: Rewiring) -> ReadingFit:
        """Return the maximum a posteriori fit, by iterated reweighting of the joints."""
        na, tau_from = self.robot.na, list(reading.tau_from)
        scale, size, counts = np.array(reading.tau_scale), self.size[tau_from], self.counts[tau_from]
        rows = self.used[:, tau_from] & self.used[:, list(reading.q_from)]
        columns, nominal = self._read(design, reading)
        removed = _remove_means(columns, nominal, reading)
        number = rows.sum(axis=0)
        own = [scale[j] * columns[rows[:, j], j] for j in range(na)]
        targets = [self.tau[rows[:, j], tau_from[j]] - scale[j] * nominal[rows[:, j], j] for j in range(na)]
        n_zeros = 0 if design.zeros is None else na
        penalty = np.concatenate([np.ones(self.prior.shape[1] + n_zeros), _weigh_drives(own, size, na)])
        floor, low = (self.test.model_error * size) ** 2, self._low(n_zeros)
        gram, right = [x.T @ x for x in own], [x.T @ y for x, y in zip(own, targets, strict=True)]
        power, residual, held = (0.3 * size) ** 2, targets, np.zeros(len(low), bool)
        A, x = np.diag(penalty), np.zeros(len(low))
        for _ in range(3):
            weight = counts / np.maximum(number, 1) / np.maximum(power, floor)
            A = np.diag(penalty) + np.tensordot(weight, np.array(gram), axes=1)
            x, held = _solve(A, np.tensordot(weight, np.array(right), axes=1), low, held)
            residual = [target - block @ x for target, block in zip(targets, own, strict=True)]
            power = np.array([compute_clipped_power(r, 3.0) for r in residual])
        power = np.where(number < MIN_ROWS, size**2, power)  # no sample, no evidence
        prior = float(penalty @ x**2) / 2
        occam = (np.linalg.slogdet(A)[1] - np.log(penalty).sum()) / 2 + NATS_PER_NUMBER * len(reading.numbers)
        log_posterior = -float(counts @ np.log(np.maximum(power, floor) / size**2)) / 2 - prior
        whole = np.zeros(rows.shape)
        whole.T[rows.T] = np.concatenate(residual)
        zero = compute_zero_mean_nats(self.mean[tau_from], scale * (removed @ np.append(x, 1.0)), size).sum()
        return ReadingFit(log_posterior - occam + float(zero), log_posterior, power, prior, whole)

    def _read(self, design: Design, reading: Rewiring) -> tuple[np.ndarray, np.ndarray]:
        """Return columns of all unknowns (n, na, m) and the file's force (n, na), minus the part that a reading lacks."""
        na, values = self.robot.na, self.robot.parameters.values
        full, force = design.full @ self.prior, design.full @ values
        for j, lack in enumerate(reading.lacks):
            kind = lack.removeprefix("file_")
            if kind in ("gravity", "model"):
                subtracted = design.subtracted * (design.static if kind == "gravity" else design.full)[:, j]
                force[:, j] -= subtracted @ values
                if lack == kind:
                    full[:, j] -= subtracted @ self.prior
        if design.zeros is not None:
            full = np.concatenate([full, design.zeros], axis=2)
        n = full.shape[2]
        columns = np.zeros((len(full), na, n + N_DRIVE * na))
        columns[:, :, :n] = full
        for j in range(na):
            speed = design.speed[:, j]
            forward = speed > 0
            friction = (np.ones(len(speed)), np.where(forward, 1.0, -1.0), speed * forward, speed * ~forward)
            columns[:, j, n + N_DRIVE * j : n + N_DRIVE * (j + 1)] = np.column_stack(friction)
        return columns, force

    def _low(self, n_zeros: int) -> np.ndarray:
        """Return lower bounds of the unknowns, with so many zeros of joints among them."""
        drives = np.tile([-np.inf, 0, 0, 0], self.robot.na)
        return np.concatenate([_bounds(self.robot, self.prior), np.full(n_zeros, -np.inf), drives])

    def _rigid(self, gravity: tuple[float, ...], q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        if not gravity:
            return self.mechanism.regressor(q, v, a)
        model = self.robot.model.copy()
        model.gravity.linear = np.linalg.norm(model.gravity.linear) * np.array(gravity)
        return build_mechanism(replace(self.robot, model=model)).regressor(q, v, a)


def _remove_means(columns: np.ndarray, force: np.ndarray, reading: Rewiring) -> np.ndarray:
    """Subtract the means from columns (n, na, m) and forces (n, na) whose mean was removed; return the means (na, m + 1)."""
    removed = np.zeros((columns.shape[1], columns.shape[2] + 1))
    offsets = range(columns.shape[2] - N_DRIVE * columns.shape[1], columns.shape[2], N_DRIVE)
    for j, lack in enumerate(reading.lacks):
        if lack == "mean":
            removed[j] = [*columns[:, j].mean(axis=0), force[:, j].mean()]
            removed[j, offsets[j]] = 0.0  # a free offset in both readings: the absence of one is no evidence
            columns[:, j] -= removed[j, :-1]
            force[:, j] -= removed[j, -1]
    return removed


def _weigh_drives(own: list[np.ndarray], size: np.ndarray, na: int) -> np.ndarray:
    """Return the prior precisions of the drives' unknowns (4 na,), from their columns and the joints' forces."""
    wide = np.array([OFFSET_SHARE, FRICTION_SHARE, FRICTION_SHARE, FRICTION_SHARE])
    n = own[0].shape[1] - N_DRIVE * na
    drives = [block[:, n + N_DRIVE * j : n + N_DRIVE * (j + 1)] for j, block in enumerate(own)]
    power = np.array([np.mean(x**2, axis=0) if len(x) else np.zeros(N_DRIVE) for x in drives])
    precision = power / (wide * size[:, None]) ** 2
    return np.where(precision > 0, precision, 1.0).ravel()


def _bounds(robot: Robot, prior: np.ndarray) -> np.ndarray:
    """Return lower bounds of the unknowns (n,) of bodies and drive inertia."""
    low = np.full(prior.shape[1], -np.inf)
    unknown = find_placeholders(robot.model)
    placeholders = {name for link in robot.links if link.joint_id in unknown for name in link.names}
    for k, (name, value) in enumerate(zip(robot.parameters.names, robot.parameters.values, strict=True)):
        column = np.flatnonzero(prior[k])
        if name.endswith(".armature") and column.size:
            low[column] = -value / prior[k, column]
        elif name.endswith((".mass", ".ixx", ".iyy", ".izz")) and column.size and value > 0:
            least = 0.0 if name in placeholders else MIN_MASS_SHARE
            low[column] = -(1 - least) * value / prior[k, column]
    return low


def _prior(robot: Robot, is_bare: bool) -> np.ndarray:
    """Return the map from independent unknowns of unit variance to parameters (p, n): `BodyPrior.rough`, more at the last bodies.

    Drive inertia: three times the inertia that the joint moves, and at least 5 kg m^2 if gears reflect a rotor.
    """
    names = robot.parameters.names
    total = sum(max(link.nominal[0], 0.0) for link in robot.links) or 1.0
    parents = {int(robot.model.parents[link.joint_id]) for link in robot.links}
    spread, known = np.zeros(len(names)), BodyPrior.of(robot).rough
    for link in robot.links:
        stderr = np.array([known.get(name, 0.0) for name in link.names])
        if link.joint_id not in parents and not is_bare:
            reach = max(PAYLOAD_REACH_M, compute_body_radius(link, total))
            stderr = np.hypot(stderr, PAYLOAD_SHARE * total * reach ** LENGTH_POWERS[list(link.own)])
        spread[[names.index(name) for name in link.names]] = stderr
    moved = np.abs(np.diagonal(build_mechanism(robot).inertia(robot.home[None])[0]))
    for joint, kind, m in zip(robot.actuated, robot.joint_kinds, moved, strict=True):
        spread[names.index(f"{joint}.armature")] = max(3 * m, ROTOR_INERTIA_KG_M2 if kind == "revolute" else 0.0)
    carried = PAYLOAD_SHARE * sum(link.nominal[0] for link in robot.links)
    spread[[name.endswith(".gravity_mass") for name in names]] = carried
    return np.diag(spread)[:, spread != 0]


def _solve(A: np.ndarray, b: np.ndarray, low: np.ndarray, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minimise x'Ax/2 - b'x within bounds, and return which hold: an active set that is grown, then released.

    It starts from a guess of the set, `held`; Lawson & Hanson 1974.
    """
    scale = np.sqrt(np.maximum(np.diag(A), 1e-300))
    A, b, low = A / np.outer(scale, scale), b / scale, low * scale
    A[np.diag_indices_from(A)] += 1e-10
    held, x = held.copy(), np.zeros(len(b))
    for _ in range(30):
        free = ~held
        x[held] = low[held]
        x[free] = np.linalg.solve(A[np.ix_(free, free)], b[free] - A[np.ix_(free, held)] @ low[held])
        below = free & (x < low - 1e-12)
        pulling = held & (b - A @ x > 1e-9)
        if not below.any() and not pulling.any():
            return x / scale, held
        held |= below
        if not below.any():
            held &= ~pulling
    root = np.linalg.cholesky(A)
    found = lsq_linear(root.T, np.linalg.solve(root, b), bounds=(low, np.inf))
    return found.x / scale, found.active_mask < 0


def count_independent(r: np.ndarray) -> float:
    """Return the number of independent samples in an autocorrelated residual (n,): `n / (1 + 2 sum rho_k)`."""
    n = len(r)
    if n < 10:
        return 0.0
    r = r - r.mean()
    power = np.abs(np.fft.rfft(r, 2 * n)) ** 2
    rho = np.fft.irfft(power)[: n // 2]
    rho = rho / max(rho[0], 1e-300)
    negative = np.flatnonzero(rho < 0.05)
    last = negative[0] if negative.size else len(rho)
    return float(n / (1 + 2 * rho[1:last].sum()))
