"""A flexible robot that repeats a motion: what its sensors show of each trial; and the thesis' path for it, a square.

References in, `Trial` out, as the thesis' Figure 7.3: controlled drives move the actuators, the structure behind them sways. The
tool is where the rigid kinematics of the true actuator positions put it, plus the deflection of the robot linearised at its pose.
A drive gets its position reference and a share of its derivative as velocity reference: `q_ref + share T q_ref'` before the lag
of (6.11). Without that share the drives are (6.11) themselves, which the thesis calls too slow for its own motion; with all of
it they are a pure delay. From trial to trial differ: noise of all sensors, a slow wander of each drive (friction settles
differently each time) and a random force on the plate. Everything else repeats. Valid near the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import Linearised, Mechanism, PositionDrives, SampledModel
from tau_dyn.simulate import VibrationSensors

_CURVED = 0.05  # m; farther from the pose than this the linear model is not trusted


@dataclass(frozen=True)
class Unrepeatable:
    """What differs from trial to trial, each a first-order coloured noise.

    Attributes:
        drive: Wander of each drive, standard deviation [m or rad].
        drive_hz: Its bandwidth [Hz].
        push: Force on the plate along each axis, standard deviation [N].
        push_hz: Its bandwidth [Hz].
    """

    drive: float = 1e-5
    drive_hz: float = 1.0
    push: float = 0.3
    push_hz: float = 20.0

    def __post_init__(self) -> None:
        """Refuse what is no noise."""
        if min(self.drive, self.push) < 0 or not min(self.drive_hz, self.push_hz) > 0:
            raise InputError("invalid_value", "disturbances have a size not below zero and a positive bandwidth")


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of the motion; all (N, ...).

    Attributes:
        dt: Step [s].
        q: Actuated positions, measured [m or rad].
        kinematic: Tool positions computed from them, z_c [m].
        acceleration: Of the tool, measured [m/s^2].
        tool: Tool positions, measured, z_m [m].
        true_tool: Tool positions [m].
    """

    dt: float
    q: np.ndarray
    kinematic: np.ndarray
    acceleration: np.ndarray
    tool: np.ndarray
    true_tool: np.ndarray


