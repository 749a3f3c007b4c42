"""Inputs of a servo loop's simulation: logs and a robot sample by sample, and the values to try."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

MAX_STEP_S = 0.0105
"""Longest step of the loop [s]: a seventh of the time constant of a hobby servo; it changes positions by about 0.4 mrad."""

SPRING_STEP_S = 2e-3
"""Longest step if a joint may have a spring [s]: resonances up to 80 Hz are exact. A diagnosis reports only causes that half of
it confirms."""

MAX_STREAM_S = 0.1
"""Longest time between two commands of a stream [s]: policies and leader arms send 15 to 200 a second."""

MAX_STREAM_SPEED = 5.0
"""Largest speed of a streamed goal [rad/s], about the speed of a hobby servo without load: a faster change is a step."""

PROFILE_STEP_S = 2e-3
"""Longest step of a goal profile [s]: halving it changes positions by 0.01 mrad. The loop itself takes longer steps."""


class LoadRows(NamedTuple):
    """Inputs of a step of coupled joints, and the resulting motion, along which loads are evaluated again.

    Attributes:
        along: Motion along which loads were evaluated (N, na, S).
        load: Torque besides that of all joints' accelerations (N, na, S), from each sample to the next.
        inertia: Own inertia without armature (N, na, S).
        stiffness: Growth of the load with the own position (N, na, S).
        mass: Mass matrix without armatures (S, R, na, na), a row for every few samples.
        slope: Growth of each joint's load with each position (S, R, na, na).
        motion: Positions and speeds of the links (2, N, na, S).
    """

    along: np.ndarray
    load: np.ndarray
    inertia: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    slope: np.ndarray
    motion: np.ndarray


class JointCoupling(NamedTuple):
    """Settings for steps of all joints at once: window by window, with loads along the final motion of the window.

    Attributes:
        every: Samples between the rows of matrices.
        window: Samples of a window, a multiple of it.
        settle: Evaluates loads of one log from one sample to another; the first time along a guess. Returns nonzero if they
            converged.
    """

    every: int
    window: int
    settle: Callable[[LoadRows, int, int, int, int], int]


@dataclass(frozen=True, eq=False)
class Waves:
    """Data of logs and a robot for a loop, sample by sample; S logs are padded to the longest, of N samples.

    Attributes:
        dt: Time between samples of each log (S,) [s].
        start: Positions at the first sample (na, S).
        speed: Speeds at the first sample (na, S).
        command: Commands (N, na, S) [rad, or the law's unit], each holding until the next.
        along: Motion along which loads were evaluated (N, na, S) [rad].
        load: Torque besides the own inertia (N, na, S) [N m].
        load_by: The same per unit of each inertial unknown (N, na, K, S).
        inertia: Own inertia without armature (N, na, S) [kg m^2].
        inertia_by: The same per unit of each inertial unknown (N, na, K, S).
        stiffness: Growth of the load with the own position (N, na, S) [N m/rad].
        supply: Supply over the nominal one (N, S).
        enabled: 1 while the motor is on (N, S).
        by_log: Law entries that differ between logs (na, S).
        encoder_on_motor: Whether the law uses the motor's position.
        measured_on_motor: Whether the positions returned, and those of the start, are the motor's.
        step: Longest step of the loop [s].
        held: Whether a load is constant from its sample to the next, rather than interpolated.
        coupling: Steps all joints at once; None if each joint is stepped separately.
        told: Kind of the commands, one of `simulate.COMMANDS`.
        given_steps: Mask (N, na, S) of commands that are steps; None to find them.
        apart: Stamps minus the clock's times, in its steps (N, S), at which positions are returned; None if all are even.
        shown: Samples (M, S) whose positions are returned; None for all.
    """

    dt: np.ndarray
    start: np.ndarray
    speed: np.ndarray
    command: np.ndarray
    along: np.ndarray
    load: np.ndarray
    load_by: np.ndarray
    inertia: np.ndarray
    inertia_by: np.ndarray
    stiffness: np.ndarray
    supply: np.ndarray
    enabled: np.ndarray
    by_log: Mapping[str, np.ndarray]
    encoder_on_motor: bool = False
    measured_on_motor: bool = False
    step: float = MAX_STEP_S
    held: bool = False
    coupling: JointCoupling | None = None
    told: str = "position"
    given_steps: np.ndarray | None = None
    apart: np.ndarray | None = None
    shown: np.ndarray | None = None

    @property
    def profile_steps(self) -> int:
        """Steps of the goal profile between two samples, at most as long as `PROFILE_STEP_S`."""
        return max(1, int(np.ceil(self.dt.max() / PROFILE_STEP_S - 1e-9)))

    @cached_property
    def steps(self) -> np.ndarray:
        """Mask (N, na, S) of commands that are steps, not parts of a stream: see `find_command_steps`."""
        if self.given_steps is not None:
            return self.given_steps
        return find_command_steps(self.command, np.arange(len(self.command))[:, None, None] * self.dt)


@dataclass(frozen=True, eq=False)
class Trials:
    """Parameter values to simulate in parallel.

    Attributes:
        values: Law entries and `coulomb`, `viscous`, `armature`, `offset`, by name (na, C).
        inertial: Inertial unknowns (K, C).
    """

    values: Mapping[str, np.ndarray]
    inertial: np.ndarray


def find_command_steps(command: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the mask (N, na, S) of steps of commands: changes after a rest, or faster than a stream.

    Args:
        command: Commands (N, na, S) [rad], each holding until the next.
        t: Their times (N, 1, S) [s].
    """
    change = np.abs(np.diff(command, axis=0, prepend=command[:1]))
    sample = np.arange(len(command))[:, None, None]
    latest = np.maximum.accumulate(np.where(change > 0, sample, -len(command)), axis=0)  # sample of the last change
    before = np.concatenate([np.full_like(latest[:1], -len(command)), latest[:-1]])
    since = t - np.take_along_axis(np.broadcast_to(t, command.shape), np.maximum(before, 0), axis=0)
    return (change > 0) & ((before < 0) | (since > MAX_STREAM_S * (1 + 1e-9)) | (change > MAX_STREAM_SPEED * since))
