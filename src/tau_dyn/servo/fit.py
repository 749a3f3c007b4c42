"""Parameters through the closed loop: output error by Gauss-Newton, started at the result of equation error.

    minimise  sum_j sum_s sum_k (q_jsk - qhat_jsk(x))^2 / (sigma_js^2 n_j) + |z|^2 + sum ((x - prior) / sigma_x)^2

`qhat` is the simulated loop from each log's start to its end: the loop forgets its start within a fraction of a second, so that
single shooting over a log is as well conditioned as multiple shooting. All sensitivities are simulated in parallel, as
differences, because static friction has no useful derivative equations. `n_j` is the number of samples of joint j per
independent sample. Standard errors are computed from the scatter of the gradient over blocks of time, so that coloured
residuals do not make them too small.
Reference: Ljung 1999, 7.2 and 9; Levenberg 1944, Marquardt 1963; White 1980, Liang & Zeger 1986 (blocks).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.servo.compiled_loop import LANES
from tau_dyn.servo.loop import simulate_loops
from tau_dyn.servo.records import LoopRecord
from tau_dyn.servo.unknowns import LoopUnknowns, compute_stiffness
from tau_dyn.servo.waves import Trials, Waves

MAX_ITERATIONS = 15  # of Gauss-Newton: fits converge in 4 to 10

FINE_DIFFERENCES = 0.05
"""Steps of differences near a solution, relative to the larger ones far from it, which friction cannot hide: large steps end a
search too early with high gains and fine encoders."""

_LAMBDAS = (1e-2, 3e-1, 1e1)  # damping factors that are tried in parallel

MAX_CONTRAST = 2.0
"""Factor within which the weight of a log's residual may differ from its joint's usual one: an error of one log that no model
explains (a contact, a shaken joint) must not determine the fit of the others."""

BLOCK_S = (1.0, 5.0)
"""Shortest and longest blocks over which the gradient's scatter is taken [s]: an encoder's rounding lasts as long as a joint
rests, a second where steps are commanded, and model errors are uncorrelated beyond the longest."""

BLOCKS = 100
"""Desired number of blocks: several for each unknown of a joint, otherwise the scatter among them is too small."""

_SMALL_GAIN = 1e-3  # relative decrease of the loss below which a first search ends, twice in succession

CONVERGED = 0.01
"""Squared distance to the minimum, in standard errors and per unknown, below which a search near a solution ends (Newton
decrement)."""

MANY = 2
"""Ratio of inertial unknowns to kinds of other unknowns from which trials reuse sensitivities to the inertial ones: simulating
them is most of the work."""

MAX_ELEMENTS = 6_000_000
"""Positions that are simulated at once, 48 MB of them."""


@dataclass(frozen=True, eq=False)
class LoopFit:
    """The end of a search.

    Attributes:
        x: Unknowns (n,).
        covariance: Their covariance (n, n); zero rows for those at a bound.
        sigma: Residual rms of each joint (na,) [rad].
        loss: Sum of squares.
        iterations: Number of simulations of sensitivities.
    """

    x: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    loss: float
    iterations: int


class Slopes(NamedTuple):
    """Sensitivities of simulated positions to unknowns, at one vector.

    Attributes:
        at: The vector (n,).
        rows: Joint by joint, sensitivities (n_j, S N) [rad per unit].
        owners: Indices of their unknowns (n_j,).
    """

    at: np.ndarray
    rows: list[np.ndarray]
    owners: list[np.ndarray]


class LoopProblem:
    """Residuals and sensitivities of a fit, at the used samples of its logs: M of each, padded to the most.

    Attributes:
        used: Mask (M, S) of the samples that are there.
        blocks: Number of each sample's block (M, S).
        slopes: Sensitivities that were simulated last, or those of nearly the same problem.
        inertial: Joint by joint, sensitivities (K, S N) to the inertial unknowns that a trial keeps; None to simulate them.
    """

    def __init__(self, unknowns: LoopUnknowns, waves: Waves, records: Sequence[LoopRecord]) -> None:
        """Prepare; records give the measured positions and the samples that are used."""
        used = [np.flatnonzero(r.used) for r in records]
        m = max(1, *map(len, used))
        self.used = np.array([np.arange(m) < len(x) for x in used]).T
        shown = np.array([np.pad(x, (0, m - len(x)), mode="edge") if len(x) else np.zeros(m, int) for x in used]).T
        self.unknowns, self.waves = unknowns, replace(waves, shown=shown)
        self.measured = self.pick([r.measured for r in records])
        self.blocks = np.take_along_axis(_number_blocks(records, len(waves.command)), shown, axis=0)
        self.count = np.maximum(self.used.sum(), 1)
        self.share_of_steps = 1.0
        self.slopes: Slopes | None = None
        self.inertial: list[np.ndarray] | None = None

    def pick(self, arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return the used samples (M, na, S) of each log's array (N, na), in the memory order of compiled loops."""
        shown = self.waves.shown
        assert shown is not None
        rows = [x[at].T for x, at in zip(arrays, shown.T, strict=True)]
        return np.ascontiguousarray(np.stack(rows, axis=1)).transpose(2, 0, 1)

    def with_finer_differences(self) -> LoopProblem:
        """Return the problem with small steps for its differences, for the last part of a search."""
        other = copy(self)
        other.share_of_steps, other.slopes = FINE_DIFFERENCES, None
        return other

    def take_slopes(self, other: LoopProblem | None) -> LoopProblem:
        """Return the problem with the sensitivities of nearly the same one, if these are differences over equal steps."""
        if other is None or other.share_of_steps != self.share_of_steps:
            return self
        problem = copy(self)
        problem.slopes = other.slopes
        return problem

    def keep_inertial(self, x: np.ndarray) -> list[np.ndarray] | None:
        """Return the sensitivities to inertial unknowns at a vector (n,), for trials near it; None if they are few."""
        count = self.unknowns.space.n_unknowns
        return (
            [rows[-count:] for rows in self.differentiate(x)[1].rows]
            if count > MANY * len(self.unknowns.kinds)
            else None
        )

    def with_inertial(self, kept: list[np.ndarray] | None) -> LoopProblem:
        """Return the problem with sensitivities to inertial unknowns that are not simulated again."""
        other = copy(self)
        other.inertial = kept
        return other

    def with_step(self, step: float) -> LoopProblem:
        """Return the problem with another longest step [s]."""
        other = copy(self)
        other.waves = replace(self.waves, step=step)
        return other

    def correct(self, exact: Sequence[np.ndarray], trials: Trials) -> LoopProblem:
        """Return the problem corrected for the error of its steps and loads by the exact positions (N, na) at one trial."""
        other = copy(self)
        other.measured = self.measured - self.pick(exact) + simulate_loops(self.waves, trials)[:, :, 0]
        return other

    def simulate(self, x: np.ndarray) -> np.ndarray:
        """Return positions (M, na, C, S) at the stamps and at vectors (n, C)."""
        values, inertial = self.unknowns.unpack(x)
        per = LANES * max(1, MAX_ELEMENTS // (LANES * self.measured.size))
        parts = []
        for k in range(0, x.shape[1], per):
            cut = {key: value[:, k : k + per] for key, value in values.items()}
            parts.append(simulate_loops(self.waves, Trials(cut, inertial[:, k : k + per])))
        return np.concatenate(parts, axis=2) if len(parts) > 1 else parts[0]

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Return measured minus simulated positions (M, na, C, S) at vectors (n, C), zero where none is used."""
        r = self.measured[:, :, None, :] - self.simulate(x)
        np.copyto(r, 0.0, where=~self.used[:, None, None, :])
        return r

    def list_steps(self, x: np.ndarray) -> np.ndarray:
        """Return steps (n,) for differences, large enough that static friction does not hide them."""
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

    def differentiate(self, x: np.ndarray) -> tuple[np.ndarray, Slopes]:
        """Return the residual (M, na, S) and the sensitivities at a vector (n,)."""
        u, steps, joint_of = self.unknowns, self.list_steps(x), self.unknowns.joint_of
        simulated = u.n if self.inertial is None else u.n - u.space.n_unknowns
        kind_of = np.append(np.nonzero(u.free)[0], len(u.kinds) + np.arange(u.space.n_unknowns))
        names = np.unique(kind_of[:simulated])
        columns = [x]
        for name in names:  # joints are independent: one column changes a kind at all of them
            columns.append(x + np.where(kind_of == name, steps, 0.0))
        r = self.residuals(np.stack(columns, axis=1))
        base, owners, sensitivities = r[:, :, 0], [], []
        for j in range(r.shape[1]):
            mine = np.flatnonzero((joint_of == j) | (joint_of < 0))
            new = mine[mine < simulated]
            at = [1 + int(np.searchsorted(names, kind_of[k])) for k in new]
            rows = r[:, j].transpose(1, 2, 0)
            change = ((rows[at] - rows[:1]) / steps[new][:, None, None]).reshape(len(new), rows[0].size)
            sensitivities.append(change if self.inertial is None else np.concatenate([change, self.inertial[j]]))
            owners.append(mine)
        self.slopes = Slopes(x, sensitivities, owners)
        return base, self.slopes


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
    """Return the number of used samples of one joint's residuals (M, S) per independent one."""
    kept = [column[mask] for column, mask in zip(residual.T, used.T, strict=True)]
    reach = min(400, max(len(x) for x in kept) // 4)
    total = np.zeros(reach)
    for x in kept:
        total += [float(x[: max(len(x) - lag, 0)] @ x[lag:]) for lag in range(reach)]
    if reach == 0 or total[0] <= 0:
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
    """Search for the unknowns that simulate the logs best, from their start values or a first vector (n,)."""
    u = problem.unknowns
    prior = LoopPrior(u)
    x = prior.enter(u.clip(prior.start if first is None else first))
    if u.n == 0:
        r = problem.residuals(x[:, None])[:, :, 0]
        sigma = np.sqrt((r**2).sum(axis=(0, 2)) / problem.count)
        return LoopFit(x, np.zeros((0, 0)), sigma, 0.0, 0)
    last, damping, small = np.inf, 1.0 if first is None else 1e-3, 0
    near, worth = None, None
    for k in range(max_iterations):
        progress(f"output error, iteration {k + 1}")
        if (
            first is None or problem.share_of_steps < 1
        ):  # far from a solution, or with a nonlinear loss, slopes are recomputed
            problem.slopes = None
        near = _linearise(problem, x, prior, None if k == 2 else worth)
        worth, weight, H, g = near.worth, near.weight, near.H, near.g
        loss = _sum_squares(near.residual[:, :, None], weight)[0] + prior.compute_cost(x)
        if not (np.isfinite(loss) and np.isfinite(H).all()):  # the simulated loop diverges from these start values
            return LoopFit(x, np.full(H.shape, np.nan), np.full(len(weight), np.inf), np.inf, k + 1)
        held = _find_held(u, x, g)
        if first is not None and float(g @ (_step(H, g, 0.0, held, prior, x) - x)) < CONVERGED * u.n:
            break
        tried = np.array([_step(H, g, damping * lam, held, prior, x) for lam in _LAMBDAS])
        losses = _sum_squares(problem.residuals(tried.T), weight) + [prior.compute_cost(t) for t in tried]
        losses = np.where(np.isfinite(losses), losses, np.inf)
        best = int(np.argmin(losses))
        gain = loss - losses[best]
        if gain <= 0:
            if not near.own:
                problem.slopes = None  # slopes of another vector may have misled the step
                continue
            if damping > 1e3:
                break
            damping *= 1e3
            continue
        x, damping, last = tried[best], min(max(damping * _LAMBDAS[best], 1e-4), 1e4), losses[best]
        small = small + 1 if gain < (CONVERGED * u.n / 2 if first is not None else _SMALL_GAIN * loss) else 0
        if small == 2:
            break
    end = _linearise(problem, x, prior, worth)
    covariance = _compute_covariance(end.H, end.scatter, _find_held(u, x, end.g))
    return LoopFit(x, covariance, end.sigma, min(loss, last), k + 1)


class LoopPrior:
    """Prior cost of the unknowns of a fit: squared distances from their start, and the divergence of bodies from the file's."""

    def __init__(self, u: LoopUnknowns) -> None:
        """Take the start of the unknowns, and their prior."""
        self.unknowns, self.start = u, u.pack()
        self._precision = np.append(u.prior[u.free] ** -2.0, np.ones(u.space.n_unknowns))
        self._z = slice(u.n - u.space.n_unknowns, u.n)

    def enter(self, x: np.ndarray) -> np.ndarray:
        """Return a vector (n,) with consistent bodies: itself, or the farthest one on the line from the file's values."""
        z = x[self._z]
        if not len(z) or self.unknowns.space.bodies.find(z) is not None:
            return x
        return np.append(x[: self._z.start], self.unknowns.space.bodies.limit(np.zeros(len(z)), z) * z)

    def compute_cost(self, x: np.ndarray) -> float:
        """Return the cost of a vector (n,); infinite if a body is inconsistent."""
        found = self.unknowns.space.bodies.find(x[self._z]) if self._z.start < len(x) else None
        if found is None and self._z.start < len(x):
            return np.inf
        return float(self._precision @ (x - self.start) ** 2) + (found.value if found else 0.0)

    def differentiate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return half the curvature (n, n) and half the slope downwards (n,) at a vector (n,)."""
        H, g = np.diag(self._precision), -self._precision * (x - self.start)
        found = self.unknowns.space.bodies.find(x[self._z]) if self._z.start < len(x) else None
        if found is not None:
            H[self._z, self._z] += 0.5 * found.curvature
            g[self._z] -= 0.5 * found.gradient
        return H, g

    def limit(self, x: np.ndarray, step: np.ndarray) -> float:
        """Return the part of a step (n,) that keeps every body consistent."""
        return self.unknowns.space.bodies.limit(x[self._z], step[self._z]) if self._z.start < len(x) else 1.0


class _Linearised(NamedTuple):
    """A problem linearised about one vector.

    Attributes:
        residual: Residuals (M, na, S) [rad].
        H: Normal matrix, with the prior's (n, n).
        g: Right side, with the prior's (n,).
        scatter: Covariance of the gradient over blocks, with the prior's (n, n).
        sigma: Residual rms of each joint (na,) [rad].
        weight: Inverse variance of residuals (na, S).
        worth: Number of samples per independent one (na,).
        own: Whether the sensitivities belong to this vector, rather than to one nearby.
    """

    residual: np.ndarray
    H: np.ndarray
    g: np.ndarray
    scatter: np.ndarray
    sigma: np.ndarray
    weight: np.ndarray
    worth: np.ndarray
    own: bool


def _linearise(problem: LoopProblem, x: np.ndarray, prior: LoopPrior, worth: np.ndarray | None) -> _Linearised:
    """Return the problem about a vector (chord method).

    Sensitivities are valid within the steps of their differences.
    Reference: Kelley 1995, 5.4.
    """
    slopes = problem.slopes
    if slopes is None or np.any(np.abs(x - slopes.at) > problem.list_steps(slopes.at)):
        r, slopes = problem.differentiate(x)
    else:
        r = problem.residuals(x[:, None])[:, :, 0]
    sigma = np.maximum(np.sqrt((r**2).sum(axis=(0, 2)) / problem.count), 1e-7)
    if worth is None:
        worth = np.array([count_worth(r[:, j], problem.used) for j in range(r.shape[1])])
    weight = _weigh(problem, r, sigma) / worth[:, None]
    H, g, scatter = _accumulate(problem, r, slopes, weight)
    known, pull = prior.differentiate(x)
    return _Linearised(r, H + known, g + pull, scatter + known, sigma, weight, worth, slopes.at is x)


def _weigh(problem: LoopProblem, r: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the inverse variances (na, S) of residuals (M, na, S): one per log, within a factor of its joint's."""
    own = np.sqrt((r**2).sum(axis=0) / np.maximum(problem.used.sum(axis=0), 1))
    return np.clip(own, sigma[:, None] / MAX_CONTRAST, sigma[:, None] * MAX_CONTRAST) ** -2.0


def _accumulate(
    problem: LoopProblem, r: np.ndarray, slopes: Slopes, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normal matrix (n, n), right side (n,) and the gradient's scatter over blocks (n, n)."""
    n = problem.unknowns.n
    H, g = np.zeros((n, n)), np.zeros(n)
    blocks = problem.blocks.T.reshape(-1)
    sums = np.zeros((blocks.max() + 1, n))
    for j, (S, mine) in enumerate(zip(slopes.rows, slopes.owners, strict=True)):
        weights = np.broadcast_to(weight[j][:, None], r[:, j].T.shape).reshape(-1)
        weighed = S * weights
        H[np.ix_(mine, mine)] += S @ weighed.T
        weighed *= -r[:, j].T.reshape(-1)  # the residual's derivative is minus the position's
        g[mine] += weighed.sum(axis=1)
        for row, k in zip(weighed, mine, strict=True):
            sums[:, k] += np.bincount(blocks, weights=row, minlength=len(sums))
    blocks_used = max(2, int(np.count_nonzero(np.abs(sums).sum(axis=1))))
    most = max(len(mine) for mine in slopes.owners)
    return H, g, sums.T @ sums * blocks_used / max(blocks_used - most, 0.2 * blocks_used)


def _sum_squares(r: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the weighted sums of squares (C,) of residuals (M, na, C, S)."""
    return np.einsum("njcs,njcs,js->c", r, r, weight)


def _find_held(u: LoopUnknowns, x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the unknowns (n,) that a bound holds against the gradient."""
    m = int(u.free.sum())
    held = np.zeros(len(x), dtype=bool)
    held[:m] = ((x[:m] <= u.lower[u.free]) & (g[:m] <= 0)) | ((x[:m] >= u.upper[u.free]) & (g[:m] >= 0))
    return held


def _step(H: np.ndarray, g: np.ndarray, lam: float, held: np.ndarray, prior: LoopPrior, x: np.ndarray) -> np.ndarray:
    """Return the next vector by a damped step of the unknowns that are not at a bound, with consistent bodies."""
    loose = ~held
    d = np.zeros(len(x))
    A = H[np.ix_(loose, loose)]
    scale = np.sqrt(np.maximum(np.diag(A), _NO_INFORMATION))
    A = A / scale[:, None] / scale[None, :] + lam * np.eye(len(scale))
    d[loose] = np.linalg.lstsq(A, g[loose] / scale, rcond=1e-12)[0] / scale
    return prior.unknowns.clip(x + prior.limit(x, d) * d)


_NO_INFORMATION = 1e-12
"""Inverse variance of an unknown below which the logs do not show it at all."""


def _compute_covariance(H: np.ndarray, scatter: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Return the sandwich covariance (n, n), without the unknowns at bounds and those on which the logs have no information.

    It is scaled to the standard errors of stationary noise where those are larger: where few blocks determine an unknown, their
    residuals follow the fit, and the sandwich alone is too small.
    Reference: Angrist & Pischke 2009, 8.1.
    """
    loose = np.flatnonzero(~held & (np.diag(H) > _NO_INFORMATION))
    out = np.zeros_like(H)
    A = H[np.ix_(loose, loose)]
    scale = np.sqrt(np.diag(A))
    inverse = np.linalg.pinv(A / scale[:, None] / scale[None, :], rcond=1e-10) / scale[:, None] / scale[None, :]
    found = inverse @ scatter[np.ix_(loose, loose)] @ inverse
    robust = np.sqrt(np.maximum(np.diag(found), 1e-300))
    grow = np.maximum(1.0, np.sqrt(np.maximum(np.diag(inverse), 0.0)) / robust)
    out[np.ix_(loose, loose)] = found * grow[:, None] * grow[None, :]
    return out
