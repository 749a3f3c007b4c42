"""Two causes together in the place of one: a cause that a pair of others explains as well is not told from the pair.

The pair is tried on the joints of the cause, next to all other causes, each member at the setting at which it explains most
there. It is a rival where its penalised statistic reaches that of the cause to within `MIN_2LOGL_DIFFERENCE`, under the
scatter of the cause, and neither member does so alone: that would be a twin of its own. Only causes that are known doubles of the
cause or explain a tenth of it are paired, the strongest first, so that chance has few pairs to choose from.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from tau_dyn.effects import EFFECTS
from tau_dyn.evidence.candidate_scan import (
    MIN_SHARE_OF_STRONGEST,
    CandidateCause,
    GroupTest,
    compute_penalised_statistic,
    find_nonnegative,
    rescore_group,
)
from tau_dyn.evidence.null_model import NullModel, compute_score_test
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE

MAX_MEMBERS = 5
"""Causes that are paired: ten pairs, of which chance makes the best 4.6 better, less than `MIN_2LOGL_DIFFERENCE` allows."""


def find_rival_pairs(
    candidate: CandidateCause, candidates: Sequence[CandidateCause], ground: NullModel
) -> tuple[str, ...]:
    """Return pairs of causes, joined by `+` in the catalogue's order, that explain as much as a cause on all of its joints.

    Args:
        candidate: The cause, its settings refined.
        candidates: All causes that were tried in the same round.
        ground: What is accounted for without the cause.
    """
    found: list[set[str]] = [set(_list_pairs(fit, candidate.cause, candidates, ground)) for fit in candidate.fits]
    return tuple(sorted(set.intersection(*found))) if found else ()


def _list_pairs(fit: GroupTest, cause: str, candidates: Sequence[CandidateCause], ground: NullModel) -> Iterator[str]:
    """Return the pairs that explain as much as one group of a cause."""
    own = compute_penalised_statistic([fit], fit.overdispersion)
    members = _choose_members(fit, cause, candidates, ground)
    alone = {name: compute_penalised_statistic([test], fit.overdispersion) for name, test in members.items()}
    for one, other in combinations(sorted(members, key=list(EFFECTS).index), 2):
        if max(alone[one], alone[other]) > own - MIN_2LOGL_DIFFERENCE:
            continue
        together = _score_together(fit, (members[one], members[other]), ground)
        if compute_penalised_statistic([together], fit.overdispersion) > own - MIN_2LOGL_DIFFERENCE:
            yield f"{one}+{other}"


def _choose_members(
    fit: GroupTest, cause: str, candidates: Sequence[CandidateCause], ground: NullModel
) -> dict[str, GroupTest]:
    """Return the causes on the same joints that are paired, by name: known doubles of the cause, then the strongest ones."""
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
    return {name: rescore_group(test, ground) for name, test in ranked}


def _score_together(fit: GroupTest, pair: tuple[GroupTest, GroupTest], ground: NullModel) -> GroupTest:
    """Return what two groups explain together."""
    C = np.concatenate([ground.rows(test.effect) for test in pair], axis=1)
    nonnegative = np.concatenate([find_nonnegative(test.effect) for test in pair])
    statistic, _, _ = compute_score_test(ground, C, nonnegative)
    tests = float(np.prod([test.n_effective_tests for test in pair]))
    return replace(fit, statistic=statistic, dof=C.shape[1], n_effective_tests=tests)
