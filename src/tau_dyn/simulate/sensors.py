"""Sensors between the true motion and the log: encoders that round, forces with coloured noise, a log rate, and effects on a log.

    q_shown = q + displacement @ parameters,     tau_shown(t) = tau(t - delay),     tool_shown = T(q) + shift @ parameters,
    q_read = resolution * round((q_shown + noise) / resolution),   tau_log = tau_shown + coloured noise.

The plant moves the loads; encoders read in front of them. Where the displacement follows from the load's own path (a periodic
error, a scale, a play, a loop), the controller reads it too. A `joint_compliance` reaches the log alone: its quasi-static law
has no resonance, which a feedback through it would excite. Carts off their guideways move the tool's position alone.

A log is *sampled*, not averaged: drives write their registers at each log tick. So noise above half the log rate folds down, as
it does in recordings, and positions and forces keep one clock; a mean over the ticks would delay them. Force noise has the
requested spectrum at the log rate. Encoder noise is white at the control rate, where it also enters the feedback.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from tau_dyn.effects import (
    DELIVERED,
    GUIDE_ACROSS,
    SENSITIVITY,
    SHIFTED_FORCE,
    SIDE_FORCE,
    CartShift,
    CircuitEffect,
    Delay,
    DisplacementEffect,
    ForceReading,
    Motion,
    TimingEffect,
    acts_on_recording,
    apply_first_order_lowpass,
)
from tau_dyn.exceptions import InputError
from tau_dyn.log import ROOM_TEMPERATURE, Log
from tau_dyn.model import COMPUTED, Model
from tau_dyn.robot import Robot
from tau_dyn.simulate.controllers import PerJoint
from tau_dyn.simulate.forces import Memory, compute_warm_up, repeat_signals
from tau_dyn.simulate.plant_run import PlantRun

_FOR_FORCES = frozenset(DisplacementEffect.needs)
_PATH = _FOR_FORCES | {"reversal", SHIFTED_FORCE}
"""Signals that a load's path gives, and those that only matter for forces."""


class EncoderErrors:
    """Encoder readings minus the loads' positions, from sample to sample."""

    def __init__(self, model: Model) -> None:
        """Look up the displacements that follow from each joint's path."""
        self._joints, self._na = model.robot.actuated, model.robot.na
        self._effects = [(e, x) for e, x in _displacements(model) if set(e.needs) <= _PATH]
        self._memory, self._last = Memory([e for e, _ in self._effects], self._na), None

    @property
    def any(self) -> bool:
        """Whether there are such effects."""
        return bool(self._effects)

    @property
    def effects(self) -> tuple[DisplacementEffect, ...]:
        """These effects."""
        return tuple(effect for effect, _ in self._effects)

    def read(self, q: np.ndarray) -> np.ndarray:
        """Return the readings of perfect encoders for the next true positions (na,) [m or rad]."""
        if self._last is not None:
            self._memory.advance(q - self._last, 0.0)
        self._last = np.array(q)
        shown, none = np.array(q), np.zeros((1, self._na))
        for effect, values in self._effects:
            signals = repeat_signals(self._memory.signals(effect), 1)
            motion = Motion.of(self._joints, q[None], none, none, self._memory.heading[None], signals=signals)
            shown += effect.displacement(motion)[0] @ values
        return shown


def record_run(run: PlantRun) -> PlantRun:
    """Return a run with the readings of perfect sensors added to the true signals; see `PlantRun`.

    Raises:
        InputError: An effect is neither of the robot nor of its sensors.
    """
    model = run.model
    known = DisplacementEffect | TimingEffect | CircuitEffect | ForceReading
    odd = [e for e in model.effects if acts_on_recording(e) and not isinstance(e, known)]
    if odd:
        raise InputError("unsupported", f"effect {odd[0].name} cannot be simulated")
    yielding = _yielding(run)
    shown, read = None, run.q_read
    if read is not None:
        read = read + yielding
    elif _displacements(model):
        errors = EncoderErrors(model)
        shown = yielding + (np.array([errors.read(q) for q in run.q]) if errors.any else run.q)
    return replace(run, q_shown=shown, q_read=read, tau_shown=_record_forces(run), tool_shown=_shifted_tool(run))


def get_temperatures(run: PlantRun) -> dict[str, np.ndarray]:
    """Return the room's temperature (N,) as a log's channel, where an effect follows it."""
    feels = any("temperature" in effect.needs for effect in run.model.effects)
    return {ROOM_TEMPERATURE: compute_warm_up(run.t - run.t[0])} if feels else {}


