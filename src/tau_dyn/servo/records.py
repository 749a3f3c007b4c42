"""Logs of commands and positions -> even records, and the loads of a robot along their motions -> waves for the loop.

A command holds from its stamp to the next one. Uneven stamps have a clock finer than the samples. Residuals are taken at the
stamps themselves, where simulated positions are interpolated over three steps of that clock; measured positions, interpolated
over the much longer steps between stamps, only give the motion along which loads are evaluated first. The inertial numbers of
the robot file have an uncertainty, a quarter of each body's size unless the file or `--fix` states another; only the directions
in which logs inform more than that are unknowns (a likelihood-informed subspace), so that a fit cannot drift in directions
without information.
Reference: Cui, Martin, Marzouk, Solonen & Spantini 2014.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import Akima1DInterpolator, interp1d

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, differentiate, estimate_encoder_noise, lowpass
from tau_dyn.mechanism import Mechanism, build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import BodyPrior
from tau_dyn.servo.consistent_bodies import ConsistentBodies
from tau_dyn.servo.waves import LoadRows, Waves, find_command_steps
from tau_dyn.simulate import COMMANDS, ServoLaw

MOTION_HZ = 12.0
"""Low-pass of measured positions before they are differentiated [Hz]: twice the bandwidth of a servo's position loop."""
SLOW_S = 0.04
"""Time over which own inertia and stiffness may be interpolated [s]: positions change by less than 0.1 rad."""
LOAD_S = 2e-3
"""Time between the loads of coupled joints [s]: speeds change by a few per cent of their peaks in it."""
PIECES = 24
"""Approximate number of pieces into which logs are cut for a fit; more are not faster."""
MIN_PIECE_S = 10.0
"""Shortest piece [s]: a start at the measured position hides the effect of static friction, so starts are rare."""
WARM_UP_S = 1.0
"""Start of a piece, and of a log that begins in motion, that is not used [s]: a dozen time constants of a servo's loop. A motion
that begins at rest instead of at 1 rad/s is still 0.6 mrad off after four of them, and 0.01 mrad after eight."""
MAX_WARM_UP = 0.1
"""Largest share of a log that is left out at its start."""
MIN_WHOLE_S = 3.0
"""Duration from which a log leaves out its start [s]: shorter ones answer single steps, which their start shows."""
EARLY_S = 0.15
"""Time in which a joint has to move for its log to begin in motion [s]: two time constants of a servo's loop."""
MAX_SUPPLY = 10.0
"""Largest supply of a log over the nominal one; a larger value has another unit, such as tenths of a volt, or is not a
supply."""
ROWS = 20_000
"""Number of samples whose regressors are computed at once: 60 MB for an arm of six joints."""


@dataclass(frozen=True, eq=False)
class LoopRecord:
    """One log on an even clock, finer than its samples where its stamps are uneven.

    Attributes:
        name: The log's name.
        t: Time (N,) [s].
        q: Measured positions (N, na) [rad].
        command: Commands (N, na) [rad, or the law's unit].
        supply: Supply over the nominal one (N,).
        enabled: 1 while the motor is on (N,).
        used: Samples that are used (N,).
        entries: Law entries (na,) that hold in this log.
        start: Positions from which it is simulated (na,) [rad]; None for the measured ones.
        speed: Speeds at the first sample (na,) [rad/s]; None for rest.
        told: Kind of the commands, one of `simulate.COMMANDS`.
        every: Samples of the clock per logged sample; more than one if the log's stamps are uneven.
        steps: Mask (N, na) of commands that are steps, by their own stamps; None to find them on the clock.
        apart: Stamps minus the times of the clock to which they are nearest, in its steps (N,), zero where no stamp is near;
            None if the stamps are even.
        at_stamps: Positions (N, na), measured at those stamps where one is near; None for `q`.
        sent: Stamps (M,) and commands (M, na) of the whole log; None if the stamps are even.
    """

    name: str
    t: np.ndarray
    q: np.ndarray
    command: np.ndarray
    supply: np.ndarray
    enabled: np.ndarray
    used: np.ndarray
    entries: Mapping[str, np.ndarray]
    start: np.ndarray | None = None
    speed: np.ndarray | None = None
    told: str = COMMANDS[0]
    every: int = 1
    steps: np.ndarray | None = None
    apart: np.ndarray | None = None
    at_stamps: np.ndarray | None = None
    sent: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def measured(self) -> np.ndarray:
        """Positions (N, na) with which simulated ones at the stamps are compared."""
        return self.q if self.at_stamps is None else self.at_stamps

    def cut(self, part: slice) -> LoopRecord:
        """Return a part of the record."""
        names = ("t", "q", "command", "supply", "enabled", "used", "steps", "apart", "at_stamps")
        whole = {name: getattr(self, name) for name in names}
        return replace(self, **{name: None if x is None else x[part] for name, x in whole.items()})

    @property
    def interval(self) -> float:
        """Time between logged samples [s]."""
        return self.every * self.dt

    @property
    def goal(self) -> np.ndarray:
        """Positions (N, na) that commands alone request: integrated speeds for speed commands, constant positions for torques."""
        if self.told == "position":
            return self.command
        if self.told != "speed":
            return np.broadcast_to(self.q[:1], self.q.shape)
        return self.q[0] + np.concatenate(
            [np.zeros((1, self.q.shape[1])), np.cumsum(self.command[:-1], axis=0) * self.dt]
        )

    @property
    def dt(self) -> float:
        """Time between samples [s]."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    @cached_property
    def motion(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Smoothed positions, speeds and accelerations (N, na), for loads."""
        return smooth_motion(self.q, self.dt)


