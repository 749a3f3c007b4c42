"""Which of several significant causes is taken in next: the strongest that is no artefact, on the joints that are its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from tau_dyn.diagnose.candidate_scan import ColumnCache, rescore_group
from tau_dyn.diagnose.group_tests import MIN_SHARE_OF_STRONGEST, CandidateCause, GroupTest, compute_penalised_statistic
from tau_dyn.diagnose.null_model import NullModel
from tau_dyn.diagnose.plausibility import SEARCH_MARGIN
from tau_dyn.diagnose.settings_refinement import drop_redundant_groups, estimate_amplitudes, refine_settings
from tau_dyn.effects import Effect

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
