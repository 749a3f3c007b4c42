"""Logs of commands and positions -> even records, and with loads -> waves for the loop.

A command holds from its stamp to the next one. Uneven stamps have a clock finer than the samples. Residuals are taken at the
stamps themselves, where simulated positions are interpolated over three steps of that clock; measured positions, interpolated
over the much longer steps between stamps, only give the motion along which loads are evaluated first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import Akima1DInterpolator, interp1d

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, differentiate, estimate_encoder_noise, lowpass
from tau_dyn.model import Model
from tau_dyn.servo.loads import LoadWaves
from tau_dyn.servo.waves import Waves, find_command_steps
from tau_dyn.simulate import COMMANDS, ServoLaw

MOTION_HZ = 12.0
"""Low-pass of measured positions before they are differentiated [Hz]: twice the bandwidth of a servo's position loop."""
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
        apart=_stack_apart(records, n),
    )


def _stack_apart(records: Sequence[LoopRecord], n: int) -> np.ndarray | None:
    """Return the distances of stamps from the clock (N, S); None if all stamps are even."""
    if all(r.apart is None for r in records):
        return None
    rows = [np.zeros(len(r.t)) if r.apart is None else r.apart for r in records]
    return np.stack([np.pad(x, (0, n - len(x))) for x in rows], axis=-1)


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


def split_pieces(
    records: Sequence[LoopRecord], loads: Sequence[LoadWaves], most: float = PIECES
) -> tuple[list[LoopRecord], list[LoadWaves]]:
    """Return the logs in pieces that are simulated in parallel (multiple shooting).

    A piece starts from the state of the motion along which its loads were evaluated. Its first part is not used: after it the
    loop has forgotten its initial state. A few long logs become many short ones, which take as long as one of them.

    Args:
        records: The logs.
        loads: Their loads.
        most: Approximate number of pieces, if none is shorter than `MIN_PIECE_S`.
    """
    total = sum(len(r.t) * r.dt for r in records)
    length = max(MIN_PIECE_S, total / most)
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