@dataclass(frozen=True, eq=False)
class LearningPlant:
    """The robot.

    Attributes:
        flexible: Linearised at the pose, its tool the point that is learnt.
        kinematics: The rigid robot that the controller knows.
        drives: Controlled drives.
        dt: Step of references and sensors [s].
        velocity_share: Share of the reference's derivative that reaches the drives as velocity reference.
        sensors: What measures.
        unrepeatable: What differs from trial to trial.
        seed: Of all noise.
    """

    flexible: Linearised
    kinematics: Mechanism
    drives: PositionDrives
    dt: float = 0.004
    velocity_share: float = 0.0
    sensors: VibrationSensors = field(default_factory=VibrationSensors.length_gauges)
    unrepeatable: Unrepeatable = field(default_factory=Unrepeatable)
    seed: int = 0
    _model: SampledModel = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Sample the structure behind its drives."""
        if self.sensors.accelerometer_hz is None:
            raise InputError("unsupported", "a plant for observers needs an accelerometer; give its bandwidth")
        continuous = self.flexible.state_space(
            self.drives, acceleration=True, accelerometer_hz=self.sensors.accelerometer_hz
        )
        object.__setattr__(self, "_model", continuous.sampled(self.dt))

    @property
    def rest(self) -> np.ndarray:
        """Tool position at the pose, as the controller computes it (3,) [m]."""
        return self.kinematics.tool_position(self.flexible.q[None])[0]

    def actuators(self, tool: np.ndarray) -> np.ndarray:
        """Return actuated positions (N, na) for tool positions (N, 3) [m], by Newton's method from the pose.

        Raises:
            InputError: A position cannot be reached from the pose.
        """
        q = np.tile(self.flexible.q, (len(tool), 1))
        for _ in range(20):
            gap = tool - self.kinematics.tool_position(q)
            if np.abs(gap).max() < 1e-12:
                return q
            q = q + np.linalg.solve(self.kinematics.tool_jacobian(q), gap[..., None])[..., 0]
        worst = int(np.argmax(np.abs(gap).max(axis=1)))
        raise InputError(
            "unreachable", f"sample {worst}: the tool cannot be brought to {np.round(tool[worst], 4)} m from this pose"
        )

    def run(self, reference: np.ndarray, trial: int = 0) -> Trial:
        """Return what the sensors show of actuator references (N, na), starting at rest at the pose.

        Raises:
            InputError: The reference has another shape, or leaves the pose farther than the linear model is trusted.
        """
        na, n = self.flexible.na, len(reference)
        if reference.shape != (n, na) or not np.isfinite(reference).all():
            raise InputError("wrong_shape", f"expected finite references (N, {na}), not {reference.shape}")
        away = reference - self.flexible.q
        if np.abs(away).max(initial=0) > _CURVED:
            raise InputError(
                "invalid_value",
                f"a reference goes {1000 * np.abs(away).max():.0f} mm from the pose; it is linear up to {1000 * _CURVED:g}",
            )
        rng = np.random.default_rng([self.seed, trial])
        y = self._model.simulate(np.hstack([self._commanded(away) + self._wander(n, rng), self._pushes(n, rng)]))
        return self._sensed(y, rng)

    def _commanded(self, away: np.ndarray) -> np.ndarray:
        """Add the velocity reference (N, na)."""
        slope = np.diff(away, axis=0, prepend=away[:1]) / self.dt
        return away + self.velocity_share * np.array(self.drives.time_constants) * slope

    def _wander(self, n: int, rng: np.random.Generator) -> np.ndarray:
        u = self.unrepeatable
        return _coloured(rng, (n, self.flexible.na), u.drive, u.drive_hz * self.dt)

    def _pushes(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return _coloured(rng, (n, 3), self.unrepeatable.push, self.unrepeatable.push_hz * self.dt)

    def _sensed(self, y: np.ndarray, rng: np.random.Generator) -> Trial:
        na, s = self.flexible.na, self.sensors
        moved, linear, acceleration = y[:, :na], y[:, na : na + 3], y[:, na + 3 :]
        deflection = linear - moved @ self.flexible.tool[:, :na].T
        q = self.flexible.q + moved
        true_tool = self.kinematics.tool_position(q) + deflection
        seen = q + s.encoder_noise * rng.standard_normal(q.shape)
        return Trial(
            self.dt,
            seen,
            self.kinematics.tool_position(seen),
            acceleration + s.acceleration_noise * rng.standard_normal(acceleration.shape),
            true_tool + s.tool_noise * rng.standard_normal(true_tool.shape),
            true_tool,
        )


def _coloured(rng: np.random.Generator, shape: tuple[int, int], size: float, bandwidth: float) -> np.ndarray:
    """Return first-order coloured noise, starting at zero as the trial does; the bandwidth is in cycles a sample."""
    a = np.exp(-2 * np.pi * bandwidth)
    white = rng.standard_normal(shape) * size * np.sqrt(1 - a**2)
    return np.asarray(lfilter([1.0], [1.0, -a], white, axis=0))


def square_path(
    n: int,
    dt: float,
    *,
    side: float = 0.010,
    speed: float = 0.1,
    acceleration: float = 1.0,
    jerk_time: float = 0.04,
    pause: float = 0.1,
    start: float = 1.2,
    rounds: int = 2,
) -> np.ndarray:
    """Return tool positions relative to the first corner (n, 3) [m]: -y, +x, +y, -x.

    Args:
        n: Samples.
        dt: Step [s].
        side: Of the square [m].
        speed: Not exceeded along an edge [m/s].
        acceleration: Along an edge [m/s^2].
        jerk_time: How long the acceleration takes from one value to the next [s].
        pause: At rest in each corner [s].
        start: Of the first edge [s].
        rounds: How often.

    Raises:
        InputError: A number is not positive, or the path does not end within n samples.
    """
    if not min(n, dt, side, speed, acceleration, jerk_time, rounds) > 0 or min(pause, start) < 0:
        raise InputError("invalid_value", "a square needs positive sizes, speeds and times")
    top = min(speed, np.sqrt(side * acceleration))
    moving = side / top + top / acceleration + jerk_time
    edge = moving + pause
    if start + 4 * rounds * edge > n * dt:
        raise InputError(
            "invalid_value",
            f"{rounds} rounds take {start + 4 * rounds * edge:.2f} s; {n} samples of {1000 * dt:g} ms are {n * dt:.2f} s",
        )
    t = np.arange(n) * dt - start
    corner = np.clip(np.floor(t / edge), 0, 4 * rounds - 1).astype(int)
    way = _way(t - corner * edge, side, top, acceleration, jerk_time)
    corners = side * np.array([[0, 0, 0], [0, -1, 0], [1, -1, 0], [1, 0, 0], [0, 0, 0]], float)
    here, there = corners[corner % 4], corners[corner % 4 + 1]
    return here + (there - here) * (way / side)[:, None]


def _way(t: np.ndarray, side: float, top: float, a: float, jerk_time: float) -> np.ndarray:
    """Return the way along an edge (N,): the trapezoid of speed, averaged over the jerk time."""
    ramp, cruise = top / a, side / top - top / a
    turns = np.cumsum([0.0, ramp, cruise, ramp])

    def integral(at: np.ndarray) -> np.ndarray:  # of the way
        return sum(
            sign * a / 6 * np.maximum(at - turn, 0) ** 3 for sign, turn in zip((1, -1, -1, 1), turns, strict=True)
        )  # type: ignore[return-value]

    end = turns[-1] + jerk_time
    at = np.clip(t, 0, end)
    return np.clip((integral(at) - integral(at - jerk_time)) / jerk_time, 0, side)
