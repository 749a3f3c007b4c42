"""Causes found one after the other, then judged together.

Each round tries every cause against what is accounted for, takes the strongest that is no artefact, on the joints that are its
own, refines its settings, and goes on. What a cause explains is discounted by its own scatter over time, which a wrong law has
more of; but two laws that explain the same are told apart by their freedom alone. Afterwards each one has to hold its ground
beside all others, and what each could be mistaken for is written down: a rival that explains nearly as much alone and nothing any
more beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, stats

from tau_dyn.diagnose.candidate_scan import (
    FAMILY_LEVEL,
    MIN_SHARE_OF_STRONGEST,
    N_NULL_DRAWS,
    CandidateCause,
    ColumnCache,
    GroupTest,
    combine_group_tests,
    compute_penalised_statistic,
    find_nonnegative,
    get_columns,
    match_settings,
    rescore_group,
    scan_causes,
)
from tau_dyn.diagnose.channel import TRAIN, Channel
from tau_dyn.diagnose.null_model import NullModel, fit_noise_models
from tau_dyn.diagnose.unknown_structure import Structure, find_structure
from tau_dyn.effects import Effect
from tau_dyn.estimate import Autoregression, scale_columns

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


SEARCH_MARGIN = 5.0
"""Factor by which plausible ranges are widened inside the search: a law beyond it only resembles the true one, and would keep
it from being found; one closer by is judged at the end, by its final amplitude."""
MIN_2LOGL_DIFFERENCE = 8.0
"""Difference of merit (twice the log-likelihood) below which two causes are not told apart: odds of 50 to 1."""
TAKEOVER_2LOGL_MARGIN = 4.0
"""Merit by which another cause takes over one joint of several: that all joints share one cause is likelier beforehand."""

ArtefactFilter = Callable[[NullModel, CandidateCause, Sequence[Effect], int], CandidateCause | None]
"""Return what of a candidate is no artefact, or None: judged on a ground, beside the effects in it, as one of so many causes."""


def choose_next_cause(
    significant: Sequence[CandidateCause],
    library: ColumnCache,
    ground: NullModel,
    others: Sequence[Effect],
    n: int,
    sift: ArtefactFilter | None,
) -> tuple[CandidateCause, tuple[str, ...]] | None:
    """Return the strongest cause that is no artefact, its settings refined, and its twins; None if there is none."""
    left = [drop_redundant_groups(c, library, ground) for c in significant]
    while left:
        strongest, twins = _strongest(left)
        own, more = _drop_shadowed_joints(strongest, left, library, ground)
        best = refine_settings(own, library, ground)
        genuine = sift(ground, best, others, n) if sift else best
        if genuine is not None and _is_believable(genuine, library, ground):
            return genuine, tuple(dict.fromkeys((*twins, *more)))
        left = [c for c in left if c is not strongest]
    return None


def _is_believable(candidate: CandidateCause, library: ColumnCache, ground: NullModel) -> bool:
    """Return whether amplitudes lie near their plausible ranges; far beyond them a law only mimics something else."""
    for fit in candidate.fits:
        values = fit.effect.parameters.with_values(estimate_amplitudes(fit.effect, library, ground))
        if fit.effect.find_implausible(values, library.channel.scene.scales, SEARCH_MARGIN):
            return False
    return True


def _strongest(significant: Sequence[CandidateCause]) -> tuple[CandidateCause, tuple[str, ...]]:
    """Return the cause that explains most, each by its own scatter, and its twins.

    Among those that explain as much under one scatter the one with the least freedom is taken.
    """
    first = max(significant, key=lambda c: c.penalised_statistic)
    scatter = first.fits[0].overdispersion
    beyond = [c.merit_under(scatter) - first.merit_under(scatter) for c in significant]
    level = [(x, k) for k, x in enumerate(beyond) if abs(x) < MIN_2LOGL_DIFFERENCE]
    best = significant[max(level)[1]]
    alike = {k for _, k in level}
    near = (
        c
        for k, c in enumerate(significant)
        if c.penalised_statistic > best.penalised_statistic - MIN_2LOGL_DIFFERENCE or k in alike
    )
    return best, tuple(dict.fromkeys(c.cause for c in near if c is not best and c.cause != best.cause))


def _drop_shadowed_joints(
    best: CandidateCause, significant: Sequence[CandidateCause], library: ColumnCache, ground: NullModel
) -> tuple[CandidateCause, tuple[str, ...]]:
    """Return a cause without the joints at which it is the shadow of another one that explains more, and its twins elsewhere.

    A shadow explains hardly a tenth of its own beside the other; what explains more than that is a thing of its own. Where
    neither explains more than the other, by far, they are twins at this joint.
    """
    scatter = best.fits[0].overdispersion
    alone = [(c.cause, fit) for c in significant if c is not best for fit in c.tested]
    kept, twins = [], []
    for fit in best.fits:
        own = next(f for f in best.tested if f.effect.joints == fit.effect.joints)
        merit = compute_penalised_statistic([own], scatter)
        same = [(cause, other) for cause, other in alone if set(other.effect.joints) == set(fit.effect.joints)]
        near = [x for x in same if compute_penalised_statistic([x[1]], scatter) > merit - MIN_2LOGL_DIFFERENCE]
        over = [(cause, other) for cause, other in near if _is_shadow(own, other, library, ground)]
        if any(compute_penalised_statistic([other], scatter) > merit + TAKEOVER_2LOGL_MARGIN for _, other in over):
            continue
        kept.append(fit)
        twins += [cause for cause, _ in over]
    return replace(best, fits=tuple(kept) or best.fits[:1]), tuple(twins)


def _is_shadow(fit: GroupTest, other: GroupTest, library: ColumnCache, ground: NullModel) -> bool:
    left = rescore_group(fit, library, ground.augment([library.columns(other.effect)]))
    return left.statistic <= max(left.threshold, MIN_SHARE_OF_STRONGEST * fit.statistic)


MAX_CAUSES = 5
"""Causes looked for at most."""
MIMIC_MARGIN = 12.0
"""Merit by which an unnamed structure must beat a cause to unseat it: chance alone, over all sets of variables, gives 12."""
MIMIC_RATIO = 1.5
"""And how many times more it must explain, unless it needs less freedom; a cause that is most of the truth keeps its name, and
what is left gets none."""
STEADIER_RATIO = 1.15
"""The same where the cause explains by fits and starts, as a wrong law does, and the structure alike at all times."""


@dataclass(frozen=True, eq=False)
class SelectedCause:
    """A cause that the training part shows.

    Attributes:
        candidate: Its fits, settings refined.
        p_value: Family-wise.
        rivals: Causes that explain as much in its place.
    """

    candidate: CandidateCause
    p_value: float
    rivals: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class StepwiseSelection:
    """What the training part shows.

    Attributes:
        found: Causes in the order found.
        noise: Noise model of each output.
        ground: The training part with baseline and causes accounted for.
        last: All causes tried beside those found, none significant.
        library: Columns made on the way.
        n_causes: Causes that could be tried.
    """

    found: tuple[SelectedCause, ...]
    noise: tuple[Autoregression, ...]
    ground: NullModel
    last: tuple[CandidateCause, ...]
    library: ColumnCache
    n_causes: int

    def others(self, one: SelectedCause) -> list[Effect]:
        """Return the effects of all causes found but one."""
        return build_effects([other for other in self.found if other is not one])


def build_effects(found: Sequence[SelectedCause]) -> list[Effect]:
    """Return the effects of several causes."""
    return [effect for one in found for effect in one.candidate.effects]


def select_causes(
    channel: Channel,
    rng: np.random.Generator,
    progress: Callable[[str], None],
    *,
    level: float = FAMILY_LEVEL,
    sift: ArtefactFilter | None = None,
) -> StepwiseSelection:
    """Look for causes on the training part.

    What `sift` rejects is passed over at once: beside an artefact, which resembles all sorts of things, a true cause would be
    judged by what little is left of it.
    """
    library = ColumnCache(channel)
    found: list[SelectedCause] = []
    pending: list[tuple[str, ...]] = []  # rivals of each; the next round shows whether they still explain anything
    while True:
        noise, ground, candidates = _scan_candidates(channel, library, [f.candidate for f in found], rng)
        significant = [c for c in candidates if adjust_p_value_bonferroni(c, candidates) < level]
        if pending and len(pending) == len(found):
            still = {c.cause for c in significant}
            found[-1] = replace(found[-1], rivals=tuple(r for r in pending[-1] if r not in still))
        if not significant or len(found) >= MAX_CAUSES or len(pending) >= 2 * MAX_CAUSES:
            break
        taken = choose_next_cause(significant, library, ground, build_effects(found), len(candidates), sift)
        if taken is None:
            break
        best, twins = taken
        progress(f"found {best.cause}")
        pending.append(twins)
        found.append(SelectedCause(best, adjust_p_value_bonferroni(best, candidates), ()))
        found = _merged(found)
    kept = _eliminate_backward(channel, library, found, noise, level)
    kept = _reject_lack_of_fit(channel, library, kept, noise, ground.draw_null_residuals(N_NULL_DRAWS, rng))
    if kept != found:
        kept = _anew(channel, library, kept, noise)
        noise, ground, candidates = _scan_candidates(channel, library, [f.candidate for f in kept], rng)
    return StepwiseSelection(tuple(kept), noise, ground, tuple(candidates), library, len(candidates))


def _merged(found: list[SelectedCause]) -> list[SelectedCause]:
    """Let a cause that was found again, on further joints, join what was found first."""
    last = found[-1]
    for k, one in enumerate(found[:-1]):
        if one.candidate.cause == last.candidate.cause:
            fits = (*one.candidate.fits, *last.candidate.fits)
            joined = replace(one, candidate=replace(one.candidate, fits=fits))
            return [*found[:k], joined, *found[k + 1 : -1]]
    return found


def adjust_p_value_bonferroni(candidate: CandidateCause, candidates: Sequence[CandidateCause]) -> float:
    """Return a cause's p-value with all causes tried taken into account (Bonferroni)."""
    return min(1.0, candidate.p_value * len(candidates))


