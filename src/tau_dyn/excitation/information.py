"""The information a motion carries about the parameters, what makes it good, and the derivatives that a search needs.

    M = sum over samples and joints  g_j y_j y_j' / sigma_j^2,      y_j the row of joint j's base regressor

`g_j` in [0, 1] is what identification leaves of a sample: nothing where the joint is slow or about to reverse, as the sign of
its friction is not sure there. A motion is a linear map of its coefficients, so M's derivative needs the regressor's by each
joint's position, speed and acceleration only: 3 na extra regressors, however many coefficients there are. They are finite
differences of the vectorised mechanism, effects included. A criterion gives its value and `Gamma = d value / d M`, symmetric:

    d          -log det M / r              the mean log variance: the volume of the confidence ellipsoid; scale-free
    condition  log cond of M with unit diagonal, halved: of the regressor with unit columns
    worst      log of the largest relative standard error, smoothly: (1 / p) log sum_k (s_k / scale_k)^p

The determinant has a gradient everywhere and does not depend on units; a condition number has none where two singular values
meet, and bounds no standard error. Reference: Kiefer & Wolfowitz 1960; Gautier & Khalil 1992; Swevers et al. 1997;
Ljung 1999, 13.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.effects import Motion
from tau_dyn.estimate import BaseParameters, find_base
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.model import Model
from tau_dyn.simulate import MotionProfile

_POWER = 12.0  # of the p-norm that stands for the largest singular value, smooth where two are equal

Criterion = Callable[[np.ndarray, np.ndarray], tuple[float, np.ndarray]]
"""From M (r, r) and the parameters' scales (r,) to a value and its derivative (r, r)."""


