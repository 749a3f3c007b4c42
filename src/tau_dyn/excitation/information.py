"""Fisher information of a motion about the parameters, criteria of its quality, and the derivatives that a search needs.

    M = sum over samples and joints  g_j y_j y_j' / sigma_j^2,      y_j the row of joint j's base regressor

`g_j` in [0, 1] is the weight of a sample in identification: zero if the joint is slow or about to reverse, as the sign of its
friction is not sure there. A motion is a linear map of its coefficients, so M's derivative needs the regressor's by each
joint's position, speed and acceleration only: 3 na extra regressors, however many coefficients there are. They are finite
differences of the vectorised mechanism, effects included. A criterion gives its value and `Gamma = d value / d M`, symmetric:

    d          -log det M / r              the mean log variance: the volume of the confidence ellipsoid; scale-free
    condition  log cond of M with unit diagonal, halved: of the regressor with unit columns
    worst      log of the largest relative standard error, smoothly: (1 / p) log sum_k (s_k / scale_k)^p

The determinant has a gradient everywhere and does not depend on units; a condition number has no gradient if two singular values
are equal, and bounds no standard error. Reference: Kiefer & Wolfowitz 1960; Gautier & Khalil 1992; Swevers et al. 1997;
Ljung 1999, 13.

**Predicted standard errors** are the covariance of an estimate from a computed recording.

Along the motion, at the log's rate, the model gives the forces, with or without a simulated controller; noise is added to forces
and positions; the rest is identification as it will be done: its filters, its gate around reversals, its base parameters, its
coloured-noise covariance. The prediction lacks friction that deviates from the model's law, which no design can know. The
draw of the noise changes the errors by up to 20 %, more for a shorter motion, as on the robot.

Force noise is taken as white at the log's rate. A joint's encoder noise of standard deviation s_q makes, through the
acceleration that is differentiated from it, a force of density `m^2 (2 pi f)^4 s_q^2`; over a band up to f it weighs as much
as white noise of variance `m^2 (2 pi f)^4 s_q^2 / 5` would, with m the inertia that the joint feels at home.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.effects import Motion
from tau_dyn.estimate import MAX_RELATIVE_STDERR, BaseParameters, find_base, solve_least_squares
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.identify import build_regression
from tau_dyn.log import Log, estimate_encoder_noise
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import MotionProfile, Sensors, Trajectory, simulate

_POWER = 12.0  # of the p-norm that replaces the largest singular value, smooth if two are equal

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
"""Criteria by their names on the command line."""


def _unit(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d = 1 / np.sqrt(np.maximum(np.diag(M), 1e-300))
    return d, M * np.outer(d, d)


def _eigen(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, vectors = np.linalg.eigh(S)
    return np.maximum(values, 1e-14 * max(values[-1], 1e-300)), vectors


STEP = 1e-6
"""Step of the finite differences of positions [m or rad], speeds [per s] and accelerations [per s^2]."""
_UNKNOWN = 0.05  # share of the force that a parameter may take and still count as unknown


@dataclass(frozen=True, eq=False)
class InformationRows:
    """Result of one evaluation of the model along a path (n, na).

    Attributes:
        Y: White rows of the base regressor (n, na, r).
        tau: Forces (n, na) [N or N m].
    """

    Y: np.ndarray
    tau: np.ndarray


@dataclass(frozen=True, eq=False)
class Information:
    """Builder of white rows of one model's base parameters.

    Attributes:
        model: The model without effects that a single state does not determine.
        base: Base parameters of the free parameters, over the states of a random path.
        sigma: Force noise of each joint, equivalent to all its noise (na,).
        window_s: Time around a reversal that identification leaves out, to each side [s].
        slow: Slowest speed with a sure sign (na,).
        scale: Unit of each base parameter's error (r,); see `compute_parameter_scales`.
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
            CannotAnswer: No free parameter affects the forces.
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
        """Prior information (r, r): parameters measured by other means."""
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
        """Return the derivatives of rows and forces by each of q, v, a (0, 1, 2) of each joint."""
        out = []
        for kind in range(3):
            for j in range(path.q.shape[1]):
                moved = [x.copy() for x in path]
                moved[kind][:, j] += STEP
                there = self.rows(MotionProfile(*moved), steep=False)
                out.append((kind, j, (there.Y - at.Y) / STEP, (there.tau - at.tau) / STEP))
        return out


