"""What a user says about parameters by name or pattern: fix, free, bound, and what was measured beforehand.

--fix plate_link.mass=9.13          taken as exact
--fix plate_link.mass=9.13+-0.05    known with a standard deviation: enters as a measurement of its own
--fix '*_link.mass'                 stays at its nominal value
--fix cart1.drive_gain=0.98+-0.01   the logged force times 0.98; the uncertainty is carried into every result
--free '*.armature'                 estimated although fixed by default
--bound cart1.viscous=0:400         kept within
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase

from tau_dyn.estimate import Regression
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import NOT_GIVEN


@dataclass(frozen=True)
class Choices:
    """Requests by name or pattern, as the command line spells them, and the motor constants among them.

    Attributes:
        fix: `NAME`, `NAME=VALUE` or `NAME=VALUE+-SIGMA`.
        free: `NAME`.
        bound: `NAME=LO:HI`.
    """

    fix: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    bound: tuple[str, ...] = ()

    def apply(self, model: Model) -> Model:
        """Return the model with these requests carried out.

        Raises:
            UnknownName: A name or pattern that no parameter has.
            InputError: A value that is not a finite number, or bounds in the wrong order.
        """
        named = [*self.free, *(text.partition("=")[0] for text in (*self.fix, *self.bound))]
        exact = [n for n in named if not set(n) & set("*?[") and n not in model.effect_parameters and not _is_gain(n)]
        model = replace(model, robot=model.robot.untied(exact))
        changes: dict[str, dict] = {}
        for text in self.free:
            for name in model.parameters.match(text):
                changes.setdefault(name, {}).update(free=True)
        for text in self.fix:
            if not _is_gain(text.partition("=")[0]):
                pattern, value, sigma = _fixed(text)
                for name in model.parameters.match(pattern):
                    given = {"value": value, "origin": "given"}
                    if value is None:
                        given = {"origin": "held"} if model.parameters[name].origin == NOT_GIVEN else {}
                    changes.setdefault(name, {}).update(given, free=sigma is not None, prior_stderr=sigma)
        for text in self.bound:
            pattern, lower, upper = _bounded(text)
            for name in model.parameters.match(pattern):
                given = changes.setdefault(name, {})
                given.update(lower=lower, upper=upper)
                if "origin" not in given:  # a nominal value follows its bounds, a given one has to lie within
                    given["value"] = min(max(model.parameters[name].value, lower), upper)
        model = model.with_parameters(model.parameters.update(changes))
        _refuse_outside(model.parameters.select(changes))
        return model

    def gains(self, joints: Iterable[str]) -> dict[str, tuple[float, float]]:
        """Return what was said about motor constants: joint -> (factor, relative standard deviation)."""
        joints = tuple(joints)
        found = {}
        for text in self.fix:
            name = text.partition("=")[0]
            if not _is_gain(name):
                continue
            pattern = name.rsplit(".", 1)[0]
            chosen = [j for j in joints if fnmatchcase(j, pattern)]
            if not chosen:
                raise UnknownName("actuated joint", pattern, joints)
            _, value, sigma = _fixed(text)
            if value is None or value <= 0:
                raise InputError("bad_option", f"--fix {text}: a drive gain is a positive factor, such as 1+-0.02")
            found.update({j: (value, (sigma or 0.0) / value) for j in chosen})
        return found


def scale_outputs(regression: Regression, factors: dict[str, float]) -> Regression:
    """Return the regression with each output multiplied by its factor (1 where none is given)."""
    scale = [factors.get(output, 1.0) for output in regression.outputs]
    return replace(
        regression, runs=tuple(replace(run, y=run.y * scale, y_all=run.y_all * scale) for run in regression.runs)
    )


def _refuse_outside(parameters: Parameters) -> None:
    for p in parameters:
        if p.origin == "given" and not p.lower <= p.value <= p.upper:
            raise InputError(
                "invalid_value", f"{p.name}={p.value:g} {p.unit} lies outside its bounds, {p.lower:g} to {p.upper:g}"
            )


def _is_gain(name: str) -> bool:
    return name.endswith(".drive_gain")


def _fixed(text: str) -> tuple[str, float | None, float | None]:
    pattern, equals, rest = text.partition("=")
    if not equals:
        return pattern, None, None
    value, uncertain, sigma = rest.replace("±", "+-").partition("+-")
    deviation = _number(sigma, text) if uncertain else None
    if deviation is not None and deviation <= 0:
        raise InputError("bad_option", f"--fix {text}: the uncertainty after +- must be positive")
    return pattern, _number(value, text), deviation


def _bounded(text: str) -> tuple[str, float, float]:
    pattern, _, rest = text.partition("=")
    low, colon, high = rest.partition(":")
    if not colon:
        raise InputError("bad_option", f"--bound {text}: write NAME=LO:HI, either may be empty")
    lower = _number(low, text) if low else float("-inf")
    upper = _number(high, text) if high else float("inf")
    if lower > upper:
        raise InputError("bad_option", f"--bound {text}: the lower bound is above the upper one")
    return pattern, lower, upper


def _number(word: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e15:
        raise InputError(
            "bad_option",
            f"'{text}': '{word}' is not a finite number of sensible size; write NAME=VALUE, such as plate_link.mass=9.13",
        )
    return value
