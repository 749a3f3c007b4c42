"""What causes explain on each group of joints, and what a cause's groups say together: its chance, and which of them show it.

A cause's p-value takes the better of its best group alone and of all groups together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect

FAMILY_LEVEL = 0.05
"""Chance of any cause on clean data on the training part; confirmation on other data multiplies it by its own level."""
GROUP_LEVEL = 0.01
"""Level at which a further joint joins a cause."""
MIN_SHARE_OF_STRONGEST = 0.1
"""Share of the strongest group's evidence that a further one needs to join at once; a weaker one gets its chance in the next
round, when the strong one is accounted for and nothing of it can leak over."""


@dataclass(frozen=True, eq=False)
class GroupTest:
    """The best setting of one cause on one group of joints.

    Attributes:
        effect: The effect at its best setting.
        statistic: What it explains, in units of the noise.
        n_effective_tests: Number `m` of independent tries that the search over settings amounts to.
        dof: Columns.
        overdispersion: Scatter of the blocks over what the noise model says, at least 1.
        noise: What the best setting explains of each noise draw (D,).
        neighbours: The settings before and after the best one in the grid, where there are.
    """

    effect: Effect
    statistic: float
    n_effective_tests: float
    dof: int
    one_sided: bool
    overdispersion: float
    noise: np.ndarray
    neighbours: tuple[dict[str, float], ...] = ()

    @property
    def p_value(self) -> float:
        """Chance that noise alone reaches `T` on this group."""
        return float(-np.expm1(self.n_effective_tests * np.log1p(-self._tail(self.statistic / self.overdispersion))))

    @property
    def threshold(self) -> float:
        """`T` above which the group joins a cause found elsewhere."""
        wanted = GROUP_LEVEL / self.n_effective_tests * (2 if self.one_sided else 1)
        return float(self.overdispersion * stats.chi2.isf(min(wanted, 1.0), self.dof))

    @property
    def penalised_statistic(self) -> float:
        """`T` less what choosing amplitudes and settings costs."""
        return self.statistic / self.overdispersion - 2 * float(np.log(max(self.n_effective_tests, 1.0))) - 2 * self.dof

    def _tail(self, T: float) -> float:
        tail = float(stats.chi2.sf(T, self.dof))
        return min(tail / 2 if self.one_sided else tail, 1 - 1e-16)


@dataclass(frozen=True, eq=False)
class CandidateCause:
    """One cause on the joints that show it.

    Attributes:
        cause: Its name.
        fits: The groups that show it, strongest first.
        p_value: Chance of the strongest evidence on clean data, for this cause alone.
        tested: All groups tried.
    """

    cause: str
    fits: tuple[GroupTest, ...]
    p_value: float
    tested: tuple[GroupTest, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at their best settings."""
        return tuple(fit.effect for fit in self.fits)

    @property
    def penalised_statistic(self) -> float:
        """What it explains less the price of its freedom; causes are ranked by it."""
        return sum(fit.penalised_statistic for fit in self.fits)

    def merit_under(self, inflation: float) -> float:
        """Return the merit under one inflation for all groups, so that a law is not chosen for its own scatter."""
        return compute_penalised_statistic(self.fits, inflation)

    @property
    def statistic(self) -> float:
        """What it explains, in units of the noise."""
        return sum(fit.statistic / fit.overdispersion for fit in self.fits)


def compute_penalised_statistic(fits: Sequence[GroupTest], inflation: float) -> float:
    """Return the merit of several groups under one inflation."""
    return sum(replace(fit, overdispersion=inflation).penalised_statistic for fit in fits)


def combine_group_tests(cause: str, fits: list[GroupTest]) -> CandidateCause:
    """Combine a cause's groups: its p-value, and which groups show it."""
    best = max(fits, key=lambda fit: fit.penalised_statistic)
    alone = min(fit.p_value for fit in fits)
    p_alone = float(-np.expm1(len(fits) * np.log1p(-min(alone, 1 - 1e-16))))
    p_value = p_alone
    if len(fits) > 1:
        p_value = min(1.0, 2 * min(p_alone, _together(fits)))
    chosen = [
        fit
        for fit in fits
        if fit is best or fit.statistic > max(fit.threshold, MIN_SHARE_OF_STRONGEST * best.statistic)
    ]
    return CandidateCause(
        cause, tuple(sorted(_disjoint(chosen), key=lambda f: -f.penalised_statistic)), p_value, tuple(fits)
    )


def _disjoint(fits: list[GroupTest]) -> list[GroupTest]:
    """Keep the best of groups that share a joint; one instance for all joints competes with one for each."""
    whole = max(fits, key=lambda fit: len(fit.effect.joints))
    parts = [fit for fit in fits if not set(fit.effect.joints) & set(whole.effect.joints) or fit is whole]
    alone = [fit for fit in fits if len(fit.effect.joints) < len(whole.effect.joints)]
    if (
        alone
        and len(whole.effect.joints) > 2
        and compute_penalised_statistic(alone, whole.overdispersion) > whole.penalised_statistic
    ):
        return _disjoint(alone)
    kept: list[GroupTest] = []
    for fit in sorted(parts, key=lambda f: -f.penalised_statistic):
        if not any(set(fit.effect.joints) & set(other.effect.joints) for other in kept):
            kept.append(fit)
    return kept


def _together(fits: list[GroupTest]) -> float:
    """Return the chance that the groups' sum reaches what it does, from a gamma law fitted to the noise draws."""
    total = sum(fit.statistic / fit.overdispersion for fit in fits)
    draws = min(len(fit.noise) for fit in fits)
    noise = np.sum([fit.noise[:draws] for fit in fits], axis=0)
    mean, variance = float(noise.mean()), float(noise.var())
    if mean <= 0 or variance <= 0:
        return 1.0
    scale = max(variance / mean, 2.0)  # no tail of chi-squares falls faster than exp(-t / 2)
    return float(stats.gamma.sf(total, mean / scale, scale=scale))
