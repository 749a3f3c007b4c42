"""What every effect answers: its force per unit parameter along a motion, and what a person should know about it.

An effect is written once and used three times. Identification asks for its columns at `sign(v)`, feedforward at a
smoothed sign, and the simulator at +1 and -1, choosing between the two by whether the plant moves, sticks or reverses.
An effect's force is what the *actuator* must add: `tau = rigid body + sum of effects`. Amplitudes are parameters, in which
it is linear; what it is not linear in (a Stribeck speed, a ripple's period) are its `settings`, fixed in one instance.

Diagnosis tries effects that name a `cause` of the contract: on which joints (`groups`) and with which settings (`grid`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations
from math import isfinite
from typing import Any, ClassVar, Self

import numpy as np

from tau_dyn.effects.words import amount, quantity
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters


@dataclass(frozen=True, eq=False)
class Motion:
    """Actuated motion as effects see it.

    Attributes:
        joints: Names of the actuated joints, in order.
        q: Positions (N, na) [m or rad].
        v: Velocities (N, na).
        a: Accelerations (N, na).
        sign: Direction of motion (N, na), in [-1, 1]; `sign(v)` unless the caller says otherwise.
        t: Time (N,) [s] of samples in order, evenly spaced; None for samples in no order, as in a single simulator step.
        signals: What else some effects feel, by name: `load` (N, na) [N, N m] across each joint's axis, `passive`
            (N, n, 3, na) angular velocity of each passive joint per actuated speed, `inertia` (N, na, na) mass matrix,
            `damping` (N, na) growth of friction with speed, `weight_gradient` (N, na, na) change of the weights with the
            positions, `rigid_force` (N, na) force of the rigid bodies, `force` (N, na) force of the model without the effect,
            `temperature` (N, na) [degC], `reversal` (N, na) distance since each joint's last reversal [m or rad], `campaign`
            (N,) number of the log.
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
        return cls(joints, q, v, a, np.sign(v) if sign is None else sign, t, dict(signals or {}))

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or say that it is missing."""
        if name not in self.signals:
            raise InputError(f"this effect feels {name}, which the motion does not give")
        return self.signals[name]


@dataclass(frozen=True, eq=False)
class Scene:
    """What a motion offers, for choosing which settings of an effect are worth trying.

    Attributes:
        joints: Actuated joints.
        units: Their force units, 'N' or 'N m'.
        low: Smallest position (na,) [m or rad].
        high: Largest position (na,).
        slow: Slowest speed with a sure sign (na,) [m/s or rad/s].
        fast: A speed that the joint exceeds in 2 % of the samples (na,).
        cutoff_hz: Frequency above which nothing is seen [Hz].
        duration: Length of all runs together [s].
        signals: Signals that the motions give.
        campaigns: Number of logs, which `campaign` counts from zero.
        resonances: Frequency [Hz] and damping ratio of modes that a black-box fit proposes, strongest first.
        structure: Whether these modes are the structure's as a whole, and no single joint's.
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

    def index(self, joint: str) -> int:
        """Return a joint's place."""
        return self.joints.index(joint)


