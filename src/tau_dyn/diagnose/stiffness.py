"""Joint stiffness read with and without what it is mistaken for: regressions of the same deflections.

    deflection = zero + compliance tau [+ loop] [+ clock_offset v]

The loop is a play that closes at once, in effect `sign(v)`, or a hysteresis that builds up over the distance that fits best.
What a reading is worth shows in what it leaves on data used for nothing else. This finds no cause; it shows how far the
stiffness depends on the causes that one believes in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.diagnose.data_split import TRAIN, VALIDATION
from tau_dyn.diagnose.deflection import DeflectionChannel
from tau_dyn.diagnose.deflection_clock import ClockOffset
from tau_dyn.diagnose.extended_fit import build_extended_regression, fit_extended_model, restrict_to_parts
from tau_dyn.effects import Backlash, Effect, Hysteresis, JointCompliance
from tau_dyn.estimate import solve_least_squares

READINGS: tuple[tuple[type[Effect], ...], ...] = (
    (JointCompliance,),
    (JointCompliance, Backlash),
    (JointCompliance, Hysteresis),
    (JointCompliance, ClockOffset),
    (JointCompliance, ClockOffset, Backlash),
    (JointCompliance, ClockOffset, Hysteresis),
)


@dataclass(frozen=True, eq=False)
class Reading:
    """Stiffness read with some causes.

    Attributes:
        causes: Names of what the deflection was made of.
        joints: The joints.
        stiffness: One over the fitted compliance (m,) [N m/rad or N/m]; infinite where no positive compliance fits.
        stderr: Its standard error (m,); infinite alike.
        values: All fitted amplitudes by name.
        rms: What is left on data used for nothing else (m,) [rad or m].
    """

    causes: tuple[str, ...]
    joints: tuple[str, ...]
    stiffness: np.ndarray
    stderr: np.ndarray
    values: dict[str, float]
    rms: np.ndarray


def estimate_stiffness(channel: DeflectionChannel, seed: int = 0) -> list[Reading]:
    """Return all readings; a loop takes, on each joint, the distance of its grid that fits best."""
    return [_reading(channel, causes, np.random.default_rng(seed)) for causes in READINGS]


def _reading(channel: DeflectionChannel, causes: Sequence[type[Effect]], rng: np.random.Generator) -> Reading:
    effects = [_on(channel, causes, joint) for joint in channel.outputs]
    fit = fit_extended_model(channel, [e for group in effects for e in group], None, rng)
    assert fit.estimate is not None
    found = fit.estimate.parameters
    values = {p.name: p.value for p in found}
    compliance = [found[f"{joint}.compliance"] for joint in channel.outputs]
    soft = np.array([p.value for p in compliance])
    error = np.array([np.inf if p.stderr is None else p.stderr for p in compliance])
    with np.errstate(divide="ignore", invalid="ignore"):
        stiffness = np.where(soft > 0, 1 / soft, np.inf)
        stderr = np.where(soft > 0, error / soft**2, np.inf)
    names = tuple(cls.name for cls in causes)
    return Reading(names, channel.outputs, stiffness, stderr, values, fit.errors.rms)


def _on(channel: DeflectionChannel, causes: Sequence[type[Effect]], joint: str) -> list[Effect]:
    """Return the causes on one joint, at the settings of their grids that leave least on training and confirmation parts."""
    unit = channel.scene.units[channel.scene.index(joint)]
    grids = [cls.grid(channel.scene, (joint,)) or [{}] for cls in causes]
    grids = [grid if cls.refined else grid[:1] for cls, grid in zip(causes, grids, strict=True)]
    first = [cls((joint,), (unit,)).with_settings(**grid[0]) for cls, grid in zip(causes, grids, strict=True)]
    tried = [first]
    for k, grid in enumerate(grids):
        tried += [[*first[:k], first[k].with_settings(**settings), *first[k + 1 :]] for settings in grid[1:]]
    return min(tried, key=lambda effects: _left(channel, effects, joint))


def _left(channel: DeflectionChannel, effects: Sequence[Effect], joint: str) -> float:
    regression = restrict_to_parts(build_extended_regression(channel, effects), channel, TRAIN, VALIDATION)
    k = channel.outputs.index(joint)
    residuals = regression.residuals(solve_least_squares(regression).theta)
    return sum(float(np.sum(e[run.usable[:, k], k] ** 2)) for e, run in zip(residuals, regression.runs, strict=True))