def compute_parameter_scales(values: np.ndarray, units: Sequence[str], W: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return the scales (r,) that errors of parameters are compared with.

    The scale is the parameter's value, or a tenth of the largest value of its unit if that is larger. If all values of a unit are
    zero (friction before any measurement), it is the value that would make a twentieth of the rms force.

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


PER_JOINT = "one number, or one for each of the {} actuated joints"


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of the noise of a log.

    Attributes:
        force: Standard deviation of forces (na,) [N or N m].
        encoder: Standard deviation of positions (na,) [m or rad].
        rate_hz: Rate of the log [Hz].
        source: Origin of the numbers, in words.
    """

    force: np.ndarray
    encoder: np.ndarray
    rate_hz: float = 1000.0
    source: str = "given"

    @classmethod
    def given(
        cls,
        robot: Robot,
        force: Sequence[float] | np.ndarray,
        encoder: Sequence[float] | np.ndarray,
        rate_hz: float = 1000.0,
        source: str = "given",
    ) -> Noise:
        """Return noise from one number for all joints or one for each.

        Raises:
            InputError: Their number is wrong, or a force noise is not above zero.
        """
        na, found = robot.na, []
        for name, values in (("force", force), ("encoder", encoder)):
            x = np.asarray(values, float).ravel()
            if len(x) not in (1, na):
                raise InputError("wrong_shape", f"{name} noise: give {PER_JOINT.format(na)}, not {len(x)}")
            found.append(np.broadcast_to(x, (na,)).copy())
        if not np.all(found[0] > 0):
            raise InputError(
                "invalid_value", "force noise must be above zero; without noise every motion determines all parameters"
            )
        return cls(found[0], found[1], rate_hz, source)

    @classmethod
    def typical(cls, model: Model, tau: np.ndarray, rate_hz: float = 1000.0) -> Noise:
        """Return the noise of a good industrial drive: 1 % of the forces' rms (n, na), half an encoder step; see `Sensors`."""
        sensors = Sensors.typical(model.robot)
        rms = np.sqrt(np.mean(tau**2, axis=0))
        force = np.maximum(0.01 * rms, 1e-3 * float(rms.max(initial=0.0)))
        force = np.where(force > 0, force, 1.0)
        step = np.broadcast_to(np.asarray(sensors.encoder_noise, float), (model.robot.na,))
        return cls(force, step.copy(), rate_hz, "typical of good drives: 1 % of the rms force, half an encoder step")

    def weighing(self, model: Model, band_hz: float) -> np.ndarray:
        """Return the force noise (na,) equivalent to the noise of forces and encoders together, up to a frequency [Hz]."""
        inertia = np.diagonal(model.mechanism.inertia(model.robot.home[None])[0])
        return np.hypot(self.force, inertia * (2 * np.pi * band_hz) ** 2 * self.encoder / np.sqrt(5))


@dataclass(frozen=True, eq=False)
class InformationPrediction:
    """Predicted standard errors of a motion.

    Attributes:
        names: Base parameters' first names (r,).
        expressions: The base parameters in words (r,); equal to the name for a single parameter.
        units: Their units (r,).
        values: The model's values (r,).
        stderr: Standard errors (r,).
        scale: Scales that errors are compared with (r,); see `compute_parameter_scales`.
        condition: Condition number of the regressor with unit columns, as identification will report it.
    """

    names: tuple[str, ...]
    expressions: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    stderr: np.ndarray
    scale: np.ndarray
    condition: float

    @property
    def relative(self) -> np.ndarray:
        """Standard errors over their scale (r,)."""
        return self.stderr / self.scale

    @property
    def worst(self) -> tuple[str, float]:
        """Return the parameter with the largest relative error, and that error."""
        k = int(np.argmax(self.relative))
        return self.expressions[k], float(self.relative[k])

    def rows(self) -> list[Mapping[str, Any]]:
        """Return one plain row for each base parameter."""
        made = zip(self.names, self.expressions, self.units, self.values, self.stderr, strict=True)
        return [
            {
                "name": name,
                "expression": words,
                "unit": unit,
                "value": float(value),
                "stderr": float(error),
                "determined": bool(error < MAX_RELATIVE_STDERR * abs(value)),
            }
            for name, words, unit, value, error in made
        ]


def predict(
    model: Model,
    motion: Trajectory,
    noise: Noise,
    seed: int = 0,
    *,
    driven: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> InformationPrediction:
    """Return the standard errors that a motion will give.

    Args:
        model: Robot and effects at their likely values; effects that need more than a state are left out.
        motion: The motion.
        noise: Noise of forces and encoders, and the log's rate.
        seed: Seed of the noise.
        driven: Whether the robot is simulated with its controller, which takes seconds; else it follows the motion exactly, which
            is enough to compare motions but lacks effects of drives (held forces, feedback of the encoders' noise).
        progress: Callback that receives the finished share of the simulation.

    Raises:
        CannotAnswer: The motion carries no information: too slow or too short.
    """
    model = model.steady()
    log = (
        simulate_log(model, motion, noise, seed, progress) if driven else predict_ideal_log(model, motion, noise, seed)
    )
    estimate = solve_least_squares(build_regression(model, [log]))
    base = estimate.base
    rows = model.parameters.select([base.names[k] for k in base.kept])
    combined = base.combine(np.array([model.parameters[name].value for name in base.names]))
    names = tuple(p.name for p in rows)
    units = tuple(p.unit for p in rows)
    words = tuple(base.expression(k) for k in range(base.rank))
    stderr = np.sqrt(np.diag(estimate.cov))
    W, y, _ = estimate.regression.stacked()
    scale = compute_parameter_scales(combined, units, W[:, np.flatnonzero(model.parameters.free)[base.kept]], y)
    return InformationPrediction(names, words, units, combined, stderr, scale, estimate.cond)


def predict_ideal_log(model: Model, motion: Trajectory, noise: Noise, seed: int = 0) -> Log:
    """Return the log of a robot that follows the motion exactly."""
    moved, rng = motion.resampled(noise.rate_hz), np.random.default_rng(seed)
    tau = model.torque(moved.q, moved.v, moved.a)
    shape, channels = tau.shape, {}
    q = moved.q + noise.encoder * rng.standard_normal(shape)
    tau = tau + noise.force * rng.standard_normal(shape)
    for k, joint in enumerate(motion.joints):
        channels |= {f"q_{joint}": q[:, k], f"tau_{joint}": tau[:, k]}
    return Log(moved.t, channels, "the predicted recording")


def simulate_log(
    model: Model,
    motion: Trajectory,
    noise: Noise,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> Log:
    """Return the log of a simulated robot with its controller; for a motion that it cannot follow, the ideal log."""
    sensors = Sensors(force_noise=noise.force.tolist(), encoder_noise=noise.encoder.tolist())
    try:
        return simulate(model, motion, sensors=sensors, seed=seed, rate_hz=noise.rate_hz, progress=progress)
    except TauDynError:
        return predict_ideal_log(model, motion, noise, seed)


def estimate_log_noise(model: Model, log: Log, rate_hz: float) -> Noise:
    """Return the noise of a recording: that of the encoders, and the residual of the forces after a fit of the model.

    Args:
        model: The fitted model.
        log: Log with `q_J` and `tau_J`.
        rate_hz: Rate of the log to come [Hz].

    Raises:
        InputError: The log lacks a column.
        CannotAnswer: Its excitation is too poor for the model.
    """
    model = model.steady()
    estimate = solve_least_squares(build_regression(model, [log]))
    cutoff = float(estimate.regression.preparation.force_cutoff_hz)
    force = estimate.sigma * np.sqrt(rate_hz / (2 * cutoff))  # white, with the residual's density below the low-pass
    encoder = estimate_encoder_noise(log.joint("q", model.robot.actuated))
    return Noise.given(model.robot, force, encoder, rate_hz, f"what a fit leaves of {log.name}")
