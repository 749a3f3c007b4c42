"""Simulated repetition of a recording: the plant under the rig's own controller, driven by the log's references.

The controller sees `q_ref_J` of the log and the simulated positions; the plant starts from the log's first position and speed.
The signals of the log are compared: positions and forces without filter, the following error `q_ref - q`, and speeds and
accelerations, both sides with the same low-pass and central differences:

    error = 100 |simulated - measured| / |measured| [%],

with norms over all samples, without a mask, as in the published errors of EMPS (Janot, Gautier & Brunot 2019).

Timing is a drive's: position k is read, force k follows from it and is held until sample k + 1. The plant's step runs from half
a sample before to half a sample after, so it is given the mean of the last two forces, which is that hold exactly. The loop
runs at the log's rate, or at a whole multiple of it; between the log's samples the reference is a cubic spline that does not
swing around a step. Encoders do not round here. If the model has such effects, their readings differ from the load's position,
forces are logged late and friction follows the log's temperature (`sensors.py`, `forces.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from tau_dyn.exceptions import InputError
from tau_dyn.log import ROOM_TEMPERATURE, Log, differentiate, ensure_even, find_motion_band, lowpass
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.simulate.compiled_plant import CompiledPlant
from tau_dyn.simulate.controllers import CascadeController, CascadeLaw
from tau_dyn.simulate.forces import EffectSurroundings
from tau_dyn.simulate.plant import Plant, follow_cascade
from tau_dyn.simulate.plant_run import OFTEN_AT_LIMIT, PlantRun, Progress
from tau_dyn.simulate.sensors import EncoderErrors, record_run
from tau_dyn.simulate.trajectory import Trajectory

SIGNALS = ("position", "speed", "acceleration", "force", "following")
"""Signals that are compared; `following` is the reference minus the position."""


@dataclass(frozen=True, eq=False)
class Replay:
    """A recording and its simulated repetition.

    Attributes:
        joints: Actuated joints, in the order of the columns.
        units: Unit of each joint's position and of its force, as pairs.
        t: Time (N,) [s], the log's.
        measured: Signals of the log by name (`SIGNALS`) (N, na); [m or rad], per s, per s^2, [N or N m].
        simulated: The same signals of the simulation.
        cutoff_hz: Zero-phase low-pass on positions before speeds and accelerations are taken [Hz]; inf for no low-pass.
        rate_hz: Rate of the simulated control loop [Hz].
        at_limit: Share of the samples in which the controller's limit held (na,).
        stuck: Share of the samples in which friction held a joint (na,).
        warnings: Doubts about the result, one sentence each.
    """

    joints: tuple[str, ...]
    units: tuple[tuple[str, str], ...]
    t: np.ndarray
    measured: Mapping[str, np.ndarray]
    simulated: Mapping[str, np.ndarray]
    cutoff_hz: float
    rate_hz: float
    at_limit: np.ndarray
    stuck: np.ndarray
    warnings: tuple[str, ...] = ()

    def residual(self, signal: str) -> np.ndarray:
        """Return measured minus simulated (N, na) of a signal."""
        return self.measured[signal] - self.simulated[signal]

    def relative_error_percent(self, signal: str) -> np.ndarray:
        """Return `100 |simulated - measured| / |measured|` (na,) [%]; nan if all measured values are zero.

        A position's error is relative to the distance from the joint's zero, so it has little meaning for a joint that works
        far from zero; `following` does not depend on the position of zero.
        """
        size = np.linalg.norm(self.measured[signal], axis=0)
        away = np.linalg.norm(self.residual(signal), axis=0)
        return np.divide(100 * away, size, out=np.full(len(size), np.nan), where=size > 0)

    def with_cutoff(self, cutoff_hz: float) -> Replay:
        """Return the same replay with speeds and accelerations after another low-pass [Hz], or without (inf)."""
        sides = []
        for side in (self.measured, self.simulated):
            q = side["position"]
            sides.append(get_signals(self.t, side["following"] + q, q, side["force"], cutoff_hz))
        return replace(self, measured=sides[0], simulated=sides[1], cutoff_hz=cutoff_hz)

    def to_dict(self) -> dict[str, Any]:
        """Return errors and settings as plain numbers for JSON; null if all measured values are zero."""
        errors: dict[str, Any] = {}
        for signal in SIGNALS:
            rms = np.sqrt(np.mean(self.residual(signal) ** 2, axis=0))
            rows = zip(self.joints, self.relative_error_percent(signal), rms, self.units, strict=True)
            errors[signal] = {
                joint: {
                    "relative_error_percent": None if np.isnan(percent) else float(percent),
                    "rms": float(size),
                    "unit": _unit(signal, *unit),
                }
                for joint, percent, size, unit in rows
            }
        return {
            "errors": errors,
            "cutoff_hz": self.cutoff_hz if np.isfinite(self.cutoff_hz) else None,
            "control_rate_hz": self.rate_hz,
            "seconds": float(self.t[-1] - self.t[0]),
            "share_at_limit": dict(zip(self.joints, self.at_limit.tolist(), strict=True)),
            "share_stuck": dict(zip(self.joints, self.stuck.tolist(), strict=True)),
            **format_warnings(self.warnings),
        }


def get_signals(
    t: np.ndarray, q_ref: np.ndarray, q: np.ndarray, tau: np.ndarray, cutoff_hz: float
) -> dict[str, np.ndarray]:
    """Return all signals of one side, in the order of `SIGNALS`.

    Args:
        t: Even times (N,) [s].
        q_ref: References (N, na) [m or rad].
        q: Positions (N, na) [m or rad].
        tau: Forces (N, na) [N or N m].
        cutoff_hz: Zero-phase low-pass on positions before central differences give speeds and accelerations; inf for no
            low-pass.
    """
    dt = (t[-1] - t[0]) / (len(t) - 1)
    v = differentiate(lowpass(q, cutoff_hz, 1 / dt) if np.isfinite(cutoff_hz) else q, dt)
    return dict(zip(SIGNALS, (q, v, differentiate(v, dt), tau, q_ref - q), strict=True))


def _unit(signal: str, position: str, force: str) -> str:
    suffix = {"speed": "/s", "acceleration": "/s^2"}.get(signal, "")
    return force if signal == "force" else position + suffix


CONTROL_HZ = 1000.0
"""A loop is not taken to run more slowly than this [Hz], however few samples the log keeps."""

START_S = 0.02
"""Stretch at the log's start from which its first position, speed and force are read, by a cubic through it [s]."""


