"""Actuated motion in the form that effects use, of all joints or of one; and properties of motions for the search for causes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from tau_dyn.exceptions import InputError

JointScales = Mapping[str, Mapping[str, float]]
"""Joint -> reference of plausible amplitudes -> its value in SI units; a missing reference is unknown and sets no bound."""


class LazySignals(Mapping[str, np.ndarray]):
    """Signals, each computed when first requested: an effect needs few of them."""

    def __init__(self, make: Mapping[str, Callable[[], np.ndarray]]) -> None:
        """Store the functions `make` that compute the signals, by the signals' names."""
        self._make = dict(make)
        self._made: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a signal."""
        if name not in self._made:
            self._made[name] = self._make[name]()
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the signal exists, without computing it."""
        return name in self._make

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._make)

    def __len__(self) -> int:
        """Return their number."""
        return len(self._make)

    @classmethod
    def changed(cls, signals: Mapping[str, np.ndarray], change: Callable[[np.ndarray], np.ndarray]) -> LazySignals:
        """Return signals, each of which is changed when first requested."""
        return cls({name: partial(lambda key: change(signals[key]), name) for name in signals})


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of all actuated joints.

    Attributes:
        joints: Names of the actuated joints, in order.
        q: Positions (N, na) [m or rad].
        v: Velocities (N, na).
        a: Accelerations (N, na).
        sign: Direction of motion (N, na), in [-1, 1]; `sign(v)` by default.
        t: Time (N,) [s] of samples in order, evenly spaced; None for unordered samples, as in a single simulator step.
        signals: Further signals that some effects need, by name: `load` (N, na) [N, N m] across each joint's axis,
            `reducer_torque` (N, na) that its drive transmits, with its sign, `passive` (N, n, 3, na) angular velocity of each
            passive joint per actuated speed, `inertia` (N, na, na) mass matrix, `damping` (N, na) growth of friction with
            speed, `weight_gradient` (N, na, na) change of the weights with the positions, `rigid_force` (N, na) force of the
            rigid bodies, `force` (N, na) force of the model without the effect, `temperature` (N, na) [degC], `reversal` (N,
            na) distance since each joint's last reversal [m or rad], `reported_force` (N, na) force that the log holds,
            `campaign` (N,) number of the log, `gravity_turn` (N, na, 2) forces at rest per turn of gravity, `shifted_force` (N,
            na, na, 4) change of the rigid body's forces by displaced positions, `delivered_force` (N, na) force of the model
            fitted together with a saturation of the drives.
    """

    joints: tuple[str, ...]
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        joints: tuple[str, ...],
        q: np.ndarray,
        v: np.ndarray,
        a: np.ndarray,
        sign: np.ndarray | None = None,
        *,
        t: np.ndarray | None = None,
        signals: Mapping[str, np.ndarray] | None = None,
    ) -> Motion:
        """Build a motion; the sign defaults to that of the velocity."""
        given = signals if isinstance(signals, LazySignals) else dict(signals or {})
        return cls(joints, q, v, a, np.sign(v) if sign is None else sign, t, given)

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or raise if it is missing."""
        return _signal(self.signals, name)

    def with_signals(self, **more: np.ndarray) -> Motion:
        """Return the motion with further or replaced signals."""
        kept = {name: partial(self.signals.__getitem__, name) for name in self.signals}
        return replace(
            self, signals=LazySignals({**kept, **{name: partial(np.asarray, x) for name, x in more.items()}})
        )


class _JointSignals(Mapping[str, np.ndarray]):
    """The part of signals that belongs to one joint."""

    def __init__(self, signals: Mapping[str, np.ndarray], index: int) -> None:
        self._signals, self._index = signals, index

    def __getitem__(self, name: str) -> np.ndarray:
        x = self._signals[name]
        if x.ndim > 2:
            raise KeyError(name)  # of several joints together
        return x[:, self._index] if x.ndim == 2 else x

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._signals if self._signals[name].ndim < 3)

    def __len__(self) -> int:
        return sum(1 for _ in self)


@dataclass(frozen=True, eq=False)
class JointMotion:
    """The part of a motion that belongs to one joint, each (N,)."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, motion: Motion, index: int) -> JointMotion:
        """Select the joint of this index; signals (N,) that belong to no joint are not changed."""
        q, v, a, sign = (x[:, index] for x in (motion.q, motion.v, motion.a, motion.sign))
        return cls(q, v, a, sign, motion.t, _JointSignals(motion.signals, index))

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or raise if it is missing."""
        return _signal(self.signals, name)


def _signal(signals: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return a signal; `name_effect_in_errors` adds the name of the effect that lacks it."""
    if name not in signals:
        raise InputError("unsupported", f"this effect feels {name}, which the motion does not give")
    return signals[name]


@dataclass(frozen=True, eq=False)
class Scene:
    """Properties of a motion, or of several together, that diagnosis uses.

    Attributes:
        joints: Actuated joints.
        units: Their force units, 'N' or 'N m'.
        low: Smallest position (na,) [m or rad].
        high: Largest position (na,).
        slow: Slowest speed with a certain sign (na,) [m/s or rad/s].
        fast: A speed that the joint exceeds in 2 % of the samples (na,).
        cutoff_hz: Frequency above which signals are cut off [Hz].
        duration: Length of all runs together [s].
        signals: Signals that the motions provide.
        campaigns: Number of logs, which `campaign` counts from zero.
        resonances: Frequency [Hz] and damping ratio of modes that a black-box fit proposes, strongest first.
        structure: Whether these modes belong to the structure as a whole, not to a single joint.
        scales: Reference forces of each joint, of which plausible amplitudes are shares.
        coupled: Pairs of joints that a shared motor may drive: neighbours in the chain, or declared by the robot file.
        timing: Joint -> delay and time constant [s] of its logged force that fit the baseline best; empty if all are short.
        step_s: Time between samples of the logs, as they were recorded [s].
        zeros: Joint -> error of its position [m or rad] that fits the baseline best.
        ratios: Joint -> gear ratio of its drive, if the robot file gives one.
        limits: Joint -> largest force and speed that the robot file permits, if it gives both.
        often: Positions below and above which the joints are rarely trained on (2, na); None if the whole range counts.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    slow: np.ndarray
    fast: np.ndarray
    cutoff_hz: float
    duration: float
    signals: frozenset[str] = frozenset()
    campaigns: int = 1
    resonances: tuple[tuple[float, float], ...] = ()
    structure: bool = False
    often: np.ndarray | None = None
    scales: JointScales = field(default_factory=dict)
    coupled: tuple[tuple[str, str], ...] = ()
    timing: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    step_s: float = 0.0
    zeros: Mapping[str, float] = field(default_factory=dict)
    ratios: Mapping[str, float] = field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def index(self, joint: str) -> int:
        """Return a joint's index."""
        return self.joints.index(joint)

    def range_of(self, joint: str) -> tuple[float, float]:
        """Return the range of positions in which a joint is trained on often."""
        k = self.index(joint)
        low, high = (self.low, self.high) if self.often is None else self.often
        return float(low[k]), float(high[k])


def list_joint_pairs(scene: Scene) -> list[tuple[str, ...]]:
    """Return the pairs of joints with the same force unit that a shared motor may drive."""
    same = {joint: unit for joint, unit in zip(scene.joints, scene.units, strict=True)}
    return [(i, j) for i, j in scene.coupled if same[i] == same[j]]
