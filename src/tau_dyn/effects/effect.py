"""Interface of all effects: force per unit parameter along a motion, and a description for readers.

An effect is written once and used three times. Identification asks for its columns at `sign(v)`, feedforward at a smoothed
sign, and the simulator at +1 and -1, choosing between the two according to whether the plant moves, sticks or reverses. An
effect's force is the one that the *actuator* must add: `tau = rigid body + sum of effects`. Amplitudes are parameters, in which
it is linear; quantities in which it is nonlinear (a Stribeck speed, a ripple's period) are its `settings`, fixed in one
instance.

Diagnosis tries effects that name a `cause` of the contract, on groups of joints (`groups`) and a grid of settings (`grid`). It
confirms no amplitude outside of the plausible ranges, which each effect states with their source.

Amounts are formatted in readable units: `1.80 ± 0.20 N`, `20.9 mm`, `0.52 ms`, with the standard error after `±`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import Any, ClassVar, Literal, Self

import numpy as np

from tau_dyn.effects.motion import JointScales, Motion, Scene
from tau_dyn.exceptions import InputError
from tau_dyn.parameters import Parameter, Parameters

_PREFIXES = {
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm")),
    "m/s": ((1.0, "m/s"), (1e-3, "mm/s"), (1e-6, "µm/s")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "rad": ((1.0, "rad"), (1e-3, "mrad"), (1e-6, "µrad")),
    "rad/s": ((1.0, "rad/s"), (1e-3, "mrad/s")),
    "m/N": ((1.0, "m/N"), (1e-3, "mm/N"), (1e-6, "µm/N"), (1e-9, "nm/N")),
    "N/m": ((1e9, "GN/m"), (1e6, "MN/m"), (1e3, "kN/m"), (1.0, "N/m")),
    "N m/rad": ((1e9, "GN m/rad"), (1e6, "MN m/rad"), (1e3, "kN m/rad"), (1.0, "N m/rad")),
    "rad/(N m)": ((1.0, "rad/(N m)"), (1e-3, "mrad/(N m)"), (1e-6, "µrad/(N m)"), (1e-9, "nrad/(N m)")),
}

NO_EXPERIMENT = "none: the robot lacks the part"
"""Text in place of the experiment that would show an effect, if no experiment can."""


def format_amount(parameter: Parameter) -> str:
    """Return a parameter's value with its standard error, if it has one, and its unit."""
    return format_quantity(parameter.value, parameter.unit, parameter.stderr)


def format_quantity(value: float, unit: str, stderr: float | None = None) -> str:
    """Return a value [unit] with the digits that its standard error supports, or with three."""
    unit = "" if unit == "1" else unit
    scale, unit = _prefixed(max(abs(value), stderr or 0.0), unit)
    value = value / scale
    if stderr is None or not stderr > 0 or not isfinite(stderr):
        return f"{value:.3g} {unit}".strip()
    stderr = stderr / scale
    decimals = 1 - floor(log10(stderr))
    decimals = max(0, decimals - 1 if round(stderr, decimals) >= 10.0 ** (2 - decimals) else decimals)
    if decimals > 7:
        return f"{value:.3g} ± {stderr:.2g} {unit}".strip()
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f} {unit}".strip()


def format_percent(parameter: Parameter) -> str:
    """Return a parameter that is a share, with its standard error, in per cent."""
    return format_quantity(100 * parameter.value, "%", None if parameter.stderr is None else 100 * parameter.stderr)


def spell_unit(unit: str, force: str) -> str:
    """Return a unit with its letters F, V and Q written out for a joint whose force unit is given."""
    position = "m" if force == "N" else "rad"
    if " " in force:
        unit = unit.replace("/F", "/(F)")
    letters = {"F": force, "V": f"{position}/s", "Q": position}
    return "".join(letters.get(c, c) for c in unit)


def describe_one_sided(friction: str, half: Parameter) -> str:
    """Return the excess of one direction's friction over the other's; the parameter is half the difference."""
    way = "forward" if half.value >= 0 else "backward"
    more = format_quantity(2 * abs(half.value), half.unit, None if half.stderr is None else 2 * half.stderr)
    return f"{friction} {more} higher when moving {way} than the other way"