class Effect(ABC):
    """A force that the rigid model leaves out, linear in its parameters.

    Attributes:
        name: How model files call it; for an effect with a cause, the cause's name.
        equation: The law in one line, for people.
        joints: The actuated joints it acts on.
        units: The joints' force units, 'N' or 'N m', by joint.
        settings: What it is not linear in; name -> value in SI units.
        label: What its parameters' names end in, so that two instances on one joint differ; mostly empty.
        cause: Whether diagnosis may name it (its name is then one of the contract's causes).
        reference: Where the equation comes from.
        reveals: The motion or recording that shows it, for people.
        mistaken_for: Causes that it is easily confused with.
        equivalent: Causes that no data of this kind can tell from it.
        needs: Signals of the motion that it feels.
        nonnegative: Whether only amplitudes from zero up make sense (a Stribeck term of the other sign is not one).
        plausible: The range that its amplitudes lie in on real machines, in words.
        refined: Settings that diagnosis adjusts beyond its grid.
        defaults: Name -> value of each setting.
        setting_units: Name -> unit of each setting; V stands for the speed unit, Q for that of the position.
        positive: Settings that must be above zero.
        whole: Settings that count something, from one up.
        grows: A setting that counts terms, of which more are tried where one was found; empty for none.
        dense: Whether its grid is so fine that it is first tried on decimated motion; it then has `local_frequency`.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    cause: ClassVar[bool] = False
    reference: ClassVar[str] = ""
    reveals: ClassVar[str] = ""
    mistaken_for: ClassVar[tuple[str, ...]] = ()
    equivalent: ClassVar[tuple[str, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    refined: tuple[str, ...] = ()
    nonnegative: ClassVar[bool] = False
    plausible: ClassVar[str] = ""
    defaults: ClassVar[Mapping[str, float]] = {}
    setting_units: ClassVar[Mapping[str, str]] = {}
    positive: ClassVar[tuple[str, ...]] = ()
    whole: ClassVar[tuple[str, ...]] = ()
    grows: ClassVar[str] = ""
    dense: ClassVar[bool] = False

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Let the effect act on these joints, whose forces are in these units ('N' or 'N m').

        Raises:
            InputError: A setting is unknown, not a finite number, or one that the effect cannot have.
        """
        self.joints, self.label = tuple(joints), label
        self.units = dict(zip(self.joints, units, strict=True))
        for key, value in settings.items():
            if key not in self.defaults:
                known = ", ".join(self.defaults) or "none"
                raise InputError(f"effect {self.name} has no setting '{key}'; it has {known}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
                raise InputError(f"setting {key} of effect {self.name} must be a finite number, not {value!r}")
            if key in self.whole and (value < 1 or value != int(value)):
                raise InputError(f"setting {key} of effect {self.name} must be a whole number from 1 up, not {value!r}")
            if key in self.positive and value <= 0:
                raise InputError(f"setting {key} of effect {self.name} must be above zero, not {value!r}")
        self.settings: dict[str, float] = {**self.defaults, **{k: float(x) for k, x in settings.items()}}

    def with_settings(self, **settings: float) -> Self:
        """Return the same effect with other settings."""
        units = [self.units[j] for j in self.joints]
        return type(self)(self.joints, units, label=self.label, **{**self.settings, **settings})

    @classmethod
    def groups(cls, scene: Scene) -> list[tuple[str, ...]]:
        """Return the groups of joints that one instance may act on; by default each joint alone."""
        return [(joint,) for joint in scene.joints]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the settings worth trying on these joints; none where the motion cannot show the effect."""
        return [{}]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return why this motion cannot show the effect and the experiment that would, or None where it can."""
        missing = [name for name in cls.needs if name not in scene.signals]
        return (f"the logs give no {missing[0]}", cls.reveals) if missing else None

    def lookalikes(self) -> list[Effect]:
        """Return laws without a name, with as many terms, that must explain less for this one to be named."""
        return []

    @property
    def measured(self) -> bool:
        """Whether it distorts what is recorded (a delay, an encoder's error) and leaves the robot's motion alone."""
        return False

    @property
    @abstractmethod
    def parameters(self) -> Parameters:
        """Its parameters at their nominal values (zero: the effect is absent)."""

    @abstractmethod
    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p) along a motion."""

    def force(self, motion: Motion, parameters: Parameters) -> np.ndarray:
        """Return its force (N, na) [N or N m] at these parameter values."""
        return self.columns(motion) @ parameters.select(self.parameters.names).values

    def describe(self, parameters: Parameters) -> str:
        """Return the effect at these values in words, with units and standard errors where they are known."""
        found = ", ".join(f"{p.name} = {amount(p)}" for p in parameters.select(self.parameters.names))
        return f"{self.name.replace('_', ' ')}: {found}"

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return speeds (N,) beyond the joints' own whose sign it uses, each with the joints' indices it acts on."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """Return what a model file keeps: name, joints and settings; values stand with the parameters."""
        more = {"settings": dict(self.settings), "label": self.label}
        return {"effect": self.name, "joints": list(self.joints), **{k: x for k, x in more.items() if x}}

    def _indices(self, motion: Motion) -> list[int]:
        missing = [j for j in self.joints if j not in motion.joints]
        if missing:
            raise InputError(f"effect {self.name} acts on joint '{missing[0]}'; there are {', '.join(motion.joints)}")
        return [motion.joints.index(j) for j in self.joints]


class JointwiseEffect(Effect):
    """An effect that acts on each of its joints by that joint's own motion.

    A subclass says its quantities and their force per unit parameter; this class lays the columns out joint by joint.
    """

    # (name, unit with F for the force unit, V for the speed unit and Q for the position's)
    quantities: ClassVar[tuple[tuple[str, str], ...]]

    @property
    def terms(self) -> tuple[tuple[str, str], ...]:
        """Its quantities and their units; a subclass whose settings say how many there are answers for itself."""
        return self.quantities

    @property
    def parameters(self) -> Parameters:
        """Its parameters, joint by joint, at zero."""
        rows = []
        for joint in self.joints:
            for term, unit in self.terms:
                text = spelled(unit, self.units[joint])
                name = f"{joint}.{term}{self.label}"
                rows.append(Parameter(name, 0.0, text, self.lower(term), origin=self.name))
        return Parameters(rows)

    def lower(self, quantity: str) -> float:
        """Return the smallest admissible value; zero where only amplitudes from zero up make sense."""
        return 0.0 if self.nonnegative else -np.inf

    @abstractmethod
    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the force per unit of each quantity (N,), for one joint's motion."""

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        n = len(self.terms)
        out = np.zeros_like(motion.v, shape=(*motion.v.shape, n * len(self.joints)))
        for k, index in enumerate(self._indices(motion)):
            for m, column in enumerate(self.per_joint(JointMotion.of(motion, index))):
                out[:, index, n * k + m] = column
        return out

    def describe(self, parameters: Parameters) -> str:
        """Return the effect at these values in words, joint by joint where there are several."""
        said = []
        for joint in self.joints:
            values = {name: parameters[f"{joint}.{name}{self.label}"] for name, _ in self.terms}
            said.append(self.words(joint, values) + (f" at {joint}" if len(self.joints) > 1 else ""))
        return "; ".join(said)

    def words(self, joint: str, values: Mapping[str, Parameter]) -> str:
        """Return what `describe` says of one joint, whose parameters are given by quantity."""
        return " and ".join(f"{name.replace('_', ' ')} of {amount(p)}" for name, p in values.items())

    def setting(self, key: str, joint: str) -> str:
        """Return a setting in words, such as `20.9 mm`."""
        return quantity(self.settings[key], spelled(self.setting_units.get(key, ""), self.units[joint]))


