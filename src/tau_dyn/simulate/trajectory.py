"""Reference motion of the actuated joints, which a controller follows.

Positions, speeds and accelerations share one clock. They come from a generator (`motions.py`), from a recorded log or
from a CSV file; between samples a quintic spline through the positions is the motion. Pieces are joined by minimum-jerk
moves, `q(s) = q0 + (q1 - q0) (10 s^3 - 15 s^4 + 6 s^5)` (Flash & Hogan 1985), which start and end at rest.

Generators build motions of constant speeds joined by smooth ramps. A ramp from speed `v0` to `v1` in time T follows, with
`s = t / T`,

    a = (v1 - v0) / T (1 - cos 2 pi s),   v = v0 + (v1 - v0) (s - sin(2 pi s) / 2 pi),

so that accelerations are continuous and peak at twice their mean. All integrals are exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import make_interp_spline

from tau_dyn.exceptions import InputError
from tau_dyn.files import write_whole
from tau_dyn.log import Log, lowpass, read_table

MEASURED_CUTOFF_HZ = 20.0
"""Low-pass on measured positions before they serve as a reference [Hz]; a reference should not repeat encoder noise."""

_MAX_SAMPLES = 10**8
"""Samples of a motion; more do not fit into memory, and come of times in another unit."""

_AGREEMENT = 0.01
"""Share of the largest step by which stated speeds may miss the next position; files have rounded ones."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A reference motion.

    Attributes:
        joints: Names of the actuated joints, in the order of the columns.
        t: Time (N,) [s], strictly increasing.
        q: Positions (N, na) [m or rad].
        v: Speeds (N, na) [m/s or rad/s].
        a: Accelerations (N, na) [m/s^2 or rad/s^2].
        name: Name in messages.
        notes: Sentences about how it was made, such as a scaling that limits enforced.
    """

    joints: tuple[str, ...]
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    name: str = "motion"
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        """Freeze the arrays and refuse shapes that do not belong together, gaps in numbers, or a clock that does not advance."""
        object.__setattr__(self, "joints", tuple(self.joints))
        for key in ("t", "q", "v", "a"):
            array = np.array(getattr(self, key), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, key, array)
        shape = (len(self.t), len(self.joints))
        if len(self.t) < 2 or any(x.shape != shape for x in (self.q, self.v, self.a)):
            raise InputError(
                "wrong_shape", f"{self.name}: q, v and a must have shape {shape} with at least two samples"
            )
        if not all(np.isfinite(x).all() for x in (self.t, self.q, self.v, self.a)) or np.any(np.diff(self.t) <= 0):
            raise InputError(
                "bad_sample", f"{self.name}: all numbers must be finite and t must increase from sample to sample"
            )

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return len(self.t)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    @classmethod
    def through(cls, joints: Iterable[str], t: np.ndarray, q: np.ndarray, name: str = "motion") -> Trajectory:
        """Return the quintic spline through positions (N, na) at times (N,) [s], with its speeds and accelerations."""
        if len(t) < 6:
            raise InputError("too_little_data", f"{name} has {len(t)} sample(s); a reference motion needs at least six")
        spline = make_interp_spline(t, q, k=5)
        return cls(tuple(joints), t, q, spline.derivative(1)(t), spline.derivative(2)(t), name)

    @classmethod
    def from_log(cls, log: Log, joints: Sequence[str]) -> Trajectory:
        """Return the reference that a log contains, or, without `q_ref_J`, its measured positions low-passed at 20 Hz.

        Raises:
            InputError: A joint has neither column, or the log is too short.
        """
        if log.has("q_ref", joints):
            return cls.through(joints, log.t, log.joint("q_ref", joints), log.name)
        q = log.joint("q", joints)
        cutoff = MEASURED_CUTOFF_HZ
        if log.rate_hz > 2.5 * cutoff:
            q = lowpass(q, cutoff, log.rate_hz)
        note = (
            f"{log.name} has no q_ref columns; its measured positions, low-passed at {cutoff:g} Hz, are the reference"
        )
        return replace(cls.through(joints, log.t, q, log.name), notes=(note,))

    @classmethod
    def from_csv(cls, path: str | Path, joints: Sequence[str]) -> Trajectory:
        """Read a motion file: `t` and, for each joint, `q_ref_J` (with or without `v_ref_J` and `a_ref_J`) or `q_J`.

        Raises:
            InputError: The file cannot be read or a column is missing; the message names file, line and column.
        """
        table = read_table(path)
        t = table.numbers("t")
        if all(f"{signal}_{j}" in table.cells for signal in ("q_ref", "v_ref", "a_ref") for j in joints):
            q, v, a = (
                np.column_stack([table.numbers(f"{s}_{j}") for j in joints]) for s in ("q_ref", "v_ref", "a_ref")
            )
            return cls(tuple(joints), t, q, v, a, table.name)
        signal = "q_ref" if any(f"q_ref_{j}" in table.cells for j in joints) else "q"
        channels = {f"{signal}_{j}": table.numbers(f"{signal}_{j}") for j in joints}
        return cls.from_log(Log(t, channels, table.name), joints)

    def to_csv(self, path: str | Path) -> None:
        """Write `t`, `q_ref_J`, `v_ref_J`, `a_ref_J` with 12 significant digits; a failed write leaves no partial file."""
        columns = {"t": self.t}
        for signal, values in (("q_ref", self.q), ("v_ref", self.v), ("a_ref", self.a)):
            columns |= {f"{signal}_{j}": values[:, k] for k, j in enumerate(self.joints)}
        write_whole(path, pd.DataFrame(columns).to_csv(index=False, float_format="%.12g", lineterminator="\n"))

    def resampled(self, rate_hz: float) -> Trajectory:
        """Return the motion on a clock of this rate [Hz] that starts at zero; unchanged if it has this clock already."""
        n = int(np.floor(self.duration * rate_hz * (1 + 1e-9) + 1e-6)) + 1
        if n > _MAX_SAMPLES:
            raise InputError(
                "wrong_unit",
                f"{self.name} lasts {self.duration:g} s, {n:.3g} samples at {rate_hz:g} Hz; are its times in s?",
            )
        clock = np.arange(n) / rate_hz
        if n == self.n_samples and np.max(np.abs(self.t - self.t[0] - clock)) < 1e-6 / rate_hz:
            return replace(self, t=clock)
        if n < 2 or self.n_samples < 6:
            raise InputError(
                "too_little_data", f"{self.name} lasts {self.duration:g} s, too short to be followed at {rate_hz:g} Hz"
            )
        if self._agrees():
            q, v, a = self.interpolate(self.t[0] + clock)
            return replace(self, t=clock, q=q, v=v, a=a)
        spline = make_interp_spline(self.t - self.t[0], self.q, k=5)
        return replace(self, t=clock, q=spline(clock), v=spline.derivative(1)(clock), a=spline.derivative(2)(clock))

    def interpolate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, speeds and accelerations (M, na) at times (M,) [s] within the motion.

        Between two samples it is the quintic with position, speed and acceleration of both; of `through` the spline itself.
        """
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, self.n_samples - 2)
        h = (self.t[k + 1] - self.t[k])[:, None]
        s = (t - self.t[k])[:, None] / h
        q, v, a = self.q[k], h * self.v[k], h**2 * self.a[k] / 2
        D = self.q[k + 1] - q - v - a
        E, F = h * self.v[k + 1] - v - 2 * a, h**2 * self.a[k + 1] / 2 - a
        c, d, e = 10 * D - 4 * E + F, -15 * D + 7 * E - 2 * F, 6 * D - 3 * E + F
        position = q + s * (v + s * (a + s * (c + s * (d + s * e))))
        speed = v + s * (2 * a + s * (3 * c + s * (4 * d + s * 5 * e)))
        acceleration = 2 * a + s * (6 * c + s * (12 * d + s * 20 * e))
        return position, speed / h, acceleration / h**2

    def _agrees(self) -> bool:
        """Tell whether stated speeds and accelerations lead from each position to the next, to 1 % of the largest step."""
        h = np.diff(self.t)[:, None]
        step = h * (self.v[1:] + self.v[:-1]) / 2 - h**2 * np.diff(self.a, axis=0) / 12
        off = np.abs(np.diff(self.q, axis=0) - step).max(axis=0)
        return bool(np.all(off <= _AGREEMENT * np.abs(np.diff(self.q, axis=0)).max(axis=0)))

    def every(self, step: int) -> Trajectory:
        """Return every `step`-th sample, for checks that need not see them all."""
        keep = slice(None, None, max(1, step))
        return replace(self, t=self.t[keep], q=self.q[keep], v=self.v[keep], a=self.a[keep])


