r"""Cyclic errors seen at too few places: several periods that fit alike.

Places a step `s` apart give the same values to every wave whose number of periods a metre differs by a multiple of `1 / s`, and
to their mirror images, `1 / p' = k / s +- 1 / p`. Of poses held still the periods that explain as much as the best one are
listed; more than one, and the period is not known. Places at uneven steps have no such twins (Dressler 2012, 4.2, presumes
them in measurements 50 mm apart).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.diagnose.candidate_scan import ColumnCache, compute_explained, get_columns
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.data_split import TRAIN
from tau_dyn.diagnose.forward_step import MIN_2LOGL_DIFFERENCE
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.result import Finding
from tau_dyn.diagnose.stepwise_selection import SelectedCause, StepwiseSelection
from tau_dyn.diagnose.tool import ToolChannel
from tau_dyn.effects import Effect, format_quantity

_FINE = 5  # settings tried to either side of a grid point that does well
_LISTED = 4  # periods named in a sentence
_PER_PERIOD = 2.5
"""Places that one period needs, with a little to spare above two."""
_MIN_EXPLAINED_SHARE = 0.8  # share of the best that a grid point explains where a finer one may explain all


def find_alias_periods(channel: ToolChannel, hunt: StepwiseSelection) -> list[tuple[float, ...]]:
    """Return the periods [m or rad] that each cyclic error found may have; none for other causes and motion sampled in time."""
    found: list[tuple[float, ...]] = []
    for one in hunt.found:
        effect = one.candidate.effects[0]
        found.append(())
        if channel.poses and effect.dense and "period" in effect.settings:
            ground = NullModel.of(channel, (TRAIN,), hunt.noise, get_columns(hunt.library, hunt.others(one)))
            found[-1] = compute_alias_periods(hunt.library, ground, effect)
    return found


def leave_period_open(channel: Channel, one: SelectedCause, finding: Finding, periods: tuple[float, ...]) -> Finding:
    """Say that the places measured leave the period of a cyclic error open, and which spacing would not."""
    effect = one.candidate.effects[0]
    joint = effect.joints[0]
    unit = "m" if effect.units[joint] == "N" else "rad"
    listed = ", ".join(format_quantity(p, unit) for p in periods[:_LISTED])
    more = (
        f" and {len(periods) - _LISTED} more down to {format_quantity(periods[-1], unit)}"
        if len(periods) > _LISTED
        else ""
    )
    step, finer = (
        format_quantity(x, unit) for x in (compute_position_spacing(channel, joint), periods[-1] / _PER_PERIOD)
    )
    return replace(
        finding,
        status="suspected",
        gain=None,
        sentence=f"{joint} has a cyclic error, but at places {step} apart periods of {listed}{more} fit alike.",
        experiment=f"measure the tool while {joint} goes in steps of {finer} or less, or at as many places in uneven steps",
    )


def compute_alias_periods(library: ColumnCache, ground: NullModel, effect: Effect) -> tuple[float, ...]:
    """Return the periods [m or rad] that explain as much as an effect's own, longest first; only its own where it is sure.

    Args:
        library: Columns on the measurements' channel.
        ground: Everything else accounted for.
        effect: An effect with a setting `period`.
    """
    scene = library.channel.scene
    k = scene.index(effect.joints[0])
    travel = float(scene.high[k] - scene.low[k])
    lines = np.array([1 / s["period"] for s in type(effect).grid(scene, effect.joints) if "period" in s])
    own = 1 / effect.settings["period"]
    if travel <= 0 or not len(lines):
        return (effect.settings["period"],)
    step = float(np.median(np.abs(np.diff(lines)))) if len(lines) > 1 else 1 / travel
    rough = _explained(library, ground, effect, lines)
    starts = [own, *lines[rough > rough.max() * _MIN_EXPLAINED_SHARE - MIN_2LOGL_DIFFERENCE]]
    fine = np.concatenate([x + step * np.linspace(-0.5, 0.5, 2 * _FINE + 1) for x in starts])
    fine = np.concatenate([[own], fine[fine > 0]])
    found = list(zip(_explained(library, ground, effect, fine), fine, strict=True))
    top = max(T for T, _ in found)
    kept: list[float] = []
    for T, line in sorted(found, reverse=True):
        if T > top - MIN_2LOGL_DIFFERENCE and all(abs(line - other) > 1 / travel for other in kept):
            kept.append(line)
    return tuple(sorted((1 / line for line in kept), reverse=True))


def compute_position_spacing(channel: Channel, joint: str) -> float:
    """Return the usual step between places of a joint [m or rad]."""
    steps = [np.abs(np.diff(v[f"q_{joint}"])) for v in channel.variables()]
    all_steps = np.concatenate(steps)
    moved = all_steps[all_steps > 1e-6 * max(float(all_steps.max(initial=0.0)), 1e-300)]
    return float(np.median(moved)) if len(moved) else 0.0


def _explained(library: ColumnCache, ground: NullModel, effect: Effect, lines: np.ndarray) -> np.ndarray:
    """Return `T` (g,) of the effect with these numbers of periods a metre or radian (g,)."""
    settings = [effect.with_settings(period=float(1 / line)) for line in lines]
    return compute_explained(settings, library, ground, ground.e[:, None])[:, 0]
