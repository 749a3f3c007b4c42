"""Parameters through the closed loop: equation error as a screen and a start, output error by Gauss-Newton.

    minimise  sum_j sum_s sum_k (q_jsk - qhat_jsk(x))^2 / (sigma_js^2 n_j) + |z|^2 + sum ((x - prior) / sigma_x)^2

`qhat` is the simulated loop from each log's start to its end: the loop forgets its start within a fraction of a second, so
that one shot over a log is as well conditioned as many. All sensitivities are simulated side by side, as differences,
because friction that holds has no useful derivative equations. `n_j` is how many samples of joint j one independent sample
is worth. Standard errors come from the scatter of the gradient over blocks of time, which coloured residuals do not make
too small.

The equation error compares the torque that the law makes of command and position with the robot's along the measured
motion. Where the servo saturates or its law is incomplete it is biased, so it serves as a start and as a screen only.
Reference: Ljung 1999, 7.2 and 9; Levenberg 1944, Marquardt 1963; White 1980, Liang & Zeger 1986 (blocks).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.log import lowpass
from tau_dyn.servo.loop import simulate_loops
from tau_dyn.servo.records import MOTION_HZ, InertialSpace, LoopRecord
from tau_dyn.servo.waves import Trials, Waves
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw

JOINT_UNITS = {"armature": "kg m^2", "coulomb": "N m", "viscous": "N m s/rad", "offset": "N m"}
"""What a joint has beside its servo's law, and the units."""
FRICTION = ("coulomb", "viscous", "offset", "load_friction", "stiction")
"""What is estimated of a joint's friction unless the model is rigid."""
DELAYS_S = np.arange(0.0, 0.0601, 0.0025)
"""Command delays that the screen tries [s]: none to three periods of a 50 Hz bus."""
MOVING = 0.03
"""Speed from which a joint's friction has a direction [rad/s]: twice what a step of a 12 bit encoder makes at 20 ms."""
MAX_DIRECTIONS = 40
"""Directions of the inertial numbers that are estimated at most; an arm of six joints has some 36."""
MIN_INFORMATION = 1e-5
"""Information of a direction, with prior knowledge as 1, from which it is estimated. It is small: what a log hardly
shows may stand for something else, as gravity at a joint that barely turns for a constant torque."""
INFORMATION_S = 0.02
"""Time between the samples that directions are chosen by [s]: a fourth of a period of the motion's low-pass."""
MAX_ITERATIONS = 15  # of Gauss-Newton: fits settle in 4 to 10
FINE_DIFFERENCES = 0.05
"""Steps of differences near a solution, over those that friction cannot hide far from one: large ones end a search too soon
where gains are high and encoders fine."""
_LAMBDAS = (1e-2, 3e-1, 1e1)  # damping factors that are tried side by side
MAX_CONTRAST = 2.0
"""Factor within which a log's residual may be weighed other than its joint's usual one: what no model explains in one log
(a contact, a shaken joint) must not decide about the others."""
BLOCK_S = (1.0, 5.0)
"""Shortest and longest blocks over which the gradient's scatter is taken [s]: an encoder's rounding lasts as long as a joint
rests, a second where steps are commanded, and what a model misses is forgotten within the longest."""
BLOCKS = 100
"""Blocks that are wanted: several for each unknown of a joint, or the scatter among them comes out too small."""
_SMALL_GAIN = 1e-3  # relative fall of the loss below which a first search ends, twice in turn
CONVERGED = 0.01
"""Squared distance to the minimum, in standard errors, from which a search near a solution ends (Newton decrement)."""
MAX_ELEMENTS = 6_000_000
"""Positions that are simulated at once, 48 MB of them."""


