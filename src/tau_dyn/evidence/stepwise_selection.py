"""Selection of causes on the training data: forward, one cause at a time, then backward.

Each iteration scans every cause with the selected ones in the model, takes the strongest one that is not an artefact of encoder
noise, on its own joints, and refines its settings. Statistics are divided by the scatter of the blocks, which is larger for a
wrong law; two laws that explain the same are compared by their degrees of freedom alone. Afterwards each cause must be
significant with all others in the model. An alternative cause explains nearly as much in its place and is not significant next
to it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.candidate_scan import (
    FAMILY_LEVEL,
    N_NULL_DRAWS,
    CandidateCause,
    GroupTest,
    combine_group_tests,
    compute_penalised_statistic,
    rescore_group,
    scan_causes,
)
from tau_dyn.evidence.channel import Channel, ColumnCache
from tau_dyn.evidence.forward_step import ArtefactFilter, choose_next_cause, drop_redundant_groups, find_rival_pairs
from tau_dyn.evidence.measurements import TRAIN
from tau_dyn.evidence.null_model import NullModel, fit_noise_models
from tau_dyn.evidence.settings import find_unbelievable, refine_settings
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE, Structure, find_structure

MAX_CAUSES = 5
"""Largest number of causes."""
MIMIC_MARGIN = 12.0
"""Difference of the penalised statistic by which an unnamed structure must exceed a cause to replace it: chance alone, over all
sets of variables, gives 12."""
MIMIC_RATIO = 1.5
"""Factor by which the structure must also explain more, unless it has fewer degrees of freedom; a cause that is most of the
truth keeps its name, and its residual gets no name."""
STEADIER_RATIO = 1.15
"""The same factor if the cause's contribution is irregular in time, as with a wrong law, and the structure's is regular."""


@dataclass(frozen=True, eq=False)
class SelectedCause:
    """A cause that the training data show.

    Attributes:
        candidate: Its fits, with refined settings.
        p_value: Its family-wise p-value.
        rivals: Causes that explain as much in its place.
    """

    candidate: CandidateCause
    p_value: float
    rivals: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class RejectedCause:
    """A significant candidate that the search did not select.

    Attributes:
        selected: The candidate with its family-wise p-value.
        why: The reason, as a phrase.
    """

    selected: SelectedCause
    why: str


@dataclass(frozen=True, eq=False)
class StepwiseSelection:
    """Causes selected on the training data.

    Attributes:
        found: Causes in the order of their selection.
        null_model: The training data with baseline and causes in the model.
        last: All causes of the last scan, with those found in the model.
        rejected: Candidates that are significant in the last scan and were not selected.
    """

    found: tuple[SelectedCause, ...]
    null_model: NullModel
    last: tuple[CandidateCause, ...]
    rejected: tuple[RejectedCause, ...] = ()

    @property
    def channel(self) -> Channel:
        """The measurements."""
        return self.null_model.channel

    @property
    def library(self) -> ColumnCache:
        """Cache of the columns."""
        return self.null_model.library

    def columns(self, effects: Sequence[Effect]) -> list[Sequence[np.ndarray]]:
        """Return the columns (n, m, k) of each run of several effects."""
        return [self.library.columns(effect) for effect in effects]

    @property
    def known_columns(self) -> list[Sequence[np.ndarray]]:
        """The columns of the effects of all causes found."""
        return self.columns(build_effects(self.found))

    def others(self, one: SelectedCause) -> list[Effect]:
        """Return the effects of all causes found except one."""
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
    artefact_filter: ArtefactFilter | None = None,
    excluded: Collection[tuple[str, tuple[str, ...]]] = (),
) -> StepwiseSelection:
    """Select causes on the training data by forward selection and backward elimination.

    A candidate that `artefact_filter` rejects is skipped: in the model, an artefact would take a part of a true cause's effect.

    Args:
        channel: The measurements.
        rng: Random numbers for noise draws.
        progress: Called with a word for each step.
        level: Family-wise significance level.
        artefact_filter: Removes artefacts of encoder noise from a candidate.
        excluded: Causes with their joints that are not tried.
    """
    library = ColumnCache(channel)
    found: list[SelectedCause] = []
    pending: list[tuple[str, ...]] = []  # alternatives of each; the next round shows whether they still explain a part
    while True:
        null_model, candidates = _scan_with(library, found, rng, progress, excluded)
        significant = [c for c in candidates if adjust_p_value_bonferroni(c, candidates) < level]
        if pending and len(pending) == len(found):
            still = {c.cause for c in significant}
            found[-1] = replace(found[-1], rivals=tuple(r for r in pending[-1] if not still & set(r.split("+"))))
        if not significant or len(found) >= MAX_CAUSES or len(pending) >= 2 * MAX_CAUSES:
            break
        taken = choose_next_cause(significant, null_model, build_effects(found), len(candidates), artefact_filter)
        if taken is None:
            break
        best, twins = taken
        progress(f"found {best.cause}")
        pending.append((*twins, *find_rival_pairs(best, candidates, null_model)))
        found = _join(found, SelectedCause(best, adjust_p_value_bonferroni(best, candidates), ()))
    kept = _eliminate_backward(null_model, found, level)
    fitting = _reject_lack_of_fit(null_model, kept, null_model.draw_null_residuals(N_NULL_DRAWS, rng))
    mimics, kept = {one.candidate.cause for one in kept} - {one.candidate.cause for one in fitting}, fitting
    if kept != found:
        kept = _refine_again(null_model, kept)
        null_model, candidates = _scan_with(library, kept, rng, progress, excluded)
    rejected = _list_rejected(null_model, candidates, build_effects(kept), level, artefact_filter, mimics)
    return StepwiseSelection(tuple(kept), null_model, tuple(candidates), rejected)


_MIMICS = "smooth functions of the joints' signals explain far more of the force than this law"
MAX_REJECTED = 3
"""Number of rejected candidates that are examined, the strongest ones; weaker ones mostly resemble these."""


def _list_rejected(
    null_model: NullModel,
    candidates: Sequence[CandidateCause],
    others: Sequence[Effect],
    level: float,
    artefact_filter: ArtefactFilter | None,
    mimics: Collection[str],
) -> tuple[RejectedCause, ...]:
    """Return the significant candidates of the last scan that are not artefacts, with the reason of their rejection.

    `mimics` are causes that the search had selected, and that a structure without a name explains better.
    """
    found = []
    ranked = sorted(candidates, key=lambda c: -c.penalised_statistic)
    significant = [c for c in ranked if adjust_p_value_bonferroni(c, candidates) < level]
    for candidate in significant[:MAX_REJECTED]:
        refined = refine_settings(drop_redundant_groups(candidate, null_model), null_model)
        why = find_unbelievable(refined, null_model) or (_MIMICS if candidate.cause in mimics else "")
        if why and (
            artefact_filter is None or artefact_filter(null_model, refined, others, len(candidates)) is not None
        ):
            found.append(
                RejectedCause(SelectedCause(refined, adjust_p_value_bonferroni(candidate, candidates), ()), why)
            )
    return tuple(found)


def _join(found: list[SelectedCause], last: SelectedCause) -> list[SelectedCause]:
    """Return the causes with one more; a cause that was found before gets the additional joints."""
    for k, one in enumerate(found):
        if one.candidate.cause == last.candidate.cause:
            fits = (*one.candidate.fits, *last.candidate.fits)
            return [*found[:k], replace(one, candidate=replace(one.candidate, fits=fits)), *found[k + 1 :]]
    return [*found, last]


def adjust_p_value_bonferroni(candidate: CandidateCause, candidates: Sequence[CandidateCause]) -> float:
    """Return a cause's p-value, corrected for all causes tried (Bonferroni)."""
    return min(1.0, candidate.p_value * len(candidates))


