r"""Stiffness and damping of a robot's springs from vibration records at several poses, one joint fit.

Maximum likelihood in the frequency domain (Pintelon & Schoukens 2012, ch. 9): with the receptances of `receptance.py`,

    min over theta of sum |(Y - Y(theta) - N c) / sigma|^2 + prior,    theta_i = log k_i, eta_i = d_i w_0 / k_i

over all lines of all stretches. `N c` are the ends of a stretch and the noise of a force in contact (`contact.py`); `c` is
eliminated. `sigma` is the residual's standard deviation, averaged over neighbouring lines, in turn with the fit. Standard errors
are those of the information matrix. Geometry and masses count as exact.

A resonance is narrow, so the cost has many minima. The fit begins with all transforms along `s = sigma + j w`, `sigma` large,
which is an exponential window: resonances are wide there, and the springs' first estimate may be off by a factor of ten. `sigma`
decreases in steps to zero (a homotopy). The start of springs without a value is the stiffness that brings each coordinate's own
mass into resonance in the middle of the band, times a factor for drives and one for other springs, by the least cost.

The prior of a stiffness has a standard deviation of a factor of ten: it holds springs that no record determines, and is
negligible for all others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.ndimage import uniform_filter1d

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import FlexibleModel
from tau_dyn.modes.springs.channels import PosedRecord, Spectrum, transform
from tau_dyn.modes.springs.receptance import PoseModel, Responses, build_pose_model
from tau_dyn.modes.springs.result import FittedSpring, RecordFit
from tau_dyn.robot import Spring

STIFFNESS_PRIOR = float(np.log(10.0))
"""Prior standard deviation of a stiffness' logarithm."""
LOSS, LOSS_PRIOR = 0.03, 0.3
"""Prior of the loss factor `d w_0 / k`, twice the damping ratio of one spring: machines have 0.5 to 5 % of damping ratio."""
WINDOWS = (0.3, 0.1, 0.05, 0.02, 0.01, 0.003)
"""`sigma` of the homotopy as a share of the band: from beyond the usual distance of resonances to their usual width."""
FACTORS = 10.0 ** np.arange(-3, 5.5, 1.0)
"""Factors of the stiffness that are tried at the start."""
STARTS, STATED_STARTS, START_STEPS = 8, 2, 20
"""Best of these from which the fit is begun, if some springs have no value and if all have one, and its steps."""
MAX_STARTS = 4
"""Starts from which the fit is begun; the end with the smallest residual counts."""
START_SPACING = 0.3
"""Least difference of the stiffnesses' logarithms of two starts that may end in different minima."""
ROUGH_ERROR, ROUGH_FLOOR = 0.1, 0.01
"""Relative errors of a line and of an output's mean, by which transforms with `sigma` above zero are weighted."""
CONVERGED = 1e-3
"""Step in standard errors that ends the fit."""
MAX_LOG_STEP = 0.7
"""Largest step of a stiffness' logarithm: a factor of two."""
MIN_AVERAGED_LINES = 60
"""Lines over which the noise is averaged: its estimate is then accurate to 10 %, which widens no error noticeably."""
RIDGE = 1e-10
"""Added to the normalised products of nuisance columns: above rounding, and below 1e-5 of a column."""
NUMERICAL_NOISE = 1e-6
"""Noise relative to an output's size below which a record counts as computed, not measured."""