@dataclass(frozen=True, eq=False)
class LoopUnknowns:
    """What a fit may change, kind by kind and joint by joint, and the inertial directions.

    Attributes:
        values: Value of every kind and law entry (na,), those that are held included.
        kinds: Kinds that are free for at least one joint.
        free: Which joints of each kind (nk, na).
        lower: Bounds (nk, na).
        upper: Bounds (nk, na).
        prior: Standard deviations of prior knowledge about the start values (nk, na); infinite for none.
        space: Inertial numbers.
    """

    values: Mapping[str, np.ndarray]
    kinds: tuple[str, ...]
    free: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    prior: np.ndarray
    space: InertialSpace

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return int(self.free.sum()) + self.space.n_unknowns

    @property
    def joint_of(self) -> np.ndarray:
        """Joint of each unknown (n,); -1 for the inertial ones."""
        return np.append(np.nonzero(self.free)[1], np.full(self.space.n_unknowns, -1))

    def pack(self) -> np.ndarray:
        """Return the start (n,)."""
        first = np.array([self.values[kind] for kind in self.kinds]).reshape(self.free.shape)[self.free]
        return np.append(first, np.zeros(self.space.n_unknowns))

    def unpack(self, x: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return values by kind (na, C) and inertial unknowns (K, C) of vectors (n, C)."""
        m, c = int(self.free.sum()), x.shape[1]
        table = np.repeat(
            np.array([self.values[k] for k in self.kinds]).reshape(self.free.shape)[:, :, None], c, axis=2
        )
        table[self.free] = x[:m]
        values = {key: np.repeat(value[:, None], c, axis=1) for key, value in self.values.items()}
        return values | dict(zip(self.kinds, table, strict=True)), x[m:]

    def clip(self, x: np.ndarray) -> np.ndarray:
        """Return a vector (n,) within the bounds."""
        m = int(self.free.sum())
        inside = np.clip(x[:m], self.lower[self.free], self.upper[self.free])
        return np.append(inside, np.clip(x[m:], -5.0, 5.0))

    def with_values(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return every value by kind (na,) at a vector (n,)."""
        return {key: value[:, 0] for key, value in self.unpack(x[:, None])[0].items()}


@dataclass(frozen=True, eq=False)
class LoopFit:
    """The end of a search.

    Attributes:
        x: LoopUnknowns (n,).
        covariance: Their covariance (n, n); zero rows for those at a bound.
        sigma: Residual rms of each joint (na,) [rad].
        loss: Sum of squares.
        iterations: How often sensitivities were simulated.
        step: Longest step of the simulated loops [s].
    """

    x: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    loss: float
    iterations: int
    step: float


@dataclass(frozen=True, eq=False)
class EquationError:
    """The screen: what the rebuilt torque says.

    Attributes:
        values: Start values of kinds (na,).
        residual: Torque that remains, record by record (N, na) [N m]; NaN where a joint rests.
        sigma: Its rms (na,) [N m].
    """

    values: Mapping[str, np.ndarray]
    residual: Sequence[np.ndarray]
    sigma: np.ndarray


def delay_command(command: np.ndarray, dt: float, delay: float) -> np.ndarray:
    """Return held commands (N, na) as a delay [s] later shows them at the samples, averaged over the sample before."""
    n = len(command)
    total = np.concatenate([np.zeros((1, command.shape[1])), np.cumsum(command, axis=0)])
    at = np.clip(np.arange(n + 1) - 0.5 - delay / dt, 0, n)
    summed = np.stack([np.interp(at, np.arange(n + 1), column) for column in total.T], axis=1)
    shown = np.diff(summed, axis=0)
    early = np.diff(at) < 1
    shown[early] = command[0]
    return shown


def screen_equation_error(
    law: ServoLaw, space: InertialSpace, records: Sequence[LoopRecord], estimate_gain: bool
) -> EquationError:
    """Return the best delay, friction and drive inertia of each joint by the rebuilt torque, bodies as the file has them."""
    na = len(law.joints)
    values = {key: np.array(law.values[key]) for key in ("position_gain", "command_delay")}
    values |= {key: np.zeros(na) for key in JOINT_UNITS}
    residual, sigma = [np.full(r.q.shape, np.nan) for r in records], np.zeros(na)
    mechanism = space.build_mechanism()
    moved = [mechanism.inverse_dynamics(*r.motion) for r in records]
    for j in range(na):
        best = None
        for delay in [float(law.values["command_delay"][j])] if law.values["command_delay"][j] > 0 else DELAYS_S:
            rows = [
                _build_rows(law, r, tau[:, j], j, float(delay), estimate_gain)
                for r, tau in zip(records, moved, strict=True)
            ]
            y, X = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
            if len(y) < 10 * X.shape[1]:
                continue
            norm = np.linalg.norm(X, axis=0) + 1e-12
            beta = np.linalg.lstsq(X / norm, y, rcond=None)[0] / norm
            rms = float(np.std(y - X @ beta))
            if best is None or rms < best[0]:
                best = (rms, delay, beta, rows)
        stiff = float(compute_stiffness(law.values)[j])
        if best is None:
            values["coulomb"][j] = 0.01 * stiff
            sigma[j] = 0.01 * stiff
            continue
        rms, delay, beta, rows = best
        values["command_delay"][j] = delay
        scale = 1.0
        if estimate_gain:  # the rows are of positions: 1 / gain times torque
            share = beta[4] if beta[4] > 0 else np.nan
            scale = 1.0 / share
            values["position_gain"][j] = scale / law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = (max(0.0, scale * b) for b in beta[:2])
        values["offset"][j], values["armature"][j] = scale * beta[2], max(1e-4, scale * beta[3])
        sigma[j] = rms * (scale if np.isfinite(scale) else 1.0)
        for k, (y, X, where) in enumerate(rows):
            residual[k][where, j] = (y - X @ beta) * (scale if np.isfinite(scale) else 1.0)
    if estimate_gain:
        values = _fill_gains(values, law)
    return EquationError(values, residual, np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0))


