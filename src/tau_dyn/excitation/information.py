r"""The information a motion carries about the parameters, on a coarse grid, and its derivative by the motion.

    M = sum over samples and joints  g_j y_j y_j' / sigma_j^2,      y_j the row of joint j's base regressor

`g_j` in [0, 1] is what identification leaves of a sample: nothing where the joint is slow or about to reverse, as the sign of
its friction is not sure there. A motion is a linear map of its coefficients, so M's derivative needs the regressor's by each
joint's position, speed and acceleration only: 3 na extra regressors, however many coefficients there are. They are finite
differences of the vectorised mechanism, effects included. Reference: Swevers et al. 1997; Ljung 1999, 13.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tau_dyn.effects import Motion
from tau_dyn.estimate import BaseParameters, find_base
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.model import Model
from tau_dyn.simulate import MotionProfile

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

    @cached_property
    def _kept(self) -> np.ndarray:
        return np.flatnonzero(self.model.parameters.free)[self.base.kept]

    @cached_property
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