def _scan_with(
    library: ColumnCache,
    found: Sequence[SelectedCause],
    rng: np.random.Generator,
    progress: Callable[[str], None],
    excluded: Collection[tuple[str, tuple[str, ...]]],
) -> tuple[NullModel, list[CandidateCause]]:
    """Return the training data with the causes found in the model, and all other causes tested next to them."""
    effects = build_effects(found)
    noise = fit_noise_models(library.channel, (TRAIN,), [library.columns(effect) for effect in effects])
    null_model = NullModel.of(library, (TRAIN,), noise, effects)
    taken = {(effect.name, effect.joints) for effect in effects} | set(excluded)
    draws = null_model.draw_null_residuals(N_NULL_DRAWS, rng)
    return null_model, scan_causes(null_model, draws, library.channel.causes, taken, progress)


def _rescore_with_others(
    null_model: NullModel, found: Sequence[SelectedCause], one: SelectedCause
) -> tuple[NullModel, list[GroupTest]]:
    """Return the null model with all other causes, and the statistics of one cause's groups there."""
    with_others = null_model.with_effects(build_effects([other for other in found if other is not one]))
    return with_others, [rescore_group(fit, with_others) for fit in one.candidate.fits]


def _eliminate_backward(null_model: NullModel, found: list[SelectedCause], level: float) -> list[SelectedCause]:
    """Drop, weakest first, the causes that are not significant next to the others.

    A cause in the model takes any amplitude, also one of the wrong sign, with which it may replace a true cause. So where others
    are not significant without a cause, and it is without them, they are dropped instead.
    """
    kept = list(found)
    while len(kept) > 1:
        tails = [_compute_tail(null_model, kept, one) for one in kept]
        k = int(np.argmax(tails))
        if tails[k] < level:
            break
        without = kept[:k] + kept[k + 1 :]
        idle = [one for one in without if _compute_tail(null_model, without, one) >= level]
        rest = [one for one in kept if one not in idle]
        kept = rest if idle and _compute_tail(null_model, rest, kept[k]) < level else without
    return kept