def move(
    joints: Sequence[str], start: np.ndarray, end: np.ndarray, duration: float, rate_hz: float = 1000.0
) -> Trajectory:
    """Return a minimum-jerk move (na,) -> (na,) that starts and ends at rest, of about this duration [s]."""
    n = max(2, round(duration * rate_hz))
    s, rate = (np.arange(n + 1) / n)[:, None], rate_hz / n
    change = np.asarray(end, float) - np.asarray(start, float)
    q = start + change * (10 * s**3 - 15 * s**4 + 6 * s**5)
    v = change * rate * (30 * s**2 - 60 * s**3 + 30 * s**4)
    a = change * rate**2 * (60 * s - 180 * s**2 + 120 * s**3)
    return Trajectory(tuple(joints), np.arange(n + 1) / rate_hz, q, v, a, "move")


def concatenate(
    pieces: Sequence[Trajectory],
    *,
    rest: float = 0.5,
    speed: float = 0.2,
    rate_hz: float = 1000.0,
    name: str = "motion",
) -> Trajectory:
    """Join motions that start and end at rest: a rest, and a minimum-jerk move to where the next one starts.

    Args:
        pieces: Motions of the same joints, each starting and ending with speed zero.
        rest: Rest before each move [s].
        speed: Highest speed of a move [m/s or rad/s].
        rate_hz: Sampling rate of the result [Hz].
        name: Name of the result in messages.

    Raises:
        InputError: There are no pieces, their joints differ, or one does not start and end at rest.
    """
    if not pieces or any(p.joints != pieces[0].joints for p in pieces):
        raise InputError("mismatch", f"{name}: the pieces of a motion must be of the same joints, in the same order")
    joints, parts = pieces[0].joints, []
    for k, piece in enumerate(pieces):
        if max(np.max(np.abs(piece.v[0])), np.max(np.abs(piece.v[-1]))) > 1e-3:
            raise InputError("mismatch", f"{name}: '{piece.name}' must start and end at rest to be joined with others")
        if k:
            gap = float(np.max(np.abs(piece.q[0] - pieces[k - 1].q[-1])))
            stand = move(joints, pieces[k - 1].q[-1], pieces[k - 1].q[-1], rest, rate_hz)
            parts += [stand, move(joints, pieces[k - 1].q[-1], piece.q[0], max(0.1, 1.875 * gap / speed), rate_hz)]
        parts.append(piece.resampled(rate_hz))
    q, v, a = (np.concatenate([getattr(p, x)[:-1] for p in parts] + [getattr(parts[-1], x)[-1:]]) for x in "qva")
    notes = tuple(dict.fromkeys(note for p in pieces for note in p.notes))
    return Trajectory(joints, np.arange(len(q)) / rate_hz, q, v, a, name, notes)