def get_voltages(run: PlantRun, forces: np.ndarray) -> dict[str, np.ndarray]:
    """Return channels (N,) of a drive that logs a voltage or pulse width as its force (N, na): one for a force of one."""
    kinds = dict.fromkeys(e.signal for e in run.model.effects if isinstance(e, CircuitEffect))
    return {f"{kind}_{j}": forces[:, k] for kind in kinds for k, j in enumerate(run.model.robot.actuated)}


def _read_forces(run: PlantRun) -> np.ndarray | None:
    """Return the forces (N, na) that drives report; None if these equal the true forces."""
    reading = [e for e in run.model.effects if isinstance(e, ForceReading)]
    signals: dict[str, np.ndarray] = {"force": run.tau, DELIVERED: run.tau}
    motion = Motion.of(run.model.robot.actuated, run.q, run.v, run.a, t=run.t, signals=signals)
    forces = [e.force(motion, run.model.effect_parameters) for e in reading]
    return run.tau + np.sum(forces, axis=0) if forces else None


def _find_voltages(run: PlantRun) -> np.ndarray | None:
    """Return the voltages (N, na) that a motor's circuit makes of the forces, as forces; None without a circuit."""
    circuit = [e for e in run.model.effects if isinstance(e, CircuitEffect)]
    if not circuit:
        return None
    warm = np.repeat(compute_warm_up(run.t - run.t[0])[:, None], run.model.robot.na, axis=1)
    tau = run.tau
    for effect in sorted(circuit, key=lambda e: "force" in e.needs):  # back-EMF first, as a voltage holds it
        signals = {"force": tau, "temperature": warm}
        motion = Motion.of(run.model.robot.actuated, run.q, run.v, run.a, t=run.t, signals=signals)
        tau = tau + effect.force(motion, run.model.effect_parameters)
    return tau


def _displacements(model: Model) -> list[tuple[DisplacementEffect, np.ndarray]]:
    effects = [e for e in model.effects if isinstance(e, DisplacementEffect) and acts_on_recording(e)]
    found = [e for e in effects if not isinstance(e, CartShift)]
    return [(e, model.effect_parameters.select(e.parameters.names).values) for e in found]


def _yielding(run: PlantRun) -> np.ndarray:
    """Return displacements (N, na) that follow from forces."""
    out, mechanism = np.zeros_like(run.q), run.model.mechanism
    for effect, values in _displacements(run.model):
        if set(effect.needs) <= _PATH:
            continue
        wanted = [name for name in effect.needs if name in COMPUTED and name not in _FOR_FORCES]
        signals = {name: COMPUTED[name](mechanism, run.q, run.v, run.a) for name in wanted}
        motion = Motion.of(
            run.model.robot.actuated, run.q, run.v, run.a, t=run.t, signals={**signals, "force": run.tau}
        )
        out += np.einsum("nip,p->ni", effect.displacement(motion), values)
    return out


def _record_forces(run: PlantRun) -> np.ndarray | None:
    """Return forces (N, na) as they are logged where a circuit or time changes them; the ends keep the last known ones."""
    changed = False
    for read in (_find_voltages, _read_forces):
        if (force := read(run)) is not None:
            run, changed = replace(run, tau=force), True
    late, lag = np.zeros((2, run.model.robot.na))
    for effect in run.model.effects:
        if isinstance(effect, TimingEffect):
            index = [run.model.robot.actuated.index(j) for j in effect.joints]
            total = late if isinstance(effect, Delay) else lag
            total[index] += run.model.effect_parameters[effect.parameters.names[0]].value
    if not (late.any() or lag.any()):
        return run.tau if changed else None
    shown = [apply_first_order_lowpass(force, run.t, x) for x, force in zip(lag, run.tau.T, strict=True)]
    return np.column_stack([np.interp(run.t - d, run.t, force) for d, force in zip(late, shown, strict=True)])


def _shifted_tool(run: PlantRun) -> np.ndarray | None:
    """Return the tool's position (N, 3) [m] with its carts shifted, or None without a shift or without a tool."""
    robot, mechanism = run.model.robot, run.model.mechanism
    effects = [e for e in run.model.effects if isinstance(e, CartShift)]
    if not effects or robot.tool_frame is None:
        return None
    across = mechanism.guide_across()
    signals = {
        SENSITIVITY: mechanism.cart_sensitivity(run.q),
        SIDE_FORCE: mechanism.guide_force(run.q, run.v, run.a),
        GUIDE_ACROSS: np.broadcast_to(across, (len(run.q), *across.shape)),
    }
    motion = Motion.of(robot.actuated, run.q, run.v, run.a, signals=signals)
    tool, still = run.tool, np.zeros((len(run.q), 3, robot.na))
    for effect in effects:
        tool = (
            tool
            + effect.tool_columns(motion, still) @ run.model.effect_parameters.select(effect.parameters.names).values
        )
    return tool


