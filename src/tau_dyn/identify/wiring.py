"""Do the columns of a log belong to this robot file: signs, joints, scales, and the direction of gravity?

Whole-robot least squares with the file's bodies as a prior (25 % a body), friction and drive inertia not below zero, and a
constant offset of each drive. The log as it is read is compared with logs in which one thing is turned: the sign of a joint's q,
tau, or both; two joints exchanged; a joint's or all forces or positions in another scale; another clock; gravity from another
side. `log p` is the maximum a posteriori log-likelihood with the residual's standard deviation of each joint as a free scale, at
least 5 % of the joint's force:

    log p = -sum_j n_j log(sigma_j) - |u|^2 / 2,      n_j = effective number of samples (autocorrelation)

An alternative is named where it gains more than 30 nats (a Bayes factor of 1e13) and halves the residual's power somewhere, or
where only it spares the bodies. Missing drive inertia, a payload, friction of any asymmetry and bodies 40 % off fit the prior, so
they gain nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import lsq_linear

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.identify.excerpt import Excerpt, compute_clipped_power
from tau_dyn.identify.wiring_alternatives import Rewiring, list_alternatives
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.message_codes import CodedWarning
from tau_dyn.robot import Robot, compute_body_stderr

MIN_GAIN_NATS = 30.0
"""Log-likelihood gain from which an alternative is named; sound logs with bodies 40 % off reach about 5."""

ALIAS_NATS = 5.0
"""Alternatives closer than this cannot be told apart; both are said."""

MODEL_ERROR = 0.05
"""Least residual of a joint, as a share of its force: what compliance, cables and heat leave of sound robots."""

PAYLOAD_SHARE = 0.2
"""Standard deviation of what the last bodies carry beyond the file, as a share of the robot's mass."""

PAYLOAD_REACH_M = 0.15
"""Distance of a payload's centre from its link's origin, for the size of its moments [m]."""

ROTOR_INERTIA_KG_M2 = 5.0
"""Standard deviation of a geared arm's reflected rotor inertia [kg m^2]; large arms reach 10."""

MIN_MASS_SHARE = 0.3
"""No body weighs less than this share of the robot file's mass; lighter ones are another unit."""

OFFSET_SHARE = 0.25
"""Standard deviation of a drive's constant offset (current sensor, balancing spring), as a share of its force."""

FINE_MODEL_ERROR = 0.005
"""The same where an alternative leaves next to nothing of any joint, as only simulated and very good robots do."""

EXPLAINED = 0.02
"""Residual of each joint, as a share of its force, that an alternative must reach to be judged by the finer measure."""

MAX_FINE_SHARE = 0.15
"""Residual of a joint, as a share of its force, from which the coarser measure has already judged all."""

MIN_POWER_DROP = 0.5
"""Share of the residual's power that an alternative leaves of some joint: a model error is not repaired by rewiring."""

MAX_MENDED_SHARE = 0.3
"""Residual that a mend may leave of the joints concerned, as a share of their force; sound robots leave 2 to 15 %. Where a joint
swings nearly free, its force is the small difference of large terms, and no reading of the log explains it."""

SPARED_NATS = 15.0
"""Gain of the prior alone from which an alternative counts without a better fit: bodies as in the file instead of absurd ones."""

MAX_FAULTS = 4
"""So many faults are looked for one after another."""

N_COMPARED = 700
"""Samples on which alternatives are compared."""

MIN_ROWS = 5
"""Fewer samples of a joint are no evidence."""

SCREENING_STEP = 5
"""All alternatives are first compared on every fifth of these samples; the best are fitted to all."""

N_FINALISTS = 8
"""So many of the best are fitted to all samples."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A maximum a posteriori fit: its log-probability, residual power by joint, half the prior's misfit, and effective counts."""

    log_p: float
    power: np.ndarray
    prior: float
    residual: np.ndarray


def check_wiring(robot: Robot, excerpt: Excerpt, name: str) -> list[CodedWarning]:
    """Return what of a log is wired otherwise than the robot file says, each with evidence and mend.

    Args:
        robot: The robot file.
        excerpt: Its log.
        name: The log's name, for the sentences.
    """
    judge = _Judge.of(robot, excerpt)
    for model_error in (MODEL_ERROR, FINE_MODEL_ERROR):
        warnings = _find_faults(replace(judge, model_error=model_error), name)
        if warnings:
            return warnings
    return []