@dataclass(frozen=True, eq=False)
class JointMotion:
    """One joint's part of a motion, each (N,)."""

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    t: np.ndarray | None = None
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, motion: Motion, index: int) -> JointMotion:
        """Look at the joint of this index; signals (N,) that belong to no joint stay as they are."""
        signals = {key: x[:, index] if x.ndim == 2 else x for key, x in motion.signals.items() if x.ndim < 3}
        q, v, a, sign = (x[:, index] for x in (motion.q, motion.v, motion.a, motion.sign))
        return cls(q, v, a, sign, motion.t, signals)

    def signal(self, name: str) -> np.ndarray:
        """Return a signal, or say that it is missing."""
        if name not in self.signals:
            raise InputError(f"this effect feels {name}, which the motion does not give")
        return self.signals[name]


def spelled(unit: str, force: str) -> str:
    """Return a unit with its letters F, V and Q written out for a joint whose force unit is given."""
    position = "m" if force == "N" else "rad"
    if " " in force:
        unit = unit.replace("/F", "/(F)")
    letters = {"F": force, "V": f"{position}/s", "Q": position}
    return "".join(letters.get(c, c) for c in unit)


def pairs(scene: Scene) -> list[tuple[str, ...]]:
    """Return every pair of joints with the same force unit."""
    same = {joint: unit for joint, unit in zip(scene.joints, scene.units, strict=True)}
    return [(i, j) for i, j in combinations(scene.joints, 2) if same[i] == same[j]]