def _compute_tail(null_model: NullModel, found: Sequence[SelectedCause], one: SelectedCause) -> float:
    """Return the p-value of a cause with the others in the model, corrected for its settings."""
    _, fits = _rescore_with_others(null_model, found, one)
    statistic = combine_group_tests(one.candidate.cause, fits).statistic
    tail = float(stats.chi2.sf(statistic, sum(f.dof for f in fits)))
    return min(1.0, tail * float(np.prod([f.n_effective_tests for f in fits])))


def _refine_again(null_model: NullModel, kept: Sequence[SelectedCause]) -> list[SelectedCause]:
    """Return the remaining causes, scored and refined again: the dropped ones had explained a part of them."""
    found = list(kept)
    for k, one in enumerate(found):
        with_others, fits = _rescore_with_others(null_model, found, one)
        found[k] = replace(one, candidate=refine_settings(replace(one.candidate, fits=tuple(fits)), with_others))
    return found


def _reject_lack_of_fit(null_model: NullModel, found: list[SelectedCause], draws: np.ndarray) -> list[SelectedCause]:
    """Drop causes that only mimic another law or a structure: smooth functions of some variables explain far more.

    A true cause leaves no structure, so no structure in its place explains much more than it does. Smooth functions that
    explain more than a cause by far more than their degrees of freedom represent another force, which the cause only resembles:
    its name would be wrong. The weakest goes first: of two laws at one joint each has but the other's remainder to explain.
    """
    kept = list(found)
    while mimics := [
        (fit.statistic, k, j) for k in range(len(kept)) for j, fit in _list_mimics(null_model, kept, k, draws)
    ]:
        _, k, j = min(mimics)
        fits = kept[k].candidate.fits
        left = replace(kept[k].candidate, fits=(*fits[:j], *fits[j + 1 :]))
        kept[k : k + 1] = [replace(kept[k], candidate=left)] if left.fits else []
    return kept


def _list_mimics(
    null_model: NullModel, found: Sequence[SelectedCause], k: int, draws: np.ndarray
) -> list[tuple[int, GroupTest]]:
    """Return the groups of a cause that a structure or another law beats, the other causes in the model, with their number."""
    with_others, fits = _rescore_with_others(null_model, found, found[k])
    structure = find_structure(with_others, draws, level=1.0)
    return [
        (j, fit)
        for j, fit in enumerate(fits)
        if (structure and structure.output in fit.effect.joints and _is_beaten(fit, structure))
        or _is_outshone(fit, with_others)
    ]


def _is_beaten(fit: GroupTest, structure: Structure) -> bool:
    own = compute_penalised_statistic(
        [fit], 1.0
    )  # as for a structure: the comparison must not depend on the scatter of either over time
    if structure.penalised_statistic <= own + MIMIC_MARGIN:
        return False
    steadier = (
        structure.penalised_statistic > STEADIER_RATIO * fit.statistic
        and structure.statistic > MIMIC_RATIO * fit.statistic / fit.overdispersion
    )
    return structure.penalised_statistic > MIMIC_RATIO * fit.statistic or structure.dof < fit.dof or steadier


def _is_outshone(fit: GroupTest, null_model: NullModel) -> bool:
    """Return whether an unnamed law with the same degrees of freedom is more likely."""
    others = [rescore_group(replace(fit, effect=effect), null_model) for effect in fit.effect.lookalikes()]
    return any((other.statistic - fit.statistic) / fit.overdispersion > MIN_2LOGL_DIFFERENCE for other in others)
