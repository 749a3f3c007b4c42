r"""A flexible robot that repeats a motion: what its sensors show of each trial; and the thesis' path for it, a square.

References in, `Trial` out, as the thesis' Figure 7.3: controlled drives move the actuators, the structure behind them sways. The
tool is where the rigid kinematics of the true actuator positions put it, plus the deflection of the robot linearised at its pose.
A drive gets its position reference and a share of its derivative as velocity reference: `q_ref + share T q_ref'` before the lag
of (6.11). Without that share the drives are (6.11) themselves, which the thesis calls too slow for its own motion; with all of
it they are a pure delay. From trial to trial differ: noise of all sensors, a slow wander of each drive (friction settles
differently each time) and a random force on the plate. Everything else repeats. Valid near the pose.

Vibration logs of a flexible robot near a pose: references or pushes in, a `Log` out.

Inputs are deviations from rest, held from sample to sample; what the log shows at its samples is then exact, not integrated
(`dynamics.linear_system`). A log has `q_ref_J`, `q_J`, the tool's position `x_tool ..`, its acceleration `ax_tool ..` as an
accelerometer reads it and, where something pushed, the force `fx_tool ..` [N]. Valid near the pose: drives and tool may move
by some millimetres. Friction is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter, max_len_seq

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.log import Log
from tau_dyn.mechanism import AXES, Linearised, Mechanism, PositionDrives, SampledModel


@dataclass(frozen=True)
class VibrationSensors:
    """What measures a vibration; zero is perfect.

    Attributes:
        encoder_noise: Standard deviation of the drives' positions [m or rad].
        tool_noise: Of the tool's position, each axis [m].
        acceleration_noise: Of the tool's acceleration, each axis [m/s^2].
        accelerometer_hz: The accelerometer's bandwidth [Hz]; None where there is no accelerometer.
    """

    encoder_noise: float = 0.0
    tool_noise: float = 0.0
    acceleration_noise: float = 0.0
    accelerometer_hz: float | None = 300.0

    def __post_init__(self) -> None:
        """Refuse negative noise."""
        if min(self.encoder_noise, self.tool_noise, self.acceleration_noise) < 0:
            raise InputError("invalid_value", "a sensor's noise must not be below zero")

    @classmethod
    def length_gauges(cls) -> VibrationSensors:
        """Return the thesis' gauges, 1 um, and accelerometer, 0.07 m/s^2 and 300 Hz (Dressler 2012, sections 6.3, 7.3)."""
        return cls(encoder_noise=1e-6, tool_noise=1e-6, acceleration_noise=0.07)

    @classmethod
    def laser_tracker(cls) -> VibrationSensors:
        """Return the thesis' laser tracker, 10 um (Dressler 2012, section 6.3), without an accelerometer."""
        return cls(encoder_noise=1e-6, tool_noise=1e-5, accelerometer_hz=None)


def simulate_vibration_log(
    flexible: Linearised,
    reference: np.ndarray,
    force: np.ndarray,
    dt: float,
    *,
    drives: PositionDrives | None = None,
    sensors: VibrationSensors | None = None,
    seed: int = 0,
    name: str = "vibration",
) -> Log:
    """Return what a flexible robot's sensors show of given inputs.

    Args:
        flexible: The robot near its pose.
        reference: Reference positions of the drives, as deviations from the pose (N, na) [m or rad].
        force: Outside force (N, 3) [N], base axes.
        dt: Step of inputs and log [s].
        drives: By default the drives follow their reference at once.
        sensors: By default perfect ones.
        seed: Of all noise.
        name: What the log is called.

    Raises:
        InputError: Shapes do not fit, or the drives' delay is not a whole number of steps.
    """
    sensors = sensors or VibrationSensors()
    reference, force = np.atleast_2d(np.asarray(reference, float)), np.atleast_2d(np.asarray(force, float))
    if reference.shape[1:] != (flexible.na,) or force.shape != (len(reference), 3):
        raise InputError(
            "wrong_shape",
            f"expected references (N, {flexible.na}) and forces (N, 3), not {reference.shape}, {force.shape}",
        )
    bandwidth = sensors.accelerometer_hz
    model = flexible.state_space(drives, acceleration=bandwidth is not None, accelerometer_hz=bandwidth or 1.0)
    y = model.sampled(dt).simulate(np.hstack([reference, force]))
    joints = flexible.robot.actuated
    rng = np.random.default_rng(seed)
    channels = {f"q_ref_{j}": flexible.q[k] + reference[:, k] for k, j in enumerate(joints)}
    if np.any(force):
        channels |= {f"f{axis}_tool": force[:, k] for k, axis in enumerate(AXES)}
    rest = np.concatenate([flexible.q, flexible.tool_position, np.zeros(3)])
    noise = [sensors.encoder_noise] * flexible.na + [sensors.tool_noise] * 3 + [sensors.acceleration_noise] * 3
    for k, column in enumerate(model.outputs):
        channels[column] = rest[k] + y[:, k] + noise[k] * rng.standard_normal(len(y))
    return Log(np.arange(len(y), dtype=np.float64) * float(dt), channels, name)


