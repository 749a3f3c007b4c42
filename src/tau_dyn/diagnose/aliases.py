r"""Cyclic errors seen at too few places: several periods that fit alike.

Places a step `s` apart give the same values to every wave whose number of periods a metre differs by a multiple of `1 / s`, and
to their mirror images, `1 / p' = k / s +- 1 / p`. Of poses held still the periods that explain as much as the best one are
listed; more than one, and the period is not known. Places at uneven steps have no such twins (Dressler 2012, 4.2, presumes
them in measurements 50 mm apart).
"""

from __future__ import annotations

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.forward_step import MIN_2LOGL_DIFFERENCE
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.effects import Effect
from tau_dyn.exceptions import InputError

_FINE = 5  # settings tried to either side of a grid point that does well
_MIN_EXPLAINED_SHARE = 0.8  # share of the best that a grid point explains where a finer one may explain all


def compute_alias_periods(channel: Channel, ground: NullModel, effect: Effect) -> tuple[float, ...]:
    """Return the periods [m or rad] that explain as much as an effect's own, longest first; only its own where it is sure.

    Args:
        channel: The measurements.
        ground: Everything else accounted for.
        effect: An effect with a setting `period`.
    """
    scene = channel.scene
    k = scene.index(effect.joints[0])
    travel = float(scene.high[k] - scene.low[k])
    lines = np.array([1 / s["period"] for s in type(effect).grid(scene, effect.joints) if "period" in s])
    own = 1 / effect.settings["period"]
    if travel <= 0 or not len(lines):
        return (effect.settings["period"],)
    step = float(np.median(np.abs(np.diff(lines)))) if len(lines) > 1 else 1 / travel
    rough = _explained(channel, ground, effect, lines)
    starts = [own, *lines[rough > rough.max() * _MIN_EXPLAINED_SHARE - MIN_2LOGL_DIFFERENCE]]
    fine = np.concatenate([x + step * np.linspace(-0.5, 0.5, 2 * _FINE + 1) for x in starts])
    fine = np.concatenate([[own], fine[fine > 0]])
    found = list(zip(_explained(channel, ground, effect, fine), fine, strict=True))
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


def _explained(channel: Channel, ground: NullModel, effect: Effect, lines: np.ndarray) -> np.ndarray:
    """Return `T` (g,) of the effect with these numbers of periods a metre or radian (g,)."""
    settings = [effect.with_settings(period=float(1 / line)) for line in lines]
    quick = channel.scan(settings, ground, ground.e[:, None])
    if quick is None:
        raise InputError("unsupported", f"effect {effect.name} has no period to scan")
    return quick[:, 0]