class SteppedPlant(Protocol):
    """A robot that is stepped in time, such as `Plant`, or one in another program."""

    @property
    def q(self) -> np.ndarray:
        """Positions (na,) [m or rad] at the current sample."""
        ...

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Apply forces (na,) around the sample; return its speed, acceleration and stuck joints, then advance."""
        ...


StartPlant = Callable[[Model, np.ndarray, np.ndarray, float], SteppedPlant]
"""Starts a robot at positions and speeds (na,) with a step [s]."""


def replay(
    model: Model,
    log: Log,
    controller_law: CascadeLaw,
    *,
    rate_hz: float | None = None,
    substeps: int = 1,
    cutoff_hz: float | None = None,
    start_plant: StartPlant | None = None,
    progress: Progress | None = None,
) -> Replay:
    """Simulate a recording again and compare.

    Args:
        model: The plant.
        log: Has `q_J`, `tau_J` and `q_ref_J` of every actuated joint, without gaps; it may start in motion.
        controller_law: The rig's own controller.
        rate_hz: Rate of its loop [Hz], a whole multiple of the log's; by default the smallest that reaches 1 kHz.
        substeps: Steps of the plant in one period of the loop.
        cutoff_hz: Low-pass before speeds and accelerations are taken [Hz], inf for no low-pass; by default as high as the
            measured encoders' noise allows (1e-4 of the acceleration's power, `find_motion_band`), and the same for later
            replays of the log.
        start_plant: Starts the robot in another program; by default `Plant`, compiled if possible.
        progress: Called with the share that is done.

    Raises:
        InputError: The log lacks a column or has a gap, the law is for another robot, or the simulated feedback is unstable.
        LoopClosureError: The robot was driven to a position at which its loops cannot be closed.
    """
    joints = model.robot.actuated
    log = ensure_even(_checked(log, joints))
    if substeps < 1:
        raise InputError(
            "invalid_value", f"a replay takes {substeps} substeps of the plant; give a whole number from 1"
        )
    if any("temperature" in effect.needs for effect in model.effects) and _surroundings(log, joints) is None:
        raise InputError(
            "missing_column",
            f"{log.name} has no temperature, which the model's friction follows; give temp_room or temp_J",
        )
    often = _per_sample(log, rate_hz)
    cutoff = _cutoff(log.joint("q", joints), _rate(log)) if cutoff_hz is None else cutoff_hz
    reference = log.joint("q_ref", joints)
    run = _drive(model, log, controller_law, _Pace(often, substeps), start_plant, progress)
    q = run.q if run.q_read is None else run.q_read
    tau = run.tau if run.tau_shown is None else run.tau_shown
    at_limit = np.mean(np.abs(run.tau) >= controller_law.limit * controller_law.force_per_unit * (1 - 1e-9), axis=0)
    notes = [
        f"joint {joint} was at its controller's limit in {100 * share:.0f} % of the samples of the replay of {log.name}"
        for joint, share in zip(joints, at_limit, strict=True)
        if share > OFTEN_AT_LIMIT
    ]
    return Replay(
        joints,
        tuple(zip(model.robot.position_units, model.robot.force_units, strict=True)),
        log.t,
        get_signals(log.t, reference, log.joint("q", joints), log.joint("tau", joints), cutoff),
        get_signals(log.t, reference, q, tau, cutoff),
        float(cutoff),
        often * _rate(log),
        at_limit,
        run.sticking_share,
        (*log.warnings, *notes),
    )


class _State(NamedTuple):
    """A log's first sample, and the two positions a drive had read before it: (na,) each, `before` (2, na)."""

    q: np.ndarray
    v: np.ndarray
    tau: np.ndarray
    before: np.ndarray