_TURN = 2 * np.pi
TURNING = 0.5 + 2 / np.pi**2
"""Way from full speed to the turning point of a reversal, over speed and half the reversal's time."""


class MotionProfile(NamedTuple):
    """Position, speed and acceleration along one coordinate, each (N,)."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray


class Segment(NamedTuple):
    """A piece of a path: for `duration` [s] the speed changes from `start` to `end`."""

    duration: float
    start: float
    end: float

    @property
    def distance(self) -> float:
        """Distance covered."""
        return self.duration * (self.start + self.end) / 2


def build_speed_profile(t: np.ndarray, segments: Sequence[Segment]) -> MotionProfile:
    """Return the path through segments, from zero at time zero, at times (N,); the last speed continues after the end."""
    duration, start, end = (
        np.array(x, float) for x in zip(*segments, (np.inf, segments[-1].end, segments[-1].end), strict=True)
    )
    begins = np.concatenate([[0.0], np.cumsum(duration[:-1])])
    places = np.concatenate([[0.0], np.cumsum([s.distance for s in segments])])
    k = np.searchsorted(begins, t, side="right") - 1
    T, since, change = duration[k], t - begins[k], (end - start)[k]
    s = np.where(np.isfinite(T), since / T, 0.0)
    rise = s - np.sin(_TURN * s) / _TURN
    inside = s**2 / 2 + (np.cos(_TURN * s) - 1) / _TURN**2
    finite = np.where(np.isfinite(T), T, 1.0)
    q = places[k] + start[k] * since + change * finite * inside
    return MotionProfile(q, start[k] + change * rise, change / finite * (1 - np.cos(_TURN * s)))


def compute_ramp_time(change: float, acceleration: float) -> float:
    """Return how long a ramp of the speed by `change` takes if its peak acceleration is `acceleration` [s]."""
    return 2 * abs(change) / acceleration


def build_stroke_profile(speed: float, half: float, acceleration: float) -> list[Segment]:
    """Return a round trip at a speed: from the middle to `+half`, to `-half` and back, starting and ending at rest.

    Where the ramps do not leave 40 % of the way for the constant speed, the speed is lowered until they do.
    """
    speed = min(speed, float(np.sqrt(0.6 * half * acceleration / (1 + 2 * TURNING))))
    ramp = compute_ramp_time(speed, acceleration)
    first = half / speed - (0.5 + TURNING) * ramp
    long = 2 * first + ramp
    return [
        Segment(ramp, 0.0, speed),
        Segment(first, speed, speed),
        Segment(2 * ramp, speed, -speed),
        Segment(long, -speed, -speed),
        Segment(2 * ramp, -speed, speed),
        Segment(first, speed, speed),
        Segment(ramp, speed, 0.0),
    ]


def build_window(t: np.ndarray, duration: float, rise: float) -> MotionProfile:
    """Return a weight (N,) that rises from 0 to 1 within `rise` [s] and falls to 0 before `duration`, with derivatives."""
    up = build_speed_profile(np.clip(t, 0, rise), [Segment(rise, 0.0, 1.0)])
    down = build_speed_profile(np.clip(duration - t, 0, rise), [Segment(rise, 0.0, 1.0)])
    first = t < duration / 2
    # the ramp's speed is the weight; its acceleration the weight's slope, whose slope follows analytically
    slope = [_TURN / rise**2 * np.sin(_TURN * np.clip(x, 0, rise) / rise) for x in (t, duration - t)]
    return MotionProfile(
        np.where(first, up.v, down.v), np.where(first, up.a, -down.a), np.where(first, slope[0], slope[1])
    )


def apply_window(path: MotionProfile, weight: MotionProfile) -> MotionProfile:
    """Return the product of a path (N, ...) and a weight (N,), by the product rule."""
    w, dw, ddw = (x.reshape((-1,) + (1,) * (path.q.ndim - 1)) for x in weight)
    return MotionProfile(w * path.q, w * path.v + dw * path.q, w * path.a + 2 * dw * path.v + ddw * path.q)
