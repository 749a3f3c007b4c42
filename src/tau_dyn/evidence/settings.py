"""Settings of a selected law: refined between the points of the grid, grown by terms, replaced at an edge, and plausible.

The best setting of a law may be at an open end of its grid. Then its true value may be beyond, where amplitude and setting are
not identifiable separately. Some families have a limit law without the setting, which all laws beyond the end approach: it
replaces the law at the edge, or the cause remains suspected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import optimize, stats

from tau_dyn.effects import Effect, Scene, format_quantity, spell_unit
from tau_dyn.estimate import scale_columns
from tau_dyn.evidence.candidate_scan import (
    CandidateCause,
    GroupTest,
    find_nonnegative,
    match_settings,
    rescore_group,
)
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.null_model import NullModel

EDGE_TOLERANCE = 1e-3
"""Relative distance from the end of a grid within which a setting counts as at the edge."""
MIN_LIMIT_SHARE = 2 / 3
"""Least share of the statistic of the law at the edge that the limit law must explain; less means another curve (see
`MIMIC_RATIO`)."""
_STEPS = 3  # Gauss-Newton steps of the settings
_TERM_LEVEL = 1e-4
"""Significance level of a further term of a law."""
_WIDE = 2.0  # factor by which a range of settings is widened
SEARCH_MARGIN = 5.0
"""Factor by which plausible ranges are widened inside the search: a law beyond it only resembles the true one, and would
prevent its detection; one within it is judged at the end, by its final amplitude."""


def refine_settings(candidate: CandidateCause, null_model: NullModel) -> CandidateCause:
    """Return a candidate with its settings adjusted by Gauss-Newton steps within the neighbouring grid points.

    A setting that equals an amplitude is estimated together with it.
    """
    fits = []
    for fit in candidate.fits:
        fit = _improve(match_settings(fit, null_model), null_model)
        fits.append(replace_at_edge(_grown(fit, null_model), null_model))
    return replace(candidate, fits=tuple(fits))


def _improve(fit: GroupTest, null_model: NullModel) -> GroupTest:
    """Return a fit after the Gauss-Newton steps that increase its statistic."""
    for _ in range(_STEPS if fit.effect.refined else 0):
        moved = _step(fit.effect, null_model, fit.neighbours)
        if moved is None:
            break
        better = rescore_group(replace(fit, effect=moved), null_model)
        if not better.statistic > fit.statistic + 0.01:
            break
        fit = better
    return fit


def _step(effect: Effect, null_model: NullModel, limits: Sequence[dict[str, float]]) -> Effect | None:
    C = null_model.rows(effect)
    amplitude = estimate_amplitudes(effect, null_model)
    if not np.any(amplitude):
        return None
    D = np.concatenate(
        [null_model.whiten_columns(x) for x in differentiate_settings(effect, amplitude, null_model.channel)], axis=1
    )
    both, norm = scale_columns(np.concatenate([C, D], axis=1))
    solution = np.linalg.lstsq(null_model.gram(both), both.T @ null_model.e, rcond=1e-8)[0] / norm
    changed = {}
    for key, change in zip(effect.refined, solution[len(amplitude) :], strict=True):
        values = [n[key] for n in limits] + [effect.settings[key]]
        low, high = min(values), max(values)
        if low == high and key in effect.positive:  # the grid has few, separate values of it
            low, high = low / _WIDE, high * _WIDE
        changed[key] = float(np.clip(effect.settings[key] + change, low, high))
    return effect.with_settings(**changed) if changed != {k: effect.settings[k] for k in changed} else None


def _grown(fit: GroupTest, null_model: NullModel) -> GroupTest:
    """Return a fit with as many terms of its law as are significant."""
    key = fit.effect.grows
    while key:
        more = fit.effect.with_settings(**{key: fit.effect.settings[key] + 1})
        better = rescore_group(replace(fit, effect=more, dof=len(more.parameters)), null_model)
        if not (better.statistic - fit.statistic) / better.overdispersion > stats.chi2.isf(
            _TERM_LEVEL, better.dof - fit.dof
        ):
            break
        fit = better
    return fit


def find_edge(effects: Sequence[Effect], scene: Scene) -> str:
    """Return the setting that is at an open end of its grid, as a phrase; empty if there is no such setting."""
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
                return f"{key} = {format_quantity(x, unit)} is at the edge of the searched range"
    return ""


def replace_at_edge(fit: GroupTest, null_model: NullModel) -> GroupTest:
    """Return a fit with the limit law of its family, if its setting is at an open end and that law explains as much.

    A limit law may have settings of its own, which are refined, and be at an edge again.
    """
    scene = null_model.channel.scene
    limit = fit.effect.find_limit_law(scene) if find_edge([fit.effect], scene) else None
    if limit is None:
        return fit
    found = _improve(rescore_group(replace(fit, effect=limit, neighbours=()), null_model), null_model)
    return replace_at_edge(found, null_model) if found.statistic > MIN_LIMIT_SHARE * fit.statistic else fit


def find_unbelievable(candidate: CandidateCause, null_model: NullModel) -> str:
    """Return the amplitude that is far beyond its plausible range, as a phrase; empty if all are near it."""
    for fit in candidate.fits:
        values = fit.effect.parameters.with_values(estimate_amplitudes(fit.effect, null_model))
        if why := fit.effect.find_implausible(values, null_model.channel.scene.scales, SEARCH_MARGIN):
            return why
    return ""


def estimate_amplitudes(effect: Effect, null_model: NullModel) -> np.ndarray:
    """Return an effect's amplitudes (k,) next to everything in the null model, within their bounds at zero.

    Minimises `x' G x - 2 x' C'e` with `G` the Gram matrix of the columns' `C` residuals on the null model; directions that the
    null model absorbs stay at zero.
    """
    C = null_model.rows(effect)
    scale = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
    values, vectors = np.linalg.eigh(null_model.gram(C / scale))
    seen = values > 1e-9 * max(values[-1], 1e-300)
    values, vectors = values[seen], vectors[:, seen]
    rows, y = np.sqrt(values)[:, None] * vectors.T, vectors.T @ (C.T @ null_model.e / scale) / np.sqrt(values)
    lower = np.where(find_nonnegative(effect), 0.0, -np.inf)
    x = (
        optimize.lsq_linear(rows, y, (lower, np.inf)).x
        if np.any(lower == 0)
        else np.linalg.lstsq(rows, y, rcond=None)[0]
    )
    return x / scale


def differentiate_settings(effect: Effect, amplitude: np.ndarray, channel: Channel) -> list[list[np.ndarray]]:
    """Return, for each refined setting, the change of the effect's force per unit of it (n, m, 1) of each run."""
    found = []
    for key in effect.refined:
        step = 1e-3 * abs(effect.settings[key]) or 1e-6
        ends = [channel.columns(effect.with_settings(**{key: effect.settings[key] + x})) for x in (step, -step)]
        found.append([((a - b) @ amplitude / (2 * step))[:, :, None] for a, b in zip(*ends, strict=True)])
    return found