class _ResumedController(CascadeController):
    """A cascade that has been running before the first sample."""

    def resume(self, reference: Trajectory, start: _State) -> None:
        """Get ready as `reset` does, but in motion; an integral starts so that the first force equals the measured one."""
        self.reset(reference)
        v_before = 2 * reference.v[0] - reference.v[1]
        self._before, self._v_ref = (start.before[0], start.before[1]), v_before
        push = self.force(0, 0.0, reference.q[0], reference.v[0], reference.a[0], start.q)
        integrates = (self.law.integral_rate > 0) & (self.law.force_per_unit > 0)
        unit = np.where(integrates, self.law.force_per_unit, 1.0)
        wound = np.minimum(np.maximum((start.tau - push) / unit, -self.law.limit), self.law.limit)
        self._integral = np.where(integrates, wound, 0.0)
        self._before, self._v_ref = (start.before[0], start.before[1]), v_before


class _Pace(NamedTuple):
    """Periods of the loop in a sample of the log, and steps of the plant in a period."""

    often: int
    substeps: int


def _start_with_temperatures(log: Log, joints: tuple[str, ...]) -> StartPlant:
    """Return how `Plant` starts in the surroundings that the log holds."""

    def start(model: Model, q: np.ndarray, v: np.ndarray, dt: float) -> Plant:
        return Plant(model, q, v, dt, _surroundings(log, joints))

    return start