def _scan_candidates(
    channel: Channel, library: ColumnCache, found: Sequence[CandidateCause], rng: np.random.Generator
) -> tuple[tuple[Autoregression, ...], NullModel, list[CandidateCause]]:
    effects = [effect for candidate in found for effect in candidate.effects]
    extra = get_columns(library, effects)
    noise = fit_noise_models(channel, (TRAIN,), extra)
    ground = NullModel.of(channel, (TRAIN,), noise, extra)
    taken = {(effect.name, effect.joints) for effect in effects}
    return (
        noise,
        ground,
        scan_causes(library, ground, ground.draw_null_residuals(N_NULL_DRAWS, rng), channel.causes, taken),
    )


def _eliminate_backward(
    channel: Channel, library: ColumnCache, found: list[SelectedCause], noise: Sequence[Autoregression], level: float
) -> list[SelectedCause]:
    """Drop, weakest first, what no longer explains anything beside the others."""
    kept = list(found)
    while len(kept) > 1:
        judged = []
        for k, one in enumerate(kept):
            others = build_effects([*kept[:k], *kept[k + 1 :]])
            ground = NullModel.of(channel, (TRAIN,), noise, get_columns(library, others))
            fits = [rescore_group(fit, library, ground) for fit in one.candidate.fits]
            beside = combine_group_tests(one.candidate.cause, fits)
            chance = min(
                1.0,
                float(stats.chi2.sf(beside.statistic, sum(f.dof for f in fits)))
                * np.prod([f.n_effective_tests for f in fits]),
            )
            judged.append((chance, k))
        worst, k = max(judged)
        if worst < level:
            break
        kept.pop(k)
    return kept


