"""Settings at the end of their grid: the law beyond it takes their place, or the cause stays suspected.

The best setting of a law may lie at an open end of what was searched. Then its true value may be beyond, where amplitude and
setting have no values of their own. Some families have a member without the setting that all laws beyond the end approach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tau_dyn.effects import Effect, Scene, format_quantity, spell_unit
from tau_dyn.evidence.candidate_scan import GroupTest, rescore_group
from tau_dyn.evidence.null_model import NullModel

EDGE_TOLERANCE = 1e-3
"""Relative distance from the end of a grid within which a setting counts as at the edge."""
MIN_LIMIT_SHARE = 2 / 3
"""Share of the evidence of the law at the edge that the limit law must explain; less is another curve (see `MIMIC_RATIO`)."""


def find_edge(effects: Sequence[Effect], scene: Scene) -> str:
    """Return which setting lies at an open end of its grid, as a phrase; empty where none does."""
    for effect in effects:
        free = {*effect.refined, *effect.open_ends}
        fixed = {key: value for key, value in effect.settings.items() if key not in free}
        grid = [s for s in type(effect).grid(scene, effect.joints) if all(s.get(k, x) == x for k, x in fixed.items())]
        for key, end in effect.open_ends.items():
            values = sorted({setting[key] for setting in grid if key in setting})
            if len(values) < 2 or key not in effect.settings:
                continue
            x, unit = (
                effect.settings[key],
                spell_unit(effect.setting_units.get(key, "1"), effect.units[effect.joints[0]]),
            )
            low, high = values[0] * (1 + EDGE_TOLERANCE), values[-1] * (1 - EDGE_TOLERANCE)
            if (end != "high" and x <= low) or (end != "low" and x >= high):
                return f"{key} = {format_quantity(x, unit)} is at the edge of what was searched"
    return ""


def replace_at_edge(fit: GroupTest, ground: NullModel) -> GroupTest:
    """Return a fit with the limit law of its family, where its setting lies at an open end and that law explains as much."""
    scene = ground.channel.scene
    limit = fit.effect.find_limit_law(scene) if find_edge([fit.effect], scene) else None
    if limit is None:
        return fit
    found = rescore_group(replace(fit, effect=limit, neighbours=()), ground)
    return found if found.statistic > MIN_LIMIT_SHARE * fit.statistic else fit