def _drive(
    model: Model, log: Log, law: CascadeLaw, pace: _Pace, start_plant: StartPlant | None, progress: Progress | None
) -> PlantRun:
    """Return the simulated run at the log's samples."""
    joints, (often, substeps) = model.robot.actuated, pace
    reference = _reference(log, joints, often)
    period = 1 / (often * _rate(log))
    start, errors = _start(log, joints, period), EncoderErrors(model)
    controller = _ResumedController(law)
    controller.resume(reference, start)
    beside = EncoderErrors(model).read(start.q) - start.q if errors.any else 0.0
    far = 100 * (1 + np.max(np.abs(reference.q), axis=0))
    compiled = None
    if start_plant is None:
        room = _surroundings(log, joints)
        compiled = CompiledPlant.find(model, substeps * reference.n_samples, room, encoders=True)
    if compiled is not None:

        def watch(k: int, q: np.ndarray) -> bool:
            if progress is not None:
                progress(k / reference.n_samples)
            return bool(np.all(np.abs(q) < far))

        options = {"often": often, "substeps": substeps, "hold": True, "watch": watch}
        moved = follow_cascade(compiled, controller, reference, (start.q - beside, start.v), **options)
        if moved is not None:
            return record_run(PlantRun(model, log.t, *moved[:5], reference.every(often), moved.read))
    start_plant = start_plant or _start_with_temperatures(log, joints)
    plant = start_plant(model, start.q - beside, start.v, period / substeps)
    q, read, v, a, tau = np.empty((5, log.n_samples, len(joints)))
    stuck = np.zeros((log.n_samples, len(joints)), dtype=bool)
    last = None
    for k in range(reference.n_samples):
        place, shown = plant.q, errors.read(plant.q) if errors.any else plant.q
        force = controller.force(k, reference.t[k], reference.q[k], reference.v[k], reference.a[k], shown)
        step = plant.step(force if last is None else 0.5 * (last + force))
        for _ in range(1, substeps):
            plant.step(force)
        row, between = divmod(k, often)
        if not between:
            q[row], read[row], tau[row], (v[row], a[row], stuck[row]) = place, shown, force, step
        last = force
        if k % max(1, reference.n_samples // 100) == 0:
            if not np.all(np.abs(plant.q) < far):
                raise InputError(
                    "unstable",
                    f"{log.name}: the simulated robot ran away before t = {reference.t[k]:.4g} s; the controller's gains, "
                    "their units or its rate are not this robot's",
                )
            if progress is not None:
                progress(k / reference.n_samples)
    return record_run(PlantRun(model, log.t, q, v, a, tau, stuck, reference.every(often), read))


def _surroundings(log: Log, joints: tuple[str, ...]) -> EffectSurroundings | None:
    """Return the temperatures that the log holds, of its joints or of the room, or None."""
    measured = log.temperatures(joints)
    if measured is None:
        return None
    t = log.t - log.t[0]
    return EffectSurroundings(lambda at: np.array([np.interp(at, t, column) for column in measured.T]))


def _start(log: Log, joints: tuple[str, ...], period: float) -> _State:
    """Return how the log starts, by cubics through its first samples, which average the encoders' noise."""
    n = min(log.n_samples, max(8, round(START_S * _rate(log)) + 1))
    t = log.t[:n] - log.t[0]
    powers = np.vander(t, 4, increasing=True)
    q = np.linalg.lstsq(powers, log.joint("q", joints)[:n], rcond=None)[0]
    tau = np.linalg.lstsq(powers, log.joint("tau", joints)[:n], rcond=None)[0]
    before = np.vander([-2 * period, -period], 4, increasing=True) @ q
    return _State(q[0], q[1], tau[0], before)


def _reference(log: Log, joints: tuple[str, ...], often: int) -> Trajectory:
    """Return the log's reference with `often` samples for each sample of the log.

    Slopes of a cubic Hermite spline: central differences, no steeper than three times the flatter adjacent chord, so that no
    value exceeds its neighbours (Fritsch & Carlson 1980; Hyman 1983).
    """
    dt, q = 1 / _rate(log), log.joint("q_ref", joints)
    chord = np.abs(np.diff(q, axis=0)) / dt
    steepest = 3 * np.minimum(np.vstack([chord[:1], chord]), np.vstack([chord, chord[-1:]]))
    slope = np.minimum(np.maximum(differentiate(q, dt, accuracy=4), -steepest), steepest)
    curve = CubicHermiteSpline(log.t, q, slope)
    clock = np.linspace(log.t[0], log.t[-1], (log.n_samples - 1) * often + 1)
    return Trajectory(joints, clock, curve(clock), curve(clock, 1), curve(clock, 2), log.name)


def _cutoff(q: np.ndarray, rate_hz: float) -> float:
    """Return the highest low-pass [Hz] under which noise stays small in every moving joint's acceleration."""
    band = find_motion_band(q, rate_hz)
    edges = np.maximum(band.noise_edge_hz, band.edge_hz)[band.edge_hz > 0]
    return float(min([0.4 * rate_hz, *edges]))


def _per_sample(log: Log, rate_hz: float | None) -> int:
    """Return how many periods of the loop pass between two samples of the log."""
    if rate_hz is None:
        return max(1, int(np.ceil(CONTROL_HZ / _rate(log) * (1 - 1e-3))))
    ratio = rate_hz / _rate(log) if np.isfinite(rate_hz) else 0.0
    if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-3 * ratio:
        raise InputError(
            "mismatch",
            f"a control loop of {rate_hz:g} Hz is no whole multiple of the {_rate(log):g} Hz of {log.name}; resample the log",
        )
    return round(ratio)


def _checked(log: Log, joints: tuple[str, ...]) -> Log:
    """Return the log with the columns that count, all there and finite."""
    if not log.has("q_ref", joints):
        raise InputError(
            "missing_column",
            f"{log.name} has no q_ref column for {', '.join(j for j in joints if not log.has('q_ref', [j]))}; without the "
            "references its controller got, a recording cannot be simulated again",
        )
    columns = {f"{s}_{j}": log.joint(s, [j])[:, 0] for s in ("q", "tau", "q_ref") for j in joints}
    for name, values in columns.items():
        if not np.all(np.isfinite(values)):
            raise InputError("bad_sample", f"{log.name}: {name} has samples that are no finite number")
    if log.n_samples < 10:
        raise InputError(
            "too_little_data",
            f"{log.name} has {log.n_samples} samples, too few to be simulated again; give ten or more",
        )
    warmth = (ROOM_TEMPERATURE, *(f"temp_{j}" for j in joints))
    columns |= {key: log.channels[key] for key in warmth if np.all(np.isfinite(log.channels.get(key, np.nan)))}
    return Log(log.t, columns, log.name, log.sha256, log.warnings)


def _rate(log: Log) -> float:
    """Return the rate of an even log [Hz], free of the jitter of single steps."""
    return (log.n_samples - 1) / log.duration