def _anew(
    channel: Channel, library: ColumnCache, kept: Sequence[SelectedCause], noise: Sequence[Autoregression]
) -> list[SelectedCause]:
    """Return what was kept, weighed and refined beside the others that were: what was dropped had explained a part of it."""
    found = list(kept)
    for k, one in enumerate(found):
        others = build_effects([other for other in found if other is not one])
        ground = NullModel.of(channel, (TRAIN,), noise, get_columns(library, others))
        fits = tuple(rescore_group(fit, library, ground) for fit in one.candidate.fits)
        found[k] = replace(one, candidate=refine_settings(replace(one.candidate, fits=fits), library, ground))
    return found


def _reject_lack_of_fit(
    channel: Channel,
    library: ColumnCache,
    found: list[SelectedCause],
    noise: Sequence[Autoregression],
    draws: np.ndarray,
) -> list[SelectedCause]:
    """Drop what only mimics a law or a structure without a name: where smooth functions of some variables explain far more.

    A true cause leaves nothing behind, so no structure in its place explains much more than it does. Smooth functions that
    beat a cause by far more than their freedom are a force that this cause resembles, and it would be a wrong name.
    """
    kept = []
    for one in found:
        others = build_effects([other for other in found if other is not one])
        ground = NullModel.of(channel, (TRAIN,), noise, get_columns(library, others))
        fits = [rescore_group(fit, library, ground) for fit in one.candidate.fits]
        structure = find_structure(channel, ground, draws, level=1.0)
        rivals = [f for f in fits if structure is not None and structure.output in f.effect.joints]
        mimics = [f for f in rivals if structure is not None and _beaten(f, structure)]
        mimics += [f for f in fits if f not in mimics and _outshone(f, library, ground)]
        left = tuple(f for f, new in zip(one.candidate.fits, fits, strict=True) if new not in mimics)
        if left:
            kept.append(replace(one, candidate=replace(one.candidate, fits=left)) if mimics else one)
    return kept


def _beaten(fit: GroupTest, structure: Structure) -> bool:
    own = compute_penalised_statistic(
        [fit], 1.0
    )  # as a structure's: which explains more is no matter of either's scatter over time
    if structure.penalised_statistic <= own + MIMIC_MARGIN:
        return False
    steadier = (
        structure.penalised_statistic > STEADIER_RATIO * fit.statistic
        and structure.statistic > MIMIC_RATIO * fit.statistic / fit.overdispersion
    )
    return structure.penalised_statistic > MIMIC_RATIO * fit.statistic or structure.dof < fit.dof or steadier


def _outshone(fit: GroupTest, library: ColumnCache, ground: NullModel) -> bool:
    """Tell whether a law without a name, as free as this one, is more likely."""
    others = [rescore_group(replace(fit, effect=effect), library, ground) for effect in fit.effect.lookalikes()]
    return any((other.statistic - fit.statistic) / fit.overdispersion > MIN_2LOGL_DIFFERENCE for other in others)
