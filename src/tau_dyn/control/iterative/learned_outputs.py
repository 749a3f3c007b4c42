"""Learned outputs: positions of the actuators, or of the tool, measured or estimated (thesis 7.3, 7.4).

A learned output (`side`) has four parts: its reference r, its estimate of the controlled variable from a trial's measurements,
the actuator references for a correction, and the model `F_u + F_y T_uy` from correction to estimate, which the stability test
uses. The correction is added to the reference of the same side: to actuator references (case 1), or to the tool's reference,
which the inverse kinematics map to the actuators (cases 2 and 3).

`Reference` is the repeated motion: positions of actuators and tool, and the part in which learning acts fully. Before and after
that part the correction is faded in and out (thesis 7.12 to 7.14) with one side of a Tukey window: the start of a trial, which
does not repeat well, is not learnt.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.signal.windows import tukey

from tau_dyn.control.iterative.lifted_system import Operator, build_convolution, compute_pulse_response
from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace


@dataclass(frozen=True, eq=False)
class Reference:
    """A motion that is repeated.

    Attributes:
        dt: Step [s].
        q: Actuated positions (N, na) [m or rad].
        tool: Tool positions (N, 3) [m].
        first: First sample where learning acts fully.
        last: First sample after it.
        lead: Samples of fading in and of fading out.
        taper: Share of the window that is tapered; the thesis takes 0.95.
    """

    dt: float
    q: np.ndarray
    tool: np.ndarray
    first: int
    last: int
    lead: int = 100
    taper: float = 0.95

    def __post_init__(self) -> None:
        """Refuse a part that does not fit into the motion."""
        n = len(self.q)
        if self.q.ndim != 2 or self.tool.shape != (n, 3):
            raise InputError(
                "wrong_shape", f"a reference has q (N, na) and tool (N, 3), not {self.q.shape} and {self.tool.shape}"
            )
        if not 0 <= self.first - self.lead < self.last + self.lead <= n or not self.first < self.last:
            raise InputError(
                "mismatch",
                f"learning from sample {self.first} to {self.last} with {self.lead} samples of lead-in and lead-out "
                f"does not fit into a motion of {n} samples",
            )
        if not (self.dt > 0 and np.isfinite(self.q).all() and np.isfinite(self.tool).all()):
            raise InputError("invalid_value", "a reference has a positive step and finite positions")

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self.q)

    @property
    def full(self) -> slice:
        """Samples where learning acts fully and errors are evaluated."""
        return slice(self.first, self.last)

    def weights(self) -> np.ndarray:
        """Return the diagonal of `Q_w` (N,), thesis (7.14)."""
        side = tukey(2 * self.lead, self.taper)[: self.lead]
        w = np.zeros(self.n)
        w[self.first - self.lead : self.first] = side
        w[self.full] = 1.0
        w[self.last : self.last + self.lead] = side[::-1]
        return w


class TrialMeasurement(Protocol):
    """Sensor signals of one trial, each (N, ...)."""

    @property
    def q(self) -> np.ndarray:
        """Actuated positions (N, na) [m or rad]."""
        ...

    @property
    def kinematic(self) -> np.ndarray:
        """Tool positions computed from them (N, 3) [m]."""
        ...

    @property
    def acceleration(self) -> np.ndarray:
        """Acceleration of the tool (N, 3) [m/s^2]."""
        ...

    @property
    def tool(self) -> np.ndarray:
        """Tool positions, measured (N, 3) [m]."""
        ...


class ToolObserver(Protocol):
    """Estimator of tool positions, such as `ComplementaryToolObserver` and `KalmanToolObserver`."""

    @property
    def dt(self) -> float:
        """Step [s]."""
        ...

    def estimate(self, kinematic: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Return tool positions (N, m) [m]."""
        ...

    def operators(self, n: int) -> tuple[Operator, Operator]:
        """Return its matrices from positions and accelerations (m n, m n)."""
        ...

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return its frequency responses from positions and accelerations."""
        ...


class LearnedOutput(Protocol):
    """One choice of the learned output."""

    @property
    def dt(self) -> float:
        """Step that its models are made for [s]."""
        ...

    @property
    def coupled(self) -> bool:
        """Whether a correction of one channel moves the others."""
        ...

    def reference(self, motion: Reference) -> np.ndarray:
        """Return r (N, m)."""
        ...

    def estimate(self, trial: TrialMeasurement) -> np.ndarray:
        """Return the estimate of the controlled variable (N, m)."""
        ...

    def commands(self, motion: Reference, correction: np.ndarray) -> np.ndarray:
        """Return actuator references (N, na) with a correction (N, m)."""
        ...

    def operator(self, n: int) -> Operator:
        """Return `F_u + F_y T_uy` (m n, m n), channel after channel."""
        ...

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the same as a response (F, m, m) at frequencies (F,) [Hz]."""
        ...


