"""A stationary Kalman filter for the tool's position on an identified model (thesis 7.19 to 7.22).

The input is the tool position z_c computed from the actuators; the measurement is the tool's acceleration y. With the extended
model of (7.21) and the prediction error covariance P from the Riccati equation,

    M = P Cy' S^-1,  S = Cy P Cy' + R2,    x(t|t) = x(t|t-1) + M (y - Cy x(t|t-1)),    z(t) = Cz x(t|t).

The output of the thesis' (7.22) is `Cz x(t|t-1)`, the estimate before the present measurement; its gain is `K = A M`.

Process noise. The thesis uses `R1 = r I`, which depends on the choice of the state coordinates, and treats position, velocity
and acceleration of the tool as if disturbed independently. Here unknown forces disturb the states: they change velocities, so
the position moves one step later, and velocity and acceleration follow by the same differences. The directions in state space
are weighted with the controllability Gramian of the input, and those with an immediate change of position are removed:
`R1 = r E G G' E'`, where `r` is the mean square of the position change by the next step, caused by one step's force [m^2].
Reference: Astrom & Wittenmark 1997, ch. 11; Anderson & Moore 1979, Optimal Filtering, ch. 4.

The extended model has two additional states per axis, the tool's velocity and acceleration (thesis 7.19 to 7.21):

    x_v(t + T) = (z(t + T) - z(t)) / T,    x_a(t + T) = (x_v(t + T) - x_v(t)) / T

with `z(t + T) = C (A x + B u)` give the matrices of (7.21). Two details are not in the thesis:

* `x_a(t)` is the second difference of `z(t), z(t - T), z(t - 2T)`, that is the acceleration at `t - T`. It has to be compared
  with the previous sample of the accelerometer, not with the present one: at 4 ms and 11.5 Hz that is 17 degrees.
* (7.21) needs `z = C x`. An identified model has a direct part D (rods transmit the carts' acceleration to the tool without
  delay). Then the input becomes a state: `x' = (x, u)`, driven by the input of the next sample, which is known when that sample
  is evaluated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import null_space, solve_discrete_are, solve_discrete_lyapunov

from tau_dyn.control.iterative import Operator, build_convolution, compute_pulse_response
from tau_dyn.control.observers.complementary import require_signals
from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace


@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """The extended model: `x(t + T) = A x(t) + B u`, with `u` at t, or at `t + T` if `ahead`.

    Attributes:
        A: (n, n).
        B: (n, m).
        position: Tool position from states (p, n).
        acceleration: Tool acceleration, one sample late, from states (p, n).
        disturbed: How a disturbance of the first states reaches all of them (n, n0).
        ahead: Whether the input of the new sample drives the step.
        dt: Step [s].
    """

    A: np.ndarray
    B: np.ndarray
    position: np.ndarray
    acceleration: np.ndarray
    disturbed: np.ndarray
    ahead: bool
    dt: float


def extend_model(model: StateSpace) -> ExtendedModel:
    """Return (7.21) of a model from computed to true tool positions.

    Raises:
        InputError: The model is unstable.
    """
    if not model.spectral_radius() < 1:
        raise InputError(
            "unstable",
            f"the model is unstable: it has a pole of magnitude {model.spectral_radius():.4g}; all must be below 1",
        )
    undelayed = _with_delay_as_states(model)
    ahead = bool(np.any(undelayed.D))
    A, B, C = _without_direct_part(undelayed) if ahead else (undelayed.A, undelayed.B, undelayed.C)
    n, p, h = len(A), len(C), 1 / model.dt
    differ = C @ (A - np.eye(n))
    wide = np.block(
        [
            [A, np.zeros((n, 2 * p))],
            [h * differ, np.zeros((p, 2 * p))],
            [h**2 * differ, -h * np.eye(p), np.zeros((p, p))],
        ]
    )
    spread = np.vstack([np.eye(n), h * C, h**2 * C])
    none = np.zeros((p, 2 * p))
    position = np.hstack([C, none])
    acceleration = np.hstack([np.zeros((p, n + p)), np.eye(p)])
    return ExtendedModel(wide, spread @ B, position, acceleration, spread, ahead, model.dt)


def _without_direct_part(model: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C of the model whose states hold the last input as well, `x' = (x, u)`, so that `z = C x'`."""
    n, m = model.B.shape
    A = np.block([[model.A, model.B], [np.zeros((m, n + m))]])
    return A, np.vstack([np.zeros((n, m)), np.eye(m)]), np.hstack([model.C, model.D])