@dataclass(frozen=True, eq=False)
class SpringProblem:
    """Records, models at their poses, and the springs at which these were linearised.

    `theta` (t,) holds the logarithms of the fitted stiffnesses (n,), their loss factors (n,), and those of the drives with known
    forces, `d / (m w_0)` with the mass `m` that they see.

    Attributes:
        flexible: The robot with the springs of the linearisation.
        fitted: Which of its springs are fitted (ns,).
        records: The records.
        models: The robot at the pose of each record.
        free: Drives with known forces.
        w0: Angular frequency in the middle of the band [rad/s].
        prior: Mean of the prior (t,).
    """

    flexible: FlexibleModel
    fitted: np.ndarray
    records: tuple[PosedRecord, ...]
    models: tuple[PoseModel, ...]
    free: tuple[str, ...]
    w0: float
    prior: np.ndarray

    @classmethod
    def build(cls, flexible: FlexibleModel, fitted: np.ndarray, records: Sequence[PosedRecord]) -> SpringProblem:
        """Return the problem at the springs of a robot."""
        lines = [transform(piece).s.imag for record in records for piece in record.pieces]
        w0 = float(np.sqrt(np.median([x.min() for x in lines]) * np.median([x.max() for x in lines])))
        free = tuple(dict.fromkeys(joint for record in records for joint in record.free))
        values = np.array([s.stiffness for s in flexible.springs])[fitted]
        prior = np.concatenate([np.log(values), np.full(len(values) + len(free), LOSS)])
        return cls(flexible, fitted, tuple(records), (), free, w0, prior).linearise(prior)

    @property
    def n(self) -> int:
        """Number of fitted springs."""
        return int(self.fitted.sum())

    def at_records(self, records: Sequence[PosedRecord], theta: np.ndarray) -> SpringProblem:
        """Return the problem of other records."""
        return replace(self, records=tuple(records)).linearise(theta)

    def linearise(self, theta: np.ndarray) -> SpringProblem:
        """Return the problem linearised about rest with other springs.

        Raises:
            InputError: The springs are too soft for the robot's weight.
        """
        flexible = self.flexible.with_springs(self.build_springs(theta))
        models = tuple(build_pose_model(flexible, record) for record in self.records)
        return replace(self, flexible=flexible, models=models)

    def move(self, theta: np.ndarray) -> SpringProblem:
        """Return the problem linearised about rest with other springs, or unchanged if these do not carry the weight."""
        try:
            return self.linearise(theta)
        except InputError:
            return self

    def start(self, has_value: np.ndarray) -> list[tuple[np.ndarray, SpringProblem]]:
        """Return first estimates (t,), the best first, each with the problem there and its prior for springs without a value.

        Args:
            has_value: Which fitted springs have a value in the robot file (n,).
        """
        n, theta = self.n, self.prior.copy()
        mass = np.max([np.diag(m.M)[m.parameters[: len(self.fitted)]] for m in self.models], axis=0)[self.fitted]
        theta[:n] = np.where(has_value, self.prior[:n], np.log(mass * self.w0**2))
        wide, narrow = (self.transform_all(share) for share in WINDOWS[:2])
        moved = [theta + np.concatenate([move, np.zeros(len(theta) - n)]) for move in self._list_moves(has_value)]
        starts = self._rank(moved, wide)[: STATED_STARTS if has_value.all() else STARTS]
        ends = self._rank([self.descend(start, wide, START_STEPS)[0] for start in starts], wide)[:MAX_STARTS]
        found = []
        for theta in self._rank([self.descend(end, narrow, START_STEPS)[0] for end in ends], narrow):
            prior = np.concatenate([np.where(has_value, self.prior[:n], theta[:n]), self.prior[n:]])
            found.append((theta, replace(self, prior=prior).move(theta)))
        return found

    def _rank(self, points: Sequence[np.ndarray], spectra: Sequence[Sequence[Spectrum]]) -> list[np.ndarray]:
        """Return values (t,) by their cost, the least first, without those next to a better one."""
        ranked = sorted((self.measure(point, spectra)[0], tuple(point)) for point in points)
        kept: list[np.ndarray] = []
        for point in (np.array(x) for _, x in ranked):
            if not any(np.abs(point - other)[: self.n].max() < START_SPACING for other in kept):
                kept.append(point)
        return kept

    def _list_moves(self, has_value: np.ndarray) -> list[np.ndarray]:
        """Return changes of the stiffnesses' logarithms (n,) that are tried: a factor for each kind of spring."""
        if has_value.all():
            return [np.full(self.n, x) for x in np.log(FACTORS)]
        at = np.flatnonzero(self.fitted)
        drives = at >= len(self.flexible.robot.springs)
        kinds = [x for x in (has_value, ~has_value & drives, ~has_value & ~drives) if x.any()]
        return [np.sum([x * kind for x, kind in zip(some, kinds, strict=True)], axis=0)
                for some in product(np.log(FACTORS), repeat=len(kinds))]  # fmt: skip

    def build_springs(self, theta: np.ndarray) -> list[Spring]:
        """Return all springs of the robot at some values."""
        springs = list(self.flexible.springs)
        for k, at in enumerate(np.flatnonzero(self.fitted)):
            stiffness = float(np.exp(theta[k]))
            springs[at] = replace(
                springs[at], stiffness=stiffness, damping=float(theta[self.n + k]) * stiffness / self.w0
            )
        return springs

    def transform_all(self, share: float) -> list[list[Spectrum]]:
        """Return the transforms of all stretches by record, under a window of a share of the record's band."""
        found = []
        for record in self.records:
            band = max(transform(piece).s.imag.max() for piece in record.pieces) if share else 0.0
            found.append([transform(piece, share * band) for piece in record.pieces])
        return found

    def descend(
        self, theta: np.ndarray, spectra: Sequence[Sequence[Spectrum]], most: int
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the minimum, the information (t, t) and the steps taken, with the noise of the start.

        Damped Gauss-Newton steps (Levenberg-Marquardt).
        """
        cost, information, gradient, noise = self.measure(theta, spectra)
        damping = 1e-3
        for step in range(most):
            scale = np.diag(np.diag(information))
            move = -np.linalg.solve(information + damping * scale, gradient)
            move *= min(1.0, MAX_LOG_STEP / max(float(np.abs(move[: self.n]).max()), 1e-300))
            if move @ information @ move < CONVERGED**2 * len(theta):
                return theta, information, step
            tried = self.measure(theta + move, spectra, noise)
            if tried[0] <= cost:
                theta, damping = theta + move, max(damping / 5, 1e-9)
                cost, information, gradient = tried[:3]
            else:
                damping *= 8
        return theta, information, most

    def measure(
        self, theta: np.ndarray, spectra: Sequence[Sequence[Spectrum]], noise: Sequence[np.ndarray] | None = None
    ) -> tuple[float, np.ndarray, np.ndarray, list[np.ndarray]]:
        """Return the cost, the information (t, t), half the cost's gradient (t,), and the noise of every stretch (F, p).

        Args:
            theta: Values (t,).
            spectra: Transforms by record.
            noise: Standard deviation of real and imaginary part of each line (F, p) of every stretch; None estimates it.
        """
        spread = np.where(np.arange(len(theta)) < self.n, STIFFNESS_PRIOR, LOSS_PRIOR)
        away = (theta - self.prior) / spread
        cost, information, gradient, used = float(away @ away), np.diag(spread**-2), away / spread, []
        for record, model, some in zip(self.records, self.models, spectra, strict=True):
            at, slopes = self._set(model, record, theta)
            for spectrum, found in zip(some, at.respond(some), strict=True):
                nuisance, n_known = _list_nuisance(at, spectrum, found)
                residual = spectrum.y - found.value
                if noise is None:
                    used.append(_estimate_noise(spectrum, residual, nuisance, n_known))
                else:
                    used.append(noise[len(used)])
                by_stiffness = found.differentiate(at.parameters)
                columns = by_stiffness @ slopes[0] + (spectrum.s[:, None, None] * by_stiffness) @ slopes[1]
                both = np.concatenate([residual[:, :, None], columns], axis=2)
                rows, ends = (_stack(_weigh(x, used[-1], spectrum.s)) for x in (both, nuisance))
                gram = _compute_gram(rows, ends, n_known)
                cost += float(gram[0, 0])
                information += gram[1:, 1:]
                gradient = gradient - gram[1:, 0]
        return cost, information, gradient, used

    def _set(self, model: PoseModel, record: PosedRecord, theta: np.ndarray) -> tuple[PoseModel, np.ndarray]:
        """Return a pose's model at some values, and the derivatives of stiffness and damping by `theta` (2, c, t).

        `c` counts springs and the record's drives with known forces.
        """
        n, springs = self.n, self.build_springs(theta)
        k, d, before = (
            np.array([getattr(s, name) for s in some])
            for some, name in ((springs, "stiffness"), (springs, "damping"), (self.flexible.springs, "stiffness"))
        )
        own = [2 * n + self.free.index(joint) for joint in record.free]
        mass = np.diag(model.M)[: len(own)] * self.w0
        slopes, at = np.zeros((2, len(k) + len(own), len(theta))), np.flatnonzero(self.fitted)
        slopes[0, at, np.arange(n)] = k[at]
        slopes[1, at, np.arange(n)] = d[at]
        slopes[1, at, n + np.arange(n)] = k[at] / self.w0
        slopes[1, len(k) + np.arange(len(own)), own] = mass
        return model.with_springs(k, np.concatenate([d, theta[own] * mass]), before), slopes

    def list_fitted(
        self, theta: np.ndarray, covariance: np.ndarray, nominal: Mapping[str, float]
    ) -> list[FittedSpring]:
        """Return the fitted springs with standard errors.

        Args:
            theta: Values (t,).
            covariance: Their covariance (t, t).
            nominal: Stiffness in the robot file by joint.
        """
        n, springs, robot = self.n, self.build_springs(theta), self.flexible.robot
        units, out = dict(zip(self.flexible.freed.actuated, self.flexible.freed.position_units, strict=True)), []
        for k, at in enumerate(np.flatnonzero(self.fitted)):
            spring, rows = springs[at], [k, n + k]
            slope = np.array([spring.damping, spring.stiffness / self.w0])
            out.append(
                FittedSpring(
                    replace(spring, stiffness_stderr=float(spring.stiffness * np.sqrt(covariance[k, k]))),
                    float(np.sqrt(slope @ covariance[np.ix_(rows, rows)] @ slope)),
                    "N/m" if units[spring.joint] == "m" else "N m/rad",
                    bool(at >= len(robot.springs)),
                    nominal.get(spring.joint),
                )
            )
        return out

    def judge(self, theta: np.ndarray, *, held_out: bool) -> list[RecordFit]:
        """Return how well the springs reproduce each record, ends of stretches aside."""
        out = []
        for record, model, spectra in zip(self.records, self.models, self.transform_all(0.0), strict=True):
            at, _ = self._set(model, record, theta)
            missed, size = np.zeros((2, len(record.outputs)))
            for spectrum, found in zip(spectra, at.respond(spectra), strict=True):
                nuisance, n_known = _list_nuisance(at, spectrum, found)
                residual = spectrum.y - found.value
                sigma = _estimate_noise(spectrum, residual, nuisance, n_known)
                left = _project(residual, nuisance, n_known, sigma, spectrum.s)
                missed += np.sum(np.abs(left) ** 2, axis=0)
                size += np.sum(np.abs(spectrum.y) ** 2, axis=0)
            springs = at.parameters[: len(self.fitted)]
            held = np.ix_(springs, springs)
            squares = eigh(at.K[held], at.M[held], eigvals_only=True)
            hz = np.sqrt(np.maximum(squares, 0)) / (2 * np.pi)
            band = max(x.s.imag.max() for x in spectra) / (2 * np.pi)
            fit = 100 * (1 - np.sqrt(missed / np.maximum(size, 1e-300)))
            out.append(RecordFit(record.name, tuple(record.q), tuple(fit), tuple(hz[hz < band]), held_out))
        return out


def _list_nuisance(at: PoseModel, spectrum: Spectrum, found: Responses) -> tuple[np.ndarray, int]:
    """Return columns (F, p, c) of ends and of the force's errors in contact, and how many of the last ones have a prior."""
    if spectrum.s.real.any():
        return np.zeros((*spectrum.y.shape, 0)), 0
    by_force = found.by_error * spectrum.errors[:, None]
    return np.concatenate([at.build_end_columns(spectrum, found), by_force], axis=2), by_force.shape[2]


def _estimate_noise(spectrum: Spectrum, residual: np.ndarray, nuisance: np.ndarray, n_known: int) -> np.ndarray:
    """Return the standard deviation of real and imaginary part of each line (F, p), as an average over lines."""
    size = np.sqrt(np.mean(np.abs(spectrum.y) ** 2, axis=0))
    if spectrum.s.real.any():
        return np.hypot(ROUGH_ERROR * np.abs(spectrum.y), ROUGH_FLOOR * size)
    left = _project(residual, nuisance, n_known, np.broadcast_to(size, residual.shape), spectrum.s)
    power = np.abs(left) ** 2 / 2
    lost = 1 - (nuisance.shape[2] - n_known + 2 * residual.shape[1]) / (2 * residual.size)
    lines = min(len(power), max(MIN_AVERAGED_LINES, len(power) // 10))
    return np.sqrt(
        uniform_filter1d(power, lines, axis=0, mode="nearest") / max(lost, 0.1) + (NUMERICAL_NOISE * size) ** 2
    )


def _stack(x: np.ndarray) -> np.ndarray:
    """Return real, then imaginary parts of (F, p, c) as rows (2 F p, c)."""
    rows = x.reshape(x.shape[0] * x.shape[1], x.shape[2])
    return np.concatenate([rows.real, rows.imag])


def _weigh(x: np.ndarray, sigma: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return (F, p, c) over the standard deviation (F, p), without what offsets `a_p + b_p s` of the outputs explain.

    On the imaginary axis an offset is real and a slope imaginary, so that each is one sum. Windowed stretches have none.
    """
    x = x / sigma[:, :, None]
    if s.real.any():
        return x
    return _leave_out(x.real, 1 / sigma) + 1j * _leave_out(x.imag, s.imag[:, None] / sigma)


def _leave_out(x: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return (F, p, c) without the multiple of a column (F, p) that explains each output."""
    share = np.einsum("fp,fpc->pc", column, x) / np.sum(column**2, axis=0)[:, None]
    return x - column[:, :, None] * share


def _project(residual: np.ndarray, nuisance: np.ndarray, n_known: int, sigma: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return residuals (F, p) without the part that nuisance columns (F, p, m) and offsets explain at a deviation (F, p)."""
    rows, columns = (_weigh(x, sigma, s) for x in (residual[:, :, None], nuisance))
    flat = _stack(columns)
    c = _solve_nuisance(flat, n_known, flat.T @ _stack(rows)[:, 0])
    return sigma * (rows[:, :, 0] - columns @ c)


def _compute_gram(rows: np.ndarray, nuisance: np.ndarray, n_known: int) -> np.ndarray:
    """Return the products (c, c) of rows (N, c) of which nuisance columns (N, m) explain nothing any more."""
    mixed = nuisance.T @ rows
    return rows.T @ rows - mixed.T @ _solve_nuisance(nuisance, n_known, mixed)


def _solve_nuisance(nuisance: np.ndarray, n_known: int, right: np.ndarray) -> np.ndarray:
    """Return least-squares coefficients (m, ..) of columns (N, m), the last `n_known` of which have a unit prior.

    Columns are scaled to one; a ridge of `RIDGE` holds those that others repeat.
    """
    m = nuisance.shape[1]
    if m == 0:
        return right
    gram = nuisance.T @ nuisance
    gram[range(m - n_known, m), range(m - n_known, m)] += 1.0
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram = gram * np.outer(scale, scale) + RIDGE * np.eye(m)
    scaled = right * (scale if right.ndim == 1 else scale[:, None])
    found = cho_solve(cho_factor(gram), scaled)
    return found * (scale if right.ndim == 1 else scale[:, None])