def compute_d_criterion(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return minus the mean log eigenvalue of M."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    inverse = (vectors / values) @ vectors.T
    value = -(np.sum(np.log(values)) - 2 * np.sum(np.log(d))) / len(M)
    return float(value), -inverse * np.outer(d, d) / len(M)


def compute_condition_criterion(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return half the log condition number of M at unit diagonal."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    gamma = np.zeros_like(M)
    for k, sign in ((-1, 0.5), (0, -0.5)):
        u = vectors[:, k]
        gamma += sign * (np.outer(u * d, u * d) / values[k] - np.diag(u**2 * d**2))
    return float(0.5 * np.log(values[-1] / values[0])), gamma


def compute_largest_error(M: np.ndarray, scale: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log of the largest standard error relative to the scales, smoothed by a power mean."""
    d, S = _unit(M)
    values, vectors = _eigen(S)
    C = (vectors / values) @ vectors.T * np.outer(d, d)
    s = np.sqrt(np.diag(C)) / scale
    share = (s / s.max()) ** _POWER
    weight = share / share.sum() / (2 * np.diag(C))
    return float(np.log(s.max()) + np.log(share.sum()) / _POWER), -(C * weight) @ C


CRITERIA: dict[str, Criterion] = {
    "d": compute_d_criterion,
    "condition": compute_condition_criterion,
    "worst": compute_largest_error,
}
"""Every criterion by the name that the command line takes."""


def _unit(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    return d, M * np.outer(d, d)


def _eigen(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = np.linalg.eigh(S)
    return np.maximum(values, 1e-14 * max(values[-1], 1e-300)), vectors


STEP = 1e-6
"""Of the finite differences [m or rad, a second, a second squared]."""
_UNKNOWN = 0.05  # share of the force that a parameter may take and still count as unknown


@dataclass(frozen=True, eq=False)
class InformationRows:
    """What one evaluation of the model gives along a path (n, na).

    Attributes:
        Y: White rows of the base regressor (n, na, r).
        tau: Forces (n, na) [N or N m].
    """

    Y: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True, eq=False)
class Information:
    """Makes white rows of one model's base parameters.

    Attributes:
        model: Without effects that a single state does not determine.
        base: Of the free parameters, over the states of a random path.
        sigma: Force noise of each joint that weighs all there is (na,).
        window_s: Time around a reversal that identification leaves out, to each side [s].
        slow: Slowest speed with a sure sign (na,).
        scale: What each base parameter's error is counted in (r,); see `compute_parameter_scales`.
    """

    model: Model
    base: BaseParameters
    sigma: np.ndarray
    window_s: float
    slow: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, model: Model, sigma: np.ndarray, window_s: float, slow: np.ndarray, path: MotionProfile) -> Information:
        """Find the base parameters on the states of a path (n, na).

        Raises:
            CannotAnswer: No free parameter shows in the forces.
        """
        model = model.steady()
        free = [p for p in model.parameters if p.free]
        W = model.regressor(path.q, path.v, path.a)[:, :, model.parameters.free].reshape(-1, len(free))
        base = find_base(W, tuple(p.name for p in free), units=[p.unit for p in free])
        if base.rank == 0:
            raise CannotAnswer(
                "not_identifiable",
                "no free parameter shows in the forces of this robot",
                "free some with --free, or name another model",
            )
        rows = model.parameters.select([base.names[k] for k in base.kept])
        values = base.combine(np.array([model.parameters[name].value for name in base.names]))
        tau = model.torque(path.q, path.v, path.a)
        scale = compute_parameter_scales(values, [p.unit for p in rows], W[:, base.kept], tau)
        return cls(model, base, sigma, window_s, slow, scale)

    @property
    def _kept(self) -> np.ndarray:
        return np.flatnonzero(self.model.parameters.free)[self.base.kept]

    @property
    def prior(self) -> np.ndarray:
        """Information that is there beforehand (r, r): parameters measured by other means."""
        rows = [self.model.parameters[self.base.names[k]].prior_stderr for k in self.base.kept]
        return np.diag([1 / float(s) ** 2 if s else 0.0 for s in rows])

    def rows(self, path: MotionProfile, *, steep: bool = True) -> InformationRows:
        """Return white rows and forces along a path (n, na); with `steep` signs are those of the speeds."""
        q, v, a = path
        sign = np.sign(v) if steep else v / np.sqrt(v**2 + self.slow**2)
        motion: Motion = self.model.motion(q, v, a, sign)
        columns = self.model.columns(motion)
        left = v**2 / (v**2 + (a * self.window_s) ** 2 + self.slow**2)
        Y = columns[:, :, self._kept] * (np.sqrt(left) / self.sigma)[:, :, None]
        return InformationRows(Y, columns @ self.model.parameters.values)

    def derivatives(self, path: MotionProfile, at: InformationRows) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
        """Return, for each of q, v, a (0, 1, 2) and each joint, how rows and forces change with it."""
        out = []
        for kind in range(3):
            for j in range(path.q.shape[1]):
                moved = [x.copy() for x in path]
                moved[kind][:, j] += STEP
                there = self.rows(MotionProfile(*moved), steep=False)
                out.append((kind, j, (there.Y - at.Y) / STEP, (there.tau - at.tau) / STEP))
        return out


def compute_parameter_scales(values: np.ndarray, units: Sequence[str], W: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return what errors of parameters (r,) are compared with.

    That is the value; of a small one a tenth of the largest of its unit; where a unit has no value at all (friction before
    it was ever measured) what would make a twentieth of the rms force.

    Args:
        values: The parameters (r,).
        units: Their units.
        W: Columns of the regressor (n, r).
        tau: Forces (..., ) [N or N m].
    """
    share = _UNKNOWN * float(np.sqrt(np.mean(tau**2))) / np.maximum(np.sqrt(np.mean(W**2, axis=0)), 1e-300)
    out = []
    for k, (value, unit) in enumerate(zip(np.abs(values), units, strict=True)):
        largest = max(abs(float(x)) for x, other in zip(values, units, strict=True) if other == unit)
        out.append(max(float(value), 0.1 * largest) or float(share[k]) or 1.0)
    return np.array(out)


def compute_information_matrix(rows: InformationRows) -> np.ndarray:
    """Return the sum of the outer products of all white rows (r, r)."""
    flat = rows.Y.reshape(-1, rows.Y.shape[2])
    return flat.T @ flat