def _with_delay_as_states(model: StateSpace) -> StateSpace:
    """Return the same model with the past inputs among its states."""
    for _ in range(model.delay):
        A, B, C = _without_direct_part(model)
        K = np.zeros((len(A), len(C)))
        model = StateSpace(A, B, C, np.zeros_like(model.D), K, model.dt, model.delay - 1, model.noise)
    return model


@dataclass(frozen=True, eq=False)
class KalmanToolObserver:
    """Tool positions from positions computed by forward kinematics and an accelerometer.

    Attributes:
        model: Model from computed to true tool positions, (6.13), for deviations from rest.
        process: `r` above [m^2], or a whole covariance of the extended states (n, n).
        measurement: R2, variance of the accelerometer [(m/s^2)^2]: a number or a matrix (p, p).
        aligned: Compare the acceleration state with the previous sample, to which it belongs; False uses (7.21) as printed.
        predict: Return the prediction, as (7.22), instead of the estimate that includes the present measurement.
    """

    model: StateSpace
    process: float | np.ndarray
    measurement: float | np.ndarray
    aligned: bool = True
    predict: bool = False

    def __post_init__(self) -> None:
        """Refuse invalid covariances, and models with different numbers of inputs and outputs."""
        if self.model.B.shape[1] != len(self.model.C):
            raise InputError(
                "mismatch", "the observer's model goes from computed to true tool positions, the same axes in and out"
            )
        if not (np.linalg.eigvalsh(self.R1).min() >= -1e-7 * np.abs(self.R1).max() and np.all(np.isfinite(self.R1))):
            raise InputError("invalid_value", "the process noise must be a covariance: symmetric, finite, not negative")
        if not np.linalg.eigvalsh(self.R2).min() > 0:
            raise InputError("invalid_value", "the accelerometer's variance must be positive")

    @property
    def dt(self) -> float:
        """Sampling step [s]."""
        return self.model.dt

    @property
    def axes(self) -> int:
        """Number of tool directions."""
        return len(self.model.C)

    @cached_property
    def extended(self) -> ExtendedModel:
        """The model of (7.21)."""
        return extend_model(self.model)

    @cached_property
    def R1(self) -> np.ndarray:
        """Covariance of the process noise (n, n)."""
        n = len(self.extended.A)
        given = np.asarray(self.process, float)
        if given.ndim == 0:
            return float(given) * compute_disturbance_shape(self.extended)
        if given.shape != (n, n):
            raise InputError("wrong_shape", f"the process noise is a number or a matrix ({n}, {n}), not {given.shape}")
        return given

    @cached_property
    def R2(self) -> np.ndarray:
        """Covariance of the accelerometer (p, p)."""
        given = np.asarray(self.measurement, float)
        return float(given) * np.eye(self.axes) if given.ndim == 0 else given

    @cached_property
    def prediction_covariance(self) -> np.ndarray:
        """P (n, n), the solution of the Riccati equation.

        Raises:
            InputError: It has none, as for a model whose poles are far faster or slower than the sampling.
        """
        e = self.extended
        try:
            return np.asarray(solve_discrete_are(e.A.T, e.acceleration.T, self.R1, self.R2))
        except (ValueError, np.linalg.LinAlgError) as fault:
            raise InputError(
                "unstable",
                "no Kalman filter exists for this model; fit one of fewer states to a better record (modes --order)",
            ) from fault

    @cached_property
    def innovation_covariance(self) -> np.ndarray:
        """S (p, p)."""
        Cy = self.extended.acceleration
        return Cy @ self.prediction_covariance @ Cy.T + self.R2

    @cached_property
    def correction(self) -> np.ndarray:
        """M (n, p): from an innovation to the states at its own sample."""
        return np.linalg.solve(self.innovation_covariance, self.extended.acceleration @ self.prediction_covariance).T

    @property
    def gain(self) -> np.ndarray:
        """K of (7.22) (n, p)."""
        return self.extended.A @ self.correction

    def estimate(self, kinematic: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Return tool positions (N, m) [m], from the past alone.

        Args:
            kinematic: Tool positions computed from the actuators (N, m) [m]; the robot is at rest at the first sample.
            acceleration: Acceleration of the tool, without gravity (N, m) [m/s^2].
        """
        return self.run(kinematic, acceleration)[0]

    def run(self, kinematic: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return tool positions (N, m) [m] and innovations (N, m) [m/s^2]."""
        u, y, rest = self._inputs(kinematic, acceleration)
        e, M, late = self.extended, self.correction, not self.extended.ahead
        if late:
            u = np.vstack([np.zeros((1, self.axes)), u[:-1]])
        kept = np.eye(len(e.A)) - M @ e.acceleration
        onward, come = kept @ e.A, u @ (kept @ e.B).T + y @ M.T  # after[k] = onward after[k - 1] + come[k]
        after = np.zeros((len(u) + 1, len(e.A)))
        for k in range(len(u)):
            after[k + 1] = onward @ after[k] + come[k]
        before = after[:-1] @ e.A.T + u @ e.B.T
        innovations = y - before @ e.acceleration.T
        z = (before if self.predict else after[1:]) @ e.position.T
        return rest + z, innovations

    def standard_error(self) -> np.ndarray:
        """Return the estimate's standard deviation (m,) [m] if model and covariances are right."""
        e, P = self.extended, self.prediction_covariance
        P = P if self.predict else P - self.correction @ e.acceleration @ P
        return np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", e.position, P, e.position), 0))

    def filters(self) -> tuple[StateSpace, StateSpace]:
        """Return the observer as models from computed positions and from accelerations to estimates: F_y in (7.4)."""
        e, M = self.extended, self.correction
        n, m = len(e.A), self.axes
        keep = np.eye(n) - M @ e.acceleration
        # states after a measurement: x+ = keep (A x + B u) + M y
        A, Bu = keep @ e.A, keep @ e.B
        C, Du, Dy = e.position @ e.A, e.position @ e.B, np.zeros((m, m))
        if not self.predict:
            C, Du, Dy = e.position @ A, e.position @ Bu, e.position @ M
        K = np.zeros((n, m))
        by_position = StateSpace(A, Bu, C, Du, K, self.dt, 0 if e.ahead else 1)
        return by_position, StateSpace(A, M, C, Dy, K, self.dt, 1 if self.aligned else 0)

    def operators(self, n: int) -> tuple[Operator, Operator]:
        """Return the estimate's (m n, m n) from positions and from accelerations, channel after channel: F_y in (7.7)."""
        slow, fast = (build_convolution(compute_pulse_response(f, n)) for f in self.filters())
        return slow, fast

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as responses (F, m, m) at frequencies (F,) [Hz]."""
        slow, fast = (f.frequency_response(frequency) for f in self.filters())
        return slow, fast

    def _inputs(self, kinematic: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        kinematic = require_signals(kinematic, acceleration, self.axes)
        y = np.vstack([np.zeros((1, self.axes)), acceleration[:-1]]) if self.aligned else acceleration
        return kinematic - kinematic[0], y, kinematic[0]


def compute_disturbance_shape(model: ExtendedModel) -> np.ndarray:
    """Return E G G' E' (n, n): the effect of unknown forces of size 1 on the extended states in one step."""
    n0 = model.disturbed.shape[1]
    A, B, C = model.A[:n0, :n0], model.B[:n0], model.position[:, :n0]
    W = np.asarray(solve_discrete_lyapunov(A, B @ B.T))
    values, vectors = np.linalg.eigh((W + W.T) / 2)
    reached = vectors * np.sqrt(np.maximum(values, 0))
    G = reached @ null_space(C @ reached)
    moved = C @ A @ G
    GG = G @ G.T / np.mean(np.sum(moved**2, axis=1))
    shape = model.disturbed @ GG @ model.disturbed.T
    return (shape + shape.T) / 2
