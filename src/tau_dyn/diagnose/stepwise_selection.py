"""Causes found one after the other, then judged together.

Each round tries every cause against what is accounted for, takes the one that explains most for its freedom among those
that noise does not explain at the family-wise level, refines its settings, and goes on. What a cause explains is discounted by
its own scatter over time, which a wrong law has more of; but two laws that explain the same are told apart by their freedom
alone. Afterwards each one has to hold its ground beside all others, and what each could be mistaken for is written down: a
rival that explains nearly as much alone and nothing any more beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.diagnose.candidate_scan import N_NULL_DRAWS, ColumnCache, get_columns, rescore_group, scan_causes
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.data_split import TRAIN
from tau_dyn.diagnose.forward_step import MIN_2LOGL_DIFFERENCE, ArtefactFilter, choose_next_cause
from tau_dyn.diagnose.group_tests import (
    FAMILY_LEVEL,
    CandidateCause,
    GroupTest,
    combine_group_tests,
    compute_penalised_statistic,
)
from tau_dyn.diagnose.noise import fit_noise_models
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.settings_refinement import refine_settings
from tau_dyn.diagnose.unknown_structure import Structure, find_structure
from tau_dyn.effects import Effect
from tau_dyn.estimate import Autoregression

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