@dataclass(frozen=True)
class Sensors:
    """Sensors of a simulated robot; a single number holds for all joints, and zero means perfect.

    Attributes:
        encoder_noise: Standard deviation of the positions' noise [m or rad].
        encoder_resolution: Step that positions are rounded to [m or rad].
        force_noise: Standard deviation of the forces' noise [N or N m].
        force_noise_relative: The same as a share of each force's rms over the run; the two add in quadrature.
        force_ar: Coefficients of `x_k = sum_i c_i x_{k-i} + e_k` that colour the force noise.
        force_power_law: Exponent b of a spectral density `1 / f^b` instead; 0 is white, 1 pink.
        tool_noise: Standard deviation of the tool position's noise, each axis [m].
        tool: Whether the log has the tool's position, if the robot has a frame `tool`; a stock arm's flange is seldom tracked.
        log_rate_hz: Rate of the log [Hz], an integer part of the control rate; None for the control rate.
    """

    encoder_noise: PerJoint = 0.0
    encoder_resolution: PerJoint = 0.0
    force_noise: PerJoint = 0.0
    force_noise_relative: PerJoint = 0.0
    force_ar: tuple[float, ...] = ()
    force_power_law: float = 0.0
    tool_noise: float = 0.0
    tool: bool = True
    log_rate_hz: float | None = None

    def __post_init__(self) -> None:
        """Refuse negative noise, colours that contradict each other, and noise that would grow without end."""
        for key in ("encoder_noise", "encoder_resolution", "force_noise", "force_noise_relative", "tool_noise"):
            if not np.all(np.asarray(getattr(self, key)) >= 0):
                raise InputError("invalid_value", f"a sensor's {key} must not be below zero")
        if self.force_ar and self.force_power_law:
            raise InputError("invalid_value", "force noise is coloured by force_ar or by force_power_law, not by both")
        if not 0 <= self.force_power_law <= 2:
            raise InputError("invalid_value", "force_power_law must lie between 0 (white) and 2 (a random walk's)")
        if self.force_ar and np.max(np.abs(np.roots([1.0, *(-c for c in self.force_ar)]))) >= 1:
            raise InputError(
                "unstable", f"force_ar {self.force_ar} has a root on or outside the unit circle; its noise would grow"
            )

    @classmethod
    def typical(cls, robot: Robot, *, log_rate_hz: float | None = None) -> Sensors:
        """Return good industrial sensors: 1 um or 10 urad resolution, half of it as noise, 1 % force noise of AR(1) 0.5."""
        step = [1e-6 if unit == "m" else 1e-5 for unit in robot.position_units]
        noise = [x / 2 for x in step]
        return cls(noise, step, force_noise_relative=0.01, force_ar=(0.5,), tool_noise=5e-5, log_rate_hz=log_rate_hz)

    def read_positions(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the encoders' readings of positions (N, na) [m or rad]."""
        noise = broadcast_per_joint(self.encoder_noise, q.shape[1], "encoder_noise") * rng.standard_normal(q.shape)
        return self.rounded(q + noise)

    def rounded(self, q: np.ndarray) -> np.ndarray:
        """Return positions (..., na) rounded to the encoders' resolution."""
        return _round_to(q, broadcast_per_joint(self.encoder_resolution, q.shape[-1], "encoder_resolution"))

    def read_forces(self, tau: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return the forces that the drives report (N, na) [N or N m]."""
        absolute = broadcast_per_joint(self.force_noise, tau.shape[1], "force_noise")
        relative = broadcast_per_joint(self.force_noise_relative, tau.shape[1], "force_noise_relative")
        sd = np.hypot(absolute, relative * np.sqrt(np.mean(tau**2, axis=0)))
        return tau + sd * self._coloured(tau.shape, rng)

    def step(self, dt: float) -> int:
        """Return how many control periods of `dt` [s] pass between two log samples.

        Raises:
            InputError: The log rate is not an integer part of the control rate.
        """
        if self.log_rate_hz is None:
            return 1
        ratio = 1 / (dt * self.log_rate_hz) if self.log_rate_hz > 0 else 0.0
        if not np.isfinite(ratio) or round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise InputError(
                "invalid_value",
                f"a log rate of {self.log_rate_hz:g} Hz is not the control rate of {1 / dt:g} Hz divided by a whole number",
            )
        return round(ratio)

    def _coloured(self, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        """Return noise (N, na) of standard deviation one."""
        if self.force_ar:
            return _autoregressive(np.array(self.force_ar), shape, rng)
        if self.force_power_law:
            return _power_law(self.force_power_law, shape, rng)
        return rng.standard_normal(shape)


class EncoderReadings:
    """A controller's readings of the true positions, sample by sample: encoder errors, noise, rounding."""

    def __init__(self, model: Model, sensors: Sensors, n_samples: int, rng: np.random.Generator) -> None:
        """Draw the noise of all samples."""
        na = model.robot.na
        sd = broadcast_per_joint(sensors.encoder_noise, na, "encoder_noise")
        self.noise = sd * rng.standard_normal((n_samples, na))
        self.resolution = broadcast_per_joint(sensors.encoder_resolution, na, "encoder_resolution")
        self._errors = EncoderErrors(model)

    def __call__(self, k: int, q: np.ndarray) -> np.ndarray:
        """Return the readings of positions (na,) in sample k."""
        return _round_to((self._errors.read(q) if self._errors.any else q) + self.noise[k], self.resolution)


def measure(run: PlantRun, sensors: Sensors, rng: np.random.Generator, name: str = "simulated") -> Log:
    """Turn a run into a log with `q_J`, `tau_J`, `q_ref_J` and, with a tool frame, `x_tool y_tool z_tool`.

    Positions are those the controller read if its feedback used the encoders; else they are read here, so
    that one run can be measured with many seeds.

    Raises:
        InputError: The log rate does not divide the control rate, or a sensor's numbers do not fit the joints.
    """
    warnings, run = run.warnings, run.every(sensors.step(float(run.t[1] - run.t[0])))
    shown = run.q if run.q_shown is None else run.q_shown
    q = sensors.read_positions(shown, rng) if run.q_read is None else run.q_read
    signals = {"q": q, "tau": sensors.read_forces(run.tau if run.tau_shown is None else run.tau_shown, rng)}
    if run.reference is not None:
        signals["q_ref"] = run.reference.q
    joints = run.model.robot.actuated
    channels = {f"{key}_{j}": values[:, k] for key, values in signals.items() for k, j in enumerate(joints)}
    channels |= get_temperatures(run) | get_voltages(run, signals["tau"])
    if sensors.tool and run.model.robot.tool == "tool":
        tool = (run.tool if run.tool_shown is None else run.tool_shown) + sensors.tool_noise * rng.standard_normal(
            run.tool.shape
        )
        channels |= dict(zip(("x_tool", "y_tool", "z_tool"), tool.T, strict=True))
    return Log(run.t, channels, name, warnings=warnings)


def _round_to(q: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return positions (..., na) rounded to a step (na,) each, if it is not zero."""
    return np.where(step > 0, np.round(q / np.where(step > 0, step, 1.0)) * step, q)


def broadcast_per_joint(value: PerJoint, na: int, what: str) -> np.ndarray:
    """Return one number a joint (na,)."""
    array = np.asarray(value, dtype=float)
    if array.shape not in ((), (na,)):
        raise InputError(
            "wrong_shape", f"a sensor's {what} has {array.size} numbers for {na} joint(s); give one, or one a joint"
        )
    return np.broadcast_to(array, (na,))


def _autoregressive(c: np.ndarray, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return stationary noise of `x_k = sum_i c_i x_{k-i} + e_k` with standard deviation one."""
    denominator = np.concatenate([[1.0], -c])
    slowest = float(np.max(np.abs(np.roots(denominator)), initial=0.0))
    settle = min(100_000, 10 + int(np.ceil(-20 / np.log(slowest)))) if slowest > 0 else 10
    response = np.asarray(lfilter([1.0], denominator, np.eye(1, settle)[0]))
    gain = np.sqrt(np.sum(response**2))
    return lfilter([1.0], denominator, rng.standard_normal((shape[0] + settle, shape[1])), axis=0)[settle:] / gain


def _power_law(exponent: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Return noise of spectral density `1 / f^exponent`, without mean, with expected standard deviation one."""
    n = 2 * shape[0]  # made twice as long and cut, so that its ends do not meet
    f = np.fft.rfftfreq(n)
    amplitude = np.zeros(len(f))
    amplitude[1:] = f[1:] ** (-exponent / 2)
    gain = np.sqrt(np.sum(amplitude**2) * 2 / n)
    spectrum = np.fft.rfft(rng.standard_normal((n, shape[1])), axis=0) * amplitude[:, None]
    return np.fft.irfft(spectrum, n, axis=0)[: shape[0]] / gain
