"""Standard errors before anything moves: the estimate's own covariance, of a recording that is only computed.

Along the motion, at the log's rate, the model gives the forces, with or without a simulated controller; noise is added to forces
and positions; the rest is identification as it will be done: its filters, its gate around reversals, its base parameters, its
coloured-noise covariance. What is not in it is what no design can know: friction that is not the model's law. The noise's draw
moves the errors by up to 20 %, the more the shorter the motion, as it will on the robot.

Force noise is taken as white at the log's rate. A joint's encoder noise of standard deviation s_q makes, through the
acceleration that is differentiated from it, a force of density `m^2 (2 pi f)^4 s_q^2`; over a band up to f it weighs as much
as white noise of variance `m^2 (2 pi f)^4 s_q^2 / 5` would, with m the inertia that the joint feels at home.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.estimate import MAX_RELATIVE_STDERR, solve_least_squares
from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.excitation.information import compute_parameter_scales
from tau_dyn.identify import build_regression
from tau_dyn.log import Log, estimate_encoder_noise
from tau_dyn.model import Model
from tau_dyn.robot import Robot
from tau_dyn.simulate import Sensors, Trajectory, simulate

PER_JOINT = "one number, or one for each of the {} actuated joints"


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviations of what is logged.

    Attributes:
        force: Of forces (na,) [N or N m].
        encoder: Of positions (na,) [m or rad].
        rate_hz: Rate of the log [Hz].
        source: Where the numbers came from, in words.
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
        """Return noise of one number for all joints or one a joint each.

        Raises:
            InputError: Another number of them, or a force noise that is not above zero.
        """
        na, found = robot.na, []
        for name, values in (("force", force), ("encoder", encoder)):
            x = np.asarray(values, float).ravel()
            if len(x) not in (1, na):
                raise InputError("wrong_shape", f"{name} noise: give {PER_JOINT.format(na)}, not {len(x)}")
            found.append(np.broadcast_to(x, (na,)).copy())
        if not np.all(found[0] > 0):
            raise InputError(
                "invalid_value", "force noise must be above zero; without noise every motion tells everything"
            )
        return cls(found[0], found[1], rate_hz, source)

    @classmethod
    def typical(cls, model: Model, tau: np.ndarray, rate_hz: float = 1000.0) -> Noise:
        """Return a good industrial drive's: 1 % of the rms of forces (n, na), and half an encoder step; see `Sensors`."""
        sensors = Sensors.typical(model.robot)
        rms = np.sqrt(np.mean(tau**2, axis=0))
        force = np.maximum(0.01 * rms, 1e-3 * float(rms.max(initial=0.0)))
        force = np.where(force > 0, force, 1.0)
        step = np.broadcast_to(np.asarray(sensors.encoder_noise, float), (model.robot.na,))
        return cls(force, step.copy(), rate_hz, "typical of good drives: 1 % of the rms force, half an encoder step")

    def weighing(self, model: Model, band_hz: float) -> np.ndarray:
        """Return the force noise (na,) that weighs as much as forces and encoders together, up to a frequency [Hz]."""
        inertia = np.diagonal(model.mechanism.inertia(model.robot.home[None])[0])
        return np.hypot(self.force, inertia * (2 * np.pi * band_hz) ** 2 * self.encoder / np.sqrt(5))


@dataclass(frozen=True, eq=False)
class InformationPrediction:
    """What one motion will tell.

    Attributes:
        names: Base parameters' first names (r,).
        expressions: The base parameters in words (r,); equal to the name where one stands alone.
        units: Their units (r,).
        values: The model's values (r,).
        stderr: Standard errors (r,).
        scale: What errors are compared with (r,); see `compute_parameter_scales`.
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
        """Return one plain row a base parameter."""
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
        noise: Of forces and encoders, and the log's rate.
        seed: Of the noise.
        driven: Whether the robot is simulated with its controller, which takes seconds; else it follows the motion exactly, which
            is enough to compare motions but misses what drives add (held forces, feedback of the encoders' noise).
        progress: Is told the share of the simulation that is done.

    Raises:
        CannotAnswer: The motion tells nothing: too slow, too short.
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
    """Return the log that a robot would leave that follows the motion exactly."""
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
    """Return the log that a simulated robot leaves, with its controller; one that it cannot follow is imagined instead."""
    sensors = Sensors(force_noise=noise.force.tolist(), encoder_noise=noise.encoder.tolist())
    try:
        return simulate(model, motion, sensors=sensors, seed=seed, rate_hz=noise.rate_hz, progress=progress)
    except TauDynError:
        return predict_ideal_log(model, motion, noise, seed)


def estimate_log_noise(model: Model, log: Log, rate_hz: float) -> Noise:
    """Return the noise that a recording shows: encoders' own, and what a fit of the model leaves of the forces.

    Args:
        model: What is fitted.
        log: With `q_J` and `tau_J`.
        rate_hz: Rate of the log to come [Hz].

    Raises:
        InputError: The log lacks a column.
        CannotAnswer: It is too dull for the model.
    """
    model = model.steady()
    estimate = solve_least_squares(build_regression(model, [log]))
    cutoff = float(estimate.regression.preparation.force_cutoff_hz)
    force = estimate.sigma * np.sqrt(rate_hz / (2 * cutoff))  # white, of the density that is left below the low-pass
    encoder = estimate_encoder_noise(log.joint("q", model.robot.actuated))
    return Noise.given(model.robot, force, encoder, rate_hz, f"what a fit leaves of {log.name}")