def move_to_stamps(x: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Return signals (N, ...) on a clock, evaluated at stamps by the parabola through three samples.

    Args:
        x: The signals.
        apart: Stamps minus the clock's times, in its steps, broadcast to the signals.
    """
    ends = [(0, 0)] * (x.ndim - 1)
    before, after = np.pad(x[:-1], [(1, 0), *ends], mode="edge"), np.pad(x[1:], [(0, 1), *ends], mode="edge")
    return x + 0.5 * apart * (after - before + apart * (after - 2 * x + before))


def smooth_motion(q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (N, na), low-passed at `MOTION_HZ`, and their derivatives."""
    smooth = lowpass(q, MOTION_HZ, 1 / dt) if 1 / dt > 2.5 * MOTION_HZ else q
    v = differentiate(smooth, dt)
    return smooth, v, differentiate(v, dt)


def build_records(model: Model, law: ServoLaw, logs: Sequence[Log], exclude: Sequence[str] = ()) -> list[LoopRecord]:
    """Return the logs on even clocks.

    Raises:
        InputError: A log lacks a command, a position or a column that the law names.
    """
    return [_build_record(model, law, log, exclude) for log in logs]


UNEVEN_SHARE = 0.02
"""Rms distance of a log's stamps from an even clock, in its steps, from which the clock is finer than the log. At 30 Hz 2 % of a
step change a position by less than an encoder's resolution; stamps rounded to milliseconds are below."""
CLOCK_S = 5e-3
"""Longest step of such a clock [s], over which a servo's motion is nearly a parabola."""

_REST_Z = 6.0  # range of a joint at rest, in standard deviations of its encoder


def _is_moving(log: Log, joints: Sequence[str]) -> bool:
    """Return whether a joint moves within `EARLY_S`."""
    q = log.joint("q", joints)
    early = q[log.t - log.t[0] <= max(EARLY_S, 2.5 * log.dt)]
    return bool(np.any(np.ptp(early, axis=0) > _REST_Z * estimate_encoder_noise(q)))


def _count_ticks(log: Log) -> int:
    """Return the samples of the clock per logged sample: one if the log's stamps are even."""
    at = (log.t - log.t[0]) / log.dt
    uneven = float(np.sqrt(np.mean((at - np.round(at)) ** 2))) > UNEVEN_SHARE
    return max(1, int(np.ceil(log.dt / CLOCK_S))) if uneven else 1


def _build_record(model: Model, law: ServoLaw, log: Log, exclude: Sequence[str]) -> LoopRecord:
    """Return a log on an even clock; samples of the clock to which no stamp is nearest are not used."""
    joints, every = model.robot.actuated, _count_ticks(log)
    dt = log.dt / every
    t = log.t[0] + np.arange(int((log.t[-1] - log.t[0]) / dt) + 1) * dt
    q, command, within = log.joint("q", joints), log.joint("cmd", joints), np.minimum(t, log.t[-1])
    between = Akima1DInterpolator(log.t, q, method="makima") if every > 1 else interp1d(log.t, q, axis=0)
    held = np.clip(np.searchsorted(log.t, t + 0.5 * dt, side="right") - 1, 0, len(log.t) - 1)
    near = np.clip(np.searchsorted(log.t, t - 0.5 * dt), 0, len(log.t) - 1)
    supply, enabled, used = np.ones((3, len(t)))
    q_clock, apart, at_stamps, sent = between(within), None, None, None
    mean, steps = average_held_commands(log.t, command, t, dt), None
    if every > 1:
        sent = (log.t, command)
        mean, steps = hold_commands(*sent, t, dt)
        apart = (log.t[near] - t) / dt
        used = (np.abs(apart) <= 0.5).astype(float)
        apart, at_stamps = used * apart, np.where(used[:, None] > 0, q[near], q_clock)
    length = t[-1] - t[0]
    if length > MIN_WHOLE_S and _is_moving(log, joints):
        used[t - t[0] < min(WARM_UP_S, MAX_WARM_UP * length)] = 0
    if law.supply:
        supply = np.interp(t, log.t, _get_column(log, law.supply, MAX_SUPPLY * law.nominal_supply)) / law.nominal_supply
    if law.enabled:
        enabled = (_get_column(log, law.enabled)[held] != 0).astype(float)
    for name in exclude:
        if name not in log.channels:
            raise InputError("missing_column", f"{log.name} has no column {name} to exclude samples by")
        used = used * (log.channels[name][near] == 0)
    return LoopRecord(
        log.name,
        t,
        q_clock,
        mean,
        supply,
        enabled,
        used.astype(bool),
        law.in_log(log.name),
        told=law.command,
        every=every,
        steps=steps,
        apart=apart,
        at_stamps=at_stamps,
        sent=sent,
    )


MIN_STEP_SHARE = 1e-3
"""Share of a step by which a command's stamp differs from the even clock; smaller differences are rounding of the stamps."""


def hold_commands(stamps: np.ndarray, command: np.ndarray, t: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean command (M, na) over each step of an even clock, and the mask (M, na) of those that are steps."""
    mean = average_held_commands(stamps, command, t, dt)
    last = np.clip(np.searchsorted(stamps, t + (1 - MIN_STEP_SHARE) * dt) - 1, 0, len(stamps) - 1)
    changed = np.diff(mean, axis=0, prepend=mean[:1]) != 0
    return mean, find_command_steps(command[:, :, None], stamps[:, None, None])[last, :, 0] & changed


def average_held_commands(stamps: np.ndarray, command: np.ndarray, t: np.ndarray, dt: float) -> np.ndarray:
    """Return the mean command (M, na) over each step of an even clock.

    A command is held from its stamp to the next one (zero-order hold). To first order a servo responds to the mean of the
    commands within a step, independent of the stamp's position within the step. Stamps that agree with the clock to their
    rounding keep their commands.

    Args:
        stamps: Times of the commands (N,) [s].
        command: Commands (N, na).
        t: The even clock (M,) [s].
        dt: Its step [s].
    """
    ends = np.append(stamps, max(stamps[-1], t[-1]) + dt)
    total = np.vstack([np.zeros(command.shape[1]), np.cumsum(command * np.diff(ends)[:, None], axis=0)])
    middle = np.clip(np.searchsorted(stamps, t + 0.5 * dt, side="right") - 1, 0, len(stamps) - 1)
    slack = MIN_STEP_SHARE * dt
    first = np.searchsorted(stamps, t + slack, side="right")
    last = np.searchsorted(stamps, t + dt - slack, side="left")
    found = command[middle]
    mixed = last > first
    if mixed.any():
        at, end = t[mixed], t[mixed] + dt
        integral = [np.interp(end, ends, x) - np.interp(at, ends, x) for x in total.T]
        found[mixed] = np.stack(integral, axis=1) / dt
    return found


def _get_column(log: Log, name: str, most: float | None = None) -> np.ndarray:
    """Return a column (N,) that a law names: finite numbers, from zero to `most` if that is given."""
    if name not in log.channels:
        raise InputError("missing_column", f"{log.name} has no column {name}, which the controller file names")
    column = log.channels[name]
    bad = ~np.isfinite(column) if most is None else ~((column >= 0) & (column <= most))
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(
            "bad_sample",
            f"{log.name}, column {name}, t = {log.t[k]:.6g} s: {column[k]:g}; every sample needs a number here"
            + ("" if most is None else f" from 0 to {most:g}, {MAX_SUPPLY:g} times the nominal supply"),
        )
    return column


@dataclass(frozen=True, eq=False)
class InertialSpace:
    """Inertial numbers of the robot file, and the directions in which they may differ.

    Attributes:
        model: The model; drive inertias are not included.
        nominal: Its parameters, drive inertias at zero (p,).
        directions: Changes of the parameters (p, K) for one unit of each unknown, one standard deviation of prior knowledge.
        prior: Standard deviations of the parameters (p,) before the fit; zero for fixed ones.
    """

    model: Model
    nominal: np.ndarray
    directions: np.ndarray
    prior: np.ndarray

    @classmethod
    def of(cls, model: Model) -> InertialSpace:
        """Return the space of a model, without unknowns."""
        parameters, known = model.robot.parameters, BodyPrior.of(model.robot).rough
        nominal, prior = np.zeros((2, len(parameters)))
        for k, p in enumerate(parameters):
            if not p.name.endswith(".armature"):
                nominal[k] = p.value
                given = p.prior_stderr if p.prior_stderr is not None else known.get(p.name, 0.0)
                prior[k] = given if p.free or p.prior_stderr is not None else 0.0
        return cls(model, nominal, np.zeros((len(parameters), 0)), prior)

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return self.directions.shape[1]

    @property
    def basis(self) -> np.ndarray:
        """The nominal values and the directions (p, 1 + K)."""
        return np.column_stack([self.nominal, self.directions])

    @cached_property
    def bodies(self) -> ConsistentBodies:
        """The constraint that keeps bodies physically consistent."""
        robot = self.model.robot
        return ConsistentBodies(robot.links, robot.parameters.names, self.nominal, self.prior, self.directions)

    def at(self, unknowns: np.ndarray) -> np.ndarray:
        """Return the parameters (p,) at unknowns (K,); directions without information keep the bodies consistent."""
        theta = self.nominal + self.directions @ unknowns
        found = self.bodies.find(unknowns) if len(unknowns) else None
        return theta if found is None else theta + self.bodies.within @ found.w

    def build_mechanism(self, unknowns: np.ndarray | None = None) -> Mechanism:
        """Return the robot's dynamics at unknowns (K,), or at the nominal values, without drive inertias."""
        robot, values = self.model.robot, self.nominal if unknowns is None else self.at(unknowns)
        return build_mechanism(robot.with_parameters(robot.parameters.with_values(values)))


@dataclass(frozen=True, eq=False)
class LoadWaves:
    """Loads of a robot along one motion, per column of a basis (p, m) of its inertial parameters: see `Waves`.

    Attributes:
        load: Torque besides the own inertia (N, na, m) [N m per unit].
        inertia: Own inertia (N, na, m) [kg m^2 per unit].
        stiffness: Growth of the load with the own position (N, na) at the nominal values [N m/rad].
        along: The motion's positions (N, na) [rad].
        speed: The motion's speeds (N, na) [rad/s], if it is simulated.
    """

    load: np.ndarray
    inertia: np.ndarray
    stiffness: np.ndarray
    along: np.ndarray
    speed: np.ndarray | None = None

    def cut(self, part: slice) -> LoadWaves:
        """Return a part of the waves."""
        speed = None if self.speed is None else self.speed[part]
        return LoadWaves(self.load[part], self.inertia[part], self.stiffness[part], self.along[part], speed)


def compute_load_waves(space: InertialSpace, q: np.ndarray, v: np.ndarray, a: np.ndarray, dt: float) -> LoadWaves:
    """Return loads along a motion (N, na): a column of the nominal values, and one for each unknown."""
    mechanism, basis, (n, na) = space.model.mechanism, space.basis, q.shape
    some = np.unique(np.append(np.arange(0, n, count_slow(dt)), n - 1))
    qs, zero = q[some], np.zeros((len(some), na))
    still = mechanism.regressor(qs, zero, zero)
    columns = [(mechanism.regressor(qs, zero, zero + unit) - still)[:, j] @ basis for j, unit in enumerate(np.eye(na))]
    full, stiffness = (
        _fill_between(some, x, n)
        for x in (np.stack(columns, axis=1), np.einsum("njj->nj", space.build_mechanism().weight_gradient(qs)))
    )
    load = np.empty_like(full)
    for k in range(0, n, ROWS):
        part = slice(k, k + ROWS)
        load[part] = mechanism.regressor(q[part], v[part], a[part]) @ basis - full[part] * a[part, :, None]
    return LoadWaves(load, full, stiffness, q)


def _fill_between(some: np.ndarray, x: np.ndarray, n: int) -> np.ndarray:
    return interp1d(some, x, axis=0, assume_sorted=True)(np.arange(n)) if len(some) > 1 else x[[0] * n]


def fill_coupled_matrices(mechanism: Mechanism, rows: LoadRows, log: int, part: slice, every: int) -> None:
    """Compute a log's mass matrix and slopes of gravity along its motion from one sample to another, inclusive."""
    q = rows.motion[0, part, :, log]
    n, na = len(q) - 1, q.shape[1]
    some = np.minimum(np.arange(0, n + every, every), n)
    mass, slope = mechanism.inertia(q[some]), mechanism.weight_gradient(q[some])
    share = (np.arange(every) / every)[:, None]

    def fill(x: np.ndarray) -> np.ndarray:
        own = np.einsum("njj->nj", x)
        return (own[:-1, None] + share * np.diff(own, axis=0)[:, None]).reshape(-1, na)[:n]

    steps, first = slice(part.start, part.start + n), part.start // every
    rows.inertia[steps, :, log], rows.stiffness[steps, :, log] = fill(mass), fill(slope)
    rows.mass[log, first : first + len(some)], rows.slope[log, first : first + len(some)] = mass, slope


def fill_coupled_loads(mechanism: Mechanism, rows: LoadRows, log: int, part: slice, every: int, dt: float) -> None:
    """Compute a log's loads along its motion from one sample to another, inclusive; accelerations are differences of speed.

    They hold from each sample to the next, and are evaluated at the middle. The force minus that of the interpolated mass
    matrix changes as smoothly as speeds do, so that it is computed every `LOAD_S`.
    """
    q, v = rows.motion[:, part, :, log]
    n = len(q) - 1
    stride = max(1, round(LOAD_S / dt))
    at = np.unique(np.append(np.arange(0, n, stride), n - 1))
    a = (v[at + 1] - v[at]) / dt
    tau = mechanism.inverse_dynamics(0.5 * (q[at + 1] + q[at]), (q[at + 1] - q[at]) / dt, a)
    row, share = part.start // every + at // every, ((at % every) / every)[:, None, None]
    M = (1 - share) * rows.mass[log, row] + share * rows.mass[log, row + 1]
    rows.along[part, :, log] = q
    rows.load[part.start : part.start + n, :, log] = _fill_between(at, tau - np.einsum("nij,nj->ni", M, a), n)


def count_slow(dt: float) -> int:
    """Return the samples over which inertias and stiffness may be interpolated."""
    return max(1, round(SLOW_S / dt))


def build_waves(records: Sequence[LoopRecord], loads: Sequence[LoadWaves], law: ServoLaw) -> Waves:
    """Return the waves of logs, padded to the longest.

    Args:
        records: The logs.
        loads: Loads along each log's motion.
        law: The law, for the entries that differ between logs.
    """
    n = max(len(r.t) for r in records)

    def stack(arrays: Sequence[np.ndarray]) -> np.ndarray:
        """Return arrays (N, ...) as (N, ..., S), in the memory order of compiled loops."""
        rows = np.stack([_pad(x, n) for x in arrays], axis=-1)
        order = {2: (1, 0), 3: (1, 2, 0), 4: (1, 3, 0, 2)}[rows.ndim]
        return np.ascontiguousarray(rows.transpose(order)).transpose(np.argsort(order))

    keys = sorted({key for entries in law.by_log.values() for key in entries})
    steps = [r.steps for r in records if r.steps is not None]
    if steps and len(steps) < len(records):  # even and uneven stamps together
        steps = [_find_steps(r) if r.steps is None else r.steps for r in records]
    return Waves(
        dt=np.array([r.dt for r in records]),
        start=np.stack([r.q[0] if r.start is None else r.start for r in records], axis=1),
        speed=np.stack([np.zeros(r.q.shape[1]) if r.speed is None else r.speed for r in records], axis=1),
        command=stack([r.command for r in records]),
        along=stack([w.along for w in loads]),
        load=stack([w.load[..., 0] for w in loads]),
        load_by=stack([w.load[..., 1:] for w in loads]),
        inertia=stack([w.inertia[..., 0] for w in loads]),
        inertia_by=stack([w.inertia[..., 1:] for w in loads]),
        stiffness=stack([w.stiffness for w in loads]),
        supply=stack([r.supply for r in records]),
        enabled=stack([r.enabled for r in records]),
        by_log={key: np.stack([r.entries[key] for r in records], axis=1) for key in keys},
        encoder_on_motor=law.encoder == "motor",
        measured_on_motor=law.measured == "motor",
        told=law.command,
        given_steps=stack(steps) if steps else None,
    )


def _find_steps(record: LoopRecord) -> np.ndarray:
    """Return the mask (N, na) of a record's commands that are steps."""
    return find_command_steps(record.command[:, :, None], record.t[:, None, None])[:, :, 0]


def refine_record(record: LoopRecord, every: int) -> LoopRecord:
    """Return a record with samples between the measured ones, its positions interpolated.

    A command that changes within a step acts by its mean there, which a saturated law does not do: shorter steps do it less.
    """
    n = (len(record.t) - 1) * every + 1
    t, q = (refine(x, every) for x in (record.t, record.q))
    before = np.arange(n) // every
    command = record.command[before]
    steps = None if record.steps is None else record.steps[before] & (np.arange(n) % every == 0)[:, None]
    if record.sent is not None:
        command, steps = hold_commands(*record.sent, t, record.dt / every)
    return replace(
        record, t=t, q=q, command=command, supply=record.supply[before], enabled=record.enabled[before],
        used=record.used[before], every=record.every * every, steps=steps, apart=None, at_stamps=None, sent=None,
    )  # fmt: skip


def refine(x: np.ndarray, every: int) -> np.ndarray:
    """Return rows (N, na) with `every` steps from each to the next."""
    n = len(x)
    return interp1d(np.arange(n), x, axis=0, assume_sorted=True)(np.arange((n - 1) * every + 1) / every)


def split_pieces(records: Sequence[LoopRecord], loads: Sequence[LoadWaves]) -> tuple[list[LoopRecord], list[LoadWaves]]:
    """Return the logs in pieces that are simulated in parallel (multiple shooting).

    A piece starts from the state of the motion along which its loads were evaluated. Its first part is not used: after it the
    loop has forgotten its initial state. A few long logs become many short ones, which take as long as one of them.
    """
    total = sum(len(r.t) * r.dt for r in records)
    length = max(MIN_PIECE_S, total / PIECES)
    pieces, waves = [], []
    for r, w in zip(records, loads, strict=True):
        n, warm = len(r.t), round(WARM_UP_S / r.dt)
        count = max(1, round(n * r.dt / length))
        bounds = np.round(np.linspace(0, n, count + 1)).astype(int)
        for begin, stop in zip(bounds[:-1], bounds[1:], strict=True):
            first = max(0, begin - warm)
            part = slice(first, stop)
            piece = r.cut(part)
            used = np.array(piece.used)
            used[: begin - first] = False
            start, speed = r.start, r.speed
            if first:
                start, speed = (None, r.motion[1][first]) if w.speed is None else (w.along[first], w.speed[first])
            pieces.append(replace(piece, used=used, start=start, speed=speed))
            waves.append(w.cut(part))
    return pieces, waves


def _pad(x: np.ndarray, n: int) -> np.ndarray:
    return np.concatenate([x, np.repeat(x[-1:], n - len(x), axis=0)]) if len(x) < n else x


def mask_unused(record: LoopRecord, unused: np.ndarray) -> LoopRecord:
    """Return the record with further samples (N,) left out."""
    return replace(record, used=record.used & ~unused)
