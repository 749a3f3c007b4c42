"""One step of the forward selection: the strongest cause that is not an artefact, its joints, and equally good alternatives.

A pair of causes may explain as much as one. The pair is tried on the joints of the cause, next to all other causes, each member
at the setting at which it explains most there. It is an alternative if its penalised statistic reaches that of the cause to
within `MIN_2LOGL_DIFFERENCE`, under the scatter of the cause, and neither member does so alone. Only known alternatives of the
cause and causes that explain a tenth of it are paired, the strongest first, so that few pairs are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.evidence.candidate_scan import (
    MIN_SHARE_OF_STRONGEST,
    CandidateCause,
    GroupTest,
    compute_penalised_statistic,
    find_nonnegative,
    rescore_group,
)
from tau_dyn.evidence.null_model import NullModel, compute_score_test
from tau_dyn.evidence.settings import find_unbelievable, refine_settings
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE

TAKEOVER_2LOGL_MARGIN = 4.0
"""Penalised statistic by which another cause must be better at one joint of several: one cause for all joints has a larger
prior."""
MAX_MEMBERS = 5
"""Number of causes that are paired: ten pairs, the best of which is better by 4.6 by chance, less than
`MIN_2LOGL_DIFFERENCE`."""
ArtefactFilter = Callable[[NullModel, CandidateCause, Sequence[Effect], int], CandidateCause | None]
"""Return a candidate without its artefacts, or None: tested on a null model with the effects in it, as one of several causes."""


def choose_next_cause(
    significant: Sequence[CandidateCause],
    null_model: NullModel,
    others: Sequence[Effect],
    n: int,
    artefact_filter: ArtefactFilter | None,
) -> tuple[CandidateCause, tuple[str, ...]] | None:
    """Return the strongest cause that is not an artefact, with refined settings, and its alternatives, or None."""
    left = [drop_redundant_groups(c, null_model) for c in significant]
    while left:
        strongest, twins = _strongest(left)
        own, more = _drop_shadowed_joints(strongest, left, null_model)
        best = refine_settings(own, null_model)
        genuine = artefact_filter(null_model, best, others, n) if artefact_filter else best
        if genuine is not None and not find_unbelievable(genuine, null_model):
            return genuine, tuple(dict.fromkeys((*twins, *more)))
        left = [c for c in left if c is not strongest]
    return None


def _strongest(significant: Sequence[CandidateCause]) -> tuple[CandidateCause, tuple[str, ...]]:
    """Return the cause that explains most, each divided by its own scatter, and its alternatives.

    Among causes that explain as much under one scatter, the one with the fewest degrees of freedom is taken.
    """
    first = max(significant, key=lambda c: c.penalised_statistic)
    scatter = first.fits[0].overdispersion
    beyond = [c.merit_under(scatter) - first.merit_under(scatter) for c in significant]
    level = [(x, k) for k, x in enumerate(beyond) if abs(x) < MIN_2LOGL_DIFFERENCE]
    best = significant[max(level)[1]]
    best = next((significant[k] for _, k in level if significant[k].cause == best.effects[0].special), best)
    alike = {k for _, k in level}
    near = (
        c
        for k, c in enumerate(significant)
        if c.penalised_statistic > best.penalised_statistic - MIN_2LOGL_DIFFERENCE or k in alike
    )
    return best, tuple(dict.fromkeys(c.cause for c in near if c is not best and c.cause != best.cause))


def drop_redundant_groups(candidate: CandidateCause, null_model: NullModel) -> CandidateCause:
    """Return a candidate with the groups that are significant next to its stronger ones, with their statistics there.

    The effect of a joint leaks through the baseline's refit into other joints, at which the same cause would be found again.
    """
    kept = [candidate.fits[0]]
    for fit in candidate.fits[1:]:
        beside = rescore_group(fit, null_model.augment([one.effect for one in kept]))
        if beside.statistic > beside.threshold:
            kept.append(beside)
    return replace(candidate, fits=tuple(kept))


def _drop_shadowed_joints(
    best: CandidateCause, significant: Sequence[CandidateCause], null_model: NullModel
) -> tuple[CandidateCause, tuple[str, ...]]:
    """Return a cause without the joints at which it only imitates a stronger one, and its alternatives elsewhere.

    An imitation explains hardly a tenth of its statistic next to the other cause; one that explains more is a separate cause.
    If neither explains far more than the other, they are indistinguishable at this joint.
    """
    scatter = best.fits[0].overdispersion
    alone = [(c.cause, fit) for c in significant if c is not best for fit in c.tested]
    kept, twins = [], []
    for fit in best.fits:
        own = next(f for f in best.tested if f.effect.joints == fit.effect.joints)
        merit = compute_penalised_statistic([own], scatter)
        same = [(cause, other) for cause, other in alone if set(other.effect.joints) == set(fit.effect.joints)]
        near = [x for x in same if compute_penalised_statistic([x[1]], scatter) > merit - MIN_2LOGL_DIFFERENCE]
        over = [(cause, other) for cause, other in near if _is_shadow(own, other, null_model)]
        if any(compute_penalised_statistic([other], scatter) > merit + TAKEOVER_2LOGL_MARGIN for _, other in over):
            continue
        kept.append(fit)
        twins += [cause for cause, _ in over]
    return replace(best, fits=tuple(kept) or best.fits[:1]), tuple(twins)


def _is_shadow(fit: GroupTest, other: GroupTest, null_model: NullModel) -> bool:
    left = rescore_group(fit, null_model.augment([other.effect]))
    return left.statistic <= max(left.threshold, MIN_SHARE_OF_STRONGEST * fit.statistic)


def find_rival_pairs(
    candidate: CandidateCause, candidates: Sequence[CandidateCause], null_model: NullModel
) -> tuple[str, ...]:
    """Return pairs of causes, joined by `+` in the catalogue's order, that explain as much as a cause on all of its joints.

    Args:
        candidate: The cause, its settings refined.
        candidates: All causes that were tried in the same round.
        null_model: The residual without the cause in the model.
    """
    found: list[set[str]] = [set(_list_pairs(fit, candidate.cause, candidates, null_model)) for fit in candidate.fits]
    return tuple(sorted(set.intersection(*found))) if found else ()


def _list_pairs(
    fit: GroupTest, cause: str, candidates: Sequence[CandidateCause], null_model: NullModel
) -> Iterator[str]:
    """Return the pairs that explain as much as one group of a cause."""
    own = compute_penalised_statistic([fit], fit.overdispersion)
    members = _choose_members(fit, cause, candidates, null_model)
    alone = {name: compute_penalised_statistic([test], fit.overdispersion) for name, test in members.items()}
    for one, other in combinations(sorted(members, key=list(EFFECTS).index), 2):
        if max(alone[one], alone[other]) > own - MIN_2LOGL_DIFFERENCE:
            continue
        together = _score_together(fit, (members[one], members[other]), null_model)
        if compute_penalised_statistic([together], fit.overdispersion) > own - MIN_2LOGL_DIFFERENCE:
            yield f"{one}+{other}"


def _choose_members(
    fit: GroupTest, cause: str, candidates: Sequence[CandidateCause], null_model: NullModel
) -> dict[str, GroupTest]:
    """Return the causes on the same joints that are paired, by name: known alternatives first, then the strongest causes."""
    known = set(fit.effect.mistaken_for)
    same = [
        (other.cause, test)
        for other in candidates
        if other.cause != cause and other.cause in EFFECTS
        for test in other.tested
        if set(test.effect.joints) == set(fit.effect.joints)
    ]
    large = [
        (name, test) for name, test in same if name in known or test.statistic > MIN_SHARE_OF_STRONGEST * fit.statistic
    ]
    ranked = sorted(large, key=lambda row: (row[0] not in known, -row[1].statistic))[:MAX_MEMBERS]
    return {name: rescore_group(test, null_model) for name, test in ranked}


def _score_together(fit: GroupTest, pair: tuple[GroupTest, GroupTest], null_model: NullModel) -> GroupTest:
    """Return the statistic of two groups together."""
    C = np.concatenate([null_model.rows(test.effect) for test in pair], axis=1)
    nonnegative = np.concatenate([find_nonnegative(test.effect) for test in pair])
    statistic, _, _ = compute_score_test(null_model, C, nonnegative)
    tests = float(np.prod([test.n_effective_tests for test in pair]))
    return replace(fit, statistic=statistic, dof=C.shape[1], n_effective_tests=tests)