class OwnPositions:
    """Actuator positions, each moved by its own correction alone: case 1, `F_r = F_u = 0`, `F_y = 1`."""

    coupled: bool = False

    def reference(self, motion: Reference) -> np.ndarray:
        """Return the actuators' references."""
        return motion.q

    def estimate(self, trial: TrialMeasurement) -> np.ndarray:
        """Return the measured actuator positions."""
        return trial.q

    def commands(self, motion: Reference, correction: np.ndarray) -> np.ndarray:
        """Return references plus correction."""
        return motion.q + correction


@dataclass(frozen=True, eq=False)
class MotorSide(OwnPositions):
    """Actuator positions with models of the controlled actuators.

    Attributes:
        model: Controlled actuators from references to positions, (6.11); each moves itself alone.
    """

    model: StateSpace

    @property
    def dt(self) -> float:
        """Step [s]."""
        return self.model.dt

    def operator(self, n: int) -> Operator:
        """Return `T_uy`."""
        return build_convolution(compute_pulse_response(self.model, n))

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return `T_uy` at frequencies."""
        return self.model.frequency_response(frequency)


@dataclass(frozen=True, eq=False)
class ToolSide:
    """Tool positions along some axes: measured (case 3), or estimated by an observer (case 2).

    Attributes:
        model: Model from the tool's reference to the tool, (6.12), along those axes.
        inverse: Maps tool positions (N, 3) [m] to actuated positions (N, na).
        axes: Axes of the tool.
        observer: Estimator of the tool's position; None if it is measured.
        kinematic_model: Model from the tool's reference to the tool computed from the actuators; only an observer needs it.
    """

    model: StateSpace
    inverse: Callable[[np.ndarray], np.ndarray]
    axes: tuple[int, ...] = (0, 1)
    observer: ToolObserver | None = None
    kinematic_model: StateSpace | None = None
    coupled: bool = True

    def __post_init__(self) -> None:
        """Refuse models and observers that do not fit together."""
        m = len(self.axes)
        if self.model.D.shape != (m, m):
            raise InputError(
                "mismatch",
                f"learning {m} tool axes takes a model with {m} inputs and outputs, not {self.model.D.shape}",
            )
        if self.observer is None:
            return
        if self.kinematic_model is None:
            raise InputError(
                "mismatch",
                "learning from an observer needs the model from the tool's reference to the computed tool too",
            )
        for what, dt in (("observer", self.observer.dt), ("model of the computed tool", self.kinematic_model.dt)):
            if abs(dt - self.dt) > 1e-9 * self.dt:
                raise InputError(
                    "mismatch", f"the {what} is made for {1000 * dt:g} ms, the tool's model for {1000 * self.dt:g} ms"
                )

    @property
    def dt(self) -> float:
        """Step [s]."""
        return self.model.dt

    def reference(self, motion: Reference) -> np.ndarray:
        """Return the tool's reference along the axes."""
        return motion.tool[:, self.axes]

    def estimate(self, trial: TrialMeasurement) -> np.ndarray:
        """Return the tool, measured or estimated, along the axes."""
        if self.observer is None:
            return trial.tool[:, self.axes]
        return self.observer.estimate(trial.kinematic[:, self.axes], trial.acceleration[:, self.axes])

    def commands(self, motion: Reference, correction: np.ndarray) -> np.ndarray:
        """Return the actuator references of the corrected tool reference."""
        tool = motion.tool.copy()
        tool[:, self.axes] += correction
        return self.inverse(tool)

    def operator(self, n: int) -> Operator:
        """Return `F_y T_uy`."""
        if self.observer is None or self.kinematic_model is None:
            return build_convolution(compute_pulse_response(self.model, n))
        slow, fast = self.observer.operators(n)
        acceleration = build_convolution(_differentiated(compute_pulse_response(self.model, n + 1), self.dt))
        return slow @ build_convolution(compute_pulse_response(self.kinematic_model, n)) + fast @ acceleration

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the same at frequencies."""
        tool = self.model.frequency_response(frequency)
        if self.observer is None or self.kinematic_model is None:
            return tool
        slow, fast = self.observer.responses(frequency)
        acceleration = 2 * (np.cos(2 * np.pi * np.asarray(frequency) * self.dt) - 1) / self.dt**2
        return slow @ self.kinematic_model.frequency_response(frequency) + fast @ (acceleration[:, None, None] * tool)


def _differentiated(pulses: np.ndarray, dt: float) -> np.ndarray:
    """Return pulse responses of the acceleration (n, p, m): the second central difference of those of positions (n + 1, p, m)."""
    before = np.concatenate([np.zeros((1, *pulses.shape[1:])), pulses[:-2]])
    return (pulses[1:] - 2 * pulses[:-1] + before) / dt**2