def simulate_binary_log(
    flexible: Linearised,
    *,
    duration: float = 60.0,
    rate_hz: float = 250.0,
    amplitude: float = 1e-3,
    hold: int = 4,
    joints: Sequence[str] | None = None,
    drives: PositionDrives | None = None,
    sensors: VibrationSensors | None = None,
    seed: int = 0,
    name: str = "prbs",
) -> Log:
    """Return a log of pseudo-random binary references, one shift of a maximum-length sequence a joint.

    Args:
        flexible: The robot near its pose.
        duration: Length [s].
        rate_hz: Of references and log [Hz].
        amplitude: References jump between plus and minus this [m or rad].
        hold: Samples between two possible jumps; the excitation reaches up to about half of `rate_hz / hold`.
        joints: Those that move; by default all.
        drives: By default the drives follow their reference at once.
        sensors: By default perfect ones.
        seed: Where the sequence starts, and of all noise.
        name: What the log is called.

    Raises:
        InputError: The log would hold fewer than two samples, or nothing is asked to move.
    """
    n = _samples(duration, rate_hz)
    moved = _moved(flexible, joints)
    if not (amplitude > 0 and np.isfinite(amplitude)) or hold < 1:
        raise InputError(
            "invalid_value", "a binary reference needs a positive amplitude and at least one sample between jumps"
        )
    jumps = -(-n // hold)
    bits = max(6, int(np.ceil(np.log2(jumps + 1))))
    start = np.random.default_rng([seed, 1]).integers(0, 2, bits)
    start[0] = 1  # all zeros would stay so
    sequence = 2.0 * max_len_seq(bits, state=start)[0] - 1
    reference = np.zeros((n, flexible.na))
    for k, joint in enumerate(moved):
        shifted = np.roll(sequence, k * (len(sequence) // len(moved)))[:jumps]
        reference[:, flexible.robot.actuated.index(joint)] = amplitude * np.repeat(shifted, hold)[:n]
    return simulate_vibration_log(
        flexible, reference, np.zeros((n, 3)), 1 / rate_hz, drives=drives, sensors=sensors, seed=seed, name=name
    )


def push_log(
    flexible: Linearised,
    directions: str,
    *,
    duration: float = 5.0,
    rate_hz: float = 1000.0,
    impulse: float = 2.0,
    width: float = 0.01,
    repeat: int | None = None,
    drives: PositionDrives | None = None,
    sensors: VibrationSensors | None = None,
    seed: int = 0,
    name: str = "",
) -> Log:
    """Return a log of pushes on the tool, half sines, while the drives hold their positions.

    Args:
        flexible: The robot near its pose.
        directions: `x`, `y`, `z`, or several of them, such as `xyz`, which take turns.
        duration: Length of the log [s].
        rate_hz: Of the log [Hz].
        impulse: Of each push [N s].
        width: Of each push [s].
        repeat: Number of pushes, evenly spread, by default one a direction; each comes after 2 % of its share of the time.
        drives: Hold still here; their delay must fit the rate.
        sensors: By default perfect ones.
        seed: Of all noise.
        name: What the log is called.

    Raises:
        InputError: A push does not fit, or there is no such direction.
    """
    n = _samples(duration, rate_hz)
    for direction in directions or " ":
        if direction not in AXES:
            raise UnknownName("direction", direction, AXES)
    pushes = len(directions) if repeat is None else repeat
    steps, share = max(2, round(width * rate_hz)), n // max(pushes, 1)
    first = 1 + share // 50
    if not (impulse > 0 and width > 0 and pushes >= 1) or first + steps >= share:
        raise InputError("invalid_value", f"{pushes} push(es) of {width:g} s do not fit into {duration:g} s")
    shape = np.sin(np.pi * (np.arange(steps) + 0.5) / steps)
    force = np.zeros((n, 3))
    for k in range(pushes):
        column = AXES.index(directions[k % len(directions)])
        force[k * share + first : k * share + first + steps, column] = impulse * rate_hz * shape / shape.sum()
    still = np.zeros((n, flexible.na))
    name = name or f"push {directions}"
    return simulate_vibration_log(
        flexible, still, force, 1 / rate_hz, drives=drives, sensors=sensors, seed=seed, name=name
    )


def _samples(duration: float, rate_hz: float) -> int:
    if not (0 < rate_hz < np.inf and 0 < duration < np.inf) or not 2 <= round(duration * rate_hz) <= 10_000_000:
        raise InputError(
            "invalid_value", f"{duration:g} s at {rate_hz:g} Hz is no log; it needs two to ten million samples"
        )
    return round(duration * rate_hz)


def _moved(flexible: Linearised, joints: Sequence[str] | None) -> tuple[str, ...]:
    moved = tuple(flexible.robot.actuated if joints is None else joints)
    for joint in moved:
        if joint not in flexible.robot.actuated:
            raise UnknownName("actuated joint", joint, flexible.robot.actuated)
    if not moved:
        raise InputError("invalid_value", "at least one joint must move")
    return moved


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