def _prefixed(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and the unit for which a number is at least one, if there is such a unit."""
    rows = _PREFIXES.get(unit, ())
    return next((row for row in rows if size >= row[0]), rows[-1] if size > 0 and rows else (1.0, unit))


REFERENCES = {
    "coulomb": "the joint's Coulomb friction",
    "viscous": "the joint's viscous friction",
    "drag": "the joint's friction at full speed over the speed's square",
    "force": "the joint's largest force",
    "inertia": "the joint's inertia",
}
"""Quantities of which a bound may be a share, in words; `diagnose` computes them from the fitted model."""


@dataclass(frozen=True)
class PlausibleRange:
    """The range of one amplitude.

    Attributes:
        quantity: The parameter's name after the joint, without a final number, wave or axis.
        low: Lower bound, in the unit or as a share of the reference.
        high: Upper bound.
        unit: Unit for which it holds, such as `m` or `rad`, as in parameters; empty for any.
        of: Reference of which the bounds are shares, one of `REFERENCES`; empty for SI units.
        setting: Whether it is the range of a setting, not of a parameter.
    """

    quantity: str
    low: float
    high: float
    unit: str = ""
    of: str = ""
    setting: bool = False

    def covers(self, name: str, unit: str) -> bool:
        """Return whether the range is that of a parameter, by the part of its name after the joint and by its unit."""
        return (name == self.quantity or name.startswith(f"{self.quantity}_")) and self.unit in ("", unit)

    def bounds(self, joint: str, scales: JointScales) -> tuple[float, float]:
        """Return both bounds for a joint in SI units; infinite if the reference is unknown."""
        if not self.of:
            return self.low, self.high
        size = scales.get(joint, {}).get(self.of)
        if size is None:
            return (-np.inf, np.inf)
        return (self.low * size if self.low else 0.0, self.high * size if self.high else 0.0)

    def describe(self) -> str:
        """Return the range in words."""
        name = self.quantity.replace("_", " ")
        if self.of:
            return f"{name} {_share(self.low)} to {_share(self.high)} of {REFERENCES[self.of]}"
        if not self.unit or self.unit == "1":
            return f"{name} {self.low:g} to {self.high:g}"
        low = "0" if self.low == 0 else format_quantity(self.low, self.unit)
        return f"{name} {low} to {format_quantity(self.high, self.unit)}"


def describe_ranges(ranges: Iterable[PlausibleRange]) -> str:
    """Return an effect's ranges in words, for the documentation."""
    return "; ".join(one.describe() for one in ranges)


def build_slide_and_hinge_ranges(
    quantity: str, unit: str, low: tuple[float, float], high: tuple[float, float]
) -> list[PlausibleRange]:
    """Return two ranges of one quantity, for a slide and for a hinge; `unit` holds Q and F for position and force."""
    kinds = zip(("N", "N m"), low, high, strict=True)
    return [PlausibleRange(quantity, one, other, spell_unit(unit, force)) for force, one, other in kinds]


def _share(x: float) -> str:
    return "0" if x == 0 else f"{100 * x:g} %"


MAX_TERMS = 1000
"""Largest number of terms of an effect on a joint; a file with 10^9 of them would never be read completely."""


class Effect(ABC):
    """A force that the rigid model leaves out, linear in its parameters.

    Attributes:
        name: Name in model files; for an effect with a cause, the cause's name.
        equation: The law in one line, for readers.
        joints: The actuated joints it acts on.
        units: The joints' force units, 'N' or 'N m', by joint.
        settings: Quantities in which it is nonlinear; name -> value in SI units.
        label: Suffix of its parameters' names, so that two instances on one joint differ; mostly empty.
        cause: Whether diagnosis may name it (its name is then one of the contract's causes).
        reference: Source of the equation.
        reveals: The motion or recording that shows it, for readers.
        mistaken_for: Causes that it is easily confused with.
        equivalent: Causes that no data of this kind can distinguish from it.
        needs: Signals of the motion that it depends on.
        nonnegative: Whether only amplitudes from zero up are meaningful (a Stribeck term of the other sign is not one).
        plausible: Ranges of its amplitudes on real machines; no amplitude outside of them is confirmed.
        refined: Settings that diagnosis adjusts beyond its grid.
        matched: Setting -> the only amplitude, which equals it at the solution; diagnosis fits them as one number.
        confirmed_as: Status of a finding that held-out data confirm; `parameter` if it corrects a number of the robot file.
        open_ends: Setting -> `low`, `high` or `both`: ends of its grid beyond which the true value may lie.
        defaults: Name -> value of each setting.
        setting_units: Name -> unit of each setting; V denotes the speed unit, Q that of the position.
        positive: Settings that must be above zero.
        whole: Settings that count something, from one up.
        speed_law: Whether its force on a joint is an odd function of that joint's speed alone.
        grows: A setting that counts terms; more are tried if one was found; mostly empty.
        felt_by_all: Whether it changes the forces of all joints, so that its gain is computed over all of them.
        shared_by_joints: Whether joints cannot have separate amplitudes, as the recording has one for all.
        special: The cause that is this law with less freedom; it is named if data do not distinguish the two; mostly empty.
        dense: Whether its grid is so fine that it is first tried on decimated motion; it then has `local_frequency`.
    """

    name: ClassVar[str]
    equation: ClassVar[str]
    cause: ClassVar[bool] = False
    reference: ClassVar[str] = ""
    reveals: ClassVar[str] = ""
    mistaken_for: ClassVar[tuple[str, ...]] = ()
    equivalent: tuple[str, ...] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    refined: tuple[str, ...] = ()
    matched: ClassVar[Mapping[str, str]] = {}
    confirmed_as: ClassVar[Literal["confirmed", "parameter"]] = "confirmed"
    open_ends: ClassVar[Mapping[str, str]] = {}
    nonnegative: ClassVar[bool] = False
    plausible: ClassVar[tuple[PlausibleRange, ...]] = ()
    defaults: ClassVar[Mapping[str, float]] = {}
    setting_units: ClassVar[Mapping[str, str]] = {}
    positive: ClassVar[tuple[str, ...]] = ()
    whole: ClassVar[tuple[str, ...]] = ()
    grows: ClassVar[str] = ""
    shared_by_joints: ClassVar[bool] = False
    felt_by_all: ClassVar[bool] = False
    speed_law: ClassVar[bool] = False
    dense: ClassVar[bool] = False
    special: ClassVar[str] = ""

    def __init__(self, joints: Iterable[str], units: Iterable[str], *, label: str = "", **settings: float) -> None:
        """Let the effect act on these joints, whose forces are in these units ('N' or 'N m').

        Raises:
            InputError: A setting is unknown, not a finite number, or one that the effect cannot have.
        """
        self.joints, self.label = tuple(joints), label
        self.units = dict(zip(self.joints, units, strict=True))
        for key, value in settings.items():
            if fault := self._fault_of_setting(key, value):
                raise InputError("invalid_value", fault)
        self.settings: dict[str, float] = {**self.defaults, **{k: float(x) for k, x in settings.items()}}

    def __repr__(self) -> str:
        """Return a line with the effect, its joints and its settings."""
        given = [*self.joints, *(f"{key}={value:g}" for key, value in self.settings.items())]
        return f"{type(self).__name__}({', '.join(given)})"

    def _fault_of_setting(self, key: str, value: float) -> str:
        """Return the error of a setting; empty if it is valid."""
        if key not in self.defaults:
            return f"effect {self.name} has no setting '{key}'; it has {', '.join(self.defaults) or 'none'}"
        fault = ""
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not isfinite(value):
            fault = f"must be a finite number, not {value!r}"
        elif key in self.whole and (value < 1 or value != int(value)):
            fault = f"must be a whole number from 1 up, not {value!r}"
        elif key in self.whole and value > MAX_TERMS:
            fault = f"is {value!r}; it may be {MAX_TERMS} at most"
        elif key in self.positive and value <= 0:
            fault = f"must be above zero, not {value!r}"
        return fault and f"setting {key} of effect {self.name} {fault}"

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
        """Return the settings to try on these joints; an empty list if the motion cannot show the effect."""
        return [{}]

    @classmethod
    def propose(cls, scene: Scene, joints: tuple[str, ...]) -> float | None:
        """Return the value of its matched setting that a fit of the whole baseline proposes, or None."""
        return None

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the reason why this motion cannot show the effect and the experiment that would, or None if it can.

        The experiment is `NO_EXPERIMENT` if the robot lacks the part.
        """
        missing = [name for name in cls.needs if name not in scene.signals]
        return (f"the logs give no {missing[0]}", cls.reveals) if missing else None

    @classmethod
    def explain_absorbed(cls, joints: tuple[str, ...], is_felt: bool) -> str:
        """Return the reason why the baseline absorbs the effect on these joints, as a clause; empty if no reason is known.

        Args:
            joints: The joints.
            is_felt: Whether the effect changes any force.
        """
        return ""

    def find_implausible(self, parameters: Parameters, scales: JointScales, margin: float = 1.0) -> str:
        """Return the amplitudes outside their plausible range, as a phrase; empty if all are within.

        Args:
            parameters: Its parameters at fitted values.
            scales: Values of the references of shares; see `PlausibleRange`.
            margin: Factor by which the ranges are widened.
        """
        for p in parameters.select(self.parameters.names):
            owner, _, name = p.name.rpartition(".")
            name = name.removesuffix(self.label)
            row = next((row for row in self.plausible if not row.setting and row.covers(name, p.unit)), None)
            if row is None:
                continue
            bounds = np.array([row.bounds(joint, scales) for joint in owner.split("+")])
            low, high = margin * bounds[:, 0].min(), margin * bounds[:, 1].max()
            if not low <= p.value <= high:
                return f"{p.name} = {format_quantity(p.value, p.unit)} is outside of its plausible range ({row.describe()})"
        for row in (row for row in self.plausible if row.setting):
            for key in (key for key in self.refined if row.covers(key, "")):
                if not row.low <= self.settings[key] <= margin * row.high:
                    return f"{key} = {self.settings[key]:.3g} is outside of its plausible range ({row.describe()})"
        return ""

    def find_limit_law(self, scene: Scene) -> Effect | None:
        """Return the law that the effect becomes beyond the open end of its grid, or None."""
        return None

    def lookalikes(self) -> list[Effect]:
        """Return unnamed laws with the same number of terms, which must explain less for this one to be named."""
        return []

    @property
    def measured(self) -> bool:
        """Whether it distorts the recording (a delay, an encoder's error) and does not change the robot's motion."""
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
        """Return the effect at these values in words, with units and known standard errors."""
        found = ", ".join(f"{p.name} = {format_amount(p)}" for p in parameters.select(self.parameters.names))
        return f"{self.name.replace('_', ' ')}: {found}"

    def other_speeds(self, motion: Motion) -> list[tuple[np.ndarray, list[int]]]:
        """Return speeds (N,) other than the joints' own whose sign it uses, each with the indices of the joints it acts on."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of a model file: name, joints and settings; values are kept with the parameters."""
        more = {"settings": dict(self.settings), "label": self.label}
        return {"effect": self.name, "joints": list(self.joints), **{k: x for k, x in more.items() if x}}

    def _indices(self, motion: Motion) -> list[int]:
        missing = [j for j in self.joints if j not in motion.joints]
        if missing:
            raise InputError(
                "invalid_value",
                f"effect {self.name} acts on joint '{missing[0]}'; there are {', '.join(motion.joints)}",
            )
        return [motion.joints.index(j) for j in self.joints]


@contextmanager
def name_effect_in_errors(effect: Effect) -> Iterator[None]:
    """Add an effect's name to errors raised while it is evaluated; a motion does not know which effect needs its signals."""
    try:
        yield
    except InputError as fault:
        raise InputError(fault.code, str(fault).replace("this effect", f"effect {effect.name}", 1)) from fault
