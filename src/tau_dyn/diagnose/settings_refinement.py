"""A cause at the settings that fit best, on the joints that show it beside its stronger ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import optimize, stats

from tau_dyn.diagnose.candidate_scan import ColumnCache, find_nonnegative, get_columns, match_settings, rescore_group
from tau_dyn.diagnose.group_tests import CandidateCause, GroupTest
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.effects import Effect
from tau_dyn.estimate import scale_columns

_STEPS = 3  # Gauss-Newton steps of the settings
_TERM_LEVEL = 1e-4
"""Chance at which noise alone adds a term to a law."""
_WIDE = 2.0  # factor by which a range of settings is widened


def refine_settings(candidate: CandidateCause, library: ColumnCache, ground: NullModel) -> CandidateCause:
    """Return a candidate with its settings adjusted by Gauss-Newton steps within the neighbouring grid points.

    A setting that agrees with an amplitude is found together with it.
    """
    fits = []
    for fit in candidate.fits:
        fit = match_settings(fit, library, ground)
        for _ in range(_STEPS if fit.effect.refined else 0):
            moved = _step(fit.effect, library, ground, fit.neighbours)
            if moved is None:
                break
            better = rescore_group(replace(fit, effect=moved), library, ground)
            if not better.statistic > fit.statistic + 0.01:
                break
            fit = better
        fits.append(_grown(fit, library, ground))
    return replace(candidate, fits=tuple(fits))


def _grown(fit: GroupTest, library: ColumnCache, ground: NullModel) -> GroupTest:
    """Return a fit with as many terms of its law as earn their freedom."""
    key = fit.effect.grows
    while key:
        more = fit.effect.with_settings(**{key: fit.effect.settings[key] + 1})
        better = rescore_group(replace(fit, effect=more, dof=len(more.parameters)), library, ground)
        if not (better.statistic - fit.statistic) / better.overdispersion > stats.chi2.isf(
            _TERM_LEVEL, better.dof - fit.dof
        ):
            break
        fit = better
    return fit


def drop_redundant_groups(candidate: CandidateCause, library: ColumnCache, ground: NullModel) -> CandidateCause:
    """Return a candidate with the groups that explain something beside its stronger ones, and what each explains there.

    What a joint does leaks through the baseline's refit into the others, where the same cause would be found again.
    """
    kept = [candidate.fits[0]]
    for fit in candidate.fits[1:]:
        beside = rescore_group(fit, library, ground.augment(get_columns(library, [one.effect for one in kept])))
        if beside.statistic > beside.threshold:
            kept.append(beside)
    return replace(candidate, fits=tuple(kept))


def estimate_amplitudes(effect: Effect, library: ColumnCache, ground: NullModel) -> np.ndarray:
    """Return an effect's amplitudes (k,) beside what the ground accounts for, within their bounds at zero.

    Minimises `x' G x - 2 x' C'e` with `G` the Gram matrix of what the ground leaves of the columns `C`; directions that it
    leaves nothing of stay at zero.
    """
    C = ground.whiten_columns(library.columns(effect))
    scale = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
    values, vectors = np.linalg.eigh(ground.gram(C / scale))
    seen = values > 1e-9 * max(values[-1], 1e-300)
    values, vectors = values[seen], vectors[:, seen]
    rows, y = np.sqrt(values)[:, None] * vectors.T, vectors.T @ (C.T @ ground.e / scale) / np.sqrt(values)
    lower = np.where(find_nonnegative(effect), 0.0, -np.inf)
    x = (
        optimize.lsq_linear(rows, y, (lower, np.inf)).x
        if np.any(lower == 0)
        else np.linalg.lstsq(rows, y, rcond=None)[0]
    )
    return x / scale


def differentiate_settings(effect: Effect, amplitude: np.ndarray, library: ColumnCache) -> list[list[np.ndarray]]:
    """Return, for each refined setting, the change of the effect's force per unit of it (n, m, 1) of each run."""
    found = []
    for key in effect.refined:
        step = 1e-3 * abs(effect.settings[key]) or 1e-6
        ends = [library.channel.columns(effect.with_settings(**{key: effect.settings[key] + x})) for x in (step, -step)]
        found.append([((a - b) @ amplitude / (2 * step))[:, :, None] for a, b in zip(*ends, strict=True)])
    return found


def _step(effect: Effect, library: ColumnCache, ground: NullModel, limits: Sequence[dict[str, float]]) -> Effect | None:
    C = ground.whiten_columns(library.columns(effect))
    amplitude = estimate_amplitudes(effect, library, ground)
    if not np.any(amplitude):
        return None
    D = np.concatenate([ground.whiten_columns(x) for x in differentiate_settings(effect, amplitude, library)], axis=1)
    both, norm = scale_columns(np.concatenate([C, D], axis=1))
    solution = np.linalg.lstsq(ground.gram(both), both.T @ ground.e, rcond=1e-8)[0] / norm
    changed = {}
    for key, change in zip(effect.refined, solution[len(amplitude) :], strict=True):
        values = [n[key] for n in limits] + [effect.settings[key]]
        low, high = min(values), max(values)
        if low == high and key in effect.positive:  # the grid has few values of it, not next to each other
            low, high = low / _WIDE, high * _WIDE
        changed[key] = float(np.clip(effect.settings[key] + change, low, high))
    return effect.with_settings(**changed) if changed != {k: effect.settings[k] for k in changed} else None
