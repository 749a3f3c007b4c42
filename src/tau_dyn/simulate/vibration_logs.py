"""Vibration logs of a flexible robot near a pose: references or pushes in, a `Log` out.

Inputs are deviations from rest, held from sample to sample; the log's samples are then exact, not integrated
(`mechanism/flexible/linear_system.py`). A log has `q_ref_J`, `q_J`, the tool's position `x_tool ..`, its acceleration
`ax_tool ..` as an accelerometer reads it and, if there are pushes, the force `fx_tool ..` [N]. Valid near the pose: drives
and tool may move by some millimetres. Friction is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import max_len_seq

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.log import Log
from tau_dyn.mechanism import AXES, Linearised, PositionDrives


@dataclass(frozen=True)
class VibrationSensors:
    """Sensors of a vibration; zero is perfect.

    Attributes:
        encoder_noise: Standard deviation of the drives' positions [m or rad].
        tool_noise: Standard deviation of the tool's position, each axis [m].
        acceleration_noise: Standard deviation of the tool's acceleration, each axis [m/s^2].
        accelerometer_hz: The accelerometer's bandwidth [Hz]; None if there is no accelerometer.
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
    """Return the log of a flexible robot's sensors for given inputs.

    Args:
        flexible: The robot near its pose.
        reference: Reference positions of the drives, as deviations from the pose (N, na) [m or rad].
        force: Outside force (N, 3) [N], base axes.
        dt: Step of inputs and log [s].
        drives: Dynamics of the drives; by default they follow their reference at once.
        sensors: Sensors; by default perfect ones.
        seed: Seed of all noise.
        name: Name of the log.

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
        rate_hz: Sampling rate of references and log [Hz].
        amplitude: References jump between plus and minus this [m or rad].
        hold: Samples between two possible jumps; the excitation reaches up to about half of `rate_hz / hold`.
        joints: Those that move; by default all.
        drives: Dynamics of the drives; by default they follow their reference at once.
        sensors: Sensors; by default perfect ones.
        seed: Seed of the sequence's start and of all noise.
        name: Name of the log.

    Raises:
        InputError: The log would hold fewer than two samples, or no joint is to move.
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
        rate_hz: Sampling rate of the log [Hz].
        impulse: Impulse of each push [N s].
        width: Duration of each push [s].
        repeat: Number of pushes, evenly spread, by default one a direction; each comes after 2 % of its share of the time.
        drives: Hold still here; their delay must fit the rate.
        sensors: Sensors; by default perfect ones.
        seed: Seed of all noise.
        name: Name of the log.

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
