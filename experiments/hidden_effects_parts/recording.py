"""What truly happens along a prescribed motion, and what sensors make of it.

The true motion is a smooth trajectory; forces are what it takes. So a set needs no simulation in time and its forces are exact
at every sample. Sensors are written here once more: white encoder noise or rounding, force noise white or `x_k = c x_{k-1} + e`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.signal import lfilter

from hidden_effects_parts.robots import Rig
from tau_dyn.log import Log
from tau_dyn.simulate import Trajectory, build_fourier_motion, build_named_motion, concatenate

RATE_HZ = 1000.0
LOG_RATES_HZ = (250.0, 500.0, 1000.0)
KINDS = ("fourier", "prbs", "mixed", "mixed", "strokes")
"""Motions that are tried; `mixed` joins a Fourier, a random binary and a slow part."""


@dataclass(frozen=True)
class Sensing:
    """Sensors of one set; noise in units of the axis.

    Attributes:
        encoder: Standard deviation of white position noise [m or rad].
        resolution: Step positions are rounded to [m or rad]; 0 for none.
        force: Standard deviation of force noise [N or N m].
        colour: Coefficient c of the force noise at the log's rate.
        rate_hz: Rate of the log [Hz].
    """

    encoder: float
    resolution: float
    force: float
    colour: float
    rate_hz: float

    @property
    def position_sd(self) -> float:
        """Standard deviation of all position errors, taken as white [m or rad]."""
        return float(np.hypot(self.encoder, self.resolution / np.sqrt(12)))

    def positions(self, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return what encoders show of positions (N, na)."""
        read = q + self.encoder * rng.standard_normal(q.shape)
        return np.round(read / self.resolution) * self.resolution if self.resolution else read

    def force_noise(self, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
        """Return force noise (N, na) [N or N m]."""
        e = rng.standard_normal(shape) * np.sqrt(1 - self.colour**2)
        e[0] /= np.sqrt(1 - self.colour**2)  # stationary from the first sample on
        return self.force * np.asarray(lfilter([1.0], [1.0, -self.colour], e, axis=0))


@dataclass(frozen=True, eq=False)
class Recording:
    """One run before noise, at the log's rate.

    Attributes:
        rig: The robot.
        motion: Its true motion at 1 kHz.
        step: Samples of the motion between two of the log.
        q: Positions that encoders without noise show (N, na); v and a are their derivatives.
        v: Velocities (N, na).
        a: Accelerations (N, na).
        tau: Forces that sensors without noise show (N, na) [N or N m].
        number: Which run of the set it is, from zero.
        extra: Further columns of the log, such as temperatures (N,).
        drive: Signal that the forces are made of, `voltage` or `pwm`; empty for none.
    """

    rig: Rig
    motion: Trajectory
    step: int
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    tau: np.ndarray
    number: int = 0
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)
    drive: str = ""

    @classmethod
    def of(cls, rig: Rig, motion: Trajectory, rate_hz: float, number: int = 0) -> Recording:
        """Return the run of a robot in which nothing hides along a motion at 1 kHz."""
        step = round(RATE_HZ / rate_hz)
        few = motion.every(step)
        return cls(rig, motion, step, few.q, few.v, few.a, rig.force(few.q, few.v, few.a), number)

    @property
    def t(self) -> np.ndarray:
        """Time (N,) [s]."""
        return self.motion.t[:: self.step]

    def plus(self, force: np.ndarray) -> Recording:
        """Return the run with a further force (N, na)."""
        return replace(self, tau=self.tau + force)

    def column(self, joint: int, force: np.ndarray) -> np.ndarray:
        """Return a force (N,) of one joint as (N, na)."""
        out = np.zeros_like(self.tau)
        out[:, joint] = force
        return out

    def log(self, sensing: Sensing, rng: np.random.Generator, name: str) -> Log:
        """Return what sensors make of it."""
        signals = {
            "q": sensing.positions(self.q, rng),
            "tau": self.tau + sensing.force_noise(self.tau.shape, rng),
        }
        signals |= {self.drive: signals["tau"]} if self.drive else {}
        channels = {f"{key}_{j}": x[:, k] for key, x in signals.items() for k, j in enumerate(self.rig.joints)}
        return Log(self.t, channels | dict(self.extra), name)


def draw_sensing(rig: Rig, rng: np.random.Generator, *, coarse: bool | None = None) -> Sensing:
    """Return sensors: encoders of 5 or 20 um (20 or 80 urad), 5 N (2 N, 0.4 N m) of force noise, white or coloured."""
    coarse = bool(rng.random() < 0.4) if coarse is None else coarse
    size = (2e-5 if rig.turns else 5e-6) * (4 if coarse else 1)
    rounded = rng.random() < 0.3
    force = {"l1": 5.0, "axis": 2.0, "arm": 0.4, "elbow": 0.4, "geared": 0.6}.get(rig.name, 0.4)
    colour = float(rng.choice((0.0, 0.0, 0.5, 0.9)))
    noise, step = (size / 3, size * np.sqrt(12) * np.sqrt(8) / 3) if rounded else (size, 0.0)  # the same in all
    return Sensing(float(noise), float(step), force, colour, float(rng.choice(LOG_RATES_HZ)))


def draw_motion(rig: Rig, duration: float, rng: np.random.Generator, kind: str | None = None) -> Trajectory:
    """Return a motion of about this length [s] at 1 kHz within the robot's limits."""
    kind = kind or str(rng.choice(KINDS))
    seeds = [int(x) for x in rng.integers(2**31, size=3)]
    if kind == "fourier":
        return _fourier(rig, duration, seeds[0], rng)
    if kind != "mixed":
        return build_named_motion(kind, rig.driven, duration, seeds[0])
    parts = (
        _fourier(rig, 0.45 * duration, seeds[0], rng),
        build_named_motion("prbs", rig.driven, 0.3 * duration, seeds[1]),
        build_named_motion(str(rng.choice(("slow", "strokes"))), rig.driven, max(6.5, 0.2 * duration), seeds[2]),
    )
    return concatenate([parts[k] for k in rng.permutation(3)], name="mixed")


def _fourier(rig: Rig, duration: float, seed: int, rng: np.random.Generator) -> Trajectory:
    harmonics, fast = int(rng.integers(4, 8)), float(rng.uniform(0.9, 1.6))
    return build_fourier_motion(rig.driven, duration, seed, harmonics=harmonics, fast_hz=fast)
