"""May a cause be confirmed? Its amplitudes are plausible, its settings inside what was searched, its joints better predicted.

A fit finds the best amplitude of any law; these rules ask whether a machine can have it. They are applied after the search: a
law that fails them has been accounted for while others were looked for, and stays in the answer as `suspected` with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect, JointScales, Scene, format_quantity, spell_unit
from tau_dyn.estimate import Estimate
from tau_dyn.parameters import Parameters

SEARCH_MARGIN = 5.0
"""Factor by which plausible ranges are widened inside the search: a law beyond it only resembles the true one, and would keep
it from being found; one closer by is judged at the end, by its final amplitude."""
INCONSISTENT_LEVEL = 1e-3
"""Significance level of a difference between joints; standard errors of amplitudes may be some tens of per cent too small."""
EDGE_TOLERANCE = 1e-3
"""Relative distance from the end of a grid within which a setting counts as at the edge."""


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


def find_implausible(effects: Sequence[Effect], values: Parameters, scales: JointScales) -> str:
    """Return which amplitude lies outside its plausible range, as a phrase; empty where all lie within."""
    return next((text for effect in effects if (text := effect.find_implausible(values, scales))), "")


def find_inconsistent(effects: Sequence[Effect], values: Parameters, step_s: float) -> str:
    """Return that a time which all joints share differs from joint to joint, as a phrase; empty where it does not.

    Channels that one controller reads in turn stand anywhere within one sample, so times that differ by less are one.

    Args:
        effects: The cause's effects on its joints.
        values: Fitted values with their standard errors.
        step_s: Time between samples of the log [s].
    """
    if not effects[0].shared_by_joints or len(effects) < 2:
        return ""
    own = [values[name] for effect in effects for name in effect.parameters.names]
    own = [p for p in own if p.stderr]
    uniform = step_s / np.sqrt(12)
    weight = np.array([1 / (float(p.stderr or 1.0) ** 2 + uniform**2) for p in own])
    x = np.array([p.value for p in own])
    mean = float(x @ weight / weight.sum()) if len(own) else 0.0
    scatter = float(np.sum(weight * (x - mean) ** 2))
    if len(own) < 2 or stats.chi2.sf(scatter, len(own) - 1) > INCONSISTENT_LEVEL:
        return ""
    listed = ", ".join(f"{p.name.rpartition('.')[0]} {format_quantity(p.value, p.unit)}" for p in own)
    return f"one recording has one {effects[0].name.replace('_', ' ')}, and here it differs between joints ({listed})"


def is_distinct_from_zero(effects: Sequence[Effect], estimate: Estimate, min_z: float) -> bool:
    """Return whether the amplitudes together are distinct from zero: a Wald test at the level of `min_z` standard errors.

    Amplitudes that move against each other may each be known badly and yet not both be zero. Of the two covariances of an
    estimate the one that finds less counts. Amplitudes without a standard error, as at a bound, are left out.
    """
    base, parameters = estimate.base, estimate.parameters
    own = {name for effect in effects for name in effect.parameters.names}
    known = {p.name for p in parameters if p.stderr is not None and 0 < p.stderr < np.inf}
    rows = [k for k, c in enumerate(base.kept) if base.alone[c] and base.names[c] in own & known]
    if not rows:
        return False
    x = np.array([parameters[base.names[c]].value for c in base.kept[rows]])
    found = np.inf
    for covariance in (estimate.cov, estimate.scatter):
        C = covariance[np.ix_(rows, rows)]
        size = np.sqrt(np.diag(C))
        found = min(
            found, float(x / size @ np.linalg.pinv(C / np.outer(size, size), 1e-6, hermitian=True) @ (x / size))
        )
    return bool(found > stats.chi2.isf(2 * stats.norm.sf(min_z), len(rows)))