def _fill_gains(values: dict[str, np.ndarray], law: ServoLaw) -> dict[str, np.ndarray]:
    """Return the values with gains that no gravity showed taken from the other joints, and friction with them."""
    gain = values["position_gain"]
    known = np.isfinite(gain) & (gain > 0.05) & (gain < 1e4)
    usual = float(np.median(gain[known])) if known.any() else 5.0
    for j in np.flatnonzero(~known | (gain > 5 * usual) | (gain < usual / 5)):
        gain[j] = usual
        stiff = usual * law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = 0.01 * stiff, 0.07 * stiff
        values["offset"][j], values["armature"][j] = 0.0, 1e-3 * stiff
    return values


def _build_rows(
    law: ServoLaw, r: LoopRecord, moved: np.ndarray, j: int, delay: float, estimate_gain: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return torque, columns (sign, speed, one, acceleration) and mask of one joint where it moves and its motor is on."""
    rate, (q, v, a) = 1 / r.dt, r.motion
    goal = delay_command(r.command[:, j : j + 1], r.dt, delay)[:, 0]
    goal = lowpass(goal, MOTION_HZ, rate) if rate > 2.5 * MOTION_HZ else goal
    error = goal - q[:, j]
    where = r.used & (np.abs(v[:, j]) > MOVING) & (r.enabled > 0)
    edge = round(0.3 * rate)
    where[:edge], where[-edge:] = False, False
    columns = [np.sign(v[:, j]), v[:, j], np.ones(len(v)), a[:, j]]
    if estimate_gain:
        return error[where], np.stack([*columns, moved], axis=1)[where], where
    entries = r.entries
    u = _rebuild_output(r, j, goal, error)
    tau = entries["force_per_unit"][j] * (u * r.supply - entries["back_emf"][j] * v[:, j])
    return (tau - moved)[where], np.stack(columns, axis=1)[where], where


def _rebuild_output(r: LoopRecord, j: int, goal: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the law's output (N,) along the measured motion."""
    p, v = {key: x[j] for key, x in r.entries.items()}, r.motion[1][:, j]
    u, gain = goal, p["integral_gain"]
    if r.told == "position":
        goal, u = error, p["position_gain"] * error - p["derivative_gain"] * v
    if r.told in ("position", "speed"):
        if p["speed_gain"] > 0:
            goal, gain = np.clip(u, -p["speed_limit"], p["speed_limit"]) - v, p["speed_integral_gain"]
            u = p["speed_gain"] * goal
        u = u + np.clip(gain * np.cumsum(goal) * r.dt, -p["limit"], p["limit"])
    return np.clip(u, -p["limit"], p["limit"])


def compute_stiffness(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return each loop's torque per unit of position error (na,) [N m/rad], the measure of small changes of torque."""
    inner = np.where(values["speed_gain"] > 0, values["speed_gain"], 1.0)
    return values["position_gain"] * inner * values["force_per_unit"]


def choose_directions(space: InertialSpace, records: Sequence[LoopRecord], screen: EquationError) -> InertialSpace:
    """Return the space with the directions of which the logs know more than the robot file."""
    p = len(space.nominal)
    information = np.zeros((p, p))
    for r in records:
        every = max(1, int(INFORMATION_S / r.dt + 1e-9))
        some = np.flatnonzero(r.used & (r.enabled > 0))[::every]
        if len(some) < 10:
            continue
        Y = space.model.mechanism.regressor(*(x[some] for x in r.motion)) * space.prior
        worth = max(1.0, 0.5 / r.dt) / every  # samples that one independent residual is worth, at half a second
        for j in range(r.q.shape[1]):
            X = np.ascontiguousarray(Y[:, j])
            information += X.T @ X / (screen.sigma[j] ** 2 * worth)
    values, vectors = np.linalg.eigh(information)
    order = np.argsort(values)[::-1][:MAX_DIRECTIONS]
    kept = [k for k in order if values[k] > MIN_INFORMATION]
    return replace(space, directions=space.prior[:, None] * vectors[:, kept])


class LoopProblem:
    """Residuals and sensitivities of a fit."""

    def __init__(self, unknowns: LoopUnknowns, waves: Waves, records: Sequence[LoopRecord]) -> None:
        """Prepare; records give the measured positions and the samples that count."""
        n = len(waves.command)
        self.unknowns, self.waves = unknowns, waves
        self.measured = _stack([r.q for r in records], n)
        self.used = np.stack([np.pad(r.used, (0, n - len(r.t))) for r in records], axis=-1)
        self.blocks = _number_blocks(records, n)
        self.count = np.maximum(self.used.sum(), 1)
        self.share_of_steps = 1.0

    def with_finer_differences(self) -> LoopProblem:
        """Return the problem with small steps for its differences, for the last part of a search."""
        other = copy(self)
        other.share_of_steps = FINE_DIFFERENCES
        return other

    def with_step(self, step: float) -> LoopProblem:
        """Return the problem with another longest step [s]."""
        other = copy(self)
        other.waves = replace(self.waves, step=step)
        return other

    def correct(self, exact: Sequence[np.ndarray], trials: Trials) -> LoopProblem:
        """Return the problem without the error of its steps and loads: known, at one trial, are the exact positions (N, na)."""
        other = copy(self)
        n = len(self.measured)
        other.measured = self.measured - _stack(exact, n) + simulate_loops(self.waves, trials)[:, :, 0]
        return other

    def simulate(self, x: np.ndarray) -> np.ndarray:
        """Return positions (N, na, C, S) at vectors (n, C)."""
        values, inertial = self.unknowns.unpack(x)
        per = max(1, MAX_ELEMENTS // self.measured.size)
        parts = []
        for k in range(0, x.shape[1], per):
            cut = {key: value[:, k : k + per] for key, value in values.items()}
            parts.append(simulate_loops(self.waves, Trials(cut, inertial[:, k : k + per])))
        return np.concatenate(parts, axis=2) if len(parts) > 1 else parts[0]

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return measured minus simulated positions (N, na, C, S) at vectors (n, C), zero where samples do not count."""
        r = self.measured[:, :, None, :] - self.simulate(x)
        np.copyto(r, 0.0, where=~self.used[:, None, None, :])
        return r

    def list_steps(self, x: np.ndarray) -> np.ndarray:
        """Return steps (n,) for differences, above what friction that holds would hide."""
        values = self.unknowns.with_values(x)
        stiff = compute_stiffness(values)
        small = {
            "armature": 2e-5 * stiff, "coulomb": 1e-3 * stiff, "viscous": 1e-3 * stiff, "offset": 1e-3 * stiff,
            "load_friction": 0.02, "carried_friction": 0.02, "stiction": 1e-3 * stiff, "command_delay": 1e-3, "dead_band": 5e-4,
            "supply_sag": 0.02, "braking": 0.05, "speed_gain": 1e-3, "speed_integral_gain": 1e-3,
            "back_emf": 1e-3 * values["position_gain"], "stiction_speed": 5e-3, "torque_delay": 1e-3, "backlash": 1e-3,
            "joint_compliance": 1e-3 / stiff, "joint_damping": 1e-4 * stiff,
        }  # fmt: skip
        na = len(stiff)
        table = [
            np.maximum(np.broadcast_to(small.get(k, 0.0), na), 0.02 * np.abs(values[k])) for k in self.unknowns.kinds
        ]
        steps = self.share_of_steps * np.array(table).reshape(self.unknowns.free.shape)[self.unknowns.free]
        return np.append(np.maximum(steps, 1e-9), np.full(self.unknowns.space.n_unknowns, 0.15))

    def differentiate(self, x: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
        """Return the residual (N, na, S), and joint by joint the sensitivities (n_j, S N) and which unknowns they belong to."""
        u, steps, joint_of = self.unknowns, self.list_steps(x), self.unknowns.joint_of
        kind_of = np.append(np.nonzero(u.free)[0], len(u.kinds) + np.arange(u.space.n_unknowns))
        names = np.unique(kind_of)
        columns = [x]
        for name in names:  # joints move alone: one column changes a kind at all of them
            columns.append(x + np.where(kind_of == name, steps, 0.0))
        r = self.residuals(np.stack(columns, axis=1))
        base, owners, sensitivities = r[:, :, 0], [], []
        for j in range(r.shape[1]):
            mine = np.flatnonzero((joint_of == j) | (joint_of < 0))
            at = [1 + int(np.searchsorted(names, kind_of[k])) for k in mine]
            rows = r[:, j].transpose(1, 2, 0)
            sensitivities.append(((rows[at] - rows[:1]) / steps[mine][:, None, None]).reshape(len(mine), -1))
            owners.append(mine)
        return base, sensitivities, owners


def _stack(arrays: Sequence[np.ndarray], n: int) -> np.ndarray:
    """Return arrays (., na) side by side (n, na, S), their last rows repeated."""
    return np.stack([np.pad(x, ((0, n - len(x)), (0, 0)), mode="edge") for x in arrays], axis=-1)


def _number_blocks(records: Sequence[LoopRecord], n: int) -> np.ndarray:
    """Return the number of the block that each sample (N, S) belongs to."""
    out, first = np.zeros((n, len(records)), dtype=int), 0
    length = float(np.clip(sum(len(r.t) * r.dt for r in records) / BLOCKS, *BLOCK_S))
    for k, r in enumerate(records):
        block = (np.arange(n) * r.dt / length).astype(int)
        out[:, k] = first + block
        first = out[-1, k] + 1
    return out


def count_worth(residual: np.ndarray, used: np.ndarray) -> float:
    """Return how many samples of one joint's residuals (N, S) an independent one is worth."""
    reach = min(400, len(residual) // 4)
    total = np.zeros(reach)
    for column, mask in zip(residual.T, used.T, strict=True):
        x = column * mask
        total += [float(x[: len(x) - lag] @ x[lag:]) for lag in range(reach)]
    if total[0] <= 0:
        return 1.0
    rho = total / total[0]
    ends = np.flatnonzero(rho < 0.05)
    return float(max(1.0, 1.0 + 2.0 * rho[1 : (ends[0] if len(ends) else reach)].sum()))


def fit_loop(
    problem: LoopProblem,
    progress: Callable[[str], None] = lambda step: None,
    max_iterations: int = MAX_ITERATIONS,
    first: np.ndarray | None = None,
) -> LoopFit:
    """Search the unknowns that simulate the logs best, from their start values or a first vector (n,)."""
    u = problem.unknowns
    start = u.pack()
    x = u.clip(start if first is None else first)
    precision = np.append(u.prior[u.free] ** -2.0, np.ones(u.space.n_unknowns))
    if u.n == 0:
        r = problem.residuals(x[:, None])[:, :, 0]
        sigma = np.sqrt((r**2).sum(axis=(0, 2)) / problem.count)
        return LoopFit(x, np.zeros((0, 0)), sigma, 0.0, 0, problem.waves.step)
    worth, last, damping, small = None, np.inf, 1.0 if first is None else 1e-3, 0
    H, scatter, sigma, loss = np.eye(u.n), np.eye(u.n), np.ones(1), 0.0
    for k in range(max_iterations):
        progress(f"output error, iteration {k + 1}")
        r, sensitivities, owners = problem.differentiate(x)
        sigma = np.maximum(np.sqrt((r**2).sum(axis=(0, 2)) / problem.count), 1e-7)
        if worth is None or k == 2:
            worth = np.array([count_worth(r[:, j], problem.used) for j in range(r.shape[1])])
        weight = _weigh(problem, r, sigma) / worth[:, None]
        H, g, scatter = _accumulate(problem, r, sensitivities, owners, weight)
        H, g = H + np.diag(precision), g - precision * (x - start)
        loss = _sum_squares(r[:, :, None], weight)[0] + float(precision @ (x - start) ** 2)
        held = _find_held(u, x, g)
        if first is not None and k > 1 and float(g @ (_step(H, g, 0.0, held, u, x) - x)) < CONVERGED:
            break
        tried = np.array([_step(H, g, damping * lam, held, u, x) for lam in _LAMBDAS])
        rs = problem.residuals(tried.T)
        losses = _sum_squares(rs, weight) + np.array([precision @ (t - start) ** 2 for t in tried])
        losses = np.where(np.isfinite(losses), losses, np.inf)
        best = int(np.argmin(losses))
        gain = loss - losses[best]
        if gain <= 0:
            if damping > 1e3:
                break
            damping *= 1e3
            continue
        x, damping, last = tried[best], min(max(damping * _LAMBDAS[best], 1e-4), 1e4), losses[best]
        small = small + 1 if gain < (CONVERGED / 2 if first is not None else _SMALL_GAIN * loss) else 0
        if small == 2:
            break
    r, sensitivities, owners = problem.differentiate(x)
    sigma = np.maximum(np.sqrt((r**2).sum(axis=(0, 2)) / problem.count), 1e-7)
    weight = _weigh(problem, r, sigma) / (worth if worth is not None else np.ones(len(sigma)))[:, None]
    H, g, scatter = _accumulate(problem, r, sensitivities, owners, weight)
    held = _find_held(u, x, g - precision * (x - start))
    return LoopFit(
        x,
        _compute_covariance(H + np.diag(precision), scatter + np.diag(precision), held),
        sigma,
        min(loss, last),
        k + 1,
        problem.waves.step,
    )


def _weigh(problem: LoopProblem, r: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the inverse variances (na, S) of residuals (N, na, S): each log's own, within a factor of its joint's."""
    own = np.sqrt((r**2).sum(axis=0) / np.maximum(problem.used.sum(axis=0), 1))
    return np.clip(own, sigma[:, None] / MAX_CONTRAST, sigma[:, None] * MAX_CONTRAST) ** -2.0


def _accumulate(problem, r, sensitivities, owners, weight):  # noqa: ANN001, ANN202
    """Return normal matrix (n, n), right side (n,) and the gradient's scatter over blocks (n, n)."""
    n = problem.unknowns.n
    H, g = np.zeros((n, n)), np.zeros(n)
    blocks = problem.blocks.T.reshape(-1)
    sums = np.zeros((blocks.max() + 1, n))
    for j, (S, mine) in enumerate(zip(sensitivities, owners, strict=True)):
        weights = np.broadcast_to(weight[j][:, None], r[:, j].T.shape).reshape(-1)
        weighed = S * weights
        H[np.ix_(mine, mine)] += S @ weighed.T
        weighed *= -r[:, j].T.reshape(-1)  # the residual's derivative is minus the position's
        g[mine] += weighed.sum(axis=1)
        for row, k in zip(weighed, mine, strict=True):
            sums[:, k] += np.bincount(blocks, weights=row, minlength=len(sums))
    blocks_used = max(2, int(np.count_nonzero(np.abs(sums).sum(axis=1))))
    most = max(len(mine) for mine in owners)
    return H, g, sums.T @ sums * blocks_used / max(blocks_used - most, 0.2 * blocks_used)


def _sum_squares(r: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted sums of squares (C,) of residuals (N, na, C, S)."""
    return np.einsum("njcs,njcs,js->c", r, r, weight)


def _find_held(u: LoopUnknowns, x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return which unknowns (n,) a bound holds against the gradient."""
    m = int(u.free.sum())
    held = np.zeros(len(x), dtype=bool)
    held[:m] = ((x[:m] <= u.lower[u.free]) & (g[:m] <= 0)) | ((x[:m] >= u.upper[u.free]) & (g[:m] >= 0))
    return held


def _step(H: np.ndarray, g: np.ndarray, lam: float, held: np.ndarray, u: LoopUnknowns, x: np.ndarray) -> np.ndarray:
    """Return the next vector by a damped step among the unknowns that no bound holds."""
    loose = ~held
    d = np.zeros(len(x))
    A = H[np.ix_(loose, loose)]
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12))
    A = A / scale[:, None] / scale[None, :] + lam * np.eye(len(scale))
    d[loose] = np.linalg.lstsq(A, g[loose] / scale, rcond=1e-12)[0] / scale
    return u.clip(x + d)


def _compute_covariance(H: np.ndarray, scatter: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the sandwich covariance (n, n), without what bounds hold."""
    loose = np.flatnonzero(~held)
    out = np.zeros_like(H)
    A = H[np.ix_(loose, loose)]
    scale = np.sqrt(np.maximum(np.diag(A), 1e-12))
    inverse = np.linalg.pinv(A / scale[:, None] / scale[None, :], rcond=1e-10) / scale[:, None] / scale[None, :]
    out[np.ix_(loose, loose)] = inverse @ scatter[np.ix_(loose, loose)] @ inverse
    return out


def build_unknowns(
    law: ServoLaw,
    space: InertialSpace,
    start: Mapping[str, np.ndarray],
    kinds: Sequence[str],
    held: Mapping[str, np.ndarray] | None = None,
) -> LoopUnknowns:
    """Return unknowns of some kinds for all joints, at start values.

    Args:
        law: Values of its entries.
        space: Inertial numbers.
        start: Values by kind (na,) that replace the law's and the zeros of the rest.
        kinds: What is free.
        held: Kinds -> joints (na,) where it is not free after all.
    """
    na = len(law.joints)
    values = {**law.values, **{key: np.zeros(na) for key in JOINT_UNITS}, **start}
    values = {key: np.array(value, float) for key, value in values.items()}
    shape = (len(kinds), na)
    lower = np.array([np.full(na, _LOWEST.get(k, 0.0)) for k in kinds]).reshape(shape)
    upper = np.array([np.full(na, HIGHEST.get(k, np.inf)) for k in kinds]).reshape(shape)
    free = np.array([~np.asarray((held or {}).get(k, np.zeros(na, bool)), bool) for k in kinds]).reshape(shape)
    return LoopUnknowns(values, tuple(kinds), free, lower, upper, np.full(shape, np.inf), space)


_LOWEST = {
    "offset": -np.inf,
    "position_gain": 1e-3,
    "speed_gain": 1e-4,
    "force_per_unit": 1e-4,
    "stiction_speed": 1e-3,
    "armature": 1e-7,
    "command_delay": -0.02,
    "drive_exponent": 0.2,
}
"""Lower bounds of kinds; zero for the others. A delay below zero is a position that is read after its time stamp."""
HIGHEST = {
    "load_friction": 0.95,
    "carried_friction": 0.95,
    "command_delay": 0.2,
    "supply_sag": 0.95,
    "dead_band": 0.2,
    "drive_exponent": 2.0,
    "braking": 1.0,
    "torque_delay": 0.1,
    "backlash": 0.2,
}
"""Upper bounds of kinds [1, s, rad]: a friction that grows as the torque would hold every motion."""


def get_unit(kind: str) -> str:
    """Return the unit of a kind."""
    return JOINT_UNITS[kind] if kind in JOINT_UNITS else SERVO_ENTRIES[kind].unit