def _find_faults(judge: _Judge, name: str) -> list[CodedWarning]:
    """Return the faults that one after another gain most."""
    robot = judge.robot
    current = Rewiring.none(robot.na)
    warnings: list[CodedWarning] = []
    fit = judge.fit(current)
    if fit is not None:
        judge = judge.counted(fit)
        fit = judge.fit(current)
        if judge.is_hopeless(fit):
            return []
    for _ in range(MAX_FAULTS):
        if fit is not None and judge.most_to_gain(fit) < MIN_GAIN_NATS:
            break
        found = judge.best(current, fit)
        if not found:
            break
        warnings += [_say(robot, name, change, fit, better) for change, better, _ in found]
        current, fit, _ = found[0]
    return warnings


@dataclass(frozen=True, eq=False)
class _Design:
    """The columns of every joint (n_j, p) for one way in which the robot moved, their Gram matrices, and the nominal force."""

    own: list[np.ndarray]
    nominal: list[np.ndarray]
    gram: list[np.ndarray]
    rows: np.ndarray


@dataclass(frozen=True, eq=False)
class _Judge:
    """Samples, prior and counts by which alternatives are compared."""

    robot: Robot
    mechanism: Mechanism
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    used: np.ndarray
    size: np.ndarray
    counts: np.ndarray
    prior: np.ndarray
    low: np.ndarray
    model_error: float = MODEL_ERROR

    @classmethod
    def of(cls, robot: Robot, excerpt: Excerpt) -> _Judge:
        """Take every so manieth sample."""
        every = max(1, len(excerpt.q) // N_COMPARED)
        used = excerpt.used[::every]
        q, v, a, tau = (x[::every] for x in (excerpt.q, excerpt.v, excerpt.a, excerpt.tau))
        used = used & (used.sum(axis=0) >= MIN_ROWS)
        squares = np.where(used, tau**2, 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
        size = np.sqrt(np.where(squares > 0, squares, 1.0))
        counts = used.sum(axis=0) / 2.0
        prior = _prior(robot)
        return cls(robot, build_mechanism(robot), q, v, a, tau, used, size, counts, prior, _bounds(robot, prior))

    def counted(self, fit: _Fit) -> _Judge:
        """Return the judge with the effective number of samples that the residual's autocorrelation leaves."""
        counts = [_effective(fit.residual[self.used[:, k], k]) for k in range(self.robot.na)]
        return replace(self, counts=np.array(counts))

    def thinned(self) -> _Judge:
        """Return the judge with fewer samples that count as much."""
        every = slice(None, None, SCREENING_STEP)
        q, v, a, tau, used = (x[every] for x in (self.q, self.v, self.a, self.tau, self.used))
        return replace(self, q=q, v=v, a=a, tau=tau, used=used)

    def is_hopeless(self, fit: _Fit | None) -> bool:
        """Tell whether no alternative can meet the finer measure: white noise of a joint is too large, or its model too poor."""
        if fit is None or self.model_error >= MODEL_ERROR:
            return False
        share = np.sqrt(fit.power) / self.size
        white = self.counts > 0.5 * self.used.sum(axis=0)
        return bool(np.any((share > EXPLAINED) & white & (self.counts > 0)) or np.any(share > MAX_FINE_SHARE))

    @property
    def floor(self) -> np.ndarray:
        """Least residual power (na,)."""
        return (self.model_error * self.size) ** 2

    def most_to_gain(self, fit: _Fit) -> float:
        """Return what a perfect alternative would gain [nats]."""
        return float(self.counts @ np.log(np.maximum(fit.power, self.floor) / self.floor) / 2 + fit.prior)

    def best(self, current: Rewiring, fit: _Fit | None) -> list[tuple[Rewiring, _Fit, float]]:
        """Return the alternative that gains most, and those that cannot be told from it and have another code."""
        quick = self.thinned()
        design, tried, gravity = quick.design(current), [], self.robot.model.gravity.linear
        by_gravity = (
            quick.build_regressor_by_gravity(current)
            if design is not None and not current.gravity and gravity.any()
            else None
        )
        for change in list_alternatives(self.robot, current, self.q):
            if design is not None and change.moves_as(current):
                other = quick.solve(design, change)
            elif by_gravity is not None and change.code == "gravity_direction":
                other = quick.fit(change, by_gravity(change.gravity))
            else:
                other = quick.fit(change)
            if other is not None:
                tried.append((change, other.log_p))
        tried.sort(key=lambda item: -item[1])
        found = []
        for change, _ in tried[:N_FINALISTS]:
            other = self.fit(change)
            if other is not None and self.accepts(fit, other) and self.is_mended(change, other):
                found.append((change, other, other.log_p - (0.0 if fit is None else fit.log_p)))
        found.sort(key=lambda item: -item[2])
        codes: dict[str, tuple[Rewiring, _Fit, float]] = {}
        for item in found:
            if found[0][2] - item[2] < ALIAS_NATS:
                codes.setdefault(item[0].code, item)
        return list(codes.values())

    def is_mended(self, change: Rewiring, other: _Fit) -> bool:
        """Tell whether the robot explains the forces of the joints concerned once they are read as an alternative says."""
        size = self.size[list(change.tau_from)]
        which = list(change.joints) or list(range(self.robot.na))
        return bool(np.sum(other.power[which]) <= MAX_MENDED_SHARE**2 * np.sum(size[which] ** 2))

    def accepts(self, fit: _Fit | None, other: _Fit) -> bool:
        """Tell whether an alternative is to be named: it gains much, and it mends a joint or spares the bodies."""
        if self.model_error < MODEL_ERROR and np.any(np.sqrt(other.power) > EXPLAINED * self.size):
            return False
        if fit is None:  # as it stands, the robot cannot even reach the positions
            return other.log_p > MIN_GAIN_NATS  # that of a robot which explains nothing of its forces is 0
        floor = self.floor
        drop = np.min(np.maximum(other.power, floor) / np.maximum(fit.power, floor))
        mends = drop < MIN_POWER_DROP or fit.prior - other.prior > SPARED_NATS
        return bool(other.log_p - fit.log_p > MIN_GAIN_NATS and mends)

    def motion(self, wiring: Rewiring) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations (n, na) as a wiring reads them."""
        q_from = list(wiring.q_from)
        q, v, a = (x[:, q_from] / np.array(wiring.q_scale) for x in (self.q, self.v, self.a))
        return q, v * wiring.t_scale, a * wiring.t_scale**2

    def build_regressor_by_gravity(self, wiring: Rewiring) -> Callable[[tuple[float, ...]], np.ndarray]:
        """Return the regressor (n, na, p) of a wiring's motion by the direction of gravity, in which it is linear."""
        q, v, a = self.motion(wiring)
        usual = np.array(self.robot.model.gravity.linear)
        size, rest = float(np.linalg.norm(usual)), np.zeros_like(q)
        plain = self._rigid((), q, v, a)
        axes = np.stack([self._rigid(tuple(axis), q, rest, rest) for axis in np.eye(3)])
        return lambda gravity: plain + np.tensordot(np.array(gravity) - usual / size, axes, axes=1)

    def design(self, wiring: Rewiring, rigid: np.ndarray | None = None) -> _Design | None:
        """Return the columns of a wiring's motion, or of its regressor; None where the robot cannot move so."""
        q_from = list(wiring.q_from)
        q, v, a = self.motion(wiring)
        try:
            rigid = self._rigid(wiring.gravity, q, v, a) if rigid is None else rigid
        except (LoopClosureError, InputError, np.linalg.LinAlgError):
            return None
        if not np.all(np.isfinite(rigid)):
            return None
        used = self.used[:, list(wiring.tau_from)] & self.used[:, q_from]
        force = rigid @ self.robot.parameters.values
        columns = rigid @ self.prior
        na, n = self.robot.na, columns.shape[2]
        own, nominal = [], []
        for j in range(na):
            rows = used[:, j]
            speed, forward = v[rows, j], v[rows, j] > 0
            friction = (np.ones(len(speed)), forward, forward - 1, speed * forward, speed * ~forward)
            block = np.zeros((len(speed), n + 5 * na))
            block[:, :n] = columns[rows, j]
            block[:, n + 5 * j : n + 5 * j + 5] = np.column_stack(friction)
            own.append(block)
            nominal.append(force[rows, j])
        return _Design(own, nominal, [block.T @ block for block in own], used)

    def fit(self, wiring: Rewiring, rigid: np.ndarray | None = None) -> _Fit | None:
        """Return the fit of the robot to the log if the log is wired so; None where the robot cannot move so."""
        design = self.design(wiring, rigid)
        return None if design is None else self.solve(design, wiring)

    def solve(self, design: _Design, wiring: Rewiring) -> _Fit:
        """Return the maximum a posteriori fit, by iterated reweighting of the joints."""
        na, n = self.robot.na, self.prior.shape[1]
        scale, tau_from = np.array(wiring.tau_scale), list(wiring.tau_from)
        size, counts = self.size[tau_from], self.counts[tau_from]
        floor = (self.model_error * size) ** 2
        targets = [self.tau[design.rows[:, j], tau_from[j]] - scale[j] * design.nominal[j] for j in range(na)]
        right = [scale[j] * (design.own[j].T @ targets[j]) for j in range(na)]
        low = np.concatenate([self.low, np.tile([-np.inf, 0, 0, 0, 0], na)])
        drives = np.zeros((na, 5))
        drives[:, 0] = (OFFSET_SHARE * size / np.abs(scale)) ** -2.0
        penalty = np.concatenate([np.ones(n), drives.ravel()])
        number = np.maximum(design.rows.sum(axis=0), 1)
        power, residual, x, held = (0.3 * size) ** 2, targets, np.zeros(len(low)), np.zeros(len(low), bool)
        for _ in range(3):
            weight = counts / number / np.maximum(power, floor)
            A, b = np.diag(penalty), np.zeros(len(low))
            for j in range(na):
                A += weight[j] * scale[j] ** 2 * design.gram[j]
                b += weight[j] * right[j]
            x, held = _solve(A, b, low, held)
            residual = [target - scale[j] * (design.own[j] @ x) for j, target in enumerate(targets)]
            power = np.array([compute_clipped_power(r, 3.0) for r in residual])
        power = np.where(design.rows.sum(axis=0) < MIN_ROWS, size**2, power)  # no sample, no evidence
        prior = float(penalty @ x**2) / 2
        log_p = -float(counts @ np.log(np.maximum(power, floor) / size**2)) / 2 - prior
        whole = np.zeros(design.rows.shape)
        whole.T[design.rows.T] = np.concatenate(residual)
        return _Fit(log_p, power, prior, whole)

    def _rigid(self, gravity: tuple[float, ...], q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        if not gravity:
            return self.mechanism.regressor(q, v, a)
        model = self.robot.model.copy()
        model.gravity.linear = np.linalg.norm(model.gravity.linear) * np.array(gravity)
        return build_mechanism(replace(self.robot, model=model)).regressor(q, v, a)


def _bounds(robot: Robot, prior: np.ndarray) -> np.ndarray:
    """Return lower bounds of the unknowns (n,) of bodies and drive inertia."""
    low = np.full(prior.shape[1], -np.inf)
    for k, (name, value) in enumerate(zip(robot.parameters.names, robot.parameters.values, strict=True)):
        column = np.flatnonzero(prior[k])
        if name.endswith(".armature") and column.size:
            low[column] = -value / prior[k, column]
        elif name.endswith((".mass", ".ixx", ".iyy", ".izz")) and column.size and value > 0:
            low[column] = -(1 - MIN_MASS_SHARE) * value / prior[k, column]
    return low


def _prior(robot: Robot) -> np.ndarray:
    """Return how parameters follow independent unknowns of unit variance (p, n): 25 % of a body, more at the last bodies.

    Drive inertia: three times what the joint itself moves, and 5 kg m^2 where gears reflect a rotor.
    """
    names = robot.parameters.names
    total = sum(max(link.nominal[0], 0.0) for link in robot.links) or 1.0
    parents = {int(robot.model.parents[link.joint_id]) for link in robot.links}
    spread = np.zeros(len(names))
    for link in robot.links:
        sizes = compute_body_stderr(link, total)
        if link.joint_id not in parents:
            reach = max(PAYLOAD_REACH_M, sizes[1] / sizes[0])
            sizes = np.hypot(sizes, PAYLOAD_SHARE * total * reach ** np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2]))
        spread[[names.index(name) for name in link.names]] = sizes[list(link.own)]
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


def _effective(r: np.ndarray) -> float:
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


def _say(robot: Robot, name: str, change: Rewiring, before: _Fit | None, after: _Fit) -> CodedWarning:
    """Return the warning about one wrong wiring, with its evidence."""
    evidence = "as logged, the robot cannot reach its positions."
    if before is not None:
        ratio = np.sqrt(after.power / np.maximum(before.power, 1e-300))
        k = int(np.argmin(np.where(before.power > 0, ratio, np.inf)))
        evidence = (
            f"so read, the model leaves {np.sqrt(after.power[k]):.3g} instead of {np.sqrt(before.power[k]):.3g} "
            f"{robot.force_units[k]} of tau_{robot.actuated[k]}, {100 * (1 - ratio[k]):.2g} % less."
            if ratio[k] ** 2 < MIN_POWER_DROP
            else "as logged, only bodies far from the robot file's explain the forces."
        )
    return CodedWarning(change.code, f"{name}: {change.words}. Evidence: {evidence}")
